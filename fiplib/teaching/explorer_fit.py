"""One refit of a stretch of a recorded flight, as the page of ``fiplib.teaching.explorer`` asks for it; no widgets here."""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fiplib import ga as genetic
from fiplib import kalman, replay
from fiplib.estimators import ESTIMATORS
from fiplib.estimators.base import Estimate
from fiplib.estimators.windows import LEAD, RawWindow, WindowSampler
from fiplib.kalman import Window
from fiplib.params import Params
from fiplib.recording import BagError, Flight, Poses, Series

MOST_SAMPLES = 250
"""Samples in a window at most: beyond, a refit takes longer than one likes to wait."""

LANDSCAPE_SAMPLES = 90_000
"""Lengths times samples of the landscape that is drawn: about 0.1 s."""

PROBLEMS = (BagError, ValueError, OSError)
"""What is the user's to mend, and so is said in the page."""


@dataclass(frozen=True, eq=False)
class Refit:
    """What a refit was given and found.

    Attributes:
        window: the data.
        params: with the settings of the refit.
        lengths: of the landscape, in m, (L,).
        fitness: of these lengths, (L,).
        best: length of least fitness that the chromosome can express near the landscape's best, m.
        found: by the genetic algorithm.
        seconds: that all of this took.
    """

    window: Window
    params: Params
    lengths: NDArray
    fitness: NDArray
    best: float
    found: genetic.Estimate
    seconds: float


def cut(flight: Flight, start: float, end: float, lead: float = 0.0) -> Flight:
    """A flight from ``start`` to ``end`` s, its commands and states from ``lead`` s earlier; time zero stays."""

    def part(data: Poses | Series | None, early: float) -> Poses | Series | None:
        if data is None:
            return None
        at = flight.time(data)
        inside = (at >= start - early) & (at <= end)
        fields = ("stamp", "received", "position", "orientation") if isinstance(data, Poses) else ("stamp", "values")
        return replace(data, **{name: getattr(data, name)[inside] for name in fields})

    early = {"vehicle": 0.0, "pendulum": 0.0, "command": lead, "state": lead}
    return replace(flight, **{role: part(getattr(flight, role), value) for role, value in early.items()})


def window_between(flight: Flight, known: Series, start: float, end: float, params: Params) -> tuple[Window, Params]:
    """The estimator's window of a stretch of flight, sampled as the pilot does it.

    Args:
        flight: the recorded flight.
        known: its states (``replay.states``).
        start: s since the start of the flight.
        end: s, as well.
        params: with the sampling period; the number of samples follows from it.

    Returns:
        The window, and the parameters with its number of samples and the rate at which commands were recorded.

    Raises:
        BagError: the bag holds no commands.
        ValueError: fewer than 2 samples, or more than ``MOST_SAMPLES``.
    """
    if flight.command is None:
        raise BagError(f"{flight.path}: {flight.why_not_refit()}")
    params = replay.at_recorded_rate(params, flight.command)
    at = flight.time(flight.command)
    latest = np.searchsorted(known.stamp, flight.command.stamp, side="right") - 1
    chosen = np.flatnonzero((at >= start) & (at <= end) & (latest >= 0))
    ticks = max(1, round(params.estimation.sample_period * params.piloting.control_rate))
    samples = (len(chosen) - 1) // ticks + 1
    if not 2 <= samples <= MOST_SAMPLES:
        raise ValueError(
            f"the window of {end - start:.1f} s holds {max(samples, 0)} samples; a refit takes 2 to {MOST_SAMPLES}: "
            f"take a {'longer' if samples < 2 else 'shorter'} window or another sampling period"
        )
    params = params.replace(estimation__window=samples)
    sampler = WindowSampler(params)
    for index in chosen:
        sampler.push(known.values[latest[index]], flight.command.values[index, :2])
        if window := sampler.due(int(flight.command.stamp[index])):
            return window, params
    raise AssertionError("as many samples as were counted")


def refit(window: Window, params: Params, seed: int) -> Refit:
    """Landscape, genetic algorithm and best length of a window.

    Raises:
        ValueError: as ``kalman.fitness``, or the filter overflowed at every length.
    """
    began, estimation = time.perf_counter(), params.estimation
    chromosome = genetic.Chromosome.of(estimation)
    count = min(chromosome.codes, LANDSCAPE_SAMPLES // len(window.states))
    codes = np.unique(np.linspace(0, chromosome.codes - 1, count).round().astype(int))
    lengths = chromosome.length(codes)
    fitness = kalman.fitness(lengths, window, estimation)
    if not np.isfinite(fitness).any():
        raise ValueError("the filter overflows at every length: take a shorter window or another reading")
    coarse = int(fitness.argmin())
    near = chromosome.length(np.arange(codes[max(coarse - 1, 0)], codes[min(coarse + 1, len(codes) - 1)] + 1))
    best = float(near[kalman.fitness(near, window, estimation).argmin()])
    found = genetic.estimate(window, params, np.random.default_rng(seed))
    return Refit(window, params, lengths, fitness, best, found, time.perf_counter() - began)


def compare(
    flight: Flight, window: Window, start: float, end: float, params: Params, seed: int
) -> Iterator[tuple[str, Estimate, float]]:
    """Every estimator on the same stretch of flight: name, estimate (with its reason if refused), seconds taken."""
    for name, estimator in ESTIMATORS.items():
        began = time.perf_counter()
        try:
            data = window if estimator.kind == "states" else _raw_window(flight, start, end)
            found = estimator.function(data, params, np.random.default_rng(seed))
        except (*PROBLEMS, RuntimeError) as error:  # the latter is CasADi's
            found = Estimate(math.nan, math.nan, str(error))
        yield name, found, time.perf_counter() - began


def _raw_window(flight: Flight, start: float, end: float) -> RawWindow:
    metadata = flight.metadata | {"params": flight.params.replace(estimation__window=2).to_dict()}
    piece = cut(replace(flight, metadata=metadata), start, end, lead=LEAD + 0.05)
    found = replay.raw_windows(piece, end - start - 0.02, every=0.0)  # less than the stretch by frames lost at its ends
    if not found:
        raise ValueError(f"needs motion capture all along the window, and commands from {LEAD:g} s before it")
    return found[-1][1]
