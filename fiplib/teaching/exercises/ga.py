"""Exercises of notebook 05, the genetic algorithm."""

import math
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from fiplib.ga import Chromosome
from fiplib.teaching.exercises.grading import Exercise


def _decoded(bits: NDArray, low: float, step: float) -> NDArray:
    chromosome = Chromosome(low, step, 2 ** bits.shape[-1])
    return chromosome.length(chromosome.decode(bits))


decode = Exercise(
    _decoded,
    lambda rng: (rng.random((6, 15)) < 0.5, rng.uniform(0.1, 0.5), rng.choice([1e-4, 5e-4, 1e-3])),
    {
        "you read backwards: the first bit is worth 2^(n-1)": lambda bits, *scale: _decoded(bits[:, ::-1], *scale),
        "l_min is missing: code 0 is the shortest length, not none": lambda bits, low, step: _decoded(bits, 0.0, step),
        "that is the code: times the resolution, plus l_min": lambda bits, low, step: _decoded(bits, 0.0, 1.0),
        "the number of ones is not the number they spell: weigh them by powers of two": (
            lambda bits, low, step: low + step * bits.sum(axis=1)
        ),
        "the last bit is worth 1, not 2": lambda bits, low, step: _decoded(bits, low, 2 * step),
        "the bits are read as decimal digits: each is worth twice the one after it": lambda bits, low, step: (
            low + step * (bits @ 10.0 ** np.arange(bits.shape[1])[::-1])
        ),
    },
    "read the bits as a binary number, the first bit counting most; then go that many steps up from the shortest",
    "code = sum of bit_i 2^(n-1-i), i = 0 being the first bit; length = l_min + code * resolution",
    "with the paper's numbers some codes lie beyond 2 m: these are infeasible",
    terms=lambda bits, low, step: {
        "l_min": low,
        "code * resolution": _decoded(bits, 0.0, step),
        "resolution": step,
        "code": _decoded(bits, 0.0, 1.0),
        "code read backwards * resolution": _decoded(bits[:, ::-1], 0.0, step),
        "last bit * resolution": bits[:, -1] * step,
        "number of ones * resolution": bits.sum(axis=1) * step,
    },
    tolerance=1e-6,  # a code is a whole number: four digits of a length do not name it
)
"""Lengths from bit strings."""


def _wheel(fitness: NDArray) -> NDArray:
    finite = np.isfinite(fitness)
    weight = np.where(finite, fitness[finite].max() - fitness, 0.0)
    return weight / weight.sum()


roulette_probabilities = Exercise(
    _wheel,
    lambda rng: (np.where(np.arange(8) == rng.integers(8), np.inf, rng.normal(-500.0, 200.0, 8)),),
    {
        "your wheel favours the worst: a small fitness is a good one": (
            lambda f: (w := np.where(np.isfinite(f), f - f.min(), 0.0)) / w.sum()
        ),
        "inf - inf is not a number: take the worst of the finite ones": lambda f: (w := f.max() - f) / w.sum(),
        "probabilities sum to one: divide by the sum of the weights": (
            lambda f: np.where(np.isfinite(f), f[np.isfinite(f)].max() - f, 0.0)
        ),
        "1 / fitness is no weight: a fitness may be negative, and its zero means nothing": lambda f: 1 / f / sum(1 / f),
        "everyone has the same chance on your wheel: weigh by the fitness": lambda f: (
            np.isfinite(f) / np.isfinite(f).sum()
        ),
        "the fitness itself is no weight: take the distance from the worst": lambda f: (
            (w := np.where(np.isfinite(f), f, 0.0)) / w.sum()
        ),
        "the weights are squared: the distance from the worst itself is asked for": lambda f: (
            (w := _wheel(f) ** 2) / w.sum()
        ),
        "that is the share of the infeasible as well: they must not count in the sum": lambda f: (
            _wheel(f) * np.isfinite(f).sum() / len(f)
        ),
        "the best one takes all: others get a share, too, by their distance from the worst": lambda f: (
            (f == f.min()) * 1.0
        ),
        "the roots of the weights are taken: the distance from the worst itself is asked for": lambda f: (
            (w := np.sqrt(_wheel(f))) / w.sum()
        ),
        "the chances are added up: one for each candidate is asked for": lambda f: np.cumsum(_wheel(f)),
        "the infeasible take part: their weight is zero": lambda f: (w := np.argsort(np.argsort(-f))) / w.sum(),
    },
    "weigh everyone by the distance from the worst that is feasible, then make the weights sum to one",
    "weight = worst finite fitness - fitness, none for the infeasible; divide by the sum of the weights",
    "neither the unit nor the zero of the fitness matters on this wheel",
)
"""Probabilities of the roulette wheel."""


def _diversity(bits: NDArray) -> float:
    ones, n = bits.sum(axis=0), len(bits)
    return (2 * ones * (n - ones)).sum() / (n * (n - 1))


def _pairs(bits: NDArray) -> NDArray:
    """In how many bits the candidates of each pair differ."""
    return np.array([(a != b).sum() for a, b in combinations(bits, 2)])


diversity = Exercise(
    _diversity,
    lambda rng: (rng.random((int(rng.integers(5, 12)), 15)) < rng.uniform(0.1, 0.9, 15),),
    {
        "candidates are compared with themselves, too: there are N (N - 1) pairs": (
            lambda bits: _diversity(bits) * (len(bits) - 1) / len(bits)
        ),
        "that is the sum over the pairs: take their mean": lambda bits: _diversity(bits) * math.comb(len(bits), 2),
        "that is the share of the bits: their number is asked for": lambda bits: _diversity(bits) / bits.shape[1],
        "it is twice too large: N candidates make N (N - 1) / 2 pairs": lambda bits: 2 * _diversity(bits),
        "neighbours alone are compared: compare every candidate with every other one": lambda bits: (
            (bits[1:] != bits[:-1]).sum() / (len(bits) - 1)
        ),
        "all are compared with the first one: compare every candidate with every other one": lambda bits: (
            (bits[1:] != bits[0]).sum() / (len(bits) - 1)
        ),
        "that counts different candidates: count the bits in which two of them differ": lambda bits: len(
            np.unique(bits, axis=0)
        ),
        "that is a sum of deviations: count the bits in which two candidates differ": lambda bits: bits.std(
            axis=0
        ).sum(),
        "that is a sum of variances: count the bits in which two candidates differ": lambda bits: bits.var(
            axis=0
        ).sum(),
        "that is the number of ones: count the bits in which two candidates differ": lambda bits: bits.sum(
            axis=1
        ).mean(),
        "that is the largest difference of a pair: take the mean over all pairs": lambda bits: _pairs(bits).max(),
        "that is the smallest difference of a pair: take the mean over all pairs": lambda bits: _pairs(bits).min(),
        "that is the median over the pairs: take their mean": lambda bits: np.median(_pairs(bits)),
        "that is the scatter of the differences: take their mean": lambda bits: _pairs(bits).std(),
        "only bits that are 1 in both are counted: count those that differ": lambda bits: np.mean(
            [(a & b).sum() for a, b in combinations(bits, 2)]
        ),
        "bits that agree are counted: count those that differ": lambda bits: bits.shape[1] - _diversity(bits),
    },
    "compare every candidate with every other one, bit by bit, and average over the pairs",
    "count the bits in which two candidates differ; take the mean over all pairs of different candidates",
    "half the bits in a random population, none in one that has converged, to the truth or too early",
)
"""Diversity of a population."""
