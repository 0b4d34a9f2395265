"""Exhaustive search of the fitness: what a perfect search of it finds."""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from fiplib import kalman
from fiplib.estimators.base import Estimate
from fiplib.ga import CURVATURE_CODES, Chromosome, landscape
from fiplib.kalman import Window
from fiplib.params import Estimation, Params


def grid(window: Window, params: Params, rng: np.random.Generator | None = None) -> Estimate:
    """The best of all lengths that the chromosome can express."""
    found = landscape(window, params)
    best, codes = int(found.fitness.argmin()), CURVATURE_CODES
    if not codes <= best < len(found.lengths) - codes:
        return Estimate(found.best, math.nan)
    values = found.fitness[[best - codes, best, best + codes]]
    return Estimate(found.best, deviation(values, codes * params.estimation.resolution, params))


def best_length(window: Window, params: Params) -> float:
    """The same length in m at a tenth of the cost (``search``)."""
    return search(lambda lengths: kalman.fitness(lengths, window, params.estimation), params.estimation)


def search(fitness_of: Callable[[NDArray], NDArray], estimation: Estimation, step: float = 1e-3) -> float:
    """Return the length in m with the smallest fitness: all in steps of ``step`` m, then every code about the best.

    The minimum of a window is centimetres wide, so nothing hides between steps of 1 mm.
    """
    chromosome = Chromosome.of(estimation)
    lengths = chromosome.length(np.arange(chromosome.codes))
    coarse = lengths[:: max(1, round(step / estimation.resolution))]
    near = lengths[np.abs(lengths - coarse[fitness_of(coarse).argmin()]) < 2 * step]
    return float(near[fitness_of(near).argmin()])


def deviation(values: NDArray, step: float, params: Params) -> float:
    """sqrt(2 / f'') from three values of f = -2 log L; nan if f is no likelihood or not convex."""
    return curvature_deviation(values, step) if kalman.reading(params.estimation).score == "likelihood" else math.nan


def curvature_deviation(values: NDArray, step: float) -> float:
    """sqrt(2 / f'') from three values of f = -2 log L, ``step`` m apart; nan where it is not convex."""
    curvature = (values[0] - 2 * values[1] + values[2]) / step**2
    return math.sqrt(2 / curvature) if 0 < curvature < math.inf else math.nan
