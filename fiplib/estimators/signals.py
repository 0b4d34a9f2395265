"""A first-order filter over evenly sampled signals."""

import numpy as np
from numpy.typing import ArrayLike, NDArray


def first_order(source: ArrayLike, now: float, decay: float, before: float = 0.0, start: ArrayLike = 0.0) -> NDArray:
    """Filter y_k = now x_k + before x_{k-1} + decay y_{k-1} along the last axis.

    Args:
        source: x, (..., n).
        now, decay, before: the coefficients.
        start: before x_{-1} + decay y_{-1}, (...).

    Returns:
        y, (..., n).
    """
    from fiplib.kernels import recursion  # here and not above: numba takes a while

    source = np.array(source, dtype=float, order="C")
    rows = source.reshape(-1, source.shape[-1])
    result = np.empty_like(rows)
    start = np.array(np.broadcast_to(start, source.shape[:-1]), dtype=float).reshape(-1)
    recursion.first_order(rows, now, before, decay, start, result)
    return result.reshape(source.shape)
