"""Exhaustive search of the fitness: what a perfect search of it finds."""

import math

import numpy as np
from numpy.typing import NDArray

from fiplib import kalman
from fiplib.estimators.base import Estimate
from fiplib.ga import CURVATURE_CODES, Chromosome, landscape
from fiplib.kalman import Window
from fiplib.params import Params


def grid(window: Window, params: Params, rng: np.random.Generator | None = None) -> Estimate:
    """The best of all lengths that the chromosome can express."""
    found = landscape(window, params)
    best, codes = int(found.fitness.argmin()), CURVATURE_CODES
    if not codes <= best < len(found.lengths) - codes:
        return Estimate(found.best, math.nan)
    values = found.fitness[[best - codes, best, best + codes]]
    return Estimate(found.best, deviation(values, codes * params.estimation.resolution, params))


def best_length(window: Window, params: Params) -> float:
    """The same length in m at a tenth of the cost: all lengths in steps of 1 mm, then every code about the best of
    them. The minimum is centimetres wide, so nothing hides between the steps."""
    coarse = landscape(window, params.replace(estimation__resolution=1e-3)).best
    chromosome = Chromosome.of(params.estimation)
    lengths = chromosome.length(np.arange(chromosome.codes))
    lengths = lengths[np.abs(lengths - coarse) < 2e-3]
    return float(lengths[kalman.fitness(lengths, window, params.estimation).argmin()])


def deviation(values: NDArray, step: float, params: Params) -> float:
    """sqrt(2 / f'') from three values of f = -2 log L; nan for readings that are no likelihood or not convex."""
    curvature = (values[0] - 2 * values[1] + values[2]) / step**2
    good = kalman.reading(params.estimation).score == "likelihood" and 0 < curvature < math.inf
    return math.sqrt(2 / curvature) if good else math.nan
