"""Running a notebook leaves the repository clean: git strips what a run writes, and nothing else is written."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

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


def test_git_sees_nothing_after_a_notebook_was_run_in_place(tmp_path: Path) -> None:
    name = "02-linearisation"  # the quickest with figures
    path = ROOT / f"notebooks/{name}.ipynb"
    clone = tmp_path / "clone"
    run(tmp_path, "git", "clone", "--quiet", str(repository(tmp_path / "origin", [path])), str(clone))
    set_up(clone)
    before = (clone / f"notebooks/{name}.ipynb").read_bytes()
    run(
        clone,
        sys.executable,
        "-m",
        "nbconvert",
        "--to",
        "notebook",
        "--execute",
        "--inplace",
        f"notebooks/{name}.ipynb",
    )
    after = (clone / f"notebooks/{name}.ipynb").read_bytes()
    assert b"image/png" in after and b"image/png" not in before  # it was run, and its pictures are in the file
    assert run(clone, "git", "status", "--porcelain") == ""
    run(clone, "git", "add", "--all")
    assert run(clone, "git", "diff", "--cached", "--name-only") == ""


def test_the_filter_leaves_every_committed_notebook_as_it_is(tmp_path: Path) -> None:
    clone = repository(tmp_path, NOTEBOOKS)
    set_up(clone)
    for path in (clone / "notebooks").glob("*.ipynb"):
        os.utime(path, (0, 0))  # git must look at the content
    assert run(clone, "git", "status", "--porcelain") == ""


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
