"""The windows of data that estimators use, and the samplers that collect them in flight.

The paper's estimator takes states sampled in steps (``kalman.Window``, ``WindowSampler``); ours takes the poses of both
bodies as measured (``RawWindow``, ``RawSampler``). Both are fed alike.
"""

from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fiplib.dynamics import z_axis
from fiplib.kalman import Window
from fiplib.params import NANO, Params
from fiplib.recording import Flight, Measurement

LEAD = 0.1
"""Poses count from this many seconds after the first command on: until then the vehicle may be held."""


@dataclass(frozen=True)
class RawPoses:
    """Poses of one body: ``stamp`` (n,) of their exposure in ns, ``position`` (n, 3) in m, ``axis`` (n, 3) its body z
    in the world.

    Raises:
        ValueError: an array of another shape, a number that is not finite, or stamps that are out of order.
    """

    stamp: NDArray
    position: NDArray
    axis: NDArray

    def __post_init__(self) -> None:
        for name in ("stamp", "position", "axis"):
            try:
                array = np.asarray(getattr(self, name), dtype=float)
            except (TypeError, ValueError) as error:
                raise ValueError(f"poses: {name} holds what is no number ({error})") from error
            shape = "(n,)" if name == "stamp" else f"({len(self.stamp)}, 3)"
            if array.ndim != 1 if name == "stamp" else array.shape != (len(self.stamp), 3):
                raise ValueError(f"poses: {name} must have shape {shape}, got {array.shape}")
            if not np.isfinite(array).all():
                raise ValueError(f"poses: {name} holds values that are not finite")
            object.__setattr__(self, name, np.asarray(self.stamp, dtype=np.int64) if name == "stamp" else array)
        if (np.diff(self.stamp) < 0).any():
            raise ValueError("poses: stamp must not decrease")

    def part(self, kept: NDArray) -> "RawPoses":
        """Return some of the poses, chosen by a mask or by indices."""
        return RawPoses(self.stamp[kept], self.position[kept], self.axis[kept])


class RawWindow(NamedTuple):
    """A stretch of motion capture, nothing paired, differentiated or filtered: both bodies at their own stamps."""

    vehicle: RawPoses
    rod: RawPoses

    @property
    def seconds(self) -> float:
        """Return how long the window is, s."""
        stamps = [body.stamp for body in self if len(body.stamp)]
        return (max(stamp[-1] for stamp in stamps) - min(stamp[0] for stamp in stamps)) / NANO if stamps else 0.0

    @classmethod
    def between(cls, flight: Flight, start_ns: int, end_ns: int) -> "RawWindow":
        """Return the poses of a recorded flight that were exposed in [start_ns, end_ns]."""
        bodies = []
        for body in (flight.vehicle, flight.pendulum):
            kept = (body.stamp >= start_ns) & (body.stamp <= end_ns)
            axis = np.column_stack(z_axis(*body.orientation[kept].T))
            bodies.append(RawPoses(body.stamp[kept], body.position[kept], axis))
        return cls(*bodies)


class RawSampler:
    """Keeps the last ``raw_window`` seconds of poses, and the schedule of an estimator of kind "raw".

    The trusted hand-over gets windows of ``first_raw_window`` already, which grow to ``raw_window``. A pose of the rod
    that comes again with the next frame, because none of its own came with that, is kept once.
    """

    def __init__(self, params: Params) -> None:
        self.seconds = params.estimation.raw_window
        self._span = round(self.seconds * NANO)
        self._period = params.estimation.run_period
        trusted = params.piloting.handover == "trusted"
        self._least = round(min(params.estimation.first_raw_window, self.seconds) * NANO) if trusted else self._span
        self._slack = 0.5 / params.piloting.mocap_rate
        self._bodies: tuple[deque[tuple[int, NDArray]], ...] = (deque(), deque())
        self._first_command: int | None = None
        self._fresh = False
        self._last_run: int | None = None

    def push_frame(self, measurement: Measurement) -> None:
        """Take a frame as it arrives, before the command that answers it."""
        self._fresh = False
        stamp = measurement.stamp
        if self._first_command is None or stamp - self._first_command < LEAD * NANO:
            return
        vehicle, rod = self._bodies
        if vehicle and stamp <= vehicle[-1][0]:
            return
        vehicle.append((stamp, np.concatenate(measurement[1:3])))
        pose = np.concatenate(measurement[3:5])
        if not rod or not np.array_equal(pose, rod[-1][1]):
            rod.append((stamp, pose))
        for body in self._bodies:
            while body and stamp - body[0][0] > self._span:
                body.popleft()

    def push_command(self, now: int, state: NDArray | None, body_rate: NDArray, thrust: float) -> None:
        """Take a control tick at ``now`` ns; what was commanded is not needed."""
        self._fresh = True
        if self._first_command is None:
            self._first_command = now

    def due(self, now: int | None) -> RawWindow | None:
        """The window, at a control tick, when it is long enough, and ``run_period`` has passed since the last."""
        if now is None or not self._fresh or not all(self._bodies):
            return None
        if self._last_run is not None and (now - self._last_run) / NANO < self._period - self._slack:
            return None
        frames = self._bodies[0]
        step = (frames[-1][0] - frames[0][0]) / max(len(frames) - 1, 1)
        # the span is full when one more frame would drop the first
        if frames[-1][0] - frames[0][0] + 1.5 * step < self._least:
            return None
        self._last_run = now
        bodies = []
        for body in self._bodies:
            poses = np.array([pose for _, pose in body])
            axis = np.column_stack(z_axis(*poses[:, 3:].T))
            bodies.append(RawPoses(np.array([stamp for stamp, _ in body]), poses[:, :3], axis))
        return RawWindow(*bodies)


class WindowSampler:
    """Gathers (state, input) at ``sample_period`` out of the control ticks, and keeps the schedule of the estimator.

    The input of a sample is the mean over the ticks up to the next one: held over the period it moves the tilt by the
    same amount as the inputs that were really applied.
    """

    def __init__(self, params: Params) -> None:
        self._estimation = params.estimation
        self._ticks = max(1, round(params.estimation.sample_period * params.piloting.control_rate))
        self._step = self._ticks / params.piloting.control_rate
        self.seconds = params.estimation.window * self._step
        self._states: deque[NDArray] = deque(maxlen=params.estimation.window)
        self._inputs: deque[NDArray] = deque(maxlen=params.estimation.window)
        self._pending: list[NDArray] = []
        self._fresh = False
        self._last_run: int | None = None

    def push_frame(self, measurement: Measurement) -> None:
        """Nothing: states come with the commands."""

    def push_command(self, now: int, state: NDArray, body_rate: NDArray, thrust: float) -> None:
        """Take a control tick: its state (10,) and applied body rates (3,) in rad/s."""
        self._fresh = len(self._pending) in (0, self._ticks)
        if self._fresh:
            if self._pending:
                self._inputs.append(np.mean(self._pending, axis=0))
            self._pending = []
            self._states.append(state)
        self._pending.append(body_rate[:2])

    def due(self, now: int | None) -> Window | None:
        """The window, when it is full, a sample has just been taken, and ``run_period`` has passed since the last."""
        if now is None or not self._fresh or len(self._states) < self._estimation.window:
            return None
        # half a tick of slack, so that a period that is a multiple of the sampling is not missed by rounding
        if self._last_run is not None and (now - self._last_run) / NANO < self._estimation.run_period - self._step / 24:
            return None
        self._last_run = now
        inputs = np.array([*list(self._inputs)[-(self._estimation.window - 1) :], self._pending[-1]])
        return Window(np.array(self._states), inputs, self._step)


SAMPLERS: dict[str, type[WindowSampler] | type[RawSampler]] = {"states": WindowSampler, "raw": RawSampler}
"""The sampler of each kind of estimator (``estimators.ESTIMATORS[name].kind``)."""
