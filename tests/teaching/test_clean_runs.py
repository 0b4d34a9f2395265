"""Running a notebook leaves the repository clean: git strips what a run writes, and nothing else is written."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import nbformat
import pytest
from jupyter_server.services.contents.filemanager import FileContentsManager
from traitlets.config import Config

from fiplib.teaching.saved import compare_by_content

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
PARTS = (".gitattributes", ".gitignore", "Makefile", "notebooks/ruff.toml")

pytestmark = pytest.mark.skipif(
    not (shutil.which("git") and shutil.which("make")), reason="needs git and make to show what git sees"
)


def run(folder: Path, *command: str) -> str:
    who = {f"GIT_{role}_{what}": "test@localhost" for role in ("AUTHOR", "COMMITTER") for what in ("NAME", "EMAIL")}
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("GIT_", "MAKE"))}
    done = subprocess.run(command, cwd=folder, env=kept | who | {"FIP_FAST": "1"}, capture_output=True, text=True)
    assert done.returncode == 0, f"{command}: {done.stdout}{done.stderr}"
    return done.stdout


def repository(folder: Path, notebooks: list[Path]) -> Path:
    """A repository with these notebooks and our rules of git, committed before its filter is set up."""
    for part in (*PARTS, *(path.relative_to(ROOT).as_posix() for path in notebooks)):
        (folder / part).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / part, folder / part)
    run(folder, "git", "init", "--quiet")
    run(folder, "git", "add", "--all")
    run(folder, "git", "commit", "--quiet", "--message", "Notebooks")
    return folder


def set_up(folder: Path) -> None:
    """The filter as `make` sets it up after .venv, with this interpreter in place of .venv/bin/python."""
    (folder / ".venv/bin").mkdir(parents=True)
    python = folder / ".venv/bin/python"
    python.write_text(f'#!/bin/sh\nexec "{sys.executable}" "$@"\n')
    python.chmod(0o755)
    run(folder, "make", "notebook-filter")


def clone_of(tmp_path: Path, notebook: Path) -> Path:
    """A clone of a repository with one notebook, set up."""
    clone = tmp_path / "clone"
    run(tmp_path, "git", "clone", "--quiet", str(repository(tmp_path / "origin", [notebook])), str(clone))
    set_up(clone)
    return clone


def test_git_sees_nothing_after_a_notebook_was_run(tmp_path: Path) -> None:
    path = ROOT / "notebooks/02-linearisation.ipynb"  # the quickest with figures
    clone = clone_of(tmp_path, path)
    file = clone / "notebooks" / path.name
    run(clone, sys.executable, "-m", "nbconvert", "--to", "notebook", "--execute", "--inplace", str(file))
    after = file.read_bytes()
    assert b"image/png" in after  # it was run, and its pictures are in the file
    assert after.count(b'"not yet: ') == 4  # what a teacher counts: each of its exercises was graded
    assert run(clone, "git", "diff") == ""
    compare_by_content(file)
    assert run(clone, "git", "status", "--porcelain") == ""


def test_git_sees_what_a_student_writes_and_not_what_jupyter_adds(tmp_path: Path) -> None:
    path = NOTEBOOKS[0]
    clone = clone_of(tmp_path, path)
    hook = json.loads(re.search(r"^LAB_HOOK := (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)[1])
    jupyter = FileContentsManager(root_dir=str(clone), config=Config(hook))
    model = jupyter.get(f"notebooks/{path.name}")
    code = next(cell for cell in model["content"]["cells"] if cell["cell_type"] == "code")
    code["outputs"] = [nbformat.v4.new_output("stream", text="a result\n")]
    code["execution_count"] = 1
    model["content"]["metadata"]["language_info"] = {"name": "python", "version": "3.13.1", "file_extension": ".py"}
    jupyter.save(model, f"notebooks/{path.name}")
    assert "a result" in (clone / "notebooks" / path.name).read_text(encoding="utf-8")
    assert run(clone, "git", "status", "--porcelain") == ""
    code["source"] += "\n# mine"
    jupyter.save(model, f"notebooks/{path.name}")
    assert run(clone, "git", "status", "--porcelain") == f" M notebooks/{path.name}\n"
    assert "a result" not in run(clone, "git", "diff") and "# mine" in run(clone, "git", "diff")


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_committed_notebook_is_written_as_the_filter_writes_it(path: Path) -> None:
    """Else it would show as modified after each run: keys in order, no results, no version of Python."""
    text = path.read_text(encoding="utf-8")
    notebook = nbformat.reads(text, as_version=4)
    assert notebook.metadata.language_info == {"name": "python"}
    assert notebook.metadata.kernelspec.display_name == "Python 3 (ipykernel)"  # as JupyterLab writes it
    assert nbformat.writes(notebook).rstrip("\n") + "\n" == text


def test_a_clone_without_an_environment_works_and_commits_what_is_there(tmp_path: Path) -> None:
    clone = repository(tmp_path, NOTEBOOKS[:1])
    run(clone, "make", "notebook-filter")  # .venv was removed afterwards, or is elsewhere
    file = clone / "notebooks" / NOTEBOOKS[0].name
    file.write_text(file.read_text(encoding="utf-8").replace("# 00 Start here", "# 00 Begin here"), encoding="utf-8")
    assert run(clone, "git", "status", "--porcelain") == f" M notebooks/{file.name}\n"
    run(clone, "git", "commit", "--quiet", "--all", "--message", "Begin")
    assert "# 00 Begin here" in run(clone, "git", "show", f"HEAD:notebooks/{file.name}")


def test_no_filter_is_set_up_in_the_repository_of_somebody_else(tmp_path: Path) -> None:
    run(tmp_path, "git", "init", "--quiet")
    inside = tmp_path / "vendored"
    inside.mkdir()
    shutil.copy(ROOT / "Makefile", inside / "Makefile")
    run(inside, "make", "notebook-filter")
    assert "filter.notebooks" not in run(tmp_path, "git", "config", "--list", "--local")
