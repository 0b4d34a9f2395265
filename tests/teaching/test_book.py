"""The book builds, its links lead somewhere, and none of its pages needs the network.

Built here without running the notebooks, whose outputs ``make book`` checks in the same way.
"""

import importlib.util
import json
import re
import shutil
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")

spec = importlib.util.spec_from_file_location("book", ROOT / "docs/book.py")
book = importlib.util.module_from_spec(spec)
spec.loader.exec_module(book)


RUN = {
    "cells": [
        {"cell_type": "markdown", "id": "a", "metadata": {}, "source": "# 99 A notebook that was run"},
        {
            "cell_type": "code",
            "id": "b",
            "execution_count": 1,
            "metadata": {},
            "source": "x",
            "outputs": [
                {
                    "output_type": "display_data",
                    "metadata": {},
                    "data": {"application/vnd.jupyter.widget-view+json": {"model_id": "0"}, "text/plain": "HBox()"},
                },
                {
                    "output_type": "display_data",
                    "metadata": {},
                    "data": {
                        "text/html": '<link rel="stylesheet" href="https://cdn.example.org/icons.css"><b>a film</b>',
                        "text/plain": "<film>",
                    },
                },
                {
                    "output_type": "display_data",
                    "metadata": {},
                    "data": {"text/markdown": "| length | $l$ |\n|---|---|\n| 1 | m |", "text/plain": "<table>"},
                },
                {"output_type": "stream", "name": "stderr", "text": "100%|####| progress"},
            ],
        },
    ],
    "metadata": {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}},
    "nbformat": 4,
    "nbformat_minor": 5,
}
"""A notebook with outputs of the kinds that would need a kernel or the network, or that a page should not show."""


@pytest.fixture(scope="module")
def html(tmp_path_factory):
    """The built pages; Sphinx takes every warning for an error, among them references to names that do not exist."""
    folder = tmp_path_factory.mktemp("book")
    book.assemble(folder / "source")
    (folder / "source/notebooks/99-outputs.ipynb").write_text(json.dumps(RUN))
    book.build(folder / "source", folder / "html", execute=False)
    return folder / "html"


def test_every_link_of_the_book_leads_somewhere_and_nothing_is_fetched(html):
    assert list(book.problems(html)) == []


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine: the pages were not looked at in one")
def test_no_page_shows_an_error_box_or_is_wider_than_a_screen_or_a_phone(html):
    from playwright.sync_api import sync_playwright

    wrong = []
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        pages = [path for path in html.rglob("*.html") if path.relative_to(html).parts[0] not in ("api", "_static")]
        for width in (1280, 390):
            page = browser.new_page(viewport={"width": width, "height": 900})
            for path in sorted(path for path in pages if "_modules" not in path.parts):
                page.goto(path.as_uri())
                page.evaluate("async () => { if (window.MathJax?.startup) await MathJax.startup.promise }")
                errors = page.locator("mjx-merror").count()
                excess = page.evaluate("document.documentElement.scrollWidth - window.innerWidth")
                if errors or excess > 1:  # a pixel of rounding
                    wrong.append((path.name, width, errors, excess))
            page.close()
        browser.close()
    assert wrong == []


def test_every_notebook_and_every_module_has_a_page(html):
    notebooks = [html / f"notebooks/{path.stem}.html" for path in ROOT.glob("notebooks/*.ipynb")]
    modules = [html / f"api/{book.module_name(path)}.html" for path in ROOT.glob("fiplib/**/*.py")]
    pages = [page for page in (*notebooks, *modules) if page != html / "api/fiplib.html"]
    assert len(pages) > 30
    assert [page for page in pages if not page.is_file()] == []


def test_a_link_to_a_module_in_a_notebook_becomes_one_to_its_page(html):
    page = book.Page((html / "notebooks/09-paper-figures.html").read_text())
    assert "../api/fiplib.products.html" in page.links
    assert "10-errata.html" in page.links


def test_formulas_are_set_by_files_of_the_book(html):
    page = book.Page((html / "notebooks/09-paper-figures.html").read_text())
    [mathjax] = [script for script in page.fetched if "mathjax" in script]
    assert (html / "notebooks" / mathjax.partition("?")[0]).resolve().is_file()


def test_outputs_need_neither_kernel_nor_network(html):
    text = (html / "notebooks/99-outputs.html").read_text()
    assert "<b>a film</b>" in text and "cdn.example.org" not in text
    assert "<td" in text and "progress" not in text and "HBox()" not in text
    assert '<span class="pre">make</span> <span class="pre">lab</span>' in text


def test_building_the_book_leaves_the_notebooks_as_they_were(html):
    for path in ROOT.glob("notebooks/*.ipynb"):
        assert not any(cell.get("outputs") for cell in json.loads(path.read_text())["cells"])


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ('<script src="https://cdn.example.org/a.js"></script>', "fetches"),
        ('<link rel="stylesheet" href="//cdn.example.org/a.css">', "fetches"),
        ("<style>@import 'https://fonts.example.org/a.css';</style>", "style"),
        ("<style>p { background: url(https://example.org/a.png) }</style>", "style"),
        ("<script>require(['https://cdn.example.org/a.js'])</script>", "script"),
        ('<a href="nowhere.html">x</a>', "does not exist"),
        ('<a href="#nowhere">x</a>', "anchor"),
    ],
)
def test_the_check_finds_what_is_wrong_with_a_page(tmp_path, text, problem):
    (tmp_path / "index.html").write_text(f"<html><body>{text}</body></html>")
    [found] = book.problems(tmp_path)
    assert problem in found


def test_a_link_for_the_reader_may_lead_to_the_network(tmp_path):
    (tmp_path / "index.html").write_text(
        '<a href="https://example.org">x</a> <a href="#there">y</a> <p id="there">z</p>'
    )
    assert list(book.problems(tmp_path)) == []


def test_a_page_that_links_to_nowhere_is_named_before_anything_is_built(tmp_path):
    with pytest.raises(book.BookError, match=r"README.md: links to no-such-file.py, which does not exist"):
        book.relinked("[x](no-such-file.py)", ROOT / "README.md", tmp_path)


def test_the_index_lists_each_module_in_the_chapter_of_its_package():
    chapters = dict(re.findall(r"^## (.+?)\n(.+?)(?=^## |\Z)", book.module_index(ROOT / "fiplib"), re.M | re.S))
    assert "fiplib.mpc" in chapters["The core"].splitlines()
    assert {"fiplib.bags", "fiplib.bags.reader"} <= set(chapters["Bags"].splitlines())
    assert "fiplib.flight.links.ros2" in chapters["Flight"].splitlines()
    listed = re.findall(r"^fiplib\.\S+$", "\n".join(chapters.values()), re.M)
    modules = {book.module_name(path) for path in ROOT.glob("fiplib/**/*.py")} - {"fiplib"}
    assert sorted(listed) == sorted(modules)
    assert "ROS 2 bags" in chapters["Bags"].partition("```")[0]
