"""The ledger's numbers of one flight: each function takes a flight and returns the number that a claim speaks of.

The study ``ledger_seeds`` has a column for each, named as the function; the ledger shows the same number of the
recorded flight. Built on ``measures``; like these they never look at a simulator's truth.
"""

import math
from functools import lru_cache

import numpy as np

from fiplib.recording import Flight
from fiplib.reproduction.measures import (
    Jump,
    convergence,
    fall_time,
    jumps,
    laps,
    lean,
    need,
    push_times,
    rms,
    settling_time,
    tracking_error,
    used_length,
    x_response,
)

SETTLED = 0.01
"""Band in m within which a and b count as settled (D3). The paper names none; 1 cm is a sixth of its largest push."""

LATE = 14.0
"""Time in s after which the paper saw little to no convergence (G4)."""

EXPLORING = {"estimation__elite_fraction": 0.05, "estimation__mutation_rate": 0.2}
"""The paper's remedy, fewer elites and more mutation, for which it gives no numbers: r_p from a sixth to a twentieth,
r_m doubled."""


# --- pushes in hover


def kept(flight: Flight) -> float:
    """Number of pushes after which the rod is still up when the next one comes, or the flight ends."""
    times, fell = push_times(flight), fall_time(flight)
    return float(sum(fell > until for until in [*times[1:], flight.duration]))


def push_lean(flight: Flight) -> float:
    """max(|a|, |b|) from the first push on, m."""
    return float(lean(flight)[flight.time(flight.state) >= push_times(flight)[0]].max())


def settling(flight: Flight) -> float:
    """Time from a push until |a| and |b| stay below ``SETTLED``, s; the longest of all pushes."""
    outside, starts = lean(flight) > SETTLED, push_times(flight)
    time = flight.time(flight.state)
    spans = [(time >= start) & (time < until) for start, until in zip(starts, [*starts[1:], math.inf], strict=True)]
    return max(settling_time(time[s], outside[s]) - start for s, start in zip(spans, starts, strict=True))


def pushed_axes(flight: Flight) -> float:
    """RMS error of y over that of x from the first push on."""
    errors = tracking_error(flight)[flight.time(flight.state) >= push_times(flight)[0]]
    x, y = (rms(axis) for axis in errors.T)
    return y / x


# --- circle


def circle_lean(flight: Flight) -> float:
    """max(|a|, |b|) over the whole flight, start included, m."""
    return float(lean(flight).max())


def x_gain(flight: Flight) -> float:
    """Amplitude of x over that of its reference, last whole laps."""
    return x_response(flight)[0]


def x_delay(flight: Flight) -> float:
    """Return how far x lags behind its reference, s, last whole laps; negative: it leads."""
    return x_response(flight)[1]


def y_error(flight: Flight) -> float:
    """max |y - y_ref| over the whole flight, m."""
    return float(np.abs(tracking_error(flight)[:, 1]).max())


# --- length


def final_length(flight: Flight) -> float:
    """Return the final length of the flight's estimate, m."""
    return convergence(flight).length


def converged(flight: Flight) -> float:
    """Return when the used length entered ``CONVERGED`` around its final value and stayed there, s from the start."""
    return convergence(flight).time


def late_share(flight: Flight) -> float:
    """Share of the initial error that goes after ``LATE``."""
    time, used = used_length(flight)
    initial, late = np.abs(used[[0, np.searchsorted(time, LATE, "right") - 1]] - flight.params.pendulum.length)
    return float((late - convergence(flight).error) / initial)


def x_tracking(flight: Flight) -> float:
    """RMS error of x on the arc flown before the first update of the length: in later laps over in the first."""
    return _tracking(flight)[0]


def y_tracking(flight: Flight) -> float:
    """RMS error of y in later laps over that in the first lap, on the same arc as ``x_tracking``."""
    return _tracking(flight)[1]


def _tracking(flight: Flight) -> tuple[float, float]:
    """Both ratios; NaN where the circle had not begun before the first update, so that there is no arc."""
    phase, time = laps(flight).phase, flight.time(flight.reference)
    before = (phase > 0) & (time < jumps(flight)[0].start)
    if not before.any():
        return math.nan, math.nan
    after = (phase > 2 * math.pi) & (phase % (2 * math.pi) <= phase[before].max())
    x, y = (rms(error[after]) / rms(error[before]) for error in tracking_error(flight).T)
    return x, y


def _estimates(flight: Flight) -> np.ndarray:
    """Return the estimator's own answers (n,) in m, before its median filter."""
    need(flight, "length")
    answers = flight.length.column("estimate")
    return answers[np.isfinite(answers)]


def fluctuation(flight: Flight) -> float:
    """Return the change from one answer of the estimator to the next that nine in ten stay below, m."""
    changes = np.abs(np.diff(_estimates(flight)))
    return float(np.quantile(changes, 0.9)) if len(changes) else math.nan


def estimate_error(flight: Flight) -> float:
    """RMS error of the estimator's answers, m."""
    return rms(_estimates(flight) - flight.params.pendulum.length)


# --- the search, in windows of a flight


@lru_cache(maxsize=8)
def search_gaps(*flights: Flight) -> tuple[float, float, float, int]:
    """Return the GA against the exhaustive optimum l_best of the same fitness.

    Returns:
        |l_GA - l_best| in m as flown and with ``EXPLORING``, |l_best - l| in m, all medians over windows; their number.
    """
    from fiplib import ga, replay  # here and below: figures import the claims, and need not wait for CasADi
    from fiplib.estimators.grid import best_length

    cases = [(window, flight.params) for flight in flights for window in replay.spaced_windows(flight)]
    best = np.array([best_length(*case) for case in cases])
    found = {explore: [] for explore in (False, True)}
    for run, (window, params) in enumerate(cases):
        for explore, lengths in found.items():
            rng = np.random.default_rng([0, run])
            lengths.append(ga.estimate(window, params.replace(**EXPLORING) if explore else params, rng).length)
    flown, explored = (float(np.median(np.abs(np.array(lengths) - best))) for lengths in found.values())
    optimum = float(np.median(np.abs(best - [params.pendulum.length for _, params in cases])))
    return flown, explored, optimum, len(cases)


def search_gap(flight: Flight) -> float:
    """|l_GA - l_best|, m, median over windows."""
    return search_gaps(flight)[0]


def explored_gap(flight: Flight) -> float:
    """Return the same with ``EXPLORING``."""
    return search_gaps(flight)[1]


def optimum_error(flight: Flight) -> float:
    """|l_best - l|, m, median over windows."""
    return search_gaps(flight)[2]


def printed_best(flight: Flight) -> float:
    """The length in m at which the fitness as printed (Euler, J = df/dx, posterior residual) is smallest, searched
    exhaustively in steps of 1 mm, with our noise covariances; median over windows."""
    return _printed(flight)


def printed_identity(flight: Flight) -> float:
    """Return the same with Q_e = R_e = I."""
    return _printed(flight, estimation__process_noise=(1.0,) * 10, estimation__measurement_noise=(1.0,) * 10)


def _printed(flight: Flight, **covariances: tuple[float, ...]) -> float:
    from fiplib import ga, replay

    windows = replay.spaced_windows(flight)
    printed = flight.params.replace(estimation__fitness="paper", estimation__resolution=1e-3, **covariances)
    return float(np.median([ga.landscape(window, printed).best for window in windows]))


# --- changes of the length


def survived_change(flight: Flight) -> float:
    """Return the largest change of the used length at once, m, after which the rod stays up until the next one."""
    return max((jump.size for jump in jumps(flight) if not jump.fell), default=math.nan)


def fatal_change(flight: Flight) -> float:
    """Return the smallest change of the used length at once, m, after which the rod falls before the next one."""
    return min((jump.size for jump in jumps(flight) if jump.fell), default=math.nan)


def command_ratio(flight: Flight) -> float:
    """RMS of the rate commands between the largest change of the length and the next one, a fall or the end, over that
    before any change."""
    need(flight, "command")
    first, largest = (found := jumps(flight))[0], max(found, key=lambda jump: jump.size)
    return _commands(flight, largest.start, largest.end) / _commands(flight, 0.0, first.start)


def fatal_jump(flight: Flight) -> Jump | None:
    """Return the smallest change that ended in a fall, if one did."""
    return min((jump for jump in jumps(flight) if jump.fell), default=None)


def _commands(flight: Flight, start: float, end: float) -> float:
    time, rates = flight.time(flight.command), flight.command.values[:, :2]
    return rms(rates[(time >= start) & (time < end)])


# --- altitude and yaw


def height_sway(flight: Flight) -> float:
    """Return how far the vehicle's height departs from its median, m, at most, once it has settled."""
    height = flight.vehicle.position[_settled(flight), 2]
    return float(np.abs(height - np.median(height)).max())


def yaw_sway(flight: Flight) -> float:
    """Return how far the vehicle's yaw departs from zero, deg, at most, once it has settled."""
    x, y, z, w = flight.vehicle.orientation[_settled(flight)].T
    return float(np.degrees(np.abs(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))).max()))


def _settled(flight: Flight) -> np.ndarray:
    """Return the frames after the first 2 s, in which altitude and yaw come to rest."""
    return flight.time(flight.vehicle) > 2.0
