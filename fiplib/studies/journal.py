"""The finished rows of a study on disk: kept one by one, complete in the end, the same bytes in any order.

A table is a CSV file whose first columns, the keys, identify a case. It is read and written as text, so that what was
computed in one session and what comes from the file in the next are the same characters.
"""

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from fiplib.reproduction import stored
from fiplib.reproduction.sources import csv_text
from fiplib.reproduction.stored import JournalError


def text(value: Any) -> str:
    """A value as it stands in a table: floats with nine significant digits, booleans as 0 or 1."""
    value = value.item() if hasattr(value, "item") else value  # a NumPy scalar
    if isinstance(value, float):
        return f"{value:.9g}"
    return str(int(value) if isinstance(value, bool) else value).replace("\n", " ")  # a row is a line


class Journal:
    """The finished rows of a study, in memory and on disk.

    Args:
        path: the complete table, a CSV file; rows gather beside it in ``.partial.csv`` until it is complete.
        keys: the columns that identify a row; they come first.
        fresh: forget the rows that are on disk.

    Raises:
        JournalError: a file that exists holds other columns, or is damaged beyond a torn last line.
    """

    def __init__(self, path: Path, keys: Sequence[str], fresh: bool = False) -> None:
        self.path, self.partial = path, path.with_suffix(".partial.csv")
        self.columns: list[str] = []
        self.rows: dict[tuple[str, ...], str] = {}
        self._keys = list(keys)
        self._begun = False
        for file in (self.path, self.partial):
            if fresh:
                file.unlink(missing_ok=True)
            self._read(file)

    def _read(self, file: Path) -> None:
        if not file.exists():
            return
        try:
            text = stored.content(file)
            if file == self.partial:
                text = "".join(text.rpartition("\n")[:2])  # without the line that a kill has torn
                if text.count("\n") < 2:
                    return
            rows = stored.parsed(text)
        except ValueError as error:
            raise JournalError(f"{file} is damaged ({error}): restore it, or start anew with --fresh") from error
        self._check(rows[0], file)
        self.rows.update({tuple(row[: len(self._keys)]): csv_text([row]) for row in rows[1:]})

    def _check(self, columns: list[str], source: object) -> None:
        expected = self.columns or [*self._keys, *columns[len(self._keys) :]]
        if columns != expected:
            raise JournalError(
                f"{source} has the columns {', '.join(columns)} where the study has {', '.join(expected)}; "
                f"--fresh starts {self.path} anew"
            )
        self.columns = columns

    def key(self, case: dict) -> tuple[str, ...]:
        """Return the key columns of a case, as text."""
        return tuple(text(case[name]) for name in self._keys)

    def append(self, case: dict, result: dict) -> None:
        """Keep a finished case; when this returns, it survives the death of the process.

        Raises:
            JournalError: the result has other columns than the rows before it.
        """
        self._check([*self._keys, *result], f"the result of case {named(case)}")
        key = self.key(case)
        self.rows[key] = csv_text([[*key, *map(text, result.values())]])
        self.partial.parent.mkdir(parents=True, exist_ok=True)
        with self.partial.open("ab+") as file:
            if not self._begun:
                file.seek(0)
                content = file.read()
                file.truncate(content.rfind(b"\n") + 1)  # without the line that a kill has torn
                if b"\n" not in content:
                    file.write(csv_text([self.columns]).encode())
                self._begun = True
            file.write(self.rows[key].encode())

    def complete(self, cases: Iterable[dict]) -> None:
        """Write the table with the rows of ``cases``, in this order, and no others; an unchanged file is left alone."""
        content = (csv_text([self.columns]) + "".join(self.rows[self.key(case)] for case in cases)).encode()
        if not self.path.exists() or self.path.read_bytes() != content:
            temporary = self.path.with_suffix(".new")
            temporary.write_bytes(content)
            os.replace(temporary, self.path)
            stored.record([self.path])
        self.partial.unlink(missing_ok=True)
        self._begun = False

    def holds(self, cases: Iterable[dict]) -> int:
        """Return how many of the cases it holds."""
        return sum(self.key(case) in self.rows for case in cases)


def named(case: dict) -> str:
    """A case in one line."""
    return " ".join(f"{name}={text(value)}" for name, value in case.items())
