"""The arm checks: what must hold before a vehicle may be armed."""

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from fiplib.dynamics import body_z_of, seat_position
from fiplib.flight.limits import Limits, Safety
from fiplib.params import NANO, Params
from fiplib.recording import Measurement


class ArmChecks:
    """Checks every good frame before the flight; the vehicle may be armed once all have passed for ``arm_time``.

    Args:
        start: where the trajectory starts, (x, y) in m.

    Attributes:
        waiting: why the vehicle may not be armed yet; empty once it may.
        doubt: what the link has against arming, from outside; ``None`` if nothing.
    """

    def __init__(self, params: Params, limits: Limits, start: NDArray) -> None:
        self._params, self._safety, self._start = params, limits.safety, start
        self._steady_since: int | None = None
        self._arrivals: deque[int] = deque()
        self.waiting = "no poses yet"
        self.doubt: str | None = None

    def passed(self, now: int, good: Measurement, lean: float, tilt: float, speed: float) -> bool:
        """Take a good frame that arrived at ``now`` ns.

        Args:
            lean, tilt: of rod and vehicle, rad.
            speed: of the faster of both, m/s.

        Returns:
            Whether the vehicle may be armed; if not, ``waiting`` says why.
        """
        safety, rate = self._safety, self._params.piloting.mocap_rate
        self._arrivals.append(now)
        while now - self._arrivals[0] > safety.arm_time * NANO:
            self._arrivals.popleft()
        self._steady_since = now if self._steady_since is None else self._steady_since
        if reason := self._failure(good, lean, tilt, speed):
            self.failed(reason)
        elif now - self._steady_since < safety.arm_time * NANO:
            self.waiting = "arm checks under way"
        elif len(self._arrivals) < safety.arm_rate * safety.arm_time * rate:
            self.waiting = f"{len(self._arrivals) / safety.arm_time:.0f} good frames/s of {rate:.0f}"
        else:
            self.waiting = ""
        return not self.waiting

    def failed(self, reason: str) -> None:
        """Begin anew, for a reason."""
        self.waiting, self._steady_since = reason, None

    def _failure(self, good: Measurement, lean: float, tilt: float, speed: float) -> str | None:
        safety, estimation = self._safety, self._params.estimation
        if self.doubt is not None:
            return self.doubt
        rod = rod_of(good, self._params)
        reach = float(np.linalg.norm(rod))
        if not 0.5 * estimation.length_min <= reach <= 0.5 * estimation.length_max + 0.1:
            return f"pendulum not placed: its COM is {reach:.2f} m from its seat"
        if rod[2] < 0.0:
            return "pendulum below the vehicle: bodies swapped, or not placed"
        if lean > safety.arm_lean:
            return f"pendulum leans {math.degrees(lean):.0f} deg"
        if angle_between(rod, body_z_of(good.pendulum_attitude)) > safety.seat_tolerance:
            return "pendulum's axis does not point from its seat to its COM: wrong body or wrong axes"
        if tilt > safety.arm_tilt:
            return f"vehicle tilts {math.degrees(tilt):.0f} deg"
        if reason := outside(good, safety):
            return reason
        away = math.dist(good.vehicle_position[:2], self._start)
        if away > safety.arm_distance:
            return f"vehicle is {away:.2f} m from where the trajectory starts"
        if speed > safety.arm_speed:
            return f"vehicle or pendulum moves at {speed:.2f} m/s"
        return None


def rod_of(good: Measurement, params: Params) -> NDArray:
    """Return the vector from the rod's seat to its centre of mass, (3,) in m."""
    seat = seat_position(good.vehicle_position, good.vehicle_attitude, params.piloting.seat_height)
    return good.pendulum_position - seat


def outside(good: Measurement, safety: Safety) -> str | None:
    """Return where the vehicle is if that is outside the fence or below the floor, else ``None``."""
    x, y, z = good.vehicle_position
    far_x, far_y, ceiling = safety.fence
    if abs(x) > far_x or abs(y) > far_y or z > ceiling:
        return f"outside the fence at ({x:.2f}, {y:.2f}, {z:.2f}) m"
    if z < safety.floor:
        return f"below the floor of {safety.floor:g} m"
    return None


def angle_between(one: NDArray, other: NDArray) -> float:
    """Return the angle between two vectors (3,), rad; pi if one is zero."""
    norms = math.sqrt(float(one @ one) * float(other @ other))
    return math.acos(max(-1.0, min(1.0, float(one @ other) / norms))) if norms > 0.0 else math.pi
