"""The slides of the lectures: every section is there, every result is under its text, and no page needs the network."""

import re
import runpy
from pathlib import Path

import nbformat
import pytest

ROOT = Path(__file__).parents[2]
SLIDES = runpy.run_path(str(ROOT / "docs/slides.py"))


def plain(name: str) -> nbformat.NotebookNode:
    return nbformat.read(ROOT / f"notebooks/{name}.ipynb", as_version=4)


@pytest.mark.parametrize("title", SLIDES["LECTURES"])
def test_a_lecture_has_its_sections_as_slides_and_needs_no_network(title: str) -> None:
    made = [
        slide
        for name, sections in SLIDES["LECTURES"][title].items()
        for slide in SLIDES["slides"](plain(name), sections)
    ]
    assert 15 <= len(made) <= 40
    page = SLIDES["page"](title, made)
    assert page.count("<section") == len(made) + 1
    for sections in SLIDES["LECTURES"][title].values():
        for section in sections:
            assert re.search(rf"<h2[^>]*>{re.escape(section)}".replace("'", ".+"), page), section
    fetched = re.findall(r"<(?:script|link|img|iframe)[^>]*?(?:src|href)=\"([^\"]+)\"", page)
    assert fetched == ["mathjax/tex-mml-chtml.js"]
    assert (SLIDES["mathjax"]() / "tex-mml-chtml.js").is_file()


def test_folded_and_long_code_is_left_out_of_a_slide_and_short_code_is_shown() -> None:
    cells = [
        nbformat.v4.new_markdown_cell("## One\n\nSee [02](02-linearisation.ipynb)."),
        nbformat.v4.new_code_cell("short = 1"),
        nbformat.v4.new_code_cell("folded = 1", metadata={"tags": ["hide-input"]}),
        nbformat.v4.new_code_cell("\n".join(f"line_{k} = {k}" for k in range(SLIDES["SHORT"] + 1))),
        nbformat.v4.new_markdown_cell("More of one.\n\n## Two\n\nNot chosen."),
    ]
    made = SLIDES["slides"](nbformat.v4.new_notebook(cells=cells), ("One",))
    page = SLIDES["page"]("A lecture", made)
    assert len(made) == 2
    assert "short" in page and "folded" not in page and "line_3" not in page
    assert "See 02." in page and "More of one." in page and "Not chosen." not in page


def test_a_section_that_no_notebook_has_is_named() -> None:
    with pytest.raises(KeyError, match="no section 'Nowhere'"):
        SLIDES["slides"](plain("02-linearisation"), ("Nowhere",))
