"""Studies of many flights, on all cores or a Dask cluster: ``fip sweep NAME``.

Each finished case is one row, written at once to ``data/sweeps/NAME.partial.csv``: whatever stops a sweep, the same
command continues it. When no case is left the rows, sorted, become ``data/sweeps/NAME.csv``; its bytes depend neither
on the number of workers nor on the order in which they finish.

A cluster that runs already (``dask scheduler``, ``dask worker ADDRESS``, on any machines) is used by its address. Its
workers need this package in this version: restart them after a change of the code.
"""

import argparse
import contextlib
import itertools
import os
import sys
import time
import traceback
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from fiplib import studies
from fiplib.params import FipError
from fiplib.studies import cluster
from fiplib.studies.cluster import ClusterError
from fiplib.studies.journal import Journal, named, text

if TYPE_CHECKING:
    from distributed import Client

DIRECTORY = Path("data/sweeps")

AHEAD = 1000
"""Cases in the scheduler's hands at a time: work for hundreds of workers, yet a sweep of millions stays small there."""

REPORTED = 10
"""Failed cases that are reported one by one; the rest is counted."""


def load(name: str, address: str) -> tuple[Any, list[dict]]:
    """Import the study at an address; returns it and its cases, sorted by its keys.

    Raises FipError: the module cannot be imported, or its cases do not differ in their keys.
    """
    try:
        study = studies.load(address)
    except ImportError as error:
        raise FipError(f"{name}: the study cannot be imported: {error}") from error
    cases = study.cases()
    if missing := {key for key in study.KEYS for case in cases if key not in case}:
        raise FipError(f"{name}: a case lacks its key {', '.join(sorted(missing))}")
    if len({tuple(text(case[key]) for key in study.KEYS) for case in cases}) < len(cases):
        raise FipError(f"{name}: two cases have the same {', '.join(study.KEYS)}")
    # text sorts behind numbers, so that a column may hold both
    return study, sorted(cases, key=lambda case: [(isinstance(case[key], str), case[key]) for key in study.KEYS])


def sweep(
    name: str, address: str, journal: Journal, cases: list[dict], client: "Client", limit: int | None = None
) -> int:
    """Run those of all ``cases`` of a study that its journal lacks, at most ``limit``; returns how many failed.

    A case that raises is reported and left out; one whose worker died is run again, on another worker. A row is added
    to the journal, and safe on disk, as soon as it arrives. Workers find the study at ``address``, see
    ``studies.load``. Raises ClusterError: the cluster was lost; JournalError: a result has other columns than before.
    """
    from distributed import KilledWorker, as_completed

    todo = [case for case in cases if journal.key(case) not in journal.rows]
    waiting, suspects, running, failed = iter(todo[:limit]), [], {}, 0
    completed = as_completed(loop=client.loop, with_results=True, raise_errors=False)

    def submit(batch: list[dict]) -> None:
        if batch:
            # not `pure`: Dask must not take a result that an older version of the study has left on the scheduler
            futures = client.map(studies.run, [address] * len(batch), batch, pure=False)
            running.update(zip(futures, batch, strict=True))
            completed.update(futures)

    often = 0.2 if sys.stderr.isatty() else 30.0  # a log file is not flooded
    counts = {"total": len(cases), "initial": len(cases) - len(todo)}
    with tqdm(desc=name, unit="case", dynamic_ncols=True, mininterval=often, **counts) as bar:
        submit(list(itertools.islice(waiting, AHEAD)))
        alone = False
        while running:
            future, result = _next(completed, client, name)
            case = running.pop(future)
            if future.status == "finished":
                journal.append(case, result)
                bar.update()
            elif future.status != "error":
                # the worker died with the only copy of the result, unless there is nobody left to ask
                _workers(client, name)
                submit([case])
                continue
            elif isinstance(result[1], KilledWorker) and not alone:
                suspects.append(case)
            else:
                failed += 1
                if failed <= REPORTED:
                    bar.write(f"{name}: case {named(case)} failed: {_reason(result)}", file=sys.stderr)
            submit(list(itertools.islice(waiting, 1)))
            if not running and suspects:
                # several workers died of one of these, or only beside it: each is run by itself and tells
                alone = True
                submit([suspects.pop()])
    if failed > REPORTED:
        print(f"{name}: {failed - REPORTED} more cases failed", file=sys.stderr)
    return failed


def _workers(client: "Client", name: str) -> dict[str, int]:
    """Threads by worker; raises ClusterError when the scheduler is gone."""
    with contextlib.suppress(OSError):
        workers = client.nthreads()
        if client.status == "running":
            return workers
    raise ClusterError(f"{name}: the scheduler is gone")


def _next(completed: Any, client: "Client", name: str) -> tuple[Any, Any]:
    """Return the next finished (future, result); an error when no worker has been left for a while."""
    alive = time.monotonic()
    while not completed.has_ready():
        time.sleep(0.02)
        if time.monotonic() > alive + cluster.PATIENCE / 2:
            if _workers(client, name):
                alive = time.monotonic()
            elif time.monotonic() > alive + cluster.PATIENCE:
                raise ClusterError(f"{name}: every worker is gone")
    return next(completed)


def _reason(result: tuple[type, BaseException, Any]) -> str:
    """Why a case failed: the exception and the line that raised it."""
    from distributed import KilledWorker

    _, error, trace = result
    if isinstance(error, KilledWorker):
        return "every worker that ran it died"
    last = traceback.extract_tb(trace)[-1:]
    return repr(error) + "".join(f" ({Path(frame.filename).name}:{frame.lineno})" for frame in last)


def add_arguments(parser: argparse.ArgumentParser, known: Mapping[str, str] = studies.STUDIES) -> None:
    """Declare the options of ``fip sweep`` for the studies ``known``, addresses by name."""
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"a study: {', '.join(known)}")
    parser.add_argument("--all", action="store_true", help="every study")
    parser.add_argument("--list", action="store_true", help="list the studies, and exit")
    parser.add_argument("--limit", type=int, metavar="N", help="run at most N cases of each study")
    parser.add_argument("--workers", type=int, metavar="N", help="local worker processes (default: one per core)")
    there = "address of a Dask scheduler, such as tcp://host:8786; default: $DASK_SCHEDULER_ADDRESS"
    default = os.environ.get("DASK_SCHEDULER_ADDRESS")
    parser.add_argument("--scheduler", metavar="ADDRESS", default=default, help=there)
    parser.add_argument("--fresh", action="store_true", help="delete the stored rows of these studies and start again")
    parser.add_argument("--data", type=Path, default=DIRECTORY, metavar="FOLDER", help="default: %(default)s")


def run(options: argparse.Namespace, known: Mapping[str, str] = studies.STUDIES) -> int:
    """Run those of the studies ``known`` that are asked for; return the exit status: 1 if a case failed.

    Raises FipError, ClusterError, JournalError: a mistake of the user, or a cluster that was lost.
    """
    if unknown := [name for name in options.names if name not in known]:
        raise FipError(f"unknown study {', '.join(unknown)}; there are {', '.join(known)}")
    names = list(known) if options.all or options.list else list(dict.fromkeys(options.names))
    if not names:
        raise FipError(f"name a study ({', '.join(known)}), or --all")
    for option, value in (("limit", options.limit), ("workers", options.workers)):
        if value is not None and value < 1:
            raise FipError(f"--{option} must be at least 1")
    loaded = {name: load(name, known[name]) for name in names}
    if options.list:
        for name, (study, cases) in loaded.items():
            print(f"{name:18}{len(cases):6} cases  {study.__doc__.splitlines()[0]}")
        return 0
    jobs = [
        (name, Journal(options.data / f"{name}.csv", study.KEYS, options.fresh), cases)
        for name, (study, cases) in loaded.items()
    ]
    idle = all(journal.holds(cases) == len(cases) for _, journal, cases in jobs)
    failed = 0
    with contextlib.nullcontext() if idle else cluster.connect(options.scheduler, options.workers) as client:
        for name, journal, cases in jobs:
            try:
                if client is not None:
                    failed += sweep(name, known[name], journal, cases, client, options.limit)
            finally:
                done = journal.holds(cases)
                if done == len(cases):
                    journal.complete(cases)
                    print(f"{name}: complete, {done} cases in {journal.path}", file=sys.stderr)
                else:
                    again = "the same command without --fresh" if options.fresh else "the same command"
                    print(f"{name}: {done} of {len(cases)} cases are kept; {again} goes on from there", file=sys.stderr)
    return int(failed > 0)
