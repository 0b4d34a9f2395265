"""Open exercise of notebook 12: an estimator of the student's own finds the length in flight and is scored beside ours.

There is no right answer: ``check(estimator)`` lets it fly, and the paper's genetic algorithm and the recommended
estimator of the poses beside it, through the same seeded flights with a wrong first length.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from fiplib.estimators import ESTIMATORS
from fiplib.estimators.base import Estimate
from fiplib.estimators.windows import RawWindow
from fiplib.kalman import Window
from fiplib.params import Params
from fiplib.references import Circle, Hover
from fiplib.simulate import Push, Scenario
from fiplib.teaching.by_hand import flown
from fiplib.teaching.exercises.grading import NotYet

RIVALS = {"ga": "the paper's", "poses": "recommended"}
"""Estimators of the library that fly beside the student's."""

WINDOWS = {"states": "ga", "raw": "poses"}
"""The two kinds of windows, each with the estimator of the library whose windows they are."""

LONGEST_LENGTH = 20.0
"""Longest length in m that counts as an answer: that of a flagpole."""

NORMAL = 1.96
"""Standard deviations on either side of a 95 % interval."""


def _params(rod: float, first: float) -> Params:
    # one run a second, so that a score takes seconds; each estimate is used as it comes, in place of a median of five
    return Params().replace(
        pendulum__length=rod, piloting__initial_length=first, piloting__estimate=True, estimation__run_period=1.0,
        estimation__median_length=1,
    )  # fmt: skip


FLIGHTS = (
    Scenario("circle, rod of 0.8 m", "", 14.0, Circle(radius=0.4, period=8.0), params=_params(0.8, 1.1), seed=1),
    Scenario("hover, rod of 1.3 m", "", 14.0, Hover(), (Push(2.0, (0.005, 0.0)), Push(4.0, (0.0, 0.005)),
             Push(9.0, (-0.005, 0.005))), params=_params(1.3, 1.0), seed=2),
)  # fmt: skip
"""What is flown: true length and first length differ."""


@dataclass(frozen=True)
class Score:
    """One flight of one estimator: ``fell`` at s (nan if not), its ``runs`` and ``answers``, rms ``error`` in m.

    ``covered`` is the share of answers whose 95 % interval holds the true length; nan if no deviations are stated.
    """

    estimator: str
    flight: str
    fell: float
    runs: int
    answers: int
    error: float
    covered: float


def own_estimate(answer: Any) -> Estimate:
    """Return what a student's estimator returned: a length in m, or a length and its standard deviation.

    Raises NotYet, in one sentence: it is something else.
    """
    if answer is None or answer is ...:
        raise NotYet("your estimator returns nothing yet: return a length in m, or a length and its standard deviation")
    if isinstance(answer, Estimate):
        answer = answer.length, answer.standard_deviation
    try:
        if np.iscomplexobj(answer):  # NumPy would drop the imaginary part
            raise TypeError
        given = np.asarray(answer, dtype=float).squeeze()
    except (TypeError, ValueError):
        raise NotYet(f"your estimator returns {answer!r:.60}, and not a length in m") from None
    if given.shape not in ((), (2,)):
        raise NotYet(f"your estimator returns an array of shape {np.shape(answer)}: return a length, or two numbers")
    length, deviation = (float(given), np.nan) if given.ndim == 0 else map(float, given)
    if not np.isfinite(length):
        raise NotYet(f"your estimator returns a length of {length}: is a root negative, or 0/0 taken?")
    if not 0.0 < length <= LONGEST_LENGTH:
        raise NotYet(f"your estimator returns a length of {length:g} m: a rod is longer than 0 and at most 20 m")
    if deviation < 0.0 or np.isinf(deviation):
        raise NotYet(
            f"your estimator returns a standard deviation of {deviation:g} m: it must be finite, and not below 0"
        )
    return Estimate(length, float(deviation))


def score(name: str, kind: str, estimator: Callable[..., Estimate] | None, scenario: Scenario) -> Score:
    """Fly a scenario with an estimator (window, params, rng) -> Estimate of a kind, or with the library's ``name``."""
    found: list[Estimate] = []
    named = WINDOWS[kind] if estimator else name
    function = estimator or ESTIMATORS[named].function

    def noted(window: Window | RawWindow, params: Params, rng: np.random.Generator) -> Estimate:
        found.append(function(window, params, rng))
        return found[-1]

    params = scenario.params.replace(estimation__estimator=named)
    flight = flown(dataclasses.replace(scenario, params=params), estimate=noted)
    true = params.pendulum.length
    answers = np.array([(one.length, one.standard_deviation) for one in found if one.reason is None]).reshape(-1, 2)
    missed, deviations = answers[:, 0] - true, answers[:, 1]
    fell = flight.duration if any(event.kind == "fall" for event in flight.events) else np.nan
    error = float(np.sqrt(np.mean(missed**2))) if len(missed) else np.nan
    stated = np.isfinite(deviations)
    covered = float(np.mean(np.abs(missed[stated]) <= NORMAL * deviations[stated])) if stated.any() else np.nan
    return Score(name, scenario.name, fell, len(found), len(missed), error, covered)


def scores(estimator: Callable[..., Any], kind: str = "states") -> list[Score]:
    """Score a student's estimator, a function of a window, and ``RIVALS`` on ``FLIGHTS``.

    ``kind`` says which windows it takes: 'states' (``kalman.Window``) or 'raw' (``windows.RawWindow``). Raises NotYet:
    it stops or returns something else.
    """
    if kind not in WINDOWS:
        raise NotYet(f"kind must be one of {', '.join(map(repr, WINDOWS))}, not {kind!r}")

    def own(window: Window | RawWindow, params: Params, rng: np.random.Generator) -> Estimate:
        try:
            answer = estimator(window)
        except Exception as error:
            raise NotYet(f"your estimator stops with {type(error).__name__}: {error}") from error
        return own_estimate(answer)

    found = []
    for scenario in FLIGHTS:
        found.append(score("yours", kind, own, scenario))
        found += [score(name, ESTIMATORS[name].kind, None, scenario) for name in RIVALS]
    return found


def check(estimator: Callable[..., Any], kind: str = "states") -> None:
    """Print the scores, and how the student's compare; raises nothing, so that a notebook runs on."""
    try:
        found = scores(estimator, kind)
    except NotYet as refusal:
        print(f"not yet: {refusal}")
        return
    print(f"{'flight':22}{'estimator':20}{'stays up':10}{'answers':>9}{'rms error':>12}{'in 95 % interval':>18}")
    for row in found:
        name = f"{row.estimator} ({RIVALS[row.estimator]})" if row.estimator in RIVALS else row.estimator
        up = "yes" if np.isnan(row.fell) else f"{row.fell:.1f} s"
        covered = "none stated" if np.isnan(row.covered) else f"{100 * row.covered:.0f} %"
        answers = f"{row.answers} of {row.runs}"
        print(f"{row.flight:22}{name:20}{up:10}{answers:>9}{1e3 * row.error:9.1f} mm{covered:>18}")
    print(verdict(found))


def verdict(found: list[Score]) -> str:
    """Say in a sentence how the student's estimator compares with the paper's."""
    own = {row.flight: row for row in found if row.estimator == "yours"}
    up = sum(np.isnan(row.fell) for row in own.values())
    words = f"With your estimator the rod stays up in {up} of {len(own)} flights"
    ratios = [own[row.flight].error / row.error for row in found if row.estimator == "ga"]
    ratio = float(np.exp(np.mean(np.log(ratios))))
    return (
        f"{words}; its error is {ratio:.2f} times that of the genetic algorithm." if np.isfinite(ratio) else f"{words}."
    )
