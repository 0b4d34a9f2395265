"""Tables of a flight for other programs: CSV, Parquet, NPZ, or a pandas DataFrame.

Every column's name ends in its unit, as in ``x [m]``. Times are given twice: in s since the start of the flight, and as
the stamp in ns that the bag holds.
"""

import csv
import io
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from fiplib.params import NANO
from fiplib.recording import ROLES, BagError, Flight

if TYPE_CHECKING:
    import pandas

__all__ = ["FORMATS", "TABLES", "columns", "export", "to_dataframe"]

TABLES = {
    "states": "state",
    "poses": "",
    "estimates": "length",
    "commands": "command",
    "references": "reference",
    "truth": "truth_state",
}
"""The tables that can be written, and the role of the bag that each comes from; poses come from both bodies."""

_ROWS = 1 << 15  # rows of a CSV file that are made at once: Python's numbers take much more memory than NumPy's


def columns(flight: Flight, what: str = "states") -> dict[str, NDArray]:
    """Return the columns of a table by name, (n,) each.

    Poses are one row each, sorted by time, with the body's name in a column: two bodies need not share their stamps.

    Args:
        flight: as ``read`` gives it.
        what: a key of ``TABLES``.

    Raises:
        BagError: there is no such table, or the bag holds nothing of it.
    """
    if what not in TABLES:
        raise BagError(f"no such table {what!r}; tables are {', '.join(TABLES)}")
    if what == "poses":
        bodies = {body: getattr(flight, body) for body in ("vehicle", "pendulum")}
        stamp, received = (
            np.concatenate([getattr(b, name) for b in bodies.values()]) for name in ("stamp", "received")
        )
        rows = np.concatenate([np.hstack([b.position, b.orientation]) for b in bodies.values()])
        names = np.repeat(list(bodies), [len(b.stamp) for b in bodies.values()])
        order = np.argsort(stamp, kind="stable")
        stamp, rows = stamp[order], rows[order]
        extra = {"body": names[order], "received [ns]": received[order]}
        entry = ROLES["vehicle"]
        labels, units = entry.names, entry.units
    else:
        series = getattr(flight, TABLES[what])
        if series is None:
            topic = ROLES[TABLES[what]].topic
            raise BagError(f"{flight.path}: holds no {what} (topic {topic}); remap the topic, or choose another table")
        stamp, rows, labels, units, extra = series.stamp, series.values, series.names, series.units, {}
    table = {"time [s]": (stamp - flight.start_ns) / NANO, "stamp [ns]": stamp, **extra}
    return table | {f"{name} [{unit}]": rows[:, i] for i, (name, unit) in enumerate(zip(labels, units, strict=True))}


def to_dataframe(flight: Flight, what: str = "states") -> "pandas.DataFrame":
    """Return a table of a flight as a pandas DataFrame; see ``columns``. Needs the extra ``fip[tables]``."""
    import pandas

    return pandas.DataFrame(columns(flight, what))


def export(flight: Flight, file: Path, what: str = "states") -> str:
    """Write a table of a flight into a new CSV, Parquet or NPZ file, by its ending; return what was done, in words.

    Raises:
        BagError: the table is not there, the ending is another, or the file exists or cannot be written.
        ModuleNotFoundError: Parquet needs pandas and pyarrow.
    """
    if file.suffix.lower() not in FORMATS:
        raise BagError(f"{file}: the ending is none of {', '.join(FORMATS)}: choose one of them")
    table = columns(flight, what)
    if file.suffix.lower() == ".parquet":
        import pandas  # noqa: F401  both before the file is made
        import pyarrow  # noqa: F401
    try:
        stream = file.open("xb")
    except FileExistsError:
        raise BagError(f"{file}: exists already; choose another path") from None
    except OSError as error:
        raise BagError(f"{file}: cannot be written ({error.strerror})") from error
    try:
        with stream:
            FORMATS[file.suffix.lower()](table, stream)
    except BaseException as error:
        file.unlink(missing_ok=True)  # half a table helps nobody
        if isinstance(error, OSError):
            raise BagError(f"{file}: cannot be written ({error.strerror or error})") from error
        raise
    rows = len(table["time [s]"])
    lines = f"{'table':<10} {file}", f"{'from':<10} {flight.path} (unchanged)", f"{'holds':<10} {rows} {what}"
    return "\n".join([*lines, f"{'columns':<10} {', '.join(table)}"])


def _csv(table: Mapping[str, NDArray], stream: BinaryIO) -> None:
    text = io.TextIOWrapper(stream, encoding="utf-8", newline="", write_through=True)
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(table)
    for at in range(0, len(table["time [s]"]), _ROWS):
        part = [column[at : at + _ROWS].tolist() for column in table.values()]
        # shortest digits that give the same number back; what is not known is left empty
        writer.writerows([["" if value != value else value for value in row] for row in zip(*part, strict=True)])
    text.detach()


def _npz(table: Mapping[str, NDArray], stream: BinaryIO) -> None:
    arrays: dict[str, Any] = dict(table)
    np.savez_compressed(stream, **arrays)


def _parquet(table: Mapping[str, NDArray], stream: BinaryIO) -> None:
    import pandas

    pandas.DataFrame(table).to_parquet(stream, index=False)


FORMATS: dict[str, Callable[[Mapping[str, NDArray], BinaryIO], None]] = {
    ".csv": _csv,
    ".parquet": _parquet,
    ".npz": _npz,
}
"""Endings of files, and what writes them."""
