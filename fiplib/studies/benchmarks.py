"""The measured times of ``benchmarks/``: figure 13 and table 10."""

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from fiplib.reproduction.sources import Quantities
from fiplib.reproduction.style import BLUE, COLUMN, GREEN, GREY, ORANGE, origin
from fiplib.reproduction.tables import Table


def fig13_deadlines(found: Quantities) -> Figure:
    """Fig. 13: how late ticks are and how long their answers take, beside how late the machine is by itself."""
    figure = Figure(figsize=(COLUMN, 2.7), layout="constrained")
    axes = figure.subplots()
    for kind, colour, dashes, label in (
        ("lateness", ORANGE, "-", "lateness of the tick"),
        ("solve", GREEN, "-", "solve of the MPC"),
        ("answer", BLUE, "-", "frame to command"),
        ("machine", GREY, "--", "lateness of an idle process"),
    ):
        axes.plot(*_longer(found, kind), dashes, color=colour, label=label, drawstyle="steps-post")
    tick = found["tick_us"] / 1e3
    axes.axvline(tick, color="black", lw=0.6)
    missed = {"our code": "ours", "the machine": "machine", "unexplained": "unexplained"}
    words = [f"{found['ticks']:.0f} ticks of {tick:.2f} ms", "missed:"]
    words += [f"{found[f'missed_{key}']:.0f} {who}" for who, key in missed.items()]
    axes.text(0.98, 0.97, "\n".join(words), transform=axes.transAxes, ha="right", va="top", fontsize=7)
    axes.set(xscale="log", yscale="log", xlabel="time (ms)", ylabel="share that takes longer (1)")
    axes.set(xlim=(0.02, 1e3), ylim=(0.5 / found["ticks"], 1.0))
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    span = f"{found['minutes']:.3g} min in real time, {found['cores']:.0f} cores"
    origin(figure, f"simulated vehicle, {span}")
    return figure


def _longer(found: Quantities, kind: str) -> tuple[NDArray, NDArray]:
    """Upper edges of a distribution's bins (ms) and the share of all that lies above each."""
    prefix = f"{kind}_us_"
    bins = sorted((float(name.removeprefix(prefix)), count) for name, count in found.items() if name.startswith(prefix))
    edges, counts = np.array(bins).T
    return edges / 1e3, 1.0 - np.cumsum(counts) / counts.sum()


def table10_rates(rates: Quantities) -> Table:
    """Table 10: flights a second of a sweep, from ``benchmarks/sweep_rates.csv``, and what a million would take."""
    one, two, cores = rates["rate_1_worker_per_s"], rates["rate_2_workers_per_s"], rates["extrapolated_cores"]
    seconds, hours = rates["flight_duration_s"], f"extrapolated: {rates['extrapolated_hours']:.1f} h for a million"
    lines = [
        (f"{workers:g}", f"{rate:.{decimals}f}", f"{seconds * rate:.0f}", f"{rate / one:.2f}", origin)
        for workers, rate, decimals, origin in (
            (1, one, 2, "measured"),
            (2, two, 2, "measured"),
            (cores, cores * one, 0, hours),
        )
    ]
    return Table(("Workers", "Flights / s", "Simulated s / s", "Speed-up", "Origin"), lines, "rrrrl")
