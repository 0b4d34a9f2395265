"""What is sent to a vehicle, and the modes in which it is sent."""

from collections import deque
from enum import Enum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fiplib.params import GRAVITY, NANO, Params
from fiplib.pilot import Command


class Mode(Enum):
    """The states of ``Guard``; values are what bags and terminals show."""

    DISARMED = "disarmed"
    """Motors off: before the arm checks have passed, and for good once a flight has ended."""
    READY = "ready"
    """Arm checks pass; motors off until ``Guard.arm``."""
    FLYING = "flying"
    """The pilot's commands."""
    COASTING = "coasting"
    """No new command for a moment: the plan's next inputs."""
    HOVER_ONLY = "hover only"
    """The solver has failed: fixed gains hold rod and vehicle where they are."""
    LEVEL = "level"
    """Level and descend; the rod is given up."""


class Setpoint(NamedTuple):
    """What is sent to the vehicle. Finite and within bounds, always.

    ``stamp`` is the time of its making in ns (the link's clock). ``body_rate`` (3,) in rad/s about x forward, y left,
    z up; ``thrust`` normalised to [0, 1]. Disarmed: rates and thrust are zero. ``tilt`` is the roll and pitch in rad
    that the vehicle is expected to reach with the commands sent so far: what levels it when nothing newer comes.
    ``command`` is the pilot's (its state, reference and length are for recorders and displays), ``None`` if it gave
    none.
    """

    stamp: int
    armed: bool
    mode: Mode
    body_rate: NDArray
    thrust: float
    command: Command | None = None
    tilt: tuple[float, float] = (0.0, 0.0)


def disarmed(stamp: int) -> Setpoint:
    """The level-and-disarm frame: no rates, no thrust, motors off."""
    return Setpoint(stamp, False, Mode.DISARMED, np.zeros(3), 0.0)


def levelling(params: Params, stamp: int, tilt: tuple[float, float]) -> Setpoint:
    """Level and descend without poses: from the tilt that is expected, roll and pitch in rad."""
    limit, gain = params.vehicle.max_body_rate, params.safety.level_gain
    rates = np.array([max(-limit, min(limit, -gain * angle)) for angle in tilt] + [0.0])
    thrust = params.safety.descent_thrust * weight(params) / params.vehicle.max_thrust
    return Setpoint(stamp, True, Mode.LEVEL, rates, min(thrust, params.safety.max_thrust), None, tilt)


def weight(params: Params) -> float:
    """Of vehicle and rod together, N."""
    return (params.vehicle.mass + params.pendulum.mass) * GRAVITY


class Transition(NamedTuple):
    """From one mode to another at ``stamp`` ns, and why."""

    stamp: int
    before: Mode
    after: Mode
    reason: str

    @property
    def level(self) -> str:
        """Severity in a bag, a key of ``recorder.LEVELS``."""
        return {Mode.COASTING: "warn", Mode.HOVER_ONLY: "error", Mode.LEVEL: "error"}.get(self.after, "info")

    @property
    def text(self) -> str:
        return f"failsafe: {self.before.value} -> {self.after.value}: {self.reason}"


class Note(NamedTuple):
    """Something worth a line in the bag that changes no mode; ``level`` as in ``recorder.LEVELS``."""

    stamp: int
    level: str
    text: str


class TiltPredictor:
    """Roll and pitch that the vehicle will have with all commands sent: those measured, and the rates since then."""

    def __init__(self, delay: float) -> None:
        self._delay = round(delay * NANO)
        self._seen, self._measured = 0, np.zeros(2)
        self._rates: deque[tuple[int, NDArray]] = deque(maxlen=256)  # two seconds at 120 Hz

    def see(self, stamp: int, tilt: tuple[float, float]) -> None:
        """Roll and pitch as measured at ``stamp`` ns."""
        self._seen, self._measured = stamp, np.array(tilt)

    def send(self, now: int, rates: NDArray) -> None:
        """Body rates (3,) commanded from ``now`` ns on."""
        self._rates.append((now, rates[:2]))

    def at(self, now: int) -> tuple[float, float]:
        """Roll and pitch in rad with what was commanded until ``now`` ns; a bounded guess."""
        tilt, end = self._measured, now
        for start, rates in reversed(self._rates):
            begin = max(start, self._seen - self._delay)
            if end > begin:
                tilt = tilt + rates * ((end - begin) / NANO)
                end = begin
            if start <= begin and start <= self._seen - self._delay:
                break
        roll, pitch = np.clip(tilt, -1.0, 1.0).tolist()
        return roll, pitch
