"""Make the slides of the three lectures from the notebooks: docs/build/slides, one page each, without the network.

``python docs/slides.py`` runs the chosen notebooks with small settings. A slide is a piece of text with the results
below it; code is shown where it is short and not folded. The pager is a few lines of this file: reveal.js, which
``jupyter nbconvert --to slides`` would use, is fetched from outside. Formulas are drawn by the MathJax of the book.
"""

import argparse
import copy
import html
import os
import re
import shutil
from importlib.util import find_spec
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbconvert import HTMLExporter
from nbformat import NotebookNode
from traitlets.config import Config

ROOT = Path(__file__).resolve().parents[1]
SLIDES = ROOT / "docs/build/slides"

SHORT = 12
"""Lines of code up to which a slide shows it."""

LECTURES: dict[str, dict[str, tuple[str, ...]]] = {
    "1 The rod and its equations": {
        "00-start-here": ("Frames and symbols",),
        "01-lagrangian": (
            "The picture",
            "Energies",
            "One derivative by hand",
            "The short form, derived",
            "What the paper leaves out, first: the rod's inertia",
        ),
        "02-linearisation": (
            "The Jacobians at hover",
            "Two axes that do not know of each other",
            "How fast does the rod fall?",
            "A step that has to begin in the wrong direction",
        ),
    },
    "2 Control and estimation": {
        "03-mpc": ("The problem on paper", "The problem in code", "A push with active bounds", "LQR beside it"),
        "04-kalman-filter": (
            "Predict",
            "Update",
            "What a wrong length does to the innovations",
            "Which number? Innovation and posterior residual",
        ),
        "05-genetic-algorithm": ("The chromosome", "The landscape", "Selection: a roulette wheel", "A run"),
    },
    "3 The loop, closed": {
        "06-closed-loop": (
            "The loop, with its rates",
            "Three starts",
            "Why a wrong length hurts",
            "A hand-over with trust",
        ),
        "10-errata": ("5. The fitness is not an innovation", "11. A rod is not a point mass"),
        "11-two-points": ("1. Three lengths in one response", "3. The estimator finds all three"),
    },
}
"""Title of each lecture, and the sections of notebooks that it shows."""

STYLE = """
html { scroll-snap-type: y mandatory; }
body { margin: 0; font: 22px/1.45 sans-serif; color: #111; background: #fff; }
section { box-sizing: border-box; height: 100vh; overflow: auto; padding: 4vh 8vw; scroll-snap-align: start; }
section.title { display: flex; flex-direction: column; justify-content: center; }
h1, h2, h3 { line-height: 1.15; margin: 0 0 .5em; }
img { max-width: 100%; max-height: 62vh; }
pre { font-size: 16px; line-height: 1.3; margin: .4em 0; white-space: pre-wrap; }
table { border-collapse: collapse; font-size: 18px; } td, th { padding: .1em .6em; text-align: left; }
mjx-container { max-width: 100%; overflow-x: auto; overflow-y: hidden; }
@page { size: 30cm 20cm; margin: 0; }
@media print { section { height: auto; min-height: 95vh; page-break-after: always; } }
"""

PAGER = """
addEventListener("keydown", event => {
  const step = {ArrowRight: 1, ArrowDown: 1, PageDown: 1, " ": 1, ArrowLeft: -1, ArrowUp: -1, PageUp: -1}[event.key];
  if (!step) return;
  event.preventDefault();
  const slides = [...document.querySelectorAll("section")];
  const now = slides.findIndex(slide => slide.getBoundingClientRect().bottom > innerHeight / 2);
  slides[Math.min(Math.max(now + step, 0), slides.length - 1)].scrollIntoView();
});
"""

MATHJAX = 'MathJax = {tex: {inlineMath: [["$", "$"]], displayMath: [["$$", "$$"]]}};'


def pieces(notebook: NotebookNode) -> list[tuple[str, NotebookNode]]:
    """The cells of a notebook with the section each stands in; text is cut at headings."""
    found, section = [], ""
    for cell in notebook.cells:
        if cell.cell_type != "markdown":
            found.append((section, cell))
            continue
        for text in re.split(r"^(?=## )", cell.source, flags=re.MULTILINE):
            if heading := re.match(r"## (.+)", text):
                section = heading[1].strip()
            if text.strip():
                found.append((section, nbformat.v4.new_markdown_cell(unlinked(text.strip()))))
    return found


def unlinked(text: str) -> str:
    """Markdown without links to files: slides are shown apart from the repository."""
    return re.sub(r"\[([^\]]+)\]\((?!https?:)[^)]*\)", r"\1", text)


def slides(notebook: NotebookNode, sections: tuple[str, ...]) -> list[list[NotebookNode]]:
    """The slides of the chosen sections: each a text and the results that follow it.

    Raises:
        KeyError: the notebook has no such section.
    """
    of = pieces(notebook)
    if missing := [name for name in sections if name not in {section for section, _ in of}]:
        raise KeyError(f"no section {missing[0]!r}")
    made: list[list[NotebookNode]] = []
    for name in sections:
        for section, cell in of:
            if section != name:
                continue
            if cell.cell_type == "markdown" or not made:
                made.append([])
            made[-1].append(cell)
    return made


def executed(name: str) -> NotebookNode:
    """A notebook of the repository with its results, run with small settings; its file stays as it is."""
    path = ROOT / f"notebooks/{name}.ipynb"
    notebook = nbformat.read(path, as_version=4)
    NotebookClient(notebook, timeout=900, resources={"metadata": {"path": str(path.parent)}}).execute()
    return notebook


def page(title: str, made: list[list[NotebookNode]]) -> str:
    """The page of a lecture: its slides, the pager, and MathJax beside it."""
    config = Config({"TagRemovePreprocessor": {"enabled": True, "remove_input_tags": ("hide-input",)}})
    exporter = HTMLExporter(config=config, template_name="basic", embed_images=True)
    exporter.exclude_input_prompt = exporter.exclude_output_prompt = exporter.exclude_anchor_links = True
    bodies = [f'<section class="title"><h1>{html.escape(title)}</h1><p>Arrow keys turn the pages.</p></section>']
    for cells in made:
        cells = copy.deepcopy(cells)
        for cell in cells:
            if cell.cell_type == "code" and len(cell.source.splitlines()) > SHORT:
                cell.metadata.tags = ["hide-input"]
        body, _ = exporter.from_notebook_node(nbformat.v4.new_notebook(cells=cells))
        bodies.append(f'<section id="{len(bodies) + 1}">{body}</section>')
    return (
        f'<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f'<style>{STYLE}</style><script>{MATHJAX}</script><script async src="mathjax/tex-mml-chtml.js"></script>'
        f"</head><body>{''.join(bodies)}<script>{PAGER}</script></body></html>"
    )


def main(arguments: list[str] | None = None) -> None:
    """Write the slides of every lecture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--no-execute", action="store_true", help="leave the results out")
    chosen = parser.parse_args(arguments)
    os.environ.setdefault("FIP_FAST", "1")
    SLIDES.mkdir(parents=True, exist_ok=True)
    for title, notebooks in LECTURES.items():
        made = []
        for name, sections in notebooks.items():
            print(f"lecture {title}: {name}")
            plain = nbformat.read(ROOT / f"notebooks/{name}.ipynb", as_version=4)
            made += slides(plain if chosen.no_execute else executed(name), sections)
        path = SLIDES / f"lecture-{title[0]}.html"
        path.write_text(page(title, made), encoding="utf-8")
        print(f"{path.relative_to(ROOT)}: {len(made) + 1} slides")
    if not (SLIDES / "mathjax").exists():
        shutil.copytree(mathjax(), SLIDES / "mathjax")


def mathjax() -> Path:
    """The folder of MathJax that the book's extension brings along."""
    return Path(find_spec("sphinx-mathjax-offline").submodule_search_locations[0]) / "static/mathjax"


if __name__ == "__main__":
    main()
