"""The simulated vehicle, its sensors and its flights. Everything recorded here is called simulated.

The plant runs in steps of 1/960 s, four to a frame of motion capture. A frame is exposed, delayed, rounded to the
single precision in which NatNet streams it, and given to the same ``Pilot`` that flies a vehicle; its commands act
after the delay and lag of the inner loop.
"""

import dataclasses
import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fiplib import __version__
from fiplib.dynamics import PLANT
from fiplib.estimators.base import Estimate
from fiplib.estimators.windows import RawWindow
from fiplib.kalman import Window
from fiplib.kernels.disturbance import Disturbance
from fiplib.mpc import Status
from fiplib.params import GRAVITY, NANO, Params
from fiplib.pilot import Pilot, estimator_of
from fiplib.recording import EPOCH, Event, Flight, Measurement, MemoryRecorder, Recorder
from fiplib.references import Circle, Hover, Reference

GROUND = 0.1
"""Height of the seat below which the simulated vehicle is on the ground, m: ``Plant.fallen``, and it rests there."""

NOISE_FRAMES = 240
"""Frames whose noise is drawn at once: of a minute it takes 2 to 10 ms, which is a late frame in real time."""


class Push(NamedTuple):
    """A constant force on the rod's COM: start and duration in s, impulse (x, y) in N s."""

    start: float
    impulse: tuple[float, float]
    duration: float = 0.05

    def event(self, stamp: int) -> Event:
        """Return the event to record when the push begins, at ``stamp`` ns."""
        data = {"impulse": list(self.impulse), "duration": self.duration}
        return Event(stamp, "info", f"push of {1e3 * math.hypot(*self.impulse):g} mN s on the rod's COM", "push", data)


@dataclass(frozen=True)
class Scenario:
    """One simulated flight, fully determined.

    ``told_lengths`` are (time s, length m): from that time on the pilot is given this length instead of an estimate.

    Raises ValueError: duration, seed, pushes or told lengths are impossible, or not in the order of time.
    """

    name: str
    description: str
    duration: float
    reference: Reference
    pushes: tuple[Push, ...] = ()
    told_lengths: tuple[tuple[float, float], ...] = ()
    params: Params = field(default_factory=Params)
    seed: int = 1

    def __post_init__(self) -> None:
        told, ends = [time for time, _ in self.told_lengths], [push.start + push.duration for push in self.pushes]
        possible = {
            "a finite duration above 0 s": 0.0 < self.duration < math.inf,
            "a whole seed, 0 or more": isinstance(self.seed, int | np.integer) and self.seed >= 0,
            "pushes of finite impulses that last longer than 0 s": all(
                math.isfinite(sum(push.impulse)) and 0.0 < push.duration < math.inf for push in self.pushes
            ),
            "pushes from 0 s on, each after the end of the one before": all(
                start >= end - 1e-9
                for start, end in zip([push.start for push in self.pushes], [0.0, *ends], strict=False)
            ),
            "told lengths in the order of time": all(map(math.isfinite, told)) and told == sorted(told),
        }
        for needed, given in possible.items():
            if not given:
                raise ValueError(f"scenario {self.name!r} needs {needed}")

    def metadata(self) -> dict[str, Any]:
        """Return what a bag of this flight carries about its origin."""
        return {
            "origin": "simulated",
            "version": __version__,
            "scenario": self.name,
            "description": self.description,
            "seed": self.seed,
            "reference": {"kind": type(self.reference).__name__, **dataclasses.asdict(cast(Any, self.reference))},
            "pushes": [{**push._asdict(), "impulse": list(push.impulse)} for push in self.pushes],
            "told_lengths": [list(told) for told in self.told_lengths],
            "params": self.params.to_dict(),
        }


class Plant:
    """The coupled plant with the inner loop's delay, advanced frame by frame.

    Args:
        params: vehicle, pendulum, simulation.
        position: (3,) m, of the seat, where the vehicle hovers at the start.
        lean: (a, b) in m at the start.
    """

    def __init__(self, params: Params, position: ArrayLike, lean: Iterable[float] = (0.0, 0.0)) -> None:
        from fiplib.kernels import poses, vehicle

        simulation, self._about = params.simulation, vehicle.plant_constants(params)
        self.substeps = round(simulation.plant_rate / params.piloting.mocap_rate)
        self._radius = params.pendulum.length / 2
        self.x = np.zeros(20)
        self.x[PLANT["position"]] = position
        self.x[9] = 1.0
        across, along = (float(offset) / self._radius for offset in lean)
        self.x[PLANT["direction"]] = across, along, math.sqrt(1.0 - across * across - along * along)
        weight = (params.vehicle.mass + params.pendulum.mass) * GRAVITY
        self.x[PLANT["thrust"]] = weight
        self._commands: deque[tuple[int, NDArray]] = deque()
        self._held = np.array([0.0, 0.0, 0.0, weight])
        self._substep = 0
        latency = simulation.mocap_latency + simulation.rate_delay
        self.delay = round(latency * simulation.plant_rate)
        """Substeps after which a command acts."""
        self._schedule = np.zeros((self.substeps, 4))
        self._advance, self._fallen, self._true_state = vehicle.advance, vehicle.fallen, poses.true_state

    def command(self, body_rate: Iterable[float], thrust: float, at: int | None = None) -> None:
        """Give a command (rad/s, N) computed from the frame exposed now; it acts after latency and delay.

        In real time ``at`` says the substep at which it acts instead, counted from the start.
        """
        self._commands.append((self._substep + self.delay if at is None else at, np.array([*body_rate, thrust])))

    def advance(self, force: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        """One frame further, with a constant force (3,) in N on the rod's COM, or a load of ``Disturbance``."""
        for row in range(self.substeps):
            while self._commands and self._commands[0][0] <= self._substep + row:
                self._held = self._commands.popleft()[1]
            self._schedule[row] = self._held
        self._advance(self.x, self._schedule, np.array(force, dtype=float), self._about)
        self._substep += self.substeps

    def truth(self) -> NDArray:
        """Return the ten true states and the height z, in the order of ``recording.ROLES["truth_state"]``."""
        truth = np.empty(11)
        self._true_state(self.x, self._radius, truth)
        return truth

    @property
    def fallen(self) -> bool:
        """Return whether rod or vehicle lean too far to come back, or the vehicle is on the ground."""
        return self._fallen(self.x)


class Mocap:
    """Motion capture of both bodies: seeded noise, then rounding to the single precision that NatNet streams."""

    def __init__(self, params: Params, frames: int, rng: np.random.Generator) -> None:
        from fiplib.kernels import poses

        self._expose = poses.expose
        scale = np.repeat([params.simulation.position_noise, params.simulation.attitude_noise], 6)
        self.noise = rng.normal(size=(frames, 12)) * scale
        """Noise of both positions in m, then of both attitudes in rad, (frames, 12)."""
        self._radius, self._seat = params.pendulum.length / 2, params.seat_above_tracked

    def frame(self, index: int, stamp: int, x: NDArray) -> Measurement:
        """Return the frame ``index`` of the plant state x (20,), exposed at ``stamp`` ns."""
        frame = np.empty(14)
        self._expose(x, self._radius, self._seat, self.noise[index], frame)
        return Measurement(stamp, frame[:3], frame[3:7], frame[7:10], frame[10:])


class PushSchedule:
    """Pushes frame by frame, ``rate`` of them a second."""

    def __init__(self, pushes: Iterable[Push], rate: float) -> None:
        self._pushes, self._rate = deque(pushes), rate

    def at(self, frame: int) -> tuple[NDArray, Push | None]:
        """Force (3,) in N on the rod's COM over a frame, the next one; and the push that begins in it, if one does."""
        seconds, force, begun = frame / self._rate, np.zeros(3), None
        if self._pushes and seconds >= self._pushes[0].start:
            push = self._pushes[0]
            if seconds < push.start + 1 / self._rate:
                begun = push
            force[:2] = np.array(push.impulse) / push.duration
            if seconds >= push.start + push.duration - 1 / self._rate:
                self._pushes.popleft()
        return force, begun


class SimulatedVehicle:
    """A scenario's plant, its motion capture and its pushes, frame by frame; held in place until first commanded.

    ``vehicle`` makes the plant of parameters, position and lean; another one flies what the pilot does not know of.
    """

    def __init__(self, scenario: Scenario, vehicle: Callable[..., Plant] = Plant) -> None:
        self._params, self.rate = scenario.params, scenario.params.piloting.mocap_rate
        self._rng = np.random.default_rng(scenario.seed)
        start = scenario.reference.at(np.zeros(1))[0]
        lean = self._rng.normal(size=2) * self._params.simulation.initial_lean
        mistaken = self._params.piloting.seat_height - self._params.seat_above_tracked
        # the seat is where the pilot takes it to be at the trajectory's height
        self.plant = vehicle(self._params, (start[0], start[2], scenario.reference.height - mistaken), lean)
        self.pushes = PushSchedule(scenario.pushes, self.rate)
        self.disturbance = Disturbance(self._params, scenario.seed)
        self._frames = 0
        self.flown: int | None = None
        """Frames since it was first commanded; ``None`` before."""

    def mocap(self, frames: int) -> Mocap:
        """Motion capture of the next frames: their noise follows that of the frames before."""
        return Mocap(self._params, frames, self._rng)

    def measure(self, stamp: int) -> Measurement:
        """Return the frame exposed now, at ``stamp`` ns."""
        index, self._frames = self._frames % NOISE_FRAMES, self._frames + 1
        if index == 0:
            self._mocap = self.mocap(NOISE_FRAMES)
        return self._mocap.frame(index, stamp, self.plant.x)

    @property
    def landed(self) -> bool:
        """Return whether the vehicle has come to rest on the ground."""
        return self.plant.x[2] < GROUND

    def command(self, command: Any, at: int | None = None) -> None:
        """Take ``body_rate`` (3,) in rad/s and ``thrust`` in [0, 1], to act after the usual delay or at a substep."""
        self.flown = self.flown or 0
        self.plant.command(command.body_rate, command.thrust * self._params.vehicle.max_thrust, at)

    def advance(self) -> Push | None:
        """One frame further; the push that begins in it, if one does: record its ``event``."""
        if self.flown is None or self.landed:
            return None
        force, begun = self.pushes.at(self.flown)
        self.plant.advance(self.disturbance.load(force))
        self.flown += 1
        return begun


class ParallelEstimator(Protocol):
    """An estimator that runs beside the flight: the simulator's, or one in a process of its own."""

    remarks: deque[tuple[str, str]]
    """Remarks of the estimator about itself, as (level, text); the reader removes them."""
    seconds: float
    """How long its last run took, s; nan where that is not known."""

    def deliver(self, now: int, window: Window | RawWindow | None) -> Estimate | None:
        """Give it a window (if one is due) at ``now`` ns; its newest estimate, once."""
        ...


class SimulatedEstimator:
    """The estimator beside the controller: takes one window at a time and answers ``estimation_latency`` later.

    ``function`` (window, params, rng) -> Estimate stands in for the one that the parameters name.
    """

    seconds = math.nan

    def __init__(self, params: Params, seed: int, function: Callable[..., Estimate] | None = None) -> None:
        self._params, self._seed, self._runs = params, seed, 0
        self._estimate = function or estimator_of(params).function
        self._ready: tuple[int, Estimate] | None = None
        self.remarks: deque[tuple[str, str]] = deque()

    @property
    def due(self) -> int | None:
        """Return when the answer of the run under way will be delivered, ns; ``None`` if none is."""
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


class LengthUpdates:
    """The lengths that a pilot receives in flight: those prescribed by the scenario, and those that are estimated.

    ``receive`` hands (time ns, length m, standard deviation m) over and returns the length used from then on. Lengths,
    refusals and the estimator's remarks are recorded; ``say`` takes the remarks, too.
    """

    def __init__(
        self,
        scenario: Scenario,
        estimator: ParallelEstimator | None,
        receive: Callable[[int, float, float], float],
        recorder: Recorder,
        say: Callable[[str], None] = lambda text: None,
    ) -> None:
        self._prescribed, self._estimator = deque(scenario.told_lengths), estimator
        self._receive, self._recorder, self._say = receive, recorder, say
        self.latest = Estimate(math.nan, math.nan)
        """The last estimate that was not refused."""
        self._refused: str | None = None

    @property
    def prescribed_at(self) -> float:
        """Seconds after the start at which the next prescribed length is due; inf if there is none."""
        return self._prescribed[0][0] if self._prescribed else math.inf

    def update(self, now: int, seconds: float, window: Window | RawWindow | None) -> None:
        """One frame at ``now`` ns, ``seconds`` after the start (nan before it), with a window if a run is due."""
        if self._estimator is not None:
            estimate = self._estimator.deliver(now, window)
            while self._estimator.remarks:  # one at a time: another thread may add to them
                level, text = self._estimator.remarks.popleft()
                self._recorder.event(now, level, text)
                self._say(text)
            if estimate is not None and estimate.reason is None:
                used = self._receive(now, estimate.length, estimate.standard_deviation)
                self._recorder.length(now, used, estimate.length, estimate.standard_deviation)
                self.latest, self._refused = estimate, None
            elif estimate is not None and (reason := estimate.reason) != self._refused:  # recorded once, not every run
                self._refused = reason
                self._recorder.event(now, "warn", f"no estimate: {reason}", "refusal", {"reason": reason})
        if seconds >= self.prescribed_at:
            length = self._prescribed.popleft()[1]
            self._recorder.event(now, "warn", f"pilot is told the length {length:g} m", "length", {"length": length})
            self._recorder.length(now, self._receive(now, length, math.nan), length, math.nan)


def frames(
    scenario: Scenario, simulated: SimulatedVehicle, pilot: Pilot, lengths: LengthUpdates, tape: Recorder
) -> Iterator[float]:
    """Fly frame by frame, recording on ``tape``; yields the seconds flown. A fall ends it and is recorded."""
    tape.numbers("truth_length", EPOCH, [scenario.params.pendulum.length])
    tape.length(EPOCH, pilot.length, math.nan, math.nan)
    rate, status = simulated.rate, Status.OPTIMAL
    latency = round(scenario.params.simulation.mocap_latency * NANO)
    for index in range(round(scenario.duration * rate)):
        seconds = index / rate
        stamp = EPOCH + round(index * NANO / rate)
        now = stamp + latency
        measurement = simulated.measure(stamp)
        tape.pose("vehicle", stamp, now, measurement.vehicle_position, measurement.vehicle_attitude)
        tape.pose("pendulum", stamp, now, measurement.pendulum_position, measurement.pendulum_attitude)
        tape.numbers("truth_state", stamp, simulated.plant.truth())
        command = pilot.step(now, measurement)
        if command is not None:
            simulated.command(command)
            tape.numbers("state", now, command.state)
            tape.numbers("reference", now, command.reference)
            tape.command(now, command.body_rate, command.thrust)
            if command.status is not status:
                status = command.status
                tape.event(*event_of_status(now, status))
        lengths.update(now, seconds, pilot.window_due())
        if push := simulated.advance():
            tape.event(*push.event(now))
        if simulated.plant.fallen:
            tape.event(*event_of_fall(now))
            return
        yield seconds


def fly(
    scenario: Scenario,
    recorder: Recorder | None = None,
    progress: Callable[[float], None] | None = None,
    vehicle: Callable[..., Plant] = Plant,
) -> Flight:
    """Fly a scenario in the simulator, through the pilot; returns the flight as ``bags.read`` gives it from its bag.

    It is also written to ``recorder``. ``progress`` is called with the simulated seconds done, about once per simulated
    second. ``vehicle`` is that of ``SimulatedVehicle``. A fall ends the flight early and is recorded as an event.
    """
    params, tape = scenario.params, MemoryRecorder(recorder)
    simulated, pilot = SimulatedVehicle(scenario, vehicle), Pilot(params, scenario.reference)
    estimator = SimulatedEstimator(params, scenario.seed)
    lengths = LengthUpdates(scenario, estimator, lambda _, *estimate: pilot.receive_estimate(*estimate), tape)
    for index, seconds in enumerate(frames(scenario, simulated, pilot, lengths, tape)):
        if progress and index % round(simulated.rate) == 0:
            progress(seconds)
    return tape.flight(scenario.name, scenario.metadata())


def event_of_status(stamp: int, status: Status) -> Event:
    """Return the event to record when the MPC's answer is of another kind than the one before, at ``stamp`` ns."""
    return Event(stamp, "info", f"MPC status {status.value}", "status", {"status": status.value})


def event_of_fall(stamp: int) -> Event:
    """Return the event that ends a flight early, at ``stamp`` ns."""
    return Event(stamp, "error", "rod or vehicle fell: flight ended", "fall")


_QUICK = Circle(radius=0.4, period=8.0)
_FLIGHTS = (
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
            _QUICK,
            params=Params().replace(piloting__initial_length=length, piloting__estimate=True),
            seed=seed,
        )
        for seed, length in enumerate((0.8, 1.2, 1.4), start=1)
    ),
    Scenario(
        "length-jump",
        "Circle of 0.4 m radius; the pilot is told lengths that jump by 0.6 m, and then by 0.85 m",
        26.0,
        _QUICK,
        told_lengths=((6.0, 0.4), (11.0, 1.0), (16.0, 1.85)),
        params=Params().replace(estimation__median_length=1),
    ),
)

SCENARIOS = {scenario.name: scenario for scenario in _FLIGHTS}
"""The flights recorded in ``data/``, by name."""
