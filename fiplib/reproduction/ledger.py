"""The ledger as files: every claim judged on our flights, as table, text, LaTeX and macros of the report.

``python -m fiplib.reproduction.ledger`` reads bags and tables and writes all of them.
"""

import argparse
import csv
import io
import math
import re
import sys
import textwrap
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from fiplib import bags
from fiplib.params import Params
from fiplib.recording import BagError, Flight
from fiplib.reproduction.claims import BY_ID, CLAIMS, Claim, Verdict
from fiplib.reproduction.rows import JournalError, Rows, quantities
from fiplib.reproduction.rows import read as read_rows
from fiplib.studies import journal, summaries


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


def evaluate(data: Path = Path("data"), benchmarks: Path = Path("benchmarks")) -> list[Row]:
    """Judge every claim on the bags in ``data`` and the tables in ``benchmarks``. Raises BagError and JournalError."""
    sources: dict[str, Flight | Mapping[str, float] | Rows] = {}
    for name in dict.fromkeys(name for claim in CLAIMS for name in claim.bags):
        if name.startswith("sweeps/"):
            sources[name] = read_rows(name.removeprefix("sweeps/"), data)
        else:
            sources[name] = quantities(benchmarks / name) if name.endswith(".csv") else bags.read(data / name)
    return [judged(claim, [sources[name] for name in claim.bags]) for claim in CLAIMS]


def judged(claim: Claim, sources: Sequence[Flight | Mapping[str, float] | Rows]) -> Row:
    """The row of one claim, from what it is read from."""
    found = claim.judge(claim.paper, *sources)
    paper, ours = (
        "" if value is None or math.isnan(value) else f"{value:.{claim.decimals}f}"
        for value in (claim.paper, found.value)
    )
    studied = {"simulated" for source in sources if isinstance(source, list)}
    origins = sorted(studied | {source.metadata["origin"] for source in sources if isinstance(source, Flight)})
    bag = ", ".join(claim.bags) + (f" ({' and '.join(origins)})" if origins else "")
    facts = {name: f"{value:.3g}" for name, value in found.facts.items()}
    return Row(claim.id, claim.text, paper, ours, claim.unit, found.reading, str(found.verdict), bag, facts)


def as_csv(rows: Sequence[Row]) -> str:
    """The ledger with the columns id, claim, paper, ours, unit, reading, verdict, bag, command."""
    text = io.StringIO()
    lines = [(*Row._fields[:-1], "command"), *((*row[:-1], command(BY_ID[row.id])) for row in rows)]
    csv.writer(text, lineterminator="\n").writerows(lines)
    return text.getvalue()


def command(claim: Claim) -> str:
    """What computes a claim's row from the beginning."""
    studies = [name.removeprefix("sweeps/") for name in claim.bags if name.startswith("sweeps/")]
    benchmarks = [name.removesuffix(".csv") for name in claim.bags if name.endswith(".csv")]
    flown = len(claim.bags) > len(studies) + len(benchmarks)
    return journal.command(bags=flown, studies=studies, benchmarks=benchmarks)


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
    lines = ["Row & Claim of the paper & Paper & Ours & Unit & Verdict"]
    for row in rows:
        symbols = re.sub(r"\b([abxyl])(0?)\b", lambda found: f"${found[1]}{'_0' if found[2] else ''}$", row.claim)
        numbers = (number.replace("-", "$-$") or "--" for number in (row.paper, row.ours))
        lines.append(" & ".join((row.id, symbols, *numbers, "" if row.unit == "1" else row.unit, row.verdict)))
    head, *body = (rf"{line} \\" for line in lines)
    top, bottom = r"\begin{tabular}{@{}llrrll@{}}" + "\n\\toprule", "\\bottomrule\n\\end{tabular}\n"
    return "\n".join([top, head, r"\midrule", *body, bottom])


def counted(rows: Sequence[Row]) -> dict[str, int]:
    """How many rows have each of the verdicts."""
    count = Counter(row.verdict for row in rows)
    return {str(kind): count[kind] for kind in Verdict}


def macros(rows: Sequence[Row], params: Params, facts: Mapping[tuple[str, ...], str]) -> dict[str, str]:
    """Every number of the report by name: Paper, Ours, Verdict + row; Fact + row + name; Count + name of a verdict;
    Param + group + field for each finite scalar parameter, with a few derived ones; Study + names of ``facts``."""
    values = {
        (group, name): value
        for group, fields in params.to_dict().items()
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


def write(
    rows: Sequence[Row], figures: Path, generated: Path, facts: Mapping[tuple[str, ...], str] = MappingProxyType({})
) -> list[Path]:
    """Write claims.csv and claims.txt into ``figures``, numbers.tex and claims-table.tex into ``generated``."""
    numbers = [f"\\newcommand{{\\{name}}}{{{text}}}\n" for name, text in macros(rows, Params(), facts).items()]
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


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line. Returns the exit code: 0, or 2 with one line on stderr."""
    parser = argparse.ArgumentParser(
        prog="python -m fiplib.reproduction.ledger", description="Hold our flights against the paper."
    )
    parser.add_argument("--data", type=Path, default=Path("data"), help="folder of the bags (default: data)")
    parser.add_argument("--benchmarks", type=Path, default=Path("benchmarks"), help="folder of their tables")
    parser.add_argument("--figures", type=Path, default=Path("figures"), help="folder for claims.csv and claims.txt")
    parser.add_argument("--generated", type=Path, default=Path("paper/generated"), help="folder for the LaTeX files")
    options = parser.parse_args(arguments)
    try:
        facts = summaries.facts({study: read_rows(study, options.data) for study in summaries.FACTS})
        rows = evaluate(options.data, options.benchmarks)
        print("wrote", *write(rows, options.figures, options.generated, facts))
    except (BagError, JournalError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
