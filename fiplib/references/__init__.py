"""Trajectories that a pilot can follow.

To add one, write a frozen dataclass ``(Reference)`` with ``height`` and ``at``, and a line of ``REFERENCES``.
"""

from dataclasses import dataclass, replace
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from fiplib.params import STATES, X, Y


class Reference(Protocol):
    """A trajectory: ``height`` in m and ``at(times)`` in s since the first step -> states (n, 10)."""

    @property
    def height(self) -> float: ...

    def at(self, times: NDArray) -> NDArray: ...

    def informed(self, time: float, deviation: float) -> Self:
        """Return the trajectory to follow once, at ``time`` in s, the length is known to a ``deviation`` in m.

        It must be the same up to ``time``. Most trajectories do not serve to identify the length: they go on.
        """
        return self


@dataclass(frozen=True)
class Hover(Reference):
    """Stay at one place (x, y) in m."""

    x: float = 0.0
    y: float = 0.0
    height: float = 1.3

    def at(self, times: NDArray) -> NDArray:
        states = np.zeros((len(times), 10))
        states[:, X], states[:, Y] = self.x, self.y
        return states


@dataclass(frozen=True)
class Circle(Reference):
    """A circle about the origin that starts at rest in (radius, 0) at time ``start`` and comes smoothly to speed.

    ``radius`` and ``height`` in m, ``period``, ``start`` and ``ramp`` in s. Raises ValueError: period or ramp are not
    above 0.
    """

    radius: float
    period: float
    height: float = 1.3
    start: float = 1.0
    ramp: float = 4.0

    def __post_init__(self) -> None:
        _above_zero("a circle", period=self.period, ramp=self.ramp)

    def at(self, times: NDArray) -> NDArray:
        from fiplib.kernels import piloting

        states = np.empty((len(times), len(STATES)))
        times = np.array(times, dtype=float)
        piloting.circle(times, self.radius, self.period, self.start, self.ramp, states)
        return states


@dataclass(frozen=True)
class Multisine(Reference):
    """A sum of harmonics about the origin that starts there at rest, which excites the rod to identify its length.

    ``frequency`` of the first harmonic in Hz; ``x`` and ``y`` in m are the amplitudes (cos, sin) of the first harmonic,
    of the second, and so on; they grow to full size within ``ramp`` s. If ``wanted`` is positive, they fade to hover
    within ``fade`` s once the length is known to a standard deviation of ``wanted`` m, which was at ``known`` s
    (``None``: not yet).
    """

    frequency: float
    x: tuple[float, ...]
    y: tuple[float, ...]
    ramp: float = 1.0
    height: float = 1.3
    wanted: float = 0.0
    fade: float = 6.0
    known: float | None = None

    def __post_init__(self) -> None:
        for axis in ("x", "y"):  # a bag has lists
            object.__setattr__(self, axis, tuple(np.atleast_1d(getattr(self, axis)).tolist()))
        if len(self.x) != len(self.y) or len(self.x) % 2:
            raise ValueError(f"a multisine needs as many pairs (cos, sin) along y as along x, not {self.x}, {self.y}")
        _above_zero("a multisine", frequency=self.frequency, ramp=self.ramp, fade=self.fade)

    def at(self, times: NDArray) -> NDArray:
        from fiplib.kernels import piloting

        states = np.empty((len(times), len(STATES)))
        known = np.inf if self.known is None else self.known
        about = np.array((self.frequency, self.ramp, known, self.fade))
        piloting.multisine(np.array(times, dtype=float), about, np.array((self.x, self.y)), states)
        return states

    def informed(self, time: float, deviation: float) -> Self:
        known = self.known is None and 0.0 < deviation <= self.wanted
        return replace(self, known=time) if known else self


def _above_zero(what: str, **numbers: float) -> None:
    for name, number in numbers.items():
        if not 0.0 < number < np.inf:
            raise ValueError(f"{name} of {what} must be a number above 0, not {number!r}")


REFERENCES = {"Hover": Hover, "Circle": Circle, "Multisine": Multisine}
"""The kinds of reference that a bag may name."""
