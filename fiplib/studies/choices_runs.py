"""What the paper's estimator does under every choice that the paper does not print: the runs behind ``choices``.

The estimates are not fed back: the pilot of every flight uses the true length (``choices_checks`` says what that
neglects). So one recording serves all choices. Its windows are cut once, a run of the estimator each ``STEP`` s; the
fitness of each is computed at ``GRID`` lengths and interpolated between them; and on these tables the genetic algorithm
of ``ga`` runs in compiled code (``kernels.evolving``).
"""

import itertools
import math
from collections.abc import Iterator
from functools import cache, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fiplib import kalman, replay
from fiplib.ga import Chromosome, elite_count
from fiplib.kalman import Window
from fiplib.params import NANO, Estimation, Params
from fiplib.recording import Flight
from fiplib.references import Circle
from fiplib.reproduction.measures import FINAL_SECONDS
from fiplib.simulate import Scenario
from fiplib.studies.batch import fly_many

SEEDS = range(20)
SECONDS = 25.0
"""Length of a flight of the paper's section 4.3 in ours, from t = 0."""

LEAD = (Params().estimation.window - 1) * Params().estimation.sample_period
"""Seconds that the first window takes to fill."""

STEP = 0.2
"""Shortest period of the runs, s: windows are cut as often."""

GRID = 81
"""Lengths at which the fitness is computed, in equal ratios; the error of what lies between is below 1e-5 of the range
(a test)."""

TRACKED = {"seat": "seat", "frame": "frame"}
"""The vehicle's tracked point; the pilot takes it to be the seat: the paper's model has no height between the two."""

UNIT = "_unit"
"""Ending of a fitness with Q_e = R_e = I, what a paper that prints neither suggests; else they are calibrated."""

WINDOWS = {"empty": ("circle", 0.0), "hover": ("hover", LEAD), "circle": ("circle", LEAD)}
"""State of the window at t = 0: the recording, and the seconds of it that lie before."""

POPULATIONS = ("fresh", "kept")
"""The first population of a run: drawn anew, or the last one of the run before."""

PERIODS = (0.2, 5.0)
PHASES = ("window", "clock")
"""The first run: as soon as the window is full, or at the next tick of a clock that knows nothing of the flight."""

MEDIANS = (3, 5, 9)

DEFINITIONS = {"stays5": 0.05, "stays10": 0.10, "first5": 0.05}
"""Convergence: the used length stays, or for the first time is, so near to its final value, m."""

MOTIONS = {"circle": Circle(0.4, 8.0), "hover": Circle(0.4, 8.0, start=1.0 + LEAD)}
"""Recordings: the circle begins 1 s after t = 0; where a window is filled in hover, it is filled before that."""

EVERY = round(PERIODS[1] / STEP)
SPREAD = 3
"""Of the ``EVERY`` phases of the long period a flight has each ``SPREAD``-th, the next flight those beside them."""


def params_of(tracked: str, fitness: str, population: int, generations: int) -> Params:
    """Return the parameters of one combination."""
    params = Params().replace(
        simulation__vehicle_origin=TRACKED[tracked],
        piloting__seat_height=0.0,
        estimation__fitness=fitness.removesuffix(UNIT),
        estimation__population=population,
        estimation__generations=generations,
        estimation__run_period=STEP,
    )
    if not fitness.endswith(UNIT):
        return params
    unit = (1.0,) * len(params.estimation.process_noise)
    return params.replace(estimation__process_noise=unit, estimation__measurement_noise=unit)


def windows_of(flight: Flight, params: Params) -> tuple[NDArray, list[Window]]:
    """Return the windows of a flight, a run each ``STEP`` s, and when each was complete, s."""
    found = replay.windows(flight, params)
    return np.array([one.stamp - flight.start_ns for one in found]) / NANO, [one.window for one in found]


@cache
def recorded(tracked: str, motion: str) -> tuple[NDArray, list[list[Window]]]:
    """Times (W,) of windows, the same for all flights, and those of a flight for each seed. RuntimeError: a fall."""
    params = params_of(tracked, "paper", 60, 20)
    duration = LEAD + SECONDS + STEP
    scenarios = [Scenario("choices", "", duration, MOTIONS[motion], params=params, seed=95_000 + s) for s in SEEDS]
    found = []
    for flight in fly_many(scenarios):
        if not flight.survived:
            raise RuntimeError(f"the rod fell with the true length in use, {tracked} tracked")
        times, windows = windows_of(flight, params)
        found.append(windows)
    return times, found


def lengths_of(estimation: Estimation) -> NDArray:
    """Return the lengths (``GRID``,) in m at which the fitness is computed."""
    return np.geomspace(estimation.length_min, estimation.length_max, GRID)


@lru_cache(maxsize=2)
def landscapes(tracked: str, fitness: str, motion: str) -> tuple[NDArray, NDArray]:
    """Times (W,) in s and fitness (F, W, ``GRID``) of the windows of all flights."""
    estimation = params_of(tracked, fitness, 60, 20).estimation
    grid, (times, flights) = lengths_of(estimation), recorded(tracked, motion)
    return times, np.array([[kalman.fitness(grid, window, estimation) for window in windows] for windows in flights])


class Interpolation(NamedTuple):
    """A cubic through four neighbours on the grid, in log l: the fitness of code c of C is the sum over k from 0 to 3
    of ``weights[c, k]`` times that at length ``first[c]`` + k of the grid; ``weights`` (C, 4), ``first`` (C,)."""

    first: NDArray
    weights: NDArray

    def fitness(self, values: NDArray) -> NDArray:
        """Return the fitness of every code (C,) from that at the lengths of the grid."""
        return sum(self.weights[:, k] * values[self.first + k] for k in range(4))


@lru_cache(maxsize=1)
def interpolation(chromosome: Chromosome) -> Interpolation:
    """Return the interpolation of all codes."""
    lengths = chromosome.length(np.arange(chromosome.codes))
    x, at = np.log(lengths), np.log(np.geomspace(lengths[0], lengths[-1], GRID))
    first, weights = np.clip(np.searchsorted(at, x) - 2, 0, GRID - 4), np.ones((len(x), 4))
    for k in range(4):
        for other in set(range(4)) - {k}:
            weights[:, k] *= (x - at[first + other]) / (at[first + k] - at[first + other])
    return Interpolation(first, weights)


def chain(values: NDArray, estimation: Estimation, kept: bool, rng: np.random.Generator) -> NDArray:
    """Return the lengths (W,) in m that runs of the genetic algorithm find, one after the other, on landscapes
    (W, ``GRID``); ``kept`` hands the last population of a run on to the next."""
    from fiplib.kernels import evolving

    chromosome, best = Chromosome.of(estimation), np.empty(len(values), dtype=np.int64)
    numbers = estimation.population, estimation.generations, elite_count(estimation), estimation.mutation_rate
    about = *interpolation(chromosome), chromosome.bits
    evolving.chain(np.ascontiguousarray(values), *about, *numbers, kept, rng, best)
    return chromosome.length(best)


class Answers(NamedTuple):
    """Lengths in m that runs found at each window of each flight, (F, W); nan where there was no run.

    ``fresh`` of new populations; ``often`` of populations kept from window to window; ``rarely`` of populations kept
    over the long period: the run at a window belongs to the phase that the window's number has.
    """

    fresh: NDArray
    often: NDArray
    rarely: NDArray


def search(values: NDArray, estimation: Estimation) -> Answers:
    """Run the genetic algorithm in every way on landscapes (F, W, ``GRID``)."""
    answers = Answers(*np.full((3, *values.shape[:2]), np.nan))
    for flight, known in enumerate(values):
        rngs = iter(np.random.default_rng(flight).spawn(2 + EVERY))
        answers.fresh[flight] = chain(known, estimation, False, next(rngs))
        answers.often[flight] = chain(known, estimation, True, next(rngs))
        for phase, rng in zip(phases_of(flight), rngs, strict=False):
            answers.rarely[flight, phase::EVERY] = chain(known[phase::EVERY], estimation, True, rng)
    return answers


def phases_of(flight: int) -> list[int]:
    """Return the phases of the long period that a flight has, as numbers of windows: 0 is the first full one."""
    return sorted({0, *range(flight % SPREAD, EVERY, SPREAD)})


class Sequences(NamedTuple):
    """Sequences of answers, a row each: ``times`` (S, n) of their delivery in s from t = 0, inf beyond the last,
    ``lengths`` (S, n) in m, and ``weights`` (S,), that of all sequences of a flight together 1."""

    times: NDArray
    lengths: NDArray
    weights: NDArray


def sequences(times: NDArray, answers: Answers, zero: float, population: str, period: float, phase: str) -> Sequences:
    """Return the sequences of answers under one choice of population, period and phase; t = 0 is at ``zero`` s."""
    flights, windows = answers.fresh.shape
    delivered = times - times[0] + (LEAD - zero) + Params().simulation.estimation_latency
    if period == PERIODS[0]:
        found = answers.fresh if population == "fresh" else answers.often
        # the clock is ahead of the flight by anything up to a period: a share of it for each flight
        ahead = STEP * (np.arange(flights) + 0.5) / flights if phase == "clock" else np.zeros(flights)
        at, weights = delivered + ahead[:, None], np.ones(flights)
    else:
        found = answers.fresh if population == "fresh" else answers.rarely
        every = [[0] if phase == "window" else list(range(f % SPREAD, EVERY, SPREAD)) for f in range(flights)]
        rows = np.repeat(np.arange(flights), [len(one) for one in every])
        weights = np.repeat([1.0 / len(one) for one in every], [len(one) for one in every])
        runs = np.concatenate(every)[:, None] + EVERY * np.arange(math.ceil(windows / EVERY))
        some, beyond = np.minimum(runs, windows - 1), runs >= windows
        found = np.where(beyond, np.nan, found[rows[:, None], some])
        at = np.where(beyond, np.inf, delivered[some])
    late = at > SECONDS
    return Sequences(np.where(late, np.inf, at), np.where(late, np.nan, found), weights)


def median(values: NDArray) -> NDArray:
    """Return the median along the last axis of what is not nan; nan of nothing."""
    ordered, count = np.sort(values, axis=-1), np.isfinite(values).sum(axis=-1)
    low, high = (np.clip(at, 0, None)[..., None] for at in ((count - 1) // 2, count // 2))
    pair = [np.take_along_axis(ordered, at, axis=-1)[..., 0] for at in (low, high)]
    return 0.5 * (pair[0] + pair[1])


def used(lengths: NDArray, filter_length: int) -> NDArray:
    """Return the lengths in use (S, n) after each answer (S, n): the printed hand-over, nan where there is none."""
    before = np.full((len(lengths), filter_length - 1), np.nan)
    padded = np.concatenate([before, lengths], axis=1)
    found = median(np.lib.stride_tricks.sliding_window_view(padded, filter_length, axis=1))
    return np.where(np.isfinite(lengths), found, np.nan)


class Outcome(NamedTuple):
    """What a sequence comes to, as ``measures.convergence`` has it: ``length`` (S,) in m and, by definition of
    convergence, ``seconds`` (S,); inf where it never converges."""

    length: NDArray
    seconds: dict[str, NDArray]


def outcomes(found: Sequences, filter_length: int, start: float) -> Outcome:
    """Return what sequences come to under a median filter, from a first length in m."""
    rows = len(found.lengths)
    times = np.concatenate([np.zeros((rows, 1)), found.times], axis=1)
    lengths = np.concatenate([np.full((rows, 1), start), used(found.lengths, filter_length)], axis=1)
    valid = np.isfinite(lengths)
    count = valid.sum(axis=1)
    last = np.take_along_axis(lengths, count[:, None] - 1, axis=1)[:, 0]
    final = median(np.where(valid & (times > SECONDS - FINAL_SECONDS), lengths, np.nan))
    final = np.where(np.isfinite(final), final, last)
    off = np.abs(lengths - final[:, None])
    seconds = {}
    for definition, tolerance in DEFINITIONS.items():
        outside = valid & (off > tolerance)
        if definition.startswith("first"):
            inside = valid & ~outside
            first = np.where(inside.any(axis=1), inside.argmax(axis=1), count)
        else:
            first = np.where(outside.any(axis=1), outside.shape[1] - outside[:, ::-1].argmax(axis=1), 0)
        known = np.take_along_axis(times, np.minimum(first, times.shape[1] - 1)[:, None], axis=1)[:, 0]
        seconds[definition] = np.where(first < count, known, np.inf)
    return Outcome(final, seconds)


def every_sequence(
    tracked: str, fitness: str, populations: tuple[int, ...], generations: tuple[int, ...]
) -> Iterator[tuple[tuple[int, int, str, str, float, str], Sequences]]:
    """Yield (population, generations, window, first population, period, phase) and the sequences of it."""
    for size in itertools.product(populations, generations):
        estimation, found = params_of(tracked, fitness, *size).estimation, {}
        for motion in MOTIONS:
            times, values = landscapes(tracked, fitness, motion)
            found[motion] = times, search(values, estimation)
        for window, *rest in itertools.product(WINDOWS, POPULATIONS, PERIODS, PHASES):
            motion, zero = WINDOWS[window]
            yield (*size, window, *rest), sequences(*found[motion], zero, *rest)
