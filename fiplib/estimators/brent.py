"""Brent's method on the fitness: a textbook search in one dimension instead of the genetic one."""

import math

import numpy as np
import scipy

from fiplib import kalman
from fiplib.estimators.base import Estimate
from fiplib.estimators.grid import deviation
from fiplib.kalman import Window
from fiplib.params import Params


def scalar(window: Window, params: Params, rng: np.random.Generator | None = None) -> Estimate:
    """Brent's method (SciPy) on the fitness, within the best bracket of a coarse grid."""
    estimation = params.estimation
    lengths = np.geomspace(estimation.length_min, estimation.length_max, 25)

    def fitness(length: float) -> float:
        return float(kalman.fitness([length], window, estimation)[0])

    best = int(kalman.fitness(lengths, window, estimation).argmin())
    bracket = lengths[max(best - 1, 0)], lengths[min(best + 1, len(lengths) - 1)]
    length = float(scipy.optimize.minimize_scalar(fitness, bounds=bracket, method="bounded", options={"xatol": 1e-5}).x)
    step = 1e-3  # small beside any deviation a window can reach, large beside rounding
    values = kalman.fitness([length - step, length, length + step], window, estimation)
    inside = estimation.length_min + 2 * step < length < estimation.length_max - 2 * step
    return Estimate(length, deviation(values, step, params) if inside else math.nan)
