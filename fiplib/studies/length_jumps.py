"""G6: the largest survivable jump of the used length, and the benefit of small steps.

On the 0.4 m circle, with the true length of 1 m in use, the pilot is given another length every 0.2 s, as a stream of
estimates would do: to the end of the flight (``lasting`` "to the end"), or for 2 s and then the true length again
("2 s", an estimator's outlier). It takes the length over at once, or by at most ``STEP`` a time
(``params.piloting.length_step``). What steps can and cannot do: docs/studies.md. 144 rows, about 6 minutes of one core.
"""

import itertools
import math

import numpy as np

from fiplib.controllers import margins
from fiplib.params import Params
from fiplib.references import Circle
from fiplib.reproduction.sources import Rows
from fiplib.reproduction.tables import Facts
from fiplib.simulate import Scenario
from fiplib.studies import seconds_flown
from fiplib.studies.batch import fly_many
from fiplib.studies.survival import RODS

KEYS = ("length", "rod", "change", "lasting")
"""``length`` given to the pilot, in m; ``rod`` is a name in ``RODS``."""

TRUE_LENGTH = 1.0
LENGTHS = tuple(tenths / 10 for tenths in range(2, 21) if tenths != 10)
STEP = 0.05
"""m per hand-over; with one each 0.2 s, 0.25 m/s."""

CHANGES = {"at once": math.inf, "in steps": STEP}
LASTING = {"to the end": math.inf, "2 s": 2.0}

START, SECONDS, PERIOD = 6.0, 15.0, 0.2
"""The jump is at ``START`` s, a second after the circle has full speed; the flight lasts ``SECONDS`` more; the pilot is
given a length every ``PERIOD`` s."""

SEEDS = (1, 2)
CIRCLE = Circle(radius=0.4, period=8.0)


def cases() -> list[dict]:
    """Every length, taken over in both ways, to the end of the flight and as an outlier."""
    return [dict(zip(KEYS, values, strict=True)) for values in itertools.product(LENGTHS, RODS, CHANGES, LASTING)]


def run(case: dict) -> dict[str, float | int | str]:
    """Survival of one case.

    Returns:
        growth_rate (1/s) of the linear loop with the given length; jump (m); survived (flights of ``SEEDS``), flown
        (shortest time from the jump to a fall, s, at most ``SECONDS``); rate_ratio (RMS of the commanded body rates
        after the jump over that of the 3 s before it, largest of the flights).
    """
    params = Params().replace(
        pendulum__length=TRUE_LENGTH,
        pendulum__gyration_ratio=RODS[case["rod"]],
        piloting__initial_length=TRUE_LENGTH,
        piloting__length_step=CHANGES[case["change"]],
        estimation__median_length=1,
    )
    since = np.arange(round(SECONDS / PERIOD)) * PERIOD
    wrong = since < LASTING[case["lasting"]] - PERIOD / 2
    told = tuple(
        (START + float(time), case["length"] if lasts else TRUE_LENGTH)
        for time, lasts in zip(since, wrong, strict=True)
    )
    survived, flown, ratios = 0, [], []
    for seed in SEEDS:
        scenario = Scenario("length jump", "", START + SECONDS, CIRCLE, told_lengths=told, params=params, seed=seed)
        [flight] = fly_many([scenario])
        survived += flight.survived
        flown.append(seconds_flown(flight, scenario) - START)
        time, rates = flight.time(flight.command), np.square(flight.command.values[:, :2])
        before, after = rates[(time > START - 3.0) & (time < START)], rates[time >= START]
        ratios.append(math.sqrt(after.mean() / before.mean()))
    return {
        "growth_rate": margins.closed_loop(case["length"], params).growth_rate,
        "jump": round(case["length"] - TRUE_LENGTH, 9),
        "survived": survived,
        "flown": min(flown),
        "rate_ratio": max(ratios),
    }


def facts(rows: Rows) -> Facts:
    """Return the shortest and longest length that flies, by rod, change and duration."""
    found: Facts = {}
    flights = max(row["survived"] for row in rows)
    for kind in itertools.product(("uniform", "point mass"), CHANGES, LASTING):
        some = [row for row in rows if (row["rod"], row["change"], row["lasting"]) == kind]
        fell = [row["length"] for row in some if row["survived"] < flights]
        below = max((length for length in fell if length < TRUE_LENGTH), default=0.0)
        above = min((length for length in fell if length > TRUE_LENGTH), default=math.inf)
        flying = [row["length"] for row in some if below < row["length"] < above]
        rod, change, lasting = kind
        name = (rod, change, "outlier" if lasting == "2 s" else "lasting")
        found |= {(*name, "shortest"): f"{min(flying):.1f}", (*name, "longest"): f"{max(flying):.1f}"}
    return found
