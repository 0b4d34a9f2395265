"""The recorded scenarios flown again over many seeds: is a row of the ledger a rule, or one lucky flight?

Everything is measured by the functions of ``claims``, on what the controller saw. ``VARIANTS`` fly again with what the
paper says should be changed, or could be read otherwise, and nothing else:

- *default*: one set of parameters for all rows, 20 seeds;
- *y heavy*: ten times the weights of y and y', those of x and x' (C3: another weight would mend y);
- *exploring*: fewer elites, more mutation (G4, ``claims.EXPLORING``);
- *every 5 s*: the other reading of "0.2 Hz"; *120 Hz window*: the other reading of the window's sampling;
- *printed fitness*: the formula as printed, under our covariances (the errata's posterior residual).

125 rows of the default and of the controller's variants; those of the estimator are the study ``ledger_readings``.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from fiplib import claims, replay
from fiplib.bags import Flight
from fiplib.params import Y_DOT, Params, Y
from fiplib.simulate import SCENARIOS, Tape, fly

KEYS = ("variant", "scenario", "seed")
"""``variant`` is a name in ``VARIANTS``, ``scenario`` one in ``simulate.SCENARIOS``."""

SEEDS, VARIANT_SEEDS = 20, 5

CIRCLE = ("circle-0.8",)
STARTS = ("estimate-0.8", "estimate-1.4")
"""Variants of the estimator start on either side of the truth; the start between, 1.2 m, adds nothing to them."""


class Variant(NamedTuple):
    """Changed parameters, the scenarios that are flown with them, and the number of seeds."""

    changes: Mapping[str, Any]
    scenarios: tuple[str, ...]
    seeds: int = VARIANT_SEEDS


def _y_weights(factor: float) -> dict[str, Any]:
    weights = Params().control.state_weights
    return {
        "control__state_weights": tuple(
            weight * factor if state in (Y, Y_DOT) else weight for state, weight in enumerate(weights)
        )
    }


VARIANTS = {
    "default": Variant({}, tuple(SCENARIOS), SEEDS),
    "y heavy": Variant(_y_weights(10.0), CIRCLE),
    "exploring": Variant(claims.EXPLORING, STARTS),
    "every 5 s": Variant({"estimation__run_period": 5.0}, STARTS),
    "120 Hz window": Variant({"estimation__sample_period": 1.0 / 120.0}, STARTS),
    "printed fitness": Variant({"estimation__fitness": "paper"}, STARTS),
}

ESTIMATOR = ("exploring", "every 5 s", "120 Hz window", "printed fitness")
"""The variants of the estimator: a study of their own, ``ledger_readings``."""

COLUMNS = (
    "survived", "flown", "largest_lean", "settling",
    "x_gain", "x_delay", "y_error", "axes",
    "final_length", "final_error", "converged", "late_share", "tracking",
    "safe_jump", "fatal_jump",
)  # fmt: skip


def cases() -> list[dict]:
    """The default and the variants of the controller, in their scenarios, over their seeds."""
    return cases_of(tuple(name for name in VARIANTS if name not in ESTIMATOR))


def cases_of(variants: tuple[str, ...]) -> list[dict]:
    """The cases of some variants."""
    return [
        dict(zip(KEYS, (name, scenario, seed), strict=True))
        for name in variants
        for scenario in VARIANTS[name].scenarios
        for seed in range(1, VARIANTS[name].seeds + 1)
    ]


def run(case: dict) -> dict[str, float | int | str]:
    """The ledger's measures of one flight; NaN where a row does not speak of this scenario, or the flight fell.

    Returns:
        survived (0 or 1) and flown (s), D1; largest_lean (m), D2 and C1; settling (s), D3; x_gain, x_delay (s) and
        y_error (m), C2; axes (RMS error of y over that of x), C3; final_length, final_error (m) and converged (s),
        G1-G3; late_share of the initial error that goes after 14 s, G4; tracking (RMS error of x after over before the
        first update), G5; safe_jump and fatal_jump (m), G6.
    """
    scenario, variant = SCENARIOS[case["scenario"]], VARIANTS[case["variant"]]
    scenario = dataclasses.replace(scenario, params=scenario.params.replace(**variant.changes), seed=case["seed"])
    tape = Tape()
    outcome = fly(scenario, tape)
    flight = replay.flight_of(tape, scenario)
    row = dict.fromkeys(COLUMNS, math.nan)
    row |= {"survived": int(outcome.survived), "flown": outcome.duration}
    if scenario.told_lengths:
        return row | {
            "safe_jump": claims.BY_ID["G6.safe"].judge(claims.PAPER["G6.safe"], flight).value,
            "fatal_jump": claims.BY_ID["G6.fatal"].judge(claims.PAPER["G6.fatal"], flight).value,
        }
    if not outcome.survived:
        return row
    time = flight.time(flight.state)
    if scenario.pushes:
        row["largest_lean"] = float(claims.lean(flight)[time >= scenario.pushes[0].start].max())
        row["settling"] = claims.BY_ID["D3"].judge(claims.PAPER["D3"], flight).value
    elif scenario.params.piloting.estimate:
        row |= _estimation(flight)
    else:
        row["largest_lean"] = float(claims.lean(flight).max())
        row["x_gain"], row["x_delay"] = claims.x_response(flight)
        error = claims.tracking_error(flight)
        row["y_error"] = float(np.abs(error[:, 1]).max())
        x, y = (claims.rms(axis) for axis in error[claims.laps(flight).mask].T)
        row["axes"] = y / x
    return row


def _estimation(flight: Flight) -> dict[str, float]:
    length, error, converged = claims.convergence(flight)
    row = {"final_length": length, "final_error": error, "converged": converged}
    row["late_share"] = claims.late_convergence(None, flight).value
    # an update before the circle has begun leaves no arc to compare with
    if claims.laps(flight).phase[claims.jumps(flight)[0].start > flight.time(flight.reference)].max() > 0.0:
        row["tracking"] = claims.tracking_ratio(None, flight).value
    return row
