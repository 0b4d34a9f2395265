"""The sources of a figure, table or claim: bags, and the finished tables of studies and benchmarks, read from disk."""

import csv
import io
import pkgutil
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from fiplib.reproduction import stored
from fiplib.reproduction.stored import JournalError

if TYPE_CHECKING:
    from fiplib.recording import Flight

Rows = list[dict[str, float | str]]
"""A finished table of a study: one dictionary per case, numbers as float."""

Quantities = dict[str, float]
"""A table of ``benchmarks/``: numbers by name."""

BENCHMARKS = {
    "solve_times": "python -m benchmarks.mpc --save",
    "sweep_rates": "python benchmarks/bench_sweep.py --save",
    "deadlines": "python benchmarks/bench_deadlines.py --save",
    "results": "make bench",
    "growth": "python -m benchmarks.growth --save",
    "controller_ticks": "python -m benchmarks.controllers --save",
}
"""The tables of ``benchmarks/``, each with the command that writes it."""

RESULTS = ("results", "growth")
"""Those of them that have several columns: ``Rows``, and not ``Quantities``."""


@dataclass(frozen=True, kw_only=True)
class Sources:
    """Names of what something is made from: bags, studies, tables of ``benchmarks/``."""

    bags: tuple[str, ...] = ()
    studies: tuple[str, ...] = ()
    benchmarks: tuple[str, ...] = ()

    @property
    def command(self) -> str:
        """Return the shell command that computes it from the beginning: flights, studies and measurements first."""
        steps = ["make bags"] if self.bags else []
        steps += [f"make sweep STUDIES='{' '.join(self.studies)}'"] if self.studies else []
        steps += [BENCHMARKS[table] for table in self.benchmarks]
        return "; ".join([*steps, "make figures"])

    @property
    def names(self) -> list[str]:
        """Return the name of the sources in the ledger."""
        tables = [f"sweeps/{study}" for study in self.studies] + [f"{table}.csv" for table in self.benchmarks]
        return [*self.bags, *tables]

    def files(self, data: Path = Path("data")) -> list[Path]:
        """Every file that is read; ``benchmarks/`` lies beside the folder ``data``."""
        found = [data / bag / file for bag in self.bags for file in (f"{bag}.mcap", "metadata.yaml")]
        found += [data / "sweeps" / f"{study}.csv" for study in self.studies]
        return found + [data.parent / "benchmarks" / f"{table}.csv" for table in self.benchmarks]

    def read(
        self, data: Path = Path("data"), check: Callable[[str, Rows], object] = lambda *_: None
    ) -> "list[Flight | Rows | Quantities]":
        """Read all of it: bags, then studies, then benchmarks, in order; a table that does not exist yet is empty.

        Args:
            data: the folder of the bags.
            check: gets the name of each study and its rows, and raises if they are not those of its cases.

        Raises:
            BagError, JournalError: a bag is missing, or something is damaged.
        """
        from fiplib import bags  # here: the registry need not wait for NumPy

        flights = [bags.read(data / bag) for bag in self.bags]
        tables = [read(study, data) for study in self.studies]
        for study, rows in zip(self.studies, tables, strict=True):
            check(study, rows)
        return flights + tables + [measured(name, data) for name in self.benchmarks]


@dataclass(frozen=True)
class Product(Sources):
    """A figure or table; ``address`` is ``module:function``, and the function takes what ``Sources.read`` returns.

    ``parts`` are further functions that make it. The studies in ``behind`` draw the spread behind recorded flights; a
    folder of other flights need not hold them.
    """

    address: str
    parts: tuple[str, ...] = ()
    behind: tuple[str, ...] = ()

    def load(self) -> Callable:
        """Import the function, which returns a ``Figure`` or a ``Table``."""
        return pkgutil.resolve_name(self.address)


def read(study: str, data: Path = Path("data")) -> Rows:
    """Return the finished table of a study; empty where ``make sweep`` has not completed it. Raises JournalError."""
    return stored.numbers(data / "sweeps" / f"{study}.csv", f"make sweep STUDIES='{study} --fresh'")


def measured(name: str, data: Path = Path("data")) -> Rows | Quantities:
    """Return a table of ``benchmarks/``, which lies beside the folder ``data``; empty where there is none yet."""
    path = data.parent / "benchmarks" / f"{name}.csv"
    return stored.numbers(path, BENCHMARKS[name]) if name in RESULTS else quantities(path, BENCHMARKS[name])


def csv_text(rows: Iterable[Iterable[str]]) -> str:
    """Rows as CSV."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def quantities(path: Path, again: str = "make bench") -> Quantities:
    """Return the numbers of a benchmark's table of two columns; empty if there is no such file. Raises JournalError.

    ``again`` is the command that makes the table.
    """
    try:
        return {name: float(value) for name, value in (row.values() for row in stored.rows(path, again))}
    except ValueError as error:
        problem = f"{path}: needs a header and rows of a name and a number ({error})"
        raise JournalError(f"{problem}; measure again: {again}") from error
