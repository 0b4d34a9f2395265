"""From the poses of two bodies to the measured rows of the filter."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from fiplib.estimators.poses.filter import DIRECTION, ROD, TILT, VEHICLE, Rows
from fiplib.estimators.poses.smoothing import parabolas
from fiplib.params import GRAVITY

HALF, RISE_HALF = 0.05, 0.15
"""Half-widths in s of the smoothing parabolas; the second one's is of the vertical acceleration."""


TURNED = 0.1, 1.0
"""A body's frame that leans by an angle between these, rad, on average is taken to be turned; the constants of the
model absorb a smaller angle, and a larger one cannot be distinguished from a wrong frame."""


class Body(NamedTuple):
    """One tracked body: ``time`` (n,) s; ``position`` (n, 3) m, ``axis`` (n, 3) its body z in the world, or None.

    Rows may come in any order; rows that are not finite are left out.
    """

    time: NDArray
    position: NDArray | None = None
    axis: NDArray | None = None

    def part(self, keep: slice | NDArray) -> "Body":
        """Return some of the poses."""
        return Body(*(None if column is None else column[keep] for column in self))


def checked(body: Body) -> Body:
    """Return the body with its columns as arrays of numbers. Raises ValueError: it is none, or of other shapes."""
    try:
        columns = [None if column is None else np.asarray(column, dtype=float) for column in body]
        time = columns[0]
        good = time is not None and time.ndim == 1 and len(columns) == 3
        good = good and all(column is None or column.shape == (len(time), 3) for column in columns[1:])
    except (TypeError, ValueError):
        good = False
    if not good:
        raise ValueError("a body takes a time (n,), and position and axis (n, 3) or None, all of them numbers")
    return Body(*columns)


def upright_axis(orientation: ArrayLike) -> tuple[NDArray, float]:
    """Return the axis (n, 3) of a body that points up on average, and the angle in rad from the body's z axis to it.

    Vehicle and rod are upright on average, however the frame of a body was drawn into its markers. The axis is z unless
    that leans by an angle within ``TURNED``. ``orientation`` are quaternions (n, 4) x, y, z, w; where one is not finite
    or zero, the axis is not finite.
    """
    orientation = np.asarray(orientation, dtype=float)
    good = np.isfinite(orientation).all(axis=1) & (np.abs(orientation).max(axis=1, initial=0.0) > 0.0)
    axis = np.full((len(orientation), 3), np.nan)
    if not np.any(good):
        return axis, 0.0
    rotation = Rotation.from_quat(orientation[good])
    up = rotation.apply([0.0, 0.0, 1.0], inverse=True).mean(axis=0)
    up /= np.linalg.norm(up)
    angle = float(np.arccos(np.clip(up[2], -1.0, 1.0)))
    turned = TURNED[0] < angle < TURNED[1]
    axis[good] = rotation.apply(up if turned else [0.0, 0.0, 1.0])
    return axis, angle if turned else 0.0


def cleaned(body: Body, name: str = "", notes: list[str] | None = None) -> Body:
    """Return the poses sorted by time, without those that are not finite or repeat a stamp; ``notes`` say so."""
    columns = [None if column is None else np.asarray(column, dtype=float) for column in body]
    time = columns[0]
    good = np.isfinite(time)
    for column in columns[1:]:
        if column is not None:
            good &= np.isfinite(column).all(axis=1)
    order = np.flatnonzero(good)[np.argsort(time[good], kind="stable")]
    fresh = np.diff(time[order], prepend=-np.inf) > 0.0
    if notes is not None:
        found = {
            "are not finite and were left out": int(np.sum(~good)),
            "were out of order and were sorted": int(np.sum(np.diff(time[good]) < 0.0)),
            "repeat the stamp of another one and were left out": int(np.sum(~fresh)),
        }
        notes += [f"{count} poses of the {name} {what}" for what, count in found.items() if count]
    return Body(*columns).part(order[fresh])


def without_jumps(vehicle: Body, rod: Body) -> tuple[Body, float]:
    """Return the rod without poses that lie elsewhere than the rod can be, and the distance of both bodies in m."""
    distances = np.linalg.norm(arm(vehicle, rod), axis=1)
    distance = float(np.median(distances))
    # the rod turns against the vehicle, so the distance changes a little; a lost body is far away
    good = np.abs(distances - distance) < 0.1 * distance + 0.02
    return rod.part(good), float(np.median(distances[good]))


def quantum(values: NDArray) -> float:
    """Return the step of a quantised signal (n,), 0 if it does not look quantised."""
    distinct = np.unique(np.round(values, 12))
    if len(distinct) > len(values) / 3:
        return 0.0
    return float(np.median(np.diff(distinct))) if len(distinct) > 1 else np.inf


def arm(vehicle: Body, rod: Body) -> NDArray:
    """Return the vector (n, 3) from the vehicle to the rod at the rod's stamps, m."""
    return rod.position - np.column_stack([np.interp(rod.time, vehicle.time, column) for column in vehicle.position.T])


def rows_of(vehicle: Body, rod: Body, origin: NDArray | None = None) -> Rows:
    """Return the rows of cleaned bodies; positions count from ``origin`` (3,), by default the vehicle's first one."""
    events = np.union1d(vehicle.time, rod.time)
    place = vehicle.position - (vehicle.position[0] if origin is None else origin)
    smooth = parabolas(vehicle.time, place, events, HALF)
    weight = GRAVITY + parabolas(vehicle.time, place[:, 2:], events, RISE_HALF)[2, :, 0]
    if vehicle.axis is None:
        thrust = smooth[2, :, :2]
    else:
        slope = vehicle.axis[:, :2] / vehicle.axis[:, 2:]
        thrust = weight[:, None] * parabolas(vehicle.time, slope, events, HALF)[0]
    if rod.axis is not None:
        lean = parabolas(rod.time, rod.axis[:, :2], events, HALF)
    else:
        lean = parabolas(rod.time, rod.position - vehicle.position[0] + place[0], events, HALF) - smooth
        lean = lean[:, :, :2] / np.linalg.norm(lean[0], axis=1)[:, None]
    # no parabola reaches across a gap: what is of second order is interpolated there
    for body, values in ((rod, lean), (vehicle, lean), (vehicle, thrust[None])):
        near = _near(body.time, events)
        for block in values:
            for column in block.T:
                column[~near] = np.interp(events[~near], events[near], column[near])
    upright = np.sqrt(np.maximum(1.0 - np.sum(lean[0] ** 2, axis=1), 0.0))
    pull = np.sqrt(np.sum(thrust**2, axis=1) + weight**2)
    second_order = (
        np.sum(lean[0] * thrust, axis=1) + upright * weight,
        np.sum(lean[1] ** 2, axis=1),
        pull,
        (1.0 - np.sum(thrust**2, axis=1) / pull**2) / pull,
    )
    parts: list[Part] = [(VEHICLE, vehicle.time, place[:, :2], None)]
    if vehicle.axis is not None:
        own = weight[np.searchsorted(events, vehicle.time)]
        parts.append((TILT, vehicle.time, own[:, None] * slope, own))
    if rod.position is not None:
        parts.append((ROD, rod.time, (rod.position - vehicle.position[0] + place[0])[:, :2], None))
    if rod.axis is not None:
        parts.append((DIRECTION, rod.time, rod.axis[:, :2], None))
    return sorted_rows(parts, events, second_order)


def _near(time: NDArray, events: NDArray) -> NDArray:
    """Return which events have a sample within 0.05 s, or two and a half periods, before and after, or lie on one."""
    gap = max(HALF, 2.5 * float(np.median(np.diff(time))))
    after = np.minimum(np.searchsorted(time, events), len(time) - 1)
    before = np.maximum(np.searchsorted(time, events, side="right") - 1, 0)
    return (np.abs(time[after] - events) <= gap) & (np.abs(events - time[before]) <= gap)


Part = tuple[int, NDArray, NDArray, NDArray | None]
"""Rows of one kind: the kind, times (n,), values (n, axes), and the factor (n,) on the kind's noise or None for 1."""


def sorted_rows(parts: list[Part], events: NDArray, second_order: Sequence[NDArray]) -> Rows:
    """Return rows of several kinds, sorted; lift, spin, pull and turn belong to the times ``events``."""
    time = np.concatenate([part[1] for part in parts])
    kind = np.concatenate([np.full(len(part[1]), part[0]) for part in parts])
    value = np.concatenate([part[2] for part in parts])
    scale = np.concatenate([np.ones(len(part[1])) if part[3] is None else part[3] for part in parts])
    tilts = [part[2] for part in parts if part[0] == TILT]
    tilt = np.concatenate([tilts[0] if tilts and part[0] == VEHICLE else np.zeros_like(part[2]) for part in parts])
    # the vehicle's row holds the tilt's value, which must then be in the past of its innovation
    order = np.lexsort((kind, kind != TILT, time))
    at = np.searchsorted(events, time[order])
    return Rows(time[order], kind[order], value[order], scale[order], *(one[at] for one in second_order), tilt[order])
