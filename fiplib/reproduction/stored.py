"""Tables on disk, read with every check, and the checksums of ``data/``: damage is one sentence, never a number.

``data/SHA256SUMS`` lists bags and tables alike, as ``sha256sum`` writes it. The writer of such a file records it
there: a finished table by itself, ``make bags`` by ``python -m fiplib.reproduction.stored FILE...``.
"""

import csv
import hashlib
import io
import os
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NoReturn

from fiplib.params import FipError

SUMS = "SHA256SUMS"
LARGEST = 1 << 28
"""Bytes of a table; a larger file is none."""


class JournalError(FipError):
    """A damaged table on disk."""


class Row(dict):
    """A row of a table, by column; a column that the table lacks is named with its file, not by a KeyError alone."""

    def __init__(self, cells: Iterable[tuple[str, Any]], path: Path, again: str) -> None:
        super().__init__(cells)
        self._path, self._again = path, again

    def __missing__(self, column: str) -> NoReturn:
        raise JournalError(f"{self._path} lacks the column {column!r}: make it again with: {self._again}")


def rows(path: Path, again: str) -> list[dict[str, str]]:
    """Return the rows of a finished table as text by column; empty if there is no such file.

    Args:
        path: a CSV file.
        again: the command that makes it again.

    Raises:
        JournalError: the file cannot be read, is not as its checksum says, or not a table whose rows are all complete.
    """
    if not os.path.lexists(path):
        return []
    try:
        header, *lines = parsed(content(path))
    except ValueError as error:
        raise JournalError(f"{path} is damaged ({error}): restore it, or make it again with: {again}") from error
    return [Row(zip(header, line, strict=True), path, again) for line in lines]


def content(path: Path) -> str:
    """Return the text of a table. Raises ValueError, which says why: it cannot be read, or its checksum differs."""
    if not path.is_file():  # a device or a pipe may never end
        raise ValueError("not a regular file")
    if path.stat().st_size > LARGEST:
        raise ValueError(f"{path.stat().st_size} bytes")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ValueError(error.strerror or "unreadable") from error
    folder = sums_of(path)
    if folder is not None:
        wanted = recorded(folder).get(path.resolve().relative_to(folder.resolve()).as_posix())
        if wanted not in (None, hashlib.sha256(data).hexdigest()):
            raise ValueError(f"its checksum is not the one in {folder / SUMS}")
    try:
        return data.decode()
    except UnicodeDecodeError:
        raise ValueError("not text in UTF-8") from None


def parsed(text: str) -> list[list[str]]:
    """Return the cells of a table, its header first. Raises ValueError with what is wrong with it."""
    if not text:
        raise ValueError("empty")
    if not text.endswith("\n"):
        raise ValueError("its last line is cut")
    if any(ord(letter) < 32 and letter not in "\r\n" for letter in text):
        raise ValueError("control characters")
    try:
        lines = list(csv.reader(io.StringIO(text), strict=True))
    except csv.Error as error:
        raise ValueError(f"no CSV: {error}") from None
    header = lines[0]
    if not all(header) or len(set(header)) < len(header):
        raise ValueError("its header does not name every column once")
    if len(lines) < 2:
        raise ValueError("no rows")
    if wrong := next((at for at, line in enumerate(lines, 1) if len(line) != len(header)), None):
        raise ValueError(f"row {wrong} has not {len(header)} cells")
    return lines


def numbers(path: Path, again: str) -> list[dict[str, float | str]]:
    """Return the rows of a finished table, numbers as float; a column holds numbers only, or words only.

    Raises JournalError as ``rows``, and for a column that holds both.
    """
    table = rows(path, again)
    found: dict[str, Sequence[float | str]] = {}
    for column in table[0] if table else ():
        cells = [row[column] for row in table]
        values = [_number(cell) for cell in cells]
        if None not in values:
            found[column] = values
        elif any(value is not None for value in values):
            wrong = next(at for at, value in enumerate(values) if value is None)
            raise JournalError(
                f"{path} is damaged (row {wrong + 2} of column {column} holds {cells[wrong][:40]!r}, others numbers): "
                f"restore it, or make it again with: {again}"
            )
        else:
            found[column] = cells
    return [Row(((column, found[column][at]) for column in found), path, again) for at in range(len(table))]


def _number(cell: str) -> float | None:
    try:
        return float(cell)
    except ValueError:
        return None


def recorded(folder: Path) -> dict[str, str]:
    """Return the checksums in the file ``SHA256SUMS`` of a folder, by name relative to it."""
    lines = (folder / SUMS).read_text(encoding="utf-8", errors="replace").splitlines()
    return {name: digest for digest, _, name in (line.partition("  ") for line in lines)}


def sums_of(path: Path) -> Path | None:
    """Return the folder whose ``SHA256SUMS`` may list a file: its own or the one above it; None if neither has one."""
    parents = path.resolve().parents[:2]
    return next((folder for folder in parents if (folder / SUMS).is_file()), None)


def record(paths: Iterable[Path]) -> None:
    """Write the checksums of files that were just made into the ``SHA256SUMS`` of their folder, if it has one."""
    for path in paths:
        folder = sums_of(path)
        if folder is not None:
            name = path.resolve().relative_to(folder.resolve()).as_posix()
            known = recorded(folder) | {name: hashlib.sha256(path.read_bytes()).hexdigest()}
            new = folder / f"{SUMS}.new"
            new.write_text("".join(f"{known[name]}  {name}\n" for name in sorted(known)), encoding="utf-8")
            os.replace(new, folder / SUMS)


if __name__ == "__main__":
    record(map(Path, sys.argv[1:]))
