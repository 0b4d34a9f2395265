"""The page "Extend it": its files written into a copy of the library, its lines added, its commands run."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs/extend.md").read_text(encoding="utf-8")
BLOCK = re.compile(r"```(\w+)\n(.*?)```", re.DOTALL)
CHAPTERS = dict(re.findall(r"^## (.+?)\n(.*?)(?=^## |\Z)", PAGE, re.MULTILINE | re.DOTALL))
pytestmark = pytest.mark.xdist_group("extend")
EXAMPLES = {title: blocks for title, text in CHAPTERS.items() if (blocks := BLOCK.findall(text))}


def insert(folder: Path, block: str) -> None:
    """Put a block of the page where its first line says: a file of its own, or lines after or instead of another."""
    head, _, body = block.partition("\n")
    where = head.removeprefix("# ")
    if where.startswith(("line: ", "replace: ")):
        kind, file, anchor = where.split(": ", 2)
        text = (folder / file).read_text(encoding="utf-8")
        assert text.count(anchor) == 1, f"{file}: {anchor} is not there once"
        new = f"{anchor}\n{body.rstrip()}" if kind == "line" else body.strip()
        (folder / file).write_text(text.replace(anchor, new), encoding="utf-8")
    else:
        assert not (folder / where).exists()
        (folder / where).write_text(body, encoding="utf-8")


@pytest.fixture(scope="module")
def extended(tmp_path_factory):
    """A copy of the library with all of the page's files and lines: one copy, since its loops are compiled afresh."""
    folder = tmp_path_factory.mktemp("extended")
    shutil.copytree(ROOT / "fiplib", folder / "fiplib", ignore=shutil.ignore_patterns("__pycache__"))
    for blocks in EXAMPLES.values():
        for language, block in blocks:
            if language == "python":
                insert(folder, block)
    return folder


def test_the_page_has_one_of_each_kind():
    assert list(EXAMPLES) == ["An estimator", "A controller", "A study, with its figure", "A link"]


def test_the_files_of_the_page_have_the_style_of_their_neighbours(extended):
    config = ("--config", str(ROOT / "pyproject.toml"))
    style = subprocess.run(
        [sys.executable, "-m", "ruff", "check", *config, "."], cwd=extended, capture_output=True, text=True
    )
    assert style.returncode == 0, style.stdout


@pytest.mark.parametrize("title", EXAMPLES)
def test_an_example_works_as_the_page_says(title, extended):
    commands = [line for language, block in EXAMPLES[title] if language == "sh" for line in block.splitlines()]
    assert commands
    before = set(extended.rglob("*"))
    for command in commands:
        name, *arguments = shlex.split(command)
        assert name == "fip"
        done = subprocess.run(
            [sys.executable, "-m", "fiplib", *arguments],
            cwd=extended,
            env=os.environ | {"PYTHONPATH": str(extended)},
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"
    made = {path.suffix for path in set(extended.rglob("*")) - before}
    assert made & {".mcap", ".pdf"}, "the commands wrote nothing"
