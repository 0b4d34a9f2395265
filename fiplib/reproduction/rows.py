"""Finished tables of studies and benchmarks, read from disk."""

import csv
from pathlib import Path

Rows = list[dict[str, float | str]]
"""A finished table: one dictionary per case, numbers as float."""


def read(study: str, data: Path = Path("data")) -> Rows:
    """The finished table of a study; empty where ``make sweep`` has not completed it yet."""
    path = data / "sweeps" / f"{study}.csv"
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return [{column: _number(value) for column, value in row.items()} for row in csv.DictReader(file)]


def _number(value: str) -> float | str:
    try:
        return float(value)
    except ValueError:
        return value


class JournalError(Exception):
    """A table on disk that is not what it should be, in one line for its user."""


def quantities(path: Path) -> dict[str, float]:
    """Numbers by name from a benchmark's table of two columns; empty if there is no such file. Raises JournalError."""
    if not path.exists():
        return {}
    try:
        with path.open(newline="", encoding="utf-8") as file:
            next(lines := csv.reader(file))
            return {name: float(value) for name, value in lines}
    except (StopIteration, ValueError) as error:
        raise JournalError(
            f"{path}: needs a header and rows of a name and a number ({error}); measure again"
        ) from error
