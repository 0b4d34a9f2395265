"""The simulated vehicle, its sensors and its flights. Everything recorded here is called simulated.

The plant runs in steps of 1/960 s, four to a frame of motion capture. A frame is exposed, delayed, rounded to the
single precision in which NatNet streams it, and given to the same ``Pilot`` that flies a vehicle; its commands act
after the delay and lag of the inner loop.
"""

import dataclasses
import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fiplib import __version__
from fiplib.dynamics import PLANT
from fiplib.estimators.base import Estimate
from fiplib.estimators.windows import RawWindow
from fiplib.kalman import Window
from fiplib.mpc import Status
from fiplib.params import GRAVITY, NANO, Params
from fiplib.pilot import Circle, Command, Hover, Pilot, Reference, estimator_of
from fiplib.recording import EPOCH, Measurement, Recorder


class Push(NamedTuple):
    """A constant force on the rod's COM: start and duration in s, impulse (x, y) in N s."""

    start: float
    impulse: tuple[float, float]
    duration: float = 0.05


@dataclass(frozen=True)
class Scenario:
    """One simulated flight, fully determined.

    ``told_lengths`` are (time s, length m): from that time on the pilot is told this length instead of an estimate.
    """

    name: str
    description: str
    duration: float
    reference: Reference
    pushes: tuple[Push, ...] = ()
    told_lengths: tuple[tuple[float, float], ...] = ()
    params: Params = field(default_factory=Params)
    seed: int = 1

    def metadata(self) -> dict[str, Any]:
        """What a bag of this flight carries about its origin; not ``safety`` and ``radio``, as ``fly`` uses neither."""
        params = self.params.to_dict()
        del params["safety"], params["radio"]
        return {
            "origin": "simulated",
            "version": __version__,
            "scenario": self.name,
            "description": self.description,
            "seed": self.seed,
            "reference": {"kind": type(self.reference).__name__, **dataclasses.asdict(self.reference)},
            "pushes": [{**push._asdict(), "impulse": list(push.impulse)} for push in self.pushes],
            "told_lengths": [list(told) for told in self.told_lengths],
            "params": params,
        }


class Plant:
    """The coupled plant with the inner loop's delay, advanced frame by frame.

    Args:
        params: vehicle, pendulum, simulation.
        position: (3,) m, where the vehicle hovers at the start.
        lean: (a, b) in m at the start.
    """

    def __init__(self, params: Params, position: ArrayLike, lean: ArrayLike = (0.0, 0.0)) -> None:
        from fiplib import kernels

        simulation = params.simulation
        self.substeps = round(simulation.plant_rate / params.piloting.mocap_rate)
        self._radius = params.pendulum.length / 2
        self.x = np.zeros(20)
        self.x[PLANT["position"]] = position
        self.x[9] = 1.0
        direction = np.array([*lean, 0.0]) / self._radius
        direction[2] = math.sqrt(1.0 - direction @ direction)
        self.x[PLANT["direction"]] = direction
        weight = (params.vehicle.mass + params.pendulum.mass) * GRAVITY
        self.x[PLANT["thrust"]] = weight
        self._commands: deque[tuple[int, NDArray]] = deque()
        self._held = np.array([0.0, 0.0, 0.0, weight])
        self._substep = 0
        latency = simulation.mocap_latency + simulation.rate_delay
        self._delay = round(latency * simulation.plant_rate)
        self._schedule = np.zeros((self.substeps, 4))
        self._kernels, self._about = kernels, kernels.plant_constants(params)

    def command(self, body_rate: ArrayLike, thrust: float, at: int | None = None) -> None:
        """Give a command (rad/s, N) computed from the frame exposed now; it acts after latency and delay.

        In real time ``at`` says the substep at which it acts instead, counted from the start.
        """
        self._commands.append((self._substep + self._delay if at is None else at, np.array([*body_rate, thrust])))

    def advance(self, force: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        """One frame of motion capture further, with a constant force (3,) in N on the rod's COM."""
        for row in range(self.substeps):
            while self._commands and self._commands[0][0] <= self._substep + row:
                self._held = self._commands.popleft()[1]
            self._schedule[row] = self._held
        self._kernels.advance(self.x, self._schedule, np.array(force, dtype=float), self._about)
        self._substep += self.substeps

    def truth(self) -> NDArray:
        """The ten true states and the height z, in the order of ``recorder.ROLES["truth_state"]``."""
        truth = np.empty(11)
        self._kernels.true_state(self.x, self._radius, truth)
        return truth

    @property
    def fallen(self) -> bool:
        """Whether rod or vehicle lean too far to come back, or the vehicle is on the ground."""
        return self._kernels.fallen(self.x)


class Mocap:
    """Motion capture of both bodies: seeded noise, then rounding to the single precision that NatNet streams."""

    def __init__(self, params: Params, frames: int, rng: np.random.Generator) -> None:
        from fiplib import kernels

        self._kernels = kernels
        scale = np.repeat([params.simulation.position_noise, params.simulation.attitude_noise], 6)
        self._noise = rng.normal(size=(frames, 12)) * scale
        self._radius = params.pendulum.length / 2

    def frame(self, index: int, stamp: int, x: NDArray) -> Measurement:
        """The frame ``index`` of the plant state x (20,), exposed at ``stamp`` ns."""
        frame = np.empty(14)
        self._kernels.expose(x, self._radius, self._noise[index], frame)
        return Measurement(stamp, frame[:3], frame[3:7], frame[7:10], frame[10:])


class Outcome(NamedTuple):
    """How a simulated flight ended: seconds flown, and whether rod and vehicle were still up."""

    duration: float
    survived: bool


def fly(
    scenario: Scenario,
    recorder: Recorder,
    progress: Callable[[float], None] | None = None,
    vehicle: Callable[[Params, ArrayLike, ArrayLike], Plant] = Plant,
) -> Outcome:
    """Fly a scenario in the simulator, through the pilot, into a recorder.

    Args:
        scenario: the flight.
        recorder: where it is written to.
        progress: called with the simulated seconds done, about once per simulated second.
        vehicle: makes the plant of parameters, position and lean; another one flies what the pilot is not told.

    Returns:
        How it ended; a fall ends the flight early and is recorded as an event.
    """
    params, seed = scenario.params, scenario.seed
    rate = params.piloting.mocap_rate
    frames = round(scenario.duration * rate)
    rng = np.random.default_rng(seed)
    start = scenario.reference.at(np.zeros(1))[0]
    lean = rng.normal(size=2) * params.simulation.initial_lean
    plant = vehicle(params, (start[0], start[2], scenario.reference.height), lean)
    mocap, pilot = Mocap(params, frames, rng), Pilot(params, scenario.reference)
    estimator = SimulatedEstimator(params, seed)
    latency = round(params.simulation.mocap_latency * NANO)
    told = deque(scenario.told_lengths)
    pushes = deque(scenario.pushes)
    status, refused = Status.OPTIMAL, None

    recorder.truth_length(EPOCH, params.pendulum.length)
    recorder.length(EPOCH, pilot.length, math.nan, math.nan)
    for index in range(frames):
        seconds = index / rate
        stamp = EPOCH + round(index * NANO / rate)
        now = stamp + latency
        measurement = mocap.frame(index, stamp, plant.x)
        recorder.pose("vehicle", stamp, now, measurement.vehicle_position, measurement.vehicle_attitude)
        recorder.pose("pendulum", stamp, now, measurement.pendulum_position, measurement.pendulum_attitude)
        recorder.truth(stamp, plant.truth())
        command = pilot.step(now, measurement)
        if command is not None:
            plant.command(command.body_rate, command.thrust * params.vehicle.max_thrust)
            _record_command(recorder, command, status)
            status = command.status
        if estimate := estimator.deliver(now, pilot.window_due()):
            if estimate.reason is None:
                used = pilot.receive_estimate(estimate.length, estimate.standard_deviation)
                recorder.length(now, used, estimate.length, estimate.standard_deviation)
            elif estimate.reason != refused:
                recorder.event(now, "warn", f"no estimate: {estimate.reason}")
            refused = estimate.reason
        if told and seconds >= told[0][0]:
            length = told.popleft()[1]
            recorder.event(now, "warn", f"pilot is told the length {length:g} m")
            recorder.length(now, pilot.receive_estimate(length), length, math.nan)
        force = np.zeros(3)
        if pushes and seconds >= pushes[0].start:
            push = pushes[0]
            if seconds < push.start + 1 / rate:
                recorder.event(now, "info", f"push of {1e3 * math.hypot(*push.impulse):g} mN s on the rod's COM")
            force[:2] = np.array(push.impulse) / push.duration
            if seconds >= push.start + push.duration - 1 / rate:
                pushes.popleft()
        plant.advance(force)
        if plant.fallen:
            recorder.event(now, "error", "rod or vehicle fell: flight ended")
            return Outcome(seconds, False)
        if progress and index % round(rate) == 0:
            progress(seconds)
    return Outcome(scenario.duration, True)


def _record_command(recorder: Recorder, command: Command, before: Status) -> None:
    recorder.state(command.stamp, command.state)
    recorder.reference(command.stamp, command.reference)
    recorder.command(command.stamp, command.body_rate, command.thrust)
    if command.status is not before:
        recorder.event(command.stamp, "info", f"MPC status {command.status.value}")


class SimulatedEstimator:
    """The estimator beside the controller: takes one window at a time and answers ``estimation_latency`` later."""

    def __init__(self, params: Params, seed: int) -> None:
        self._params, self._seed, self._runs = params, seed, 0
        self._estimate = estimator_of(params).function
        self._ready: tuple[int, Estimate] | None = None

    @property
    def due(self) -> int | None:
        """When the answer of the run under way will be delivered, ns; ``None`` if none is."""
        return self._ready[0] if self._ready else None

    def deliver(self, now: int, window: Window | RawWindow | None) -> Estimate | None:
        answer = None
        if self._ready and now >= self._ready[0]:
            answer, self._ready = self._ready[1], None
        if window is not None and self._ready is None:
            # a generator of its own for each run: a run can be repeated from the bag alone
            rng = np.random.default_rng([self._seed, self._runs])
            self._runs += 1
            due = now + round(self._params.simulation.estimation_latency * NANO)
            self._ready = (due, self._estimate(window, self._params, rng))
        return answer


def _scenarios() -> dict[str, Scenario]:
    params = Params()
    quick = Circle(radius=0.4, period=8.0)
    flights = [
        Scenario(
            "push-hover",
            "Hover at (0, 0, 1.3) m; the rod is pushed at 5.3, 12 and 20.2 s",
            26.0,
            Hover(),
            pushes=(Push(5.3, (0.008, 0.0)), Push(12.0, (0.0, 0.007)), Push(20.2, (-0.005, 0.005))),
        ),
        Scenario("circle-0.8", "Circle of 0.8 m radius", 26.0, Circle(radius=0.8, period=9.0)),
        *(
            Scenario(
                f"estimate-{length:.1f}",
                f"Circle of 0.4 m radius; the length is estimated in flight from l0 = {length:.1f} m",
                25.0,
                quick,
                params=params.replace(piloting__initial_length=length, piloting__estimate=True),
                seed=seed,
            )
            for seed, length in enumerate((0.8, 1.2, 1.4), start=1)
        ),
        Scenario(
            "length-jump",
            "Circle of 0.4 m radius; the pilot is told lengths that jump by 0.6 m, and then by 0.85 m",
            26.0,
            quick,
            told_lengths=((6.0, 0.4), (11.0, 1.0), (16.0, 1.85)),
            params=params.replace(estimation__median_length=1),
        ),
    ]
    return {scenario.name: scenario for scenario in flights}


SCENARIOS = _scenarios()
"""The flights recorded in ``data/``, by name."""
