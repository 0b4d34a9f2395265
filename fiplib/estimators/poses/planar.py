"""The same estimate for a rod balanced in one plane, on a cart or a rotary arm, by two encoders."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fiplib.estimators.poses import checks
from fiplib.estimators.poses.checks import Refusal
from fiplib.estimators.poses.estimate import PoseEstimate, answer, described
from fiplib.estimators.poses.filter import DIRECTION, LE, VEHICLE
from fiplib.estimators.poses.fit import Problem, Value
from fiplib.estimators.poses.knowledge import ANY_OFFSET, UNIFORM, Knowledge, assumptions
from fiplib.estimators.poses.rows import HALF, Body, cleaned, quantum, sorted_rows
from fiplib.estimators.poses.smoothing import parabolas
from fiplib.params import GRAVITY, FipError

LARGEST_SPREAD = 0.1
"""Refused above this relative deviation of L_e: the base is known exactly, and friction leaves most of the doubt."""

PRIOR = Knowledge(noise=(1e-4, 1e-3), lengths=(0.03, 4.0))
"""The default prior of a laboratory with encoders: its rods may be short."""

LEAST_QUANTA = 4.0
"""Refused where the rod's angle moves by fewer steps of its encoder than this (standard deviation)."""


COLUMNS = ("time_s", "base_position_m", "angle_rad")
"""Columns of a CSV file of encoders: time, position of the rod's pivot along its path, angle of the rod from upright.

The angle is positive where the rod leans towards positive positions."""


def is_encoders(path: Path) -> bool:
    """Return whether a file is a CSV file whose header has the columns of encoders."""
    if path.suffix.lower() != ".csv" or not path.is_file():
        return False
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        return set(COLUMNS) <= {name.strip() for name in file.readline(1000).split(",")}


def read_encoders(path: Path) -> tuple[NDArray, NDArray, NDArray]:
    """Return time in s, position in m and angle in rad of a CSV file whose header names ``COLUMNS``, in any order.

    Rows with an empty cell are left out. On a rotary arm the position is the arm's angle times its radius.

    Raises:
        FipError: a column is missing, a cell is no number, or too few rows are left.
    """
    if not is_encoders(path):
        raise FipError(f"{path}: not a CSV file of encoders, whose header names {', '.join(COLUMNS)}")
    try:
        table = np.genfromtxt(path, delimiter=",", names=True, encoding="utf-8-sig", loose=False)
    except ValueError as error:
        raise FipError(f"{path}: a row is damaged: {' '.join(str(error).split())[:200]}") from None
    columns = np.array([np.atleast_1d(table[name]) for name in COLUMNS])
    columns = columns[:, np.isfinite(columns).all(axis=0)]
    if columns.shape[1] < checks.LEAST_POSES:
        raise FipError(f"{path}: {columns.shape[1]} rows hold numbers, at least {checks.LEAST_POSES} are needed")
    return columns[0], columns[1], columns[2]


def planar(
    base_time: ArrayLike,
    base: ArrayLike,
    angle_time: ArrayLike,
    angle: ArrayLike,
    knowledge: Knowledge | None = None,
    arm_radius: float = math.inf,
) -> PoseEstimate:
    """Return the effective length of a rod balanced in one plane on a cart or an arm, by two encoders.

    Real encoders, joints and belts are no motion capture. Where innovations show that the model leaves something out,
    a second fit gives the rod an unknown white force too; the difference between both lengths is then taken for one
    more standard deviation.

    Args:
        base_time, base: s, and position of the rod's pivot along its path, m.
        angle_time, angle: s, and angle of the rod from upright, rad, positive towards positive positions.
        knowledge: priors, by default ``PRIOR``; masses and seat have no meaning here.
        arm_radius: radius of the circle on which an arm moves the pivot, m; infinite for a cart.
    """
    knowledge, found = knowledge or PRIOR, {"notes": []}
    sensors = ((base_time, base), (angle_time, angle))
    bodies = [cleaned(Body(np.asarray(t, dtype=float), np.asarray(v, dtype=float)[:, None])) for t, v in sensors]
    try:
        found |= _answered(*bodies, knowledge, arm_radius, found)
    except Refusal as refusal:
        found["reason"] = str(refusal)
    return PoseEstimate(**found | {"notes": tuple(found["notes"])})


def _answered(base: Body, angle: Body, knowledge: Knowledge, arm_radius: float, found: dict) -> dict:
    problem = _problem(base, angle, knowledge, arm_radius)
    told = knowledge.inertia_factor or UNIFORM
    fit = problem.fit(told, ANY_OFFSET)
    whiteness = checks.whiteness_of(fit, problem.rows)
    fields, extra = described(fit, problem), 0.0
    variant = "told" if knowledge.inertia_factor else "uniform"
    found |= {"whiteness": whiteness, "noise": fields["noise"]}
    found["assumed"] = assumptions(variant, told, ANY_OFFSET, knowledge, False, math.nan)
    correlation = max(whiteness.values())
    jump = checks.largest_jump(problem.rows.time, fit.innovation)
    if correlation > checks.LARGEST_CORRELATION or jump > checks.LARGEST_JUMP:
        extra = abs(problem.fit(told, ANY_OFFSET, force=True).theta[LE] - fit.theta[LE])
        found["notes"].append(
            f"the innovations are not white (correlation {correlation:.2f}): something moves the rod that the model "
            f"leaves out, friction or backlash; an unknown force on the rod changes L_e by {100 * extra:.1f} %, which "
            "is taken for a standard deviation"
        )
    value, deviation = fields["effective_length"]
    relative = math.hypot(deviation / value, extra)
    if not fit.converged:
        raise Refusal("the likelihood has no maximum: the angle does not follow the base; check signs, units, stamps")
    if relative > LARGEST_SPREAD:
        raise Refusal(
            f"L_e is known to {100 * relative:.0f} % only, not to {100 * LARGEST_SPREAD:.0f} %: record longer, "
            "move more, or find what else moves the rod"
        )
    length, deviation = fit.length
    checks.check_length(length, 0.0, knowledge.lengths)
    for name in ("effective_length", "uniform_length"):
        fields[name] = Value(fields[name].value, relative * fields[name].value)
    return fields | answer(length, math.hypot(deviation, extra * length))


def _problem(base: Body, angle: Body, knowledge: Knowledge, arm_radius: float) -> Problem:
    if min(len(base.time), len(angle.time)) < checks.LEAST_POSES:
        raise Refusal(f"too few samples: at least {checks.LEAST_POSES} of each sensor are needed; record longer")
    place, sine = base.position - base.position[0], np.sin(angle.position)
    quanta = [quantum(place[:, 0]), quantum(angle.position[:, 0])]
    moved = float(np.std(angle.position))
    if moved < LEAST_QUANTA * quanta[1]:
        raise Refusal(
            f"quantisation: the rod moves by {moved / quanta[1]:.1f} steps of its encoder, not by {LEAST_QUANTA:g}; "
            "excite it more, or use a finer encoder"
        )
    events = np.union1d(base.time, angle.time)
    speed, force = parabolas(base.time, place, events, HALF)[1:, :, 0]
    lean, rate = parabolas(angle.time, sine, events, HALF)[:2, :, 0]
    upright = np.maximum(1.0 - lean**2, 0.1)
    lift = lean * force + np.sqrt(upright) * GRAVITY
    spin = rate**2 / upright - (speed / arm_radius) ** 2 * upright  # |q'|^2, and the centrifugal force of the arm
    parts = [(VEHICLE, base.time, place, None), (DIRECTION, angle.time, sine, None)]
    weight = np.full(len(events), GRAVITY)
    rows = sorted_rows(parts, events, (lift, spin, weight, 1.0 / weight))
    floor = [max(step / math.sqrt(12.0), noise) for step, noise in zip(quanta, knowledge.noise, strict=True)]
    return Problem(rows, replace(knowledge, noise=(floor[0], floor[1])))
