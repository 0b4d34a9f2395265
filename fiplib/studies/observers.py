"""The benefit of a calmer state observer, and its cost for the estimate of the length.

A case is one simulated flight of the default vehicle and rod under one observer of ``OBSERVED``: "hover" and "circle"
with the rod's length in use, "pushes" in hover with the pushes of the scenario ``push-hover`` and another ``length`` in
use. Beside the outcome of the flight, a row has the margins of the linear loop and, for hover and circle, the
results for the length in windows of ``SECONDS``: the Cramer-Rao bound, and the pose estimator's stated deviation and
error. Findings: docs/studies.md. 1200 rows, about 4 minutes of one core.
"""

import itertools
import math
from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import binomtest

from fiplib.controllers import margins
from fiplib.dynamics import z_axis
from fiplib.estimators.cramer_rao import CALIBRATION, cramer_rao, motion
from fiplib.estimators.poses.estimate import estimate
from fiplib.estimators.poses.knowledge import Knowledge
from fiplib.estimators.poses.rows import Body
from fiplib.params import NANO, A, B, Params, X, Y
from fiplib.recording import Flight
from fiplib.references import Circle, Hover
from fiplib.reproduction.sources import Rows
from fiplib.reproduction.style import BLUE, COLUMN, GREEN, ORANGE, PURPLE, origin
from fiplib.reproduction.tables import NONE, Facts, Table, number
from fiplib.simulate import SCENARIOS, Scenario
from fiplib.studies import seconds_flown
from fiplib.studies.batch import fly_many

KEYS = ("flight", "observer", "length", "seed")
"""``flight`` is a name in ``FLIGHTS``, ``observer`` one in ``OBSERVED``; ``length`` is the one in use, m."""

_FORCE = Params().piloting.force_density
OBSERVED: dict[str, dict] = {
    "differentiated": {},
    "Kalman": {"piloting__observer": "kalman"},
    "Kalman, force / 10": {"piloting__observer": "kalman", "piloting__force_density": _FORCE / 10},
    "Kalman, force / 100": {"piloting__observer": "kalman", "piloting__force_density": _FORCE / 100},
}
"""Parameters of each observer: the two of ``fiplib.observers``, the second with less force than it should expect."""

FLIGHTS = {"hover": Hover(), "circle": Circle(0.4, 8.0), "pushes": Hover()}
TRUE_LENGTH = 1.0
LENGTHS = tuple(tenths / 10 for tenths in range(4, 17))
SEEDS = range(20)

SETTLED, SECONDS, WINDOWS = 5.0, 2.5, 2
"""Hover and circle are judged from ``SETTLED`` s on, in so many windows of ``SECONDS``."""


LINEAR = ("delay_margin", "gain_low", "gain_high")
ESTIMATED, KNOWN = ("answered", "deviation", "length_error"), ("", "_seat")
"""Columns of the pose estimator, and the endings of their names: the seat's height is not known, or it is."""


def cases() -> list[dict]:
    """Hover and circle with the true length in use, pushes with every length, for every observer and seed."""
    flights = [("hover", TRUE_LENGTH), ("circle", TRUE_LENGTH), *(("pushes", length) for length in LENGTHS)]
    return [
        dict(zip(KEYS, (flight, observer, length, seed), strict=True))
        for (flight, length), observer, seed in itertools.product(flights, OBSERVED, SEEDS)
    ]


def run(case: dict) -> dict[str, float | int | str]:
    """Fly one case.

    Returns:
        survived (1 or 0); flown (s until a fall); lean (largest |a| or |b|, m). And, nan for pushes: delay_margin (s),
        gain_low, gain_high of ``margins``; rate (RMS of the two commanded body rates, deg/s), error (RMS distance from
        the reference, m), bound (m, RMS over windows); of the pose estimator, once without the height of the seat and
        once with it (``_seat``), answered (windows with a length), deviation (m, stated, RMS over these) and
        length_error (m, RMS over these).
    """
    pushed = case["flight"] == "pushes"
    params = Params().replace(
        pendulum__length=TRUE_LENGTH, piloting__initial_length=case["length"], **OBSERVED[case["observer"]]
    )
    scenario = Scenario(
        "observers",
        "",
        SCENARIOS["push-hover"].duration if pushed else SETTLED + WINDOWS * SECONDS,
        FLIGHTS[case["flight"]],
        pushes=SCENARIOS["push-hover"].pushes if pushed else (),
        params=params,
        seed=50_000 + int(case["seed"]),
    )
    [flight] = fly_many([scenario])
    return {
        "survived": int(flight.survived),
        "flown": seconds_flown(flight, scenario),
        "lean": float(np.abs(flight.truth_state.values[:, [A, B]]).max()),
        **_quiet(flight if flight.survived and not pushed else None),
    }


def _quiet(flight: Flight | None) -> dict[str, float]:
    """Return the columns of hover and circle; nan of another flight."""
    if flight is None:
        names = *LINEAR, "rate", "error", "bound", *(f"{name}{kind}" for kind in KNOWN for name in ESTIMATED)
        return dict.fromkeys(names, math.nan)
    rates = np.degrees(flight.command.values[flight.time(flight.command) > SETTLED, :2])
    off = (flight.state.values - flight.reference.values)[flight.time(flight.state) > SETTLED]
    known, bodies = Knowledge.of_flight(flight), bodies_of(flight)
    knowledge = dict(zip(KNOWN, (replace(known, seat_height=Knowledge().seat_height), known), strict=True))
    bounds, answers = [], {kind: [] for kind in KNOWN}
    for window in range(WINDOWS):
        start = SETTLED + window * SECONDS
        first, last = (flight.start_ns + round(at * NANO) for at in (start, start + SECONDS))
        bounds.append(cramer_rao(motion(flight, first, last), flight.params, (CALIBRATION,))[-1])
        parts = [body.part((body.time >= start) & (body.time < start + SECONDS)) for body in bodies]
        for kind in KNOWN:
            answers[kind].append(estimate(*parts, knowledge[kind]))
    found = margins.closed_loop(TRUE_LENGTH, flight.params).margins
    columns = dict(zip(LINEAR, (found.delay, found.gain_low, found.gain_high), strict=True))
    columns |= {"rate": _rms(rates), "error": _rms(np.hypot(off[:, X], off[:, Y])), "bound": _rms(bounds)}
    for kind, ones in answers.items():
        given = [answer for answer in ones if answer.reason is None]
        deviation = _rms([answer.standard_deviation for answer in given])
        values = len(given), deviation, _rms([answer.length - TRUE_LENGTH for answer in given])
        columns |= {f"{name}{kind}": value for name, value in zip(ESTIMATED, values, strict=True)}
    return columns


def bodies_of(flight: Flight) -> list[Body]:
    """Return vehicle and rod of a flight, as the pose estimator takes them."""
    return [
        Body(flight.time(body), body.position, np.column_stack(z_axis(*body.orientation.T)))
        for body in (flight.vehicle, flight.pendulum)
    ]


def _rms(values: list | np.ndarray) -> float:
    """Root mean square; nan of nothing."""
    return math.sqrt(np.mean(np.square(values))) if len(values) else math.nan


def _rows(rows: Rows, flight: str, observer: str, length: float = TRUE_LENGTH) -> Rows:
    return [row for row in rows if (row["flight"], row["observer"], row["length"]) == (flight, observer, length)]


def mean(rows: Rows, flight: str, observer: str, column: str) -> tuple[float, float]:
    """Return the mean of a column over the seeds and half its 95 % interval (normal); nan values are left out."""
    values = np.array([row[column] for row in _rows(rows, flight, observer)])
    values = values[np.isfinite(values)]
    if len(values) < 2:
        return math.nan, math.nan
    return float(values.mean()), float(1.96 * values.std(ddof=1) / math.sqrt(len(values)))


def survival(rows: Rows, observer: str, length: float) -> tuple[float, float, float]:
    """Return the share of flights with pushes that stay up, and its 95 % interval (Wilson)."""
    up = [row["survived"] for row in _rows(rows, "pushes", observer, length)]
    interval = binomtest(round(sum(up)), len(up)).proportion_ci(method="wilson")
    return sum(up) / len(up), interval.low, interval.high


def surviving(rows: Rows, observer: str) -> list[float]:
    """Return the lengths in use with which most flights survive the pushes: the interval lies above one half."""
    return [length for length in LENGTHS if survival(rows, observer, length)[1] > 0.5]


COLOURS = dict(zip(OBSERVED, ((ORANGE, "o"), (BLUE, "s"), (GREEN, "^"), (PURPLE, "v")), strict=True))


def fig18_observers(rows: Rows) -> Figure:
    """Fig. 18: observers: survival of pushes with a wrong length, and the cost of calm commands for the estimate.

    20 simulated flights at each point, a uniform rod of 1 m; bars: 95 % intervals (Wilson's above, of the mean below).
    Above: three pushes in hover, by the length in use. Below: standard deviation of the length from windows of 2.5 s,
    over the RMS rate command, in hover (filled) and on the 0.4 m circle (open): the Cramer-Rao bound if the commands
    are known, and the deviation that the estimate from poses alone states. A Kalman filter needs a quarter of the
    commands and survives lengths a tenth longer; the calmer the commands, the less informative the poses.
    """
    figure = Figure(figsize=(COLUMN, 4.1), layout="constrained")
    panels = figure.subplot_mosaic([["up", "up"], ["bound", "deviation"]])
    above = panels["up"]
    for place, (observer, (colour, marker)) in enumerate(COLOURS.items()):
        shares = np.array([survival(rows, observer, length) for length in LENGTHS])
        lengths = np.array(LENGTHS) + 0.012 * (place - 1.5)
        spread = np.abs(shares[:, 1:] - shares[:, :1]).T
        above.errorbar(lengths, shares[:, 0], spread, color=colour, marker=marker, ms=3, elinewidth=0.6, label=observer)
        for column, flight in itertools.product(("bound", "deviation"), ("hover", "circle")):
            (rate, rates), (length, lengths) = (mean(rows, flight, observer, name) for name in ("rate", column))
            style = {"color": colour, "marker": marker, "ms": 4, "mfc": colour if flight == "hover" else "white"}
            panels[column].errorbar(rate, 1e3 * length, 1e3 * lengths, rates, elinewidth=0.6, ls="none", **style)
    above.axvline(TRUE_LENGTH, color="black", lw=0.6, ls="--")
    above.set(xlabel="length used (m)", ylabel="share that stays up", ylim=(-0.04, 1.04), xlim=(0.35, 1.65))
    above.legend(loc="lower left")
    for column, title in (("bound", "bound, commands known"), ("deviation", "stated, poses alone")):
        axes = panels[column]
        axes.set(xscale="log", yscale="log", xlabel="RMS rates (deg/s)", title=title, xlim=(2.4, 40), ylim=(2, 150))
        for axis, ticks in ((axes.xaxis, (3, 6, 12, 25)), (axes.yaxis, (2, 5, 10, 20, 50, 100))):
            axis.set_ticks(ticks, [f"{tick}" for tick in ticks])
        axes.minorticks_off()
    panels["bound"].set_ylabel("deviation of the length (mm)")
    origin(figure, f"simulated flights, 1 m rod, {len(SEEDS)} seeds; filled: hover, open: circle")
    return figure


def _cell(rows: Rows, flight: str, observer: str, column: str, factor: float) -> str:
    """A mean over the seeds with half its interval."""
    value, half = (factor * one for one in mean(rows, flight, observer, column))
    return rf"{number(value, 1)} $\pm$ {half:.1f}" if math.isfinite(value) else NONE


def table15_observers(rows: Rows) -> Table:
    """Table 15: the observers: commands, errors, margins, pushes, and the deviation of the length.

    Means over 20 simulated flights with half their 95 % intervals (normal), a uniform rod of 1 m; the last six lines
    are standard deviations of the length from windows of 2.5 s. A length survives where more than half of the flights
    do, with 95 % confidence (Wilson); margins are those of the linear loop.
    """
    found, quiet = [], ("hover", "circle")
    for observer in OBSERVED:
        cells: list[str] = []
        for column, factor in (("rate", 1.0), ("error", 1e3)):
            cells += [_cell(rows, flight, observer, column, factor) for flight in quiet]
        loop = _rows(rows, "hover", observer)[0]
        cells += [number(1e3 * loop["delay_margin"], 0), f"{loop['gain_low']:.2f}--{loop['gain_high']:.2f}"]
        lengths = surviving(rows, observer)
        cells.append(_cell(rows, "pushes", observer, "lean", 100))
        cells.append(f"{lengths[0]:.1f}--{lengths[-1]:.1f}" if lengths else NONE)
        for column in ("bound", "deviation", "deviation_seat"):
            cells += [_cell(rows, flight, observer, column, 1e3) for flight in quiet]
        found.append(cells)
    names = (
        "Rates, hover (deg/s)", "Rates, circle (deg/s)", "Error, hover (mm)", "Error, circle (mm)", "Delay margin (ms)",
        "Gain margins", "Lean, pushed (cm)", "Lengths that survive (m)", "Bound, hover (mm)", "Bound, circle (mm)",
        "Poses alone, hover (mm)", "Poses alone, circle (mm)", "Seat known, hover (mm)", "Seat known, circle (mm)",
    )  # fmt: skip
    lines = [tuple(line) for line in zip(names, *found, strict=True)]
    return Table(("Quantity", *OBSERVED), lines, "l" + "r" * len(OBSERVED))


def facts(rows: Rows) -> Facts:
    """Return what the report states of both observers."""
    found: Facts = {}
    for name, observer in (("differentiated", "differentiated"), ("Kalman", "Kalman")):
        lengths, loop = surviving(rows, observer), _rows(rows, "hover", observer)[0]
        found |= {
            (name, "delay"): f"{1e3 * loop['delay_margin']:.0f}",
            (name, "shortest"): f"{lengths[0]:.1f}",
            (name, "longest"): f"{lengths[-1]:.1f}",
        }
        means = {("rate",): ("hover", "rate", 1.0), ("lean",): ("pushes", "lean", 100.0)}
        means |= {
            (flight, column): (flight, column, 1e3)
            for flight in ("hover", "circle")
            for column in ("bound", "deviation")
        }
        for words, (flight, column, factor) in means.items():
            value, half = (factor * part for part in mean(rows, flight, observer, column))
            found[name, *words], found[name, *words, "half"] = f"{value:.1f}", f"{half:.1f}"
    return found
