"""State observers of the pilot, one a file, behind one class: from frames of motion capture to the ten states.

To add one, write a file with ``describe(params, constants)`` and ``linear(params, length)`` as its neighbours have, a
line of ``OBSERVERS``, and its compiled step in ``kernels.observing``, where a flight spends its time.
"""

from importlib import import_module
from types import ModuleType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fiplib.params import NANO, Params
from fiplib.recording import Measurement

OBSERVERS = {"differentiate": "differentiate", "kalman": "kalman"}
"""The module of every observer by name; ``piloting.observer`` chooses the one in flight."""


def module(params: Params) -> ModuleType:
    """Return the module of the observer that the parameters name; ValueError if its name is not known."""
    name = params.piloting.observer
    if name not in OBSERVERS:
        raise ValueError(f"piloting.observer must be one of {', '.join(OBSERVERS)}, not {name!r}")
    return import_module(f"{__name__}.{OBSERVERS[name]}")


class LinearObserver(NamedTuple):
    """One axis of an observer at rest in its steady state, frame by frame: z+ = A z + B y, seen = C z+ + D y.

    y is (tracked point of the vehicle, tracked point of the rod, tilt), seen is (s, s', d, d', tilt).
    """

    a: NDArray
    b: NDArray
    c: NDArray
    d: NDArray


class Observer:
    """Poses to states, frame by frame.

    Positions are those of the rod's seat, ``seat_height`` above the vehicle's tracked point along the body's z axis;
    (a, b) lead from it to the rod's COM. With ``pendulum_measurement = "direction"`` they are the rod's direction times
    half the length in use.

    Attributes:
        constants, memory: of ``kernels.observing.observe``.

    Raises:
        ValueError: no such observer, or no such ``pendulum_measurement``.
    """

    def __init__(self, params: Params) -> None:
        kind = params.piloting.pendulum_measurement
        if kind not in ("position", "direction"):
            raise ValueError(f"pendulum_measurement must be 'position' or 'direction', not {kind!r}")
        from fiplib.kernels import observing

        self.constants = np.zeros(observing.FORCE + 1)
        self.constants[observing.DIRECTION] = kind == "direction"
        self.constants[observing.SEAT] = params.piloting.seat_height
        self.constants[observing.CUTOFF] = params.piloting.velocity_cutoff
        module(params).describe(params, self.constants)
        self._observe, self.memory = observing.observe, np.zeros(observing.MEMORY)
        self._stamp: int | None = None

    def update(self, measurement: Measurement, length: float) -> tuple[NDArray, tuple[float, float, float]]:
        """Take one frame.

        Args:
            measurement: the frame; one whose stamp is not later than the last one's changes no velocity.
            length: length in use, m.

        Returns:
            The ten states, and (height in m, climb rate in m/s, yaw in rad). Velocities are zero at the first frame.
        """
        elapsed = 0.0 if self._stamp is None else max(0.0, (measurement.stamp - self._stamp) / NANO)
        self._stamp = measurement.stamp
        observed, frame = np.empty(13), np.concatenate(measurement[1:], dtype=float)
        self._observe(frame, length, elapsed, self.constants, self.memory, observed)
        height, climb_rate, yaw = observed[10:].tolist()
        return observed[:10], (height, climb_rate, yaw)
