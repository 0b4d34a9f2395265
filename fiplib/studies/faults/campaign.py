"""The fault campaign: inject faults into simulated flights behind the failsafe, and report what happened.

Faults of poses, solver, estimate and operator fly in virtual time: the same rows every time. Those of processes fly in
real time, in processes of their own that are killed or stopped; of these the table keeps what does not depend on
timing. Everything is simulated: nothing here has flown on a vehicle. Rows gather beside the table in .partial.csv;
stopped at any time, the same command goes on from there. Each fault is injected in every phase of a flight that it can
disturb; flights in virtual time take all cores.
"""

import argparse
import gc
import multiprocessing
import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from tqdm import tqdm

from fiplib.reproduction import stored
from fiplib.studies.faults.judging import Fault
from fiplib.studies.faults.processes import PROCESS_FAULTS
from fiplib.studies.faults.virtual import PHASES, VIRTUAL_FAULTS
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
MARKS = "<!-- table: written by fip faults -->", "<!-- end of the table -->"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``fip faults``."""
    parser.add_argument("names", nargs="*", metavar="NAME", help="which faults (default: all)")
    parser.add_argument("--list", action="store_true", help="list the faults")
    parser.add_argument("--output", type=Path, metavar="CSV", help="table to write (default: data/faults.csv)")
    jobs = "processes for flights in virtual time (default: one per core)"
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, metavar="N", help=jobs)
    parser.add_argument("--fresh", action="store_true", help="forget the rows that are on disk")


def run(options: argparse.Namespace) -> int:
    """Fly the faults that are asked for; return 1 if one did not meet the target, else 0.

    Raises ValueError: an unknown fault, or some faults alone without a table of their own; JournalError, OSError: the
    table on disk is another, or cannot be written.
    """
    if options.list:
        for name, fault in FAULTS.items():
            real_time = ", in real time" if name in PROCESS_FAULTS else ""
            print(f"{name:24} {fault.group:10} {fault.what} ({', '.join(fault.phases)}{real_time})")
        return 0
    if unknown := [name for name in options.names if name not in FAULTS]:
        raise ValueError(f"no fault {unknown[0]!r}; --list lists them")
    if options.names and options.output is None:
        raise ValueError("some faults alone go to a table of their own: give --output CSV")
    path = options.output or TABLE
    fly({name: FAULTS[name] for name in options.names or FAULTS}, path, options.fresh, options.jobs)
    rows = rows_of(path)
    if options.output is None:
        PAGE.write_text(with_table(PAGE.read_text(encoding="utf-8"), rows), encoding="utf-8")
    for row in rows:
        print(f"{row['fault']:24} {row['phase']:9} {row['vehicle']:52} {row['verdict']}")
    counts = counted(rows)
    print(f"{len(rows)} cases: {', '.join(f'{count} {kind}' for kind, count in counts.items())}; wrote {path}")
    return int(counts["NOT MET"] > 0)


def fly(faults: Mapping[str, Fault], path: Path, fresh: bool = False, jobs: int = 1) -> None:
    """Fly the cases, faults by phases, of which the table has no row yet, and complete it."""
    journal = Journal(path, ["fault", "phase"], fresh)
    cases = [{"fault": name, "phase": phase} for name, fault in faults.items() for phase in fault.phases]
    left = [case for case in cases if journal.key(case) not in journal.rows]
    with tqdm(total=len(left), unit="case", disable=None) as bar:
        for case, row in flown(faults, left, jobs):
            journal.append(case, row)
            bar.update()
    journal.complete(cases)


def flown(
    faults: Mapping[str, Fault], cases: Sequence[dict[str, str]], jobs: int
) -> Iterator[tuple[dict[str, str], dict]]:
    """Fly cases and yield each with its row: those in virtual time on so many cores, then the others one by one."""
    virtual = [case for case in cases if case["fault"] in VIRTUAL_FAULTS]
    if virtual:
        spawn = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(max(1, min(jobs, len(virtual))), spawn, gc.freeze) as pool:
            futures = {pool.submit(fly_virtual, **case): case for case in virtual}
            try:
                for future in as_completed(futures):
                    yield futures[future], future.result()
            finally:
                pool.shutdown(cancel_futures=True)
    for case in cases:
        if case not in virtual:
            yield case, faults[case["fault"]].fly(case["phase"])


def fly_virtual(fault: str, phase: str) -> dict[str, Any]:
    """Fly one case in virtual time, by its names: faults do not travel between processes."""
    return VIRTUAL_FAULTS[fault].fly(phase)


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
    counts, cases = counted(rows), {}
    for row in rows:
        cases.setdefault((row["group"], row["what"]), {})[row["phase"]] = row
    lines = [
        f"{len(cases)} faults in {len(rows)} cases: {counts['met']} met the target, {counts['by design']} ended safely "
        "by a limit of the failsafe where perfect information would have kept the rod, "
        f"{counts['NOT MET']} did not meet it."
    ]
    for group, title in GROUPS.items():
        lines += ["", f"### {title}", "", f"| injected | {' | '.join(PHASES)} |", "|---" * (1 + len(PHASES)) + "|"]
        for (of, what), by_phase in cases.items():
            if of == group:
                cells = [cell(by_phase[phase]) if phase in by_phase else "" for phase in PHASES]
                lines.append(f"| {what} | {' | '.join(cells)} |")
    return f"{before}{MARKS[0]}\n" + "\n".join(lines) + f"\n{MARKS[1]}{after}"


def cell(row: Mapping[str, str]) -> str:
    """Return how a case ended, in the few words of a cell of the page."""
    kind, _, how = row["verdict"].partition(": ")
    words = how.removeprefix("ended safely, ") if kind == "met" else f"**{kind}**: {how.removeprefix('ended safely, ')}"
    if how.startswith("ended safely"):
        words = f"{row['vehicle'].removeprefix('rod given up, ')}; {words}"
    words += f" ({row['ended']})" if how == "not armed" else ""
    return words if row["bag"] in ("valid", "") else f"{words}; bag {row['bag']}"
