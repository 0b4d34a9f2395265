"""The notebooks as they are committed: short, stripped, each with its question, every link leading somewhere.

That they run is tested by nbmake: ``make test`` gives it the notebooks too, ``make notebooks`` at full length.
"""

import ast
import json
import re
from pathlib import Path

import pytest

from fiplib.products import PRODUCTS

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))

CELL_LINES = 25
FOLDED_LINES = 40  # of a figure whose code is folded away
WIDTH = 88
DEF_LINES = 10

LINK = re.compile(r"\]\((?!\w+:)([^)\s]*)\)")
"""A link in Markdown to a place in this repository: a path, with or without an anchor, or an anchor alone."""


def cells(path: Path, kind: str) -> list[str]:
    """The sources of a notebook's cells of one kind, "code" or "markdown"."""
    notebook = json.loads(path.read_text(encoding="utf-8"))
    return ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == kind]


def tagged(path: Path, tag: str) -> list[str]:
    """The sources of the code cells with a tag."""
    notebook = json.loads(path.read_text(encoding="utf-8"))
    return ["".join(cell["source"]) for cell in notebook["cells"] if tag in cell.get("metadata", {}).get("tags", ())]


def python(source: str) -> ast.Module:
    """A code cell without the lines that only IPython understands."""
    lines = source.splitlines()
    return ast.parse("\n".join("pass" if re.match(r"[%!?]", line) else line for line in lines))


def anchors(path: Path) -> set[str]:
    """What JupyterLab and the book make of a notebook's headings: words joined by hyphens, without case."""
    headings = re.findall(r"^#+ (.+)$", "\n".join(cells(path, "markdown")), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading).strip().replace(" ", "-").lower() for heading in headings}


def stored_outputs(path: Path) -> list[str]:
    """What running has left behind in a notebook."""
    notebook = json.loads(path.read_text(encoding="utf-8"))
    code = [(number, cell) for number, cell in enumerate(notebook["cells"]) if cell["cell_type"] == "code"]
    return [f"cell {number}" for number, cell in code if cell["outputs"] or cell["execution_count"] is not None]


def too_long(path: Path) -> list[str]:
    """Code cells and functions that are longer than a reader takes in at once."""
    found = []
    folded = tagged(path, "hide-input")
    for number, source in enumerate(cells(path, "code")):
        if (length := len(source.splitlines())) > (FOLDED_LINES if source in folded else CELL_LINES):
            found.append(f"code cell {number}: {length} lines")
        if max(map(len, source.splitlines()), default=0) > WIDTH:
            found.append(f"code cell {number}: wider than {WIDTH} columns")
        for node in ast.walk(python(source)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                if (length := node.end_lineno - node.lineno + 1) > DEF_LINES:
                    found.append(f"code cell {number}: {node.name} has {length} lines")
    return found


def open_figures(path: Path) -> list[str]:
    """Code that draws, and would stand between a sentence and its picture: it is to be folded."""
    folded = tagged(path, "hide-input")
    drawing = [source for source in cells(path, "code") if re.search(r"plt\.(subplots|figure)\(", source)]
    return [source.splitlines()[0] for source in drawing if source not in folded]


def faults_of_numbering(path: Path) -> list[str]:
    """Equations that are not numbered (1), (2), ... in order, and references to others without "of the paper"."""
    text = "\n".join(cells(path, "markdown"))
    tags = re.findall(r"\\tag\{(.*?)\}", text)
    found = [] if tags == [str(k + 1) for k in range(len(tags))] else [f"tags {tags}"]
    for number, after in re.findall(r"Eqs?\. \((\d+)\)((?:(?:,| and| to) \(\d+\))*(?: of the paper)?)", text):
        if number not in tags and "of the paper" not in after:
            found.append(f"Eq. ({number}) is not in this notebook")
    return found


def broken_links(path: Path) -> list[str]:
    """Links of a notebook to files, notebooks or headings that are not there."""
    found = []
    for link in LINK.findall("\n".join(cells(path, "markdown"))):
        file, _, anchor = link.partition("#")
        target = (path.parent / file).resolve() if file else path
        known = target.exists() and (not anchor or target.suffix != ".ipynb" or anchor.lower() in anchors(target))
        found += [] if known else [link]
    return found


def opening_faults(path: Path) -> list[str]:
    """What the first cell lacks: a title, the question, the time and what one can do afterwards, what it needs."""
    [first, *_] = cells(path, "markdown")
    title = rf"\A# {path.name[:2]} \w"
    wanted = {
        "a title with its number": title,
        "its question": r"\*\*Question\.\*\*",
        "a question mark": r"\?",
        "its time and objectives": r"^\*\*\d+ minutes[^*]*; afterwards you can\*\* ",
        "what it needs": r"^\*\*You need\*\* ",
    }
    return [what for what, pattern in wanted.items() if not re.search(pattern, first, re.IGNORECASE | re.MULTILINE)]


def test_the_thirteen_notebooks_are_numbered_without_a_gap():
    assert [path.name[:2] for path in NOTEBOOKS] == [f"{number:02}" for number in range(len(NOTEBOOKS))]
    assert len(NOTEBOOKS) == 13


FAULTS = [stored_outputs, too_long, open_figures, faults_of_numbering, broken_links, opening_faults]


@pytest.mark.parametrize("fault", FAULTS, ids=lambda f: f.__name__)
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_no_notebook_has_this_fault(path, fault):
    assert fault(path) == []


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_begins_with_text_and_ends_with_what_to_try(path):
    kinds = [cell["cell_type"] for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]]
    assert kinds[0] == "markdown"
    headings = re.findall(r"^#+ (.+)$", "\n".join(cells(path, "markdown")), re.MULTILINE)
    assert any(heading.lower().startswith("what to try") for heading in headings)
    assert "What was learnt" in headings


def test_the_ninth_notebook_shows_every_figure_and_walks_over_every_table():
    source = "\n".join(cells(ROOT / "notebooks/09-paper-figures.ipynb", "code"))
    shown = set(re.findall(r'make\("(fig\d+-\w+)", DATA\)', source))
    assert shown == {name for name in PRODUCTS if name.startswith("fig")}
    assert "for name in products.PRODUCTS:" in source


SOUND = {
    "cells": [
        {
            "cell_type": "markdown",
            "source": [
                "# 00 A title\n\n**Question.** Does it hold? [here](#00-a-title)\n\n",
                "**5 minutes; afterwards you can** say so.\n\n**You need** nothing.\n\n",
                "$$x \\tag{1}$$ Eq. (1), Eq. (7) of the paper",
            ],
        },
        {"cell_type": "code", "source": ["%matplotlib inline\n", "x = 1"], "outputs": [], "execution_count": None},
    ]
}


def written(folder: Path, **changes: object) -> Path:
    """A sound notebook on disk, with fields of its last cell changed; of its first, where the name says so."""
    notebook = json.loads(json.dumps(SOUND))
    for name, value in changes.items():
        notebook["cells"][name != "opening"]["source" if name == "opening" else name] = value
    path = folder / "00-a.ipynb"
    path.write_text(json.dumps(notebook))
    return path


@pytest.mark.parametrize("fault", FAULTS, ids=lambda f: f.__name__)
def test_a_sound_notebook_has_no_fault(tmp_path, fault):
    assert fault(written(tmp_path)) == []


@pytest.mark.parametrize(
    ("fault", "changes"),
    [
        (stored_outputs, {"outputs": [{"output_type": "stream", "name": "stdout", "text": "1"}]}),
        (stored_outputs, {"execution_count": 1}),
        (too_long, {"source": "x = 1\n" * (CELL_LINES + 1)}),
        (too_long, {"source": "x = " + "1" * WIDTH}),
        (open_figures, {"source": "fig, ax = plt.subplots()"}),
        (faults_of_numbering, {"opening": r"$$x \tag{2}$$"}),
        (faults_of_numbering, {"opening": r"$$x \tag{1}$$ as in Eq. (3)"}),
        (opening_faults, {"opening": "# 00 A title\n\n**Question.** Does it hold?\n\n**You need** nothing."}),
        (too_long, {"source": "def f():\n" + "    x = 1\n" * DEF_LINES}),
        (broken_links, {"opening": "[nowhere](no-such-file.py)"}),
        (broken_links, {"opening": "# 00 A title\n[elsewhere](#another-title)"}),
        (broken_links, {"opening": "# 00 A title\n[elsewhere](00-a.ipynb#another-title)"}),
        (opening_faults, {"opening": "# 00 A title\n\nWe show that it holds."}),
        (opening_faults, {"opening": "**Question.** Does it hold?"}),
        (opening_faults, {"opening": "# 01 A title\n\n**Question.** Does it hold?"}),
    ],
)
def test_each_fault_is_found(tmp_path, fault, changes):
    assert len(fault(written(tmp_path, **changes))) >= 1
