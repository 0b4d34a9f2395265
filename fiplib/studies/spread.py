"""The spread behind the recorded flights of the length estimation: 20 seeds of each scenario, over time.

A row is one flight of a scenario that ``data/`` holds, under one of ``SEEDS``, among which is that of the recorded
flight; flights of the same seed have the same noise. Column ``QUANTITY_SECONDS`` is a quantity of ``QUANTITIES`` so
many seconds after the start, nan before there is one and after a fall. 60 rows, about 3 minutes of one core.
"""

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from fiplib import replay
from fiplib.params import NANO
from fiplib.recording import Flight
from fiplib.reproduction import measures
from fiplib.reproduction.bands import QUANTITIES, STEP, TIMES
from fiplib.simulate import SCENARIOS
from fiplib.studies import seconds_flown
from fiplib.studies.batch import fly_many

KEYS = ("scenario", "seed")

STARTS = ("estimate-0.8", "estimate-1.2", "estimate-1.4")
SEEDS = range(1, 21)


def cases() -> list[dict]:
    """Every scenario with every seed."""
    return [{"scenario": scenario, "seed": seed} for scenario in STARTS for seed in SEEDS]


def run(case: dict) -> dict[str, float | int | str]:
    """Fly one case.

    Returns:
        survived (1 or 0), flown (s until a fall), and for each quantity and time ``QUANTITY_SECONDS``, m, to 10 um.
    """
    scenario = dataclasses.replace(SCENARIOS[case["scenario"]], seed=int(case["seed"]))
    [flight] = fly_many([scenario])
    row: dict[str, float | int | str] = {"survived": int(flight.survived), "flown": seconds_flown(flight, scenario)}
    for quantity, values in zip(QUANTITIES, _quantities(flight), strict=True):
        row |= {f"{quantity}_{time:g}": round(float(value), 5) for time, value in zip(TIMES, values, strict=True)}
    return row


def _quantities(flight: Flight) -> list[NDArray]:
    """Return the quantities of a flight at ``TIMES``."""
    answers = np.column_stack((measures.used_length(flight)[1], flight.length.values[:, 1:]))
    answered = np.searchsorted(flight.time(flight.length), TIMES, side="right") - 1
    used, estimate, deviation = answers[np.maximum(answered, 0)].T
    ticks = np.searchsorted(flight.time(flight.state), TIMES)
    ticks = np.minimum(ticks, len(flight.state.stamp) - 1)
    errors = measures.tracking_error(flight)[ticks].T
    poses = _from_poses(flight)
    later = np.array(TIMES) > flight.duration
    return [np.where(later, math.nan, values) for values in (used, estimate, deviation, *errors, *poses)]


def _from_poses(flight: Flight) -> NDArray:
    """Length and stated deviation from raw poses (2, n): from windows that end at ``TIMES``."""
    from fiplib.estimators.poses.in_flight import InFlight  # compiled code: half a second to import

    found = np.full((2, len(TIMES)), math.nan)
    for stamp, window in replay.raw_windows(flight, flight.params.estimation.raw_window, STEP):
        at, estimate = round((stamp - flight.start_ns) / NANO / STEP), InFlight()(window, flight.params)
        if at < len(TIMES) and estimate.reason is None:
            found[:, at] = estimate.length, estimate.standard_deviation
    return found
