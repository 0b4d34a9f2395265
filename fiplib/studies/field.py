"""The field: eight controllers on the same plant, with the same noise and the same seeds.

The plant is the default one: a uniform rod of 1 m on a seat of 8 cm, delay and lag of the inner loop, motion capture
with noise; the pilot's observer is the paper's. A case is one flight of one controller of ``FIELD``:

- "pushed": hover, at ``PUSHED`` s a push of 8 mN s on the rod's COM; with every length in use of ``LENGTHS``,
- "circle": 0.4 m radius in 8 s,
- "rotor": from 2 s on one of four rotors gives 20 % less,
- "wind": 2 m/s along x, steady, for 20 s; "gusts": of 1 m/s standard deviation, no mean,
- "seat": as "pushed", by a pilot that does not know of the seat's 8 cm.

The adaptive MPC is the paper's MPC with the pose estimator and the trusted hand-over; it starts from the shortest rod
to expect, 0.5 m, whatever length it is given. Every controller flies ``SEEDS`` seeds and ``LENGTHS``, the nonlinear MPC
``FEW_SEEDS`` and ``FEW_LENGTHS``. What was found: docs/studies.md.
"""

import itertools
import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fiplib.params import A, B, Params, X, Y
from fiplib.recording import Flight
from fiplib.references import Circle, Hover
from fiplib.reproduction.measures import binomial_interval
from fiplib.reproduction.sources import Quantities, Rows
from fiplib.reproduction.style import BLUE, COLUMN, GREY, origin
from fiplib.reproduction.tables import NONE, Facts, Table, number
from fiplib.simulate import Push, Scenario
from fiplib.studies import seconds_flown
from fiplib.studies.batch import fly_many

KEYS = ("controller", "flight", "length", "seed")
"""``controller`` is a name in ``FIELD``, ``flight`` one in ``FLIGHTS``; ``length`` is the one in use at first, m."""

FIELD: dict[str, tuple[str, dict[str, Any]]] = {
    "lqr": ("LQR (2011)", {"piloting__controller": "lqr"}),
    "lqr_ga": ("LQR, weights by GA", {"piloting__controller": "lqr_ga"}),
    "mpc": ("MPC (paper)", {}),
    "adaptive_mpc": (
        "adaptive MPC",
        {"piloting__estimate": True, "estimation__estimator": "poses", "piloting__handover": "trusted"},
    ),
    "nonlinear_mpc": ("nonlinear MPC", {"piloting__controller": "nonlinear_mpc"}),
    "mpc_l1": ("MPC with L1", {"piloting__controller": "mpc_l1"}),
    "offset_free_mpc": ("offset-free MPC", {"piloting__controller": "offset_free_mpc"}),
    "geometric": ("geometric, observer", {"piloting__controller": "geometric"}),
}
"""Every controller by name: how figure and table call it, and its parameters."""

TRUE_LENGTH = 1.0
LENGTHS = (0.6, 0.8, 1.0, 1.1, 1.2, 1.3, 1.4, 1.5, 1.6, 1.8)
SEEDS = 20
FEW_SEEDS, FEW_LENGTHS = 2, (1.0, 1.4, 1.6)
"""Of the nonlinear MPC, which takes some hundred times as long."""
PUSHED, HINDERED, SETTLED = 8.0, 2.0, 5.0
"""When the push and the hindered rotor come; when the beginning of a flight is over, s."""
CALM = 0.02
"""A rod has settled when neither |a| nor |b| exceeds this any more, m."""

_PUSH = (Push(PUSHED, (0.008, 0.0)),)
FLIGHTS: dict[str, tuple[float, float, dict[str, Any], dict[str, Any]]] = {
    "pushed": (12.0, SETTLED, {"pushes": _PUSH}, {}),
    "circle": (10.0, SETTLED, {"reference": Circle(0.4, 8.0, start=0.0)}, {}),
    "rotor": (6.0, HINDERED, {}, {"simulation__rotor_loss": 0.2, "simulation__rotor_loss_start": HINDERED}),
    "wind": (20.0, 15.0, {}, {"simulation__wind": (2.0, 0.0)}),
    "gusts": (9.0, SETTLED, {}, {"simulation__gusts": 1.0}),
    "seat": (12.0, SETTLED, {"pushes": _PUSH}, {"piloting__seat_height": 0.0}),
}
"""Of every flight: how long it is and from when on its error is judged, s; what of the scenario differs from a hover,
and what of the parameters."""


def seeds(controller: str) -> range:
    """Return the seeds that a controller flies."""
    return range(FEW_SEEDS if controller == "nonlinear_mpc" else SEEDS)


def lengths(controller: str) -> list[float]:
    """Return the lengths in use with which a controller flies the pushed flight."""
    if controller == "nonlinear_mpc":
        return list(FEW_LENGTHS)
    return list(dict.fromkeys(flown_with(controller, length) for length in LENGTHS))


def flown_with(controller: str, length: float) -> float:
    """Return the length, m, with which a flight is flown that stands for one with this length in use at first.

    The adaptive MPC starts from its shortest rod to expect; any length among those to expect gives the same flight.
    """
    low, high = Params().piloting.rod_lengths
    return TRUE_LENGTH if controller == "adaptive_mpc" and low <= length <= high else length


def cases() -> list[dict]:
    """Every flight with the true length in use, the pushed one with all, for every controller and seed."""
    others = [(flight, TRUE_LENGTH) for flight in FLIGHTS if flight != "pushed"]
    found = []
    for controller in FIELD:
        pushed = [("pushed", length) for length in lengths(controller)]
        for (flight, length), seed in itertools.product(pushed + others, seeds(controller)):
            found.append(dict(zip(KEYS, (controller, flight, length, seed), strict=True)))
    return found


def run(case: dict) -> dict[str, float | int]:
    """Fly one case.

    Returns:
        survived (1 or 0, the whole flight); hovered (1 or 0, until ``PUSHED`` or the end); flown (s until a fall). Of
        flights that stay up, nan of others: lean (largest |a| or |b| from 1 s on, m); settled (s from the push until
        the rod stays within ``CALM``; nan where it does not, or is not pushed); rate (RMS of the two commanded body
        rates from 2 s to ``SETTLED``, deg/s); error (RMS distance from the reference, see ``FLIGHTS``, m); sunk
        (largest deviation of the height from 1 s on, m).
    """
    seconds, judged, scene, changes = FLIGHTS[case["flight"]]
    params = Params().replace(
        pendulum__length=TRUE_LENGTH,
        piloting__initial_length=case["length"],
        **FIELD[case["controller"]][1],
        **changes,
    )
    scene = {"reference": Hover()} | scene
    scenario = Scenario("field", "", seconds, params=params, seed=70_000 + int(case["seed"]), **scene)
    [flight] = fly_many([scenario])
    flown = seconds_flown(flight, scenario)
    outcome = {"survived": int(flight.survived), "hovered": int(flown >= min(PUSHED, seconds)), "flown": flown}
    return outcome | (_scores(flight, scenario, judged) if flight.survived else dict.fromkeys(SCORES, math.nan))


SCORES = ("lean", "settled", "rate", "error", "sunk")
"""The columns of a flight that stays up."""


def _scores(flight: Flight, scenario: Scenario, judged: float) -> dict[str, float]:
    truth, time = flight.truth_state.values, flight.time(flight.truth_state)
    lean = np.abs(truth[:, [A, B]]).max(axis=1)
    off = np.hypot(*(truth[:, [X, Y]] - scenario.reference.at(time)[:, [X, Y]]).T)
    commanded = flight.time(flight.command)
    rates = flight.command.values[(commanded >= 2.0) & (commanded < SETTLED), :2]
    # the seat stands where the pilot takes it to be at the reference's height
    height = scenario.reference.height - (scenario.params.piloting.seat_height - scenario.params.seat_above_tracked)
    settled = math.nan
    if scenario.pushes and lean[-1] <= CALM:
        settled = float(time[(lean > CALM) & (time >= PUSHED)].max(initial=PUSHED)) - PUSHED
    values = (
        float(lean[time >= 1.0].max()),
        settled,
        float(np.degrees(np.sqrt(np.mean(rates**2)))),
        float(np.sqrt(np.mean(off[time >= judged] ** 2))),
        float(np.abs(truth[time >= 1.0, 10] - height).max()),
    )
    return dict(zip(SCORES, values, strict=True))


def _rows(rows: Rows, controller: str, flight: str, length: float = TRUE_LENGTH) -> Rows:
    return [row for row in rows if (row["controller"], row["flight"], row["length"]) == (controller, flight, length)]


def share(rows: Rows, controller: str, flight: str, length: float = TRUE_LENGTH, column: str = "survived") -> Any:
    """Return the flights that stay up, how many there are, and the 95 % interval of the share; nan of none."""
    up = [int(row[column]) for row in _rows(rows, controller, flight, flown_with(controller, length))]
    if not up:
        return 0, 0, math.nan, math.nan
    return sum(up), len(up), *binomial_interval(sum(up), len(up))


def surviving(rows: Rows, controller: str, column: str = "survived") -> list[float]:
    """Return the lengths in use with which most flights stay up: the interval lies above one half."""
    return [length for length in LENGTHS if share(rows, controller, "pushed", length, column)[2] > 0.5]


def mean(rows: Rows, controller: str, flight: str, column: str) -> tuple[float, float, float]:
    """Return the mean of a score over the flights that stay up, and its 95 % interval (bootstrap); nan of none."""
    values = np.array([row[column] for row in _rows(rows, controller, flight)], dtype=float)
    values = values[np.isfinite(values)]
    if not len(values):
        return math.nan, math.nan, math.nan
    resampled = np.random.default_rng(0).choice(values, size=(2000, len(values))).mean(axis=1)
    return float(values.mean()), *map(float, np.percentile(resampled, [2.5, 97.5]))


SCORED = (
    ("pushed", "rate", 1.0, "RMS rates in hover (deg/s)", 1),
    ("pushed", "lean", 100.0, "Lean after the push (cm)", 1),
    ("pushed", "settled", 1.0, "Settled after (s)", 2),
    ("circle", "error", 1000.0, "Error on the circle (mm)", 0),
    ("wind", "error", 1000.0, "Offset after 15 s of wind (mm)", 0),
    ("gusts", "error", 1000.0, "Error in gusts (mm)", 0),
    ("rotor", "sunk", 1000.0, "Height lost, hindered (mm)", 0),
)
"""Flight, column, factor, name and decimals of the scores in the table."""


def table18_field(rows: Rows, ticks: Quantities) -> Table:
    """Table 18: a column for each controller: who stays up, how well, and how long a tick takes.

    20 simulated flights of each kind, 2 of the nonlinear MPC, with the same plant, noise and seeds: a uniform rod of
    1 m on a seat of 8 cm. Means with half their 95 % intervals; a length in use survives where most flights do. A
    tick: median and 99th percentile of one call, measured on one machine.
    """
    lines = []
    for column, name in (("hovered", f"Lengths up, hover {PUSHED:g} s (m)"), ("survived", "And after a push (m)")):
        lines.append((name, *(_span(surviving(rows, controller, column)) for controller in FIELD)))
    for flight, name in (("circle", "circle"), ("rotor", "hindered rotor"), ("wind", "wind"), ("gusts", "gusts")):
        cells = (share(rows, controller, flight) for controller in FIELD)
        lines.append((f"Up, {name}", *(f"{up}/{count}" for up, count, _, _ in cells)))
    cells = (share(rows, controller, "seat") for controller in FIELD)
    lines.append(("Up after a push, seat unknown", *(f"{up}/{count}" for up, count, _, _ in cells)))
    for flight, column, factor, name, decimals in SCORED:
        found = (mean(rows, controller, flight, column) for controller in FIELD)
        lines.append((name, *(_interval(*(factor * value for value in one), decimals) for one in found)))
    for quantile in ("p50", "p99"):
        times = (ticks.get(f"{controller}_{quantile}_us", math.nan) for controller in FIELD)
        lines.append((f"A tick, {quantile} (us)", *(number(time, 0) if time == time else NONE for time in times)))
    return Table(("", *(label for label, _ in FIELD.values())), lines, "l" + "r" * len(FIELD))


def _span(lengths: list[float]) -> str:
    """The first and the last of lengths as a cell."""
    return f"{lengths[0]:.1f}--{lengths[-1]:.1f}" if lengths else NONE


def _interval(value: float, low: float, high: float, decimals: int) -> str:
    """A mean and half its interval as a cell."""
    if not math.isfinite(value):
        return NONE
    return rf"{value:.{decimals}f} $\pm$ {(high - low) / 2:.{decimals}f}"


def fig21_field(rows: Rows) -> Figure:
    """Fig. 21: the controllers on the same plant, noise and seeds: with which lengths they survive, and how well.

    20 simulated flights at each point, 2 of the nonlinear MPC, a uniform rod of 1 m on a seat of 8 cm. Above: the
    percentage that stays up after a push of 8 mN s in hover, by the length in use; blank: not flown. Below: RMS rate
    command in hover, RMS error on the 0.4 m circle (8 s), and distance from the place after 15 s of a steady wind of
    2 m/s; means with 95 % intervals. What widens the range of lengths costs commands, not error; only those that
    estimate a disturbance stand still in wind.
    """
    figure = Figure(figsize=(COLUMN, 4.4), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=(1.15, 1.0))
    axes, labels = above.subplots(), [label for label, _ in FIELD.values()]
    _shares(axes, rows)
    axes.set_yticks(range(len(FIELD)), labels)
    panels = below.subplots(1, 3, sharey=True)
    shown = (("pushed", "rate", 1.0, "rates (deg/s)"), ("circle", "error", 1e3, "circle (mm)"),
             ("wind", "error", 1e3, "wind (mm)"))  # fmt: skip
    for axes, (flight, column, factor, name) in zip(panels, shown, strict=True):
        for place, controller in enumerate(FIELD):
            value, low, high = (factor * one for one in mean(rows, controller, flight, column))
            spread = [[value - low], [high - value]]
            axes.errorbar(value, place, xerr=spread, color=BLUE, marker="o", ms=3, elinewidth=0.8, ls="none")
        axes.margins(x=0.1)
        axes.set(xlabel=name, ylim=(len(FIELD) - 0.5, -0.5))
        axes.set_xlim(left=0.0)
        axes.grid(axis="y", lw=0.3, color=GREY, alpha=0.4)
        axes.tick_params(axis="y", length=0)
    panels[0].set_yticks(range(len(FIELD)), labels)
    origin(figure, f"simulated flights, 1 m rod, {SEEDS} seeds ({FEW_SEEDS} of the nonlinear MPC)")
    return figure


def _shares(axes: Axes, rows: Rows) -> None:
    """The percentage of flights that stay up after the push, by controller and length in use."""
    found = [[share(rows, controller, "pushed", length) for length in LENGTHS] for controller in FIELD]
    part = np.array([[up / count if count else math.nan for up, count, _, _ in line] for line in found])
    axes.imshow(part, cmap="Blues", vmin=0.0, vmax=1.5, aspect="auto")
    for (place, index), value in np.ndenumerate(part):
        words = f"{100 * value:.0f}" if math.isfinite(value) else ""
        axes.text(index, place, words, ha="center", va="center", fontsize=6)
    axes.axvline(LENGTHS.index(TRUE_LENGTH) - 0.5, color="black", lw=0.6, ls="--")
    axes.axvline(LENGTHS.index(TRUE_LENGTH) + 0.5, color="black", lw=0.6, ls="--")
    axes.set_xticks(range(len(LENGTHS)), [f"{length:.1f}" for length in LENGTHS])
    axes.set(xlabel="length used (m)", title="flights that stay up after a push (%)")
    axes.tick_params(length=0)


def facts(rows: Rows) -> Facts:
    """Return what the report states of the field."""
    found: Facts = {("seeds",): f"{SEEDS}", ("few", "seeds"): f"{FEW_SEEDS}", ("controllers",): f"{len(FIELD)}"}
    for controller in FIELD:
        words = tuple(controller.replace("l1", "lone").split("_"))
        for flight, column, factor, _, decimals in SCORED:
            value, low, high = (factor * one for one in mean(rows, controller, flight, column))
            found[*words, flight, column] = number(value, decimals)
            found[*words, flight, column, "low"] = number(low, decimals)
            found[*words, flight, column, "high"] = number(high, decimals)
        for flight in FLIGHTS:
            kept, flown, low, high = share(rows, controller, flight)
            found |= {(*words, flight, "up"): f"{kept}", (*words, flight, "flown"): f"{flown}"}
            found |= {
                (*words, flight, "up", "low"): f"{100 * low:.0f}",
                (*words, flight, "up", "high"): f"{100 * high:.0f}",
            }
        up = surviving(rows, controller)
        found[*words, "shortest"], found[*words, "longest"] = (f"{up[0]:g}", f"{up[-1]:g}") if up else (NONE, NONE)
    return found
