"""What the page of ``fiplib.teaching.explorer`` computes on a window of a flight."""

import math
import time
from collections.abc import Iterator

import numpy as np

from fiplib import ga, kalman, replay
from fiplib.estimators import ESTIMATORS
from fiplib.estimators.base import Estimate
from fiplib.estimators.checks import checked
from fiplib.kalman import Window
from fiplib.params import Params
from fiplib.recording import Flight
from fiplib.teaching.explorer_plots import WindowFit
from fiplib.teaching.explorer_widgets import PROBLEMS

LANDSCAPE_SAMPLES = 90_000
"""Lengths times samples of the landscape that is drawn: about 0.1 s."""


def fit_window(window: Window, params: Params, seed: int) -> WindowFit:
    """Landscape, genetic algorithm and best length of a window.

    Raises ValueError as ``kalman.fitness``, or if the filter overflows at every length.
    """
    began, estimation = time.perf_counter(), params.estimation
    chromosome = ga.Chromosome.of(estimation)
    count = min(chromosome.codes, LANDSCAPE_SAMPLES // len(window.states))
    codes = np.unique(np.linspace(0, chromosome.codes - 1, count).round().astype(int))
    lengths = chromosome.length(codes)
    fitness = kalman.fitness(lengths, window, estimation)
    if not np.isfinite(fitness).any():
        raise ValueError("the filter overflows at every length: take a shorter window or another reading")
    coarse = int(fitness.argmin())
    near = chromosome.length(np.arange(codes[max(coarse - 1, 0)], codes[min(coarse + 1, len(codes) - 1)] + 1))
    best = float(near[kalman.fitness(near, window, estimation).argmin()])
    # settings change with every run here: a table of all gains would take ten times as long as it saves
    found = ga.estimate(window, params, np.random.default_rng(seed))
    return WindowFit(window, params, lengths, fitness, best, found, time.perf_counter() - began)


def stated(fit: WindowFit) -> Estimate:
    """What may be stated of the genetic algorithm's length: refused at an end of the interval, or by its residuals."""
    return checked(Estimate(fit.found.length, fit.found.standard_deviation), fit.window, fit.params)


def compare(
    flight: Flight, window: Window, start: float, end: float, params: Params, seed: int
) -> Iterator[tuple[str, Estimate, float]]:
    """Every estimator on the same stretch of flight: name, estimate (with its reason if refused), seconds taken."""
    for name, estimator in ESTIMATORS.items():
        began = time.perf_counter()
        try:
            data = window if estimator.kind == "states" else replay.raw_window_between(flight, start, end)
            found = estimator.answer(data, params, np.random.default_rng(seed))
        except (*PROBLEMS, RuntimeError) as error:  # the latter is CasADi's
            found = Estimate(math.nan, math.nan, str(error))
        yield name, found, time.perf_counter() - began
