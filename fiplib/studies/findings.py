"""Figures beyond the paper: what the studies of ``make sweep`` found, from their tables in ``data/sweeps``.

As in ``figures``: tables and flights in, ``Figure`` out. Nothing is simulated here; what was simulated is said.
"""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from fiplib.params import NANO
from fiplib.recording import Flight
from fiplib.reproduction import measures
from fiplib.reproduction.rows import Rows
from fiplib.reproduction.style import BLUE, COLUMN, GREEN, GREY, ORANGE, PURPLE, origin
from fiplib.studies.summaries import LABELS, SHOWN_READINGS, pooled


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


def fig8_landscapes(curves: Rows) -> Figure:
    """Fig. 8: what four readings of the fitness say about every length, on one and the same window."""
    figure = Figure(figsize=(COLUMN, 2.9), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    looks = zip((ORANGE, PURPLE, GREEN, BLUE), ("-", "--", "-.", "-"), strict=True)
    shown = {reading: (label, *look) for (reading, label), look in zip(SHOWN_READINGS.items(), looks, strict=True)}
    titles = {"default": "calibrated covariances", "identity": "$Q_e = R_e = I$"}
    for axes, (noise, title) in zip(panels, titles.items(), strict=True):
        for reading, (label, colour, dashes) in shown.items():
            points = sorted(
                (row["length"], row["normalised"])
                for row in curves
                if row["reading"] == reading and row["noise"] == noise
            )
            axes.plot(*np.array(points).T, dashes, color=colour, label=label)
            best = min(points, key=lambda point: point[1])
            axes.plot(best[0], best[1], "o", color=colour, ms=4, mec="black", mew=0.4, clip_on=False, zorder=3)
        axes.axvline(1.0, color="black", lw=0.6)
        axes.set(title=title, xlabel="candidate length (m)", ylim=(0, 1.5), xlim=(0.2, 2.0))
    panels[0].set_ylabel("fitness above its best (median = 1)")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    origin(figure, "one simulated window, true length 1 m")
    return figure


def fig9_estimators(rows: Rows) -> Figure:
    """Fig. 9: RMS error of every estimator over the Cramer-Rao bound of raw motion capture, on the 0.4 m circle."""
    figure = Figure(figsize=(COLUMN, 3.0), layout="constrained")
    axes = figure.subplots()
    names = list(LABELS)
    for ratio, marker, colour, label in ((True, "o", BLUE, "uniform rod"), (False, "D", ORANGE, "point mass")):
        chosen = [row for row in rows if row["excitation"] == "circle-0.4" and (row["gyration_ratio"] > 0) == ratio]
        found = [pooled(chosen, name) for name in names]
        axes.plot([one.rms / one.bound for one in found], range(len(names)), marker, color=colour, ms=4, label=label)
    axes.axvline(1.0, color="black", lw=0.6)
    axes.axvline(1.2, color="black", lw=0.6, ls="--", label="target, 1.2")
    axes.set(yticks=range(len(names)), yticklabels=[LABELS[name] for name in names])
    axes.set(xscale="log", xlabel="RMSE / bound (1)")
    axes.invert_yaxis()
    axes.margins(x=0.08)
    axes.legend(loc="upper right")
    origin(figure, "simulated flights, 0.4 m circle")
    return figure


def fig10_intervals(flight: Flight) -> Figure:
    """Fig. 10: maximum likelihood with its 95 % interval on the flight of Fig. 5, beside the GA's answers."""
    figure = Figure(figsize=(COLUMN, 2.5), layout="constrained")
    axes = figure.subplots()
    times, lengths, deviations = _estimates(flight)
    recorded = flight.length.values[1:, 1]
    axes.plot(flight.time(flight.length)[1:], recorded, ".", ms=2.5, color=ORANGE, label="GA, recorded in flight")
    axes.errorbar(
        times, lengths, 1.96 * deviations, fmt=".", ms=2.5, lw=0.6, color=BLUE, label="maximum likelihood, 95 %"
    )
    axes.axhline(measures.true_length(flight), color="black", lw=0.6, label="true")
    axes.set(xlabel="time (s)", ylabel="length (m)", xlim=(0, flight.duration), ylim=(0.9, 1.1))
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    origin(figure, f"{flight.metadata['origin']}, {flight.path.name}")
    return figure


def _estimates(flight: Flight) -> tuple[NDArray, NDArray, NDArray]:
    """Times (s), maximum-likelihood lengths and standard deviations (m), a window each half second of a flight."""
    from fiplib import replay  # here: the other figures need not wait for CasADi
    from fiplib.estimators.likelihood import maximum_likelihood

    found = []
    for stamp, window in replay.raw_windows(flight, flight.params.estimation.raw_window, 0.5):
        estimate = maximum_likelihood(window, flight.params)
        if estimate.reason is None:
            found.append(((stamp - flight.start_ns) / NANO, estimate.length, estimate.standard_deviation))
    return tuple(np.array(found).T)


def fig11_handover(rows: Rows) -> Figure:
    """Fig. 11: random rods and first lengths: who stays up, as printed and with the trusted hand-over."""
    figure = Figure(figsize=(COLUMN, 2.5), layout="constrained")
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    told = {row["index"] for row in rows if row["policy"] == "told" and row["survived"] == 1}
    for axes, policy, title in zip(panels, ("printed", "trusted"), ("as printed", "trusted"), strict=True):
        flown = [row for row in rows if row["policy"] == policy]
        up = [row for row in flown if row["survived"] == 1]
        fell = [row for row in flown if row["survived"] != 1 and row["index"] in told]
        hopeless = [row for row in flown if row["survived"] != 1 and row["index"] not in told]
        for some, marker, size, colour, label in (
            (up, ".", 2.0, BLUE, "stays up"),
            (fell, "x", 3.5, ORANGE, "falls"),
            (hopeless, "+", 4.0, GREY, "falls when told, too"),
        ):
            points = np.array([(row["initial_length"], row["true_length"]) for row in some]).reshape(-1, 2)
            axes.plot(*points.T, marker, ms=size, mew=0.8, color=colour, label=label if some else None)
        axes.set(title=f"{title}: {len(up)} of {len(flown)} up", xlabel="first length (m)", xlim=(0.37, 1.63))
    panels[0].set(ylabel="true length (m)", ylim=(0.45, 1.55))
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    origin(figure, "simulated flights of 12 s, uniform rods")
    return figure


def fig12_bound(rows: Rows) -> Figure:
    """Fig. 12: the Cramer-Rao bound of the length over the window: by excitation, and by what is measured and known."""
    figure = Figure(figsize=(COLUMN, 3.5), layout="constrained")
    # curves fill the panels: their names have a row of their own
    panels, names = figure.subplots(2, 2, sharex="row", sharey="row", height_ratios=(2.6, 1.0))
    cells = {tuple(row[key] for key in ("excitation", "rod", "noise", "knowledge")): row for row in rows}
    windows = [float(name.removeprefix("bound_")) for name in rows[0] if name.startswith("bound_")]
    usual = {"excitation": "circle 0.4 m / 8 s", "rod": "uniform", "noise": "default", "knowledge": "plant known"}
    curves = (
        (0, {}, "0.4 m, 8 s", BLUE, "-"),
        (0, {"excitation": "circle 0.4 m / 5 s"}, "0.4 m, 5 s", GREEN, "--"),
        (0, {"excitation": "circle 0.8 m / 9 s"}, "0.8 m, 9 s", PURPLE, "-."),
        (0, {"excitation": "hover"}, "hover", ORANGE, ":"),
        (1, {}, "as on the left", BLUE, "-"),
        (1, {"noise": "positions x 5"}, r"positions $\times 5$", ORANGE, ":"),
        (1, {"noise": "attitude x 5"}, r"attitude $\times 5$", PURPLE, "-."),
        (1, {"knowledge": "inertia and lag unknown"}, "inertia, lag unknown", GREEN, "--"),
        (1, {"knowledge": "calibration unknown"}, "calibration unknown", "black", (0, (6, 1.5))),
    )
    for panel, changes, label, colour, dashes in curves:
        row = cells[tuple((usual | changes).values())]
        bounds = [1e3 * row[f"bound_{seconds:g}"] for seconds in windows]
        panels[panel].loglog(windows, bounds, ls=dashes, color=colour, label=label)
    for axes, below in zip(panels, names, strict=True):
        axes.axhline(10.0, color=GREY, lw=0.6)
        axes.set(xlabel="window (s)", xticks=(0.25, 1, 2.5, 10), xticklabels=("0.25", "1", "2.5", "10"))
        axes.minorticks_off()
        below.axis("off")
        below.legend(*axes.get_legend_handles_labels(), loc="upper center", handlelength=2.4, borderaxespad=0.0)
    panels[0].set(ylabel="bound on the length (mm)", ylim=(0.2, 3000))
    panels[0].set_title("excitation")
    panels[1].set_title("noise, knowledge")
    origin(figure, "simulated flights, uniform rod of 1 m; grey: 1 cm")
    return figure


def fig13_deadlines(found: Mapping[str, float]) -> Figure:
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


def _longer(found: Mapping[str, float], kind: str) -> tuple[NDArray, NDArray]:
    """Upper edges of a distribution's bins (ms) and the share of all that lies above each."""
    prefix = f"{kind}_us_"
    bins = sorted((float(name.removeprefix(prefix)), count) for name, count in found.items() if name.startswith(prefix))
    edges, counts = np.array(bins).T
    return edges / 1e3, 1.0 - np.cumsum(counts) / counts.sum()
