"""The recorded scenarios flown again over many seeds: is a row of the ledger a rule, or one lucky flight?

Everything is measured and judged by the ledger itself (``claims``), on what the controller saw. ``VARIANTS`` fly again
with what the paper says should be changed, or could be read otherwise, and nothing else:

- *default*: one set of parameters for all rows, 20 seeds;
- *y heavy*: ten times the weights of y and y', those of x and x' (C3: another weight would mend y);
- *exploring*: fewer elites, more mutation (G4, ``claims.EXPLORING``);
- *every 5 s*: the other reading of "0.2 Hz"; *120 Hz window*: the other reading of the window's sampling;
- *printed fitness*: the formula as printed, under our covariances (the errata's posterior residual).

125 rows of the default and of the controller's variants; ``Readings`` are the 40 of the estimator's.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from fiplib.params import Y_DOT, Params, Y
from fiplib.recording import Flight
from fiplib.reproduction import claims, measures
from fiplib.reproduction.sources import Rows
from fiplib.reproduction.tables import NONE, Table, number
from fiplib.simulate import SCENARIOS
from fiplib.studies import seconds_flown
from fiplib.studies.batch import fly_many

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
    weights = list(Params().control.state_weights)
    weights[Y], weights[Y_DOT] = factor * weights[Y], factor * weights[Y_DOT]
    return {"control__state_weights": tuple(weights)}


VARIANTS = {
    "default": Variant({}, tuple(SCENARIOS), SEEDS),
    "y heavy": Variant(_y_weights(10.0), CIRCLE),
    "exploring": Variant(claims.EXPLORING, STARTS),
    "every 5 s": Variant({"estimation__run_period": 5.0}, STARTS),
    "120 Hz window": Variant({"estimation__sample_period": 1.0 / 120.0}, STARTS),
    "printed fitness": Variant({"estimation__fitness": "paper"}, STARTS),
}

ESTIMATOR = ("exploring", "every 5 s", "120 Hz window", "printed fitness")
"""The variants of the estimator: a study of their own, ``Readings``."""

CIRCLING = {"largest_lean": "C1", "x_gain": "C2.gain", "x_delay": "C2.delay", "y_error": "C2.y"}
ESTIMATING = {"final_length": "length", "final_error": "error", "converged": "time"}

ROWS = {
    "push-hover": {"largest_lean": "D2", "settling": "D3"},
    "circle-0.8": CIRCLING,
    **{
        f"estimate-{start}": {column: f"{id}.{row}" for column, row in ESTIMATING.items()}
        | {"late_share": "G4.late", "tracking": "G5"}
        for id, start in (("G1", "0.8"), ("G2", "1.2"), ("G3", "1.4"))
    },
    "length-jump": {"safe_jump": "G6.safe", "fatal_jump": "G6.fatal"},
}
"""The row of the ledger that judges each column of the study, by scenario."""

COLUMNS = tuple(dict.fromkeys(column for rows in ROWS.values() for column in rows))


def cases() -> list[dict]:
    """The default and the variants of the controller, in their scenarios, over their seeds."""
    return _cases(of_estimator=False)


def _cases(of_estimator: bool) -> list[dict]:
    return [
        {"variant": name, "scenario": scenario, "seed": seed}
        for name, variant in VARIANTS.items()
        if (name in ESTIMATOR) == of_estimator
        for scenario in variant.scenarios
        for seed in range(1, variant.seeds + 1)
    ]


def run(case: dict) -> dict[str, float | int | str]:
    """The ledger's measures of one flight; NaN where a row does not speak of this scenario, or the flight fell.

    Returns:
        survived (0 or 1) and flown (s); axes, the RMS error of y over that of x on the 0.8 m circle; and for each
        column in ``ROWS`` the value of its row in the row's unit, and whether the row holds, ``holds_COLUMN`` (0 or 1).
    """
    scenario, variant = SCENARIOS[case["scenario"]], VARIANTS[case["variant"]]
    scenario = dataclasses.replace(scenario, params=scenario.params.replace(**variant.changes), seed=case["seed"])
    [flight] = fly_many([scenario])
    row = dict.fromkeys((*COLUMNS, "axes", *(f"holds_{column}" for column in COLUMNS)), math.nan)
    row = {"survived": int(flight.survived), "flown": seconds_flown(flight, scenario), **row}
    if flight.survived or scenario.told_lengths:
        for column, id in ROWS[scenario.name].items():
            if column == "tracking" and not updated_on_the_circle(flight):
                continue
            claim = claims.BY_ID[id]
            found = claim.judge(claim.paper, flight)
            row |= {column: found.value, f"holds_{column}": int(found.verdict in claims.HELD)}
    if flight.survived and scenario.name in CIRCLE:
        errors = measures.tracking_error(flight)[measures.laps(flight).mask]
        x, y = (measures.rms(axis) for axis in errors.T)
        row["axes"] = y / x
    return row


def updated_on_the_circle(flight: Flight) -> bool:
    """Whether the circle had begun before the first update of the length: else there is no arc to compare with (G5)."""
    before = flight.time(flight.reference) < measures.jumps(flight)[0].start
    return bool(measures.laps(flight).phase[before].max() > 0.0)


class Readings:
    """The estimator's rows of the ledger under other readings of the paper, and under the remedy that it names."""

    KEYS = KEYS
    run = staticmethod(run)

    @staticmethod
    def cases() -> list[dict]:
        """Each variant of the estimator from either side of the truth, over its seeds."""
        return _cases(of_estimator=True)


def table5_seeds(rows: Rows) -> Table:
    """Table 5: every row of the ledger that is measured on a flight, over 20 simulated flights with other noise.

    Mean, standard deviation and extremes over the flights that have the number; the last column counts the flights in
    which the row holds, and a flight that falls does not count as holding.
    """
    default = [row for row in rows if row["variant"] == "default"]
    lines = []
    for scenario, columns in ROWS.items():
        if scenario == "push-hover":
            columns = {"survived": "D1"} | columns
        flown = [row for row in default if row["scenario"] == scenario]
        for column, id in columns.items():
            held = column if column == "survived" else f"holds_{column}"
            name = f"{id}, {scenario}" if id in ("G4.late", "G5") else id
            lines.append((name, *_spread([row[column] for row in flown], id), *_share([row[held] for row in flown])))
    header = ("Row", "Paper", "Mean", "SD", "Least", "Most", "Unit", "Flights", "Row holds")
    return Table(header, sorted(lines, key=lambda line: _order(line[0])), "lrrrrrlrr")


def table6_readings(default: Rows, readings: Rows) -> Table:
    """Table 6: the length that the estimator's flights come to under other variants of the paper, and its remedy.

    Simulated flights of 25 s on the 0.4 m circle from two first lengths, a rod of 1 m: 20 flights of the default, 5 of
    each other variant; mean, standard deviation and RMS error of the length reached.
    """
    lines = []
    for variant in ("default", *dict.fromkeys(row["variant"] for row in readings)):
        for scenario in STARTS:
            flown = [row for row in (*default, *readings) if row["variant"] == variant and row["scenario"] == scenario]
            lengths = np.array([row["final_length"] for row in flown if math.isfinite(row["final_length"])])
            mean, deviation, error = NONE, NONE, NONE
            if lengths.size:
                mean, deviation = f"{lengths.mean():.3f}", f"{lengths.std(ddof=1):.3f}"
                errors = [row["final_error"] for row in flown if math.isfinite(row["final_error"])]
                error = f"{measures.rms(errors):.3f}"
            up, held = sum(row["survived"] for row in flown), _share([row["holds_final_length"] for row in flown])[1]
            lines.append((variant, scenario[-3:], f"{len(flown)}", f"{up:g}", mean, deviation, error, held))
    header = ("Reading", "$l_0$ (m)", "Flights", "Up", "Mean (m)", "SD (m)", "RMSE (m)", "Row holds")
    return Table(header, lines, "lrrrrrrr")


def _spread(values: Sequence[float], id: str) -> tuple[str, ...]:
    """Paper, mean, standard deviation, least, most, unit: of the finite values, with the decimals of the claim."""
    claim = claims.BY_ID[id]
    finite = np.array([value for value in values if math.isfinite(value)])
    paper = NONE if claim.paper is None or id == "D1" else number(claim.paper, claim.decimals)
    unit = "" if claim.unit == "1" or id == "D1" else claim.unit
    if not finite.size:
        return paper, NONE, NONE, NONE, NONE, unit
    decimals = 2 if id == "D1" else claim.decimals
    deviation = finite.std(ddof=1) if finite.size > 1 else math.nan
    return paper, *(number(value, decimals) for value in (finite.mean(), deviation, finite.min(), finite.max())), unit


def _share(held: Sequence[float]) -> tuple[str, str]:
    """How many flights there are, and in how many of them the row holds; one that fell does not count as holding."""
    return f"{len(held)}", f"{sum(value == 1 for value in held)}"


def _order(name: str) -> tuple[int, str]:
    return list(claims.BY_ID).index(name.split(",")[0]), name
