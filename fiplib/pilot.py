"""The controller without clock, I/O or threads: ``Pilot.step(now, measurement) -> command``.

One pilot serves the simulator, a real vehicle and the replay of a bag. It turns poses into the ten states, solves the
MPC at the control rate, holds altitude and heading, gathers the estimator's window and takes new lengths over. Who
drives it calls ``step`` for every pair of poses; asks ``window_due`` whether an estimate is wanted; runs the estimator
wherever it likes; and gives the answer to ``receive_estimate``. Times are integer nanoseconds, as in ROS messages, so
that a replay sees exactly what the flight saw.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fiplib.controllers import controller_of
from fiplib.estimators import ESTIMATORS
from fiplib.estimators.base import Estimator
from fiplib.estimators.handover import HANDOVERS
from fiplib.estimators.windows import SAMPLERS, RawWindow
from fiplib.kalman import Window
from fiplib.mpc import MPC, Solution, Status
from fiplib.observers import Observer
from fiplib.params import AXES, NANO, PHI, STATES, THETA, Params, Piloting
from fiplib.recording import Measurement, nanoseconds, numbers_of
from fiplib.references import Reference


class Command(NamedTuple):
    """A command to the vehicle, with the state and the reference that it was computed from.

    ``body_rate`` (3,) rad/s, ``thrust`` normalised to [0, 1], ``state`` and ``reference`` (10,), ``length`` used in m.
    """

    stamp: int
    body_rate: NDArray
    thrust: float
    state: NDArray
    reference: NDArray
    length: float
    status: Status


class Tick(NamedTuple):
    """The inputs of a controller at one control tick.

    ``now`` in ns, ``elapsed`` in s since the last tick, ``state`` (10,), ``reference`` (N+1, 10) at the nodes of the
    horizon, ``height`` in m, ``climb_rate`` in m/s, ``yaw`` in rad.
    """

    now: int
    elapsed: float
    state: NDArray
    reference: NDArray
    height: float
    climb_rate: float
    yaw: float


class Pilot:
    """From poses to body rates and thrust. The time of the reference to follow starts with the first step.

    What is not what a method asks for (``None``, another shape, a number that is not finite) is a ValueError.
    """

    def __init__(self, params: Params, reference: Reference) -> None:
        from fiplib.kernels import piloting as loops

        _checked("params", params, Params)
        try:
            start = np.array((*reference.at(np.zeros(1))[0], reference.informed(0.0, math.nan).height), dtype=float)
        except Exception as error:  # whatever it is: no trajectory
            raise ValueError(f"no reference to follow: {type(reference).__name__} ({error})") from error
        if start.shape != (len(STATES) + 1,) or not np.isfinite(start).all():
            raise ValueError("a reference must give finite states, shape (n, 10), and a finite height")
        self.params, self.reference = params, reference
        self._sampler = SAMPLERS[estimator_of(params).kind](params)
        policy = _known("piloting.handover", params.piloting.handover, HANDOVERS)
        self._handover = policy(params, self._sampler.seconds / params.estimation.run_period)
        self.length = self._handover.used
        self._mpc, self._controller = MPC(params), controller_of(params)
        self._gains = self._feedback()
        self._observer = Observer(params)
        self._loops, self._about = loops.answer, loops.pilot_constants(params, reference.height)
        self._integrals = np.zeros(2)
        self._horizon = np.arange(params.control.nodes + 1) * params.control.step
        self._least = least_period(params.piloting)
        self._first: int | None = None
        self._last: int | None = None

    def step(self, now: int, measurement: Measurement) -> Command | None:
        """Take one frame that arrived at ``now`` ns; the command at a control tick, ``None`` at the frames between."""
        tick = self.observe(now, measurement)
        if tick is None:
            return None
        solution = self.solve(tick)
        if not np.isfinite(solution.input).all():
            raise ValueError(f"the controller answered {solution.input}: its body rates must be finite")
        return self.answer(tick, solution.input, solution.status)

    def observe(self, now: int, measurement: Measurement) -> Tick | None:
        """The first part of ``step``: take one frame; at a control tick, what a controller needs to know."""
        now = nanoseconds(now)
        if not np.isfinite(numbers_of(measurement)).all():
            raise ValueError("malformed frame: not every number is finite")
        measurement = Measurement(nanoseconds(measurement[0]), *measurement[1:])
        state, altitude = self._observer.update(measurement, self.length)
        self._sampler.push_frame(measurement)
        if self._first is None:
            self._first = now
        if self._last is not None and now - self._last < self._least:
            return None
        elapsed = 0.0 if self._last is None else (now - self._last) / NANO
        self._last = now
        reference = self.reference.at((now - self._first) / NANO + self._horizon)
        return Tick(now, elapsed, state, reference, *altitude)

    def solve(self, tick: Tick) -> Solution:
        """The second part: the optimal plan, or what another ``piloting.controller`` answers."""
        _checked("tick", tick, Tick)
        return self._controller.solve(tick.state, tick.reference, self.length)

    def hold(self, tick: Tick, place: NDArray) -> NDArray:
        """Instead of the second part, without a solver: body rates (2,) that keep rod and vehicle at a state (10,).

        The feedback is that of the optimal plan where no bound is active: u = -K_0 (x - x_ref), cut off at the bounds.
        """
        _checked("tick", tick, Tick)
        if np.shape(place) != (len(STATES),):
            raise ValueError(f"place must be a state (10,), not of shape {np.shape(place)}")
        limit = self.params.vehicle.max_body_rate
        return np.clip((self._gains * (tick.state - place)).sum(axis=1), -limit, limit)

    def answer(self, tick: Tick, rates: NDArray, status: Status) -> Command:
        """The last part of ``step``: body rates (2,) in rad/s about x and y, with thrust and yaw, as a command."""
        _checked("tick", tick, Tick)
        if np.shape(rates) != (2,):
            raise ValueError(f"rates must be two body rates, not of shape {np.shape(rates)}")
        command, state = np.empty(4), tick.state
        measured = (state[PHI], state[THETA], tick.height, tick.climb_rate, tick.yaw)
        self._loops(*measured, rates[0], rates[1], tick.elapsed, self._about, self._integrals, command)
        body_rate, thrust = command[:3], float(command[3])
        self._sampler.push_command(tick.now, tick.state, body_rate, thrust)
        return Command(tick.now, body_rate, thrust, tick.state, tick.reference[0], self.length, status)

    @property
    def window_seconds(self) -> float:
        """Return how long the estimator's window is, s."""
        return self._sampler.seconds

    def forget_window(self) -> None:
        """After a gap in frames or commands: gather the estimator's window afresh."""
        self._sampler = SAMPLERS[estimator_of(self.params).kind](self.params)

    def window_due(self) -> Window | RawWindow | None:
        """The window, of the estimator's kind, when a run is due by its schedule (``run_period``), else ``None``."""
        return self._sampler.due(self._last) if self.params.piloting.estimate else None

    def receive_estimate(self, length: float, deviation: float = math.nan) -> float:
        """Take a new estimate over by the policy ``piloting.handover``; returns the length used from the next tick on.

        All in m; a non-finite ``length`` is ignored, its standard ``deviation`` is nan if it has none. The reference is
        ``informed`` of it, as of the last tick.
        """
        try:
            length, deviation = float(length), float(deviation)
        except (TypeError, ValueError) as error:
            raise ValueError(f"an estimate must be two numbers in m ({error})") from error
        self.length = self._handover.update(length, deviation)
        if self._first is not None and self._last is not None and math.isfinite(length + deviation):
            self.reference = self.reference.informed((self._last - self._first) / NANO, deviation)
        self._gains = self._feedback()  # prepares the MPC: here, and not within the next tick
        return self.length

    def _feedback(self) -> NDArray:
        """-K_0 (2, 10) of the length in use."""
        gains = np.zeros((2, 10))
        for axis, part in zip(AXES, self._mpc.prepare(self.length), strict=True):
            # z = (s, s', d, d', sign * tilt) and sign * rate: see params.Axis
            signs = axis.sign * np.array((1.0, 1.0, 1.0, 1.0, axis.sign))
            gains[axis.input, list(axis.states)] = -signs * part.gains[0]
        return gains


def least_period(piloting: Piloting) -> int:
    """The least time between control ticks, ns: half a frame early counts, as arrival times jitter about the tick.

    Raises ValueError: ticks, which come with frames, cannot have the rate that observers and estimators count on.
    """
    frames = piloting.mocap_rate / piloting.control_rate
    if not math.isclose(frames, max(1, round(frames)), rel_tol=0.01):
        rates = f"{piloting.mocap_rate:g} and {piloting.control_rate:g} Hz"
        raise ValueError(f"piloting.mocap_rate must be a whole multiple of piloting.control_rate, not {rates}")
    return round(NANO / piloting.control_rate) - round(NANO / piloting.mocap_rate / 2)


def estimator_of(params: Params) -> Estimator:
    """Return the estimator that a flight uses; ValueError if its name is not known."""
    return _known("estimation.estimator", params.estimation.estimator, ESTIMATORS)


def _checked(name: str, value: object, kind: type) -> None:
    if not isinstance(value, kind):
        raise ValueError(f"{name} must be {kind.__name__}, not {type(value).__name__}")


def _known(parameter: str, name: str, registry: dict[str, Any]) -> Any:
    if name not in registry:
        raise ValueError(f"{parameter} must be one of {', '.join(registry)}, not {name!r}")
    return registry[name]
