"""Small angles that nobody sees, enlarged: rods lean by two or three degrees in flight."""

import math

import numpy as np
from numpy.typing import ArrayLike

ENLARGED = 5.0
"""How many times the lean of the rod and the tilt of the vehicle are enlarged in the second picture."""

STEEPEST = math.sin(math.radians(75.0))
"""Sine at which an enlarged lean stops."""


def upright(axis: ArrayLike, enlarged: float = 1.0) -> tuple[float, float, float, float]:
    """Return the quaternion (x, y, z, w) of the turn about a horizontal axis that takes z to a unit vector (3,).

    Its lean is ``enlarged``: the sine times that factor, at most ``STEEPEST``.
    """
    x, y, z = np.asarray(axis, dtype=float)
    if enlarged != 1.0:
        sine = math.hypot(x, y)
        factor = min(enlarged, STEEPEST / sine) if sine > 0.0 else 1.0
        x, y = factor * x, factor * y
        z = math.sqrt(1.0 - x * x - y * y)
    norm = math.sqrt(2.0 * (1.0 + z))
    return -y / norm, x / norm, 0.0, (1.0 + z) / norm
