"""Trajectories that a pilot can follow.

To add one, write a frozen dataclass with ``height`` and ``at``, and a line of ``REFERENCES``.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fiplib.params import STATES, X, Y


class Reference(Protocol):
    """A trajectory: ``height`` in m and ``at(times)`` in s since the first step -> states (n, 10)."""

    @property
    def height(self) -> float: ...

    def at(self, times: NDArray) -> NDArray: ...


@dataclass(frozen=True)
class Hover:
    """Stay at one place (x, y) in m."""

    x: float = 0.0
    y: float = 0.0
    height: float = 1.3

    def at(self, times: NDArray) -> NDArray:
        states = np.zeros((len(times), 10))
        states[:, X], states[:, Y] = self.x, self.y
        return states


@dataclass(frozen=True)
class Circle:
    """A circle about the origin that starts at rest in (radius, 0) at time ``start`` and comes smoothly to speed.

    ``radius`` and ``height`` in m, ``period``, ``start`` and ``ramp`` in s.
    """

    radius: float
    period: float
    height: float = 1.3
    start: float = 1.0
    ramp: float = 4.0

    def at(self, times: NDArray) -> NDArray:
        from fiplib.kernels import piloting

        states = np.empty((len(times), len(STATES)))
        times = np.array(times, dtype=float)
        piloting.circle(times, self.radius, self.period, self.start, self.ramp, states)
        return states


REFERENCES = {"Hover": Hover, "Circle": Circle}
"""The kinds of reference that a bag may name."""
