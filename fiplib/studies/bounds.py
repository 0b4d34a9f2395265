"""The Cramer-Rao bound of the length over window, excitation, noise, inertia and what else is known (docs/studies.md).

A case is one flight with the true length in use; its row has the bound for windows of ``WINDOWS`` seconds, root mean
square over windows that begin at ``STARTS``. What is drawn or stated is flown with every one of ``SEEDS``, all other
cases with the first of them. ``knowledge``:

- ``plant known``: all but the state and the length;
- ``calibration unknown``: four constants, where markers and body frame sit, as well (``cramer_rao.CALIBRATION``);
- ``inertia and lag unknown``: these two as well;
- ``height measured``: motion capture reports the height of the pendulum's centre of mass too.

156 rows, about 5 minutes of one core.
"""

import itertools
import math
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from fiplib.estimators.cramer_rao import CALIBRATION, cramer_rao, motion
from fiplib.params import NANO
from fiplib.reproduction.sources import Rows
from fiplib.reproduction.style import BLUE, COLUMN, GREEN, GREY, ORANGE, PURPLE, origin
from fiplib.reproduction.tables import Facts
from fiplib.studies.landscapes import EXCITATIONS, RODS, flown

KEYS = ("excitation", "rod", "noise", "knowledge", "seed")

SEEDS = range(1, 6)
"""The grid of cases is flown with the first, what is drawn or stated with all."""

USUAL = {"excitation": "circle 0.4 m / 8 s", "rod": "uniform", "noise": "default", "knowledge": "plant known"}

STATED = {
    "usual": {},
    "hover": {"excitation": "hover"},
    "fast": {"excitation": "circle 0.4 m / 5 s"},
    "large": {"excitation": "circle 0.8 m / 9 s"},
    "positions": {"noise": "positions x 5"},
    "attitude": {"noise": "attitude x 5"},
    "calibration": {"knowledge": "calibration unknown"},
    "unknown": {"knowledge": "inertia and lag unknown"},
    "height": {"knowledge": "height measured"},
}
"""What is drawn or stated, by what differs from ``USUAL``."""

NOISES = {"default": (1.0, 1.0), "positions x 5": (5.0, 1.0), "attitude x 5": (1.0, 5.0)}
"""Factors on the noise of motion capture: of positions, of attitude."""

KNOWLEDGE = {
    "plant known": ((), False),
    "calibration unknown": ((CALIBRATION,), False),
    "inertia and lag unknown": (("inertia_factor", "rate_lag"), False),
    "height measured": ((), True),
}
"""Arguments of ``cramer_rao.cramer_rao``: nuisances, and whether the height is measured."""

WINDOWS = (0.25, 0.5, 1.0, 2.5, 5.5, 10.0)
STARTS = (6.0, 8.0, 10.0)
"""s of the flight at which windows begin: at full speed, in three phases of the circle."""


def cases() -> list[dict]:
    """Every excitation and rod, with every noise and state of knowledge, and what is ``STATED`` with more seeds."""
    first, *others = SEEDS
    grid = itertools.product(EXCITATIONS, RODS, NOISES, KNOWLEDGE, (first,))
    found = [dict(zip(KEYS, values, strict=True)) for values in grid]
    return found + [USUAL | changes | {"seed": seed} for changes in STATED.values() for seed in others]


def run(case: dict) -> dict[str, float]:
    """Return the bounds of one case.

    Returns:
        ``bound_SECONDS``: the bound in m for a window of so many seconds.
    """
    flight = flown(case["excitation"], RODS[case["rod"]], case["seed"], math.ceil(max(STARTS) + max(WINDOWS)) + 1.0)
    position, attitude = NOISES[case["noise"]]
    params = flight.params.replace(
        simulation__position_noise=position * flight.params.simulation.position_noise,
        simulation__attitude_noise=attitude * flight.params.simulation.attitude_noise,
    )
    bounds = []
    for start in STARTS:
        begin = flight.start_ns + round(start * NANO)
        path = motion(flight, begin, begin + round(max(WINDOWS) * NANO))
        found = cramer_rao(path, params, *KNOWLEDGE[case["knowledge"]])
        bounds.append([found[min(round(seconds / path.period), len(found) - 1)] for seconds in WINDOWS])
    means = np.sqrt(np.mean(np.square(bounds), axis=0))
    return {f"bound_{seconds:g}": float(mean) for seconds, mean in zip(WINDOWS, means, strict=True)}


def _bounds(rows: Rows, name: str, windows: Sequence[float]) -> NDArray:
    """Return the bounds in m of a ``STATED`` case by seed and window."""
    found = [row for row in rows if (USUAL | STATED[name]).items() <= row.items()]
    return np.array([[row[f"bound_{seconds:g}"] for seconds in windows] for row in found])


def _mean(bounds: NDArray) -> NDArray:
    """Return the root mean square over seeds, of bounds by seed and window."""
    return np.sqrt(np.mean(np.square(bounds), axis=0))


def fig12_bound(rows: Rows) -> Figure:
    """Fig. 12: the Cramer-Rao bound of the length over the span of the window, from raw motion capture.

    Uniform rod of 1 m, RMS over 3 windows of each of 5 simulated flights; bands: the smallest and the largest bound of
    the five. It is computed from the motion, not from noise. Left: by the reference flown, left legend: radius and time
    of a lap. Right: the 0.4 m circle (8 s) with noise five times as large, or with more unknowns. Grey: 1 cm. A circle
    at speed gives a centimetre within a second, hover takes two to three times as long; in short windows unknown
    positions of the markers cost most.
    """
    figure = Figure(figsize=(COLUMN, 3.5), layout="constrained")
    # curves fill the panels: their names have a row of their own
    panels, names = figure.subplots(2, 2, sharex="row", sharey="row", height_ratios=(2.6, 1.0))
    windows = [float(name.removeprefix("bound_")) for name in rows[0] if name.startswith("bound_")]
    curves = (
        (0, "usual", "0.4 m, 8 s", BLUE, "-"),
        (0, "fast", "0.4 m, 5 s", GREEN, "--"),
        (0, "large", "0.8 m, 9 s", PURPLE, "-."),
        (0, "hover", "hover", ORANGE, ":"),
        (1, "usual", "as on the left", BLUE, "-"),
        (1, "positions", r"positions $\times 5$", ORANGE, ":"),
        (1, "attitude", r"attitude $\times 5$", PURPLE, "-."),
        (1, "unknown", "inertia, lag unknown", GREEN, "--"),
        (1, "calibration", "calibration unknown", "black", (0, (6, 1.5))),
    )
    for panel, name, label, colour, dashes in curves:
        bounds = 1e3 * _bounds(rows, name, windows)
        panels[panel].loglog(windows, _mean(bounds), ls=dashes, color=colour, label=label)
        panels[panel].fill_between(windows, bounds.min(axis=0), bounds.max(axis=0), color=colour, alpha=0.25, lw=0)
    for axes, below in zip(panels, names, strict=True):
        axes.axhline(10.0, color=GREY, lw=0.6)
        axes.set(xlabel="window (s)", xticks=(0.25, 1, 2.5, 10), xticklabels=("0.25", "1", "2.5", "10"))
        axes.minorticks_off()
        below.axis("off")
        below.legend(*axes.get_legend_handles_labels(), loc="upper center", handlelength=2.4, borderaxespad=0.0)
    panels[0].set(ylabel="bound on the length (mm)", ylim=(0.2, 1e4))
    panels[0].set_title("excitation")
    panels[1].set_title("noise, knowledge")
    origin(figure, "simulated flights, uniform rod of 1 m; grey: 1 cm")
    return figure


def facts(rows: Rows) -> Facts:
    """Return the bounds in windows of 2.5 s, root mean square over seeds, mm, that the report states."""
    return {(name,): f"{1e3 * _mean(_bounds(rows, name, (2.5,)))[0]:.2g}" for name in STATED if name != "large"}
