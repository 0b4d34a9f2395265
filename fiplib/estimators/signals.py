"""Two short filters over evenly sampled signals."""

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


def local_parabola(values: NDArray, span: int, period: float, derivative: int = 0) -> NDArray:
    """Fit a parabola to the ``span`` samples about each one (Savitzky and Golay, 1964), and evaluate it there.

    Towards the ends, the parabola through the first or last ``span`` samples serves.

    Args:
        values: (n, columns), every ``period`` s.
        span: an odd number of samples, 3 to n.
        period: in s.
        derivative: 0 for the value, 1 for its rate.

    Returns:
        (n, columns).
    """
    half = span // 2
    at = np.arange(-half, half + 1)
    # orthogonal polynomials on these points: 1, t and t^2 - mean
    square = at**2 - half * (half + 1) / 3
    shown = (np.array([at, square]), np.array([np.ones(span), 2 * at]))[derivative]
    fit = shown.T @ (np.array([at, square]) / np.array([[np.sum(at**2)], [np.sum(square**2)]]))
    fit = fit / period if derivative else fit + 1 / span
    windows = np.lib.stride_tricks.sliding_window_view(values, span, axis=0)
    return np.concatenate([fit[:half] @ values[:span], windows @ fit[half], fit[half + 1 :] @ values[-span:]])
