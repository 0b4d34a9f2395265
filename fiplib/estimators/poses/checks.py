"""Checks of an estimate: frames, units and bodies before the fit, innovations and priors after it."""

import math

import numpy as np
from numpy.typing import NDArray

from fiplib.estimators.poses.filter import KINDS, NR, NV, Rows
from fiplib.estimators.poses.fit import TOLD, Fit, Problem
from fiplib.estimators.poses.rows import Body, arm, quantum

LEAST_POSES = 64
"""Fewest poses of each body: a quarter of a second at 240 Hz, and never enough to be sure of anything."""

SHORTEST_ARM = 0.1
"""Tracked points closer than this, m, are taken for the rod's foot."""

LARGEST_LEAN = 0.3
"""Refused above this angle, rad: terms of second order are taken from smoothed poses, which is then too coarse."""

LARGEST_SLOPE = 0.15
"""Refused above this average lean, rad: a circle of 0.6 m in 6 s leans by 0.07, and the constants hold 0.1."""

LEAST_STEPS = 3.0
"""Refused where the rod moves against the vehicle by fewer steps of the recorded positions (standard deviation)."""

LARGEST_SPREAD = 0.05
"""Refused above this relative standard deviation: the priors alone, with no motion at all, end at 10 % for 1 m."""

LARGEST_CONFLICT = 3.5
"""Refused above this many standard deviations between a stated value and the flight: one in 2 000 by chance."""

LARGEST_JUMP, JUMP_SPAN = 3.0, 0.1
"""Refused above this mean squared innovation over a span in s; noise alone reaches 2 in a flight of minutes."""

RECOVERY = 1.0
"""How long in s the filter is taken to need after a jump; jumps closer than this are one."""

MOST_NAMED = 6
"""Jumps that a refusal names at most."""

SHORTEST_QUIET = 2.5
"""Shortest stretch between jumps, s, that a refusal suggests."""

NO_NOISE = 3e-6
"""Fitted noise of positions, m, below which there is none: no motion capture is as good, and the filter needs some."""

LARGEST_CORRELATION = 0.3
"""Refused above this autocorrelation of innovations."""

LARGEST_NOISE = 5.0
"""Refused above this ratio of fitted to stated noise."""

POSITIONS, ATTITUDES = ("vehicle", "rod"), ("tilt", "direction")
"""Kinds of rows by what was measured."""


class Refusal(Exception):
    """Why there is no length and what to do about it, in one sentence."""


def check_bodies(vehicle: Body, rod: Body, distance: float) -> None:
    """Raise ``Refusal`` if units, frames or the kinds of bodies cannot be right. ``distance`` is nan or theirs in m."""
    if distance > 20.0:
        raise Refusal(
            f"the two bodies are {distance:.0f} m apart: positions are in millimetres, it seems; divide them by 1000"
        )
    if distance > SHORTEST_ARM:
        along = np.median(arm(vehicle, rod), axis=0) / distance
        if along[2] < -0.7:
            raise Refusal("the rod is below the vehicle: the bodies are swapped, or z points down; "
                          "swap them or turn the frame")  # fmt: skip
        if along[2] < 0.7:
            axis = "xy"[int(np.argmax(np.abs(along[:2])))]
            raise Refusal(f"the rod stands along {axis}, not along z: turn the world's frame so that z points up")
    for body, name in ((vehicle, "vehicle"), (rod, "rod")):
        if body.axis is not None and float(np.median(body.axis[:, 2])) < 0.7:
            raise Refusal(
                f"the {name}'s body z axis does not point up: check the order of its quaternion (x, y, z, w) and the "
                "frame of its body"
            )
    if distance <= SHORTEST_ARM and rod.axis is None:
        raise Refusal(
            f"the rod is tracked {100 * distance:.0f} cm from the vehicle, at its foot, where it does not move: "
            "track its middle, or record its orientation too"
        )
    axes = {name: body.axis for body, name in ((vehicle, "vehicle"), (rod, "rod")) if body.axis is not None}
    if distance > SHORTEST_ARM:
        axes["rod's tracked point as seen from the vehicle"] = arm(vehicle, rod)
    leaned = 0.0
    for name, axis in axes.items():
        slope = _angle(np.median(axis, axis=0)[None])[0]
        if slope > LARGEST_SLOPE:
            raise Refusal(
                f"frames are not level: the {name} leans by {math.degrees(slope):.0f} deg on average; turn the world's "
                "frame so that z points up, and the body's frame so that it is level in hover"
            )
        leaned = max(leaned, float(np.quantile(_angle(axis), 0.995)))  # single noisy poses aside
    if leaned > LARGEST_LEAN:
        raise Refusal(f"rod or vehicle leans by {math.degrees(leaned):.0f} deg, too far for the model; "
                      "leave out the stretch where it falls")  # fmt: skip


def check_resolution(vehicle: Body, rod: Body) -> None:
    """Raise ``Refusal`` if the rod hardly moves by the steps in which positions are recorded."""
    step = max(quantum(body.position[:, axis]) for body in (vehicle, rod) for axis in range(2))
    moved = float(np.max(np.std(arm(vehicle, rod)[:, :2], axis=0)))
    if not math.isfinite(step):
        raise Refusal("quantisation: one body's recorded position does not change; record it with more digits")
    if moved < LEAST_STEPS * step:
        raise Refusal(
            f"quantisation: the rod moves by {moved / step:.1f} steps of the recorded positions, {1e3 * step:.2g} mm "
            f"each, not by {LEAST_STEPS:g}; record them with more digits, or move more"
        )


def _angle(axis: NDArray) -> NDArray:
    """Return the angle (n,) between vectors (n, 3) and the vertical, rad."""
    return np.arctan2(np.linalg.norm(axis[:, :2], axis=1), axis[:, 2])


def check_motion(fit: Fit, rows: Rows) -> None:
    """Raise ``Refusal`` if there is no maximum, or if something moves as nothing in the model does."""
    jump = largest_jump(rows.time, fit.innovation)
    if not (fit.converged and np.all(np.isfinite(fit.covariance))):
        raise Refusal(_why_no_maximum(fit, rows, jump))
    if jump > LARGEST_JUMP:
        raise Refusal(_pushed(jumps(rows.time, fit.innovation), rows, jump))


def _why_no_maximum(fit: Fit, rows: Rows, jump: float) -> str:
    """Name the most probable cause of a likelihood without a maximum."""
    noises = [index for index in (NV, NR) if index in fit.free]
    if np.all(np.exp(fit.theta[noises]) < NO_NOISE):
        return (
            "the poses hold no noise, so that the likelihood has no maximum: they were simulated or computed; give "
            "them the noise of a motion capture, about 0.2 mm and 1 mrad"
        )
    found = jumps(rows.time, fit.innovation, relative=True)
    quiet = np.ones(len(rows.time), dtype=bool)
    for start, end in found:
        quiet &= (rows.time < start) | (rows.time > end + RECOVERY)
    parts = [fit.innovation[quiet & (rows.kind == kind)] for kind in range(len(KINDS)) if rows.has(kind)]
    correlation = max((_correlation(part) for part in parts if len(part) >= LEAST_POSES), default=0.0)
    if found and correlation <= LARGEST_CORRELATION:
        return _pushed(found, rows, jump)
    if correlation > LARGEST_CORRELATION:
        return (
            f"the likelihood has no maximum, and innovations are not white (correlation {correlation:.2f}): either the "
            "poses were smoothed by a low-pass filter, which must be switched off in the motion capture or its driver, "
            "or the two bodies do not move as a vehicle and its rod; check the frames and the stamps"
        )
    return "the likelihood has no maximum: the two bodies do not move as a vehicle and its rod; check the frames"


def _pushed(found: list[tuple[float, float]], rows: Rows, jump: float) -> str:
    """Name the times of jumps, and the longest stretch without one."""
    named = [f"{start:.1f}" for start, _ in found[:MOST_NAMED]]
    if len(found) > MOST_NAMED:
        named.append(f"{len(found) - MOST_NAMED} more times")
    times = f"{', '.join(named[:-1])} and {named[-1]}" if len(named) > 1 else named[0]
    times = times if len(found) > MOST_NAMED else f"{times} s"
    begins = [float(rows.time[0]), *(end + RECOVERY for _, end in found)]
    ends = [*(start - JUMP_SPAN for start, _ in found), float(rows.time[-1])]
    begin, end = max(zip(begins, ends, strict=True), key=lambda stretch: stretch[1] - stretch[0])
    way = "leave that out"
    if end - begin > SHORTEST_QUIET:
        way = f"leave that out, for example with fip bag cut --from {begin:.1f} --to {end:.1f}"
    return (
        f"the rod or the vehicle moves at {times} as nothing in the model does (squared innovations {jump:.1f} times "
        f"as large as expected): it was pushed or mistracked; {way}"
    )


def check_knowledge(fit: Fit, problem: Problem) -> None:
    """Raise ``Refusal`` if the flight contradicts a prior, or an assumption made instead of one."""
    conflicts = np.abs(fit.conflicts()[: len(TOLD)])
    worst = int(np.argmax(conflicts))
    if conflicts[worst] <= LARGEST_CONFLICT:
        return
    told = problem.knowledge.inertia_factor, problem.knowledge.marker_offset
    if worst < 2 and told[worst] is None:
        raise Refusal(
            "the rod's tracked point is not at its middle, or the rod is not uniform: the flight contradicts both by "
            f"{conflicts[worst]:.0f} standard deviations; say which by the inertia factor or the marker's offset"
        )
    raise Refusal(
        f"the flight contradicts the {TOLD[worst]} {fit.prior.means[worst]:.3f} +- {fit.prior.tolerances[worst]:.3f} "
        f"by {conflicts[worst]:.0f} standard deviations: measure it again, or state a wider tolerance"
    )


def check_noise(noise: dict[str, float], whiteness: dict[str, float], stated: tuple[float, float]) -> None:
    """Raise ``Refusal`` if the noise is not what was stated, or the innovations are not white."""
    ratios = {name: value / stated[name in ATTITUDES] for name, value in noise.items()}
    loud = max(ratios, key=ratios.__getitem__)
    if ratios[loud] > LARGEST_NOISE:
        kinds = zip((POSITIONS, ATTITUDES), stated, strict=True)
        largest = [max((noise[name] for name in names if name in noise), default=told) for names, told in kinds]
        raise Refusal(
            f"the {loud}'s noise comes out {ratios[loud]:.0f} times as large as stated: the model does not explain "
            "the motion; check the frames and the stamps, or state the noise if it is that large, "
            f"--noise {largest[0]:.2g},{largest[1]:.2g}"
        )
    name = max(whiteness, key=whiteness.__getitem__)
    if whiteness[name] > LARGEST_CORRELATION:
        raise Refusal(
            f"the innovations of the {name} are not white (correlation {whiteness[name]:.2f}): the model does not "
            "explain the motion; check the frames, the stamps, whether the rod stands freely in its seat, and that the "
            "motion capture does not smooth its poses"
        )


def check_length(length: float, deviation: float, interval: tuple[float, float]) -> None:
    """Raise ``Refusal`` if the length lies outside the interval asked for, or is hardly known."""
    least, most = interval
    if not least < length < most:
        raise Refusal(
            f"the best length, {length:.3g} m, lies outside the interval from {least:g} to {most:g} m: widen it"
        )
    if deviation > LARGEST_SPREAD * length:
        raise Refusal(
            f"too little excitation: the standard deviation is {100 * deviation / length:.0f} % of the length, not "
            f"below {100 * LARGEST_SPREAD:.0f} %; record longer, or move more"
        )


def whiteness_of(fit: Fit, rows: Rows) -> dict[str, float]:
    """Return by kind of row the largest autocorrelation of its innovations."""
    kinds = [kind for kind in range(len(KINDS)) if rows.has(kind)]
    return {KINDS[kind]: _correlation(fit.innovation[rows.kind == kind]) for kind in kinds}


def _correlation(innovation: NDArray, lags: int = 10) -> float:
    """Largest autocorrelation in absolute value of innovations (n, axes) at lags of 1 to 10 rows."""
    values = innovation[min(len(innovation) // 8, 30) :]  # the first rows only find the state
    power = float(np.vdot(values, values)) / len(values)
    products = (float(np.vdot(values[lag:], values[:-lag])) / (len(values) - lag) for lag in range(1, lags + 1))
    return max(map(abs, products)) / power


def largest_jump(time: NDArray, innovation: NDArray) -> float:
    """Return the largest mean squared innovation over ``JUMP_SPAN``. The first tenth of a second does not count."""
    return float(np.max(_means(time, innovation)[0]))


def jumps(time: NDArray, innovation: NDArray, relative: bool = False) -> list[tuple[float, float]]:
    """Return when, by the rows' clock, innovations are too large for the model: start and end of each stretch, s.

    Too large is a mean square above ``LARGEST_JUMP``; if ``relative``, as where there is no maximum, above that many
    times the median if this is larger than 1.
    """
    means, fair = _means(time, innovation)
    usual = max(1.0, float(np.median(means[fair]))) if relative and np.any(fair) else 1.0
    loud = time[means > LARGEST_JUMP * usual]
    first = np.flatnonzero(np.diff(loud, prepend=-np.inf) > RECOVERY)
    last = np.append(first[1:] - 1, len(loud) - 1)
    return [(float(loud[i]), float(loud[j]) + JUMP_SPAN) for i, j in zip(first, last, strict=False)]


def _means(time: NDArray, innovation: NDArray) -> tuple[NDArray, NDArray]:
    """Mean squared innovations over ``JUMP_SPAN`` from each row on, 0 where that is not fair, and where it is."""
    power = np.mean(innovation**2, axis=1)
    total = np.concatenate([[0.0], np.cumsum(power)])
    ends = np.searchsorted(time, time + JUMP_SPAN)
    counts = ends - np.arange(len(time))
    fair = (counts >= max(8, int(np.median(counts)) // 2)) & (time > time[0] + 0.1)
    return np.where(fair, (total[ends] - total[:-1]) / np.maximum(counts, 1), 0.0), fair
