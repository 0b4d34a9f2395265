"""The paper's MPC with an L1 adaptive augmentation: what the model does not explain is taken off its rate commands.

Per axis (``params.AXES``) a state predictor runs beside the MPC on z = (s', d', tilt), with l the length in use:

    s''   = g (tilt + sigma_a)
    d''   = 2 g d / l - g (tilt + sigma_a) + g sigma_b
    tilt' = u + sigma_r

sigma_r is an uncertainty of the rate command. sigma_a, a force on the vehicle or a thrust that is not along the body's
z axis, acts as a further tilt; in terms of the effective tilt, tilt + sigma_a, it is matched, too. sigma_b (a force on
the rod, another length or inertia than the model's) is not: no rate cancels it, and it is estimated only so that it
does not corrupt the others. At every tick, T apart,

    prediction    z^ <- z^ + T (f(z, u) + B sigma^ + A_s (z^ - z)),   A_s = -``PREDICTOR`` I
    adaptation    sigma^ = -B^-1 Phi^-1 exp(A_s T) (z^ - z),          Phi = A_s^-1 (exp(A_s T) - I)
    compensation  the MPC is given tilt + C(s) sigma_a^;   u = u_MPC - C(s) sigma_r^,   C(s) = w / (s + w)

The piecewise constant adaptation law is as fast as the sampling; robustness is left to the filter C(s). Its bandwidth w
is a ``SHARE`` of sqrt(2 g / l), the rate at which the rod falls: an estimate that is faster answers the rod's own
motion, which the model misses in inertia, lag and delay.

Source: D. Hanover, P. Foehn, S. Sun, E. Kaufmann, D. Scaramuzza, "Performance, precision, and payloads: adaptive
nonlinear MPC for quadrotors", IEEE Robotics and Automation Letters, 2021, doi:10.1109/LRA.2021.3131690.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fiplib.controllers import answer
from fiplib.mpc import MPC, Solution
from fiplib.params import AXES, GRAVITY, Params

SHARE = 0.25
"""Bandwidth of the filter as a share of the rate at which the rod falls."""

PREDICTOR = 5.0
"""Decay rate of the predictor's error, 1/s."""

_MATCHED = np.array([[GRAVITY, 0.0, 0.0], [-GRAVITY, GRAVITY, 0.0], [0.0, 0.0, 1.0]])
"""B: how (sigma_a, sigma_b, sigma_r) act on z'."""


class L1AugmentedMPC:
    """The MPC with L1 adaptation; it remembers the prediction, the estimate and its filter from call to call."""

    def __init__(self, params: Params) -> None:
        self.params, self._mpc = params, MPC(params)
        self._period = 1.0 / params.piloting.control_rate
        left = math.exp(-PREDICTOR * self._period)
        self._adaptation = np.linalg.inv(_MATCHED).T * PREDICTOR * left / (1.0 - left)
        self._filtered, self._predicted = np.zeros((2, 3)), None

    def solve(self, state: ArrayLike, reference: ArrayLike, length: float | None = None) -> Solution:
        """As ``mpc.MPC.solve``, one call per control period."""
        state = np.array(state, dtype=float)
        length = self.params.pendulum.length if length is None else float(length)
        shifted = state.copy()
        z = np.array([axis.sign ** np.array([0, 0, 1]) * state[list(axis.states[1::2]) + [axis.states[4]]] for axis in AXES])
        offset = np.array([state[axis.states[2]] for axis in AXES])
        if self._predicted is None:
            self._predicted = z
        error = self._predicted - z
        sigma = -error @ self._adaptation
        share = 1.0 - math.exp(-SHARE * math.sqrt(2.0 * GRAVITY / length) * self._period)
        self._filtered = self._filtered + share * (sigma - self._filtered)
        for axis, (extra, _, _) in zip(AXES, self._filtered, strict=True):
            shifted[axis.states[4]] += axis.sign * extra
        solution = self._mpc.solve(shifted, reference, length)
        rates = solution.input.copy()
        for axis, (_, _, extra) in zip(AXES, self._filtered, strict=True):
            rates[axis.input] -= axis.sign * extra
        given = answer(rates, self.params.vehicle.max_body_rate, solution.status)
        rate = np.array([axis.sign * given.input[axis.input] for axis in AXES])
        thrust = GRAVITY * z[:, 2]
        known = np.column_stack([thrust, 2.0 * GRAVITY / length * offset - thrust, rate])
        self._predicted = self._predicted + self._period * (known + sigma @ _MATCHED.T - PREDICTOR * error)
        return given
