"""Brent's method on the fitness: a textbook search in one dimension instead of the genetic one."""

import math
from collections.abc import Callable

import numpy as np
import scipy
from numpy.typing import NDArray

from fiplib import kalman
from fiplib.estimators.base import Estimate
from fiplib.estimators.grid import deviation
from fiplib.kalman import Window
from fiplib.params import Estimation, Params


def scalar(window: Window, params: Params, rng: np.random.Generator | None = None) -> Estimate:
    """Brent's method (SciPy) on the fitness, within the best bracket of a coarse grid."""
    estimation = params.estimation
    length = search(lambda lengths: kalman.fitness(lengths, window, estimation), estimation)
    step = 1e-3  # small beside any deviation a window can reach, large beside rounding
    values = kalman.fitness([length - step, length, length + step], window, estimation)
    inside = estimation.length_min + 2 * step < length < estimation.length_max - 2 * step
    return Estimate(length, deviation(values, step, params) if inside else math.nan)


def search(fitness_of: Callable[[NDArray], NDArray], estimation: Estimation) -> float:
    """Return the length in m at a minimum of any fitness (C,) of lengths (C,): that in the best of 24 brackets."""
    lengths = np.geomspace(estimation.length_min, estimation.length_max, 25)
    best = int(fitness_of(lengths).argmin())
    bracket = lengths[max(best - 1, 0)], lengths[min(best + 1, len(lengths) - 1)]

    def fitness(length: float) -> float:
        return float(fitness_of(np.array([length]))[0])

    return float(scipy.optimize.minimize_scalar(fitness, bounds=bracket, method="bounded", options={"xatol": 1e-5}).x)
