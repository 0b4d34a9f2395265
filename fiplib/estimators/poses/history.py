"""The length of a recorded flight: from the whole of it, from windows, and how its interval shrank."""

import math
from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import scipy  # its parts are imported when they are first used
from numpy.typing import NDArray

from fiplib.estimators.checks import why_no_length
from fiplib.estimators.poses.estimate import PoseEstimate, answer, bodies_of, estimate, solved
from fiplib.estimators.poses.fit import Value
from fiplib.estimators.poses.knowledge import Knowledge
from fiplib.estimators.poses.rows import Body
from fiplib.estimators.poses.stream import Running
from fiplib.params import NANO
from fiplib.recording import Flight, Series

FIRST = 1.0
"""Seconds from the first pose after which a history begins."""
POINTS = 60
"""Points of a history."""
SHORTEST = 2.5
"""Shortest stretch that is estimated, s: the window of the estimators that fly."""
MOST_WINDOWS = 24
"""Windows of a flight at most: what does not fit into a figure is not computed."""


PARTS = 6
"""Parts of a flight whose answers are compared with each other: at most, unless it is longer than ``LONGEST``."""
BY_CHANCE = 1e-3
"""Probability of a scatter between parts (chi-square) below which it is not taken for chance."""
LONGEST = 600.0
"""A flight of more seconds is estimated from its parts alone, each of at most half of that: it bounds the memory."""


NONE = np.zeros((3, 0))
"""The times, lengths and deviations of a history that is empty."""


Advance = Callable[[int], object]
"""Called before each part with the number of parts that are left to do, and with 0 at the end."""


def _unseen(left: int) -> None:
    """Show no progress."""


class Stretch(NamedTuple):
    """The estimate from a part of a flight: ``start`` and ``end`` in s since the start of the flight."""

    start: float
    end: float
    found: PoseEstimate


class History(NamedTuple):
    """An answer, and what it was before all poses were in: seconds from the first pose (n,), lengths and their
    standard deviations (n,), m. The arrays are empty if the answer was refused before there was a maximum."""

    answer: PoseEstimate
    time: NDArray
    length: NDArray
    standard_deviation: NDArray


def history(vehicle: Body, rod: Body, knowledge: Knowledge | None = None, points: int = POINTS) -> History:
    """Return the length of a flight of any duration, and how its interval shrank; see ``estimate``.

    The earlier lengths are each one Newton step from the maximum for the whole flight. Their times are spaced evenly in
    logarithm. What the answer's deviation holds for a rod that may not be uniform is part of theirs.
    """
    answer, problem, fit = solved(vehicle, rod, knowledge)
    if problem is None or fit is None:
        return History(answer, *NONE)
    rows = problem.rows
    doubt = max(answer.standard_deviation**2 - fit.length.deviation**2, 0.0) if answer.reason is None else 0.0
    running, first = Running(fit, rows.time[0], rows.value.shape[1]), 0
    times, found = np.geomspace(FIRST, max(rows.time[-1] - rows.time[0], 2.0 * FIRST), points), []
    for last in np.searchsorted(rows.time, rows.time[0] + times, side="right"):
        running.add(rows.part(slice(first, last)))
        length, deviation = running.length
        found.append((length, math.sqrt(deviation**2 + doubt)))
        first = last
    return History(answer, times, *np.array(found).T)


def length_of_flight(flight: Flight, knowledge: Knowledge, points: int = 0, advance: Advance = _unseen) -> History:
    """Return the length of a flight of any duration, unless its parts contradict each other, and its history.

    The parts contradict each other where the rod, or a tracked point, was changed. Of a flight that is not longer than
    ``LONGEST`` the length is that of ``estimate``, and a part that gives no answer says nothing. Of a longer one it is
    the mean of the parts, weighted by their variances. What was assumed is the same for all parts, so that their errors
    may be, too: the mean is only taken to be as exact as its parts are.

    Args:
        flight: with the two bodies.
        knowledge: priors.
        points: how many points of the history are wanted, its times counted from the start of the flight; of a long
            flight this is the number within its first part, and each later part adds one.
        advance: called as the work goes on, see ``Advance``.
    """
    if reason := why_no_length(flight):
        return History(PoseEstimate(reason=reason), *NONE)
    vehicle, rod, notes = bodies_of(flight)
    start, end = _span(vehicle, rod)
    if end - start > LONGEST:
        found = _of_parts(vehicle, rod, knowledge, points, advance)
    else:
        found = (
            history(vehicle, rod, knowledge, points) if points else History(estimate(vehicle, rod, knowledge), *NONE)
        )
        found = found._replace(time=found.time + min(vehicle.time[0], rod.time[0]))
        if found.answer.reason is None:
            count = max(1, min(PARTS, int((end - start) / SHORTEST)))
            parts = list(_estimated(vehicle, rod, knowledge, count, advance))
            found = found._replace(answer=_consistent(found.answer, parts))
    return found._replace(answer=replace(found.answer, notes=(*notes, *found.answer.notes)))


def _history(vehicle: Body, rod: Body, knowledge: Knowledge, points: int) -> History:
    """Return a history whose times are those of the bodies."""
    found = history(vehicle, rod, knowledge, points)
    return found._replace(time=found.time + _span(vehicle, rod)[0])


def _of_parts(vehicle: Body, rod: Body, knowledge: Knowledge, points: int, advance: Advance) -> History:
    """Estimate a flight from its parts alone; see ``length_of_flight``."""
    start, end = _span(vehicle, rod)
    count, parts, curves = max(PARTS, math.ceil(2.0 * (end - start) / LONGEST)), list[Stretch](), []
    if points:
        first = _between(vehicle, rod, start, start + (end - start) / count)
        curves.append(np.array(_history(*first, knowledge, points)[1:]))
    for part in _estimated(vehicle, rod, knowledge, count, advance):
        parts.append(part)
        if part.found.reason is not None:
            reason = f"from {part.start:.1f} to {part.end:.1f} s: {part.found.reason}"
            return History(replace(part.found, reason=reason), *NONE)
        if points and len(parts) > 1:
            mean = _mean(parts)
            curves.append(np.array([[part.end], [mean.length], [mean.standard_deviation]]))
    return History(_consistent(_mean(parts), parts), *(np.concatenate(curves, axis=1) if points else NONE))


def windows(
    flight: Flight, knowledge: Knowledge, most: int = MOST_WINDOWS, advance: Advance = _unseen
) -> Iterator[Stretch]:
    """Estimate windows of equal length that follow each other, where both bodies were tracked.

    Their answers are independent. A flight that is refused as a whole is one window.
    """
    if reason := why_no_length(flight):
        return iter([Stretch(0.0, flight.duration, PoseEstimate(reason=reason))])
    vehicle, rod, _ = bodies_of(flight)
    start, end = _span(vehicle, rod)
    return _estimated(vehicle, rod, knowledge, max(1, min(most, int((end - start) / SHORTEST))), advance)


def between(flight: Flight, start: float, end: float, knowledge: Knowledge) -> Stretch:
    """Estimate what lies between two times in s since the start of the flight."""
    if reason := why_no_length(flight):
        return Stretch(start, end, PoseEstimate(reason=reason))
    vehicle, rod, _ = bodies_of(flight)
    return Stretch(start, end, estimate(*_between(vehicle, rod, start, end), knowledge))


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


def _consistent(found: PoseEstimate, parts: list[Stretch]) -> PoseEstimate:
    """Return the answer, refused if the parts of the flight cannot be of one rod."""
    given = [part.found for part in parts if part.found.reason is None]
    if len(given) < 2:
        return found
    lengths, deviations = np.array([(one.length, one.standard_deviation) for one in given]).T
    mean = np.average(lengths, weights=deviations**-2)
    scatter = float(np.sum(((lengths - mean) / deviations) ** 2))
    if scipy.special.chdtrc(len(given) - 1, scatter) >= BY_CHANCE:
        return found
    reason = (
        f"the parts of the flight contradict each other beyond chance: they give lengths from {lengths.min():.3f} to "
        f"{lengths.max():.3f} m; was the rod, or a tracked point, changed in flight? Cut the bag to where it was not"
    )
    return replace(found, reason=reason, length=np.nan, standard_deviation=np.nan, interval=(np.nan, np.nan))


def _mean(parts: list[Stretch]) -> PoseEstimate:
    """Return the answer of parts of equal duration that all gave one."""
    given = [part.found for part in parts]
    weights = np.array([one.standard_deviation**-2 for one in given])
    weights /= weights.sum()

    def mean(values: list[float]) -> float:
        return float(weights @ np.array(values, dtype=float))

    found = given[0]
    names = [field.name for field in fields(found) if isinstance(getattr(found, field.name), Value)]
    values = {name: Value(*(mean([getattr(one, name)[at] for one in given]) for at in (0, 1))) for name in names}
    note = (
        f"the flight was estimated in {len(given)} parts of {parts[0].end - parts[0].start:.0f} s: the length is their "
        "mean, and its standard deviation is not divided by the root of their number"
    )
    return replace(
        found,
        **values,
        **answer(mean([one.length for one in given]), mean([one.standard_deviation for one in given])),
        noise={name: mean([one.noise[name] for one in given]) for name in found.noise},
        whiteness={name: max(one.whiteness[name] for one in given) for name in found.whiteness},
        notes=(note, *dict.fromkeys(text for one in given for text in one.notes)),
    )


def _estimated(
    vehicle: Body, rod: Body, knowledge: Knowledge, count: int, advance: Advance = _unseen
) -> Iterator[Stretch]:
    """Estimate a flight in parts of equal duration."""
    first, last = _span(vehicle, rod)
    edges = np.linspace(first, last, count + 1).tolist()
    for index, (start, end) in enumerate(pairwise(edges)):
        advance(count - index)
        yield Stretch(start, end, estimate(*_between(vehicle, rod, start, end), knowledge))
    advance(0)


def _span(vehicle: Body, rod: Body) -> tuple[float, float]:
    """Return when the first and the last pose was taken, s: a flight may last longer than a body was tracked."""
    time = np.concatenate([vehicle.time, rod.time])
    return (float(time.min()), float(time.max())) if len(time) else (0.0, 0.0)


def _between(vehicle: Body, rod: Body, start: float, end: float) -> tuple[Body, Body]:
    """Return the poses from one time to another, both included."""
    first, second = (body.part((body.time >= start) & (body.time <= end)) for body in (vehicle, rod))
    return first, second
