"""The fitness of all 18 001 lengths in each of its interpretations, on the same windows of simulated flights.

One factor at a time is moved away from ``DEFAULT``: the excitation, the noise covariances that the filter assumes, the
number of samples in the window, the sampling rate, the rod's inertia about its COM (the filter has none). Each setting
is evaluated in each of ``READINGS``; a row sums up ``len(SEEDS) * len(ENDS)`` windows. The rod is 1 m long.

153 rows, about 12 minutes of one core.
"""

import math
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from fiplib import kalman, replay
from fiplib.ga import CURVATURE_CODES, Chromosome
from fiplib.kalman import Window
from fiplib.params import A_DOT, B_DOT, NANO, Estimation, Params
from fiplib.recording import Flight
from fiplib.references import Circle, Hover, Reference
from fiplib.reproduction.sources import Rows
from fiplib.reproduction.style import BLUE, COLUMN, GREEN, ORANGE, PURPLE, origin
from fiplib.reproduction.tables import Table, number
from fiplib.simulate import Scenario
from fiplib.studies.batch import fly_many

KEYS = ("factor", "excitation", "noise", "samples", "rate", "rod", "reading")
"""``samples`` in a window, sampling ``rate`` in Hz; ``factor`` names the one that differs from ``DEFAULT``."""

READINGS = tuple(name for name in kalman.READINGS if name != "paper")
"""Every distinct interpretation; the paper's own is 'printed_posterior'."""

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
    """Return the default setting, then each factor on its own, each in every interpretation."""
    settings = [{"factor": "none", **DEFAULT}]
    settings += [{"factor": factor, **DEFAULT, factor: value} for factor, values in VARIED.items() for value in values]
    return [{**setting, "reading": reading} for setting in settings for reading in READINGS]


def run(case: dict[str, Any]) -> dict[str, float | int]:
    """Landscapes of one interpretation at one setting, summed up by ``summary``."""
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
    """Return the parameters of a case: of the flight its rod, of the estimator the rest.

    Q_e is the variance that a sampling period adds: it is taken in proportion to the period.
    """
    default, factors = Params(), NOISES[case["noise"]]
    process = np.multiply(default.estimation.process_noise, factors[0])
    measurement = np.multiply(default.estimation.measurement_noise, factors[1])
    if case["noise"] == "identity":
        process = measurement = np.ones(len(process))
    elongation = 1.0 / case["rate"] / default.estimation.sample_period
    return default.replace(
        pendulum__gyration_ratio=RODS[case["rod"]],
        estimation__fitness=case["reading"],
        estimation__process_noise=tuple((process * elongation).tolist()),
        estimation__measurement_noise=tuple(measurement.tolist()),
        estimation__window=case["samples"],
        estimation__sample_period=1.0 / case["rate"],
    )


def windows_of(excitation: str, params: Params) -> list[Window]:
    """Return the windows of ``SEEDS`` flights that end nearest to ``ENDS``, as the estimator would be given them."""
    often = params.replace(estimation__run_period=0.1)
    chosen = []
    for seed in SEEDS:
        flight = flown(excitation, params.pendulum.gyration_ratio, seed, ENDS[-1] + 0.5)
        known = replay.windows(flight, often)
        seconds = np.array([window.stamp - flight.start_ns for window in known]) / NANO
        chosen += [known[np.abs(seconds - end).argmin()].window for end in ENDS]
    return chosen


@cache
def flown(excitation: str, gyration_ratio: float, seed: int, seconds: float) -> Flight:
    """A simulated flight with the true length; the same whatever is varied in the estimator. Raises RuntimeError if the
    rod falls."""
    params = Params().replace(pendulum__gyration_ratio=gyration_ratio)
    [flight] = fly_many([Scenario(excitation, "", seconds, EXCITATIONS[excitation], params=params, seed=seed)])
    if not flight.survived:
        raise RuntimeError(f"the rod fell on {excitation}, seed {seed}")
    return flight


def landscapes(windows: Sequence[Window], estimation: Estimation) -> tuple[NDArray, NDArray]:
    """Lengths (C,) in m and their fitness on each of W windows, (W, C): ``ga.landscape`` of all."""
    chromosome = Chromosome.of(estimation)
    lengths = chromosome.length(np.arange(chromosome.codes))
    fitness = np.array([kalman.fitness(lengths, window, estimation) for window in windows])
    return lengths, fitness


def summary(lengths: NDArray, fitness: NDArray, true: float, likelihood: bool) -> dict[str, float]:
    """Return a summary of W landscapes ``fitness`` (W, C) of evenly spaced ``lengths`` (C,) in m; ``true`` in m.

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


CURVE_NOISES = ("default", "identity")
"""The names in ``NOISES`` under which whole landscapes are drawn."""

CURVE_LENGTHS = tuple(centimetres / 100 for centimetres in range(20, 201))
"""m: the interval of the paper's Table 2 in steps of 1 cm."""


class Curves:
    """The landscapes themselves, for a figure: every interpretation on one window, with calibrated and unit noise."""

    KEYS = ("reading", "noise", "length")

    @staticmethod
    def cases() -> list[dict[str, Any]]:
        """Each interpretation, each noise, each length."""
        return [{"reading": r, "noise": n, "length": l} for r in READINGS for n in CURVE_NOISES for l in CURVE_LENGTHS]

    @staticmethod
    def run(case: dict[str, Any]) -> dict[str, float]:
        """``fitness`` of one length, and ``normalised``: its rise above the best of ``CURVE_LENGTHS``.

        The unit of the rise is that of the median length, so that half the interval lies below 1 for every fitness.
        """
        fitness, normalised = _curve(case["reading"], case["noise"])
        index = int(np.abs(np.array(CURVE_LENGTHS) - case["length"]).argmin())
        return {"fitness": float(fitness[index]), "normalised": float(normalised[index])}


@cache
def _curve(reading: str, noise: str) -> tuple[NDArray, NDArray]:
    params = params_of({**DEFAULT, "noise": noise, "reading": reading})
    window = windows_of(DEFAULT["excitation"], params)[0]
    fitness = kalman.fitness(CURVE_LENGTHS, window, params.estimation)
    rise = fitness - fitness.min()
    return fitness, rise / np.median(rise)


SHOWN_READINGS = {
    "printed_posterior": "as printed",
    "rk4_posterior": "posterior residual",
    "rk4_prior": "prior residual",
    "rk4_likelihood": "likelihood",
}
"""Interpretations of the fitness, as figures and tables name them."""


def fig8_landscapes(curves: Rows) -> Figure:
    """Fig. 8: four variants of the fitness as functions of the length, on the same simulated window.

    55 samples in steps of 0.1 s of the 0.4 m circle (8 s), uniform rod of 1 m (vertical line), lengths in steps of
    1 cm; dots: the best length. Left: our calibrated noise covariances; right: unit ones, as the paper prints none.
    With calibrated covariances every variant has a valley within 0.25 m of the true length; with unit ones each prefers
    an end of the interval and none finds the rod. One window, no statistic: Table 9 has its spread over windows.
    """
    figure = Figure(figsize=(COLUMN, 2.9), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    looks = zip((ORANGE, PURPLE, GREEN, BLUE), ("-", "--", "-.", "-"), strict=True)
    shown = {reading: (label, *look) for (reading, label), look in zip(SHOWN_READINGS.items(), looks, strict=True)}
    titles = {"default": "calibrated covariances", "identity": "$Q_e = R_e = I$"}
    for axes, (noise, title) in zip(panels, titles.items(), strict=True):
        for reading, (label, colour, dashes) in shown.items():
            here = (row for row in curves if (row["reading"], row["noise"]) == (reading, noise))
            points = sorted((row["length"], row["normalised"]) for row in here)
            axes.plot(*np.array(points).T, dashes, color=colour, label=label)
            best = min(points, key=lambda point: point[1])
            axes.plot(best[0], best[1], "o", color=colour, ms=4, mec="black", mew=0.4, clip_on=False, zorder=3)
        axes.axvline(1.0, color="black", lw=0.6)
        axes.set(title=title, xlabel="candidate length (m)", ylim=(0, 1.5), xlim=(0.2, 2.0))
    panels[0].set_ylabel("fitness above its best (median = 1)")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    origin(figure, "one simulated window, true length 1 m")
    return figure


def table9_landscapes(rows: Rows) -> Table:
    """Table 9: mean error (standard deviation over 6 windows) of the best of all lengths, in cm, for four variants.

    One thing at a time differs from the default: 55 samples at 10 Hz of the 0.4 m circle (8 s), a uniform rod of 1 m,
    calibrated covariances; 2 simulated flights of 3 windows each. No variant is free of bias once the covariances are
    wrong.
    """
    cells = {(_setting(row), row["reading"]): row for row in rows}
    lines = []
    for setting in sorted(dict.fromkeys(setting for setting, _ in cells), key=lambda setting: setting != "default"):
        found = [cells[setting, reading] for reading in SHOWN_READINGS]
        errors = (f"{number(100 * row['bias'], 1)} ({100 * row['spread']:.1f})" for row in found)
        lines.append((setting, *errors))
    return Table(("What differs", *SHOWN_READINGS.values()), lines, "lrrrr")


def _setting(row: dict) -> str:
    """Return the name of the setting that differs from the default in a row of the study 'landscapes'."""
    if row["factor"] == "none":
        return "default"
    noise = str(row["noise"]).replace("Q_e", "$Q_e$").replace("R_e", "$R_e$").replace("*", r"$\times$")
    words = {
        "noise": noise.replace("identity", "$Q_e = R_e = I$"),
        "samples": f"{row['samples']:g} samples",
        "rate": f"{row['rate']:g} Hz",
    }
    return words.get(row["factor"], str(row[row["factor"]]))
