"""Measures of a recorded flight: leans, laps, settling, convergence, changes of the length.

All is measured on what the controller saw (``/fip/state``, ``/fip/reference``, ``/fip/length``), as the paper did, and
never on a simulator's truth: the bag of a real vehicle goes through unchanged. ``quantities`` makes the ledger's
numbers of these.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import bdtr, betaincinv

from fiplib.params import A, B, X, Y
from fiplib.recording import TOPICS, BagError, Flight

FALL_ANGLE = math.radians(30.0)
"""A rod that leans further has fallen: only to hold it there, the vehicle itself would have to tilt as far."""

FINAL_SECONDS = 5.0
"""The final length of a flight is the median over its last seconds: single runs of the estimator scatter."""

CONVERGED = 0.05
"""Band in m about the final length within which an estimate counts as converged: the usual 5 %, of a 1 m rod."""


def need(flight: Flight, *roles: str) -> None:
    """Raise BagError if the flight does not hold a topic, or a single message of it; the sentence says which."""
    for role in roles:
        if (series := getattr(flight, role)) is None or len(series.stamp) < 2:
            count = "no topic" if series is None else "one message only on"
            raise BagError(f"{flight.path}: {count} {TOPICS[role]} ({role}), which this is read from")


def states(flight: Flight) -> NDArray:
    """The states that the controller used, (n, 10). Raises BagError if its references are not there beside them."""
    need(flight, "state", "reference")
    if not np.array_equal(flight.state.stamp, flight.reference.stamp):
        raise BagError(f"{flight.path}: its states and references do not have the same stamps, one for one")
    return flight.state.values


class Circling(NamedTuple):
    """The circle that a bag's metadata name as the reference: m, m, s."""

    radius: float
    height: float
    period: float


def circling(flight: Flight) -> Circling:
    """Return the circle that the bag's metadata name. Raises BagError if they name none."""
    try:
        return Circling(*(float(flight.metadata["reference"][name]) for name in Circling._fields))
    except (KeyError, TypeError, ValueError):
        names = ", ".join(Circling._fields)
        raise BagError(f"{flight.path}: its metadata name no circle as the reference ({names})") from None


def lean(flight: Flight) -> NDArray:
    """max(|a|, |b|) of every recorded state, (n,) m."""
    return np.abs(states(flight)[:, [A, B]]).max(axis=1)


def tracking_error(flight: Flight) -> NDArray:
    """x - x_ref and y - y_ref of every recorded state, (n, 2) m."""
    return (states(flight) - flight.reference.values)[:, [X, Y]]


def angle(offset: float, flight: Flight) -> float:
    """Angle in deg of the flight's rod when its COM lies ``offset`` m beside its seat: asin(offset / (l/2))."""
    return math.degrees(math.asin(min(1.0, 2 * offset / flight.params.pendulum.length)))


def fall_time(flight: Flight) -> float:
    """Time in s at which the rod first leans beyond ``FALL_ANGLE``; inf if it never does."""
    offset = np.hypot(*states(flight)[:, [A, B]].T)
    fallen = offset > flight.params.pendulum.length / 2 * math.sin(FALL_ANGLE)
    return float(flight.time(flight.state)[fallen.argmax()]) if fallen.any() else math.inf


def push_times(flight: Flight) -> list[float]:
    """Times in s of the pushes that were recorded. Raises BagError if there are none."""
    times = [flight.time(event) for event in flight.events if event.kind == "push"]
    if not times:
        raise BagError(f"{flight.path}: no push is recorded on {TOPICS['events']}: when was it pushed?")
    return times


def settling_time(time: NDArray, outside: NDArray) -> float:
    """First of the times (n,) from which on ``outside`` (n,) is never true; inf if it is true at the end."""
    first = np.flatnonzero(outside)[-1] + 1 if outside.any() else 0
    return float(time[first]) if first < len(time) else math.inf


class Laps(NamedTuple):
    """A circular reference: ``mask`` (n,) of its last whole laps at full speed, ``phase`` (n,) rad turned since the
    start, ``period`` s, ``radius`` m."""

    mask: NDArray
    phase: NDArray
    period: float
    radius: float


def laps(flight: Flight) -> Laps:
    """Read from the recorded reference alone. Raises BagError if it holds no whole lap."""
    states(flight)
    path, time = flight.reference.values[:, [X, Y]], flight.time(flight.reference)
    if not path.any():
        raise BagError(f"{flight.path}: its reference makes no whole circle at full speed")
    turned = np.unwrap(np.arctan2(path[:, 1], path[:, 0]))
    rate = np.gradient(turned, time)
    period = float(2 * math.pi / abs(rate[-1])) if rate[-1] else math.inf
    steady = settling_time(time, np.abs(rate - rate[-1]) > 0.01 * abs(rate[-1]))  # speeding up ends smoothly: 1 %
    count = math.floor((time[-1] - steady) / period)
    if count < 1:
        raise BagError(f"{flight.path}: its reference makes no whole circle at full speed")
    phase = (turned - turned[0]) * np.sign(rate[-1])
    return Laps(time > time[-1] - count * period, phase, period, float(np.hypot(*path[-1])))


def x_response(flight: Flight) -> tuple[float, float]:
    """Amplitude of x over that of its reference, and its delay in s, at the circle's frequency over its last laps."""
    lap, x, reference = laps(flight), states(flight)[:, X], flight.reference.values[:, X]
    basis = np.stack([f(lap.phase[lap.mask]) for f in (np.cos, np.sin, np.ones_like)], axis=1)
    ours, theirs = (
        complex(*np.linalg.lstsq(basis, signal[lap.mask], rcond=None)[0][:2].tolist()) for signal in (x, reference)
    )
    response = ours / theirs
    return abs(response), math.atan2(response.imag, response.real) * lap.period / (2 * math.pi)


def used_length(flight: Flight) -> tuple[NDArray, NDArray]:
    """Times (n,) in s at which a length was set, and the lengths (n,) in m. Raises BagError if there are none."""
    if flight.length is None:
        raise BagError(f"{flight.path}: no topic {TOPICS['length']} (length), which says which length was used")
    return flight.time(flight.length), flight.length.column("used")


def true_length(flight: Flight) -> float:
    """True length in m: recorded by the simulator, else the one in the bag's parameters. Drawn, and never judged by."""
    truth = flight.truth_length
    return float(truth.values[0, 0]) if truth is not None else flight.params.pendulum.length


class Convergence(NamedTuple):
    """The final used length: ``length`` and ``error`` in m, ``time`` in s since the start of the flight."""

    length: float
    error: float
    time: float


def convergence(flight: Flight) -> Convergence:
    """Return the median of the used length over the last ``FINAL_SECONDS``, its error against the rod of the flight's
    parameters, and when the used length entered ``CONVERGED`` around that median and stayed there."""
    time, used = used_length(flight)
    late = time > flight.duration - FINAL_SECONDS
    final = float(np.median(used[late] if late.any() else used[-1:]))
    error = abs(final - flight.params.pendulum.length)
    return Convergence(final, error, settling_time(time, np.abs(used - final) > CONVERGED))


class Jump(NamedTuple):
    """A change of the used length: ``size`` in m; it lasts from ``start`` to the next one, a fall or the end, in s."""

    size: float
    start: float
    end: float
    fell: bool


def jumps(flight: Flight) -> list[Jump]:
    """Every change of the used length, in order. Raises BagError if there is none."""
    time, used = used_length(flight)
    at, fell = np.flatnonzero(np.diff(used)) + 1, fall_time(flight)
    if not len(at):
        raise BagError(f"{flight.path}: the length in use never changes in this flight")
    sizes, starts = np.abs(used[at] - used[at - 1]).tolist(), time[at].tolist()
    ends = [*starts[1:], flight.duration]
    return [Jump(size, a, min(b, fell), a <= fell <= b) for size, a, b in zip(sizes, starts, ends, strict=True)]


def binomial_interval(successes: int, trials: int) -> tuple[float, float]:
    """Return the 95 % interval of a probability (Clopper and Pearson, 1934: never too narrow)."""
    if not trials:
        return 0.0, 1.0
    low = betaincinv(successes, trials - successes + 1, 0.025) if successes else 0.0
    high = betaincinv(successes + 1, trials - successes, 0.975) if successes < trials else 1.0
    return float(low), float(high)


def bootstrap_interval(
    values: ArrayLike, statistic: Callable[[NDArray], float], draws: int = 2000
) -> tuple[float, float]:
    """Return the 95 % interval of a statistic of independent values (n,), drawn anew with repetition; seeded."""
    values = np.asarray(values, dtype=float)
    chosen = np.random.default_rng(0).integers(len(values), size=(draws, len(values)))
    low, high = np.quantile([statistic(values[one]) for one in chosen], (0.025, 0.975))
    return float(low), float(high)


def quantile_interval(values: ArrayLike, share: float = 0.5) -> tuple[float, float]:
    """Return the exact 95 % interval of a quantile of independent values (n,): two of them, never too narrow.

    An end is nan where too few values leave it unbounded: of the median, fewer than six.
    """
    ordered = np.sort(np.asarray(values, dtype=float))
    # the number of values below the quantile is binomial
    below = bdtr(np.arange(len(ordered)), len(ordered), share)
    low, high = int(np.sum(below <= 0.025)) - 1, int(np.sum(below < 0.975))
    return (
        float(ordered[low]) if low >= 0 else math.nan,
        float(ordered[high]) if high < len(ordered) else math.nan,
    )


def rms(values: ArrayLike) -> float:
    """Root of the mean square; nan of no values."""
    return float(np.sqrt(np.mean(np.square(values)))) if np.size(values) else math.nan
