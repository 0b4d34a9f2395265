"""Extended Kalman filter of the states and the length together; its eleven-state model serves ``ukf``, too."""

import math
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from fiplib.dynamics import prediction_model, rk4
from fiplib.estimators.base import PRIOR, Estimate
from fiplib.kalman import Window
from fiplib.params import Params


def ekf(window: Window, params: Params, rng: np.random.Generator | None = None) -> Estimate:
    """Extended Kalman filter (filterpy) of the ten states and the length, a constant that starts at ``PRIOR``."""
    from filterpy.kalman import ExtendedKalmanFilter  # here: it takes a second to import

    step, jacobian, _ = augmented(window.step)
    estimator = ExtendedKalmanFilter(dim_x=11, dim_z=10)
    prepare(estimator, window, params)
    for state, applied in zip(window.states[1:], window.inputs[:-1], strict=True):
        estimator.F = np.array(jacobian(estimator.x, applied))
        estimator.P = estimator.F @ estimator.P @ estimator.F.T + estimator.Q
        estimator.x = np.array(step(estimator.x, applied)).ravel()
        estimator.update(state, lambda x: np.eye(10, 11), lambda x: x[:10])
        estimator.x[10] = np.clip(estimator.x[10], params.estimation.length_min, params.estimation.length_max)
    return Estimate(float(estimator.x[10]), math.sqrt(estimator.P[10, 10]))


@lru_cache(maxsize=4)
def augmented(step: float) -> tuple[ca.Function, ca.Function, ca.Function]:
    """(x (11,), u) -> x after a step with the length as eleventh state; its Jacobian; the same for 23 columns."""
    x, u = ca.SX.sym("x", 11), ca.SX.sym("u", 2)
    after = ca.vertcat(rk4(prediction_model(), step)(x[:10], u, x[10]), x[10])
    move = ca.Function("move", [x, u], [after])
    return move, ca.Function("jacobian", [x, u], [ca.jacobian(after, x)]), move.map(23)


def prepare(estimator: Any, window: Window, params: Params) -> None:
    """Set noise, first state and covariance of a joint filter; the first one is a posterior, as in ``kalman``."""
    estimation = params.estimation
    estimator.x = np.append(window.states[0], PRIOR[0])
    estimator.P = np.diag([*estimation.measurement_noise, PRIOR[1] ** 2])
    estimator.Q = np.diag([*estimation.process_noise, 0.0])
    estimator.R = np.diag(estimation.measurement_noise)
