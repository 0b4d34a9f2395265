"""The report holds no number of its own: all are macros, figures and tables that the package makes. Needs no LaTeX,
but for the last test, which typesets it where there is one."""

import os
import re
import shutil
import subprocess
from collections import Counter
from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple

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


class Entry(NamedTuple):
    """An entry of the bibliography: its kind, its key, and its fields by name."""

    kind: str
    key: str
    fields: dict[str, str]


REQUIRED = {
    "article": {"author", "title", "journal", "year"},
    "inproceedings": {"author", "title", "booktitle", "year"},
    "book": {"author", "title", "publisher", "year"},
    "misc": {"author", "title", "note"},
}
"""Fields that an entry must have, by its kind. Other kinds are not used."""

DOI = r"10\.\d{4,9}/[-._;()/:A-Za-z0-9]+"
"""A digital object identifier, as the registration agency recommends to recognise it; without resolver or spaces."""


def entries(bib: str) -> list[Entry]:
    """The entries of a bibliography, in its order, repeated ones included."""
    starts = list(re.finditer(r"^@(\w+)\{([^,\s]+),", bib, flags=re.MULTILINE))
    ends = [*(start.start() for start in starts[1:]), len(bib)]
    return [
        Entry(
            start[1],
            start[2],
            dict(
                re.findall(r"^\s*(\w+)\s*=\s*\{(.*?)\},?\s*$", bib[start.end() : end], flags=re.DOTALL | re.MULTILINE)
            ),
        )
        for start, end in zip(starts, ends, strict=True)
    ]


def bibliography(bib: str) -> set[str]:
    return {entry.key for entry in entries(bib)}


def malformed(bib: str) -> list[str]:
    """What is wrong with a bibliography: missing or empty fields, years and DOIs of another form, repetitions."""
    found = entries(bib)
    wrong = [f"{entry.key}: {entry.kind}" for entry in found if entry.kind not in REQUIRED]
    for entry in found:
        fields = entry.fields
        lacking = {name for name in REQUIRED.get(entry.kind, ()) if not fields.get(name, "").strip()}
        wrong += [f"{entry.key}: no {name}" for name in sorted(lacking)]
        patterns = {"year": r"(19|20)\d\d", "doi": DOI, "pages": r"\w+(--\w+)?", "volume": r"\d+", "number": r"\d+"}
        wrong += [
            f"{entry.key}: {name} {fields[name]}"
            for name, pattern in patterns.items()
            if name in fields and not re.fullmatch(pattern, fields[name])
        ]
    for what in (
        [entry.key for entry in found],
        [entry.fields["doi"].lower() for entry in found if "doi" in entry.fields],
        [re.sub(r"\W+", " ", entry.fields.get("title", entry.key)).lower() for entry in found],
    ):
        wrong += [f"twice: {one}" for one, count in Counter(what).items() if count > 1]
    return wrong


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


def test_the_bibliography_is_well_formed_and_at_least_25_works_have_a_doi():
    bib = (PAPER / "references.bib").read_text(encoding="utf-8")
    assert malformed(bib) == []
    assert sum("doi" in entry.fields for entry in entries(bib)) >= 25


def test_the_report_cites_every_work_that_the_paper_cites():
    of_the_paper = {
        *("jannohamed", "schwenzer", "mayne2011", "yu2024", "tamba", "oloo", "yang2024", "kang", "sferrazza"),
        *("barawkar", "lambora", "iglesias", "chen2019", "yang2014", "srivastava", "hehn"),
    }
    bib = (PAPER / "references.bib").read_text(encoding="utf-8")
    assert of_the_paper <= bibliography(bib)


def test_every_figure_and_table_of_the_report_is_one_that_the_package_makes(report):
    assert missing_files(report) == set()
    shown, read = included(report)
    # the paper's main result, what limits it, and the ledger
    assert {"fig6-convergence", "fig15-identifiability", "fig19-ablation", "fig20-choices", "fig21-field"} <= shown
    assert read >= GENERATED


def test_every_label_is_referred_to_and_every_reference_has_its_label(report):
    assert unlabelled(report) == set()


def test_the_report_says_that_it_is_simulated_where_numbers_are_shown(report):
    assert "simulated" in report.partition(r"\begin{abstract}")[2].partition(r"\end{abstract}")[0]
    captions = re.findall(r"\\caption\{((?:[^{}]|\{[^{}]*\})*)\}", report)
    assert len(captions) >= 8
    assert [caption for caption in captions if "imulated" not in caption] == []


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


GOOD = """@article{kalman,
  author  = {Kalman, Rudolf E.},
  title   = {A new approach to linear filtering
             and prediction problems},
  journal = {Journal of {Basic} Engineering},
  year    = {1960},
  pages   = {35--45},
  doi     = {10.1115/1.3662552},
}
"""


def test_entries_are_read_with_their_fields():
    [entry] = entries(GOOD)
    assert (entry.kind, entry.key) == ("article", "kalman")
    assert list(entry.fields) == ["author", "title", "journal", "year", "pages", "doi"]
    assert entry.fields["journal"] == "Journal of {Basic} Engineering"
    assert entry.fields["title"].split() == "A new approach to linear filtering and prediction problems".split()
    assert malformed(GOOD) == []


@pytest.mark.parametrize(
    ("old", "new", "wrong"),
    [
        ("  journal = {Journal of {Basic} Engineering},\n", "", "kalman: no journal"),
        ("Kalman, Rudolf E.", " ", "kalman: no author"),
        ("{10.1115/1.3662552}", "{https://doi.org/10.1115/1.3662552}", "kalman: doi https://doi.org/10.1115/1.3662552"),
        ("{10.1115/1.3662552}", "{10.1115}", "kalman: doi 10.1115"),
        ("{10.1115/1.3662552}", "{10.1115/1.36 62552}", "kalman: doi 10.1115/1.36 62552"),
        ("{1960}", "{60}", "kalman: year 60"),
        ("35--45", "35-45", "kalman: pages 35-45"),
        ("@article", "@paper", "kalman: paper"),
    ],
)
def test_an_entry_that_lacks_something_is_found(old, new, wrong):
    assert malformed(GOOD.replace(old, new)) == [wrong]


def test_an_entry_or_a_doi_that_comes_twice_is_found():
    assert "twice: kalman" in malformed(GOOD + GOOD)
    other = GOOD.replace("{kalman,", "{other,").replace("A new approach", "An approach")
    assert malformed(GOOD + other) == ["twice: 10.1115/1.3662552"]
    again = GOOD.replace("{kalman,", "{other,").replace("1.3662552", "1.3662553").replace("A new", "A {New}")
    assert malformed(GOOD + again) == ["twice: a new approach to linear filtering and prediction problems"]


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
    assert len(pages[0]) > 50_000  # the figures and their fonts
    [count] = re.findall(r"Output written on .*\((\d+) pages", log)
    assert 8 <= int(count) <= 10
    assert pages[0] == pages[1]
