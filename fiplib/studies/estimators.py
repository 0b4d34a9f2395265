"""Every estimator against the Cramer-Rao bound, on the same flights.

One case is one simulated flight, which flies with a used length 0.1 m too short, right, or 0.1 m too long by its seed.
Each estimator gets all windows of its kind that follow each other without overlap once the circle is at speed: 5.5 s of
derived states, or 2.5 s of raw motion capture. Per estimator ``NAME`` the row holds

- ``n_NAME``: windows answered; ``refused_NAME``: windows refused;
- ``bias_NAME``, ``rms_NAME``, ``worst_NAME``: mean, root mean square and largest size of the answers' errors, m;
- ``covered_NAME``: answers whose 95 % interval covers the truth; ``sd_NAME``: their mean standard deviation, m; nan
  both for an estimator that states none;
- ``bound_NAME``: root mean square over the windows of the bound for the *raw* motion capture of the same span, m, so
  that derived states and raw frames are held against the same limit. What an estimator takes for unknown is unknown
  in its bound too (``UNKNOWN``); all others take the calibration of motion capture for exact.
"""

import math
from typing import Any

import numpy as np

from fiplib import replay
from fiplib.estimators import ESTIMATORS
from fiplib.estimators.base import Estimate
from fiplib.estimators.cramer_rao import cramer_rao, motion
from fiplib.estimators.likelihood import CALIBRATION, NUISANCES
from fiplib.params import NANO, Params
from fiplib.pilot import Circle, Hover
from fiplib.recording import Flight
from fiplib.simulate import Scenario, fly

KEYS = ("excitation", "gyration_ratio", "seed")

EXCITATIONS = {"circle-0.4": Circle(0.4, 8.0), "circle-0.8": Circle(0.8, 9.0), "hover": Hover()}

UNKNOWN = {"maximum_likelihood": (CALIBRATION,), "maximum_likelihood_free": NUISANCES}
"""What is unknown beside state and length, by estimator."""

DURATION = 22.0
"""s: three windows of derived states and six of raw motion capture after ``SETTLED``."""

SETTLED = 5.0
"""s after which windows begin: the circle has come to speed."""

Z95 = 1.959964
"""Half-width of a 95 % interval in standard deviations."""


def cases() -> list[dict]:
    """40 flights of the paper's excitation and a real rod, on which the target is judged; 10 of each other kind."""
    return [
        {"excitation": excitation, "gyration_ratio": ratio, "seed": seed}
        for excitation in EXCITATIONS
        for ratio in (0.0, round(1 / 12, 6))
        for seed in range(40 if excitation == "circle-0.4" and ratio > 0 else 10)
    ]


def run(case: dict) -> dict[str, float | int | str]:
    """Fly the case, ask every estimator, hold the answers against the bound."""
    flight = _flown(case)
    row: dict[str, float | int | str] = {"survived": int(flight.survived)}
    params = flight.params
    for kind, (seconds, kept) in windows_of(flight).items():
        bounds: dict[tuple[str, ...], float] = {}
        for name, estimator in ESTIMATORS.items():
            if estimator.kind != kind:
                continue
            unknown = UNKNOWN.get(name, ())
            if unknown not in bounds:
                bounds[unknown] = _bound(flight, [end for end, _ in kept], seconds, unknown)
            rng = np.random.default_rng([case["seed"], list(ESTIMATORS).index(name)])
            answers = [estimator.function(window, params, rng) for _, window in kept]
            summary = summarise(answers, params.pendulum.length) | {"bound": bounds[unknown]}
            row |= {f"{column}_{name}": value for column, value in summary.items()}
    return row


def windows_of(flight: Flight) -> dict[str, tuple[float, list[tuple[int, Any]]]]:
    """By kind of estimator: the span of its windows in s, and those that begin after ``SETTLED`` and do not overlap.

    Each window comes with the time in ns at which its last frame was exposed.
    """
    params = flight.params
    settled = flight.start_ns + round(SETTLED * NANO)
    span = (params.estimation.window - 1) * params.estimation.sample_period
    sampled = params.replace(estimation__run_period=params.estimation.window * params.estimation.sample_period)
    latency = round(params.simulation.mocap_latency * NANO)
    found = {
        "states": (span, replay.windows(flight, sampled)),
        "raw": (params.estimation.raw_window, replay.raw_windows(flight, *2 * (params.estimation.raw_window,))),
    }
    return {
        kind: (
            seconds,
            [(stamp - latency, one) for stamp, one in some if stamp - latency - round(seconds * NANO) >= settled],
        )
        for kind, (seconds, some) in found.items()
    }


def summarise(answers: list[Estimate], truth: float) -> dict[str, float | int]:
    """Counts and errors of the answers for one flight, as described above."""
    given = [answer for answer in answers if answer.reason is None]
    errors = np.array([answer.length for answer in given]) - truth
    deviations = np.array([answer.standard_deviation for answer in given])
    stated = bool(np.isfinite(deviations).any())
    return {
        "n": len(given),
        "refused": len(answers) - len(given),
        "bias": float(errors.mean()) if given else math.nan,
        "rms": float(np.sqrt(np.mean(errors**2))) if given else math.nan,
        "worst": float(np.abs(errors).max()) if given else math.nan,
        "covered": int(np.count_nonzero(np.abs(errors) <= Z95 * deviations)) if stated else math.nan,
        "sd": float(np.nanmean(deviations)) if stated else math.nan,
    }


def _flown(case: dict) -> Flight:
    seed = int(case["seed"])
    params = Params().replace(
        pendulum__gyration_ratio=float(case["gyration_ratio"]), piloting__initial_length=(0.9, 1.0, 1.1)[seed % 3]
    )
    kind = case["excitation"]
    # a stretch of seeds for each kind of flight, so that no two share their noise; none that a recorded scenario flies
    first = 10_000 * (1 + list(EXCITATIONS).index(kind)) + (5_000 if case["gyration_ratio"] > 0 else 0)
    scenario = Scenario(kind, "", DURATION, EXCITATIONS[kind], params=params, seed=first + seed)
    return fly(scenario)


def _bound(flight: Flight, ends: list[int], seconds: float, unknown: tuple[str, ...]) -> float:
    bounds = [cramer_rao(motion(flight, end - round(seconds * NANO), end), flight.params, unknown)[-1] for end in ends]
    return float(np.sqrt(np.mean(np.square(bounds)))) if bounds else math.nan
