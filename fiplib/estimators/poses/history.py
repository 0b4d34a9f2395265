"""The length over a flight: window by window, and from its beginning up to later and later times."""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy  # its parts are imported when they are first used

from fiplib.estimators.poses.estimate import PoseEstimate, length_of
from fiplib.estimators.poses.knowledge import Knowledge
from fiplib.params import NANO
from fiplib.recording import Flight, Poses, Series

SHORTEST = 2.5
"""Shortest stretch that is estimated, s: the window of the estimators that fly."""
MOST_WINDOWS = 24
"""Windows of a flight at most: what does not fit into a figure is not computed."""
GROWTH = 1.5
"""Ratio of the lengths of two successive stretches from the beginning; all of them take three times the last one."""


PARTS = 6
"""Parts of a flight at most whose answers are compared with each other."""
BY_CHANCE = 1e-3
"""Probability of a scatter between parts (chi-square) below which it is not taken for chance."""


class Stretch(NamedTuple):
    """What a part of a flight says: ``start`` and ``end`` in s since the start of the flight."""

    start: float
    end: float
    found: PoseEstimate


def length_of_flight(flight: Flight, knowledge: Knowledge) -> PoseEstimate:
    """Return the length from a whole flight, unless its parts contradict each other: the rod or its point changed.

    A part that gives no answer says nothing here.
    """
    found = length_of(flight, knowledge)
    if found.reason is not None:
        return found
    parts = [part.found for part in windows(flight, knowledge, PARTS) if part.found.reason is None]
    lengths, deviations = np.array([(part.length, part.standard_deviation) for part in parts]).reshape(-1, 2).T
    mean = np.average(lengths, weights=deviations**-2) if len(parts) else 0.0
    scatter = float(np.sum(((lengths - mean) / deviations) ** 2))
    if len(parts) < 2 or scipy.special.chdtrc(len(parts) - 1, scatter) >= BY_CHANCE:
        return found
    reason = (
        f"the parts of the flight contradict each other beyond chance: they give lengths from {lengths.min():.3f} to "
        f"{lengths.max():.3f} m; was the rod, or a tracked point, changed in flight? Cut the bag to where it was not"
    )
    return replace(found, reason=reason, length=np.nan, standard_deviation=np.nan, interval=(np.nan, np.nan))


def windows(flight: Flight, knowledge: Knowledge, most: int = MOST_WINDOWS) -> Iterator[Stretch]:
    """Estimate windows of equal length that follow each other: their answers are independent."""
    count = max(1, min(most, int(flight.duration / SHORTEST)))
    seconds = flight.duration / count
    for index in range(count):
        yield between(flight, index * seconds, (index + 1) * seconds, knowledge)


def growing(flight: Flight, knowledge: Knowledge) -> Iterator[Stretch]:
    """Estimate longer and longer stretches from the beginning of the flight; the last is the whole flight."""
    end = SHORTEST
    while end * GROWTH**0.5 < flight.duration:
        yield between(flight, 0.0, end, knowledge)
        end *= GROWTH
    yield Stretch(0.0, flight.duration, length_of_flight(flight, knowledge))


def estimated(flight: Flight) -> bool:
    """Return whether an estimator gave lengths in flight, and they were recorded."""
    return flight.length is not None and bool(np.isfinite(flight.length.column("estimate")).any())


def series_of(flight: Flight, stretches: Iterator[Stretch]) -> Series:
    """Return the estimates at the ends of stretches as the signal that a flight with an estimator records.

    Nothing was used by a controller: that column is NaN; so is an estimate that was refused.
    """
    found = list(stretches)
    stamp = np.array([flight.start_ns + round(NANO * stretch.end) for stretch in found], np.int64)
    rows = [(np.nan, stretch.found.length, stretch.found.standard_deviation) for stretch in found]
    return Series.of("length", stamp, np.array(rows, dtype=float).reshape(-1, 3))


def between(flight: Flight, start: float, end: float, knowledge: Knowledge) -> Stretch:
    """Estimate what lies between two times in s since the start of the flight."""
    bodies = {body: _part(flight, getattr(flight, body), start, end) for body in ("vehicle", "pendulum")}
    return Stretch(start, end, length_of(replace(flight, **bodies), knowledge))


def _part(flight: Flight, body: Poses, start: float, end: float) -> Poses:
    time = flight.time(body)
    keep = (time >= start) & (time <= end)
    return Poses(body.stamp[keep], body.received[keep], body.position[keep], body.orientation[keep])
