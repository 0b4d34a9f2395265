"""The pictures of ``fiplib.teaching.explorer``: a flight over time, in space, and what a refit found.

Each function draws anew into a figure that it is given, so that one canvas in a page serves for many pictures.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO

import ipywidgets as widgets
import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from fiplib import ga
from fiplib.dynamics import seat_position
from fiplib.kalman import Window
from fiplib.params import STATES, Params
from fiplib.recording import Flight, Poses
from fiplib.reproduction.style import BLUE, GREEN, GREY, ORANGE, PURPLE, STYLE, origin

DPI = 100
"""Pixels per inch in the page: 8 pt are 11 pixels high."""

TOOLBAR = 0.2
"""Height in inches that is left free above the panels, where the buttons appear."""

SNAPSHOTS = 12
"""Rods drawn in the view in space, evenly over the window."""

COLUMNS = 1000
"""Columns of a picture in which a line is drawn by its first, least, greatest and last point: 4 000 points at most."""

_LABELS = {signal.name: signal.label for signal in STATES}


@dataclass(frozen=True, eq=False)
class WindowFit:
    """The genetic algorithm and the landscape on one window: data, settings, results.

    ``lengths`` (L,) in m and their ``fitness``; ``best`` is the length of least fitness in m, ``found`` the answer of
    the genetic algorithm, ``seconds`` the time that all of this took.
    """

    window: Window
    params: Params
    lengths: NDArray
    fitness: NDArray
    best: float
    found: ga.Evolution
    seconds: float


class Picture:
    """A figure in a page, width and height in inches: a canvas to zoom and turn where ipympl's backend is active, else
    an image. Draw into ``figure``, then call ``show``; the page displays ``widget``."""

    def __init__(self, width: float, height: float) -> None:
        with mpl.rc_context(STYLE):
            self.figure = Figure(figsize=(width, height), dpi=DPI, layout="constrained")
        self.figure.get_layout_engine().set(rect=(0.0, 0.0, 1.0, 1.0 - TOOLBAR / height))
        if mpl.get_backend().removeprefix("module://").partition(".")[0] in ("ipympl", "widget", "nbagg"):
            from ipympl.backend_nbagg import Canvas, FigureManager

            self.widget = Canvas(self.figure)
            FigureManager(self.widget, id(self) % 2**31)
            self.widget.header_visible = self.widget.footer_visible = self.widget.resizable = False
            self.widget.toolbar_position = "top"
            mpl.rcParams["axes3d.mouserotationstyle"] = "azel"  # read when the mouse moves: up stays up
            self.widget.layout.width = f"{DPI * width:.0f}px"
        else:
            FigureCanvasAgg(self.figure)
            self.widget = widgets.Image(format="png", layout=widgets.Layout(width=f"{DPI * width:.0f}px"))

    def show(self) -> None:
        """Bring the page up to date with the figure."""
        if isinstance(self.widget, widgets.Image):
            self.widget.value = image_of(self.figure, DPI)
        else:
            self.figure.canvas.draw_idle()


def image_of(figure: Figure, dpi: int = 2 * DPI) -> bytes:
    """Return a figure as a PNG image."""
    buffer = BytesIO()
    figure.savefig(buffer, dpi=dpi)
    return buffer.getvalue()


def thinned(time: NDArray, values: NDArray, span: tuple[float, float]) -> tuple[NDArray, NDArray]:
    """Return the times and values (m,) that draw a line (n,) between two times as all of its points would."""
    first, last = np.searchsorted(time, span)
    kept = slice(max(int(first) - 1, 0), int(last) + 1)
    time, values = time[kept], values[kept]
    if len(time) <= 4 * COLUMNS:
        return time, values
    column = ((time - time[0]) / (time[-1] - time[0]) * COLUMNS).astype(int).clip(max=COLUMNS - 1)
    order = np.lexsort((values, column))
    starts = np.flatnonzero(np.diff(column, prepend=-1))  # where a column begins, in time as in order
    ends = np.append(starts[1:], len(time)) - 1
    drawn = np.unique(np.concatenate([starts, ends, order[starts], order[ends]]))
    return time[drawn], values[drawn]


def draw_flight(figure: Figure, flight: Flight, span: tuple[float, float], zoom: bool) -> None:
    """Position, the rod's offset, tilt and commands over time; the window ``span``, in s since the start, is shaded.

    The flight comes with its states, recorded or derived; ``zoom`` shows the window alone.
    """
    figure.clear()
    shown = span if zoom else (0.0, flight.duration)
    with mpl.rc_context(STYLE):
        panels = figure.subplots(4, 1, sharex=True)
        time = flight.time(flight.vehicle)
        for name, colour, position in zip("xyz", (BLUE, ORANGE, GREEN), flight.vehicle.position.T, strict=True):
            panels[0].plot(*thinned(time, position, shown), color=colour, label=f"${name}$")
        if flight.reference is not None:
            time = flight.time(flight.reference)
            for name, colour in zip("xy", (BLUE, ORANGE), strict=True):
                line = thinned(time, flight.reference.column(name), shown)
                panels[0].plot(*line, "--", lw=0.7, color=colour, alpha=0.6)
        panels[0].set_ylabel("vehicle (m)")
        _states(panels[1], flight, shown, ("a", "b"), 100.0, "rod's COM (cm)")
        _states(panels[2], flight, shown, ("phi", "theta"), math.degrees(1), "tilt (deg)")
        panels[3].set_ylabel("rates (deg/s)")
        if flight.command is None:
            panels[3].set_yticks([])
            _instead(panels[3], "no commands in this bag")
        else:
            time = flight.time(flight.command)
            for name, label, colour in (("omega_x", r"$\omega_x$", BLUE), ("omega_y", r"$\omega_y$", ORANGE)):
                rate = np.degrees(flight.command.column(name))
                panels[3].plot(*thinned(time, rate, shown), color=colour, lw=0.5, alpha=0.8, label=label)
        for axes in panels:
            axes.axvspan(*span, color=GREY, alpha=0.15, lw=0)
            for event in flight.events[:50]:
                axes.axvline(flight.time(event), color=PURPLE, lw=0.7, ls=":")
            if axes.get_legend_handles_labels()[0]:
                axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), handlelength=1.0, frameon=False)
        panels[-1].set(xlabel="time (s)", xlim=shown)
        figure.align_ylabels(panels)
        _say(figure, flight)


def draw_space(figure: Figure, flight: Flight, span: tuple[float, float]) -> None:
    """The window in space: the ways of vehicle and rod, and rods as they stood, from light (first) to dark (last)."""
    figure.clear()
    with mpl.rc_context(STYLE):
        axes = figure.add_subplot(projection="3d")
        vehicle, pendulum = (_within(flight, body, span) for body in (flight.vehicle, flight.pendulum))
        if len(vehicle.stamp) and len(pendulum.stamp):
            for body, colour, label in ((vehicle, BLUE, "vehicle"), (pendulum, ORANGE, "rod's COM")):
                way = body.position[:: 1 + len(body.stamp) // (4 * COLUMNS)]
                axes.plot(*way.T, color=colour, label=label)
            at = np.linspace(0, len(vehicle.stamp) - 1, SNAPSHOTS).round().astype(int)
            other = np.searchsorted(pendulum.stamp, vehicle.stamp[at]).clip(max=len(pendulum.stamp) - 1)
            seats = seat_position(vehicle.position[at], vehicle.orientation[at], flight.params.piloting.seat_height)
            shades, rods = np.linspace(0.2, 1.0, SNAPSHOTS), (seats, pendulum.position[other])
            for shade, seat, middle in zip(shades, *rods, strict=True):
                axes.plot(*np.array([seat, 2 * middle - seat]).T, color="black", lw=1.0, alpha=shade)  # tip: COM again
            axes.legend(loc="upper left", frameon=False)
        axes.set(xlabel="$x$ (m)", ylabel="$y$ (m)", zlabel="$z$ (m)")
        for low_high, set_limits in ((axes.get_xlim(), axes.set_xlim), (axes.get_ylim(), axes.set_ylim)):
            middle, half = np.mean(low_high), max(np.ptp(low_high) / 2, 0.3)  # in hover there is hardly a way to see
            set_limits(middle - half, middle + half)
        axes.set_aspect("equal")
        axes.locator_params(nbins=4)
        axes.view_init(elev=16, azim=-60)
        axes.tick_params(pad=-2)
        for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
            axis.labelpad = -4
            axis.pane.set_facecolor("white")
        _say(figure, flight)


def draw_refit(figure: Figure, flight: Flight, refits: Sequence[WindowFit], truth: float | None) -> None:
    """The last refit's landscape and generations, and the estimates of all refits with their intervals.

    ``refits`` come in the order in which they were made; none gives empty panels that say so. ``truth`` is the length
    in m that the bag states.
    """
    figure.clear()
    with mpl.rc_context(STYLE):
        left, middle, right = figure.subplots(1, 3)
        if refits:
            _landscape(left, refits[-1])
            _generations(middle, refits[-1])
            _history(right, refits[-SHOWN:], max(0, len(refits) - SHOWN), truth)
        else:
            words = "press Refit" if flight.command is not None else "no commands, no refit"
            for axes in (left, middle, right):
                axes.set(xticks=[], yticks=[])
            _instead(left, words)
        if truth is not None and refits:
            for line in (left.axvline, middle.axhline, right.axhline):
                line(truth, color="black", lw=0.7, ls="--", label="stated by the bag")
        left.set(title="landscape", xlabel="length (m)", ylabel="fitness above its least")
        middle.set(title="generations of the GA", xlabel="generation", ylabel="length (m)")
        right.set(title="refits so far", xlabel="refit", ylabel="length (m)")
        if refits:
            figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
        _say(figure, flight)


SHOWN = 12
"""Refits shown side by side; older ones remain in the table."""


def _landscape(axes: Axes, refit: WindowFit) -> None:
    finite = np.isfinite(refit.fitness)
    lengths, height = refit.lengths[finite], refit.fitness[finite] - refit.fitness.min()
    axes.plot(lengths, height, color=BLUE)
    axes.axvline(refit.found.length, color=ORANGE, label="genetic algorithm, its best")
    if math.isfinite(refit.found.standard_deviation):
        half = 2 * refit.found.standard_deviation
        axes.axvspan(refit.found.length - half, refit.found.length + half, color=ORANGE, alpha=0.15, lw=0)
        axes.axhline(4.0, color=GREY, lw=0.6, ls=":", label=r"4 above: ends of $\pm 2\sigma$")  # of -2 log L
    # linear, and cut off: there is a wall at short lengths, beside which the valley would not be seen
    axes.set(xlim=(lengths[0], lengths[-1]), ylim=(0.0, 1.5 * float(np.quantile(height, 0.6)) or 1.0))


def _generations(axes: Axes, refit: WindowFit) -> None:
    populations = refit.found.populations
    number = np.broadcast_to(np.arange(1, len(populations) + 1)[:, None], populations.shape)
    feasible = populations <= refit.lengths[-1]
    axes.plot(number[feasible], populations[feasible], ".", ms=2, color=GREY, alpha=0.6)
    axes.plot(number[:, 0], refit.found.best_lengths, color=ORANGE, label="best")
    axes.set(xlim=(0.5, len(populations) + 0.5), ylim=(refit.lengths[0], refit.lengths[-1]))


def _history(axes: Axes, refits: Sequence[WindowFit], before: int, truth: float | None) -> None:
    number = before + np.arange(1, len(refits) + 1)
    lengths, deviations = np.array([(r.found.length, r.found.standard_deviation) for r in refits]).T
    half = 2 * np.nan_to_num(deviations)
    axes.errorbar(number, lengths, half, fmt="o", ms=3, color=ORANGE, ecolor=ORANGE, elinewidth=0.8)
    axes.plot(number, [r.best for r in refits], "_", ms=9, color=BLUE)
    # whatever happens, at least 10 cm and at most what lengths there are
    middle = lengths if truth is None else np.append(lengths, truth)
    low, high = min((lengths - half).min(), middle.min() - 0.05), max((lengths + half).max(), middle.max() + 0.05)
    limits = (max(low - 0.02, 0.0), min(high + 0.02, 1.1 * refits[-1].lengths[-1]))
    axes.set(xlim=(before + 0.5, before + max(len(refits), 4) + 0.5), ylim=limits)
    axes.xaxis.get_major_locator().set_params(integer=True)


def _states(
    axes: Axes, flight: Flight, shown: tuple[float, float], names: tuple[str, str], scale: float, label: str
) -> None:
    for name, colour in zip(names, (BLUE, ORANGE), strict=True):
        line = thinned(flight.time(flight.state), scale * flight.state.column(name), shown)
        axes.plot(*line, color=colour, label=_LABELS[name])
    axes.set_ylabel(label)


def _instead(axes: Axes, words: str) -> None:
    axes.text(0.5, 0.5, words, color=GREY, ha="center", va="center", transform=axes.transAxes)


def _within(flight: Flight, body: Poses, span: tuple[float, float]) -> Poses:
    inside = (flight.time(body) >= span[0]) & (flight.time(body) <= span[1])
    return Poses(body.stamp[inside], body.received[inside], body.position[inside], body.orientation[inside])


def _say(figure: Figure, flight: Flight) -> None:
    words = flight.metadata["origin"].replace("unknown", "origin unknown")
    origin(figure, f"{words}, {flight.path.name}")
