"""The wrong lengths with which the rod stays up: linear stability and simulated survival, side by side.

A case is a length that the MPC uses, the rod's true length and its inertia. A row has what linear theory says of the
loop (``margins``: delay and lag included, bounds and noise not) and the outcome of flights on the 0.4 m circle. The
reason why the rod stays up with too short a length and falls with too long a one is in docs/studies.md. 666 rows, about
a minute of one core.
"""

import itertools

import numpy as np
from matplotlib.figure import Figure

from fiplib.controllers import margins
from fiplib.params import A, B, Params
from fiplib.references import Circle
from fiplib.reproduction.sources import Rows
from fiplib.reproduction.style import COLUMN, origin
from fiplib.simulate import Scenario
from fiplib.studies import seconds_flown
from fiplib.studies.batch import fly_many

KEYS = ("used_length", "true_length", "rod")
"""Lengths in m; ``rod`` is a name in ``RODS``."""

USED_LENGTHS = tuple(twentieths / 20 for twentieths in range(4, 41))
TRUE_LENGTHS = tuple(eighths / 8 for eighths in range(4, 13))
RODS = {"point mass": 0.0, "uniform": 1.0 / 12.0}
"""k^2/l^2 of the rod that is flown; the MPC has none."""

SECONDS = 12.0
"""A flight's length: the paper flew a wrong length for about as long before it had converged."""

SEEDS = (1, 2)
CIRCLE = Circle(radius=0.4, period=8.0)


def cases() -> list[dict]:
    """Every length used with every rod."""
    return [dict(zip(KEYS, values, strict=True)) for values in itertools.product(USED_LENGTHS, TRUE_LENGTHS, RODS)]


def run(case: dict) -> dict[str, float | int | str]:
    """Stability and survival of one case.

    Returns:
        growth_rate (1/s) and frequency (rad/s) of the slowest decaying or fastest growing mode; gain_low, gain_high,
        delay_margin (s), disk_margin as in ``margins.Margins``; pendulum_low, pendulum_high as in
        ``LinearLoop.pendulum_share``; offset_gain K_a (rad/s per m); survived (flights of ``SEEDS``), flown (shortest
        flight, s) and largest_lean (|a| or |b| at most, m).
    """
    params = Params().replace(
        pendulum__length=case["true_length"],
        pendulum__gyration_ratio=RODS[case["rod"]],
        piloting__initial_length=case["used_length"],
    )
    loop = margins.closed_loop(case["used_length"], params)
    low, high = loop.pendulum_share()
    scenarios = [Scenario("survival", "", SECONDS, CIRCLE, params=params, seed=seed) for seed in SEEDS]
    flights = list(fly_many(scenarios))
    return {
        "growth_rate": loop.growth_rate,
        "frequency": loop.frequency,
        "gain_low": loop.margins.gain_low,
        "gain_high": loop.margins.gain_high,
        "delay_margin": loop.margins.delay,
        "disk_margin": loop.margins.disk,
        "pendulum_low": low,
        "pendulum_high": high,
        "offset_gain": float(-loop.gain[2]),
        "survived": sum(flight.survived for flight in flights),
        "flown": min(map(seconds_flown, flights, scenarios)),
        "largest_lean": max(float(np.abs(flight.truth_state.values[:, [A, B]]).max()) for flight in flights),
    }


def fig7_survival(rows: Rows) -> Figure:
    """Fig. 7: survival with a wrong length: linear theory, and simulated flights of 12 s on the 0.4 m circle.

    From above: growth rate of the linear loop (blue: stable), its delay margin (none where it is unstable), and the
    shorter of 2 simulated flights, seeds 1 and 2, at each of 333 pairs of lengths; two flights give no
    share, but neighbouring points agree. Dashed: the two lengths agree; solid: the border of linear stability on the
    long side. Rods fall where the length in use is far too long, a little beyond that border, as the oscillation needs
    time to grow; no rod falls with a length that is too short, not even where the delay margin is gone.
    """
    figure = Figure(figsize=(COLUMN, 4.6), layout="constrained")
    panels = figure.subplots(3, 2, sharex=True, sharey=True)
    used = sorted({row["used_length"] for row in rows})
    true = sorted({row["true_length"] for row in rows})
    # column of the table, factor to the unit shown, label, colours
    quantities = (
        ("growth_rate", 1.0, "growth rate (1/s)", {"cmap": "RdBu_r", "vmin": -2, "vmax": 2}),
        ("delay_margin", 1e3, "delay margin (ms)", {"cmap": "cividis", "vmin": 0}),
        ("flown", 1.0, "flown, of 12 s (s)", {"cmap": "cividis", "vmin": 0}),
    )
    for line, (name, factor, label, colours) in zip(panels, quantities, strict=True):
        for axes, rod in zip(line, ("uniform", "point mass"), strict=True):
            cells = {(row["true_length"], row["used_length"]): row for row in rows if row["rod"] == rod}
            values, growth = (
                np.array([[cells[y, x][column] for x in used] for y in true]) for column in (name, "growth_rate")
            )
            colours["vmax"] = colours.get("vmax", factor * max(row[name] for row in rows))
            mesh = axes.pcolormesh(used, true, factor * values, shading="nearest", rasterized=True, **colours)
            growth[np.less_equal(used, np.reshape(true, (-1, 1)))] = -1.0  # the border on the long side only
            for colour, more in (("white", 1.0), ("black", 0.0)):  # seen on dark and on light
                axes.plot(true, true, color=colour, lw=0.8 + more, ls="--" if more == 0.0 else "-")
                axes.contour(used, true, growth, levels=[0.0], colors=colour, linewidths=0.7 + more)
        line[0].set_ylabel("true length (m)")
        figure.colorbar(mesh, ax=line, label=label, aspect=12)
    for axes, rod in zip(panels[0], ("uniform rod", "point mass"), strict=True):
        axes.set(title=rod, xticks=(0.5, 1.0, 1.5, 2.0))
    figure.supxlabel("length used (m)", fontsize="medium")
    origin(figure, f"linear theory (two rows); {len(SEEDS)} simulated flights a point")
    return figure
