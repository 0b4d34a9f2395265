"""The effects of data, model and search: the estimate of the same flights with each of the three exchanged.

A row is a flight of the 0.4 m circle with a uniform rod, the seat 8 cm above the vehicle's frame, 20 seeds for each of
three rods; all answers are to the same 5.4 s of it.

- *Data*: the paper's 55 derived states in steps of 0.1 s, or all poses of both bodies as measured, without the measured
  distance of the two tracked points.
- *Model*: lambda = 1, the paper's point mass, or lambda = 0.75 +- 0.05, a rod that is about uniform. Whatever else is
  unknown is at its most likely value for each length (a profile likelihood): a length is all that is searched for.
- *Search*: the printed genetic algorithm; every length in steps of 3 mm, then of 0.1 mm; Brent's method in the best of
  24 brackets.

Columns, for each DATA-MODEL-SEARCH: ``length`` (m), ``sd`` (m, by the curvature of the fitness), ``ms`` of CPU for the
search, without ``prepare_ms`` for each DATA-MODEL: what it takes before the first length is judged.
60 rows, about 4 minutes of two cores.
"""

import itertools
import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from fiplib import ga, kalman, replay
from fiplib.estimators import brent, grid
from fiplib.estimators.poses.knowledge import Told
from fiplib.kalman import Window
from fiplib.params import A_DOT, B_DOT, A, B, Estimation, Params
from fiplib.recording import Flight
from fiplib.references import Circle
from fiplib.reproduction.measures import binomial_interval, bootstrap_interval, rms
from fiplib.reproduction.sources import Rows
from fiplib.reproduction.style import BLUE, COLUMN, GREEN, ORANGE, origin
from fiplib.reproduction.tables import NONE, Facts, Table, number
from fiplib.simulate import Scenario
from fiplib.studies.batch import fly_many

KEYS = ("true_length", "seed")

RODS, SEEDS = (0.5, 1.0, 1.5), range(20)

CIRCLE = Circle(0.4, 8.0, ramp=2.0)

START, END = 4.5, 9.9
"""The stretch in s: 55 samples in steps of 0.1 s, at full speed."""

GRID = 3e-3
"""Step of the first grid, m: the likelihood of poses has one maximum, whose width is 3 mm and more."""

STEP = 1e-3
"""Step in length for the curvature, m: small beside any deviation that a window can reach, large beside rounding."""

Fitness = Callable[[NDArray], NDArray]

DATA = {"derived": "10 Hz derived states", "poses": "raw poses"}

MODELS = {"point": r"$\lambda = 1$", "tolerance": r"$\lambda = 0.75 \pm 0.05$"}

INERTIA = {"point": Told(1.0, 1e-4), "tolerance": Told(0.75, 0.05)}

SEARCHES: dict[str, Callable[[Fitness, Estimation, np.random.Generator], float]] = {
    "ga": lambda fitness, estimation, rng: ga.evolve(fitness, estimation, rng).length,
    "grid": lambda fitness, estimation, rng: grid.search(fitness, estimation, GRID),
    "brent": lambda fitness, estimation, rng: brent.search(fitness, estimation),
}

ARMS = tuple(itertools.product(DATA, MODELS, SEARCHES))


def cases() -> list[dict]:
    """Every rod with every seed."""
    return [{"true_length": length, "seed": seed} for length in RODS for seed in SEEDS]


def run(case: dict) -> dict[str, float | int]:
    """Fly the case, and search its stretch for the length in every way."""
    flight = flown(float(case["true_length"]), int(case["seed"]))
    estimation = flight.params.estimation
    row: dict[str, float | int] = {"survived": int(flight.survived)}
    for data, model in itertools.product(DATA, MODELS):
        began = time.process_time()
        fitness = fitness_of(flight, data, INERTIA[model])
        row[f"prepare_ms_{data}_{model}"] = 1e3 * (time.process_time() - began)
        for number_, (search, find) in enumerate(SEARCHES.items()):
            began = time.process_time()
            length = find(fitness, estimation, np.random.default_rng([int(case["seed"]), number_]))
            row[f"ms_{data}_{model}_{search}"] = 1e3 * (time.process_time() - began)
            values = fitness(length + STEP * np.array([-1.0, 0.0, 1.0]))
            inside = estimation.length_min + 2 * STEP < length < estimation.length_max - 2 * STEP
            row[f"length_{data}_{model}_{search}"] = length
            row[f"sd_{data}_{model}_{search}"] = grid.curvature_deviation(values, STEP) if inside else math.nan
    return row


def flown(length: float, seed: int) -> Flight:
    """A flight with a rod of so many m, whose pilot knows its length."""
    params = Params().replace(pendulum__length=length, piloting__initial_length=length)
    scenario = Scenario("ablation", "", END + 0.5, CIRCLE, params=params, seed=80_000 + 100 * RODS.index(length) + seed)
    return next(fly_many([scenario]))


def fitness_of(flight: Flight, data: str, inertia: Told) -> Fitness:
    """Return -2 log likelihood (C,) of lengths (C,) from one kind of data, lambda at its most likely value."""
    if data == "derived":
        window, params = replay.window_between(flight, START, END, flight.params)
        return derived_fitness(window, params.estimation, inertia)
    from fiplib.estimators.poses.in_flight import profile_of  # compiled code: half a second to import

    return profile_of(replay.raw_window_between(flight, START, END), flight.params, inertia)


def derived_fitness(window: Window, estimation: Estimation, inertia: Told) -> Fitness:
    """Return the paper's fitness with the inertia factor lambda in its model, profiled over lambda.

    a'' = lambda (2 g a / l - s'') is, in a / lambda, the paper's model of a rod of length l / lambda: its own filter
    serves, on states and noise in these units. The density of a, a', b, b' is then in other units, too.
    """
    spread = np.linspace(-2.5, 2.5, 13) if inertia.tolerance > 1e-3 else np.zeros(1)
    factors = inertia.value + inertia.tolerance * spread
    factors, scaled, measured = factors[factors > 0.45], [], [A, A_DOT, B, B_DOT]
    for factor in factors:
        scale = np.ones(10)
        scale[measured] = 1.0 / factor
        noise = {
            name: tuple(np.array(getattr(estimation, name)) * scale**2)
            for name in ("process_noise", "measurement_noise")
        }
        scaled.append((replace(window, states=window.states * scale), replace(estimation, **noise)))
    units = 2.0 * len(measured) * (len(window.states) - 1) * np.log(factors)
    prior = ((factors - inertia.value) / inertia.tolerance) ** 2

    def fitness(lengths: NDArray) -> NDArray:
        given = zip(factors, scaled, strict=True)
        values = np.array([kalman.fitness(lengths / factor, *one) for factor, one in given]) + (units + prior)[:, None]
        return _lowest(values)

    return fitness


def _lowest(values: NDArray) -> NDArray:
    """Return the minimum of each column (n, C), of the parabola through its three lowest values in a row."""
    if len(values) < 3:
        return values.min(axis=0)
    middle, columns = np.clip(values.argmin(axis=0), 1, len(values) - 2), np.arange(values.shape[1])
    below, here, above = (values[middle + step, columns] for step in (-1, 0, 1))
    slope, curvature = (above - below) / 2.0, above - 2.0 * here + below
    at = np.clip(-slope / np.where(curvature > 0.0, curvature, np.inf), -1.0, 1.0)
    return here + slope * at + curvature * at**2 / 2.0


class Judged(NamedTuple):
    """An arm over all its flights, errors relative to the true length: how many, bias with its 95 % interval, RMS error
    with its own, the share of 95 % intervals that hold the length with its own, and median CPU time in ms."""

    flights: int
    bias: tuple[float, float, float]
    rms: tuple[float, float, float]
    covered: tuple[float, float, float]
    milliseconds: float


def judged(rows: Rows, data: str, model: str, search: str) -> Judged:
    """An arm over the rows of the study, or over those of one rod."""
    arm = f"{data}_{model}_{search}"
    true, found, stated = (
        np.array([row[name] for row in rows]) for name in ("true_length", f"length_{arm}", f"sd_{arm}")
    )
    errors = found / true - 1.0
    inside = np.abs(found - true) <= 1.959964 * stated  # never where no deviation is stated
    hits = int(np.count_nonzero(inside))
    spent = [row[f"ms_{arm}"] + row[f"prepare_ms_{data}_{model}"] for row in rows]
    return Judged(
        len(rows),
        (float(errors.mean()), *bootstrap_interval(errors, np.mean)),
        (rms(errors), *bootstrap_interval(errors, rms)),
        (hits / len(rows), *binomial_interval(hits, len(rows))),
        float(np.median(spent)),  # the first case of a process loads what is compiled
    )


def table16_ablation(rows: Rows) -> Table:
    """Table 16: bias, RMS error, coverage and cost of every combination of data, model and search.

    60 simulated flights of the 0.4 m circle (8 s), 20 for each rod of 0.5, 1 and 1.5 m; errors relative to the length;
    in brackets: 95 % intervals, bootstrap over flights for errors, binomial for coverage. CPU: median of a search with
    what it must prepare.
    """
    lines, names = [], {"ga": "GA", "grid": "grid", "brent": "Brent"}
    for data, model, search in ARMS:
        found = judged(rows, data, model, search)
        bias, low, high = (100 * value for value in found.bias)
        rest = [tuple(100 * value for value in values) for values in (found.rms, found.covered)]
        lines.append((
            DATA[data], MODELS[model], names[search], f"{number(bias, 2)} ({number(low, 2)} to {number(high, 2)})",
            *(f"{value:.{places}f} ({least:.{places}f} to {most:.{places}f})"
              for (value, least, most), places in zip(rest, (2, 0), strict=True)),
            f"{found.milliseconds:.0f}",
        ))  # fmt: skip
    header = ("Data", "Model", "Search", r"Bias (\%)", r"RMSE (\%)", r"In 95\,\% interval (\%)", "CPU (ms)")
    return Table(header, lines, "lllrrrr")


def fig19_ablation(rows: Rows) -> Figure:
    """Fig. 19: RMS error of the length by data, model and search, for three uniform rods.

    20 simulated flights of the 0.4 m circle (8 s) for each rod, all answers to the same 5.4 s; bars: 95 % intervals,
    bootstrap over flights. Data: states derived at 10 Hz, or all poses as measured. Model: lambda = 1, the paper's
    point mass, or 0.75 +- 0.05, about a uniform rod. The searches agree; better data help by a factor of about twenty,
    but only together with the right inertia.
    """
    figure = Figure(figsize=(COLUMN, 2.6), layout="constrained")
    panels = figure.subplots(1, len(RODS), sharey=True, sharex=True)
    kinds = list(itertools.product(DATA, MODELS))
    styles = (("ga", "o", ORANGE, "GA"), ("grid", "s", BLUE, "grid"), ("brent", "D", GREEN, "Brent"))
    for axes, length in zip(panels, RODS, strict=True):
        chosen = [row for row in rows if row["true_length"] == length]
        for place, (search, marker, colour, label) in enumerate(styles):
            found = np.array([judged(chosen, *kind, search).rms for kind in kinds]) * 1e3 * length
            error = np.abs(found[:, 1:] - found[:, :1]).T
            at = np.arange(len(kinds)) + 0.22 * (place - 1)
            axes.errorbar(found[:, 0], at, xerr=error, fmt=marker, ms=2.5, lw=0.7, color=colour, label=label)
        axes.set(xscale="log", title=f"{length:g} m")
        axes.margins(x=0.1)
    names = [f"{DATA[data]},\n{MODELS[model]}" for data, model in kinds]
    panels[0].set(yticks=range(len(kinds)), yticklabels=names)
    panels[0].invert_yaxis()
    panels[1].set(xlabel="RMS error (mm)")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    origin(figure, f"simulated flights, {len(SEEDS)} a rod; bars: 95 %, bootstrap")
    return figure


def facts(rows: Rows) -> Facts:
    """Return what the report states of each combination, in % of the length, and of the three choices."""
    found: Facts = {}
    for arm in ARMS:
        one = judged(rows, *arm)
        found |= {
            (*arm, "bias"): f"{100 * one.bias[0]:.2f}",
            (*arm, "rms"): f"{100 * one.rms[0]:.2f}",
            (*arm, "covered"): f"{100 * one.covered[0]:.0f}" if one.covered[0] else NONE,
        }
        for name, (_, low, high), decimals in (("bias", one.bias, 2), ("rms", one.rms, 2), ("covered", one.covered, 0)):
            found |= {
                (*arm, name, "low"): f"{100 * low:.{decimals}f}",
                (*arm, name, "high"): f"{100 * high:.{decimals}f}",
            }
    return found
