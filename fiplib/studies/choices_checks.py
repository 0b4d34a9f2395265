"""Two checks beside ``choices``: what the neglected feedback does, and whether the search is what limits the estimate.

``Flown`` flies the combinations ``FLOWN`` with the estimates fed back, from each of the paper's starts. A flight is
flown with the lengths that were found in the one before, and these are estimated anew: an answer depends on earlier
ones alone, so that each repetition is nearer to the flight that its own estimates steer. Rows are those of the last.

``Exploring`` takes the paper's remarks at the end of its section 4.3, as the ledger does (G4), to every number of
candidates and generations, and to new and kept populations.
"""

import itertools
import math

import numpy as np
from numpy.typing import NDArray

from fiplib import kalman
from fiplib.ga import Chromosome
from fiplib.kalman import Window
from fiplib.params import Params
from fiplib.reproduction.claims import EXPLORING, LATE, LITTLE
from fiplib.reproduction.measures import binomial_interval, rms
from fiplib.reproduction.sources import Rows
from fiplib.reproduction.tables import Facts
from fiplib.simulate import Scenario
from fiplib.studies import choices_runs as runs
from fiplib.studies.batch import fly_many
from fiplib.studies.choices_runs import Outcome, Sequences

FLOWN: dict[str, tuple] = {
    "best": ("seat", "printed_posterior", 12, 5, "hover", "kept", 5.0, "clock", 3, "first5"),
    "default": ("seat", "rk4_likelihood", 60, 20, "empty", "fresh", 0.2, "window", 5, "stays5"),
}
"""Levels in the order of ``choices.LEVELS``: the most probable combination, and the one that ``Params`` has."""

REPETITIONS = 5
"""With the long period a flight has five answers: the last repetition is then the flight that they steer."""


class Flown:
    """Combinations with their estimates fed back: 24 rows."""

    KEYS = ("combination", "start", "seed")
    STARTS = (0.8, 1.2, 1.4)
    SEEDS = range(4)

    @staticmethod
    def cases() -> list[dict]:
        """Each of ``FLOWN`` from each of the paper's starts, with every seed."""
        every = itertools.product(FLOWN, Flown.STARTS, Flown.SEEDS)
        return [dict(zip(Flown.KEYS, values, strict=True)) for values in every]

    @staticmethod
    def run(case: dict) -> dict[str, float | int]:
        """Fly a case without and with feedback.

        Returns:
            survived (0 or 1, with feedback); length (m) and seconds of convergence, fed back, and ``open_length``,
            ``open_seconds`` without; ``change``, of the length by the last repetition, m. nan if the rod fell.
        """
        combination, start, seed = FLOWN[case["combination"]], float(case["start"]), int(case["seed"])
        *setting, window, first, period, phase, filter_length, definition = combination
        params = runs.params_of(*setting).replace(piloting__initial_length=1.0)
        motion, zero = runs.WINDOWS[window]
        told: tuple[tuple[float, float], ...] = ()
        ends: list[Outcome] = []
        for repetition in range(REPETITIONS + 1):
            if repetition:  # the first flight uses the true length, as those of ``choices`` do
                params = params.replace(piloting__initial_length=start, estimation__median_length=1)
            duration = runs.LEAD + runs.SECONDS + runs.STEP
            number = 97_000 + 100 * Flown.STARTS.index(start) + seed
            flown = Scenario("choices", "", duration, runs.MOTIONS[motion], (), told, params, number)
            [flight] = fly_many([flown])
            if not flight.survived:
                break
            found = answers(*runs.windows_of(flight, params), params, zero, first, period, phase, seed)
            ends.append(runs.outcomes(found, filter_length, start))
            lengths = runs.used(found.lengths, filter_length)[0]
            given = zip((found.times[0] + zero).tolist(), lengths.tolist(), strict=True)
            told = tuple(one for one in given if math.isfinite(one[1]))
        row: dict[str, float | int] = {"survived": int(len(ends) == REPETITIONS + 1)}
        for name, number in (("", -1), ("open_", 0)):
            known = ends[number] if row["survived"] or number == 0 else None
            row[f"{name}length"] = float(known.length[0]) if known else math.nan
            row[f"{name}seconds"] = float(known.seconds[definition][0]) if known else math.nan
        row["change"] = float(ends[-1].length[0] - ends[-2].length[0]) if row["survived"] else math.nan
        return row

    @staticmethod
    def facts(rows: Rows) -> Facts:
        """Return what feedback changes: RMS differences of length (cm) and time (s), the largest last change (mm)."""
        found: Facts = {}
        for combination in FLOWN:
            some = [row for row in rows if row["combination"] == combination and row["survived"]]
            length = [row["length"] - row["open_length"] for row in some]
            timed = [row for row in some if math.isfinite(row["seconds"] - row["open_seconds"])]
            found |= {
                (combination, "flights"): f"{len(some)}",
                (combination, "length"): f"{100 * rms(length):.1f}",
                (combination, "seconds"): f"{rms([row['seconds'] - row['open_seconds'] for row in timed]):.1f}",
                (combination, "change"): f"{1e3 * max(abs(row['change']) for row in some):.1f}",
            }
        return found


def answers(
    times: NDArray, windows: list[Window], params: Params, zero: float, first: str, period: float, phase: str, seed: int
) -> Sequences:
    """Return the one sequence of answers in a flight: runs at the windows that one choice of the schedule has."""
    rng = np.random.default_rng(seed)
    every = round(period / runs.STEP)
    at = np.arange(rng.integers(every) if phase == "clock" else 0, len(windows), every)
    delivered = times[at] - zero + params.simulation.estimation_latency
    at, delivered = at[delivered <= runs.SECONDS], delivered[delivered <= runs.SECONDS]
    grid = runs.lengths_of(params.estimation)
    values = np.array([kalman.fitness(grid, windows[number], params.estimation) for number in at])
    lengths = runs.chain(values, params.estimation, first == "kept", rng)
    return Sequences(delivered[None], lengths[None], np.ones(1))


class Exploring:
    """The paper's remarks on the search, over the number of candidates, generations and new or kept populations.

    18 rows: two variants of the fitness, the seat tracked, an empty window at t = 0.
    """

    KEYS = ("fitness", "population", "generations")
    FITNESSES = ("printed_posterior", "rk4_likelihood")
    CANDIDATES, GENERATIONS = (12, 30, 60), (5, 20, 40)
    REMARKS = ("late", "search", "remedy")

    @staticmethod
    def cases() -> list[dict]:
        """Every setting."""
        every = itertools.product(Exploring.FITNESSES, Exploring.CANDIDATES, Exploring.GENERATIONS)
        return [dict(zip(Exploring.KEYS, values, strict=True)) for values in every]

    @staticmethod
    def run(case: dict) -> dict[str, int]:
        """In how many of the flights a remark holds.

        Returns:
            For each first population and period: ``late_``, at most ``LITTLE`` of an initial error of 0.2 m goes after
            ``LATE`` s; ``search_``, the median distance of the answer from the best of all lengths is more than that of
            the best one from the rod; ``remedy_``, it is, and is less with ``claims.EXPLORING``.
        """
        setting = "seat", case["fitness"]
        size = int(case["population"]), int(case["generations"])
        params = runs.params_of(*setting, *size)
        times, values = runs.landscapes(*setting, "circle")
        values = values[:, times <= runs.SECONDS - params.simulation.estimation_latency]
        times, chromosome = times[: values.shape[1]], Chromosome.of(params.estimation)
        between = runs.interpolation(chromosome)
        best = chromosome.length(np.array([[between.fitness(one).argmin() for one in flight] for flight in values]))
        printed, explored = (runs.search(values, one.estimation) for one in (params, params.replace(**EXPLORING)))
        row: dict[str, int] = {}
        for first, period in itertools.product(runs.POPULATIONS, runs.PERIODS):
            found = runs.sequences(times, printed, 0.0, first, period, "window")
            better = runs.sequences(times, explored, 0.0, first, period, "window")
            at = slice(0, None, round(period / runs.STEP))
            gap, mended = (
                np.nanmedian(np.abs(one.lengths[:, : best[:, at].shape[1]] - best[:, at]), axis=1)
                for one in (found, better)
            )
            optimum = np.median(np.abs(best[:, at] - params.pendulum.length), axis=1)
            lengths = runs.used(found.lengths, params.estimation.median_length)
            before = np.where(np.isfinite(lengths) & (found.times <= LATE), found.times, -1.0).argmax(axis=1)
            middle = np.abs(lengths[np.arange(len(lengths)), before] - params.pendulum.length)
            end = np.abs(runs.outcomes(found, params.estimation.median_length, 0.8).length - params.pendulum.length)
            holds = (middle - end) / 0.2 <= LITTLE, gap > optimum, (gap > optimum) & (mended < gap)
            for remark, flights in zip(Exploring.REMARKS, holds, strict=True):
                row[f"{remark}_{first}_{period:g}"] = int(flights.sum())
        return row

    @staticmethod
    def facts(rows: Rows) -> Facts:
        """Return in how many of all flights each remark holds, with the interval of the share in %.

        For the seat tracked and the likelihood as fitness: for the fewest and the most evaluations, and for what
        ``Params`` has.
        """
        found: Facts = {("flights",): f"{len(runs.SEEDS)}"}
        sizes = {"least": (12, 5), "ours": (60, 20), "most": (60, 40)}
        for row in rows:
            if row["fitness"] == "rk4_likelihood":
                for name, size in sizes.items():
                    if (row["population"], row["generations"]) == size:
                        for remark, first, period in itertools.product(
                            Exploring.REMARKS, runs.POPULATIONS, runs.PERIODS
                        ):
                            words = (name, remark, first, f"{period:g}")
                            holding = round(row[f"{remark}_{first}_{period:g}"])
                            low, high = binomial_interval(holding, len(runs.SEEDS))
                            found |= {
                                words: f"{holding}",
                                (*words, "low"): f"{100 * low:.0f}",
                                (*words, "high"): f"{100 * high:.0f}",
                            }
        return found
