"""Which of the choices that the paper does not print give its Table 3?

A row is one setting of what takes a run of the estimator: the tracked point, the fitness, the noise covariances, N_c
and the number of generations. Its columns are all combinations of the rest, ``ARMS``: the window at t = 0, new or kept
populations, period and phase of the runs, the median filter, and what is called convergence. ``choices_runs`` says how
they are run: in 20 flights a rod of 1 m, from each of the paper's three starts.

``fit_ARM`` is the log of the probability of the paper's numbers, ``log_probability``; ``within_ARM``, how many of its
six independent numbers lie in the central 95 % of the simulated ones: each error is that of its length, so that six
say all that nine do.
324 rows, SECONDS_TO_STATE.
"""

import itertools
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.special import logsumexp, ndtr

from fiplib import kalman
from fiplib.params import Params
from fiplib.reproduction.claims import PAPER
from fiplib.reproduction.sources import Rows
from fiplib.reproduction.style import BLUE, COLUMN, GREY, ORANGE, origin
from fiplib.reproduction.tables import Facts, Table
from fiplib.studies import choices_runs as runs
from fiplib.studies.choices_runs import Outcome

KEYS = ("tracked", "fitness", "noise", "population", "generations")

FITNESSES = tuple(name for name in kalman.READINGS if name != "paper")
CANDIDATES, GENERATIONS = (12, 30, 60), (5, 20, 40)

SETTINGS = (tuple(runs.TRACKED), FITNESSES, runs.NOISES, CANDIDATES, GENERATIONS)
"""Levels of each of ``KEYS``."""

COLUMNS = (tuple(runs.WINDOWS), runs.POPULATIONS, runs.PERIODS, runs.PHASES, runs.MEDIANS, tuple(runs.DEFINITIONS))
"""Levels of the choices within a row."""

ARMS = tuple(itertools.product(*COLUMNS))

LEVELS = {
    "tracked": ("point of the vehicle that motion capture tracks", SETTINGS[0]),
    "fitness": ("fitness", SETTINGS[1]),
    "noise": ("noise covariances", SETTINGS[2]),
    "population": ("number of candidates $N_c$", SETTINGS[3]),
    "generations": ("generations a run", SETTINGS[4]),
    "window": ("window at $t = 0$", COLUMNS[0]),
    "first": ("first population of a run", COLUMNS[1]),
    "period": ("period of the runs", COLUMNS[2]),
    "phase": ("phase of the first run", COLUMNS[3]),
    "median": ("length of the median filter", COLUMNS[4]),
    "definition": ("definition of convergence", COLUMNS[5]),
}
"""Every choice, in words, and its levels: the order of the axes of ``log_probabilities``."""

STARTS = {"G2": 1.2, "G1": 0.8, "G3": 1.4}
"""Rows of the ledger with the paper's numbers, and the length in m that each flight starts with."""

HALF_DIGIT = {"G1": 5e-4, "G2": 5e-4, "G3": 5e-2}
"""Half a unit of the last digit that the paper prints of each error, m: the third is printed as 0.0."""
HALF_TIME = 5e-3
"""The same of the times, s."""

KERNEL = (0.01, 0.25)
"""Standard deviations in m and s of the Gaussian kernels: about what the neglected feedback moves a single flight by
(``choices_checks``), so that nothing finer is read from the runs than they hold."""

BASE = (Params().estimation.length_max - Params().estimation.length_min, runs.SECONDS)
"""Extent in m and s of the uniform density that is worth one more flight: what 20 flights never did is not impossible."""


def arm_name(arm: tuple) -> str:
    """Return the ending of an arm's columns."""
    return "_".join(f"{level:g}" if isinstance(level, float) else f"{level}" for level in arm)


def cases() -> list[dict]:
    """Every setting."""
    return [dict(zip(KEYS, levels, strict=True)) for levels in itertools.product(*SETTINGS)]


def run(case: dict) -> dict[str, float | int]:
    """Run the estimator of one setting in every arm: the columns of all ``ARMS``."""
    row: dict[str, float | int] = {}
    setting = case["tracked"], case["fitness"], case["noise"], int(case["population"]), int(case["generations"])
    for arm, found in runs.every_sequence(*setting):
        for filter_length in runs.MEDIANS:
            ends = {id: runs.outcomes(found, filter_length, start) for id, start in STARTS.items()}
            for definition in runs.DEFINITIONS:
                name = arm_name((*arm, filter_length, definition))
                judged = [judge(end, definition, found.weights, id) for id, end in ends.items()]
                row[f"fit_{name}"] = round(sum(one[0] for one in judged), 2)
                row[f"within_{name}"] = sum(one[1] for one in judged)
    return row


def judge(end: Outcome, definition: str, weights: NDArray, id: str) -> tuple[float, int]:
    """Return the log probability of a pair of the paper's numbers, length and time, and how many of the two lie in the
    central 95 % of the simulated ones."""
    length, seconds, half = PAPER[f"{id}.length"], PAPER[f"{id}.time"], HALF_DIGIT[id]
    simulated = end.length, end.seconds[definition]
    inside = [
        between(values, weights, paper, slack)
        for values, paper, slack in zip(simulated, (length, seconds), (half, HALF_TIME), strict=True)
    ]
    return log_probability(*simulated, weights, (length, seconds), (half, HALF_TIME)), sum(inside)


def log_probability(
    lengths: NDArray, seconds: NDArray, weights: NDArray, paper: tuple[float, float], half: tuple[float, float]
) -> float:
    """Return the log of the probability that another flight gives the paper's two numbers as it rounds them.

    The density is the mean of Gaussian kernels at the simulated pairs (S,) and, as one more flight, a uniform one: the
    predictive density of a Dirichlet process. ``weights`` (S,): of a flight together 1.
    """
    cells = []
    for values, number, slack, width in zip((lengths, seconds), paper, half, KERNEL, strict=True):
        cells.append(ndtr((number + slack - values) / width) - ndtr((number - slack - values) / width))
    base = np.prod([2.0 * slack / extent for slack, extent in zip(half, BASE, strict=True)])
    return float(np.log((weights @ (cells[0] * cells[1]) + base) / (weights.sum() + 1.0)))


def between(values: NDArray, weights: NDArray, number: float, slack: float) -> bool:
    """Whether a number, give or take the slack, lies in the central 95 % of weighted values."""
    share = weights / weights.sum()
    below, above = share @ (values < number - slack), share @ (values > number + slack)
    return bool(below <= 0.975 and above <= 0.975)


# --- the posterior


def log_probabilities(rows: Rows, column: str = "fit") -> NDArray:
    """Return a column's values of every combination, an axis for each of ``LEVELS``."""
    known = {tuple(row[key] for key in KEYS): row for row in rows}
    names = [f"{column}_{arm_name(arm)}" for arm in ARMS]
    found = [[known[setting][name] for name in names] for setting in itertools.product(*SETTINGS)]
    return np.array(found).reshape([len(levels) for _, levels in LEVELS.values()])


class Posterior(NamedTuple):
    """Of all combinations, each as probable as the others before: ``log`` their log probabilities, one axis a choice;
    ``shares`` those of the levels of each choice; ``number`` the effective number of combinations, exp of the entropy;
    ``effects`` the range of the log probability over the levels of a choice, all others fixed: posterior mean."""

    log: NDArray
    shares: dict[str, NDArray]
    number: float
    effects: dict[str, float]


def posterior(fit: NDArray) -> Posterior:
    """Return the posterior of log probabilities of the paper's numbers, one axis for each of ``LEVELS``."""
    log = fit - logsumexp(fit)
    probability = np.exp(log)
    shares, effects = {}, {}
    for axis, choice in enumerate(LEVELS):
        others = tuple(other for other in range(fit.ndim) if other != axis)
        shares[choice] = probability.sum(axis=others)
        effects[choice] = float((probability.sum(axis=axis) * np.ptp(fit, axis=axis)).sum())
    return Posterior(log, shares, effective(probability), effects)


def effective(probability: NDArray) -> float:
    """Return exp of the entropy: how many equally probable ones are as undecided as these."""
    some = probability[probability > 0]
    return float(np.exp(-(some * np.log(some)).sum()))


def best(fit: NDArray, number: int = 1) -> list[tuple]:
    """Return the most probable combinations, levels in the order of ``LEVELS``."""
    levels = [levels for _, levels in LEVELS.values()]
    order = np.argsort(-fit, axis=None, kind="stable")[:number]
    places = zip(*np.unravel_index(order, fit.shape), strict=True)
    return [tuple(known[at] for known, at in zip(levels, place, strict=True)) for place in places]
