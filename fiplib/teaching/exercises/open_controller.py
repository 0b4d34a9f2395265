"""Open exercise of notebook 12: a controller of the student's own flies the simulator and is scored beside ours.

There is no right answer: ``check(controller)`` flies it, the MPC and the LQR through the same seeded flights and says
who keeps the rod up, how far from the reference, and with how much effort.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fiplib.controllers import Controller, answer, controller_of
from fiplib.mpc import Solution
from fiplib.params import STATES, Params, X, Y
from fiplib.references import Circle, Hover
from fiplib.simulate import Push, Scenario
from fiplib.teaching.by_hand import flown
from fiplib.teaching.exercises.grading import NotYet

RIVALS = ("mpc", "lqr")
"""Controllers of the library that fly beside the student's."""

SETTLED = 2.0
"""Seconds at the start that are not scored: every flight begins with a small lean."""

FLIGHTS = (
    Scenario("hover, pushed twice", "", 12.0, Hover(), (Push(3.0, (0.006, 0.0)), Push(7.0, (0.0, -0.006))), seed=1),
    Scenario("circle of 0.4 m", "", 16.0, Circle(radius=0.4, period=8.0), seed=2),
    Scenario("hover, rod of 0.6 m", "", 8.0, Hover(), (Push(3.0, (0.003, 0.0)),), seed=3,
             params=Params().replace(pendulum__length=0.6, piloting__initial_length=0.6)),
)  # fmt: skip
"""What is flown; the controller is given the true length."""


class OwnController:
    """A student's function (state, reference, length) -> two body rates, as a controller.

    Raises NotYet, in one sentence, where the function stops or returns something else.
    """

    def __init__(self, function: Callable[..., Any], params: Params) -> None:
        self._function, self._limit = function, params.vehicle.max_body_rate

    def solve(self, state: ArrayLike, reference: ArrayLike, length: float | None = None) -> Solution:
        """Ask the function; its rates are cut off at the vehicle's limit."""
        try:
            rates = self._function(np.array(state), np.array(reference), length)
        except Exception as error:
            raise NotYet(f"your controller stops with {type(error).__name__}: {error}") from error
        return answer(two_rates(rates), self._limit)


def two_rates(rates: Any) -> NDArray:
    """Return what a student's controller returned, as rates (2,) in rad/s. Raises NotYet: it is something else."""
    if rates is None or rates is ...:
        raise NotYet("your controller returns nothing yet: return two body rates in rad/s, about x and about y")
    try:
        if np.iscomplexobj(rates):  # NumPy would drop the imaginary part
            raise TypeError
        given = np.asarray(rates, dtype=float).squeeze()
    except (TypeError, ValueError):
        raise NotYet(f"your controller returns {rates!r:.60}, and not two numbers") from None
    if given.shape != (2,):
        raise NotYet(f"your controller returns an array of shape {np.shape(rates)}: return two body rates in rad/s")
    if not np.isfinite(given).all():
        raise NotYet(f"your controller returns {given.tolist()}: is a root negative, or 0/0 taken?")
    return given


@dataclass(frozen=True)
class Score:
    """One flight of one controller: ``fell`` at s (nan if the rod stayed up), rms ``error`` in m, ``effort`` in rad/s.

    ``error`` is the distance of the seat from the reference, ``effort`` the body rate commanded about x and y, both
    after the first ``SETTLED`` seconds. Of a flight that ended in a fall they are nan.
    """

    controller: str
    flight: str
    fell: float
    error: float
    effort: float


def score(name: str, make: Callable[[Params], Controller], scenario: Scenario) -> Score:
    """Fly a scenario with the controller that ``make`` makes of the parameters."""
    flight = flown(scenario, make)
    if any(event.kind == "fall" for event in flight.events):
        return Score(name, scenario.name, flight.duration, np.nan, np.nan)
    truth, command = flight.truth_state, flight.command
    times = flight.time(truth)
    wanted = scenario.reference.at(times)[:, [X, Y]]
    missed = np.hypot(*(truth.values[:, [X, Y]] - wanted)[times > SETTLED].T)
    rates = np.hypot(*command.values[flight.time(command) > SETTLED, :2].T)
    return Score(name, scenario.name, np.nan, float(np.sqrt(np.mean(missed**2))), float(np.sqrt(np.mean(rates**2))))


def scores(controller: Callable[..., Any]) -> list[Score]:
    """Score a student's controller and ``RIVALS`` on ``FLIGHTS``. Raises NotYet: what it returns are not two rates."""
    OwnController(controller, Params()).solve(np.zeros(len(STATES)), np.zeros((61, len(STATES))), 1.0)
    makers: dict[str, Callable[[Params], Controller]] = {"yours": lambda params: OwnController(controller, params)}
    for name in RIVALS:
        makers[name] = lambda params, name=name: controller_of(params.replace(piloting__controller=name))
    return [score(name, make, scenario) for scenario in FLIGHTS for name, make in makers.items()]


def check(controller: Callable[..., Any]) -> None:
    """Print the scores, and how the student's compare; raises nothing, so that a notebook runs on."""
    try:
        found = scores(controller)
    except NotYet as refusal:
        print(f"not yet: {refusal}")
        return
    print(f"{'flight':22}{'controller':12}{'stays up':12}{'rms error':>11}{'rms effort':>13}")
    for row in found:
        up = "yes" if np.isnan(row.fell) else f"{row.fell:.1f} s"
        numbers = f"{100 * row.error:8.1f} cm{np.degrees(row.effort):8.1f} deg/s" if up == "yes" else ""
        print(f"{row.flight:22}{row.controller:12}{up:12}{numbers}".rstrip())
    print(verdict(found))


def verdict(found: list[Score]) -> str:
    """Say in a sentence or two how the student's controller compares with the MPC."""
    own = [row for row in found if row.controller == "yours"]
    mpc = {row.flight: row for row in found if row.controller == "mpc"}
    up = [row for row in own if np.isnan(row.fell)]
    words = f"Your controller keeps the rod up in {len(up)} of {len(own)} flights"
    if not up:
        return f"{words}: does it push the vehicle under the rod, with the signs of both axes?"
    error, effort = (
        np.exp(np.mean([np.log(getattr(row, name) / getattr(mpc[row.flight], name)) for row in up]))
        for name in ("error", "effort")
    )
    return f"{words}; there its error is {error:.2f} times that of the MPC, its effort {effort:.2f} times."
