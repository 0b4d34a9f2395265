"""What estimators are given, and what gathers it in flight.

The paper's estimator takes states sampled in steps (``kalman.Window``, ``WindowSampler``); ours takes frames as
measured and commands as sent (``RawWindow``, ``RawSchedule``). Both are fed alike.
"""

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fiplib.dynamics import euler_angles, seat_position
from fiplib.kalman import Window
from fiplib.params import NANO, Params
from fiplib.recording import Measurement

LEAD = 0.1
"""Commands are kept from this many seconds before the first frame: those still on their way to the motors."""


@dataclass(frozen=True)
class RawWindow:
    """A stretch of motion capture, nothing differentiated or filtered. Times in s, zero at the first frame.

    Attributes:
        time: exposure of each frame, (n,).
        vehicle: position of the rod's seat, (n, 3), m.
        pendulum: position of the pendulum's COM, (n, 3), m.
        attitude: roll, pitch, yaw of R = Rx Ry Rz, (n, 3), rad.
        command_time: when each command was given (not when it acts), (m,); starts before the first frame.
        command: body rates omega_x, omega_y in rad/s and normalised thrust, (m, 3).

    Raises:
        ValueError: an array of another shape, a number that is not finite, or times that do not increase.
    """

    time: NDArray
    vehicle: NDArray
    pendulum: NDArray
    attitude: NDArray
    command_time: NDArray
    command: NDArray

    def __post_init__(self) -> None:
        for first, names in (("time", ("vehicle", "pendulum", "attitude")), ("command_time", ("command",))):
            count = len(self._checked(first, None))
            for name in names:
                self._checked(name, count)
        for name, least in (("time", 2), ("command_time", 1)):
            times = getattr(self, name)
            if len(times) < least or (np.diff(times) <= 0.0).any():
                raise ValueError(f"window {name} must hold at least {least} increasing times in s")

    def _checked(self, name: str, count: int | None) -> NDArray:
        """Keep the array of a name as float; (n,) where there is no count, else (count, 3)."""
        try:
            array = np.asarray(getattr(self, name), dtype=float)
        except (TypeError, ValueError) as error:
            raise ValueError(f"window {name} holds what is no number ({error})") from error
        shape = "(n,)" if count is None else f"({count}, 3)"
        if array.ndim != 1 if count is None else array.shape != (count, 3):
            raise ValueError(f"window {name} must have shape {shape}, got {array.shape}")
        if not np.isfinite(array).all():
            raise ValueError(f"window {name} holds values that are not finite")
        object.__setattr__(self, name, array)
        return array


class RawSampler:
    """Keeps the last ``seconds`` of frames, and the commands that belong to them.

    The seat lies ``seat_height`` m above the vehicle's tracked point.
    """

    def __init__(self, seconds: float, seat_height: float) -> None:
        self.seconds, self._seat_height = seconds, seat_height
        self._span = round(seconds * NANO)
        self._frames: deque[tuple[int, NDArray]] = deque()
        self._commands: deque[tuple[int, NDArray]] = deque()

    def push_frame(self, measurement: Measurement) -> None:
        """Take a frame as it arrives, before the command that answers it."""
        stamp = measurement.stamp
        if self._frames and stamp <= self._frames[-1][0]:
            return
        attitude = euler_angles(measurement.vehicle_attitude)
        seat = seat_position(measurement.vehicle_position, measurement.vehicle_attitude, self._seat_height)
        row = np.concatenate([seat, measurement.pendulum_position, attitude])
        self._frames.append((stamp, row))
        while stamp - self._frames[0][0] > self._span:
            self._frames.popleft()

    def push_command(self, now: int, state: NDArray | None, body_rate: NDArray, thrust: float) -> None:
        """Take a control tick at ``now`` ns: state (not used), body rates (3,) in rad/s and normalised thrust."""
        self._commands.append((now, np.array([*body_rate[:2], thrust])))
        first = self._frames[0][0] if self._frames else now
        while len(self._commands) > 1 and self._commands[1][0] < first - LEAD * NANO:
            self._commands.popleft()

    def window(self, least: float = math.inf) -> RawWindow | None:
        """The window, once frames of the whole span and a command before them (by ``LEAD``) have been seen.

        While the span fills, a window of ``least`` seconds will do.
        """
        if not self._commands or len(self._frames) < 2:
            return None
        zero, last = self._frames[0][0], self._frames[-1][0]
        # the span is full when one more frame would drop the first
        step = (last - zero) / (len(self._frames) - 1)
        needed = min(self._span, least * NANO)
        if last - zero + 1.5 * step < needed or self._commands[0][0] > zero - LEAD * NANO + 2 * step:
            return None
        values = np.array([row for _, row in self._frames])
        return RawWindow(
            (np.array([stamp for stamp, _ in self._frames]) - zero) / NANO,
            values[:, :3],
            values[:, 3:6],
            values[:, 6:],
            (np.array([now for now, _ in self._commands]) - zero) / NANO,
            np.array([row for _, row in self._commands]),
        )


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


class RawSchedule(RawSampler):
    """Gathers frames as measured and commands as sent, and keeps the schedule of an estimator of kind "raw".

    Frames count from ``LEAD`` after the first command on: what moved the vehicle before that is not known. The trusted
    hand-over gets windows of ``first_raw_window`` already, which grow to ``raw_window``.
    """

    def __init__(self, params: Params) -> None:
        super().__init__(params.estimation.raw_window, params.piloting.seat_height)
        self._period = params.estimation.run_period
        self._least = params.estimation.first_raw_window if params.piloting.handover == "trusted" else math.inf
        self._slack = 0.5 / params.piloting.mocap_rate
        self._first_command: int | None = None
        self._fresh = False
        self._last_run: int | None = None

    def push_frame(self, measurement: Measurement) -> None:
        self._fresh = False
        if self._first_command is not None and measurement.stamp - self._first_command >= LEAD * NANO:
            super().push_frame(measurement)

    def push_command(self, now: int, state: NDArray | None, body_rate: NDArray, thrust: float) -> None:
        self._fresh = True
        if self._first_command is None:
            self._first_command = now
        super().push_command(now, state, body_rate, thrust)

    def due(self, now: int | None) -> RawWindow | None:
        """The window, at a control tick, when it is long enough, and ``run_period`` has passed since the last."""
        if now is None or not self._fresh:
            return None
        if self._last_run is not None and (now - self._last_run) / NANO < self._period - self._slack:
            return None
        window = self.window(self._least)
        if window is not None:
            self._last_run = now
        return window


SAMPLERS = {"states": WindowSampler, "raw": RawSchedule}
"""What gathers the windows of each kind of estimator (``estimators.ESTIMATORS[name].kind``)."""
