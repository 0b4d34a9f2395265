"""The harness of the benchmarks: contenders agree first, then take turns, and one that is not installed is named.

A topic (``mpc``, ``estimation``, ``bags``, ``flights``, ``growth``) is one module and runs in one process. Its works
are measured with ``compare``: every contender answers the same arguments, its answers are compared with ours, and then
all of them are timed in interleaved blocks, so that a change of the machine's speed meets them alike. What holds on
another machine is the ratio of two medians over the same arguments; the medians themselves stand beside it. Times are
CPU time of the process, all its threads together: what else the machine does meanwhile is not counted.
"""

import argparse
import csv
import gc
import importlib
import multiprocessing
import platform
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, fields
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

FOLDER = Path(__file__).parent
RESULTS = FOLDER / "results.csv"
BLOCK = 8
"""Consecutive calls of one contender before the next one's turn; one more ahead of them warms the caches and is not
counted."""
NOT_INSTALLED = "not installed"


class Absent(Exception):
    """A contender that cannot run here; the message says why."""


@dataclass(frozen=True)
class Contender:
    """One way to do a piece of work.

    Attributes:
        call: takes an argument of the work and returns a raw answer; this is timed.
        answer: brings the raw answer to an array (...) that is compared with ours; this is not timed.
        tolerance: the largest difference from our answer, in its unit, at which both count as equal.
        remark: what a reader must know of this contender, in a few words.
    """

    call: Callable[[Any], Any]
    answer: Callable[[Any], Any] = np.asarray
    tolerance: float = 1e-6
    remark: str = ""


@dataclass(frozen=True)
class Row:
    """One line of ``results.csv``: a contender at one piece of work.

    ``ratio`` is the contender's median over ours on the same arguments (ours: 1), ``p50_us`` and ``p99_us`` are in us,
    ``difference`` is the largest one from our answers; nan where there is none.
    """

    topic: str
    work: str
    contender: str
    ratio: float
    p50_us: float
    p99_us: float
    calls: int
    difference: float
    agrees: int
    remark: str = ""


COLUMNS = tuple(field.name for field in fields(Row))


def needs(*modules: str) -> list[ModuleType]:
    """Import modules of rivals, or raise ``Absent``."""
    found = []
    for name in modules:
        try:
            found.append(importlib.import_module(name))
        except ImportError as error:
            raise Absent(f"{NOT_INSTALLED}: {name.partition('.')[0]}") from error
    return found


def compare(
    topic: str,
    work: str,
    ours: Contender,
    rivals: Mapping[str, Callable[[], Contender]],
    arguments: Sequence[Any],
    *,
    budget: float = 2.0,
    checks: int = 24,
    block: int = BLOCK,
    before: Callable[[], object] | None = None,
) -> list[Row]:
    """Compare contenders at one piece of work.

    Args:
        topic, work: names of the rows.
        ours: what the rivals are compared with; the first row.
        rivals: by name, what makes each contender; may raise ``Absent``.
        arguments: one of each call, in the order in which a user would make them.
        budget: seconds of measurement for each contender; one that is too slow for all arguments is given blocks
            spread evenly over them.
        checks: arguments, spread evenly, on which answers are compared first.
        block: calls in one turn.
        before: called ahead of every timed call and not timed, for example to empty the caches.

    Returns:
        One row per contender. A rival whose answers differ, or that fails, is in it and does not count as agreeing.
    """
    contenders, absent = {"fip": ours}, {}
    for name, make in rivals.items():
        try:
            contenders[name] = make()
        except Absent as error:
            absent[name] = str(error)
    chosen = [arguments[i] for i in np.unique(np.linspace(0, len(arguments) - 1, checks).astype(int))]
    truth = [ours.answer(ours.call(argument)) for argument in chosen]
    differences, paces = {}, {}
    for name, contender in list(contenders.items()):
        try:
            taken, off = [], []
            for argument, wanted in zip(chosen, truth, strict=True):
                start = time.process_time()
                raw = contender.call(argument)
                taken.append(time.process_time() - start)
                off.append(_difference(contender.answer(raw), wanted))
            paces[name], differences[name] = float(np.median(taken)), max(off)
        except Exception as error:  # a rival's failure is a finding, whatever it raises
            if contender is ours:
                raise
            del contenders[name]
            absent[name] = f"failed: {type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"[:100]
    durations = interleaved(
        {name: contender.call for name, contender in contenders.items()}, arguments, paces, budget, block, before
    )
    rows = []
    for name, contender in contenders.items():
        times = durations[name]
        same = np.array([durations["fip"][index] for index in times])
        found = np.array(list(times.values())) / 1e3
        rows.append(
            Row(
                topic,
                work,
                name,
                float(np.median(found) / (np.median(same) / 1e3)),
                float(np.median(found)),
                float(np.percentile(found, 99)),
                len(found),
                differences[name],
                int(differences[name] <= contender.tolerance),
                contender.remark,
            )
        )
    rows += [
        Row(topic, work, name, np.nan, np.nan, np.nan, 0, np.nan, 0, reason.replace("\n", " "))
        for name, reason in absent.items()
    ]
    for row in rows:
        print(line(row), flush=True)
    return rows


def _difference(found: Any, wanted: Any) -> float:
    found, wanted = np.asarray(found, dtype=float), np.asarray(wanted, dtype=float)
    if found.shape != wanted.shape:
        raise ValueError(f"answer of shape {found.shape} where ours has {wanted.shape}")
    difference = float(np.abs(found - wanted).max())
    return difference if np.isfinite(difference) else np.inf


def interleaved(
    calls: Mapping[str, Callable[[Any], Any]],
    arguments: Sequence[Any],
    paces: Mapping[str, float],
    budget: float,
    block: int = BLOCK,
    before: Callable[[], object] | None = None,
) -> dict[str, dict[int, int]]:
    """Time calls in turns of ``block`` arguments: for each contender, ns by the index of the argument.

    The first contender sees every argument; one whose pace (s per call) breaks the budget sees every n-th block.
    The garbage collector rests meanwhile.
    """
    names = list(calls)
    blocks = [range(at, min(at + block, len(arguments))) for at in range(0, len(arguments), block)]
    strides = {
        name: max(1, int(np.ceil(paces[name] * (len(arguments) + len(blocks)) / budget))) for name in names[1:]
    } | {names[0]: 1}
    found: dict[str, dict[int, int]] = {name: {} for name in names}
    collecting = gc.isenabled()
    gc.disable()
    try:
        for turn, indices in enumerate(blocks):
            for name in names[turn % len(names) :] + names[: turn % len(names)]:
                if turn % min(strides[name], len(blocks)):
                    continue
                call = calls[name]
                if before is None:
                    call(arguments[indices[0]])
                for index in indices:
                    if before is not None:
                        before()
                    start = time.process_time_ns()
                    call(arguments[index])
                    found[name][index] = time.process_time_ns() - start
    finally:
        if collecting:
            gc.enable()
    return found


def rate(topic: str, work: str, contender: str, value: float, remark: str) -> Row:
    """A row for a number that is no comparison of calls (real-time factor, memory): the number stands in ``ratio``."""
    row = Row(topic, work, contender, value, np.nan, np.nan, 1, np.nan, 1, remark)
    print(line(row), flush=True)
    return row


def line(row: Row) -> str:
    """One row as it is printed."""
    numbers = f"{row.ratio:9.2f} x {row.p50_us:12.1f} us {row.p99_us:12.1f} us {row.calls:6} calls"
    verdict = "" if row.agrees or not row.calls else " DIFFERS"
    return f"{row.work:34} {row.contender:24} {numbers}  |d| {row.difference:.1e}{verdict}  {row.remark}"


def peak_memory(function: Callable[[bool], object]) -> float:
    """MB by which a call raises the peak of resident memory, in a fresh process; nan where this cannot be measured.

    ``function`` stands at the top level of a module and takes whether to do a small piece of the work only; that piece
    comes first and is not measured: it imports and compiles.
    """
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(_rise, function).result()


def _rise(function: Callable[[bool], object]) -> float:
    reset = Path("/proc/self/clear_refs")
    if not reset.exists():
        return float("nan")
    function(True)
    gc.collect()
    reset.write_text("5")  # sets the peak back to what is resident now
    before = _peak()
    function(False)
    return (_peak() - before) / 1024


def _peak() -> int:
    """Peak of resident memory, kB."""
    text = Path("/proc/self/status").read_text()
    return int(text.split("VmHWM:")[1].split()[0])


def machine() -> str:
    """The machine in one line."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [entry.split(":", 1)[1].strip() for entry in info.read_text().splitlines() if "model name" in entry]
        model = names[0] if names else model
    versions = f"Python {platform.python_version()}, NumPy {np.__version__}"
    return f"{model}, {multiprocessing.cpu_count()} cores, {platform.system()}, {versions}"


def save(topic: str, rows: Sequence[Row], path: Path = RESULTS) -> None:
    """Replace the rows of a topic, and the machine's, in the table of results."""
    kept = [row for row in load(path) if row["topic"] not in (topic, "machine")] if path.exists() else []
    this = Row("machine", "machine", machine(), np.nan, np.nan, np.nan, 0, np.nan, 1)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        writer.writerow([_text(getattr(this, column)) for column in COLUMNS])
        lines = [[row[column] for column in COLUMNS] for row in kept]
        lines += [[_text(getattr(row, column)) for column in COLUMNS] for row in rows]
        writer.writerows(sorted(lines, key=lambda cells: cells[0]))
    print(f"wrote {path}")


def load(path: Path = RESULTS) -> list[dict[str, str]]:
    """The rows of the table of results, as text."""
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def _text(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def main(
    topic: str,
    measure: Callable[[bool], list[Row]],
    description: str,
    keep: Callable[[list[Row]], None] = lambda rows: None,
) -> None:
    """The command line of a topic: ``--quick`` measures little, ``--save`` keeps the rows in ``results.csv``.

    ``keep`` saves what a topic has beside its rows.
    """
    parser = argparse.ArgumentParser(prog=f"python -m benchmarks.{topic}", description=description.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a look in a minute: few calls")
    parser.add_argument("--save", action="store_true", help=f"write the rows to {RESULTS.name}")
    options = parser.parse_args()
    print(f"{topic}: {machine()}", file=sys.stderr)
    rows = measure(options.quick)
    if options.save:
        save(topic, rows)
        keep(rows)
