"""The Kalman filter over candidate lengths; ``kalman.filter_step`` is the readable one."""

import math

import numpy as np
from numpy.typing import NDArray

from fiplib.kernels.compiling import compiled
from fiplib.kernels.model import AXIS_INPUTS, AXIS_SIGNS, discretise, of_axis, onward, plus, product, row_of


@compiled()
def _invert(matrix: NDArray, first: int) -> float:
    """Replace the positive definite rows ``first`` to ``first`` + 4 by their inverse; returns their determinant.

    The sweep operator: an exchange step of Gauss and Jordan for each pivot leaves the negative inverse.
    """
    determinant = 1.0
    for i in range(5):
        pivot = row_of(matrix, first + i)
        determinant *= pivot[i]
        inverse = 1.0 / pivot[i]
        for row in range(5):
            if row != i:
                factor = pivot[row] * inverse
                for column in range(5):
                    matrix[first + row, column] -= factor * pivot[column]
                matrix[first + row, i] = matrix[first + i, row] = factor
        matrix[first + i, i] = -inverse
    for row in range(first, first + 5):
        for column in range(5):
            matrix[row, column] = -matrix[row, column]
    return determinant


@compiled("void(f8[::1], f8[:,::1], f8[:,::1], f8, i8, i8, f8[:,::1], f8[:,::1], f8[::1])")
def fitness(
    lengths: NDArray,
    states: NDArray,
    inputs: NDArray,
    step: float,
    transition: int,
    score: int,
    q: NDArray,
    r: NDArray,
    result: NDArray,
) -> None:
    """Write the fitness (C,) of candidate lengths (C,).

    ``kalman.filter_step`` per axis, shortened as H = I and a diagonal R allow: with G = S^-1, K = I - R G,
    P+ = R - R G R and x+ = z - R G y.

    Args:
        lengths: in m, (C,).
        states, inputs, step: as in ``kalman.Window``.
        transition: 0 'printed', 1 'euler', 2 'rk4', as in ``kalman.READINGS``.
        score: 0 'posterior', 1 'prior', 2 'likelihood'.
        q, r: variances per axis, (2, 5).
        result: (C,).
    """
    same = True
    for i in range(5):
        same = same and q[0, i] == q[1, i] and r[0, i] == r[1, i]
    f, j, half, b, x = np.empty((5, 5)), np.empty((5, 5)), np.empty((5, 5)), np.empty((1, 5)), np.empty((2, 5))
    p, g = np.empty((10, 5)), np.empty((10, 5))  # one axis below the other
    for candidate in range(len(lengths)):
        discretise(lengths[candidate], step, 4 if transition == 2 else 1, f, b[0])
        j[:] = f
        if transition == 0:  # as printed: the continuous Jacobian
            for i in range(5):
                for m in range(5):
                    j[i, m] = (f[i, m] - (i == m)) / step
        total = 0.0
        p[:] = 0.0
        for axis in range(2):
            for i in range(5):
                p[5 * axis + i, i] = r[axis, i]
            x[axis, 0], x[axis, 1], x[axis, 2], x[axis, 3], x[axis, 4] = of_axis(axis, states, 0)
        for k in range(1, len(states)):
            for axis in range(2):
                if axis == 0 or not same:  # axes of equal noise share their covariances
                    for i in range(5):
                        half[0, i], half[1, i], half[2, i], half[3, i], half[4, i] = onward(j, row_of(p, 5 * axis + i))
                    for i in range(5):
                        m = 5 * axis + i
                        g[m, 0], g[m, 1], g[m, 2], g[m, 3], g[m, 4] = onward(j, row_of(half, i))  # J P J'
                        g[m, i] += q[axis, i] + r[axis, i]
                    determinant = _invert(g, 5 * axis)
                    for row in range(5):
                        for column in range(5):
                            p[5 * axis + row, column] = -r[axis, row] * g[5 * axis + row, column] * r[axis, column]
                        p[5 * axis + row, row] += r[axis, row]
                if score == 2:
                    total += math.log(determinant)
                u = AXIS_SIGNS[axis] * inputs[k - 1, AXIS_INPUTS[axis]]
                z = of_axis(axis, states, k)
                predicted = plus(onward(f, row_of(x, axis)), b, 0, u)
                y = (
                    z[0] - predicted[0],
                    z[1] - predicted[1],
                    z[2] - predicted[2],
                    z[3] - predicted[3],
                    z[4] - predicted[4],
                )
                weighted = product(g, y, 0 if same else 5 * axis)
                for i in range(5):
                    residual = r[axis, i] * weighted[i]
                    x[axis, i] = z[i] - residual
                    if score == 0:
                        total += residual * residual
                    elif score == 1:
                        total += y[i] * y[i]
                    else:
                        total += y[i] * weighted[i]
        result[candidate] = total if math.isfinite(total) else math.inf
