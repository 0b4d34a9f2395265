"""Motion capture in CSV files -> a bag of two bodies: exports of Motive and Vicon, or any columns by mapping.

Motive's layout is that of OptiTrack's documentation (Data Export: CSV). Vicon's is read only where its own names of
the columns leave no doubt, that is with quaternions: three angles may be Euler's or helical, and the file does not say.
"""

import csv
from array import array
from collections import defaultdict
from collections.abc import Iterator, Sequence
from itertools import chain, islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fiplib.bags import guards
from fiplib.bags.conventions import UNITS
from fiplib.bags.roles import BODIES, Place, two_bodies
from fiplib.bags.writer import BagRecorder
from fiplib.params import NANO
from fiplib.recording import BagError

POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
MAPPING = f"time=T,vehicle={','.join(POSE)},pendulum={','.join(POSE)}"

_HEADER_UNITS = {"meters": ("m", 1.0), "centimeters": ("cm", 1e-2), "millimeters": ("mm", 1e-3)}
_HEAD = 50  # rows in which the header is looked for
_RATES = (10.0, 10_000.0)  # Hz of any motion capture: outside, the times are not in seconds
_ROUNDED = 0.01  # by which the norm of a quaternion may differ from 1 where its digits are few

Row = tuple[int, list[str]]
"""A line's number in the file, from 1, and its cells."""


class Stated(NamedTuple):
    """The conventions of a file as stated by the caller; None where the file or a default decides."""

    columns: str | None = None
    """The meaning of the columns, as in ``MAPPING``; ``frame=`` in place of ``time=`` with a rate."""
    unit: str | None = None
    """The unit of positions: a key of ``UNITS``."""
    up: str | None = None
    """The axis that points up, "y" or "z"."""
    rate: float | None = None
    """The frame rate, Hz."""
    vehicle: str | None = None
    pendulum: str | None = None
    """Names of the bodies."""


NOTHING = Stated()


class _Layout(NamedTuple):
    """The places of the columns in a file, counted from 0."""

    kind: str
    first: int
    """The line after the header's last."""
    bodies: dict[str, tuple[int, ...]]
    """Columns of x, y, z, qx, qy, qz, qw, by the name of the body."""
    time: int | None = None
    frame: int | None = None
    rate: float | None = None
    unit: tuple[str, float] | None = None
    up: str | None = None
    ends_blank: bool = False
    """Whether an empty line ends the table."""


def from_csv(source: Path, bag: Path, stated: Stated = NOTHING) -> list[str]:
    """Write the poses of vehicle and pendulum into a new bag, of origin unknown; stamps are the file's times.

    Args:
        source: the CSV file; cells are separated by comma, semicolon or tab.
        bag: directory of the bag, which must not exist.
        stated: what the caller knows.

    Returns:
        What was read from the header, assumed and left out, a sentence each.

    Raises:
        BagError: the file cannot be read, or leaves something open; nothing is written then.
    """
    try:
        rows = _rows(source)
        head = list(islice(rows, _HEAD))
        layout = _layout(source, head, stated)
        lines, times, values = _numbers(source, layout, chain(head, rows))
    except (csv.Error, ValueError) as error:
        raise BagError(f"{source}: not a CSV file ({error})") from error
    notes = [f"the file is {layout.kind}, by its header" if stated.columns is None else f"the file is {layout.kind}"]
    stamps = _stamps(source, layout, stated, lines, times, values, notes)
    _convert_axes(source, layout, stated, values, notes)
    poses = dict(zip(layout.bodies, values, strict=True))
    roles = _roles(source, poses, stated, notes)
    kept = {role: _poses(source, role, lines, poses[name], notes) for role, name in roles.items()}
    with BagRecorder(bag, {"origin": "unknown", "converted": {"from": source.name, "assumed": notes}}) as recorder:
        for row, stamp in enumerate(stamps):
            for role, (there, found) in kept.items():
                if there[row]:
                    recorder.numbers(role, stamp, found[row].tolist(), stamp)
    return notes


def _rows(source: Path) -> Iterator[Row]:
    with source.open(newline="", encoding="utf-8-sig", errors="replace") as stream:
        start = stream.read(4096)
        stream.seek(0)
        reader = csv.reader(guards.lines(stream), delimiter=max(",;\t", key=start.count))
        for row in reader:
            yield reader.line_num, [cell.strip() for cell in row]


def _layout(source: Path, head: Sequence[Row], stated: Stated) -> _Layout:
    if stated.columns is not None:
        return _mapped(source, head, stated.columns)
    if head and head[0][1][:1] == ["Format Version"]:
        return _motive(source, head)
    if axes := next((at for at, (_, row) in enumerate(head) if row[:2] == ["Frame", "Sub Frame"]), None):
        return _vicon(source, head, axes)
    cells = next((", ".join(row) for _, row in head if any(row)), "nothing")
    raise BagError(
        f"{source}: not recognised as an export of Motive or Vicon; its first row holds {cells[:200]}: say which "
        f"column is what by --columns {MAPPING} (names in the header, or numbers from 1)"
    )


def _motive(source: Path, head: Sequence[Row]) -> _Layout:
    about = dict(zip(head[0][1][::2], head[0][1][1::2], strict=False))
    if (rotation := about.get("Rotation Type", "Quaternion")) != "Quaternion":
        raise BagError(f"{source}: row 1 says Rotation Type {rotation}: export it again with Rotation Type Quaternion")
    if (space := about.get("Coordinate Space", "Global")) != "Global":
        raise BagError(f"{source}: row 1 says Coordinate Space {space}: export it again with global coordinates")
    kinds = next((at for at, (_, row) in enumerate(head) if {"Rotation", "Position"} <= set(row)), None)
    types = next((at for at, (_, row) in enumerate(head) if "Rigid Body" in row), None)
    if kinds is None or types is None or not types + 1 < kinds < len(head) - 1:
        raise BagError(
            f"{source}: an export of Motive without rigid bodies: export it again with Rigid Bodies included"
        )
    found: defaultdict[str, dict[str, int]] = defaultdict(dict)
    columns = zip(head[types][1], head[types + 1][1], head[kinds][1], head[kinds + 1][1], strict=False)
    for column, (type_, name, kind, axis) in enumerate(columns):
        if type_ == "Rigid Body" and kind in ("Rotation", "Position"):
            found[name][("q" if kind == "Rotation" else "") + axis.lower()] = column
    bodies = {name: tuple(map(places.get, POSE)) for name, places in found.items()}
    if short := [name for name, places in bodies.items() if None in places]:
        raise BagError(f"{source}: rigid body {short[0]} lacks a column of its position or its rotation X, Y, Z, W")
    units = about.get("Length Units", "")
    unit = _HEADER_UNITS.get(units.lower())
    if units and unit is None:
        raise BagError(f"{source}: row 1 says Length Units {units}: export it again in metres or millimetres")
    first = head[kinds + 1][0] + 1
    return _Layout("an export of Motive", first, bodies, time=1, frame=0, unit=unit, up="y")


def _vicon(source: Path, head: Sequence[Row], axes: int) -> _Layout:
    line, names = head[axes]
    starts = [column for column, name in enumerate(names) if name == "RX"]
    quaternion = ("TX", "TY", "TZ", "RX", "RY", "RZ", "RW")
    bodies = {}
    for start, end in zip(starts, [*starts[1:], len(names)], strict=True):
        block = names[start:end]
        if not set(quaternion) <= set(block):
            raise BagError(
                f"{source}: row {line} names {', '.join(block)}, from which no orientation follows with certainty: "
                "export rotations as quaternions (RX, RY, RZ, RW)"
            )
        label = head[axes - 1][1][start] if start < len(head[axes - 1][1]) else ""
        name = label.removeprefix("Global Angle ").partition(":")[0] or f"column {start + 1}"
        bodies[name] = tuple(start + block.index(axis) for axis in quaternion)
    if not bodies:
        raise BagError(f"{source}: an export of Vicon without rotations: export objects, not trajectories of markers")
    rates = [row[0] for _, row in head[:axes] if row and _number(row[0]) and not any(row[1:])]
    rate = float(rates[0]) if rates else None
    units = head[axes + 1][1] if axes + 1 < len(head) else []
    places = [columns[0] for columns in bodies.values() if columns[0] < len(units)]
    unit = next(((units[place], UNITS[units[place]]) for place in places if units[place] in UNITS), None)
    first = line + 1 + (unit is not None)
    return _Layout("an export of Vicon", first, bodies, frame=0, rate=rate, unit=unit, ends_blank=True)


def _mapped(source: Path, head: Sequence[Row], mapping: str) -> _Layout:
    """Return the layout that ``--columns`` describes."""
    named: dict[str, list[str]] = {}
    key = ""
    for item in mapping.split(","):
        start, equals, rest = item.partition("=")
        if equals and start.strip() in ("time", "frame", *BODIES):
            key, item = start.strip(), rest
            named[key] = []
        if not key:
            raise BagError(f"{source}: --columns {mapping} must begin with what a column is, as in {MAPPING}")
        named[key].append(item.strip())
    for key, names in named.items():
        if len(names) != (wanted := len(POSE) if key in BODIES else 1):
            raise BagError(f"{source}: --columns names {len(names)} columns for {key}, which takes {wanted}: {MAPPING}")
    if missing := [body for body in BODIES if body not in named]:
        raise BagError(f"{source}: --columns does not name the columns of the {missing[0]}, as in {MAPPING}")
    wanted = {name for names in named.values() for name in names}
    line, header = max(head, key=lambda row: len(wanted & set(row[1])), default=(0, []))
    if absent := sorted(wanted - set(header)):
        if not all(name.isdecimal() and int(name) for name in wanted):
            cells = ", ".join(filter(None, header)) or "none"
            raise BagError(f"{source}: no column {absent[0]} in a header; row {line} has {cells[:300]}")
        line, places = 0, {name: int(name) - 1 for name in wanted}
    elif twice := [name for name in sorted(wanted) if header.count(name) > 1]:
        raise BagError(f"{source}: row {line} has several columns {twice[0]}: give --columns by numbers, from 1")
    else:
        places = {name: header.index(name) for name in wanted}
    columns = {key: tuple(places[name] for name in names) for key, names in named.items()}
    single = {key: columns[key][0] for key in ("time", "frame") if key in columns}
    inside = [(number, row) for number, row in head if number > line]
    key = next(iter(single.values()), columns["vehicle"][0])
    first = next((number for number, row in inside if key < len(row) and _number(row[key])), line + 1)
    return _Layout(f"a table with {mapping}", first, {body: columns[body] for body in BODIES}, **single)


def _number(cell: str) -> bool:
    try:
        return bool(np.isfinite(float(cell)))
    except ValueError:
        return False


def _numbers(source: Path, layout: _Layout, rows: Iterator[Row]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lines (n,), times and frame numbers (n, 2), poses (bodies, n, 7); NaN where a cell is empty or not there."""
    columns = [-1 if column is None else column for column in (layout.time, layout.frame)]
    columns += [column for places in layout.bodies.values() for column in places]
    lines, cells = array("q"), array("d")
    for line, row in rows:
        if line < layout.first:
            continue
        if not any(row):
            if layout.ends_blank:
                break
            continue
        picked = [row[column] if 0 <= column < len(row) else "" for column in columns]
        try:
            cells.extend([float(cell or "nan") for cell in picked])
        except ValueError:
            column, cell = next((c, p) for c, p in zip(columns, picked, strict=True) if not _readable(p))
            raise BagError(f"{source}: row {line}, column {column + 1}: {cell[:40]!r} is not a number") from None
        lines.append(line)
    if len(lines) < 2:
        raise BagError(f"{source}: no rows of numbers after the header")
    table = np.array(cells).reshape(len(lines), len(columns))
    poses = table[:, 2:].reshape(len(lines), len(layout.bodies), len(POSE))
    return np.array(lines), table[:, :2], poses.transpose(1, 0, 2).copy()


def _readable(cell: str) -> bool:
    try:
        float(cell or "nan")
    except ValueError:
        return False
    return True


def _stamps(
    source: Path,
    layout: _Layout,
    stated: Stated,
    lines: np.ndarray,
    times: np.ndarray,
    values: np.ndarray,
    notes: list[str],
) -> np.ndarray:
    """Return the time of each row in ns, from the time column, or from the rate and the frame numbers or rows."""
    rate = stated.rate if stated.rate is not None else layout.rate
    if stated.rate is None and layout.time is not None:
        seconds, words = times[:, 0], f"times are those of column {layout.time + 1}, in s"
    elif rate is None:
        raise BagError(f"{source}: neither a column of times nor a rate: say --rate HZ, or time=T within --columns")
    elif not 0 < rate < np.inf:
        raise BagError(f"{source}: a rate of {rate:g} Hz is not positive and finite: correct --rate")
    elif layout.frame is not None:
        seconds, words = (times[:, 1] - times[0, 1]) / rate, f"times are the frame numbers over {rate:g} Hz"
    else:
        seconds, words = np.arange(len(lines)) / rate, f"times are those of rows without a gap at {rate:g} Hz"
    if not (known := np.isfinite(seconds)).all():
        raise BagError(f"{source}: row {lines[np.argmin(known)]} has no time")
    if not (inside := (seconds >= 0) & (seconds < 2**31)).all():
        at = int(np.argmin(inside))
        raise BagError(f"{source}: row {lines[at]} has the time {seconds[at]:g} s: it must be in s, from 0 on")
    stamps = np.rint(seconds * NANO).astype(np.int64)
    step = np.diff(stamps)
    after, before = values[:, 1:], values[:, :-1]
    changed = ((after != before) & ~(np.isnan(after) & np.isnan(before))).any(axis=(0, 2))
    if (wrong := (step < 0) | ((step == 0) & changed)).any():
        raise BagError(
            f"{source}: the time of row {lines[1:][np.argmax(wrong)]} is not after that of the row before: sort the "
            "rows, or say --rate HZ if they are equally spaced"
        )
    if not np.any(step):
        raise BagError(f"{source}: all rows have the same time")
    median = NANO / float(np.median(step[step > 0]))
    if not _RATES[0] <= median <= _RATES[1]:
        raise BagError(f"{source}: its times give {median:.3g} frames per second: they must be in s; or say --rate HZ")
    notes.append(f"{words}: {len(lines)} rows in {(stamps[-1] - stamps[0]) / NANO:.2f} s, {median:.1f} Hz")
    return stamps


def _convert_axes(source: Path, layout: _Layout, stated: Stated, values: np.ndarray, notes: list[str]) -> None:
    """Metres, and z up for the world and the bodies, in place."""
    if stated.unit and layout.unit and stated.unit != layout.unit[0]:
        raise BagError(f"{source}: its header says {layout.unit[0]}, and --unit {stated.unit}: leave one out")
    unit, factor = layout.unit or (stated.unit or "m", UNITS[stated.unit or "m"])
    said = "as its header says" if layout.unit else "as stated" if stated.unit else "assumed; other: --unit mm"
    notes.append(f"positions are in {unit}, {said}")
    values[..., :3] *= factor
    up = stated.up or layout.up or "z"
    said = "as stated" if stated.up else f"assumed; other: --up {'z' if up == 'y' else 'y'}"
    turned = ": the world's frame and the bodies' are turned by 90 deg about x" if up == "y" else ""
    notes.append(f"{up} is up, {said}{turned}")
    if up == "y":  # a rotation by R turns the vector part of a quaternion as it turns a position
        for start in (0, 3):
            y, z = values[..., start + 1].copy(), values[..., start + 2].copy()
            values[..., start + 1], values[..., start + 2] = -z, y


def _roles(source: Path, poses: dict[str, np.ndarray], stated: Stated, notes: list[str]) -> dict[str, str]:
    """Return the body of each role."""
    if stated.columns is not None:
        if stated.vehicle is not None or stated.pendulum is not None:
            raise BagError(f"{source}: --columns says which body is what: leave --vehicle and --pendulum out")
        return {body: body for body in BODIES}
    roles = {role: name for role in BODIES if (name := getattr(stated, role)) is not None}
    for role, name in roles.items():
        if name not in poses:
            raise BagError(f"{source}: no body {name} ({role}); there are {', '.join(poses)}")
    heights = {}
    for name, pose in poses.items():
        known = pose[np.isfinite(pose[:, 2]), 2]
        if name not in roles.values() and len(known):
            heights[Place(name)] = float(known[0])
    missing = [role for role in BODIES if role not in roles]
    for role, (place, reason) in (two_bodies(heights, missing) if missing else {}).items():
        if role in missing:
            roles[role] = place.topic
            notes.append(f"{place} is taken for the {role}, {reason}; another: --{role} NAME")
    if len(set(roles.values())) < len(BODIES):
        raise BagError(
            f"{source}: which body is the vehicle and which is the rod? There are {', '.join(poses)}: "
            "say --vehicle NAME --pendulum NAME"
        )
    return roles


def _poses(
    source: Path, role: str, lines: np.ndarray, values: np.ndarray, notes: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Return whether a body has a pose in each row (n,), and the poses (n, 7) with unit quaternions."""
    there = np.isfinite(values).all(axis=1) & values[:, 3:].any(axis=1)
    if not there.any():
        raise BagError(f"{source}: the {role} has no pose in any row")
    if lost := len(there) - int(there.sum()):
        notes.append(f"{role}: {lost} of {len(there)} rows hold no pose: they are left out")
    norm = np.where(there, np.linalg.norm(values[:, 3:], axis=1), 1.0)
    if (off := np.abs(norm - 1.0) > _ROUNDED).any():
        at = int(np.argmax(off))
        raise BagError(
            f"{source}: row {lines[at]}: the quaternion of the {role} has norm {norm[at]:.4g}, not 1: are its "
            "columns those of x, y, z, w?"
        )
    values[:, 3:] /= norm[:, None]
    return there, values
