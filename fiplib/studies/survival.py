"""Where does the MPC survive a wrong length? Linear stability and simulated survival, side by side.

A case is a length that the MPC uses, the rod's true length and its inertia. A row has what linear theory says of the
loop (``margins``: delay and lag included, bounds and noise not) and what becomes of flights on the 0.4 m circle.

**Why too short flies and too long falls.** Numbers are for a true length of 1 m, of a uniform rod first, of a point
mass in brackets.

The MPC believes that the rod falls with sqrt(2 g / l), and answers a accordingly: relative to the gain at l = 1 m, K_a
is 3.5 at l = 0.2 m, 1.9 at 0.4 m, 0.83 at 1.4 m, 0.70 at 2 m. The gain of s' goes the other way, from 0.47 at 0.2 m to
1.33 at 2 m; that of the tilt hardly moves (1.26 to 0.95). How much of a wrong K_a and K_a' does the loop bear, all else
left as it is (``pendulum_low``, ``pendulum_high``)? At l = 1 m from 0.82 to 2.1 times (0.73 to 1.6), and these edges
are of two kinds:

- *Too much* ends in a fast oscillation, at 15 rad/s, that the delay makes: without it the edge is at 3.3 (2.5), and no
  length here is too short. A short l raises K_a but also K_a', K_tilt, which damp, and lowers the gains of s and s',
  which upset the rod; so the loop stays stable down to 0.2 m (0.3 m), far beyond what a larger K_a alone would allow.
  What it costs is delay margin: 52 ms (31 ms) at l = 1 m, 30 ms (10 ms) at 0.4 m, 4 ms (none) at 0.2 m. With a few ms
  left, noise and the bound on the rates end the flight within 2 to 4 s.
- *Too little* ends in a slow oscillation, at 3.6 rad/s, that has nothing to do with delay: without it the edge is in
  the same place. To move the vehicle, the MPC must first lean the rod against the motion; what s and s' ask for upsets
  the rod, and K_a must take it up. With the gains of s and s' ten times smaller the edge is at 0.50 (0.49) instead of
  0.82 (0.73): half is what holds the rod, the rest is what position control costs. With a long l, K_a falls and the
  gains of s and s' rise, and both go towards this edge. Inertia brings it nearer: the rod answers the seat's motion
  less (lambda = 3/4), position control asks for as much. So a uniform rod is unstable from l = 1.6 m on, a point mass
  not even at 2 m; but slowly: the oscillation grows by 0.04 1/s at 1.6 m, by 0.47 1/s at 2 m.

So the short side has the wider range in relative terms, l / true length from 0.2-0.3 to 1.5-2, and a sharp end; the
long side fades. Weights decide how near the long edge is. With unit weights (Q = I, R = 1) the low edge is at 0.89
(0.82), K_a is down to 0.74 at l = 1.4 m, and all from 1.2 m (1.4 m) on is unstable. Heavy weights on a and a' (ours)
move the edge away, at the price of delay margin: 81 ms (56 ms) with unit weights, 52 ms (31 ms) with ours.

190 rows, about 5 minutes of one core.
"""

import itertools

import numpy as np
from matplotlib.figure import Figure

from fiplib.controllers import margins
from fiplib.params import A, B, Params
from fiplib.pilot import Circle
from fiplib.reproduction.sources import Rows
from fiplib.reproduction.style import COLUMN, origin
from fiplib.simulate import Scenario, fly
from fiplib.studies import seconds_flown

KEYS = ("used_length", "true_length", "rod")
"""Lengths in m; ``rod`` is a name in ``RODS``."""

USED_LENGTHS = tuple(tenths / 10 for tenths in range(2, 21))
TRUE_LENGTHS = (0.5, 0.75, 1.0, 1.25, 1.5)
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
    flights = [fly(scenario) for scenario in scenarios]
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
    """Fig. 7: where the MPC survives a wrong length: growth rate and delay margin of the linear loop, seconds flown."""
    figure = Figure(figsize=(COLUMN, 4.6), layout="constrained")
    panels = figure.subplots(3, 2, sharex=True, sharey=True)
    used = sorted({row["used_length"] for row in rows})
    true = sorted({row["true_length"] for row in rows})
    # column of the table, factor to the unit shown, label, colours
    quantities = (
        ("growth_rate", 1.0, "growth rate (1/s)", {"cmap": "RdBu_r", "vmin": -2, "vmax": 2}),
        ("delay_margin", 1e3, "delay margin (ms)", {"cmap": "cividis", "vmin": 0}),
        ("flown", 1.0, "flown, of 12 s (s)", {"cmap": "cividis"}),
    )
    for line, (name, factor, label, colours) in zip(panels, quantities, strict=True):
        for axes, rod in zip(line, ("uniform", "point mass"), strict=True):
            cells = {(row["true_length"], row["used_length"]): row[name] for row in rows if row["rod"] == rod}
            values = factor * np.array([[cells[y, x] for x in used] for y in true])
            colours["vmax"] = colours.get("vmax", factor * max(row[name] for row in rows))
            mesh = axes.pcolormesh(used, true, values, shading="nearest", rasterized=True, **colours)
            axes.plot(true, true, color="black" if name == "growth_rate" else "white", lw=0.8, ls="--")
        line[0].set_ylabel("true length (m)")
        figure.colorbar(mesh, ax=line, label=label, aspect=12)
    for axes, rod in zip(panels[0], ("uniform rod", "point mass"), strict=True):
        axes.set(title=rod, xticks=(0.5, 1.0, 1.5, 2.0))
    figure.supxlabel("length used (m)", fontsize="medium")
    origin(figure, "linear theory (two rows), simulated flights; dashed: lengths agree")
    return figure
