"""Build the book: assemble its sources, run Sphinx, check every link and that no page needs the network.

``python docs/book.py`` writes docs/build/html. Nothing outside docs/build is written, so notebooks/ stays clean.
"""

import argparse
import ast
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
LIBRARY = ROOT / "fiplib"
BUILD = DOCS / "build"

RECORDED = Path("data/estimate-1.4")
"""The flight that plays in docs/recorded-flight.md."""

LINK = re.compile(r"(\]\()(?!\w+:|#)([^)#\s]+)(#[^)\s]*)?(\))")
"""A relative link in Markdown: its path and its anchor."""


class BookError(Exception):
    """The book cannot be built, or is not whole; a line for each reason."""


# --- sources --------------------------------------------------------------------------------------------------------


def assemble(folder: Path) -> None:
    """Write the tree that Sphinx reads: pages, notebooks, one page per module, and whatever file they link to.

    Raises:
        BookError: a page or notebook links to what does not exist.
    """
    shutil.rmtree(folder, ignore_errors=True)
    for path in [*DOCS.glob("*.md"), ROOT / "README.md", *sorted(ROOT.glob("notebooks/*.ipynb"))]:
        add(path, folder)
    for name in (module_name(path) for path in ROOT.glob("fiplib/**/*.py") if path != LIBRARY / "__init__.py"):
        write(folder / "api" / f"{name}.md", f"# {name}\n\n```{{eval-rst}}\n.. automodule:: {name}\n```\n")
    write(folder / "api/index.md", module_index(LIBRARY))


def module_name(path: Path) -> str:
    """The dotted name of a module of the library."""
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def add(path: Path, folder: Path) -> None:
    """Put a page or notebook into the tree, with links to pages of the book, and the files that it links to."""
    place = folder / path.relative_to(DOCS if DOCS in path.parents else ROOT)
    if place == folder / "README.md":
        place = folder / "repository.md"
    if place.exists():
        return
    if path.suffix == ".ipynb":
        notebook = json.loads(path.read_text(encoding="utf-8"))
        for cell in notebook["cells"]:
            if cell["cell_type"] == "markdown":
                cell["source"] = relinked("".join(cell["source"]), path, folder)
        write(place, json.dumps(notebook))
    elif path.suffix == ".md":
        text = relinked(path.read_text(encoding="utf-8"), path, folder)
        write(place, re.sub("^# .*", "# The repository", text, count=1) if place.stem == "repository" else text)
    else:
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, place)


def relinked(text: str, source: Path, folder: Path) -> str:
    """Markdown whose relative links lead to pages of the book: a module's to its page, any other file's to a copy."""

    def lead(found: re.Match) -> str:
        target = (source.parent / found[2]).resolve()
        if source.parent == DOCS and not target.exists():
            return found[0]  # between pages of the book, which Sphinx checks
        if target == ROOT / "fiplib":
            target /= "__init__.py"
        elif target.is_dir():  # one without a page of its own is described by that of the folder above
            pages = [place / "README.md" for place in (target, target.parent)]
            target = next((page for page in pages if page.is_file()), pages[0])
        if not target.is_file() or ROOT not in target.parents:
            raise BookError(f"{source.relative_to(ROOT)}: links to {found[2]}, which does not exist")
        inside = target.relative_to(ROOT)
        if inside.parts[0] == "fiplib" and inside.suffix == ".py":
            page = f"api/{'index' if inside == Path('fiplib/__init__.py') else module_name(target)}.md"
        else:
            page = "repository.md" if inside == Path("README.md") else inside.as_posix().removeprefix("docs/")
            if inside.suffix != ".ipynb" and target.parent != DOCS:
                add(target, folder)
        depth = len(source.relative_to(ROOT).parts) - 1 if source.parent != DOCS else 0
        return f"{found[1]}{'../' * depth}{page}{found[3] or ''}{found[4]}"

    return LINK.sub(lead, text)


def module_index(library: Path) -> str:
    """The list of modules: a chapter for the modules directly in the library and for each of its packages.

    The first paragraph of a package's docstring introduces its chapter.
    """
    packages = [library, *sorted(path.parent for path in library.glob("*/__init__.py"))]
    text = ["# The library\n", "Every public name with its shapes, units and errors, from the docstrings.\n"]
    for package in packages:
        title = "The core" if package == library else package.name.capitalize()
        modules = sorted(package.glob("*.py") if package == library else package.glob("**/*.py"))
        pages = [module_name(path) for path in modules if path != library / "__init__.py"]
        docstring = ast.get_docstring(ast.parse((package / "__init__.py").read_text(encoding="utf-8"))) or ""
        introduction = docstring.partition("\n\n")[0]
        text += [f"## {title}\n", f"{introduction}\n", "```{toctree}\n:maxdepth: 1\n", *pages, "```\n"]
    return "\n".join(text)


def write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


# --- build ----------------------------------------------------------------------------------------------------------


def build(source: Path, html: Path, execute: bool = True, builder: str = "html") -> None:
    """Run Sphinx, every warning an error. Raises BookError with what it printed on stderr."""
    shutil.rmtree(html, ignore_errors=True)
    options = ["-b", builder, *([] if execute else ["-D", "nb_execution_mode=off"])]
    doctrees = html.with_name(f"{html.name}-doctrees")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-E", "-c", str(DOCS), "-d", str(doctrees)]
    run = subprocess.run([*command, *options, str(source), str(html)], check=False)
    if run.returncode:
        raise BookError("Sphinx found the errors above")
    if builder == "html":
        page = ["-m", "fiplib", "view", str(ROOT / RECORDED), "--output", str(html / "_static/recorded-flight.html")]
        if subprocess.run([sys.executable, *page], check=False).returncode:
            raise BookError("the page of the recorded flight was not written, see above")


TO_MODULES = re.compile(r"\[([^\]]+)\]\((?:\.\./)*api/[^)]+\)|^api/index\n", re.MULTILINE)
"""In assembled Markdown, a link to a module's page, or the entry of all of them in the table of contents."""


def print_pdf(source: Path, pdf: Path, execute: bool = True) -> None:
    """Write the assembled book as one PDF, printed by Chromium; the modules' pages, for looking up, are left out.

    Raises:
        BookError: there is no Chromium, or what it or Sphinx printed on stderr.
    """
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if browser is None:
        raise BookError("the PDF is printed by Chromium, which is not installed (Debian: apt-get install chromium)")
    shutil.rmtree(source / "api", ignore_errors=True)
    for path in source.rglob("*.md"):
        path.write_text(TO_MODULES.sub(r"\1", path.read_text(encoding="utf-8")), encoding="utf-8")
    for path in source.rglob("*.ipynb"):
        notebook = json.loads(path.read_text(encoding="utf-8"))
        for cell in notebook["cells"]:
            if cell["cell_type"] == "markdown":
                cell["source"] = TO_MODULES.sub(r"\1", "".join(cell["source"]))
        path.write_text(json.dumps(notebook), encoding="utf-8")
    page = pdf.with_name(f"{pdf.stem}-page")
    build(source, page, execute, "singlehtml")
    root = ["--no-sandbox"] if os.name == "posix" and os.geteuid() == 0 else []
    options = ["--headless=new", "--disable-gpu", "--no-pdf-header-footer", "--virtual-time-budget=300000"]
    command = [browser, *root, *options, f"--print-to-pdf={pdf}", (page / "index.html").as_uri()]
    run = subprocess.run(command, check=False, capture_output=True, text=True)
    if run.returncode or not pdf.is_file():
        raise BookError(f"Chromium printed no PDF: {run.stderr.strip()}")


# --- check ----------------------------------------------------------------------------------------------------------

FETCHED = {"script": "src", "link": "href", "img": "src", "iframe": "src", "source": "src", "video": "src"}
"""Elements whose target a browser loads by itself, with the attribute that names it; links to click are no such."""

SPLIT_TAG = re.compile(r"\\begin\{split\}(?:(?!\\end\{split\}).)*\\tag", re.DOTALL)
"""A numbered formula that MathJax would show as an error box."""

SCRIPT_URL = re.compile(r"(?:import|require|fetch|src|href)\W{1,4}(https?://[^\s\"')]+)")
"""A script in a page that would load from the network: what widgets, plotting and animation libraries write."""

STYLE_URL = re.compile(r"(?:url\(|@import\s+)\s*[\"']?(https?:)?//", re.IGNORECASE)


class Page(HTMLParser):
    """Anchors and references of a page: ``fetched`` and, by scripts, ``loading`` come with it, ``links`` one clicks."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.anchors: set[str] = set()
        self.fetched: list[str] = []
        self.links: list[str] = []
        self.loading: list[str] = []
        self.script = False
        self.feed(text)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        named = {name: value or "" for name, value in attributes}
        self.script = tag == "script"
        self.anchors |= {named[name] for name in ("id", "name") if name in named}
        if tag == "a" and "href" in named:
            self.links.append(named["href"])
        about = tag == "link" and named.get("rel") in ("canonical", "author", "license")
        if not about and FETCHED.get(tag) in named:
            self.fetched.append(named[FETCHED[tag]])

    def handle_endtag(self, tag: str) -> None:
        self.script = False

    def handle_data(self, data: str) -> None:
        if self.script:
            self.loading += SCRIPT_URL.findall(data)


def problems(html: Path) -> Iterator[str]:
    """What is wrong with built pages: links to nowhere, and anything that a browser would fetch from the network."""
    files = [
        path for path in sorted(html.rglob("*.html")) if "_static" not in path.parts
    ]  # there: the theme's templates
    pages = {path: Page(path.read_text(encoding="utf-8")) for path in files}
    for path, page in pages.items():
        where = path.relative_to(html)
        for target in page.fetched + page.links:
            parts = urlsplit(target)
            if parts.scheme in ("http", "https") or parts.netloc:
                if target in page.fetched:
                    yield f"{where}: fetches {target}"
            elif not parts.scheme:
                file = (path.parent / unquote(parts.path)).resolve() if parts.path else path
                if not file.is_file():
                    yield f"{where}: links to {target}, which does not exist"
                elif file in pages and unquote(parts.fragment) not in pages[file].anchors | {""}:
                    yield f"{where}: links to {target}, an anchor that does not exist"
        if STYLE_URL.search(path.read_text(encoding="utf-8")):
            yield f"{where}: a style fetches from the network"
        if SPLIT_TAG.search(path.read_text(encoding="utf-8")):
            yield f"{where}: a formula with a number breaks into lines, which shows an error instead"
        if page.loading:
            yield f"{where}: a script loads {page.loading[0]}"
    for path in sorted(html.rglob("*.css")):
        if STYLE_URL.search(path.read_text(encoding="utf-8")):
            yield f"{path.relative_to(html)}: a style fetches from the network"


def main(arguments: list[str] | None = None) -> int:
    """Command line. Returns the exit code: 0, or 1 with a line for each problem on stderr."""
    parser = argparse.ArgumentParser(prog="python docs/book.py", description="Build the book and check it.")
    parser.add_argument("--output", type=Path, default=BUILD / "html", help="folder of the pages")
    parser.add_argument("--no-execution", action="store_true", help="show the notebooks' cells without their outputs")
    parser.add_argument("--pdf", action="store_true", help="print it as one PDF beside that folder instead")
    options = parser.parse_args(arguments)
    html = options.output.resolve()
    source = html.with_name(f"{html.name}-source")
    try:
        assemble(source)
        if options.pdf:
            print_pdf(source, pdf := html.with_name("fip.pdf"), execute=not options.no_execution)
            print(f"The book is in {pdf}")
            return 0
        build(source, html, execute=not options.no_execution)
        if found := list(problems(html)):
            raise BookError("\n".join(found))
    except BookError as error:
        print(error, file=sys.stderr)
        return 1
    print(f"The book is in {options.output}/index.html: open it in a browser, no server is needed")
    return 0


if __name__ == "__main__":
    sys.exit(main())
