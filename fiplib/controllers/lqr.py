"""The design of the first flying inverted pendulum: a linear quadratic regulator about the nominal motion.

M. Hehn and R. D'Andrea, "A flying inverted pendulum", ICRA 2011: linearised about its nominal motion, each axis is
regulated by the gain that minimises

    int (s^2 + rho u^2) dt,      z = (s, s', d, d', tilt),      z' = A(l) z + B u,      u = u_0 - K (z - z_0),

with the two penalties of that design, those of the vehicle's position s and of the body rate u; every other weight is
zero. Their ratio is ours (``WEIGHTS``). The nominal motion (z_0, u_0) of a trajectory with the acceleration p'' is that
of slow motion, as if p'' stayed: tilt p''/g, rod d = l p''/(2 g), which the 2011 design solves for exactly on a circle;
on one of 8 s it is 3 % too large. Bounds and the loop's delay are not known to it; rates are cut off at their limit.
"""

import functools
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fiplib.controllers import answer
from fiplib.dynamics import axis_matrices
from fiplib.mpc import Solution
from fiplib.params import AXES, GRAVITY, Params


class Weights(NamedTuple):
    """Penalties of an axis: ``state`` of (s, s', d, d', tilt) squared, 1/unit^2, ``input`` of the rate, s^2/rad^2."""

    state: tuple[float, ...]
    input: float


WEIGHTS = Weights((1.0, 0.0, 0.0, 0.0, 0.0), 0.25)
"""One metre weighs as two rad/s: our choice, near the bandwidth of the MPC; the paper of 2011 gives no numbers."""


class LQR:
    """Linear quadratic regulator with the gain of the length in use.

    Args:
        params: supplies the largest body rate, the nodes' distance in time, and the length where none is given.
        weights: of both axes.
    """

    weights = WEIGHTS

    def __init__(self, params: Params, weights: Weights | None = None) -> None:
        self._params, self._weights = params, weights or self.weights
        self._gain = functools.lru_cache(8)(lambda length: gain(length, self._weights))

    def solve(self, state: ArrayLike, reference: ArrayLike, length: float | None = None) -> Solution:
        """The body rates of u = u_0 - K (z - z_0); arguments as ``mpc.MPC.solve``. ValueError: no positive length."""
        length = self._params.pendulum.length if length is None else float(length)
        state, reference, rates = np.asarray(state, dtype=float), np.asarray(reference, dtype=float), np.empty(2)
        for axis in AXES:
            # z = (s, s', d, d', sign * tilt) and sign * rate: see params.Axis
            signs, states = np.array((1.0, 1.0, 1.0, 1.0, axis.sign)), list(axis.states)
            nominal, forward = nominal_motion(reference[:3, states[:2]], self._params.control.step, length)
            rates[axis.input] = axis.sign * (forward - self._gain(length) @ (signs * state[states] - nominal))
        return answer(rates, self._params.vehicle.max_body_rate)


def gain(length: float, weights: Weights) -> NDArray:
    """Return K (5,) for a length in m; ValueError if that is not positive.

    It is rounded to 9 digits: so every CPU flies the same bits, whatever order its LAPACK sums in.
    """
    import control

    if not 0.0 < length < np.inf:
        raise ValueError(f"length must be positive and finite, got {length} m")
    found, _, _ = control.lqr(*axis_matrices(length), np.diag(weights.state), [[weights.input]])
    return np.array([float(f"{value:.9g}") for value in found[0]])


def nominal_motion(path: NDArray, step: float, length: float) -> tuple[NDArray, float]:
    """Return z_0 (5,) and u_0 at the first of three places (3, 2) in m and m/s of one axis, ``step`` s apart."""
    first, second, third = path[:, 1]
    acceleration = (4.0 * second - 3.0 * first - third) / (2.0 * step)
    jerk = (first - 2.0 * second + third) / step**2
    lean = length / (2.0 * GRAVITY)
    return np.array((*path[0], lean * acceleration, lean * jerk, acceleration / GRAVITY)), jerk / GRAVITY
