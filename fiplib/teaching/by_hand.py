"""A flight of the simulator that its user steers: pushes, target, length, weights and controller change in flight.

``HandFlight`` is the simulator of ``fiplib.simulate``, one frame after the other, with the pilot of every other flight.
It has neither clock nor thread: ``fiplib.teaching.viewer`` runs it against the clock.
"""

import math
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fiplib.controllers import Controller, controller_of
from fiplib.estimators import ESTIMATORS
from fiplib.estimators.base import Estimate
from fiplib.estimators.windows import RawWindow
from fiplib.kalman import Window
from fiplib.mpc import Solution
from fiplib.params import A_DOT, B_DOT, NANO, X_DOT, Y_DOT, A, B, FipError, Params, X, Y
from fiplib.pilot import Pilot, Tick
from fiplib.recording import EPOCH, Flight, MemoryRecorder
from fiplib.references import Circle, Hover, Reference
from fiplib.simulate import LengthUpdates, Push, PushSchedule, Scenario, SimulatedEstimator, SimulatedVehicle, frames

LONGEST = 600.0
"""Seconds after which a flight by hand ends: its recording takes some 50 MB by then."""

SPEED = 0.4
"""Mean speed in m/s at which the target moves to a new place; the fastest of our recorded circles flies 0.56 m/s."""

CIRCLE = Circle(radius=0.4, period=8.0, start=0.5)
"""The circle that the target follows if asked: that of the flights with an estimated length."""

NO_ESTIMATE = "none: the slider decides"
"""The choice of no estimator."""

OURS = Params().control.state_weights


def _weighted(**factors: float) -> tuple[float, ...]:
    """The state weights of the library, those of position, lean and tilt multiplied."""
    groups = {"position": (X, X_DOT, Y, Y_DOT), "lean": (A, A_DOT, B, B_DOT)}
    weights = list(OURS)
    for name, factor in factors.items():
        for index in groups[name]:
            weights[index] *= factor
    return tuple(weights)


WEIGHTS = {
    "as in the library": OURS,
    "position ten times": _weighted(position=10.0),
    "position a tenth": _weighted(position=0.1),
    "lean ten times": _weighted(lean=10.0),
    "lean a hundredth": _weighted(lean=0.01),
    "all a hundredth: rates are dear": _weighted(position=0.01, lean=0.01),
}
"""State weights Q of the controllers by name, in the order of ``params.STATES``."""


class Target(Reference):
    """A reference that is moved in flight: a place that glides to the next one, and a circle through it if asked.

    A glide begins and ends at rest and takes as long as ``SPEED`` demands; the controller sees it coming, as far as its
    horizon reaches.
    """

    height: float = 1.3

    def __init__(self) -> None:
        self._from, self._to, self._since, self._lasts = np.zeros(2), np.zeros(2), 0.0, 1.0
        self._circle: Circle | None = None

    @property
    def place(self) -> tuple[float, float]:
        """Where the target rests or glides to, (x, y) in m."""
        return float(self._to[0]), float(self._to[1])

    @property
    def circling(self) -> bool:
        """Whether the circle is followed."""
        return self._circle is not None

    def go(self, now: float, x: float, y: float) -> None:
        """Glide to the place (x, y) in m, from ``now`` on, in s of the reference's time."""
        self._from = self._glide(np.array([now]))[0][0]
        self._to, self._since = np.array([x, y], dtype=float), now
        self._lasts = max(0.5, float(np.hypot(*(self._to - self._from))) / SPEED)

    def circle(self, now: float, on: bool) -> None:
        """Fly a circle that begins at the place, from ``now`` on, or end it: the place is then where it was left."""
        if on and self._circle is None:
            self._circle = replace(CIRCLE, start=now + CIRCLE.start)
        elif not on and self._circle is not None:
            here = self.at(np.array([now]))[0, [X, Y]]
            self._circle, goal = None, self._to
            self._from, self._to, self._since, self._lasts = (
                here,
                goal,
                now,
                0.5 + float(np.hypot(*(goal - here))) / SPEED,
            )

    def at(self, times: NDArray) -> NDArray:
        states = np.zeros((len(times), 10))
        states[:, [X, Y]], states[:, [X_DOT, Y_DOT]] = self._glide(times)
        if self._circle is not None:
            states += self._circle.at(times)
            states[:, X] -= self._circle.radius
        return states

    def _glide(self, times: NDArray) -> tuple[NDArray, NDArray]:
        """Places and velocities (n, 2) at the times in s: a quintic, whose ends have neither speed nor acceleration."""
        way, share = self._to - self._from, np.clip((np.asarray(times) - self._since) / self._lasts, 0.0, 1.0)[:, None]
        place = self._from + way * share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
        return place, way * 30.0 * share**2 * (1.0 - share) ** 2 / self._lasts


class OpenPilot(Pilot):
    """The pilot, with a controller that may be replaced in flight.

    ``make`` makes it of the parameters; FipError: it returns ``None``, as where a ``return`` was forgotten.
    """

    def __init__(self, params: Params, reference: Reference, make: Callable[[Params], Controller]) -> None:
        super().__init__(params, reference)
        self.use(make, params)

    def use(self, make: Callable[[Params], Controller], params: Params) -> None:
        """Fly on with another controller."""
        made = make(params)
        if made is None:
            raise FipError("the function that makes the controller returns None: let it return the controller")
        self.controller: Controller = made

    def solve(self, tick: Tick) -> Solution:
        return self.controller.solve(tick.state, tick.reference, self.length)


class BackgroundEstimator:
    """An estimator in a thread beside the flight: a run of the genetic algorithm takes longer than a picture may.

    It answers when it is done, so that a flight with it is not repeatable.
    """

    seconds = math.nan

    def __init__(self, params: Params, seed: int) -> None:
        self._params, self._rng = params, np.random.default_rng(seed)
        self._function = ESTIMATORS[params.estimation.estimator].function
        self._worker = ThreadPoolExecutor(1, "estimator")
        self._running: Future[Estimate] | None = None
        self.remarks: deque[tuple[str, str]] = deque()

    def deliver(self, now: int, window: Window | RawWindow | None) -> Estimate | None:
        answer = None
        if self._running is not None and self._running.done():
            answer, self._running = self._running.result(), None
        if window is not None and self._running is None:
            self._running = self._worker.submit(self._function, window, self._params, self._rng)
        return answer

    def wait(self) -> None:
        """Return when no run is under way: a flight that outruns the clock would leave its estimator behind."""
        if self._running is not None:
            wait([self._running])

    def close(self) -> None:
        """End the thread, after the run under way."""
        self._worker.shutdown(wait=True, cancel_futures=True)


class HandFlight:
    """A simulated flight, hovering, that is steered while it flies.

    Args:
        rod_length: true length of the rod, m.
        used_length: the length that the controller starts with, m.
        estimator: a name in ``estimators.ESTIMATORS``, or ``NO_ESTIMATE``.
        own: a controller (params) -> Controller to fly instead of the one that ``controller`` names.
        seed: of noise and first lean.

    Raises FipError, ValueError: a name is not known, or a length not possible.
    """

    def __init__(
        self,
        rod_length: float = 1.0,
        used_length: float = 1.0,
        estimator: str = NO_ESTIMATE,
        controller: str = "mpc",
        weights: str = "as in the library",
        own: Callable[[Params], Controller] | None = None,
        seed: int = 1,
    ) -> None:
        for name, known in ((estimator, (NO_ESTIMATE, *ESTIMATORS)), (weights, WEIGHTS)):
            if name not in known:
                raise FipError(f"{name!r} is none of {', '.join(map(repr, known))}")
        chosen: dict[str, Any] = {"estimation__median_length": 1}  # a length from the slider is used at once
        if estimator != NO_ESTIMATE:
            trusted = ESTIMATORS[estimator].streams  # the one that says how sure it is
            chosen = {"piloting__estimate": True, "estimation__estimator": estimator}
            chosen["piloting__handover"] = "trusted" if trusted else "printed"
        self.params = Params().replace(
            pendulum__length=rod_length, piloting__initial_length=used_length, control__state_weights=WEIGHTS[weights],
            piloting__controller=controller, **chosen,
        )  # fmt: skip
        self._make = own or controller_of
        self.target = Target()
        scenario = Scenario(
            "by-hand", "Flown by hand in a browser", LONGEST, self.target, params=self.params, seed=seed
        )
        self.vehicle = SimulatedVehicle(scenario)
        self.pilot = OpenPilot(self.params, self.target, self._make)
        self._estimator = BackgroundEstimator(self.params, seed) if estimator != NO_ESTIMATE else None
        self._tape = MemoryRecorder()
        receive = self.pilot.receive_estimate
        self._lengths = LengthUpdates(scenario, self._estimator, lambda _, *estimate: receive(*estimate), self._tape)
        self._frames = frames(scenario, self.vehicle, self.pilot, self._lengths, self._tape)
        self._scenario = scenario
        self.seconds, self.over = 0.0, False

    def advance(self, count: int = 1) -> None:
        """Fly some frames of motion capture further; nothing happens once the flight is ``over``."""
        for _ in range(count):
            seconds = next(self._frames, None)
            if seconds is None:
                self.over = True
                return
            self.seconds = seconds

    @property
    def fallen(self) -> bool:
        """Whether rod or vehicle have fallen."""
        return self.vehicle.plant.fallen

    @property
    def estimate(self) -> Estimate:
        """The last estimate; nan before there is one."""
        return self._lengths.latest

    def push(self, x: float, y: float, duration: float = 0.05) -> None:
        """Push the rod's centre of mass with an impulse (x, y) in N s, beginning with the next frame.

        Raises FipError: they are not finite.
        """
        if not (math.isfinite(x) and math.isfinite(y)):
            raise FipError(f"an impulse must be two finite numbers in N s, not {x!r} and {y!r}")
        begin = (self.vehicle.flown or 0) / self.vehicle.rate
        self.vehicle.pushes = PushSchedule([Push(begin, (x, y), duration)], self.vehicle.rate)

    def use_length(self, length: float) -> None:
        """Give the controller a length in m, from the next control tick on."""
        used = self.pilot.receive_estimate(length)
        self._tape.length(EPOCH + round(self.seconds * NANO), used, length, math.nan)

    def use_weights(self, name: str) -> None:
        """Give the controller other state weights, one of ``WEIGHTS``."""
        self._use(self._make, self.params.replace(control__state_weights=WEIGHTS[name]))

    def use_controller(self, name: str) -> None:
        """Fly on with another controller of ``controllers.CONTROLLERS``."""
        self._use(controller_of, self.params.replace(piloting__controller=name))

    def use_own(self, own: Callable[[Params], Controller]) -> None:
        """Fly on with a controller that ``own`` makes of the parameters."""
        self._use(own, self.params)

    def _use(self, make: Callable[[Params], Controller], params: Params) -> None:
        self.pilot.use(make, params)  # first: where it fails, all stays as it was
        self._make, self.params = make, params

    def flight(self) -> Flight:
        """Return what has been flown so far, as a recorded flight."""
        return self._tape.flight(
            self._scenario.name,
            replace(self._scenario, reference=Hover()).metadata() | {"reference": {"kind": "Target"}},
        )

    def wait_for_estimate(self) -> None:
        """Wait for the estimate under way, if there is one: where the flight is faster than the clock."""
        if self._estimator is not None:
            self._estimator.wait()

    def close(self) -> None:
        """End the estimator's thread, if there is one."""
        if self._estimator is not None:
            self._estimator.close()


def flown(
    scenario: Scenario,
    controller: Callable[[Params], Controller] = controller_of,
    estimate: Callable[..., Estimate] | None = None,
) -> Flight:
    """Fly a scenario as ``simulate.fly`` does, with a controller or an estimator that is in no registry.

    ``controller`` makes it of the parameters; ``estimate`` (window, params, rng) -> Estimate takes the windows of the
    estimator that the parameters name.
    """
    params, tape = scenario.params, MemoryRecorder()
    vehicle, pilot = SimulatedVehicle(scenario), OpenPilot(params, scenario.reference, controller)
    estimator = SimulatedEstimator(params, scenario.seed, estimate)
    lengths = LengthUpdates(scenario, estimator, lambda _, *answer: pilot.receive_estimate(*answer), tape)
    for _ in frames(scenario, vehicle, pilot, lengths, tape):
        pass
    return tape.flight(scenario.name, scenario.metadata())
