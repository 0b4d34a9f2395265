"""The figure of ``fip bag length --plot``: the length over a flight, and how its interval shrank."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from fiplib.estimators.poses.estimate import NORMAL
from fiplib.estimators.poses.history import History, Stretch
from fiplib.recording import BagError, Flight
from fiplib.reproduction.style import BLUE, COLUMN, GREEN, GREY, ORANGE, origin, styled

FORMATS = {
    ".pdf": {"CreationDate": None, "Producer": None, "Creator": None},
    ".png": {"Software": None},
}
"""Endings of the file, and what is kept out of each: the same figure gives the same bytes."""

_ORIGINS = {"simulated": "simulated flight", "real": "recorded flight", "unknown": "flight of unknown origin"}


def length_figure(flight: Flight, windows: Sequence[Stretch], history: History) -> Figure:
    """Draw the length by windows, from the beginning, and of the whole flight, each with its interval of 95 %.

    Args:
        flight: for its origin, and the true length if a simulator recorded it.
        windows: stretches that follow each other; see ``poses.history``.
        history: the answer, and what it was from the beginning up to later and later times, s since the start.
    """
    with styled():
        figure = Figure(figsize=(COLUMN, 3.3), layout="constrained")
        above, below = figure.subplots(2, sharex=True, height_ratios=(3, 2))
        whole = history.answer
        if whole.reason is None:
            above.axhspan(*whole.interval, color=BLUE, alpha=0.25, lw=0)
            above.axhline(whole.length, color=BLUE, label="whole flight")
            below.axhline(1e3 * NORMAL * whole.standard_deviation, color=BLUE)
        known = np.isfinite(history.length) & np.isfinite(history.standard_deviation)
        if whole.reason is None and np.any(known):
            time, length, half = history.time[known], history.length[known], NORMAL * history.standard_deviation[known]
            above.fill_between(time, length - half, length + half, color=ORANGE, alpha=0.25, lw=0)
            above.plot(time, length, color=ORANGE, label="from the beginning")
            below.plot(time, 1e3 * half, color=ORANGE)
        if given := _given(windows):
            middle, width = np.array([((one.start + one.end) / 2, (one.end - one.start) / 2) for one in given]).T
            seconds = windows[0].end - windows[0].start
            bars = {"fmt": "none", "ecolor": GREEN, "elinewidth": 0.9}
            half = np.array([NORMAL * one.found.standard_deviation for one in given])
            label = f"windows of {seconds:.3g} s"
            above.errorbar(middle, [one.found.length for one in given], half, width, label=label, **bars)
            below.errorbar(middle, 1e3 * half, xerr=width, **bars)
        refused = [one for one in windows if one.found.reason is not None]
        if refused:
            at = [(one.start + one.end) / 2 for one in refused]
            above.plot(at, np.full(len(at), 0.03), "x", ms=3.5, mew=0.8, color=GREY, label="window refused",
                       transform=above.get_xaxis_transform(), clip_on=False)  # fmt: skip
        if flight.truth_length is not None:
            true = flight.truth_length
            time, length = np.append(flight.time(true), flight.duration), true.values[[*range(len(true.stamp)), -1], 0]
            above.step(time, length, "--", where="post", color="black", lw=0.7, label="true")
        _limits(above, windows, history)
        above.set_ylabel("length (m)")
        below.set(xlabel="time (s)", ylabel="half-width of the\n95 % interval (mm)", yscale="log")
        below.set_xlim(0.0, flight.duration)
        below.yaxis.set_major_locator(LogLocator(subs=(1.0, 1.5, 2.0, 3.0, 5.0, 7.0)))
        below.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        below.yaxis.set_minor_formatter(NullFormatter())
        below.grid(axis="y", which="both", lw=0.3, color="0.85")
        figure.legend(*above.get_legend_handles_labels(), loc="outside lower center", ncols=2)
        origin(figure, _ORIGINS[flight.metadata["origin"]])
        return figure


def check_name(file: Path) -> None:
    """Raise BagError if a figure cannot be written there; nothing is ever overwritten."""
    if file.suffix.lower() not in FORMATS:
        raise BagError(f"{file}: the ending is none of {', '.join(FORMATS)}: choose one of them")
    if file.exists():
        raise BagError(f"{file}: exists already; choose another path")
    if not file.parent.is_dir():
        raise BagError(f"{file}: there is no folder {file.parent}; make it first")


def save(figure: Figure, file: Path) -> None:
    """Write a figure into a new PNG or PDF file. Raises BagError as ``check_name``, or OSError."""
    check_name(file)
    with styled(), file.open("xb") as stream:
        FigureCanvasAgg(figure)
        figure.savefig(stream, format=file.suffix.lower()[1:], metadata=FORMATS[file.suffix.lower()])


def _given(stretches: Sequence[Stretch]) -> list[Stretch]:
    return [one for one in stretches if one.found.reason is None]


def _limits(axes: Axes, windows: Sequence[Stretch], history: History) -> None:
    """Show every estimate, and as much of the widest intervals as leaves the others legible."""
    found = [one.found for one in _given(windows)] + [history.answer] * (history.answer.reason is None)
    if not found:
        axes.set_yticks([])
        return
    lengths = np.array([one.length for one in found])
    room = 1.5 * float(np.quantile([NORMAL * one.standard_deviation for one in found], 0.8))
    axes.set_ylim(lengths.min() - room, lengths.max() + room)
