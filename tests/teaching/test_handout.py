"""The copy for students has everything that the notebooks need, and no worked answer."""

import json
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from fiplib.params import FipError
from fiplib.teaching.handout import handout, without_solutions
from tests.teaching.test_notebooks import broken_links

ROOT = Path(__file__).parents[2]

pytestmark = pytest.mark.skipif(
    subprocess.run(["git", "ls-files", "--error-unmatch", "README.md"], cwd=ROOT, capture_output=True).returncode != 0,
    reason="needs a clone: git says which files belong to the repository",
)


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("handout") / "student"
    handout(folder)
    return folder


def test_no_solution_is_in_the_copy_or_in_its_zip(copy: Path) -> None:
    with zipfile.ZipFile(copy.with_suffix(".zip")) as archive:
        names = archive.namelist()
    assert any(name.endswith("notebooks/02-linearisation.ipynb") for name in names)
    assert not [name for name in names if "solutions" in name or "/tests/" in name]
    bodies = [path.read_text(encoding="utf-8") for path in (ROOT / "notebooks/solutions").glob("*.py")]
    lines = {
        line.strip() for body in bodies for line in body.splitlines() if line.startswith("    ") and len(line) > 50
    }
    assert len(lines) > 20
    for notebook in (copy / "notebooks").glob("*.ipynb"):
        cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
        source = "\n".join("".join(cell["source"]) for cell in cells)
        assert not [line for line in lines if line in source], notebook.name


def test_no_notebook_leads_to_a_solution_and_every_other_link_leads_somewhere(copy: Path) -> None:
    notebooks = sorted((copy / "notebooks").glob("*.ipynb"))
    assert len(notebooks) == len(list((ROOT / "notebooks").glob("*.ipynb")))
    for notebook in notebooks:
        assert "solutions/" not in notebook.read_text(encoding="utf-8")
        assert broken_links(notebook) == []


def test_the_exercises_of_the_copy_can_be_graded_in_it(copy: Path) -> None:
    code = """
import fiplib, numpy as np
from fiplib.teaching.exercises import linearisation as exercises
exercises.growth_rate.check(lambda length, k2: np.sqrt(2 * 9.81 / length / (1 + 4 * k2)))
print(fiplib.__file__)
"""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=copy, env={"PYTHONPATH": str(copy)}, capture_output=True, text=True
    )
    assert done.stdout.startswith("right: ") and str(copy) in done.stdout, done.stderr


def test_a_second_copy_replaces_the_first_and_nothing_else_is_replaced(tmp_path: Path) -> None:
    with pytest.raises(FipError, match="not a copy for students"):
        (tmp_path / "mine").mkdir()
        handout(tmp_path / "mine")
    with pytest.raises(FipError, match="no clone of the repository"):
        handout(tmp_path / "copy", root=tmp_path)


def test_a_paragraph_with_a_solution_goes_the_others_stay() -> None:
    text = {
        "cell_type": "markdown",
        "metadata": {},
        "source": ["Read.\n", "\n", "See [it](solutions/02.py).\n", "\n", "## Go on"],
    }
    code = {"cell_type": "code", "source": ["1"], "outputs": [1], "execution_count": 3, "metadata": {}}
    cells = json.loads(without_solutions(json.dumps({"cells": [text, code]})))["cells"]
    assert "".join(cells[0]["source"]) == "Read.\n\n## Go on"
    assert cells[1]["outputs"] == [] and cells[1]["execution_count"] is None
    assert not re.search("solutions", json.dumps(cells))
