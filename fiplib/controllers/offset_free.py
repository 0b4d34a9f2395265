"""Offset-free MPC: the paper's MPC about a steady state that a disturbance estimate moves.

Per axis (``params.AXES``) the prediction model is augmented by three constant disturbances, w = (w_a, w_b, w_r): the
specific force on the vehicle, that on the rod, and an error of the body rate,

    s'' = g tilt + w_a,   d'' = 2 g d / l - g tilt - w_a + w_b,   tilt' = u + w_r,   w' = 0.

*Estimate.* A Kalman filter of (z, w), all five z measured, in its steady state: its gain solves the discrete algebraic
Riccati equation of the length in use. *Target.* The steady state in which the vehicle is at its reference,

    tilt_t = -w_a / g,   d_t = -l w_b / (2 g),   u_t = -w_r,

exists and is unique whatever w is. *Regulation.* Deviations from the target obey the model without w, so the paper's
MPC of x - x_t, with the same weights and ``mpc.MPC``'s exact solver, gives u - u_t. (Bounds are of the deviations.)
Where the loop settles, the estimates are those that explain the measurement, and the vehicle's offset is zero, whatever
the cause: wind, a tilted thrust axis, a rod that is bent. This needs as many disturbances as tracked outputs; two
more keep forces on the rod and rate errors out of w_a.

The noises of z are those of the length estimator (``params.estimation``), and the rod's equation is taken to be
``ROD_MODEL`` times less exact than there: its length and inertia are not known. A velocity that feels white noise of
density n and a random walk of density q shows the walk with the bandwidth sqrt(q / n), so q follows from the bandwidths
that are wanted, ``ESTIMATION_SHARES``.

Source: G. Pannocchia, J. B. Rawlings, "Disturbance models for offset-free model-predictive control", AIChE Journal
49(2), 2003, doi:10.1002/aic.690490213; U. Maeder, F. Borrelli, M. Morari, "Linear offset-free model predictive
control", Automatica 45(10), 2009, pp. 2214-2222.
"""

import functools

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import expm, solve_discrete_are

from fiplib.controllers import ESTIMATION_SHARES, answer, by_axis, rates_by_axis, rates_of
from fiplib.dynamics import axis_matrices
from fiplib.mpc import CACHED_LENGTHS, MPC, Solution
from fiplib.params import AXES, GRAVITY, Params

ROD_MODEL = 30.0
"""Variance of the error of the rod's equation over ``estimation.process_noise``: 0.018 m^2/s^3, an error of
0.3 m/s^2 that changes within 0.2 s, as an inertia factor of 3/4 for 1 makes at a tilt of 7 degrees."""

NOISE_PERIOD = 0.1
"""Seconds for which ``estimation.process_noise`` is stated."""


class OffsetFreeMPC:
    """Offset-free MPC; it remembers its prediction of states and disturbances from call to call."""

    def __init__(self, params: Params) -> None:
        self.params, self._mpc = params, MPC(params)
        self._period = 1.0 / params.piloting.control_rate
        self._filter = functools.lru_cache(CACHED_LENGTHS)(self._design)
        self._predicted: NDArray | None = None

    def _design(self, length: float) -> tuple[NDArray, NDArray, NDArray]:
        """Transition (8, 8) and input (8,) of (z, w) over a tick, and the filter's gains of both axes (2, 8, 5)."""
        a, b = axis_matrices(length)
        continuous = np.zeros((9, 9))
        continuous[:5, :5], continuous[:5, 8:] = a, b
        continuous[[1, 3, 3, 4], [5, 5, 6, 7]] = 1.0, -1.0, 1.0, 1.0
        discrete = expm(continuous * self._period)
        transition, gains = discrete[:8, :8], []
        estimation = self.params.estimation
        shares = np.square(ESTIMATION_SHARES) * 2.0 * GRAVITY / length
        for axis in AXES:
            states = list(axis.states)
            process = np.array(estimation.process_noise)[states] / NOISE_PERIOD
            process[3] *= ROD_MODEL
            process = np.append(process, shares * process[[1, 3, 4]])
            measured = np.diag(np.array(estimation.measurement_noise)[states])
            try:
                covariance = solve_discrete_are(transition.T, np.eye(8, 5), np.diag(process) * self._period, measured)
            except np.linalg.LinAlgError as error:
                raise ValueError(
                    "offset_free_mpc has no filter with these estimation.process_noise and measurement_noise: "
                    "no variance may be zero"
                ) from error
            gains.append(np.linalg.solve(covariance[:5, :5] + measured, covariance[:5]).T)
        return transition, discrete[:8, 8], np.array(gains)

    def solve(self, state: ArrayLike, reference: ArrayLike, length: float | None = None) -> Solution:
        """As ``mpc.MPC.solve``, one call per control period."""
        state = np.array(state, dtype=float)
        length = self.params.pendulum.length if length is None else float(length)
        transition, acting, gains = self._filter(length)
        z = by_axis(state)
        if self._predicted is None:
            self._predicted = np.hstack([z, np.zeros((2, 3))])
        estimate = self._predicted + np.einsum("aij,aj->ai", gains, z - self._predicted[:, :5])
        target = np.zeros(len(state))
        for axis, (force, rod, _) in zip(AXES, estimate[:, 5:], strict=True):
            target[axis.states[2]] = -length * rod / (2.0 * GRAVITY)
            target[axis.states[4]] = -axis.sign * force / GRAVITY
        solution = self._mpc.solve(state - target, reference, length)
        rates = solution.input - rates_of(estimate[:, 7])
        given = answer(rates, self.params.vehicle.max_body_rate, solution.status)
        self._predicted = estimate @ transition.T + np.outer(rates_by_axis(given.input), acting)
        return given
