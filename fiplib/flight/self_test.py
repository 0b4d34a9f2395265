"""A second of the controller's work at the control rate, before the flight: does this machine keep the deadlines?"""

import math
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fiplib.flight.limits import Safety
from fiplib.params import NANO, FipError, Params, X, Y
from fiplib.pilot import Pilot
from fiplib.recording import Measurement
from fiplib.references import Reference

SECONDS = 1.0
"""How long the self-test takes, s."""


class DeadlineError(FipError):
    """The machine does not keep the deadlines of a flight; the message says by how much, and what to do."""


class Punctuality(NamedTuple):
    """How punctual a machine was: ``late`` of so many ``ticks`` were answered late, the ``worst`` after so many s."""

    ticks: int
    late: int
    worst: float

    def kept(self, safety: Safety) -> bool:
        """Return whether few enough were late, and none by as much as poses may be."""
        return self.late <= safety.late_share * self.ticks and self.worst < safety.pose_flag

    def __str__(self) -> str:
        return f"self-test: {self.late} of {self.ticks} ticks late, the worst answered after {1e3 * self.worst:.1f} ms"


def measured(
    pilot: Pilot,
    safety: Safety,
    clock: Callable[[], int] = time.monotonic_ns,
    sleep: Callable[[float], None] = time.sleep,
) -> Punctuality:
    """Let a pilot control a vehicle that stands still, for ``SECONDS``; measure when each tick is answered.

    A tick is late when its answer comes later than ``safety.solve_limit`` after it is due, for whatever reason: the
    machine has woken us late, or the solver took long.

    Args:
        pilot: a new one, for this alone.
        clock: monotonic time, ns.
        sleep: waits for so many s.
    """
    params, reference = pilot.params, pilot.reference
    step = round(NANO / params.piloting.control_rate)
    frames, ticks = round(params.piloting.mocap_rate / params.piloting.control_rate), round(SECONDS * NANO / step)
    pilot.step(0, standing(params, reference, 0))  # what happens once alone is no matter of punctuality
    late, worst, start = 0, 0.0, clock()
    for tick in range(1, ticks + 1):
        due = start + tick * step
        while (left := due - clock()) > 0:
            sleep(left / NANO)
        for frame in range(frames):
            stamp = tick * step + frame * step // frames
            pilot.step(stamp, standing(params, reference, stamp))
        took = (clock() - due) / NANO
        late, worst = late + (took > safety.solve_limit), max(worst, took)
    return Punctuality(ticks, late, worst)


def standing(params: Params, reference: Reference, stamp: int) -> Measurement:
    """Return the frame of a vehicle where the trajectory starts, with an upright rod that moves by a millimetre."""
    start = reference.at(np.zeros(1))[0]
    place = np.array((start[X], start[Y], reference.height))
    swing = np.array((1e-3 * math.sin(6.0 * stamp / NANO), 0.0, 0.5 * params.pendulum.length))
    upright = np.array((0.0, 0.0, 0.0, 1.0))
    return Measurement(stamp, place, upright, place + swing, upright)
