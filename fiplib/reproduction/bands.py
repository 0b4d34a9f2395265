"""Bands over seeds: what lies behind one recorded flight, from the rows of the study ``spread``."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fiplib.reproduction.sources import Rows

STEP = 0.5
TIMES = tuple(round(step * STEP + 0.01, 2) for step in range(50))
"""s since the start of the flight, just after every half second: an answer of that moment comes with the next tick."""

QUANTITIES = ("used", "estimate", "deviation", "x_error", "y_error", "pose_length", "pose_deviation")
"""Length in use; the estimator's answer and its stated standard deviation; x and y minus their references; the length
from a window of raw poses that ends then, and its stated standard deviation. All in m."""

SHARES = (0.05, 0.5, 0.95)
"""The quantiles of a band."""


class Band(NamedTuple):
    """Quantiles over flights at ``time`` (n,) s: ``low``, ``middle`` and ``high`` (n,), those of ``SHARES``."""

    time: NDArray
    low: NDArray
    middle: NDArray
    high: NDArray


def flights(rows: Rows, scenario: str) -> Rows:
    """Return the rows of one scenario."""
    return [row for row in rows if row["scenario"] == scenario]


def values(rows: Rows, quantity: str) -> NDArray:
    """Return a quantity of flights at ``TIMES``, (flights, n); nan where a flight has none."""
    return np.array([[row[f"{quantity}_{time:g}"] for time in TIMES] for row in rows])


def band(found: NDArray) -> Band:
    """Return the quantiles over flights of values (flights, n) at ``TIMES``, of those times at which most have one."""
    known = 2 * np.isfinite(found).sum(axis=0) > len(found)
    return Band(np.array(TIMES)[known], *np.nanquantile(found[:, known], SHARES, axis=0))
