"""Local parabolas through samples at any times: smoothed values and derivatives."""

import numba
import numpy as np
from numpy.typing import NDArray


def parabolas(time: NDArray, values: NDArray, at: NDArray, half: float) -> NDArray:
    """Return values and first two derivatives (3, len(at), columns) of local parabolas.

    Args:
        time: sorted times of the samples (n,), s.
        values: the samples (n, columns).
        at: sorted times at which the parabolas are centred, s.
        half: every parabola takes the samples within ``half`` s, and never fewer than the five nearest in a row.
    """
    return _parabolas(np.ascontiguousarray(time), np.ascontiguousarray(values), np.ascontiguousarray(at), half)


@numba.njit(cache=True, error_model="numpy")
def _parabolas(time, values, at, half):  # pragma: no cover - compiled
    n, columns = values.shape
    out = np.zeros((3, len(at), columns))
    low = high = 0
    for index in range(len(at)):
        while low < n and time[low] < at[index] - half:
            low += 1
        while high < n and time[high] <= at[index] + half:
            high += 1
        first, last = low, high
        while last - first < min(5, n):
            if first > 0 and (last >= n or at[index] - time[first - 1] <= time[last] - at[index]):
                first -= 1
            else:
                last += 1
        width = max(time[last - 1] - at[index], at[index] - time[first]) + 1e-12
        m = np.zeros(5)
        for i in range(first, last):
            z = (time[i] - at[index]) / width
            power = 1.0
            for j in range(5):
                m[j] += power
                power *= z
        a, b, c, d, e, f = m[0], m[1], m[2], m[2], m[3], m[4]
        # inverse of the symmetric matrix [[a, b, c], [b, d, e], [c, e, f]]
        i00, i01, i02 = d * f - e * e, c * e - b * f, b * e - c * d
        i11, i12, i22 = a * f - c * c, b * c - a * e, a * d - b * b
        determinant = a * i00 + b * i01 + c * i02
        for column in range(columns):
            y0 = y1 = y2 = 0.0
            for i in range(first, last):
                z = (time[i] - at[index]) / width
                y = values[i, column]
                y0 += y
                y1 += y * z
                y2 += y * z * z
            out[0, index, column] = (i00 * y0 + i01 * y1 + i02 * y2) / determinant
            out[1, index, column] = (i01 * y0 + i11 * y1 + i12 * y2) / determinant / width
            out[2, index, column] = 2.0 * (i02 * y0 + i12 * y1 + i22 * y2) / determinant / width**2
    return out
