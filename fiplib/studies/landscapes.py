"""What every reading of the fitness says about all 18 001 lengths, on the same windows of simulated flights.

One factor at a time is moved away from ``DEFAULT``: the excitation, the noise covariances that the filter is told, the
number of samples in the window, the sampling rate, the rod's inertia about its COM (the filter has none). Each setting
is read in each of ``READINGS``; a row sums up ``len(SEEDS) * len(ENDS)`` windows. The rod is 1 m long.

153 rows, about 12 minutes of one core.
"""

import math
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fiplib import kalman, replay
from fiplib.ga import CURVATURE_CODES, Chromosome
from fiplib.kalman import Window
from fiplib.params import A_DOT, B_DOT, NANO, Estimation, Params
from fiplib.pilot import Circle, Hover, Reference
from fiplib.recording import Flight, MemoryRecorder
from fiplib.simulate import Scenario, fly

KEYS = ("factor", "excitation", "noise", "samples", "rate", "rod", "reading")
"""``samples`` in a window, sampling ``rate`` in Hz; ``factor`` names the one that differs from ``DEFAULT``."""

READINGS = tuple(name for name in kalman.READINGS if name != "paper")
"""Every distinct reading; the paper's own is 'printed_posterior'."""

EXCITATIONS: dict[str, Reference] = {
    "circle 0.4 m / 8 s": Circle(0.4, 8.0),
    "circle 0.8 m / 9 s": Circle(0.8, 9.0),
    "circle 0.4 m / 5 s": Circle(0.4, 5.0),
    "circle 0.4 m / 12 s": Circle(0.4, 12.0),
    "hover": Hover(),
}

NOISES = {
    "default": (1.0, 1.0),
    "Q_e / 100": (1e-2, 1.0),
    "Q_e * 100": (1e2, 1.0),
    "R_e / 100": (1.0, 1e-2),
    "R_e * 100": (1.0, 1e2),
    "identity": (math.nan, math.nan),
}
"""Factors on the default Q_e and R_e; 'identity' takes Q_e = R_e = I, what a paper that prints neither suggests."""

RODS = {"uniform": 1.0 / 12.0, "point mass": 0.0}
"""k^2/l^2 of the simulated rod."""

DEFAULT = {"excitation": "circle 0.4 m / 8 s", "noise": "default", "samples": 55, "rate": 10, "rod": "uniform"}

VARIED: dict[str, tuple[Any, ...]] = {
    "excitation": tuple(EXCITATIONS)[1:],
    "noise": tuple(NOISES)[1:],
    "samples": (14, 28, 110),
    "rate": (5, 40, 120),
    "rod": ("point mass",),
}

SEEDS = (1, 2)
"""One flight each."""

ENDS = (16.0, 22.0, 28.0)
"""Seconds of the flight at which a window ends: 5.5 s windows share no sample, 11 s ones begin at full speed."""

RISE = 0.01
"""Share of its minimum by which a sum of squares rises at the edge of its valley."""


def cases() -> list[dict[str, Any]]:
    """The default setting, then each factor on its own, each in every reading."""
    settings = [{"factor": "none", **DEFAULT}]
    settings += [{"factor": factor, **DEFAULT, factor: value} for factor, values in VARIED.items() for value in values]
    return [{**setting, "reading": reading} for setting in settings for reading in READINGS]


def run(case: dict[str, Any]) -> dict[str, float | int]:
    """Landscapes of one reading at one setting, summed up by ``summary``."""
    params = params_of(case)
    estimation = params.estimation
    windows = windows_of(case["excitation"], params)
    lengths, fitness = landscapes(windows, estimation)
    true = params.pendulum.length
    kept = acceleration_kept(np.array([estimation.length_min, true]), windows[0], estimation)
    return {
        "windows": len(windows),
        **summary(lengths, fitness, true, kalman.reading(estimation).score == "likelihood"),
        "kept_at_min": float(kept[0]),
        "kept_at_truth": float(kept[1]),
    }


def params_of(case: dict[str, Any]) -> Params:
    """The parameters of a case: of the flight its rod, of the estimator the rest.

    Q_e is the variance that a sampling period adds: it is taken in proportion to the period.
    """
    default = Params()
    process, measurement = (
        tuple(variance * factor for variance in noise)
        for noise, factor in zip(
            (default.estimation.process_noise, default.estimation.measurement_noise), NOISES[case["noise"]], strict=True
        )
    )
    if case["noise"] == "identity":
        process = measurement = (1.0,) * len(process)
    elongation = 1.0 / case["rate"] / default.estimation.sample_period
    return default.replace(
        pendulum__gyration_ratio=RODS[case["rod"]],
        estimation__fitness=case["reading"],
        estimation__process_noise=tuple(variance * elongation for variance in process),
        estimation__measurement_noise=measurement,
        estimation__window=case["samples"],
        estimation__sample_period=1.0 / case["rate"],
    )


def windows_of(excitation: str, params: Params) -> list[Window]:
    """The windows of ``SEEDS`` flights that end nearest to ``ENDS``, as the estimator would be given them."""
    often = params.replace(estimation__run_period=0.1)
    chosen = []
    for seed in SEEDS:
        flight = flight_of(excitation, params.pendulum.gyration_ratio, seed)
        known = replay.windows(flight, often)
        seconds = np.array([window.stamp - flight.start_ns for window in known]) / NANO
        chosen += [known[np.abs(seconds - end).argmin()].window for end in ENDS]
    return chosen


@cache
def flight_of(excitation: str, gyration_ratio: float, seed: int) -> Flight:
    """A simulated flight with the true length; the same for all that is varied in the estimator.

    Raises:
        RuntimeError: the rod fell.
    """
    params = Params().replace(pendulum__gyration_ratio=gyration_ratio)
    scenario = Scenario(excitation, excitation, ENDS[-1] + 0.5, EXCITATIONS[excitation], params=params, seed=seed)
    tape = MemoryRecorder()
    if not fly(scenario, tape).survived:
        raise RuntimeError(f"the rod fell on {excitation}, seed {seed}")
    return replay.flight_of(tape, scenario)


def landscapes(windows: Sequence[Window], estimation: Estimation) -> tuple[NDArray, NDArray]:
    """Lengths (C,) in m and their fitness on each of W windows, (W, C): ``ga.landscape`` of all."""
    chromosome = Chromosome.of(estimation)
    lengths = chromosome.length(np.arange(chromosome.codes))
    fitness = np.array([kalman.fitness(lengths, window, estimation) for window in windows])
    return lengths, fitness


def summary(lengths: NDArray, fitness: NDArray, true: float, likelihood: bool) -> dict[str, float]:
    """What W landscapes say together.

    Args:
        lengths: evenly spaced candidates in m, (C,).
        fitness: one landscape per row, (W, C).
        true: the true length in m.
        likelihood: whether the fitness is -2 log L.

    Returns:
        ``bias`` and ``spread``: mean error and standard deviation of the best lengths, m.
        ``at_min``, ``at_max``: share of windows whose best length is the first or the last candidate.
        ``width``: median over the windows of half the interval about the best length on which the fitness rises by no
        more than ``RISE`` of its minimum (sums of squares) or 1 (likelihood: one standard deviation of a parabola), m.
        It counts nothing beyond the candidates.
        ``curvature_sd``: median standard deviation sqrt(2 / f'') at the best length, m; nan where the fitness is not a
        likelihood, or for want of an interior minimum in most windows.
    """
    best = fitness.argmin(axis=1)
    widths, deviations = [], []
    for row, index in zip(fitness, best, strict=True):
        limit = row[index] + (1.0 if likelihood else RISE * row[index])
        outside = np.flatnonzero(row > limit)
        first = outside[outside < index].max(initial=-1) + 1
        last = outside[outside > index].min(initial=len(row)) - 1
        widths.append((lengths[last] - lengths[first]) / 2)
        deviations.append(_curvature_sd(lengths, row, index) if likelihood else math.nan)
    known = [value for value in deviations if math.isfinite(value)]
    return {
        "bias": float(lengths[best].mean() - true),
        "spread": float(best.std(ddof=1) * (lengths[1] - lengths[0])),  # of indices: exactly 0 if all agree
        "at_min": float(np.mean(best == 0)),
        "at_max": float(np.mean(best == len(lengths) - 1)),
        "width": float(np.median(widths)),
        "curvature_sd": float(np.median(known)) if 2 * len(known) > len(best) else math.nan,
    }


def acceleration_kept(lengths: NDArray, window: Window, estimation: Estimation) -> NDArray:
    """Share of its innovation that the posterior residual keeps in a', b', the rows that hold the length: (C,).

    The diagonal element of I - K = R S^-1, averaged over the samples of the window and the two axes. Where it is near
    0 the posterior follows the measurement and the residual no longer sees the length.
    """
    rows = np.array([A_DOT, B_DOT])
    information = np.linalg.inv(kalman.filter_window(lengths, window, estimation).covariances)[..., rows, rows]
    return (information * np.array(estimation.measurement_noise)[rows]).mean(axis=(-2, -1))


def _curvature_sd(lengths: NDArray, fitness: NDArray, index: int) -> float:
    below, above = index - CURVATURE_CODES, index + CURVATURE_CODES
    if below < 0 or above >= len(lengths):
        return math.nan
    curvature = (fitness[below] - 2 * fitness[index] + fitness[above]) / (lengths[above] - lengths[index]) ** 2
    return math.sqrt(2 / curvature) if curvature > 0 else math.nan
