"""Concurrent learning of the inverse length: an adaptive law with a memory."""

import math

import numpy as np

from fiplib.estimators.base import PRIOR, Estimate
from fiplib.estimators.recursive_least_squares import inverted, regression
from fiplib.kalman import Window
from fiplib.params import Params


def concurrent_learning(window: Window, params: Params, rng: np.random.Generator | None = None) -> Estimate:
    """Concurrent learning: an adaptive law that is driven by recorded data beside the current error.

    p = 1/l follows p' = gamma (e phi + sum_j e_j phi_j), with the error e = response - p phi now and e_j at the points
    of a history stack, which keeps the points of largest |phi| (for one parameter this maximises the least singular
    value that governs convergence). Steps are normalised, so that the law is stable at any excitation.
    """
    regressor, response = regression(window)
    value, stack = 1 / PRIOR[0], np.zeros(0, dtype=int)
    for now in range(len(regressor)):
        stack = np.append(stack, now)
        stack = stack[np.argsort(-np.abs(regressor[stack]), kind="stable")[:20]]
        used = np.append(stack, now)
        phi, error = regressor[used], response[used] - value * regressor[used]
        value += 0.5 * float(phi @ error) / float(phi @ phi + 1e-6)
    return inverted(value, math.nan, params)
