"""The estimate of a rod's length from the poses of a vehicle and its rod."""

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from fiplib.estimators.base import Estimate
from fiplib.estimators.checks import tracked, why_no_length
from fiplib.estimators.poses import checks
from fiplib.estimators.poses.checks import Refusal
from fiplib.estimators.poses.filter import HC, LE, MU, ND, NR, NT, NV, OFFSET, H, R
from fiplib.estimators.poses.fit import TOLD, Fit, Problem, Value, inertia_factor_of
from fiplib.estimators.poses.knowledge import ANY_OFFSET, UNIFORM, Knowledge, Told, assumptions
from fiplib.estimators.poses.rows import Body, checked, cleaned, rows_of, upright_axis, without_jumps
from fiplib.recording import Flight

LARGEST_DOUBT = 3.0
"""Difference of the two possible lengths, in standard deviations, from which on they disagree; 0.3 % by chance."""

LEAST_EVIDENCE = 4.5
"""Difference in log posterior from which one of the two lengths is accepted: 3 standard deviations."""

NORMAL = 1.959964
"""Half the width of a 95 % interval, standard deviations."""

UNKNOWN = Value(math.nan, math.nan)


@dataclass(frozen=True)
class PoseEstimate(Estimate):
    """The length of a rod from two tracked bodies, and what else they say about it.

    Attributes:
        length: twice the distance from the seat to the rod's centre of mass, m; nan if refused.
        standard_deviation, interval: of the length, m; the interval holds 95 %.
        reason: None, or one sentence why there is no length and what to do about it.
        assumed: what was taken for granted and with which tolerance, one sentence each.
        effective_length: L_e, m, the length of the point pendulum that falls as fast on a base as heavy.
        rod_point: rho, distance from the seat to the rod's tracked point, m.
        seat_height: of the seat above the vehicle's tracked point, m.
        com_height: of the seat above the vehicle's centre of mass, m.
        inertia_factor: lambda; 1 for a point mass, 3/4 for a uniform rod.
        uniform_length, middle_length: two lengths, m: of a uniform rod wherever it is tracked, and twice
            ``rod_point``, which is the length if the rod is tracked at its middle.
        distance: measured distance of the two tracked points, m, and its deviation from rho + h over the standard
            deviation of that: it agrees within +-3.
        noise: fitted standard deviations of the vehicle's and the rod's position, m, of tilt and direction, rad.
        whiteness: largest autocorrelation of the innovations at lags of 1 to 10 rows, by kind of row.
        notes: what was left out of the data, and what else is worth knowing, one sentence each.
    """

    length: float = math.nan
    standard_deviation: float = math.nan
    interval: tuple[float, float] = (math.nan, math.nan)
    effective_length: Value = UNKNOWN
    rod_point: Value = UNKNOWN
    seat_height: Value = UNKNOWN
    com_height: Value = UNKNOWN
    inertia_factor: Value = UNKNOWN
    uniform_length: Value = UNKNOWN
    middle_length: Value = UNKNOWN
    distance: Value = UNKNOWN
    noise: dict[str, float] = field(default_factory=dict)
    whiteness: dict[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


class Solution(NamedTuple):
    """An answer, and the problem and its maximum if it came so far, refused or not."""

    answer: PoseEstimate
    problem: Problem | None
    fit: Fit | None


def estimate(vehicle: Body, rod: Body, knowledge: Knowledge | None = None) -> PoseEstimate:
    """Return the length of a balanced rod from the poses of two bodies, or the reason for a refusal.

    Args:
        vehicle: positions, and the body's z axis if it is a vehicle that tilts to accelerate. Without axes it is a
            prescribed base: a cart, an arm, a hand.
        rod: positions of one point of the rod, its axis, or both.
        knowledge: priors of the laboratory.

    Raises:
        ValueError: the vehicle has no positions, or the rod neither positions nor axes.
    """
    return solved(vehicle, rod, knowledge).answer


def solved(vehicle: Body, rod: Body, knowledge: Knowledge | None = None) -> Solution:
    """Return the estimate with what it was made from; see ``estimate``."""
    knowledge, found, problem = knowledge or Knowledge(), {"notes": [], "fit": None}, None
    try:
        problem = problem_of(vehicle, rod, knowledge, found["notes"])
        found |= _answered(problem, found)
    except Refusal as refusal:
        found["reason"] = str(refusal)
    fit = found.pop("fit")
    return Solution(PoseEstimate(**found | {"notes": tuple(found["notes"])}), problem, fit)


def length_of(flight: Flight, knowledge: Knowledge) -> PoseEstimate:
    """Return the length of the rod from the two bodies of a recorded flight; see ``estimate``."""
    if reason := why_no_length(flight):
        return PoseEstimate(reason=reason)
    vehicle, rod, notes = bodies_of(flight)
    found = estimate(vehicle, rod, knowledge)
    return replace(found, notes=(*notes, *found.notes))


def bodies_of(flight: Flight) -> tuple[Body, Body, list[str]]:
    """Return vehicle and rod of a flight, each set upright where it was tracked, and what was done to them.

    Their times are those of the flight, s since its start.
    """
    flight = tracked(flight)
    bodies, notes = [], []
    for name, body in (("vehicle", flight.vehicle), ("pendulum", flight.pendulum)):
        axis, turned = upright_axis(body.orientation)
        bodies.append(Body(flight.time(body), body.position, axis))
        if turned:
            notes.append(
                f"the {name}'s body frame leans by {math.degrees(turned):.0f} deg on average and was set upright"
            )
    return bodies[0], bodies[1], notes


def problem_of(vehicle: Body, rod: Body, knowledge: Knowledge, notes: list[str]) -> Problem:
    """Return what is to be fitted to the poses of two bodies; ``notes`` take what was left out. Raises Refusal."""
    vehicle, rod = checked(vehicle), checked(rod)
    if vehicle.position is None or (rod.position is None and rod.axis is None):
        raise ValueError("an estimate needs the vehicle's positions, and the rod's positions or axes")
    given = len(vehicle.time), len(rod.time)
    vehicle, rod = cleaned(vehicle, "vehicle", notes), cleaned(rod, "rod", notes)
    counts = len(vehicle.time), len(rod.time)
    if min(counts) < checks.LEAST_POSES:
        text = f"{counts[0]} of the vehicle and {counts[1]} of the rod"
        if min(given) < 2 * checks.LEAST_POSES:
            raise Refusal(f"too few poses: {text}, at least {checks.LEAST_POSES} of each are needed; record longer")
        raise Refusal(f"too few poses are left, {text}: {'; '.join(notes)}; stamp each pose with its exposure, "
                      "or use the times of arrival")  # fmt: skip
    distance = math.nan
    if rod.position is not None:
        count = len(rod.time)
        rod, distance = without_jumps(vehicle, rod)
        if dropped := count - len(rod.time):
            notes.append(f"{dropped} poses of the rod were left out: they lie elsewhere than the rod can be")
        if len(rod.time) < checks.LEAST_POSES:
            raise Refusal("the distance of the two bodies is not constant: they do not belong together")
        checks.check_resolution(vehicle, rod)
    checks.check_bodies(vehicle, rod, distance)
    if distance < checks.SHORTEST_ARM:
        rod = Body(rod.time, None, rod.axis)
        notes.append("the rod is tracked at its foot: its orientation alone was used")
    return Problem(rows_of(vehicle, rod), knowledge, distance)


def _answered(problem: Problem, found: dict) -> dict:
    """Fit, check, and return the fields of the answer; ``found`` takes what is known before it is refused."""
    knowledge, doubt = problem.knowledge, 0.0
    untold = knowledge.inertia_factor is None and knowledge.marker_offset is None
    variant = "told" if knowledge.inertia_factor else "middle" if problem.tracked else "uniform"
    fit = found["fit"] = problem.fit(problem.inertia, problem.offset)
    whiteness = checks.whiteness_of(fit, problem.rows)
    checks.check_motion(fit, problem.rows)
    if untold and problem.tracked:
        # both lengths are true of a uniform rod that is tracked at its middle
        difference = fit.of(lambda t: 2.0 * t[R] - uniform_length_of(t))
        tolerance = math.hypot(difference.deviation, fit.length.value * UNIFORM.tolerance / UNIFORM.value)
        doubt = max(abs(difference.value), tolerance)
        if doubt > LARGEST_DOUBT * tolerance:
            other, doubt = problem.fit(UNIFORM, ANY_OFFSET), 0.0
            if min(np.max(np.abs(one.conflicts()[2 : len(TOLD)])) for one in (fit, other)) <= checks.LARGEST_CONFLICT:
                if abs(other.value - fit.value) < LEAST_EVIDENCE:
                    found |= described(fit, problem)
                    raise Refusal(_ambiguity(fit.length.value, other.length.value))
                if other.value > fit.value:
                    fit, variant = other, "uniform"
                    found["fit"] = fit
                    whiteness = checks.whiteness_of(fit, problem.rows)
                found["notes"].append(
                    f"the rod's {'middle' if variant == 'uniform' else 'inertia'} is not where a uniform rod tracked "
                    "at its middle has it; its reaction on the vehicle decides which"
                )
    priors = [Told(*pair) for pair in zip(fit.prior.means[:2], fit.prior.tolerances[:2], strict=True)]
    distance = problem.distance if problem.tracked else math.nan
    described_by = described(fit, problem)
    found["whiteness"], found["noise"] = whiteness, described_by["noise"]
    found["assumed"] = assumptions(variant, *priors, knowledge, problem.flies, distance)
    if doubt:
        found["assumed"] += (
            f"the rod is uniform and tracked at its middle: neither was stated, and {1e3 * doubt:.0f} mm, by which the "
            "flight may contradict that, are part of the standard deviation",
        )
    checks.check_knowledge(fit, problem)
    checks.check_noise(described_by["noise"], whiteness, knowledge.noise)
    length, deviation = fit.length
    deviation = math.hypot(deviation, doubt)
    checks.check_length(length, deviation, knowledge.lengths)
    return described_by | answer(length, deviation)


def answer(length: float, deviation: float) -> dict:
    """Return the fields of a length and its standard deviation, m."""
    interval = (length - NORMAL * deviation, length + NORMAL * deviation)
    return {"length": length, "standard_deviation": deviation, "interval": interval}


def uniform_length_of(theta: np.ndarray) -> np.ndarray:
    """Return the length of a uniform rod: 2 lambda kappa L_e with lambda = 3/4."""
    return 1.5 * np.exp(theta[LE]) / (1.0 - 0.75 * theta[MU])


def described(fit: Fit, problem: Problem) -> dict:
    """Return what both answers and refusals say of the rod."""
    values: dict = {
        "effective_length": fit.of(lambda t: np.exp(t[LE])),
        "inertia_factor": fit.of(inertia_factor_of),
        "uniform_length": fit.of(uniform_length_of),
    }
    if problem.tracked:
        values["rod_point"] = fit.of(lambda t: t[R] + t[OFFSET])
        values["middle_length"] = fit.of(lambda t: 2.0 * (t[R] + t[OFFSET]))
    if problem.flies:
        values["seat_height"] = fit.of(lambda t: t[H])
        values["com_height"] = fit.of(lambda t: t[HC])
    names = {"vehicle": NV, "rod": NR, "tilt": NT, "direction": ND}
    values["noise"] = {name: float(np.exp(fit.theta[i])) for name, i in names.items() if i in fit.free}
    if math.isfinite(problem.distance):
        agrees = fit.conflicts()[5] if problem.tracked and problem.flies else math.nan
        values["distance"] = Value(problem.distance, float(agrees))
    return values


def _ambiguity(middle: float, uniform: float) -> str:
    return (
        f"the rod's tracked point is not at its middle, or the rod is not uniform: it is {uniform:.3f} m long if "
        f"it is uniform, {middle:.3f} m if it is tracked at its middle; say which by the inertia factor or the "
        "marker's offset"
    )
