"""The ledger as files: every claim judged on our flights, as table, text, Markdown, LaTeX and macros of the report."""

import argparse
import math
import re
import sys
import textwrap
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

from fiplib.params import Params
from fiplib.recording import BagError, Flight
from fiplib.reproduction.claims import BY_ID, CLAIMS, JUDGED, Claim
from fiplib.reproduction.sources import Quantities, Rows, csv_text
from fiplib.reproduction.tables import NONE, Facts, Table
from fiplib.reproduction.verdicts import SENSITIVITY, Kind, Share, Verdict, middle, share, verdict


class Row(NamedTuple):
    """A row of the ledger as text, in the columns of ``claims.csv``; ``facts`` are numbers that only the report prints.

    ``ours`` is the median of the flights with its 95 % interval, ``recorded`` the value of the recorded flight;
    ``agree`` of ``flights`` agree with the claim, a share with its 95 % interval; ``half`` and ``twice`` are the
    verdicts with half and with twice the tolerance (empty: the criterion has none).
    """

    id: str
    claim: str
    kind: str
    paper: str
    ours: str
    ours_low: str
    ours_high: str
    recorded: str
    unit: str
    criterion: str
    agree: str
    flights: str
    share_low: str
    share_high: str
    verdict: str
    half: str
    twice: str
    reason: str
    reading: str
    bag: str
    facts: Mapping[str, str]

    @property
    def interval(self) -> str:
        """Our number with its interval, for people: ``0.057 [0.055, 0.059]``."""
        return f"{self.ours} [{self.ours_low}, {self.ours_high}]" if self.ours_low else self.ours

    @property
    def share(self) -> str:
        """The share that agrees with its interval, for people: ``40/40 (0.91-1.00)``; of many events without it."""
        interval = f" ({self.share_low}-{self.share_high})" if len(self.flights) < 4 else ""
        return f"{self.agree}/{self.flights}{interval}" if self.flights else ""

    @property
    def short(self) -> str:
        """Return the verdict, or why there is none."""
        return self.kind if self.verdict == Verdict.NONE else self.verdict

    @property
    def printed(self) -> str:
        """Return the paper's number with its unit."""
        return f"{self.paper} {self.unit}" if self.paper else ""


def evaluate(
    data: Path = Path("data"),
    check: Callable[[str, Rows], object] = lambda *_: None,
    failures: list[str] | None = None,
    claims: Iterable[Claim] = CLAIMS,
) -> list[Row]:
    """Judge claims on their sources in ``data`` and ``benchmarks/`` beside it.

    Args:
        data: the folder of the bags.
        check: as for ``Sources.read``.
        failures: gets a sentence for each bag that claims cannot be judged from, whose rows stay open then; None: the
            first of these is raised.
        claims: which; all by default.

    Raises:
        BagError, JournalError: a bag is missing, damaged or lacks something; a table is damaged.
    """

    @cache
    def sources(claim: Claim) -> list[Flight | Rows | Quantities]:
        return claim.read(data, check)

    rows, first = [], {tuple(claim.names): claim for claim in CLAIMS}
    for claim in claims:
        try:
            rows.append(judged(claim, sources(first[tuple(claim.names)])))
        except BagError as error:
            if failures is None:
                raise
            failures += [] if str(error) in failures else [str(error)]
            rows.append(_row(claim, bag=", ".join(claim.names), reading=f"Cannot be judged: {error}"))
    return rows


def shares(claim: Claim, values: Sequence[float]) -> list[Share]:
    """Return the shares of flights that agree with a claim with each of the tolerances in ``SENSITIVITY``."""
    return [share(claim.agree(value, factor) for value in values) for factor in SENSITIVITY]


def verdicts(claim: Claim, found: Sequence[Share]) -> list[Verdict]:
    """Return the verdicts that go with ``shares``."""
    return [
        verdict(one, claim.kind, claim.needed(factor), claim.unprinted)
        for one, factor in zip(found, SENSITIVITY, strict=True)
    ]


def judged(claim: Claim, sources: Sequence[Flight | Rows | Quantities]) -> Row:
    """The row of one claim, from what it is read from. Raises BagError if a flight lacks what the claim needs."""
    found = claim.gather(*sources)
    counts = shares(claim, found.values)
    half, as_stated, twice = verdicts(claim, counts)
    ours = middle(found.values) if found.ours is None else (found.ours, math.nan, math.nan)
    studied = {"simulated" for source in sources if isinstance(source, list)}
    origins = sorted(studied | {source.metadata["origin"] for source in sources if isinstance(source, Flight)})
    limits = {}
    if found.values:
        digits = 2 if counts[1].flights < 1000 else 4
        limits = {name: f"{getattr(counts[1], name):.{digits}f}" for name in ("low", "high")}
    return _row(
        claim,
        **dict(zip(("ours", "ours_low", "ours_high"), (_number(value, claim) for value in ours), strict=True)),
        recorded=_number(found.recorded, claim),
        **{name: str(getattr(counts[1], name)) for name in ("agree", "flights") if found.values},
        **{f"share_{name}": text for name, text in limits.items()},
        verdict=str(as_stated),
        reason=f"{claim.reason}; under our choice the row {verdict(counts[1])}" if claim.unprinted else claim.reason,
        **({"half": str(half), "twice": str(twice)} if tolerant(claim) else {}),
        reading=found.note,
        bag=", ".join(claim.names) + (f" ({' and '.join(origins)})" if origins else ""),
        facts={name: f"{value:.3g}" for name, value in found.facts.items() if math.isfinite(value)},
    )


def tolerant(claim: Claim) -> bool:
    """Return whether a claim is tested by a criterion with a tolerance."""
    return claim.kind is Kind.TESTED and (claim.tolerance > 0 or claim.late is not None)


def _row(claim: Claim, **known: str | Mapping[str, str]) -> Row:
    """A row with what is known of it; open, unless there is a verdict."""
    own = {"id": claim.id, "claim": claim.text, "kind": str(claim.kind), "unit": claim.unit, "reason": claim.reason}
    own |= {"paper": _number(claim.paper, claim), "criterion": claim.criterion}
    own |= {"verdict": str(Verdict.OPEN if claim.kind is Kind.TESTED else Verdict.NONE), "facts": {}}
    return Row(**{**dict.fromkeys(Row._fields, ""), **own, **known})


def _number(value: float | None, claim: Claim) -> str:
    return "" if value is None or math.isnan(value) else f"{value:.{claim.decimals}f}"


def as_csv(rows: Sequence[Row]) -> str:
    """The ledger with the columns of ``Row`` and the command that computes each row from the beginning."""
    return csv_text([(*Row._fields[:-1], "command"), *((*row[:-1], BY_ID[row.id].command) for row in rows)])


# --- to read


GROUPS = {
    "Pushes in hover": ("D", "D1"),
    "Circle of 0.8 m": ("C", "C2.delay"),
    "Length in flight": ("G G1 G2 G3", "G1.length"),
    "Search of the GA": ("G4", "G4.search"),
    "Tracking": ("G5", "G5"),
    "Changes of length": ("G6", "G6.fatal"),
    "Fluctuation": ("G7", "G7"),
    "Excitation": ("G8", "G8"),
    "Model, problem": ("M", "M3"),
    "Real time": ("R", "R1.ga"),
    "On a vehicle": ("V", "V1"),
}
"""The groups of rows: claims (or their letters) that belong to each, and the row that stands for it."""

RULE = (
    "A verdict is a share of at least 20 flights: the claim holds if the lower limit of the share's 95 % interval is "
    "above 1/2, fails if the upper one is below, else it is undecided."
)
WIDTH = 100
COLUMNS = {"row": 9, "claim": 27, "paper": 8, "ours [95 %]": 23, "agree (95 %)": 19, "verdict": 9}
"""Column widths of the ledger in a terminal, with a space between columns."""

SUMMARY = {
    **{"group": 17, "hold": 5, "fail": 5, "undec.": 6},
    **{"main row": 9, "ours [95 %]": 23, "agree (95 %)": 19, "verdict": 9},
}
"""Column widths of its summary: the tested rows of a group by verdict, and the group's main row."""

WORDS = {Verdict.HOLDS: "hold", Verdict.FAILS: "fail", Verdict.UNDECIDED: "are undecided", Verdict.OPEN: "are open"}


def as_text(rows: Sequence[Row], verbose: bool = False) -> str:
    """The ledger for a terminal of 100 columns: a screen of summary, then a line or two for each row.

    ``verbose`` adds to each row its criterion, what was fitted or is not printed, its note and its sources.
    """
    widths = list(COLUMNS.values())
    text = [*summary(rows), "", *_wrapped(list(COLUMNS), widths), "-" * WIDTH]
    for row in rows:
        text += _wrapped((row.id, row.claim, row.printed, row.interval, row.share, row.short), widths)
        if verbose:
            text += [*textwrap.wrap(explained(row), WIDTH - 8, initial_indent=" " * 8, subsequent_indent=" " * 8), ""]
    return "\n".join(text)


def explained(row: Row) -> str:
    """Return the reasons for the verdict of a row, as sentences."""
    reason = {Kind.FITTED: "Fitted", Kind.NOT_TESTABLE: "Not testable", Kind.TESTED: "Undecided"}[Kind(row.kind)]
    words = [
        f"Criterion: {row.criterion}." if row.kind == Kind.TESTED and row.criterion else "",
        f"{reason}: {row.reason}." if row.reason else "",
        f"{row.reading}." if row.reading else "",
        f"Recorded flight: {row.recorded}." if row.recorded else "",
        f"With half the tolerance: {row.half}, with twice: {row.twice}." if row.half else "",
        f"[{row.bag}]" if row.bag else "",
    ]
    return " ".join(filter(None, words))


def summary(rows: Sequence[Row]) -> list[str]:
    """At most 24 lines of up to 100 characters: counts by kind and verdict, the rule, a line for each group."""
    counts = counted(rows)
    kinds = ", ".join(f"{counts[kind]} {kind}" for kind in Kind)
    found = ", ".join(f"{counts[one]} {word}" for one, word in WORDS.items())
    text = textwrap.wrap(f"{len(rows)} claims of the paper: {kinds}. Of the tested ones: {found}. {RULE}", WIDTH)
    widths = [*SUMMARY.values()]
    text += ["", *_wrapped([*SUMMARY], widths), "-" * WIDTH]
    by_id = {row.id: row for row in rows}
    for name, (members, main) in GROUPS.items():
        if row := by_id.get(main):
            tally = Counter(other.verdict for other in rows if of_group(other.id, members.split()))
            numbers = (str(tally[one] or "") for one in (Verdict.HOLDS, Verdict.FAILS, Verdict.UNDECIDED))
            found = (row.interval, row.share, row.verdict) if row.flights else (row.short, "", "")
            text += _wrapped((name, *numbers, main, *found), widths)
    return text


def of_group(id: str, members: Sequence[str]) -> bool:
    """Return whether a row belongs to a group: by its claim, G4 of G4.search, or by the claim's letter."""
    claim = id.partition(".")[0]
    return claim in members or (claim[0] in members and not any(len(member) > 1 for member in members))


def _wrapped(cells: Sequence[str], widths: Sequence[int]) -> list[str]:
    """A row of a text table as lines, long cells wrapped."""
    columns = [textwrap.wrap(cell, width) or [""] for cell, width in zip(cells, widths, strict=True)]
    height = max(map(len, columns))
    columns = [[*lines, *[""] * (height - len(lines))] for lines in columns]
    return [
        " ".join(f"{part:{width}}" for part, width in zip(parts, widths, strict=True)).rstrip()
        for parts in zip(*columns, strict=True)
    ]


HEADLINE = ("D1", "C2.delay", "G1.length", "G2.length", "G3.length", "G5", "G6.fatal", "G8", "M3", "R1.ga")
"""The rows that the README shows: tested ones only."""


def headline(data: Path = Path("data"), check: Callable[[str, Rows], object] = lambda *_: None) -> str:
    """Return the rows in ``HEADLINE`` as a Markdown table, judged from ``data``. Errors as ``evaluate``."""
    return as_markdown(evaluate(data, check, claims=[BY_ID[id] for id in HEADLINE]))


def as_markdown(rows: Sequence[Row]) -> str:
    """Rows of the ledger as a Markdown table."""
    lines = [("Claim of the paper", "Paper", "Ours (simulated), 95 % interval", "Agree, 95 % interval", "Verdict")]
    lines.append(("---",) * len(lines[0]))
    for row in rows:
        what = "" if not row.flights else f"{row.agree} of {row.flights} ({row.share_low} to {row.share_high})"
        unit = "" if row.unit == "1" else f" {row.unit}"
        lines.append((f"{row.claim} ({row.id})", row.printed or NONE, f"{row.interval}{unit}", what, row.short))
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


# --- for the report


def as_latex(rows: Sequence[Row]) -> str:
    """The ledger as a booktabs tabular of the page's width; the reasons stay in the CSV."""
    lines = []
    for row in rows:
        claim = re.sub(r"\b([abxyl])(0?)\b", lambda found: f"${found[1]}{'_0' if found[2] else ''}$", row.claim)
        claim = claim.replace("m_p << m", r"$m_p \ll m$")
        numbers = [number.replace("-", "$-$") or NONE for number in (row.paper, row.interval)]
        share = row.share.replace("-", "--") or NONE
        unit = {"1": "", "%": r"\%"}.get(row.unit, row.unit)
        lines.append((row.id, claim, *numbers, unit, share, row.short))
    header = ("Row", "Claim of the paper", "Paper", r"Ours [95\,\%]", "Unit", r"Agree (95\,\%)", "Verdict")
    return Table(header, lines, "@{}llrllll@{}").latex()


def table21_sensitivity(*sources: Flight | Rows | Quantities) -> Table:
    """Table 21: the verdict of every tested claim with half the tolerance of its criterion, as stated, and with twice.

    The share that agrees of the simulated flights of Table 5, 40 flights or 120, and the verdict. A claim that depends
    on an unprinted choice is undecided with every tolerance. Where a share is needed, the tolerance is what may
    be missing from it.
    """
    known = dict(zip((*JUDGED.bags, *JUDGED.studies, *JUDGED.benchmarks), sources, strict=True))
    lines = []
    for claim in filter(tolerant, CLAIMS):
        counts = shares(claim, claim.gather(*(known[name] for name in claim.of)).values)
        found = [
            f"{100 * count.agree / max(count.flights, 1):.0f}\\,\\% {one}"
            for count, one in zip(counts, verdicts(claim, counts), strict=True)
        ]
        lines.append((claim.id, claim.criterion.replace("%", r"\,\%"), f"{counts[1].flights}", *found))
    header = ("Row", "Criterion of a flight", "Flights", "Half", "As stated", "Twice the tolerance")
    return Table(header, lines, "llrlll")


def counted(rows: Sequence[Row]) -> dict[str, int]:
    """Return how many rows there are of each kind, and how many tested ones have each verdict."""
    kinds, found = Counter(row.kind for row in rows), Counter(row.verdict for row in rows if row.kind == Kind.TESTED)
    verdicts = {str(one): found[one] for one in Verdict if one is not Verdict.NONE}
    return {str(kind): kinds[kind] for kind in Kind} | verdicts


NUMBERS = (
    *("paper", "ours", "ours_low", "ours_high", "recorded"),
    *("agree", "flights", "share_low", "share_high", "verdict", "half", "twice", "kind"),
)
"""Fields of a row that the report may cite."""


def macros(rows: Sequence[Row], params: Params, facts: Facts) -> dict[str, str]:
    """Every number of the report by name: each of ``NUMBERS`` + row; Fact + row + name; Count + kind or verdict;
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
        named |= {macro(name, row.id): getattr(row, name) for name in NUMBERS if getattr(row, name) != "inf"}
        named |= {macro("Fact", row.id, name): text for name, text in row.facts.items()}
    named |= {macro("Count", kind): str(count) for kind, count in {"rows": len(rows), **counted(rows)}.items()}
    tolerances = [row for row in rows if row.half]
    changed = [row for row in tolerances if {row.half, row.twice} != {row.verdict}]
    named |= {macro("Count", "tolerances"): f"{len(tolerances)}", macro("Count", "changed"): f"{len(changed)}"}
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
        figures / "claims.txt": as_text(rows, verbose=True) + "\n",
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
    shown = parser.add_mutually_exclusive_group()
    shown.add_argument("--verbose", action="store_true", help="with criterion, reasons and sources of each row")
    shown.add_argument("--markdown", action="store_true", help="print the main rows only, as the README's table")


def run(options: argparse.Namespace) -> int:
    """Judge every claim and print the ledger; return the exit status: 1 if claims could not be judged.

    Raises BagError, JournalError: there is no such folder; a table is damaged.
    """
    if not options.data.is_dir():
        raise BagError(f"{options.data}: no such folder; name that of the bags with --data")
    if options.markdown:
        print(headline(options.data), end="")
        return 0
    failures: list[str] = []
    print(as_text(evaluate(options.data, failures=failures), options.verbose))
    for sentence in failures:
        print(f"fip: claims cannot be judged: {sentence}", file=sys.stderr)
    return int(bool(failures))
