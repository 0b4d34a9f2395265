"""First-order recursive filters: lags, and linear systems of one state."""

from numpy.typing import NDArray

from fiplib.kernels.compiling import compiled


@compiled("void(f8[:,::1], f8, f8, f8, f8[::1], f8[:,::1])")
def first_order(source: NDArray, now: float, before: float, decay: float, start: NDArray, result: NDArray) -> None:
    """Write y_k = now x_k + (before x_{k-1} + decay y_{k-1}) for each row x of source; start is the bracket of y_0.

    Args:
        source: (R, n).
        now, before, decay: the coefficients.
        start: (R,).
        result: (R, n).
    """
    for i in range(len(source)):
        memory = start[i]
        for k in range(source.shape[1]):
            result[i, k] = memory + now * source[i, k]
            memory = before * source[i, k] + decay * result[i, k]
