"""Checks of the frames of motion capture: their numbers, their stamps, and the change since the last one.

No clock and no I/O: time comes in with the frames. A refused frame counts as none; ``failsafe.Guard`` acts on the age
of the last good one.
"""

import math
from collections import deque
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from fiplib.dynamics import body_z_of
from fiplib.flight.arming import angle_between
from fiplib.flight.limits import Limits
from fiplib.params import NANO, Params
from fiplib.recording import Measurement, nanoseconds, numbers_of

BODIES = ("vehicle", "pendulum")
FARTHEST = 1000.0
"""No position lies further away than this, m: such a number is a driver's mark of a lost body, or an accident."""
STAMPS = 24
"""Stamps looked back at when judging a clock: 0.1 s of frames."""
DRIFT = 500
"""Clocks may drift apart by so many ns per frame, 120 ppm: cheap quartz is within 100."""
SAME_CLOCK = NANO // 10
"""Arrivals that usually come so many ns after their stamps are stamped by the same clock: 0.1 s at most is a delay."""
STEADY = 120
"""Frames over which a clock's stamps must agree with the arrivals to be used again: 0.5 s."""
Tilts = Callable[[int], tuple[float, float]]
"""Time of exposure in ns by the clock of arrivals -> roll and pitch in rad that the commands lead to."""


class PoseMonitor:
    """Check every frame as it arrives: whether it is good, why not, and how old the newest good one is.

    Stamps are compared with arrivals, whose clock may be another one: the change of their difference is judged.
    When the stamps' clock has stepped or lost its order, frames are stamped anew by their arrival until it is steady.

    Attributes:
        refusal: why the last frame was refused; ``None`` if it was good.
        velocity: of vehicle and pendulum, (2, 3), m/s, from good frames.
        learning: before a flight: the usual delay of arrivals is learnt, and bodies may be put elsewhere.
        trusted: whether stamps are used; else arrivals stand in for them.
        remarks: what is worth recording about clocks; to be emptied by the reader.
    """

    def __init__(self, params: Params, limits: Limits) -> None:
        self._safety = limits.safety
        self._tolerance = round(self._safety.clock_tolerance * NANO)
        self._cutoff = 2.0 * math.pi * params.piloting.velocity_cutoff
        self.learning = True
        self.refusal: str | None = None
        self.remarks: list[str] = []
        self.velocity = np.zeros((2, 3))
        self._raw: tuple[int, NDArray] | None = None
        self._last: NDArray | None = None
        self._newest = self._delay = self._correction = 0  # ns
        self.trusted = True
        self._ahead: deque[bool] = deque(maxlen=STAMPS)
        self._leads: deque[int] = deque(maxlen=STEADY)
        self._behind = self._refused = 0

    def take(self, now: int, measurement: Measurement, tilts: Tilts | None = None) -> Measurement | None:
        """Judge a frame that arrived at ``now`` ns.

        Args:
            tilts: once the rod is given up, the tilt that a frame must show, by its time of exposure.

        Returns:
            The frame, with its stamp put right if its clock is wrong; ``None`` if it is not good (see ``refusal``).
        """
        values, self.refusal = self._numbers(measurement)
        if values is None:
            return None
        stamp = nanoseconds(measurement[0])
        raw, self._raw = self._raw, (stamp, values)
        if raw is not None:
            self.refusal = self._repeated(raw, stamp, values)
            if self.refusal:
                return None
        corrected = self._stamped(now, stamp)
        if corrected is None:
            return None
        self.refusal = self._moved(corrected, values) or self._contradicted(corrected, values, tilts)
        if self.refusal:
            self._refused += 1
            if not (self.learning and self._refused >= self._safety.recovery_frames):
                return None
            self._last = None  # on the ground bodies are moved by hand: believe where they are now
        self._accept(corrected, values)
        return Measurement(corrected, values[:3], values[3:7], values[7:10], values[10:])

    def age(self, now: int) -> float:
        """Seconds since the exposure of the newest good frame, less the usual delay; infinite before the first."""
        return math.inf if self._last is None else (now - self._newest - self._delay) / NANO

    def exposed(self, stamp: int) -> int:
        """Return the time of a stamp by the clock of arrivals, ns; where that is another clock, the usual arrival."""
        return stamp if 0 <= self._delay < SAME_CLOCK else stamp + self._delay

    @property
    def vehicle_position(self) -> tuple[float, float, float]:
        """At the newest good frame, m; nan before the first."""
        x, y, z = (math.nan,) * 3 if self._last is None else self._last[:3].tolist()
        return x, y, z

    def _numbers(self, measurement: Measurement) -> tuple[NDArray | None, str | None]:
        """Return the 14 numbers of a frame, or why they are no two poses."""
        try:
            values = numbers_of(measurement)
        except ValueError:
            return None, "malformed frame"
        if not np.isfinite(values).all():
            return None, "pose not finite"
        try:
            nanoseconds(measurement[0])
        except ValueError:
            return None, "stamp out of range"
        for body, pose in zip(BODIES, (values[:7], values[7:]), strict=True):
            if np.abs(pose[:3]).max() > FARTHEST:
                return None, f"{body} position beyond {FARTHEST:g} m"
            if np.abs(pose[3:]).max() > 2.0 or abs(math.hypot(*pose[3:]) - 1.0) > self._safety.quaternion_tolerance:
                return None, f"{body} quaternion not of unit length"
        return values, None

    def _repeated(self, raw: tuple[int, NDArray], stamp: int, values: NDArray) -> str | None:
        frozen = [body for body, part in zip(BODIES, np.split(values == raw[1], 2), strict=True) if part.all()]
        if not frozen:
            return None  # new poses under an old stamp are a matter of the clock
        return "frame repeated" if stamp == raw[0] else f"{' and '.join(frozen)} pose frozen"

    def _stamped(self, now: int, stamp: int) -> int | None:
        """Return the stamp to use for a frame, or ``None`` (and ``refusal``)."""
        if self._last is None and self._newest == 0:
            self._delay = now - stamp
            return stamp
        if self.trusted:
            corrected = stamp + self._correction
            excess = now - corrected - self._delay
            if self.learning and excess < -self._tolerance:
                self._delay += excess
                excess = 0
            ahead, behind = excess < -self._tolerance, corrected <= self._newest
            self._ahead.append(ahead)
            self._behind = self._behind + 1 if behind else 0
            if not self.learning and self._says_old(now, corrected):
                self.refusal = "stamp of an old pose"
                return None
            if max(sum(self._ahead), self._behind) < STAMPS // 4:
                if ahead or behind:
                    self.refusal = "stamp ahead of its arrival" if ahead else "stamp not after the last"
                    return None
                # the least delay is the usual one; a slow leak follows clocks that drift apart
                self._delay += min(excess, 0) or min(excess // 1000, DRIFT)
                return corrected
            self.trusted = False
            self._leads.clear()
            self.remarks.append("stamps are out of order or a clock has stepped: arrivals stand in for stamps")
        if not self.learning and self._says_old(now, stamp + self._correction):
            self.refusal = "stamp of an old pose"
            return None
        corrected = now - self._delay
        self._leads.append(stamp - now)
        if len(self._leads) == STEADY and max(self._leads) - min(self._leads) <= 2 * self._tolerance:
            self.trusted, self._behind = True, 0
            self._correction = -self._delay - max(self._leads)
            self._ahead.clear()
            self.remarks.append("stamps are steady again")
        if corrected <= self._newest:
            self.refusal = "stamp not after the last"
            return None
        return corrected

    def _says_old(self, now: int, stamp: int) -> bool:
        """Return whether a pose is, by its stamp, as old as one that disarms: from a recording that is played, perhaps.

        A clock that has stepped back looks the same; arrivals must not stand in for its stamps either.
        """
        return now - self._delay - stamp >= self._safety.pose_disarm * NANO

    def _moved(self, stamp: int, values: NDArray) -> str | None:
        """Why a frame cannot follow the last good one, if so."""
        if self._last is None:
            return None
        safety, elapsed = self._safety, (stamp - self._newest) / NANO
        allowed = safety.jump + 0.5 * safety.jump_acceleration * elapsed**2
        positions, before = values.reshape(2, 7)[:, :3], self._last.reshape(2, 7)
        expected = before[:, :3] + self.velocity * elapsed
        jumps = np.sqrt(((positions - expected) ** 2).sum(1))
        swapped = np.sqrt(((positions[::-1] - expected) ** 2).sum(1))
        # What is allowed grows with time, and reaches the other body in the end: the body nearer to where the vehicle
        # must be is the vehicle. Where the rod must be says less: nobody can tell how a rod falls that is given up.
        if (jumps > safety.jump).any() and swapped[0] <= allowed and swapped[0] < jumps[0]:
            return "bodies swapped"
        if (jumps > allowed).any():
            return f"{BODIES[int(jumps.argmax())]} position jumps"
        cosine = np.abs((values.reshape(2, 7)[:, 3:] * before[:, 3:]).sum(1))
        # of the rod its axis counts: how it is turned about that is hard to track
        cosine[1] = math.sqrt(max(0.0, 1.0 + float(body_z_of(values[10:]) @ body_z_of(before[1, 3:]))) / 2.0)
        turned = safety.turn + safety.turn_rate * elapsed
        if turned < math.pi and (cosine < math.cos(turned / 2.0) - 1e-3).any():
            return f"{BODIES[int(cosine.argmin())]} attitude jumps"
        return None

    def _contradicted(self, stamp: int, values: NDArray, tilts: Tilts | None) -> str | None:
        """Why a frame cannot be of a vehicle that levels as commanded, if so."""
        if tilts is None:
            return None
        roll, pitch = tilts(self.exposed(stamp))
        # the body's z axis of R = Rx(roll) Ry(pitch) Rz(yaw), as dynamics.euler_angles has it
        expected = (math.sin(pitch), -math.sin(roll) * math.cos(pitch), math.cos(roll) * math.cos(pitch))
        off = angle_between(body_z_of(values[3:7]), np.array(expected))
        return "vehicle attitude contradicts the commands" if off > self._safety.turn else None

    def _accept(self, stamp: int, values: NDArray) -> None:
        positions = values.reshape(2, 7)[:, :3]
        if self._last is None:
            self.velocity = np.zeros((2, 3))
        else:
            elapsed = (stamp - self._newest) / NANO
            share = 1.0 - math.exp(-self._cutoff * elapsed)
            speed = (positions - self._last.reshape(2, 7)[:, :3]) / elapsed
            self.velocity = self.velocity + share * (speed - self.velocity)
        self._last, self._newest, self._refused, self.refusal = values, stamp, 0, None
