"""The regulator of ``lqr`` with the nominal motion that the design of 2011 solves for: exact on a steady circle.

With the angular speed w, the acceleration p'' = w J p' (J turns by 90 degrees) and p''' = -w^2 p', the rod's equation
d'' = 2 g d / l - p'' has the periodic solution d = p'' / (2 g / l + w^2), to first order in the lean. So

    z_0 = (p, p', d, d', p''/g),   d' = p''' / (2 g / l + w^2),   u_0 = p'''/g,

where ``lqr`` leaves w^2 out. w is the angle by which the reference's velocity turns from its first node to the second;
where the circle is not steady, while it comes to speed, this is an approximation. A vehicle that hovers has w = 0.

Source: M. Hehn, R. D'Andrea, "A flying inverted pendulum", IEEE ICRA, 2011.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fiplib.controllers import answer, by_axis, rates_of
from fiplib.controllers.lqr import LQR
from fiplib.mpc import Solution
from fiplib.params import A_DOT, B_DOT, GRAVITY, PHI, THETA, X_DOT, Y_DOT, A, B, Params, X, Y


class CircleLQR(LQR):
    """Linear quadratic regulator about the motion on a circle."""

    def __init__(self, params: Params) -> None:
        super().__init__(params)
        self._step, self._limit = params.control.step, params.vehicle.max_body_rate
        self._default = params.pendulum.length

    def solve(self, state: ArrayLike, reference: ArrayLike, length: float | None = None) -> Solution:
        """As ``lqr.LQR.solve``; of the reference the first two nodes are used."""
        length = self._default if length is None else float(length)
        nominal, forward = circular_motion(np.asarray(reference, dtype=float), self._step, length)
        error = by_axis(np.asarray(state, dtype=float) - nominal)
        return answer(rates_of(forward - error @ self._gain(length)), self._limit)


def circular_motion(reference: NDArray, step: float, length: float) -> tuple[NDArray, NDArray]:
    """Return the nominal state (10,) and p'''/g (2,), 1/s, at the first of nodes (n, 10), ``step`` s apart."""
    (u, v), (u_next, v_next) = reference[:2, [X_DOT, Y_DOT]]
    speed = math.atan2(u * v_next - v * u_next, u * u_next + v * v_next) / step
    acceleration, jerk = speed * np.array([-v, u]), -(speed**2) * np.array([u, v])
    stiffness = 2.0 * GRAVITY / length + speed**2
    nominal = np.zeros(reference.shape[1])
    nominal[[X, Y, X_DOT, Y_DOT]] = reference[0, [X, Y, X_DOT, Y_DOT]]
    nominal[[A, B]], nominal[[A_DOT, B_DOT]] = acceleration / stiffness, jerk / stiffness
    nominal[[THETA, PHI]] = acceleration[0] / GRAVITY, -acceleration[1] / GRAVITY
    return nominal, jerk / GRAVITY
