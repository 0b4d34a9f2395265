"""Sphinx settings of the book. ``make book`` builds it; docs/book.py assembles the sources that Sphinx reads.

The pages must work from a folder on disk without network: formulas, fonts and scripts are local, and what a notebook's
output would fetch is taken out.
"""

import dataclasses
import hashlib
import os
import re
from pathlib import Path

import numpy.typing
from docutils import nodes
from sphinx import addnodes

import fiplib

ROOT = Path(__file__).parents[1]

# Signatures name these two as the source does; what NumPy makes of them fills a screen.
for name in ("ArrayLike", "NDArray"):
    members = {"__module__": "numpy.typing", "__class_getitem__": classmethod(lambda cls, item: cls)}
    setattr(numpy.typing, name, type(name, (), members))

project, author, copyright = "fip", "the fip authors", "the fip authors; text CC BY 4.0, code MIT"
release = fiplib.__version__
html_title = "fip"
html_theme = "sphinx_book_theme"
html_static_path = [str(Path(__file__).parent / "static")]
html_css_files = ["book.css"]
REPOSITORY = os.environ.get("FIP_REPOSITORY", "")
"""Where the repository is published, as https://github.com/owner/name: pages then have buttons for Binder and Colab."""

html_theme_options = {
    "show_toc_level": 2,
    "home_page_in_toc": True,
    "use_download_button": False,
    "use_fullscreen_button": False,
    "show_navbar_depth": 1,
    "navbar_persistent": [],
    **(
        {
            "repository_url": REPOSITORY,
            "repository_branch": "main",
            "path_to_docs": ".",
            "launch_buttons": {
                "binderhub_url": "https://mybinder.org",
                "colab_url": "https://colab.research.google.com",
            },
        }
        if REPOSITORY
        else {}
    ),
}
html_sidebars = {"**": ["navbar-logo.html", "search-field.html", "sbt-sidebar-nav.html"]}
html_copy_source = False
html_show_sourcelink = False

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx-mathjax-offline",
]
nitpicky = True  # a reference to a module, class or function of ours that does not exist is an error
nitpick_ignore_regex = [(r"py:.*", r"(?!fiplib\b).*")]  # other libraries are not linked: that needs the network

# --- notebooks. The cache knows a notebook's cells but not the code and the data behind them: both name its folder.
myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence", "deflist"]
myst_heading_anchors = 3
nb_execution_mode = "cache"
nb_execution_timeout = 1800  # seconds for one cell: a figure over hundreds of flights takes minutes on a small machine
nb_execution_raise_on_error = False  # it is a warning, and warnings are errors: every failing notebook is named
nb_execution_show_tb = True
nb_output_stderr = "remove"  # progress bars
nb_merge_streams = True
nb_render_markdown_format = "myst"  # tables and formulas that a cell displays
nb_ipywidgets_js = {}  # widgets need a kernel; the page says so instead


def _fingerprint() -> str:
    """What the notebooks' outputs depend on besides their cells: library, recorded data, packages, fast switch."""
    state = hashlib.sha256(os.environ.get("FIP_FAST", "").encode())
    read = [*ROOT.glob("fiplib/**/*.py"), *ROOT.glob("data/sweeps/*.csv"), ROOT / "data/SHA256SUMS"]
    for path in sorted([*read, ROOT / "requirements.lock"]):
        state.update(path.read_bytes())
    return state.hexdigest()[:16]


nb_execution_cache_path = str(ROOT / "docs/build/cache" / _fingerprint())

# --- modules
autodoc_default_options = {"members": True, "ignore-module-all": True, "member-order": "bysource"}
autodoc_typehints_format = "short"
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88
napoleon_use_rtype = False
add_module_names = False
viewcode_line_numbers = True

MARKUP = re.compile(r"(``.+?``|(?<!\S)\*[A-Za-z][^*]*\w[.,;:]?\*(?!\w))|([|*]|(?<=\w)_(?=\W|$))")
"""Literals and emphasis, which stay, and other characters that reStructuredText would take for markup."""


def literal(text: str) -> str:
    """Plain text as reStructuredText: |x| is a magnitude there, not a substitution."""
    return MARKUP.sub(lambda found: found[1] or "\\" + found[2], text)


def escape_plain_text(app, what, name, thing, options, lines) -> None:
    """Docstrings are plain text with double backticks."""
    # The empty line keeps napoleon from reading "RK4: its step" as a type and what is of it.
    lines[:] = [*([""] if what in ("data", "attribute") else []), *map(literal, lines)]


def list_quantities(app, what, name, thing, options, lines) -> None:
    """A parameter group shows each field's default, unit and source, which its docstring need not repeat."""
    if what == "class" and dataclasses.is_dataclass(thing):
        for entry in dataclasses.fields(thing):
            if "source" in entry.metadata:
                value = f"{entry.default:.6g}" if isinstance(entry.default, float) else entry.default
                unit = "" if entry.metadata["unit"] in ("1", "-") else f" {entry.metadata['unit']}"
                lines += ["", f"``{entry.name} = {value}{unit}``", "    " + literal(entry.metadata["source"])]


def skip_fields_without_text(app, what, name, thing, skip, options) -> bool | None:
    """Fields of a named tuple carry a made-up docstring, which tells nothing."""
    return True if (getattr(thing, "__doc__", None) or "").startswith("Alias for field number") else None


NEEDS_KERNEL = "Here are controls when the notebook runs in JupyterLab:", "make lab"
LIVE_VIEW = re.compile(r"<iframe\s[^>]*src=[\"']http://127\.0\.0\.1")
STYLESHEET = re.compile(r"<link[^>]+href=[\"']https?:[^>]+>")


LONGEST_VALUE = 60
"""Characters of a constant's value that its entry shows; the source is a click away."""


def hide_long_values(app, doctree) -> None:
    """Tables and texts that are constants of a module do not fill its page."""
    for node in list(doctree.findall(addnodes.desc_annotation)):
        if len(text := node.astext()) > LONGEST_VALUE and text.lstrip().startswith("="):
            node.parent.remove(node)


def make_outputs_local(app, doctree) -> None:
    """Outputs of notebooks: a sentence in place of widgets and live views, and no style sheet from the network."""
    for raw in list(doctree.findall(nodes.raw)):
        if "vnd.jupyter.widget-view" in raw.astext() or LIVE_VIEW.search(raw.astext()):
            text, command = NEEDS_KERNEL
            sentence = nodes.paragraph("", "", nodes.Text(f"{text} "), nodes.literal("", command))
            raw.replace_self(nodes.note("", sentence))
        elif STYLESHEET.search(raw.astext()):
            text = STYLESHEET.sub("", raw.astext())
            raw.replace_self(nodes.raw(text, text, format=raw["format"]))


def keep_equation_numbers(app, doctree) -> None:
    r"""A formula with a number of its own goes to the page as it is: Sphinx would put one with line breaks, be they
    those of a matrix, into ``split``, where ``\tag`` is an error."""
    for node in list(doctree.findall(nodes.math_block)):
        if r"\tag" in node.astext() and not node.get("nowrap"):
            node.replace_self(nodes.math_block("", rf"\[{node.astext()}\]", **node.attributes | {"nowrap": True}))


def drop_modules_without_source(app, env) -> None:
    """The list of source pages names only modules that have one."""
    pages = getattr(env, "_viewcode_modules", {})
    for name in [name for name, page in pages.items() if not page]:
        del pages[name]


def setup(app) -> None:
    app.connect("autodoc-process-docstring", escape_plain_text, priority=400)  # before napoleon writes its own markup
    app.connect("autodoc-process-docstring", list_quantities, priority=600)
    app.connect("autodoc-skip-member", skip_fields_without_text)
    app.connect("doctree-read", hide_long_values)
    app.connect("doctree-read", make_outputs_local)
    app.connect("doctree-read", keep_equation_numbers)
    app.connect("env-updated", drop_modules_without_source)
