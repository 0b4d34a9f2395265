"""The paper's genetic algorithm: bit-string lengths, elites, roulette wheel, single-point crossover, bit flips.

The paper fixes the operators and two rates (section 2.3, Table 2). What it leaves open is settled here:

- Chromosome: code c stands for l_min + c * resolution. 18 001 codes need n = 15 bits, so the bit patterns 18 001 to
  32 767 lie beyond l_max. They are infeasible: their fitness is infinite, so they are neither parents nor elites.
- Roulette wheel for a fitness that is minimised: the weight of a candidate is worst - fitness, with the worst feasible
  candidate of the generation. It depends on neither the unit nor the zero of the fitness.
- Crossover is always applied; its point is uniform between the bits.

The last population is not handed on: every run starts anew from uniformly drawn lengths.
"""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fiplib import kalman
from fiplib.kalman import Window
from fiplib.params import Estimation, Params

CURVATURE_CODES = 10
"""Half-width, in codes, of the second difference behind the standard deviation: small beside any standard deviation
that a window can reach, large enough for rounding errors in the fitness to vanish."""


@dataclass(frozen=True)
class Chromosome:
    """Lengths as bit strings: code c, 0 <= c < ``codes``, is the length l_min + c * resolution; bits beyond are none.

    Attributes:
        length_min: length of code 0 in m.
        resolution: difference between neighbouring lengths in m.
        codes: number of feasible codes.
    """

    length_min: float
    resolution: float
    codes: int

    @classmethod
    def of(cls, estimation: Estimation) -> "Chromosome":
        """The chromosome that covers [length_min, length_max]; ValueError if these or the resolution make no sense."""
        low, high, resolution = estimation.length_min, estimation.length_max, estimation.resolution
        if not (0 < low < high < math.inf and 0 < resolution <= high - low):
            raise ValueError(f"cannot cover lengths from {low} to {high} m in steps of {resolution} m")
        return cls(low, resolution, round((high - low) / resolution) + 1)

    @property
    def bits(self) -> int:
        """Number of bits n."""
        return (self.codes - 1).bit_length()

    def length(self, codes: NDArray) -> NDArray:
        """Lengths in m of codes of any shape, feasible or not."""
        return np.round(self.length_min + self.resolution * codes, 12)  # 0.3, not 0.30000000000000004

    def encode(self, codes: NDArray) -> NDArray:
        """Codes (...) to bits (..., n), most significant first."""
        return (codes[..., None] >> np.arange(self.bits)[::-1]) & 1 == 1

    def decode(self, bits: NDArray) -> NDArray:
        """Bits (..., n) to codes (...), feasible or not."""
        return bits @ (1 << np.arange(self.bits)[::-1])


@dataclass(frozen=True)
class Evolution:
    """Result of one run of the genetic algorithm with G generations of N candidates.

    Attributes:
        length: best length found in m.
        standard_deviation: in m, from the curvature of the log likelihood at ``length``; nan for a fitness that is
            not a likelihood (the paper reports none), at an end of the interval and where the curvature is not
            positive. Correct only if the noise covariances are.
        fitness: fitness of ``length``.
        best_lengths: best length of each generation in m, (G,).
        populations: all lengths in m, (G, N); those beyond length_max are infeasible.
        evaluations: number of distinct lengths that were filtered.
    """

    length: float
    standard_deviation: float
    fitness: float
    best_lengths: NDArray
    populations: NDArray
    evaluations: int


@dataclass(frozen=True)
class Landscape:
    """Fitness of every length that the chromosome can express: ``lengths`` in m and ``fitness``, both (codes,)."""

    lengths: NDArray
    fitness: NDArray

    @property
    def best(self) -> float:
        """Return the length in m with the smallest fitness: what a perfect search would find."""
        return float(self.lengths[self.fitness.argmin()])


class MedianFilter:
    """Median of the last ``length`` values (paper: across successive solutions of the genetic algorithm)."""

    def __init__(self, length: int) -> None:
        if length < 1:
            raise ValueError(f"a median filter needs a length of at least 1, got {length}")
        self._values: deque[float] = deque(maxlen=length)

    def push(self, value: float) -> float:
        """Take a value in; the median of the last values, of fewer while the filter fills. ValueError if not finite."""
        if not math.isfinite(value):
            raise ValueError(f"a median filter takes finite values, got {value}")
        self._values.append(value)
        return float(np.median(self._values))


def estimate(window: Window, params: Params, rng: np.random.Generator) -> Evolution:
    """Find the length that explains a window best, with the genetic algorithm of the paper's section 2.3.

    The first of ``params.estimation.generations`` populations is drawn uniformly; each later one is bred from the
    one before.

    Args:
        window: the data.
        params: of which ``estimation`` is used.
        rng: the only source of randomness.

    Raises:
        ValueError: parameters that make no sense; see also ``kalman.fitness``.
    """
    estimation = params.estimation
    likelihood = kalman.reading(estimation).score == "likelihood"
    return evolve(lambda lengths: kalman.fitness(lengths, window, estimation), estimation, rng, likelihood)


def evolve(
    fitness_of: Callable[[NDArray], NDArray], estimation: Estimation, rng: np.random.Generator, likelihood: bool = True
) -> Evolution:
    """Minimise any fitness (C,) of lengths (C,) in m, as ``estimate`` does; ``likelihood`` says that it is -2 log L."""
    estimation = _checked(estimation)
    chromosome = Chromosome.of(estimation)
    known = np.full(2**chromosome.bits, np.inf)  # the fitness of infeasible codes
    known[: chromosome.codes] = np.nan  # not yet filtered
    populations = np.empty((estimation.generations, estimation.population), dtype=int)
    for generation, codes in enumerate(populations):
        if generation == 0:
            codes[:] = rng.integers(chromosome.codes, size=codes.size)
        else:
            parents = populations[generation - 1]
            codes[:] = breed(parents, known[parents], chromosome, estimation, rng)
        unseen = np.unique(codes[np.isnan(known[codes])])
        known[unseen] = fitness_of(chromosome.length(unseen))
    fitness = known[populations]
    best_codes = np.take_along_axis(populations, fitness.argmin(axis=1)[:, None], axis=1)[:, 0]
    best = best_codes[fitness.min(axis=1).argmin()]
    return Evolution(
        length=float(chromosome.length(best)),
        standard_deviation=_standard_deviation(int(best), chromosome, fitness_of) if likelihood else math.nan,
        fitness=float(known[best]),
        best_lengths=chromosome.length(best_codes),
        populations=chromosome.length(populations),
        evaluations=int(np.count_nonzero(~np.isnan(known[: chromosome.codes]))),
    )


def landscape(window: Window, params: Params) -> Landscape:
    """Fitness of all lengths, 18 001 with the paper's resolution. Arguments and errors as ``estimate``."""
    estimation = _checked(params.estimation)
    chromosome = Chromosome.of(estimation)
    lengths = chromosome.length(np.arange(chromosome.codes))
    return Landscape(lengths, kalman.fitness(lengths, window, estimation))


def breed(
    codes: NDArray, fitness: NDArray, chromosome: Chromosome, estimation: Estimation, rng: np.random.Generator
) -> NDArray:
    """The next population (N,) from codes (N,) and their fitness (N,): elites first, best first, then offspring."""
    elites = codes[np.argsort(fitness, kind="stable")[: elite_count(estimation)]]
    offspring = len(codes) - len(elites)
    pairs = math.ceil(offspring / 2)
    first, second = chromosome.encode(codes[roulette(fitness, 2 * pairs, rng)]).reshape(2, pairs, chromosome.bits)
    children = mutate(crossover(first, second, rng), estimation.mutation_rate, rng)
    return np.concatenate([elites, chromosome.decode(children)[:offspring]])


def elite_count(estimation: Estimation) -> int:
    """Number of candidates that pass unchanged to the next generation: r_p of the population, rounded."""
    return round(estimation.elite_fraction * estimation.population)


def roulette(fitness: NDArray, count: int, rng: np.random.Generator) -> NDArray:
    """Indices (count,) of parents, drawn with probability proportional to worst - fitness.

    The worst is the largest finite fitness; candidates of infinite fitness are never drawn. If all finite ones are
    equal they are drawn uniformly; if none is finite, all candidates are.
    """
    finite = np.isfinite(fitness)
    if not finite.any():
        return rng.integers(len(fitness), size=count)
    weights = np.where(finite, fitness[finite].max() - np.where(finite, fitness, 0.0), 0.0)
    if weights.sum() == 0.0:
        weights = finite.astype(float)
    return rng.choice(len(fitness), size=count, p=weights / weights.sum())


def crossover(first: NDArray, second: NDArray, rng: np.random.Generator) -> NDArray:
    """Single-point crossover of parents (M, n) each: children (2 M, n); each pair swaps the bits from one point on."""
    pairs, bits = first.shape
    tail = np.arange(bits) >= rng.integers(1, max(bits, 2), size=(pairs, 1))
    return np.concatenate([np.where(tail, second, first), np.where(tail, first, second)])


def mutate(bits: NDArray, rate: float, rng: np.random.Generator) -> NDArray:
    """Flip each bit with probability ``rate``."""
    return bits ^ (rng.random(bits.shape) < rate)


def _standard_deviation(best: int, chromosome: Chromosome, fitness_of: Callable[[NDArray], NDArray]) -> float:
    """sqrt(2 / f'') at the best code, as f = -2 log L; nan where that has no meaning."""
    below, above = best - CURVATURE_CODES, best + CURVATURE_CODES
    if below < 0 or above >= chromosome.codes:
        return math.nan
    lengths = chromosome.length(np.array([below, best, above]))
    left, middle, right = fitness_of(lengths).tolist()
    curvature = (left - 2 * middle + right) / (CURVATURE_CODES * chromosome.resolution) ** 2
    return math.sqrt(2 / curvature) if 0 < curvature < math.inf else math.nan


def _checked(estimation: Estimation) -> Estimation:
    """Return the parameters; ValueError names one that makes no sense."""
    if estimation.generations < 1 or estimation.population < 2:
        raise ValueError(
            f"need at least 1 generation of 2, got {estimation.generations} generations of {estimation.population}"
        )
    for name in ("elite_fraction", "mutation_rate"):
        if not 0 <= getattr(estimation, name) <= 1:
            raise ValueError(f"{name} must lie between 0 and 1, got {getattr(estimation, name)}")
    return estimation
