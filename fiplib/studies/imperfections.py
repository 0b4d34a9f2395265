"""Errors of the estimates when the vehicle and its laboratory differ from the estimator's assumptions.

The study ``estimators`` presumes that all but the state and the length is known exactly. Here one thing at a time is
not, by as much as one meets in a laboratory, and then all of them together. One case is one flight of the 0.4 m circle
with a uniform rod; its columns are those of ``estimators``, without the bounds, for each estimator in ``NAMES``. What
was seen: docs/studies.md. 220 rows, about 12 minutes of two cores.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from fiplib.estimators import ESTIMATORS
from fiplib.params import Params
from fiplib.recording import Flight
from fiplib.references import Circle
from fiplib.reproduction.sources import Rows
from fiplib.reproduction.tables import NONE, Facts, Table
from fiplib.simulate import Plant, Scenario, fly
from fiplib.studies.estimators import (
    DURATION,
    answered,
    covering,
    pooled,
    pooled_rms,
    ranged,
    resampled,
    summarise,
    windows_of,
)

KEYS = ("imperfection", "seed")

NAMES = ("ga", "poses")

SEEDS = range(20)

CIRCLE = Circle(0.4, 8.0)


@dataclass(frozen=True)
class Imperfection:
    """The differences between the laboratory and the estimator's assumptions.

    ``late`` and ``jitter`` are mean and standard deviation in s of how much later a command acts; ``lag`` in s is added
    to the inner loop's; ``gain`` multiplies body rates, ``thrust`` the thrust; ``gust`` is the standard deviation in
    rad/s of a body rate that nobody commanded, white from command to command. ``marker`` in m and ``mount`` in rad are
    added to the pendulum's position along x and y, and to roll and pitch, as they are read by the estimators.
    """

    late: float = 0.0
    jitter: float = 0.0
    lag: float = 0.0
    gain: float = 1.0
    thrust: float = 1.0
    gust: float = 0.0
    marker: float = 0.0
    mount: float = 0.0


IMPERFECTIONS = {
    "none": Imperfection(),
    "commands 1 ms late, jitter 0.3 ms": Imperfection(late=1e-3, jitter=0.3e-3),
    "commands 3 ms late, jitter 1 ms": Imperfection(late=3e-3, jitter=1e-3),
    "lag 5 ms longer": Imperfection(lag=5e-3),
    "rates 3 % larger": Imperfection(gain=1.03),
    "gusts of 5 deg/s": Imperfection(gust=np.radians(5.0)),
    "thrust 5 % less": Imperfection(thrust=0.95),
    "marker 0.1 mm off": Imperfection(marker=1e-4),
    "marker 1 mm off": Imperfection(marker=1e-3),
    "frame turned by 0.5 deg": Imperfection(mount=np.radians(0.5)),
    "all of them": Imperfection(3e-3, 1e-3, 5e-3, 1.03, 0.95, np.radians(5.0), 1e-3, np.radians(0.5)),
}


class ImperfectPlant(Plant):
    """The plant with an imperfection between the commands and what acts."""

    def __init__(
        self, params: Params, position: ArrayLike, lean: ArrayLike, *, imperfection: Imperfection, seed: int
    ) -> None:
        lag = params.simulation.rate_lag + imperfection.lag
        super().__init__(params.replace(simulation__rate_lag=lag), position, lean)
        self._imperfection, self._rng, self._last = imperfection, np.random.default_rng([seed, 1]), 0
        self._rate = params.simulation.plant_rate

    def command(self, body_rate: ArrayLike, thrust: float, at: int | None = None) -> None:
        one = self._imperfection
        late, *gust = self._rng.normal(size=3)
        at = self._substep + self.delay + round(max(0.0, one.late + one.jitter * late) * self._rate)
        self._last = max(self._last, at)  # none overtakes another
        rates = one.gain * np.asarray(body_rate) + one.gust * np.array([*gust, 0.0])
        super().command(rates, one.thrust * thrust, self._last)


def cases() -> list[dict]:
    """Every imperfection, over ``SEEDS``."""
    return [{"imperfection": name, "seed": seed} for name in IMPERFECTIONS for seed in SEEDS]


def run(case: dict) -> dict[str, float | int]:
    """Fly the case and ask the estimators."""
    flight = flown(IMPERFECTIONS[case["imperfection"]], int(case["seed"]))
    params, row = flight.params, {"survived": int(flight.survived)}
    windows = windows_of(flight)
    for name in NAMES:
        _, given = windows[ESTIMATORS[name].kind]
        rng = np.random.default_rng([int(case["seed"]), NAMES.index(name)])
        answers = [ESTIMATORS[name].function(window, params, rng) for _, window in given]
        row |= {f"{column}_{name}": value for column, value in summarise(answers, params.pendulum.length).items()}
    return row


def flown(imperfection: Imperfection, seed: int) -> Flight:
    """A flight of 1 m of uniform rod, the true length in use, as the estimators read it."""
    scenario = Scenario("circle", "", DURATION, CIRCLE, params=Params(), seed=40_000 + seed)

    def vehicle(params: Params, position: ArrayLike, lean: ArrayLike) -> Plant:
        return ImperfectPlant(params, position, lean, imperfection=imperfection, seed=scenario.seed)

    flight = fly(scenario, vehicle=vehicle)
    return misread(flight, imperfection) if imperfection.marker or imperfection.mount else flight


def misread(flight: Flight, imperfection: Imperfection) -> Flight:
    """A flight whose markers sit a little beside where they are said to sit; its states are derived from them anew."""
    turn = Rotation.from_rotvec((imperfection.mount, imperfection.mount, 0.0))
    vehicle, pendulum = flight.vehicle, flight.pendulum
    offset = np.array((imperfection.marker, imperfection.marker, 0.0))
    return replace(
        flight,
        vehicle=replace(vehicle, orientation=(Rotation.from_quat(vehicle.orientation) * turn).as_quat()),
        pendulum=replace(pendulum, position=pendulum.position + offset),
        state=None,
    )


def table11_imperfections(rows: Rows) -> Table:
    """Table 11: errors of two estimators when vehicle and laboratory differ from what is stated.

    The genetic algorithm on derived states and the estimate from raw poses, on 20 simulated flights of the 0.4 m circle
    (8 s) for each imperfection, uniform rod of 1 m, pooled over 3 windows of 5.4 s or 5 of 2.5 s a flight; in brackets:
    95 % intervals, bootstrap over flights.
    """
    lines = []
    for name in IMPERFECTIONS:
        chosen = [row for row in rows if row["imperfection"] == name]
        cells = [_error(chosen, "ga", 0), _answered(chosen, "poses"), NONE, NONE]
        if given := answered(chosen, "poses"):
            covered = (100 * share for share in covering(given, "poses"))
            cells[2:] = _error(chosen, "poses", 1), ranged(*covered, 0)
        lines.append((name.replace("%", r"\%"), *cells))
    header = ("Imperfection", "GA: RMSE (mm)", r"Poses: answered (\%)", "RMSE (mm)", r"In 95\,\% interval (\%)")
    return Table(header, lines, "lrrrr")


def _error(rows: Rows, name: str, decimals: int) -> str:
    """Return the RMS error of an estimator with its interval, mm."""
    found = resampled(answered(rows, name), pooled_rms, f"n_{name}", f"rms_{name}")
    return ranged(*(1e3 * value for value in found), decimals)


def _answered(rows: Rows, name: str) -> str:
    """Return the share of its windows that an estimator answered, %."""
    answered, refused = (sum(row[f"{column}_{name}"] for row in rows) for column in ("n", "refused"))
    return f"{100 * answered / (answered + refused):.0f}"


def facts(rows: Rows) -> Facts:
    """Return what the report states of three imperfections."""
    found: Facts = {}
    kinds = {"marker": "marker 0.1 mm off", "turned": "frame turned by 0.5 deg", "all": "all of them"}
    for key, kind in kinds.items():
        chosen = [row for row in rows if row["imperfection"] == kind]
        for name in NAMES:
            one = pooled(chosen, name)
            found[key, name, "answered"] = _answered(chosen, name)
            if one.windows:
                given = answered(chosen, name)
                _, low, high = resampled(given, pooled_rms, f"n_{name}", f"rms_{name}")
                found |= {
                    (key, name, "rms", "low"): f"{1e3 * low:.1f}",
                    (key, name, "rms", "high"): f"{1e3 * high:.1f}",
                }
                found[key, name, "rms"] = f"{1e3 * one.rms:.1f}"
                found[key, name, "covered"] = f"{100 * one.covered:.0f}"
    return found
