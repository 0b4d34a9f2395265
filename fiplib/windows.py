"""What an estimator is given beyond the paper's sampled states: frames as measured, commands as sent."""

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

NANO = 1_000_000_000

LEAD = 0.1
"""Commands are kept from this many seconds before the first frame: those still on their way to the motors."""


@dataclass(frozen=True)
class RawWindow:
    """A stretch of motion capture, nothing differentiated or filtered. Times in s, zero at the first frame.

    Attributes:
        time: exposure of each frame, (n,).
        vehicle: position of the vehicle, (n, 3), m.
        pendulum: position of the pendulum's COM, (n, 3), m.
        attitude: roll, pitch, yaw of R = Rx Ry Rz, (n, 3), rad.
        command_time: when each command was given (not when it acts), (m,); starts before the first frame.
        command: body rates omega_x, omega_y in rad/s and normalised thrust, (m, 3).
    """

    time: NDArray
    vehicle: NDArray
    pendulum: NDArray
    attitude: NDArray
    command_time: NDArray
    command: NDArray


class RawSampler:
    """Keeps the last ``seconds`` of frames, and the commands that belong to them."""

    def __init__(self, seconds: float) -> None:
        self._span = round(seconds * NANO)
        self._frames: deque[tuple[int, NDArray]] = deque()
        self._commands: deque[tuple[int, NDArray]] = deque()

    def push_frame(self, stamp: int, vehicle: ArrayLike, pendulum: ArrayLike, attitude: ArrayLike) -> None:
        """Take a frame exposed at ``stamp`` ns: positions (3,) in m, roll, pitch, yaw in rad."""
        if self._frames and stamp <= self._frames[-1][0]:
            return
        self._frames.append((stamp, np.concatenate([vehicle, pendulum, attitude])))
        while self._frames[-1][0] - self._frames[0][0] > self._span:
            self._frames.popleft()

    def push_command(self, now: int, body_rate: ArrayLike, thrust: float) -> None:
        """Take a command given at ``now`` ns: at least omega_x, omega_y in rad/s, and normalised thrust."""
        self._commands.append((now, np.array([*np.asarray(body_rate)[:2], thrust])))
        first = self._frames[0][0] if self._frames else now
        while len(self._commands) > 1 and self._commands[1][0] < first - LEAD * NANO:
            self._commands.popleft()

    def window(self, least: float = math.inf) -> RawWindow | None:
        """The window, once frames of the whole span and a command before them (by ``LEAD``) have been seen.

        Args:
            least: while the span fills, a window of that many seconds will do.
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
