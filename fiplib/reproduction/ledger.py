"""The ledger as files: every claim judged on our flights, as table, text, LaTeX and macros of the report."""

import argparse
import math
import re
import sys
import textwrap
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from itertools import zip_longest
from pathlib import Path
from typing import NamedTuple

from fiplib.params import Params
from fiplib.recording import BagError, Flight
from fiplib.reproduction.claims import BY_ID, CLAIMS, Claim, Verdict
from fiplib.reproduction.sources import Quantities, Rows, csv_text
from fiplib.reproduction.tables import NONE, Facts, Table


class Row(NamedTuple):
    """A row of the ledger as text; ``facts`` are numbers that only the report prints."""

    id: str
    claim: str
    paper: str
    ours: str
    unit: str
    reading: str
    verdict: str
    bag: str
    facts: Mapping[str, str]


def evaluate(
    data: Path = Path("data"),
    check: Callable[[str, Rows], object] = lambda *_: None,
    failures: list[str] | None = None,
) -> list[Row]:
    """Judge every claim on its sources in ``data`` and ``benchmarks/`` beside it.

    Args:
        data: the folder of the bags.
        check: as for ``Sources.read``.
        failures: gets a sentence for each bag that claims cannot be judged from, whose rows stay open then; None: the
            first of these is raised.

    Raises:
        BagError, JournalError: a bag is missing, damaged or lacks something; a table is damaged.
    """

    @cache
    def sources(claim: Claim) -> list[Flight | Rows | Quantities]:
        return claim.read(data, check)

    rows, first = [], {tuple(claim.names): claim for claim in CLAIMS}
    for claim in CLAIMS:
        try:
            rows.append(judged(claim, sources(first[tuple(claim.names)])))
        except BagError as error:
            if failures is None:
                raise
            failures += [] if str(error) in failures else [str(error)]
            paper = "" if claim.paper is None else f"{claim.paper:.{claim.decimals}f}"
            about = claim.unit, f"Cannot be judged: {error}", str(Verdict.OPEN), ", ".join(claim.names)
            rows.append(Row(claim.id, claim.text, paper, "", *about, {}))
    return rows


def judged(claim: Claim, sources: Sequence[Flight | Rows | Quantities]) -> Row:
    """The row of one claim, from what it is read from. Raises BagError if a flight lacks what the claim needs."""
    found = claim.judge(claim.paper, *sources)
    paper, ours = (
        "" if value is None or math.isnan(value) else f"{value:.{claim.decimals}f}"
        for value in (claim.paper, found.value)
    )
    studied = {"simulated" for source in sources if isinstance(source, list)}
    origins = sorted(studied | {source.metadata["origin"] for source in sources if isinstance(source, Flight)})
    bag = ", ".join(claim.names) + (f" ({' and '.join(origins)})" if origins else "")
    facts = {name: f"{value:.3g}" for name, value in found.facts.items()}
    return Row(claim.id, claim.text, paper, ours, claim.unit, found.reading, str(found.verdict), bag, facts)


def as_csv(rows: Sequence[Row]) -> str:
    """The ledger with the columns id, claim, paper, ours, unit, reading, verdict, bag, command."""
    return csv_text([(*Row._fields[:-1], "command"), *((*row[:-1], BY_ID[row.id].command) for row in rows)])


WIDTHS = {"id": 10, "claim": 28, "paper": 6, "ours": 6, "unit": 6, "verdict": 18, "reading": 62}
"""Columns of the ledger in a terminal: 148 characters with two between them."""


def as_text(rows: Sequence[Row]) -> str:
    """The ledger to read in a terminal, long texts wrapped."""

    def lines(cells: Sequence[str]) -> list[str]:
        wrapped = [textwrap.wrap(cell, width) for cell, width in zip(cells, WIDTHS.values(), strict=True)]
        return [
            "  ".join(
                part.rjust(width) if name in ("paper", "ours") else part.ljust(width)
                for part, (name, width) in zip(parts, WIDTHS.items(), strict=True)
            ).rstrip()
            for parts in zip_longest(*wrapped, fillvalue="")
        ]

    counts = ", ".join(f"{count} {name}" for name, count in counted(rows).items())
    text = [f"What the paper claims and what we get, {len(rows)} rows:", f"{counts}.", "", *lines(list(WIDTHS))]
    text.append("-" * len("  ".join("-" * width for width in WIDTHS.values())))
    for row in rows:
        reading = f"{row.reading}." + (f" [{row.bag}]" if row.bag else "")
        text += [*lines([*(getattr(row, name) for name in list(WIDTHS)[:-1]), reading]), ""]
    return "\n".join(text)


def as_latex(rows: Sequence[Row]) -> str:
    """The ledger as a booktabs tabular of the page's width; the reasons stay in the CSV."""
    lines = []
    for row in rows:
        symbols = re.sub(r"\b([abxyl])(0?)\b", lambda found: f"${found[1]}{'_0' if found[2] else ''}$", row.claim)
        numbers = (number.replace("-", "$-$") or NONE for number in (row.paper, row.ours))
        lines.append((row.id, symbols, *numbers, "" if row.unit == "1" else row.unit, row.verdict))
    header = ("Row", "Claim of the paper", "Paper", "Ours", "Unit", "Verdict")
    return Table(header, lines, "@{}llrrll@{}").latex()


def counted(rows: Sequence[Row]) -> dict[str, int]:
    """How many rows have each of the verdicts."""
    count = Counter(row.verdict for row in rows)
    return {str(kind): count[kind] for kind in Verdict}


def macros(rows: Sequence[Row], params: Params, facts: Facts) -> dict[str, str]:
    """Every number of the report by name: Paper, Ours, Verdict + row; Fact + row + name; Count + name of a verdict;
    Param + group + field for each finite scalar parameter, with a few derived ones; Study + names of ``facts``."""
    values = {
        (group, name): value
        for group, fields in params.to_dict(complete=True).items()
        for name, value in fields.items()
        if type(value) in (int, float)
    }
    values["pendulum", "inertia_factor"] = params.pendulum.inertia_factor
    values["control", "step"] = params.control.step
    values["vehicle", "max_body_rate_degrees"] = math.degrees(params.vehicle.max_body_rate)
    for name in ("mocap_latency", "rate_delay", "rate_lag"):
        values["simulation", f"{name}_ms"] = round(1e3 * getattr(params.simulation, name), 2)
    named = {macro("Param", *words): f"{value:.4g}" for words, value in values.items()}
    for row in rows:
        named |= {macro(kind, row.id): getattr(row, kind.lower()) for kind in ("Paper", "Ours", "Verdict")}
        named |= {macro("Fact", row.id, name): text for name, text in row.facts.items()}
    named |= {macro("Count", kind): str(count) for kind, count in {"rows": len(rows), **counted(rows)}.items()}
    named |= {macro("Study", *words): text for words, text in facts.items()}
    return {name: text for name, text in named.items() if text}


def macro(*words: str) -> str:
    """A name of letters only, as LaTeX wants it: ("Ours", "G1.time") -> OursGOneTime."""
    digits = "Zero One Two Three Four Five Six Seven Eight Nine".split()
    parts = re.findall(r"[A-Za-z]+|\d", " ".join(words))
    return "".join(digits[int(part)] if part.isdigit() else part[0].upper() + part[1:] for part in parts)


def write(rows: Sequence[Row], figures: Path, generated: Path, facts: Facts | None = None) -> list[Path]:
    """Write claims.csv and claims.txt into ``figures``, numbers.tex and claims-table.tex into ``generated``."""
    numbers = [f"\\newcommand{{\\{name}}}{{{text}}}\n" for name, text in macros(rows, Params(), facts or {}).items()]
    contents = {
        figures / "claims.csv": as_csv(rows),
        figures / "claims.txt": as_text(rows),
        generated / "numbers.tex": "".join(numbers),
        generated / "claims-table.tex": as_latex(rows),
    }
    for path, text in contents.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8", newline="\n")
    return list(contents)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``fip claims``."""
    parser.add_argument("--data", type=Path, default=Path("data"), help="folder of the bags (default: data)")


def run(options: argparse.Namespace) -> int:
    """Judge every claim and print the ledger; return the exit status: 1 if claims could not be judged.

    Raises BagError, JournalError: there is no such folder; a table is damaged.
    """
    if not options.data.is_dir():
        raise BagError(f"{options.data}: no such folder; name that of the bags with --data")
    failures: list[str] = []
    print(as_text(evaluate(options.data, failures=failures)))
    for sentence in failures:
        print(f"fip: claims cannot be judged: {sentence}", file=sys.stderr)
    return int(bool(failures))
