"""The measured times of ``benchmarks/``: figures 13 and 14, tables 10 and 12."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator
from numpy.typing import NDArray

from fiplib.reproduction.sources import Quantities, Rows
from fiplib.reproduction.style import BLUE, COLUMN, GREEN, GREY, ORANGE, PURPLE, origin
from fiplib.reproduction.tables import NONE, Table


def fig13_deadlines(found: Quantities) -> Figure:
    """Fig. 13: lateness of control ticks and time of their answers, in real time with a simulated vehicle.

    One run of ten minutes at 120 Hz, the genetic algorithm in a process beside the controller: share of all ticks above
    each time. Vertical line: the period of a tick, 8.33 ms. Dashed: lateness of a process that does nothing else. Of
    a hundred answers 99 take a tenth of a tick or less; the tail beyond a few ms is the machine's, as the dashed line
    shows.
    """
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
    """Table 10: simulated flights a second of a sweep by number of worker processes, hover without estimator.

    Measured once on each number of workers; the last line is extrapolated, with the time that a million flights need.
    """
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


OURS, FLOOR = "fip", "floor"
"""Names among the contenders of a benchmark."""


def table12_speed(rows: Rows) -> Table:
    """Table 12: time of each piece of work, beside the fastest rival whose answers agree, and ratios of all others.

    Medians (p50) and 99th percentiles (p99) of many calls in one process each, on simulated data; a ratio is the
    rival's median over ours. A rival with other answers is marked: its time is for different work.
    """
    lines = []
    for work in dict.fromkeys(row["work"] for row in rows if row["contender"] == OURS and row["calls"] > 0):
        own, *others = sorted((row for row in rows if row["work"] == work), key=lambda row: row["contender"] != OURS)
        if not others or not own["p50_us"] > 0.0 or own["topic"] == "growth":
            continue  # nothing beside it, or a number that is no time
        timed = sorted((row for row in others if row["calls"] > 0), key=lambda row: row["ratio"])
        best = next((row for row in timed if row["agrees"]), None)
        rest = [f"{_name(row)} {_figures(row['ratio'])}" for row in timed if row is not best]
        rest += [f"{row['contender']} {str(row['remark']).partition(':')[0]}" for row in others if row["calls"] == 0]
        beside = (_name(best), _figures(best["p50_us"] / 1e3), _figures(best["ratio"])) if best else (NONE,) * 3
        times = _figures(own["p50_us"] / 1e3), _figures(own["p99_us"] / 1e3)
        lines.append((str(work), *times, *beside, ", ".join(rest) or NONE))
    header = (
        "Work",
        "ours, p50 (ms)",
        "p99 (ms)",
        "Fastest rival that agrees",
        "p50 (ms)",
        "Ratio",
        "Ratios of others",
    )
    return Table(header, lines, "lrrlrrl")


def _name(row: dict[str, float | str]) -> str:
    """A contender with what its ratio must not be quoted without."""
    extrapolated = ", extrapolated" if "extrapolated" in str(row["remark"]) else ""
    return f"{row['contender']}{extrapolated}{'' if row['agrees'] else ' (differs)'}"


def _figures(value: float) -> str:
    """Three significant figures, or whole numbers above a thousand."""
    return f"{value:.3g}" if value < 1e3 else f"{value:.0f}"


def fig14_growth(rows: Rows) -> Figure:
    """Fig. 14: time over the size of the work, beside the physical floor, on simulated data.

    Medians of many calls on one machine; the number behind each name is the exponent fitted to the larger half of the
    sizes, the floor is what arithmetic or memory alone would take. An exponent of one means that every node, sample or
    message is touched once; where it is smaller, a fixed cost of each call still counts.
    """
    works = list(dict.fromkeys(str(row["work"]) for row in rows))
    figure = Figure(figsize=(COLUMN, 1.45 * -(-len(works) // 2) + 0.3), layout="constrained")
    panels = figure.subplots(-(-len(works) // 2), 2, squeeze=False).ravel()
    for axes, work in zip(panels, works, strict=False):
        title, _, size = work.rpartition(", ")
        found = [row for row in rows if row["work"] == work]
        colours = iter((ORANGE, GREEN, PURPLE))
        for contender in dict.fromkeys(str(row["contender"]) for row in found):
            sizes, times = np.array([(r["size"], r["p50_us"] / 1e3) for r in found if r["contender"] == contender]).T
            if contender == FLOOR:
                axes.plot(sizes, times, "--", color=GREY, label="floor")
            else:
                label = f"{contender} {exponent(sizes, times):.2f}"
                axes.plot(sizes, times, ".-", color=BLUE if contender == OURS else next(colours), label=label)
        axes.set(xscale="log", yscale="log", xlabel="duration (s)" if size == "seconds" else f"{size} (1)")
        axes.set_xticks(ticks := sorted({row["size"] for row in found})[::2], [f"{tick:.0f}" for tick in ticks])
        axes.xaxis.set_minor_locator(NullLocator())
        axes.set_ylabel("time (ms)")
        axes.set_title(title)
        axes.margins(x=0.05, y=0.1)
        low, high = axes.get_ylim()
        axes.set_ylim(low, high * (high / low) ** 0.9)  # room for the legend
        axes.legend(fontsize=6, loc="upper left")
    for axes in panels[len(works) :]:
        axes.remove()
    origin(figure, "measured; numbers: fitted exponents; simulated data")
    return figure


def exponent(sizes: NDArray, times: NDArray) -> float:
    """The slope of a straight line through log time over log size; of the upper half of the sizes, three at least."""
    half = min(len(sizes) - 3, len(sizes) // 2) if len(sizes) > 3 else 0
    return float(np.polyfit(np.log(sizes[half:]), np.log(times[half:]), 1)[0])
