"""Unscented Kalman filter of the states and the length together."""

import math

import numpy as np

from fiplib.estimators.base import Estimate
from fiplib.estimators.ekf import augmented, prepare
from fiplib.kalman import Window
from fiplib.params import Params


def ukf(window: Window, params: Params, rng: np.random.Generator | None = None) -> Estimate:
    """Unscented Kalman filter (filterpy) of the same eleven states as ``ekf``."""
    from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter  # here: it takes a second to import

    _, _, spread = augmented(window.step)
    # kappa = 3 - n and alpha = 0.3: sigma points at 0.5 standard deviations, so that no length turns negative
    points = MerweScaledSigmaPoints(11, alpha=0.3, beta=2.0, kappa=3.0 - 11)
    estimator = UnscentedKalmanFilter(11, 10, window.step, hx=lambda x: x[:10], fx=None, points=points)
    prepare(estimator, window, params)
    for state, applied in zip(window.states[1:], window.inputs[:-1], strict=True):
        sigmas = points.sigma_points(estimator.x, estimator.P)
        sigmas[:, 10] = np.maximum(sigmas[:, 10], params.estimation.length_min / 2)
        moved = iter(np.array(spread(sigmas.T, np.repeat(applied[:, None], len(sigmas), axis=1))).T)
        estimator.predict(fx=lambda x, dt, moved=moved: next(moved))  # all points in one call of CasADi
        estimator.update(state)
        estimator.x[10] = np.clip(estimator.x[10], params.estimation.length_min, params.estimation.length_max)
        estimator.P = (estimator.P + estimator.P.T) / 2
    return Estimate(float(estimator.x[10]), math.sqrt(max(estimator.P[10, 10], 0.0)))
