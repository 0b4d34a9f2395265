"""The flights that decide the ledger: every scenario over many seeds, and with what a claim asks to be changed.

A row holds numbers only, one column for each function of ``reproduction.quantities`` that speaks of its scenario; the
ledger (``reproduction.claims``) judges them. ``VARIANTS`` fly with one thing changed, and nothing else:

- *default*: one set of parameters for all rows, 40 seeds, other ones from each first length;
- *y heavy*: ten times the weights of y and y', those of x and x' (C3, D4);
- *hover*: the estimator without the circle (G8: excitation is needed);
- *swaying*: thrust and yaw rate disturbed slowly (M1: altitude and yaw do not matter);
- *massless*: a rod of 0.1 g (M2: m_p << m is harmless);
- *outlier*: a length 0.85 m too long for 2 s; *short outlier*: a change by 0.9 m to 0.2 m for 2 s; *standing*: the long
  one to the end; *standing in steps*: the same by 5 cm each (G6).

500 rows; ``Readings`` are 160 of the estimator under other interpretations of the paper. About 11 and 4 minutes of one
core.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from numpy.typing import ArrayLike

from fiplib.params import Y_DOT, Params, Y
from fiplib.recording import Flight
from fiplib.references import Hover
from fiplib.reproduction import claims, feasibility, measures, quantities
from fiplib.reproduction.sources import Rows
from fiplib.reproduction.tables import NONE, Table, number
from fiplib.reproduction.verdicts import Share, middle, share
from fiplib.simulate import SCENARIOS, Plant, Scenario, fly
from fiplib.studies import seconds_flown
from fiplib.studies.batch import fly_many

KEYS = ("variant", "scenario", "seed")
"""``variant`` is a name in ``VARIANTS``, ``scenario`` one in ``simulate.SCENARIOS``."""

SEEDS, VARIANT_SEEDS = 40, 20

FIRST_SEEDS = {"estimate-1.2": 41, "estimate-1.4": 81}
"""Other seeds for each first length: after the first update these flights differ by the noise alone."""

PUSHES, CIRCLE, JUMP, HOVER = ("push-hover",), ("circle-0.8",), ("length-jump",), ("estimate-1.2",)
STARTS = ("estimate-0.8", "estimate-1.2", "estimate-1.4")
READ_FROM = (STARTS[0], STARTS[2])
"""Other interpretations start on either side of the truth; the start between adds nothing to them."""

FLOWN = {
    "push-hover": (
        *(quantities.kept, quantities.push_lean, quantities.settling, quantities.pushed_axes),
        feasibility.terminal_loss,
    ),
    "circle-0.8": (quantities.circle_lean, quantities.x_gain, quantities.x_delay, quantities.y_error),
    **dict.fromkeys(
        STARTS,
        (
            *(quantities.final_length, quantities.converged, quantities.late_share),
            *(quantities.x_tracking, quantities.y_tracking, quantities.fluctuation, quantities.estimate_error),
            *(quantities.search_gap, quantities.explored_gap, quantities.optimum_error),
            *(quantities.printed_best, quantities.printed_identity),
        ),
    ),
    "length-jump": (quantities.survived_change, quantities.fatal_change, quantities.command_ratio),
}
"""The quantities that are measured on the flights of each scenario."""

ESTIMATED = (
    *(quantities.final_length, quantities.converged, quantities.late_share),
    *(quantities.fluctuation, quantities.estimate_error),
)
SWAYED = (*FLOWN["circle-0.8"], quantities.height_sway, quantities.yaw_sway)

WRONG, SINCE, OUTLIER, PERIOD, LASTING = 1.85, 6.0, 2.0, 0.2, 15.0
"""A length 0.85 m too long, in m, that the pilot is given from a time in s on; an outlier's duration, the period of
hand-overs and the time flown after the first, all in s."""


class Variant(NamedTuple):
    """A change of parameters and scenario, the scenarios flown with it, the number of seeds, the quantities measured.

    A quantity of None is that of the default.
    """

    changes: Mapping[str, Any]
    scenarios: tuple[str, ...]
    seeds: int = VARIANT_SEEDS
    flown: Mapping[str, Any] = {}
    measured: tuple | None = None


def _y_weights(factor: float) -> dict[str, Any]:
    weights = list(Params().control.state_weights)
    weights[Y], weights[Y_DOT] = factor * weights[Y], factor * weights[Y_DOT]
    return {"control__state_weights": tuple(weights)}


def _outlier(*told: tuple[float, float]) -> Variant:
    """A wrong length for 2 s. From 1.1 m a change by more than the paper's 0.8 m leads to its shortest, 0.2 m."""
    flown = {"told_lengths": told, "duration": SINCE + LASTING}
    return Variant({}, JUMP, SEEDS, flown, (quantities.command_ratio,))


def _standing(step: float) -> Variant:
    told = tuple((SINCE + PERIOD * k, WRONG) for k in range(round(LASTING / PERIOD)))
    flown = {"told_lengths": told, "duration": SINCE + LASTING}
    return Variant({"piloting__length_step": step}, JUMP, SEEDS, flown, measured=())


VARIANTS = {
    "default": Variant({}, tuple(SCENARIOS), SEEDS),
    "y heavy": Variant(_y_weights(10.0), PUSHES + CIRCLE),
    "hover": Variant({}, HOVER, flown={"reference": Hover()}, measured=ESTIMATED),
    "swaying": Variant({}, CIRCLE, measured=SWAYED),
    "massless": Variant({"pendulum__mass": 1e-4}, CIRCLE),
    "outlier": _outlier((SINCE, WRONG), (SINCE + OUTLIER, 1.0)),
    "short outlier": _outlier((SINCE - 4.0, 1.1), (SINCE, 0.2), (SINCE + OUTLIER, 1.1)),
    "standing": _standing(math.inf),
    "standing in steps": _standing(0.05),
    "exploring": Variant(quantities.EXPLORING, READ_FROM, measured=ESTIMATED),
    "every 5 s": Variant({"estimation__run_period": 5.0}, READ_FROM, measured=ESTIMATED),
    "120 Hz window": Variant({"estimation__sample_period": 1.0 / 120.0}, READ_FROM, measured=ESTIMATED),
    "printed fitness": Variant({"estimation__fitness": "paper"}, READ_FROM, measured=ESTIMATED),
}

ESTIMATOR = ("exploring", "every 5 s", "120 Hz window", "printed fitness")
"""The variants of the estimator: a study of their own, ``Readings``."""

COLUMNS = tuple(
    dict.fromkeys(
        function.__name__
        for functions in (*FLOWN.values(), *(variant.measured or () for variant in VARIANTS.values()))
        for function in functions
    )
)


class Swaying(Plant):
    """A vehicle whose thrust and yaw rate a slow disturbance moves: ``THRUST`` of the thrust, ``YAW`` rad/s."""

    THRUST, YAW, FREQUENCY = 0.2, 0.35, 0.5
    """Half a hertz is slower than the rod's own sqrt(2 g / l) = 4.4 rad/s, and within reach of both PID loops."""

    def __init__(self, params: Params, position: ArrayLike, lean: ArrayLike = (0.0, 0.0)) -> None:
        super().__init__(params, position, lean)
        self._frames, self._rate = 0, params.piloting.mocap_rate

    def command(self, body_rate: ArrayLike, thrust: float, at: int | None = None) -> None:
        wave = math.sin(2 * math.pi * self.FREQUENCY * self._frames / self._rate)
        roll, pitch, yaw = body_rate
        super().command((roll, pitch, yaw + self.YAW * wave), thrust * (1 + self.THRUST * wave), at)

    def advance(self, force: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        super().advance(force)
        self._frames += 1


def cases() -> list[dict]:
    """Return the default and the variants of the flight, in their scenarios, over their seeds."""
    return _cases(of_estimator=False)


def _cases(of_estimator: bool) -> list[dict]:
    return [
        {"variant": name, "scenario": scenario, "seed": FIRST_SEEDS.get(scenario, 1) + number}
        for name, variant in VARIANTS.items()
        if (name in ESTIMATOR) == of_estimator
        for scenario in variant.scenarios
        for number in range(variant.seeds)
    ]


def scenario_of(case: dict) -> Scenario:
    """Return the flight of a case."""
    scenario, variant = SCENARIOS[case["scenario"]], VARIANTS[case["variant"]]
    params = scenario.params.replace(**variant.changes)
    return dataclasses.replace(scenario, params=params, seed=case["seed"], **variant.flown)


def run(case: dict) -> dict[str, float | int | str]:
    """Return the numbers of one flight.

    Returns:
        survived (0 or 1) and flown (s); for each of ``COLUMNS`` what the function of that name in ``quantities`` or
        ``feasibility`` says. NaN: it is not measured in this scenario, or the flight fell and no length was given.
    """
    scenario, variant = scenario_of(case), VARIANTS[case["variant"]]
    flight: Flight = fly(scenario, vehicle=Swaying) if case["variant"] == "swaying" else next(fly_many([scenario]))
    row = {
        "survived": int(flight.survived),
        "flown": seconds_flown(flight, scenario),
        **dict.fromkeys(COLUMNS, math.nan),
    }
    if flight.survived or scenario.told_lengths:
        functions = FLOWN[scenario.name] if variant.measured is None else variant.measured
        row |= {function.__name__: function(flight) for function in functions}
    return row


class Readings:
    """The estimator's flights under other interpretations of the paper, and under the remedy that it names."""

    KEYS = KEYS
    run = staticmethod(run)

    @staticmethod
    def cases() -> list[dict]:
        """Each variant of the estimator from either side of the truth, over its seeds."""
        return _cases(of_estimator=True)


def table5_seeds(rows: Rows) -> Table:
    """Table 5: every number of the ledger that a flight has, over 40 simulated flights with other noise.

    Median with its exact 95 % interval, and the extremes, over the flights that have the number; in how many flights it
    agrees with the paper, with the 95 % interval of that share. A flight that falls does not agree. Rows of all three
    first lengths together have 120 flights.
    """
    lines = []
    for claim in claims.CLAIMS:
        if claim.measure is None:
            continue
        values = [
            row[claim.measure.__name__] for row in rows if row["variant"] == "default" and row["scenario"] in claim.bags
        ]
        paper = NONE if claim.paper is None else number(claim.paper, claim.decimals)
        known = [value for value in values if not math.isnan(value)]
        cells = (*middle(values), *((min(known), max(known)) if known else (math.nan,) * 2))
        spread = [NONE if math.isnan(value) else number(value, claim.decimals) for value in cells]
        interval = f"{spread[1]} to {spread[2]}" if known else NONE
        unit = "" if claim.unit == "1" else claim.unit
        agree = share(claim.agree(value) for value in values)
        lines.append((claim.id, paper, spread[0], interval, *spread[3:], unit, f"{agree.flights}", _share(agree)))
    header = ("Row", "Paper", "Median", r"its 95\,\%", "Least", "Most", "Unit", "Flights", r"Agree (95\,\%)")
    return Table(header, lines, "lrrrrrlrl")


def table6_readings(default: Rows, readings: Rows) -> Table:
    """Table 6: the final length of the estimator's flights under other interpretations of the paper.

    Simulated flights of 25 s on the 0.4 m circle from two first lengths, a rod of 1 m: 40 flights of the default, 20 of
    each other interpretation and of the paper's remedy (exploring). Median with its 95 % interval, RMS error, the
    change from one answer to the next that one in ten exceeds, and how many flights end within the paper's 29 mm.
    """
    claim, lines = claims.BY_ID["G1.length"], []
    for variant in ("default", *dict.fromkeys(row["variant"] for row in readings)):
        for scenario in READ_FROM:
            flown = [row for row in (*default, *readings) if row["variant"] == variant and row["scenario"] == scenario]
            lengths = [row["final_length"] for row in flown if not math.isnan(row["final_length"])]
            spread = [f"{value:.3f}" if lengths else NONE for value in middle(lengths)]
            error = f"{measures.rms([length - claims.TRUE for length in lengths]):.3f}" if lengths else NONE
            change = middle([row["fluctuation"] for row in flown]).median
            agree = share(claim.agree(row["final_length"]) for row in flown)
            up = sum(row["survived"] for row in flown)
            cells = f"{len(flown)}", f"{up:g}", spread[0], f"{spread[1]} to {spread[2]}", error, f"{change:.3f}"
            lines.append((variant, scenario[-3:], *cells, _share(agree)))
    header = (
        *("Interpretation", "$l_0$ (m)", "Flights", "Up", "Median (m)", r"its 95\,\%", "RMSE (m)", "Change a run (m)"),
        r"Agree (95\,\%)",
    )
    return Table(header, lines, "lrrrrrrrl")


def _share(found: Share) -> str:
    return f"{found.agree} ({found.low:.2f} to {found.high:.2f})" if found.flights else NONE
