"""The paper's MPC with an L1 adaptive augmentation, which compensates the estimated model error in the rate commands.

Per axis (``params.AXES``) a state predictor runs beside the MPC on z = (s', d', tilt), with l the length in use:

    s''   = g (tilt + sigma_a)
    d''   = 2 g d / l - g (tilt + sigma_a) + g sigma_b
    tilt' = u + sigma_r

sigma_r is an uncertainty of the rate command and matched: a rate cancels it. sigma_a, a force on the vehicle or a
thrust that is not along the body's z axis, acts as a further tilt, and sigma_b, a force on the rod or another length or
inertia than the model's, as a further lean l sigma_b / 2. In terms of the effective tilt and lean they are matched,
too, while they change slowly. (Without sigma_b, a wind that blows on vehicle and rod leaves a larger offset than the
MPC's own, whose two errors partly cancel.) At every tick, T apart,

    prediction    z^ <- z^ + T (f(z, u) + B sigma^ + A_s (z^ - z)),   A_s = -``PREDICTOR`` I
    adaptation    sigma^ = -B^-1 Phi^-1 exp(A_s T) (z^ - z),          Phi = A_s^-1 (exp(A_s T) - I)
    compensation  the MPC is given tilt + C(s) sigma_a^ and d + l/2 C(s) sigma_b^;   u = u_MPC - C(s) sigma_r^

The piecewise constant adaptation law is as fast as the sampling, and short of a constant uncertainty by
1 - exp(A_s T) = 4 %. Robustness is left to the low-pass filter C(s) = w / (s + w), its bandwidth w one of
``ESTIMATION_SHARES`` of the rate at which the rod falls.

Source: D. Hanover, P. Foehn, S. Sun, E. Kaufmann, D. Scaramuzza, "Performance, precision, and payloads: adaptive
nonlinear MPC for quadrotors", IEEE Robotics and Automation Letters, 2021, doi:10.1109/LRA.2021.3131690.
"""

import math

import numpy as np
from numpy.typing import ArrayLike

from fiplib.controllers import ESTIMATION_SHARES, answer, by_axis, rates_by_axis, rates_of
from fiplib.mpc import MPC, Solution
from fiplib.params import AXES, GRAVITY, Params

PREDICTOR = 5.0
"""Decay rate of the predictor's error, 1/s: about that at which the rod falls."""

_MATCHED = np.array([[GRAVITY, 0.0, 0.0], [-GRAVITY, GRAVITY, 0.0], [0.0, 0.0, 1.0]])
"""The matrix B, by which (sigma_a, sigma_b, sigma_r) act on z'."""


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
        measured = by_axis(state)
        z, offset = measured[:, [1, 3, 4]], measured[:, 2]
        error = np.zeros_like(z) if self._predicted is None else self._predicted - z
        sigma = -error @ self._adaptation
        bandwidths = np.array(ESTIMATION_SHARES) * math.sqrt(2.0 * GRAVITY / length)
        # of (sigma_a, sigma_b, sigma_r), as the shares are
        self._filtered = self._filtered + (1.0 - np.exp(-bandwidths * self._period)) * (sigma - self._filtered)
        effective = state.copy()
        for axis, (tilt, lean, _) in zip(AXES, self._filtered, strict=True):
            effective[axis.states[2]] += length / 2.0 * lean
            effective[axis.states[4]] += axis.sign * tilt
        solution = self._mpc.solve(effective, reference, length)
        rates = solution.input - rates_of(self._filtered[:, 2])
        given = answer(rates, self.params.vehicle.max_body_rate, solution.status)
        thrust = GRAVITY * z[:, 2]
        known = np.column_stack([thrust, 2.0 * GRAVITY / length * offset - thrust, rates_by_axis(given.input)])
        self._predicted = z + error + self._period * (known + sigma @ _MATCHED.T - PREDICTOR * error)
        return given
