"""An outside check: the first flying inverted pendulum (Hehn and D'Andrea, 2011), flown with its own parameters.

That experiment held a rod whose centre of mass is 0.565 m above the seat with a linear quadratic regulator, which
commanded body rates 50 times a second over a loop with a latency of about 30 ms. It reports a static offset of about
5 cm, and errors of about 0.1 m on a circle of 0.1 m radius. Known from it: these numbers, the form of the cost and the
nominal motion (``controllers.lqr_circle``), and that its model of the rod is a point mass. Not known: the ratio of the
two weights, the circle's period, the masses, noise and filters; for these stand ours, and several ``PERIODS``.

A simulated vehicle without errors of calibration has no static offset. One cause that every laboratory has is a tracked
frame that is turned against the thrust: with the feedback u = -K z, it hovers where K_s s + K_tilt turn = 0, so that

    turn = ``OFFSET`` K_s / |K_tilt|

gives the reported offset (``misalignment``). That is fitted, to the one number. The error on the circle with this turn
and nothing else changed is tested, for a rod that is a point mass, as the regulator takes it to be, and for a uniform
one, as a tube is. What was found: docs/studies.md. 320 rows, about 3 minutes of one core.
"""

import itertools
import math

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from fiplib.controllers.lqr import WEIGHTS, gain
from fiplib.params import Params, X, Y
from fiplib.references import Circle, Hover
from fiplib.reproduction.measures import rms
from fiplib.reproduction.sources import Rows
from fiplib.reproduction.tables import NONE, Facts, Table, number
from fiplib.simulate import Plant, Scenario, fly

KEYS = ("rod", "misaligned", "period", "seed")
"""``rod`` is a name in ``RODS``; ``misaligned`` is 1 or 0; ``period`` is the circle's in s, 0: hover."""

RODS = {"point mass": 0.0, "uniform": 1.0 / 12.0}
"""Gyration ratio k^2/l^2 of each rod."""

LENGTH = 2 * 0.565
"""Rod of this package with its centre of mass where theirs is, m."""

RADIUS, PERIODS = 0.1, (2.0, 3.0, 6.0)
SEEDS = range(20)
SECONDS, SETTLED = 15.0, 7.0
"""Duration of a flight, and from when on it is judged, s: the circle is at speed from 5 s on."""

OFFSET, CIRCLE_ERROR = 0.05, 0.1
"""Errors that the experiment reports, approximately, m."""

OTHER_WEIGHTS = (WEIGHTS.input / 5, WEIGHTS.input * 4)
"""Input weights for which the misalignment is computed, too; the state weight is 1."""

PARAMS = Params().replace(
    piloting__controller="lqr_circle",
    pendulum__length=LENGTH,
    piloting__initial_length=LENGTH,
    piloting__control_rate=50.0,
    piloting__mocap_rate=200.0,
    simulation__plant_rate=1000.0,
    simulation__mocap_latency=0.01,  # of the 30 ms a third before the controller, the rest after it: only the sum acts
    simulation__rate_delay=0.02,
    vehicle__seat_height=0.0,
    piloting__seat_height=0.0,
)


def misalignment(input_weight: float = WEIGHTS.input) -> float:
    """Return the angle in rad between tracked frame and thrust that gives the reported offset, linearly."""
    feedback = gain(LENGTH, WEIGHTS._replace(input=input_weight))
    return OFFSET * abs(feedback[0] / feedback[4])


class MisalignedPlant(Plant):
    """A plant whose thrust is turned about the pitch axis against the frame that is tracked and that turns the rates.

    Its state holds the attitude of the tracked frame; it is that of the thrust while it advances.
    """

    turn = Rotation.from_rotvec((0.0, misalignment(), 0.0))

    def advance(self, force: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        self._turned(self.turn)
        super().advance(force)
        self._turned(self.turn.inv())

    def _turned(self, turn: Rotation) -> None:
        attitude = slice(6, 10)
        self.x[attitude] = (Rotation.from_quat(self.x[attitude]) * turn).as_quat()


def cases() -> list[dict]:
    """Both rods, with and without misalignment, in hover and on every circle, over ``SEEDS``."""
    return [dict(zip(KEYS, values, strict=True)) for values in itertools.product(RODS, (0, 1), (0.0, *PERIODS), SEEDS)]


def run(case: dict) -> dict[str, float | int]:
    """Fly one case.

    Returns:
        survived (1 or 0); once settled, in m, of the seat's distance from its reference: offset_x and offset_y, the
        means; error, the rms; largest (nan after a fall).
    """
    reference = Circle(RADIUS, case["period"]) if case["period"] else Hover()
    params = PARAMS.replace(pendulum__gyration_ratio=RODS[case["rod"]])
    scenario = Scenario("flying pendulum", "", SECONDS, reference, params=params, seed=70_000 + int(case["seed"]))
    flight = fly(scenario, vehicle=MisalignedPlant if case["misaligned"] else Plant)
    if not flight.survived:
        return {"survived": 0, **dict.fromkeys(("offset_x", "offset_y", "error", "largest"), math.nan)}
    times = flight.time(flight.truth_state)
    settled = times >= SETTLED
    away = flight.truth_state.values[settled][:, [X, Y]] - reference.at(times[settled])[:, [X, Y]]
    distance, mean = np.hypot(*away.T), away.mean(axis=0)
    return {
        "survived": 1,
        "offset_x": float(mean[0]),
        "offset_y": float(mean[1]),
        "error": rms(distance),
        "largest": float(distance.max()),
    }


def mean(rows: Rows, rod: str, misaligned: int, period: float, column: str) -> tuple[float, float]:
    """Return the mean over the seeds of a column in cm, and half its 95 % interval (normal); nan after falls.

    ``offset`` is the one along the turn: where the thrust is turned forward, the vehicle hovers too far back.
    """
    some = [row for row in rows if (row["rod"], row["misaligned"], row["period"]) == (rod, misaligned, period)]
    values = 100 * np.array([-row["offset_x"] if column == "offset" else row[column] for row in some])
    return float(values.mean()), float(1.96 * values.std(ddof=1) / math.sqrt(len(values)))


def _cell(value: tuple[float, float]) -> str:
    return NONE if math.isnan(value[0]) else rf"{number(value[0], 1)} $\pm$ {value[1]:.1f}"


def table19_flying_pendulum(rows: Rows) -> Table:
    """Table 19: the experiment of 2011 beside ours: reported, fitted and tested numbers.

    20 simulated flights of 15 s in each cell, with its rod (centre of mass 0.565 m above the seat), 50 commands a
    second and a latency of 30 ms; the turn of the tracked frame is fitted to the static offset, the errors on the
    circle of 0.1 m radius are tested.
    """
    offset, circle = f"about {100 * OFFSET:.0f}", f"about {100 * CIRCLE_ERROR:.0f}"
    turns = {
        "Frame against thrust (deg)": WEIGHTS.input,
        "Same, input weight a fifth (deg)": OTHER_WEIGHTS[0],
        "Same, input weight fourfold (deg)": OTHER_WEIGHTS[1],
    }
    lines = []
    for name, weight in turns.items():
        turn = f"{np.degrees(misalignment(weight)):.2f}"
        lines.append((name, NONE, turn, turn, "fitted to the offset"))
    for name, misaligned, period, column, reported, kind in (
        ("Static offset, aligned (cm)", 0, 0.0, "offset", offset, "tested"),
        ("Static offset, turned (cm)", 1, 0.0, "offset", offset, "fitted"),
        *((f"Circle in {period:g} s, aligned: rms (cm)", 0, period, "error", circle, "tested") for period in PERIODS),
        *((f"Circle in {period:g} s, turned: rms (cm)", 1, period, "error", circle, "tested") for period in PERIODS),
        *(
            (f"Circle in {period:g} s, turned: largest (cm)", 1, period, "largest", circle, "tested")
            for period in PERIODS
        ),
    ):
        cells = [_cell(mean(rows, rod, misaligned, period, column)) for rod in RODS]
        lines.append((name, reported, *cells, kind))
    return Table(("Quantity", "2011", *(rod.capitalize() for rod in RODS), "Kind"), lines, "llrrl")


def facts(rows: Rows) -> Facts:
    """Return what the report states of this check."""
    found: Facts = {
        ("misalignment",): f"{np.degrees(misalignment()):.2f}",
        ("flights",): f"{len(rows)}",
        ("survived",): f"{sum(row['survived'] for row in rows):.0f}",
    }
    for rod, (word, misaligned) in itertools.product(RODS, (("aligned", 0), ("turned", 1))):
        value, half = mean(rows, rod, misaligned, 0.0, "offset")
        found[rod, word, "offset"], found[rod, word, "offset", "half"] = f"{value:.1f}", f"{half:.1f}"
        for column in ("error", "largest"):
            means = [mean(rows, rod, misaligned, period, column) for period in PERIODS]
            found[rod, word, column, "least"] = f"{min(value for value, _ in means):.1f}"
            found[rod, word, column, "most"] = f"{max(value for value, _ in means):.1f}"
            found[rod, word, column, "half"] = f"{max(half for _, half in means):.1f}"
    return found
