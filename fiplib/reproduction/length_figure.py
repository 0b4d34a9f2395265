"""The figure of ``fip bag length --plot``: the length over a flight, and how its interval shrank."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from fiplib.estimators.poses.estimate import NORMAL, PoseEstimate
from fiplib.estimators.poses.history import Stretch
from fiplib.recording import BagError, Flight
from fiplib.reproduction.style import BLUE, COLUMN, GREEN, GREY, ORANGE, origin, styled

FORMATS = {
    ".pdf": {"CreationDate": None, "Producer": None, "Creator": None},
    ".png": {"Software": None},
}
"""Endings of the file, and what is kept out of each: the same figure gives the same bytes."""

_ORIGINS = {"simulated": "simulated flight", "real": "recorded flight", "unknown": "flight of unknown origin"}


def length_figure(flight: Flight, windows: Sequence[Stretch], growing: Sequence[Stretch]) -> Figure:
    """Draw the length by windows, from the beginning, and of the whole flight, each with its interval of 95 %.

    Args:
        flight: for its origin, and the true length if a simulator recorded it.
        windows: stretches that follow each other; see ``poses.history``.
        growing: stretches from the beginning; the last is the whole flight.
    """
    with styled():
        figure = Figure(figsize=(COLUMN, 3.3), layout="constrained")
        above, below = figure.subplots(2, sharex=True, height_ratios=(3, 2))
        whole = growing[-1].found
        if whole.reason is None:
            above.axhspan(*whole.interval, color=BLUE, alpha=0.25, lw=0)
            above.axhline(whole.length, color=BLUE, label="whole flight")
            below.axhline(1e3 * _half(whole), color=BLUE)
        if given := _given(growing):
            time, length = np.array([(one.end, one.found.length) for one in given]).T
            low, high = np.array([one.found.interval for one in given]).T
            above.fill_between(time, low, high, color=ORANGE, alpha=0.25, lw=0)
            dots = {"ms": 2.5, "color": ORANGE, "clip_on": False}
            above.plot(time, length, "o-", label="from the beginning", **dots)
            below.plot(time, [1e3 * _half(one.found) for one in given], "o-", **dots)
        if given := _given(windows):
            middle, width = np.array([((one.start + one.end) / 2, (one.end - one.start) / 2) for one in given]).T
            seconds = windows[0].end - windows[0].start
            bars = {"fmt": "none", "ecolor": GREEN, "elinewidth": 0.9}
            half = np.array([_half(one.found) for one in given])
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
        _limits(above, [*windows, *growing])
        above.set_ylabel("length (m)")
        below.set(xlabel="time (s)", ylabel="half-width of the\n95 % interval (mm)", yscale="log")
        below.set_xlim(0.0, flight.duration)
        below.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
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


def _half(found: PoseEstimate) -> float:
    """Half the width of the interval of 95 %, m."""
    return NORMAL * found.standard_deviation


def _limits(axes: Axes, stretches: Sequence[Stretch]) -> None:
    """Show every estimate, and as much of the widest intervals as leaves the others legible."""
    given = _given(stretches)
    if not given:
        axes.set_yticks([])
        return
    lengths = np.array([one.found.length for one in given])
    half = np.array([_half(one.found) for one in given])
    room = 1.5 * float(np.quantile(half, 0.8))
    axes.set_ylim(lengths.min() - room, lengths.max() + room)
