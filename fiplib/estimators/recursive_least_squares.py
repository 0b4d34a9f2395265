"""Recursive least squares of the inverse length; its regression serves ``concurrent_learning``, too."""

import math

import numpy as np
from numpy.typing import NDArray

from fiplib.estimators.base import PRIOR, Estimate
from fiplib.kalman import Window
from fiplib.params import AXES, GRAVITY, Params


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
    return inverted(float(estimator.x[0, 0]), math.sqrt(estimator.P[0, 0]), params)


def regression(window: Window) -> tuple[NDArray, NDArray]:
    """Regressor 2 g d and response d'' + g tilt, (2 (n - 1),), in time order, both as means over a step."""
    rows = []
    for axis in AXES:
        _, _, offset, offset_rate, tilt = axis.states
        mean = (window.states[1:] + window.states[:-1]) / 2
        second = np.diff(window.states[:, offset_rate]) / window.step
        rows.append((2 * GRAVITY * mean[:, offset], second + GRAVITY * axis.sign * mean[:, tilt]))
    regressor, response = np.array(rows).transpose(1, 2, 0).reshape(2, -1)
    return regressor, response


def inverted(inverse: float, deviation: float, params: Params) -> Estimate:
    """From 1/l and its standard deviation to l, to first order; refused outside the interval of lengths."""
    if not params.estimation.length_min < 1 / max(inverse, 1e-9) < params.estimation.length_max:
        return Estimate(math.nan, math.nan, f"the regression gives 1/l = {inverse:.2g} 1/m, not a rod in question")
    return Estimate(1 / inverse, deviation / inverse**2)
