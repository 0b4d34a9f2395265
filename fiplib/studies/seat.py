"""The pilot's knowledge of its seat: rods on a seat 8 cm above the tracked frame, known rightly, wrongly or not.

A case is a flight (a hover with pushes, or the 0.4 m circle), a uniform rod whose length the pilot knows, the height at
which its seat really is above the vehicle's tracked frame, and the height that the pilot takes it to be. The seat at
the frame itself, as in the paper's model, is the standard of comparison. Every case flies with the same ``SEEDS``.
``growth_rate`` and ``gain_high`` are those of the linear loop (``controllers.margins``). About 4 minutes of one core.
"""

import math

import numpy as np
from matplotlib.figure import Figure

from fiplib.controllers import margins
from fiplib.params import A, B, Params, X, Y
from fiplib.recording import Flight
from fiplib.references import Circle, Hover
from fiplib.reproduction.measures import binomial_interval, quantile_interval, rms
from fiplib.reproduction.sources import Rows
from fiplib.reproduction.style import BLUE, COLUMN, GREEN, GREY, ORANGE, PURPLE, origin
from fiplib.reproduction.tables import NONE, Facts, Table
from fiplib.simulate import Push, Scenario
from fiplib.studies import seconds_flown
from fiplib.studies.batch import fly_many
from fiplib.studies.estimators import ranged

KEYS = ("motion", "length", "seat", "stated")
"""``motion`` is a name in ``MOTIONS``; all others are in m."""

LENGTHS = (0.4, 0.7, 1.0, 1.5)
SEAT = 0.08
STATED = (0.0, 0.04, 0.06, 0.08, 0.10, 0.12)
"""The seat height that the pilot assumes, m; 0: it assumes no raised seat."""

SEEDS = range(20)

SECONDS = 20.0
SETTLED = 8.0
"""Seconds of a flight after which it is on its trajectory: from there on errors are taken."""

PUSHES = (Push(5.3, (0.008, 0.0)), Push(10.0, (0.0, 0.007)), Push(15.0, (-0.005, 0.005)))
MOTIONS = {
    "hover": Scenario("hover with pushes", "", SECONDS, Hover(), pushes=PUSHES),
    "circle": Scenario("circle", "", SECONDS, Circle(radius=0.4, period=8.0)),
}


def cases() -> list[dict]:
    """Every stated height with every rod in both motions, and the seat at the frame, which the pilot knows."""
    seats = [(0.0, 0.0), *((SEAT, stated) for stated in STATED)]
    found = [(motion, length, *heights) for motion in MOTIONS for length in LENGTHS for heights in seats]
    return [dict(zip(KEYS, values, strict=True)) for values in found]


def run(case: dict) -> dict[str, float | int | str]:
    """Fly one case with every seed.

    Returns:
        flown, how many flights, and survived, how many of them stay up; seconds, the median time to the fall or the
        end; of those up, from ``SETTLED`` on: error, rms distance of the seat from its reference, largest_lean, |a| or
        |b| at most, both the median over the flights in m, and rate, rms body rate commanded, rad/s (nan if none is
        up), each with its exact 95 % interval, error_low, error_high and so on (nan of fewer than six flights);
        growth_rate in 1/s and gain_high of the linear loop.
    """
    params = Params().replace(
        pendulum__length=case["length"],
        piloting__initial_length=case["length"],
        vehicle__seat_height=case["seat"],
        piloting__seat_height=case["stated"],
    )
    motion = MOTIONS[case["motion"]]
    scenarios = [Scenario(motion.name, "", SECONDS, motion.reference, motion.pushes, (), params, s) for s in SEEDS]
    flights = list(fly_many(scenarios))
    up = [flight for flight in flights if flight.survived]
    loop = margins.closed_loop(case["length"], params)
    return {
        "flown": len(flights),
        "survived": len(up),
        "seconds": float(np.median([seconds_flown(*pair) for pair in zip(flights, scenarios, strict=True)])),
        **_median("error", [_error(flight, motion) for flight in up]),
        **_median("largest_lean", [float(np.abs(flight.truth_state.values[:, [A, B]]).max()) for flight in up]),
        **_median("rate", [rms(flight.command.values[:, :2]) for flight in up]),
        "growth_rate": loop.growth_rate,
        "gain_high": loop.margins.gain_high,
    }


def _median(name: str, values: list[float]) -> dict[str, float]:
    """Return the median of the values, nan of none, and its interval, by column."""
    low, high = quantile_interval(values)
    return {name: float(np.median(values)) if values else math.nan, f"{name}_low": low, f"{name}_high": high}


def _error(flight: Flight, motion: Scenario) -> float:
    """Return the rms distance, in m, of the true seat from its reference once the flight has settled."""
    times = flight.time(flight.truth_state)
    settled = times >= SETTLED
    away = flight.truth_state.values[settled][:, [X, Y]] - motion.reference.at(times[settled])[:, [X, Y]]
    return rms(np.hypot(*away.T))


def survival(row: dict) -> tuple[float, float, float]:
    """Return the share of a row's flights that stay up, and its exact (Clopper-Pearson) 95 % interval."""
    up, flown = int(row["survived"]), int(row["flown"])
    return up / flown, *binomial_interval(up, flown)


ENDS = ("", "_low", "_high")
"""What is added to a column's name for the median and for the ends of its interval."""

COLOURS = dict(zip(LENGTHS, (ORANGE, PURPLE, BLUE, GREEN), strict=True))
PLACE = -3.0
"""Where a figure puts the seat at the frame, beside the stated heights in cm."""


def fig17_seat(rows: Rows) -> Figure:
    """Fig. 17: rods on a seat 8 cm above the tracked frame, by the height that the pilot is given for it.

    20 simulated flights of 20 s at each point, in hover with three pushes and on the 0.4 m circle (8 s), uniform rods
    whose length is known; dotted: the true height; none (open squares): the seat at the frame. From above: share that
    stays up; of those that stay up the median RMS distance from the reference and the median RMS rate command. Bars:
    exact 95 % intervals, of a median where at least six flights stay up; most of the latter are shorter than their
    markers. Short rods fall when the seat is unknown, and a height that is too large does more harm than one that is
    too small.
    """
    figure = Figure(figsize=(COLUMN, 4.2), layout="constrained")
    panels = figure.subplots(3, 2, sharex=True, sharey="row")
    for axes, motion in zip(panels[0], MOTIONS, strict=True):
        axes.set_title(MOTIONS[motion].name)
    for column, motion in zip(panels.T, MOTIONS, strict=True):
        for shift, length in enumerate(LENGTHS):
            some = [row for row in rows if row["motion"] == motion and row["length"] == length]
            raised = sorted((row for row in some if row["seat"] > 0), key=lambda row: row["stated"])
            frame = [row for row in some if row["seat"] == 0]
            for at, style in ((raised, "o-"), (frame, "s")):
                x = [0.25 * (shift - 1.5) + (100 * row["stated"] if row["seat"] else PLACE) for row in at]
                look = {"ms": 2.5, "lw": 0.7, "color": COLOURS[length], "mfc": "white" if style == "s" else None}
                share, low, high = np.array([survival(row) for row in at]).T
                label = f"$l$ = {length:g} m" if style == "o-" else None
                column[0].errorbar(
                    x, share, (share - low, high - share), fmt=style, elinewidth=0.5, label=label, **look
                )
                for axes, name, factor in ((column[1], "error", 100.0), (column[2], "rate", math.degrees(1.0))):
                    middle, low, high = factor * np.array([[row[name + end] for row in at] for end in ENDS])
                    axes.errorbar(x, middle, (middle - low, high - middle), fmt=style, elinewidth=0.5, **look)
        for axes in column:
            axes.axvline(100 * SEAT, color=GREY, lw=0.5, ls=":")
        column[2].set(
            xticks=(PLACE, 0, 4, 8, 12),
            xticklabels=("none", "0", "4", "8", "12"),
            xlim=(-4, 13),
            xlabel="stated seat (cm)",
        )
    for axes, label in zip(panels[:, 0], ("share that stays up", "rms error (cm)", "rms rate (deg/s)"), strict=True):
        axes.set(ylabel=label, ylim=(0, None))
    panels[1, 0].set(
        yscale="log", ylim=(3, 120), yticks=(5, 10, 20, 50, 100), yticklabels=("5", "10", "20", "50", "100")
    )
    panels[1, 0].minorticks_off()
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    origin(figure, f"{len(SEEDS)} simulated flights each; dotted: true; none: seat at the frame")
    return figure


def _cell(values: list[float]) -> str:
    """Return a cell with a median and its interval, as far as they are known."""
    if not math.isfinite(values[0]):
        return NONE
    return ranged(*values, 1) if np.isfinite(values).all() else f"{values[0]:.1f}"


def table14_seat(rows: Rows) -> Table:
    """Table 14: the pilot's seat height: survival, the error, the largest lean and the rate commands.

    20 simulated flights of 20 s in each cell, in hover with three pushes and on the 0.4 m circle (8 s); behind the
    number that stays up its exact 95 % interval in per cent. RMS error, largest lean and RMS rate command are medians
    over the flights that stay up, in brackets their exact 95 % intervals where at least six do. Gain margin: the upper
    one of the linear loop, none where it is unstable.
    """
    lines = []
    for length in LENGTHS:
        for seat, stated in ((0.0, 0.0), *((SEAT, stated) for stated in STATED)):
            cells = [f"{length:g}", f"{100 * seat:g}", f"{100 * stated:g}"]
            at = {
                row["motion"]: row
                for row in rows
                if (row["length"], row["seat"], row["stated"]) == (length, seat, stated)
            }
            for motion in MOTIONS:
                row = at[motion]
                _, low, high = survival(row)
                cells.append(f"{row['survived']:.0f} ({100 * low:.0f} to {100 * high:.0f})")
                for name, factor in (("error", 100.0), ("largest_lean", 100.0), ("rate", math.degrees(1.0))):
                    cells.append(_cell([factor * row[name + end] for end in ENDS]))
            cells.append(f"{row['gain_high']:.2f}" if row["growth_rate"] < 0 else NONE)
            lines.append(tuple(cells))
    each = tuple(
        f"{motion}: {what}"
        for motion in ("Pushes", "Circle")
        for what in (f"up of {len(SEEDS)} (95\\,\\%)", "error (cm)", "lean (cm)", "rate (deg/s)")
    )
    header = ("$l$ (m)", "Seat (cm)", "Stated (cm)", *each, "Gain margin")
    return Table(header, lines, "rrr" + "rrrr" * len(MOTIONS) + "r")


def _row(rows: Rows, *case: str | float) -> dict:
    """Return the row of a case, given in the order of ``KEYS``."""
    return next(row for row in rows if tuple(row[key] for key in KEYS) == case)


def facts(rows: Rows) -> Facts:
    """Return what the report states: survival and seconds flown by rod, seat known and not, over both motions."""
    found: Facts = {}
    for length, word in zip(LENGTHS, ("shortest", "short", "middle", "longest"), strict=True):
        for stated, knowledge in ((SEAT, "known"), (0.0, "unknown")):
            some = [_row(rows, motion, length, SEAT, stated) for motion in MOTIONS]
            up = sum(int(row["survived"]) for row in some)
            low, high = binomial_interval(up, len(MOTIONS) * len(SEEDS))
            found[word, knowledge, "up"] = f"{up}"
            found[word, knowledge, "low"], found[word, knowledge, "high"] = f"{100 * low:.0f}", f"{100 * high:.0f}"
            found[word, knowledge, "seconds"] = f"{min(row['seconds'] for row in some):.1f}"
    return found | {("flights",): f"{len(MOTIONS) * len(SEEDS)}"}
