"""Setpoints, the messages that are sent to a vehicle, and the modes of the failsafe that chooses them."""

from collections import deque
from enum import Enum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fiplib.flight.limits import Limits
from fiplib.params import GRAVITY, NANO, Params
from fiplib.pilot import Command


class Mode(Enum):
    """The states of ``failsafe.Guard``; the values are shown in bags and on terminals."""

    DISARMED = "disarmed"
    """Motors off: before the arm checks have passed, and after the flight."""
    READY = "ready"
    """The arm checks pass; motors off until ``Guard.arm``."""
    FLYING = "flying"
    """The pilot's commands are sent."""
    COASTING = "coasting"
    """No new command is available for a moment: the next inputs of the last plan are sent."""
    HOVER_ONLY = "hover only"
    """The solver has failed: a linear feedback with fixed gains holds rod and vehicle in place."""
    LEVEL = "level"
    """The vehicle levels and descends; the rod is given up."""


class Setpoint(NamedTuple):
    """One message to the vehicle; its numbers are always finite and within bounds.

    ``stamp`` is the time at which it was computed, ns (the link's clock). ``body_rate`` (3,) in rad/s about x forward,
    y left, z up; ``thrust`` normalised to [0, 1]; both are zero when disarmed. ``tilt`` is the roll and pitch in rad
    that the vehicle is expected to reach with the commands sent so far: the command sender levels the vehicle from it
    when no newer setpoint arrives. ``command`` is the pilot's command with its state, reference and length, for
    recorders and displays; ``None`` if the failsafe chose the setpoint without the pilot.
    """

    stamp: int
    armed: bool
    mode: Mode
    body_rate: NDArray
    thrust: float
    command: Command | None = None
    tilt: tuple[float, float] = (0.0, 0.0)


def disarmed(stamp: int) -> Setpoint:
    """Return the level-and-disarm setpoint: no rates, no thrust, motors off."""
    return Setpoint(stamp, False, Mode.DISARMED, np.zeros(3), 0.0)


def levelling(params: Params, limits: Limits, stamp: int, tilt: tuple[float, float]) -> Setpoint:
    """Return the setpoint that levels and descends without poses, from the expected roll and pitch ``tilt`` in rad."""
    safety, limit = limits.safety, params.vehicle.max_body_rate
    rates = np.array([max(-limit, min(limit, -safety.level_gain * angle)) for angle in tilt] + [0.0])
    thrust = safety.descent_thrust * weight(params) / params.vehicle.max_thrust
    return Setpoint(stamp, True, Mode.LEVEL, rates, min(thrust, safety.max_thrust), None, tilt)


def weight(params: Params) -> float:
    """Return the weight of vehicle and rod together, N."""
    return (params.vehicle.mass + params.pendulum.mass) * GRAVITY


class TiltPredictor:
    """Predicts roll and pitch: the measured ones, plus the integral of the rates commanded since ``delay`` s before."""

    def __init__(self, delay: float) -> None:
        self._delay = round(delay * NANO)
        self._seen, self._measured = 0, np.zeros(2)
        self._rates: deque[tuple[int, NDArray]] = deque(maxlen=256)  # two seconds at 120 Hz

    def see(self, stamp: int, tilt: tuple[float, float]) -> None:
        """Take roll and pitch in rad, measured at ``stamp`` ns."""
        self._seen, self._measured = stamp, np.array(tilt)

    def send(self, now: int, rates: NDArray) -> None:
        """Take body rates (3,) in rad/s, commanded from ``now`` ns on."""
        self._rates.append((now, rates[:2]))

    def shown(self, exposed: int) -> tuple[float, float]:
        """Return roll and pitch in rad that a pose exposed at a time in ns is expected to show; bounded to [-1, 1]."""
        return self.at(exposed - self._delay)

    def at(self, now: int) -> tuple[float, float]:
        """Return roll and pitch in rad, predicted from the commands until ``now`` ns and bounded to [-1, 1]."""
        tilt, end = self._measured, now
        for start, rates in reversed(self._rates):
            begin = max(start, self._seen - self._delay)
            if end > begin:
                tilt = tilt + rates * ((end - begin) / NANO)
                end = begin
            if start <= self._seen - self._delay:
                break
        roll, pitch = np.clip(tilt, -1.0, 1.0).tolist()
        return roll, pitch
