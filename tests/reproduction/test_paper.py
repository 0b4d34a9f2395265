"""The report holds no number of its own: all are macros, figures and tables that the package makes. Needs no LaTeX,
but for the last test, which typesets it where there is one."""

import os
import re
import shutil
import subprocess
from collections.abc import Collection
from pathlib import Path

import pytest

from fiplib import products, replay, studies
from fiplib.params import Params
from fiplib.reproduction import ledger, quantities

ROOT = Path(__file__).parents[2]
PAPER = ROOT / "paper"
GENERATED = {"generated/numbers", "generated/claims-table"}

LATEX_OWN = {"IfFileExists"}
"""Macros of LaTeX with a capital letter in the body; all others are ours, and generated."""

ALLOWED = (
    (r"\\(?:cite[pt]?|ref|eqref|label|input|includegraphics|texttt)\s*(?:\[[^\]]*\])?\{[^}]*\}", "names and places"),
    (r"\\resizebox\{[^}]*\}\{[^}]*\}", "sizes on the page"),
    (r"\\begin\{tabular\}(?:\[\w\])?\{[^}]*\}", "columns on the page"),
    (r"\\(?:vspace|hspace)\*?\{[^}]*\}", "distances on the page"),
    (r"\bROS~2\b", "the product's name"),
    (r"\b[DCGMRV]\d(?:--[DCGMRV]\d)?\b", "rows of the ledger"),
)
"""What may hold digits in the body, and why."""

MATHS = r"\$[^$]*\$|\\begin\{(equation|align|aligned|gather)\*?\}.*?\\end\{\1\*?\}"
STRUCTURE = r"(?<![\d.,])\d(?![\d.,]*\d)"
"""A lone digit inside a formula is its structure (an index, an exponent, the 2 of l/2), never a measured number."""


def stripped(tex: str) -> str:
    """Without comments."""
    return re.sub(r"(?<!\\)%.*", "", tex)


def body(tex: str) -> str:
    """What stands between begin and end of the document, without comments."""
    return stripped(tex).partition(r"\begin{document}")[2].partition(r"\end{document}")[0]


def typed_numbers(tex: str) -> list[str]:
    """Numbers typed by hand into the body, each with some text around it."""
    text = body(tex)
    for pattern, _ in ALLOWED:
        text = re.sub(pattern, " ", text)
    text = re.sub(MATHS, lambda found: re.sub(STRUCTURE, " ", found[0]), text, flags=re.DOTALL)
    return [text[max(0, found.start() - 20) : found.end() + 20] for found in re.finditer(r"\d+(?:[.,]\d+)*", text)]


def undefined_macros(tex: str, defined: Collection[str]) -> set[str]:
    """Macros of the body that are written like ours and are not generated, and what siunitx is given instead of one."""
    text = body(tex)
    own = {name for name in re.findall(r"\\([A-Za-z]+)", text) if name != name.lower()} - LATEX_OWN
    capital_greek = {"Gamma", "Delta", "Theta", "Lambda", "Xi", "Pi", "Sigma", "Phi", "Psi", "Omega"}
    missing = own - capital_greek - set(defined)
    given = re.findall(r"\\(?:num|qty|SI|numlist|qtylist)\s*(?:\[[^\]]*\])?\{([^}]*)\}", text)
    given += [part for pair in re.findall(r"\\(?:qty|num)range\{([^}]*)\}\{([^}]*)\}", text) for part in pair]
    numbers = [number.strip() for group in given for number in group.split(";")]
    return missing | {number for number in numbers if number.removeprefix("\\") not in defined}


def citations(tex: str) -> set[str]:
    keys = re.findall(r"\\cite[a-z]*\*?\s*(?:\[[^\]]*\]){0,2}\{([^}]*)\}", body(tex))
    return {key.strip() for group in keys for key in group.split(",")}


def bibliography(bib: str) -> set[str]:
    return set(re.findall(r"^@\w+\{([^,\s]+),", bib, flags=re.MULTILINE))


def included(tex: str) -> tuple[set[str], set[str]]:
    """Names of the figures (without folder and suffix) and of the files that are input (without suffix)."""
    text = stripped(tex)
    shown = {Path(name).stem for name in re.findall(r"\\includegraphics\s*(?:\[[^\]]*\])?\{([^}]*)\}", text)}
    return shown, {name.removesuffix(".tex") for name in re.findall(r"\\input\{([^}]*)\}", text)}


def missing_files(tex: str) -> set[str]:
    """What is included and made by nothing."""
    shown, read = included(tex)
    made = {f"../figures/{name}" for name in products.PRODUCTS} | GENERATED
    return (shown - set(products.PRODUCTS)) | (read - made)


def unlabelled(tex: str) -> set[str]:
    text = stripped(tex)
    return set(re.findall(r"\\(?:eq)?ref\{([^}]*)\}", text)) ^ set(re.findall(r"\\label\{([^}]*)\}", text))


@pytest.fixture(scope="module")
def report() -> str:
    """The report with its sections in place."""
    main = (PAPER / "main.tex").read_text(encoding="utf-8")
    return re.sub(
        r"\\input\{(sections/\w+)\}", lambda found: (PAPER / f"{found[1]}.tex").read_text(encoding="utf-8"), main
    )


@pytest.fixture(scope="module")
def judged_rows() -> list[ledger.Row]:
    """The ledger with a single window each refitted: the names of the macros are the same."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(replay, "STRIDE", 1000)
        quantities.search_gaps.cache_clear()
        return ledger.evaluate(ROOT / "data")


@pytest.fixture(scope="module")
def facts() -> dict[tuple[str, ...], str]:
    return studies.facts(ROOT / "data")


# --- the report


def test_no_number_in_the_report_is_typed_by_hand(report):
    assert typed_numbers(report) == []


def test_every_macro_of_the_report_is_generated(report, judged_rows, facts):
    assert undefined_macros(report, ledger.macros(judged_rows, Params(), facts)) == set()


def test_every_citation_has_its_entry_and_every_entry_is_cited(report):
    assert citations(report) == bibliography((PAPER / "references.bib").read_text(encoding="utf-8"))


def test_every_figure_and_table_of_the_report_is_one_that_the_package_makes(report):
    assert missing_files(report) == set()
    shown, read = included(report)
    # the flights that the paper shows, and the ledger
    assert {"fig1-flight", "fig3-pushes", "fig4-circle", "fig5-estimation", "fig6-convergence"} <= shown
    assert {*GENERATED, "../figures/table3-convergence"} <= read


def test_every_label_is_referred_to_and_every_reference_has_its_label(report):
    assert unlabelled(report) == set()


def test_the_report_says_that_it_is_simulated_where_numbers_are_shown(report):
    assert "simulated" in report.partition(r"\begin{abstract}")[2].partition(r"\end{abstract}")[0]
    captions = re.findall(r"\\caption\{((?:[^{}]|\{[^{}]*\})*)\}", report)
    silent = [caption for caption in captions if "imulated" not in caption]
    # the two tables of parameters come from no flight
    assert silent == ["The vehicle and its rod.", "Parameters of the software."]


# --- the checks themselves


def document(text: str) -> str:
    return "\\documentclass[12pt]{article}\n\\begin{document}\n" + text + "\n\\end{document}\n"


@pytest.mark.parametrize(
    "text",
    [
        "a settling time of 1.82 s",
        "three pushes and 2 circles",
        r"\num{3}",
        r"\qty{0.8}{\metre}",
        "$l = 1.4$",
        r"$\lambda = 0.75$",
        "$N = 60$",
        r"\begin{equation} t_f = 6.0 \end{equation}",
        r"\caption{A circle of 0.8 m.}",
        "in 2011",
        r"100\% of them",
        "ROS 2 and ROS~3",
    ],
)
def test_a_typed_number_is_found(text):
    assert typed_numbers(document(text))


@pytest.mark.parametrize(
    "text",
    [
        r"\qty{\OursDOne}{\metre}",
        r"$\frac{1}{2} x_0^2 + l/2$ and $\bm e_3$",
        r"\begin{equation} \ddot a = 2 g a / l \label{eq:model1} \end{equation}",
        r"\citep{hehn2011} in ROS~2, row D1, rows G1--G3, \includegraphics[width=0.9\columnwidth]{fig3-pushes.pdf}",
        "nothing % but 17.3 in a comment",
    ],
)
def test_structure_names_and_macros_are_no_typed_numbers(text):
    assert typed_numbers(document(text)) == []


@pytest.mark.parametrize(
    ("text", "missing"),
    [
        (r"\qty{\OursDTwo}{\metre}", {"OursDTwo"}),
        (r"row \VerdictDTen{}", {"VerdictDTen"}),
        (r"\num{3}", {"3"}),
        (r"\qtylist{\OursDOne;\OursDTwo}{\metre}", {"OursDTwo"}),
        (r"\qtyrange{\OursDOne}{7}{\metre}", {"7"}),
        (r"\qty[per-mode=symbol]{\oursDOne}{\metre}", {"oursDOne"}),
        (r"\qty{\OursDOne}{\metre}, $\Delta t$", set()),
    ],
)
def test_an_undefined_macro_is_found(text, missing):
    found = undefined_macros(document(text), {"OursDOne"})
    assert {name.removeprefix("\\") for name in found} == missing


def test_a_missing_citation_figure_input_or_label_is_found():
    tex = document(
        r"\citep[see][]{hehn, nobody} \includegraphics{fig9-dream.pdf} \input{../figures/table9} \ref{fig:no}"
    )
    assert citations(tex) == {"hehn", "nobody"}
    assert bibliography("@article{hehn,\n  year = {2011},\n}\n@misc{paul,\n}") == {"hehn", "paul"}
    assert missing_files(tex) == {"fig9-dream", "../figures/table9"}
    assert unlabelled(tex) == {"fig:no"}


# --- the page


@pytest.mark.skipif(shutil.which("latexmk") is None, reason="the report needs LaTeX with latexmk; see make latex")
def test_the_report_is_typeset_twice_to_the_same_bytes_without_a_missing_piece(report, judged_rows, facts, tmp_path):
    classes = subprocess.run(["kpsewhich", "elsarticle.cls", "siunitx.sty"], capture_output=True, text=True)
    if len(classes.stdout.split()) < 2:
        pytest.skip("LaTeX is here but not elsarticle and siunitx; see make latex")
    shown, read = included(report)
    for name in shown | {Path(path).name for path in read if path.startswith("../figures/")}:
        products.write(name, products.make(name, ROOT / "data"), tmp_path / "figures")
    paper = tmp_path / "paper"
    shutil.copytree(PAPER, paper, ignore=shutil.ignore_patterns("build", "generated"))
    ledger.write(judged_rows, tmp_path / "figures", paper / "generated", facts)
    pages = []
    for folder in ("first", "second"):
        # as the Makefile does, but with the environment spelled out
        run = subprocess.run(
            ["latexmk", "-pdf", "-interaction=nonstopmode", "-halt-on-error", f"-outdir={folder}", "main.tex"],
            cwd=paper,
            env={**os.environ, "SOURCE_DATE_EPOCH": "1767225600", "FORCE_SOURCE_DATE": "1"},
            capture_output=True,
            text=True,
            errors="replace",
        )
        assert run.returncode == 0, run.stdout[-3000:]
        log = (paper / folder / "main.log").read_text(errors="replace")
        assert not re.search(r"LaTeX Warning: .*undefined|Citation .* undefined", log)
        pages.append((paper / folder / "main.pdf").read_bytes())
    assert len(pages[0]) > 50_000  # five figures and their fonts
    assert pages[0] == pages[1]
