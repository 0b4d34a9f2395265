"""The genetic algorithm on an interpolated fitness; ``ga.evolve`` is the readable one.

For studies that run it a million times. It draws the same random numbers in the same order, so that a test can demand
equal answers.
"""

import numpy as np
from numpy.typing import NDArray

from fiplib.kernels.compiling import compiled


@compiled()
def _roulette(fitness: NDArray, shares: NDArray, count: int, rng: np.random.Generator, picks: NDArray) -> None:
    """Draw ``count`` parents as ``ga.roulette`` does; ``shares`` (N,) is scratch."""
    candidates, worst, finite = len(fitness), -np.inf, 0
    for i in range(candidates):
        if np.isfinite(fitness[i]):
            finite, worst = finite + 1, max(worst, fitness[i])
    if finite == 0:
        for k in range(count):
            picks[k] = rng.integers(0, candidates)
        return
    total = 0.0
    for i in range(candidates):
        total += worst - fitness[i] if np.isfinite(fitness[i]) else 0.0
    level, sum_ = total == 0.0, finite if total == 0.0 else total
    reached = 0.0
    for i in range(candidates):
        if np.isfinite(fitness[i]):
            reached += 1.0 / sum_ if level else (worst - fitness[i]) / sum_
        shares[i] = reached
    for i in range(candidates):
        shares[i] /= reached
    for k in range(count):
        picks[k] = np.searchsorted(shares, rng.random(), side="right")


@compiled()
def evolve(
    codes: NDArray,
    values: NDArray,
    first: NDArray,
    weights: NDArray,
    bits: int,
    generations: int,
    elites: int,
    rate: float,
    rng: np.random.Generator,
) -> int:
    """Evolve a population (N,) of codes in place; returns the best code that there ever was.

    Args:
        codes: the first population; the last one is left in it.
        values: fitness (G,) at known lengths.
        first, weights: (C,), (C, 4): fitness of code c is sum_k weights[c, k] values[first[c] + k], k from 0 to 3;
            codes from C on are infeasible.
        bits: of a chromosome.
        generations: how many populations are judged, the first one included.
        elites: how many candidates pass unchanged to the next.
        rate: of bit flips.
        rng: the only source of randomness.
    """
    size = len(codes)
    offspring = size - elites
    pairs = (offspring + 1) // 2
    fitness, shares, parents = np.empty(size), np.empty(size), np.empty(size, dtype=np.int64)
    picks, children = np.empty(2 * pairs, dtype=np.int64), np.empty(2 * pairs, dtype=np.int64)
    best, least = codes[0], np.inf
    for generation in range(generations):
        for i in range(size):
            code = parents[i] = codes[i]
            fitness[i] = np.inf
            if code < len(first):
                at = first[code]
                fitness[i] = weights[code, 0] * values[at] + weights[code, 1] * values[at + 1]
                fitness[i] += weights[code, 2] * values[at + 2] + weights[code, 3] * values[at + 3]
            if fitness[i] < least:
                best, least = code, fitness[i]
        if generation == generations - 1:
            break
        order = np.argsort(fitness, kind="mergesort")  # stable
        for i in range(elites):
            codes[i] = parents[order[i]]
        _roulette(fitness, shares, 2 * pairs, rng, picks)
        for k in range(pairs):
            tail = (1 << (bits - rng.integers(1, max(bits, 2)))) - 1
            one, other = parents[picks[k]], parents[picks[pairs + k]]
            children[k] = (one & ~tail) | (other & tail)
            children[pairs + k] = (other & ~tail) | (one & tail)
        for k in range(2 * pairs):
            for bit in range(bits - 1, -1, -1):
                if rng.random() < rate:
                    children[k] ^= 1 << bit
        for k in range(offspring):
            codes[elites + k] = children[k]
    return best


@compiled()
def chain(
    values: NDArray,
    first: NDArray,
    weights: NDArray,
    bits: int,
    size: int,
    generations: int,
    elites: int,
    rate: float,
    kept: bool,
    rng: np.random.Generator,
    best: NDArray,
) -> None:
    """Run ``evolve`` on one window after the other and write the best code of each.

    Args:
        values: (W, G), of each window as in ``evolve``, as are the arguments that are not named here.
        size: of a population.
        kept: whether the last population of a run is the first one of the next, or each run draws a new one.
        best: (W,), written.
    """
    codes = np.empty(size, dtype=np.int64)
    for window in range(len(values)):
        if window == 0 or not kept:
            for i in range(size):
                codes[i] = rng.integers(0, len(first))
        best[window] = evolve(codes, values[window], first, weights, bits, generations, elites, rate, rng)
