"""The paper's genetic algorithm as an estimator, with the paper's own remedies, and on the likelihood of raw poses."""

import math
from dataclasses import replace

import numpy as np

from fiplib.estimators.base import Estimate
from fiplib.estimators.windows import RawWindow
from fiplib.ga import estimate, evolve
from fiplib.kalman import Window
from fiplib.params import Params

IMPROVED = {"elite_fraction": 1 / 30, "mutation_rate": 0.2}
"""The paper's own remedies (its conclusion): fewer elites, more mutation. Two elites of sixty keep the population
diverse, and three flipped bits of fifteen keep it searching."""


def ga(window: Window, params: Params, rng: np.random.Generator) -> Estimate:
    """The paper's genetic algorithm with its printed settings (``ga.estimate``)."""
    found = estimate(window, params, rng)
    return Estimate(found.length, found.standard_deviation)


def ga_improved(window: Window, params: Params, rng: np.random.Generator) -> Estimate:
    """The same with fewer elites and more mutation, at the same number of evaluations (``IMPROVED``)."""
    return ga(window, replace(params, estimation=replace(params.estimation, **IMPROVED)), rng)


def ga_poses(window: RawWindow, params: Params, rng: np.random.Generator) -> Estimate:
    """The printed algorithm on another fitness: the profile likelihood of raw poses (``poses.profile``)."""
    from fiplib.estimators.poses.checks import Refusal  # compiled code: half a second to import
    from fiplib.estimators.poses.in_flight import profile_of

    try:
        found = evolve(profile_of(window, params), params.estimation, rng)
    except Refusal as refusal:
        return Estimate(math.nan, math.nan, str(refusal))
    return Estimate(found.length, found.standard_deviation)
