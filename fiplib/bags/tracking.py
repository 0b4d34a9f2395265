"""Invalid poses: repeated, mistracked, or beyond a gap that nothing bridges."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fiplib.bags.motion import arm, distance_of
from fiplib.params import NANO
from fiplib.recording import Flight, Poses

LONGEST_GAP = 1.2
"""Longer than this, s, no motion bridges a gap of either body: a rod falls in less."""

_MEDIAN = 9  # poses of which the median is taken, against which a mistracked one stands out


class Lost(NamedTuple):
    """The poses of one body that are left out, (n,) bool each, and the stretch that is used."""

    repeated: NDArray
    """In every digit as the one before: no new measurement."""
    stray: NDArray
    """Far from those around it."""
    beyond: NDArray
    """Outside the longest stretch in which no body is lost for longer than ``LONGEST_GAP``."""

    @property
    def any(self) -> NDArray:
        """All that is left out."""
        return self.repeated | self.stray | self.beyond


def lost(flight: Flight) -> tuple[Lost, Lost]:
    """Return what is left out of the vehicle's and of the rod's poses."""
    bodies = flight.vehicle, flight.pendulum
    distance = distance_of(arm(*bodies))
    found = []
    for poses in bodies:
        repeated = np.zeros(len(poses.stamp), bool)
        repeated[1:] = (np.diff(poses.position, axis=0) == 0.0).all(axis=1)
        repeated[1:] &= (np.diff(poses.orientation, axis=0) == 0.0).all(axis=1)
        stray = np.zeros(len(poses.stamp), bool)
        if (fresh := np.flatnonzero(~repeated)).size > _MEDIAN:
            stray[fresh] = _stray(poses.position[fresh], distance)
        found.append((repeated, stray))
    first, last = _stretch([poses.stamp[~(a | b)] for poses, (a, b) in zip(bodies, found, strict=True)])
    outside = [(poses.stamp < first) | (poses.stamp > last) for poses in bodies]
    vehicle, rod = (Lost(*pair, beyond) for pair, beyond in zip(found, outside, strict=True))
    return vehicle, rod


def tracked(flight: Flight) -> Flight:
    """Return the flight without its invalid poses; the flight itself if there are none."""
    if min(len(flight.vehicle.stamp), len(flight.pendulum.stamp)) < 2:
        return flight
    vehicle, rod = (one.any for one in lost(flight))
    if not (vehicle.any() or rod.any()) or vehicle.all() or rod.all():
        return flight
    return replace(flight, vehicle=_part(flight.vehicle, ~vehicle), pendulum=_part(flight.pendulum, ~rod))


def _stray(position: NDArray, distance: float) -> NDArray:
    windows = np.lib.stride_tricks.sliding_window_view(
        np.pad(position, ((_MEDIAN // 2, _MEDIAN // 2), (0, 0)), mode="edge"), _MEDIAN, axis=0
    )
    size = float(np.max(np.subtract(*np.quantile(position, [0.95, 0.05], axis=0))))
    scale = max(distance, size) if np.isfinite(distance) else size
    return np.linalg.norm(position - np.median(windows, axis=2), axis=1) > 0.3 * scale


def _stretch(stamps: list[NDArray]) -> tuple[int, int]:
    """Return the longest time in which no body has a gap, from stamp to stamp in ns."""
    if not all(len(stamp) for stamp in stamps):
        return 0, 0
    start, end = max(int(stamp[0]) for stamp in stamps), min(int(stamp[-1]) for stamp in stamps)
    gaps = []
    for stamp in stamps:
        wide = np.flatnonzero(np.diff(stamp) > LONGEST_GAP * NANO)
        gaps += [(int(stamp[i]), int(stamp[i + 1])) for i in wide]
    if not gaps:  # a little of one body alone, before or after the other, does no harm
        first, last = min(int(stamp[0]) for stamp in stamps), max(int(stamp[-1]) for stamp in stamps)
        few = LONGEST_GAP * NANO
        return (first if start - first < few else start), (last if last - end < few else end)
    best = start, start
    for gap in [*sorted(gaps), (end, end)]:
        if gap[0] - start > best[1] - best[0]:
            best = start, gap[0]
        start = max(start, gap[1])
    return best


def _part(poses: Poses, keep: NDArray) -> Poses:
    return Poses(*(array[keep] for array in (poses.stamp, poses.received, poses.position, poses.orientation)))
