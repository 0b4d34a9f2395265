"""The fault campaign: inject faults into simulated flights behind the failsafe, and report what happened.

Faults of poses, solver, estimate and operator fly in virtual time: the same rows every time. Those of processes fly in
real time, in processes of their own that are killed or stopped; of these the table keeps what does not depend on
timing. Everything is simulated: nothing here has flown on a vehicle. Rows gather beside the table in .partial.csv;
stopped at any time, the same command goes on from there.
"""

import argparse
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from tqdm import tqdm

from fiplib.reproduction import stored
from fiplib.studies.faults.judging import Fault
from fiplib.studies.faults.processes import PROCESS_FAULTS
from fiplib.studies.faults.virtual import VIRTUAL_FAULTS
from fiplib.studies.journal import Journal

FAULTS: Mapping[str, Fault] = {**VIRTUAL_FAULTS, **PROCESS_FAULTS}
"""All faults by name, in the order of the table."""
TABLE, PAGE = Path("data/faults.csv"), Path("docs/faults.md")
GROUPS = {
    "poses": "Poses and stamps",
    "solver": "The solver",
    "estimator": "The estimator and the length",
    "link": "The way to the vehicle",
    "process": "Processes killed or stopped",
    "recording": "The recording",
    "operator": "The operator",
    "vehicle": "Disturbances",
}
"""The groups of faults in the order of the page, with their titles."""
TABLE_HEAD = r"| injected | modes after take-off | vehicle | \|a\|, \|b\| (cm) | perfect information | verdict |"
MARKS = "<!-- table: written by fip faults -->", "<!-- end of the table -->"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``fip faults``."""
    parser.add_argument("names", nargs="*", metavar="NAME", help="which faults (default: all)")
    parser.add_argument("--list", action="store_true", help="list the faults")
    parser.add_argument("--output", type=Path, metavar="CSV", help="table to write (default: data/faults.csv)")
    parser.add_argument("--fresh", action="store_true", help="forget the rows that are on disk")


def run(options: argparse.Namespace) -> int:
    """Fly the faults that are asked for; return 1 if one did not meet the target, else 0.

    Raises ValueError: an unknown fault, or some faults alone without a table of their own; JournalError, OSError: the
    table on disk is another, or cannot be written.
    """
    if options.list:
        for name, fault in FAULTS.items():
            real_time = ", in real time" if name in PROCESS_FAULTS else ""
            print(f"{name:24} {fault.group:10} {fault.what}{real_time}")
        return 0
    if unknown := [name for name in options.names if name not in FAULTS]:
        raise ValueError(f"no fault {unknown[0]!r}; --list lists them")
    if options.names and options.output is None:
        raise ValueError("some faults alone go to a table of their own: give --output CSV")
    path = options.output or TABLE
    fly({name: FAULTS[name] for name in options.names or FAULTS}, path, options.fresh)
    rows = rows_of(path)
    if options.output is None:
        PAGE.write_text(with_table(PAGE.read_text(encoding="utf-8"), rows), encoding="utf-8")
    for row in rows:
        print(f"{row['fault']:24} {row['vehicle']:52} {row['verdict']}")
    counts = counted(rows)
    print(f"{len(rows)} faults: {', '.join(f'{count} {kind}' for kind, count in counts.items())}; wrote {path}")
    return int(counts["NOT MET"] > 0)


def fly(faults: Mapping[str, Fault], path: Path, fresh: bool = False) -> None:
    """Fly the faults of which the table has no row yet, and complete it."""
    journal = Journal(path, ["fault"], fresh)
    for name, fault in tqdm(faults.items(), unit="fault", disable=None):
        if (name,) not in journal.rows:
            journal.append({"fault": name}, fault.fly())
    journal.complete([{"fault": name} for name in faults])


def rows_of(path: Path) -> list[dict[str, str]]:
    """Return the rows of a finished table. Raises JournalError if it is damaged."""
    return stored.rows(path, "fip faults --fresh")


def counted(rows: Sequence[Mapping[str, str]]) -> Counter[str]:
    """Count how many of the verdicts begin with each word: "met", "by design", "NOT MET"."""
    return Counter(row["verdict"].partition(":")[0] for row in rows)


def with_table(page: str, rows: Sequence[Mapping[str, str]]) -> str:
    """Return a page in Markdown with the table between its marks made anew."""
    before, _, rest = page.partition(MARKS[0])
    _, _, after = rest.partition(MARKS[1])
    counts = counted(rows)
    lines = [
        f"{len(rows)} faults: {counts['met']} met the target, {counts['by design']} ended safely by a limit of the "
        f"failsafe where perfect information would have kept the rod, {counts['NOT MET']} did not meet it."
    ]
    for group, title in GROUPS.items():
        lines += ["", f"### {title}", "", TABLE_HEAD, "|---|---|---|---|---|---|"]
        for row in rows:
            if row["group"] == group:
                largest = f"{row['largest_a_cm']}, {row['largest_b_cm']}" if row["largest_a_cm"] else ""
                vehicle = row["vehicle"] + (f" ({row['ended']})" if row["ended"] else "")
                vehicle += "" if row["bag"] == "valid" else f"; bag {row['bag']}"
                cells = (row["what"], row["modes"].replace(">", "→"), vehicle, largest, row["perfect_information"])
                lines.append(f"| {' | '.join(cells)} | {row['verdict']} |")
    return f"{before}{MARKS[0]}\n" + "\n".join(lines) + f"\n{MARKS[1]}{after}"
