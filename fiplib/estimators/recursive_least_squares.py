"""Recursive least squares of the inverse length."""

import math

import numpy as np

from fiplib.estimators.base import PRIOR, Estimate, inverted, regression
from fiplib.kalman import Window
from fiplib.params import AXES, Params


def recursive_least_squares(window: Window, params: Params, rng: np.random.Generator | None = None) -> Estimate:
    """Recursive least squares of 1/l: the Kalman filter (filterpy) of a constant, one regression per step and axis."""
    from filterpy.kalman import KalmanFilter  # here: it takes a second to import

    regressor, response = regression(window)
    estimator = KalmanFilter(dim_x=1, dim_z=1)
    estimator.x[:] = 1 / PRIOR[0]
    estimator.P[:] = 1 / params.estimation.length_min**2  # knows next to nothing
    estimator.Q[:] = 0.0
    # the response errs by the noise of two velocities over a step
    velocity = params.estimation.measurement_noise[AXES[0].states[3]]
    estimator.R[:] = 2 * velocity / window.step**2
    for row, value in zip(regressor, response, strict=True):
        estimator.predict()
        estimator.update(value, H=np.array([[row]]))
    inverse = float(estimator.x[0, 0])
    return inverted(inverse, math.sqrt(estimator.P[0, 0]), params)
