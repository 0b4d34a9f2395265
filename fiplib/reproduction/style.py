"""The style of every figure: one column, 8 pt, colours for colour-blind readers, the origin of the data."""

from contextlib import AbstractContextManager
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

COLUMN = 3.4
"""Width of a journal column, inches."""

BLUE, ORANGE, GREEN, PURPLE, GREY = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#666666"
"""The colours of Okabe and Ito."""

LIGHT = "#E4E4E4"
"""Colour of shaded areas behind lines."""

STYLE = {
    "font.size": 8,
    "axes.labelsize": 8,
    "axes.titlesize": 8,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "legend.fontsize": 7,
    "legend.framealpha": 1.0,
    "legend.edgecolor": "white",
    "legend.borderpad": 0.1,
    "legend.handlelength": 1.4,
    "legend.columnspacing": 1.0,
    "legend.borderaxespad": 0.2,
    "lines.linewidth": 0.9,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.xmargin": 0.0,
    "pdf.fonttype": 42,
    "savefig.dpi": 300,
}


def origin(figure: Figure, words: str, y: float | None = None) -> None:
    """Say in the figure itself what its data are."""
    figure.suptitle(words, fontsize=7, color=GREY, x=0.99, ha="right", y=y)


def styled() -> AbstractContextManager:
    """Return the context in which figures are drawn and saved."""
    return mpl.rc_context(STYLE)


def settle(figure: Figure) -> None:
    """Lay a figure with subfigures out once for all, to a millionth of its size.

    The solver of the layout works in an order that changes from run to run: the last digit of a place changes with it.
    """
    if not figure.subfigs:
        return
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    for part in figure.subfigs:
        part.bbox_relative.set_points(np.round(part.bbox_relative.get_points(), 6) + 0.0)  # + 0.0: no -0
    for axes in figure.axes:
        axes.set_position(np.round(axes.get_position().bounds, 6) + 0.0)


def save(figure: Figure, pdf: Path, png: Path) -> None:
    """Save a figure without date and program: the same figure gives the same bytes."""
    with styled():
        FigureCanvasAgg(figure)
        settle(figure)
        figure.savefig(pdf, metadata={"CreationDate": None, "Producer": None, "Creator": None})
        figure.savefig(png, metadata={"Software": None})
