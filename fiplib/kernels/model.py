"""The prediction model of one axis (``dynamics.axis_matrices`` is the readable one), and products of its 5-vectors.

Vectors are tuples here: numba keeps those in registers.
"""

import numpy as np
from numpy.typing import NDArray

from fiplib.kernels.compiling import compiled
from fiplib.params import AXES, GRAVITY

AXIS_STATES = np.array([axis.states for axis in AXES])
AXIS_INPUTS = np.array([axis.input for axis in AXES])
AXIS_SIGNS = np.array([axis.sign for axis in AXES])
"""With z of an axis as in ``params.Axis``: z[4] and the input carry the sign of the axis."""


@compiled()
def discretise(length: float, step: float, order: int, f: NDArray, b: NDArray) -> None:
    """Write F (5, 5) and B (5,) of one axis of the model (``dynamics.axis_matrices``), its input held over the step.

    They are sum (A dt)^n / n! and dt sum (A dt)^n b / (n + 1)! up to ``order``: 1 is Euler's method, 4 is RK4.
    """
    stiffness = 2.0 * GRAVITY / length
    f[:] = np.eye(5)
    b[:] = 0.0
    b[4] = step
    power, product = np.eye(5), np.empty((5, 5))
    for n in range(1, order + 1):
        share = step / n
        for column in range(5):
            product[0, column] = power[1, column] * share
            product[1, column] = GRAVITY * power[4, column] * share
            product[2, column] = power[3, column] * share
            product[3, column] = (stiffness * power[2, column] - GRAVITY * power[4, column]) * share
            product[4, column] = 0.0
        power[:] = product
        for row in range(5):
            if n < order:
                b[row] += step / (n + 1) * power[row, 4]
            for column in range(5):
                f[row, column] += power[row, column]


@compiled()
def dot(matrix: NDArray, i: int, z: tuple) -> float:
    """Row i of a matrix with at least 5 columns times z. In pairs, which is two additions faster than in a row."""
    pairs = (matrix[i, 0] * z[0] + matrix[i, 1] * z[1]) + (matrix[i, 2] * z[2] + matrix[i, 3] * z[3])
    return pairs + matrix[i, 4] * z[4]


@compiled()
def product(matrix: NDArray, z: tuple, i: int = 0) -> tuple:
    """Rows i to i + 4 of a matrix times z (5,)."""
    z0, z1, z2 = dot(matrix, i, z), dot(matrix, i + 1, z), dot(matrix, i + 2, z)
    return z0, z1, z2, dot(matrix, i + 3, z), dot(matrix, i + 4, z)


@compiled()
def onward(f: NDArray, z: tuple) -> tuple:
    """F z (5,), where F or A of one axis (``discretise``) has numbers: (s, s'), (d, d') and the tilt."""
    return (
        f[0, 0] * z[0] + f[0, 1] * z[1] + f[0, 4] * z[4],
        f[1, 1] * z[1] + f[1, 4] * z[4],
        f[2, 2] * z[2] + f[2, 3] * z[3] + f[2, 4] * z[4],
        f[3, 2] * z[2] + f[3, 3] * z[3] + f[3, 4] * z[4],
        f[4, 4] * z[4],
    )


@compiled()
def backward(f: NDArray, p: tuple) -> tuple:
    """F'p (5,) of the same F."""
    return (
        f[0, 0] * p[0],
        f[0, 1] * p[0] + f[1, 1] * p[1],
        f[2, 2] * p[2] + f[3, 2] * p[3],
        f[2, 3] * p[2] + f[3, 3] * p[3],
        (f[0, 4] * p[0] + f[1, 4] * p[1]) + (f[2, 4] * p[2] + f[3, 4] * p[3]) + f[4, 4] * p[4],
    )


@compiled()
def plus(z: tuple, matrix: NDArray, i: int, factor: float) -> tuple:
    """z + factor * (row i of a matrix)."""
    return (
        z[0] + matrix[i, 0] * factor,
        z[1] + matrix[i, 1] * factor,
        z[2] + matrix[i, 2] * factor,
        z[3] + matrix[i, 3] * factor,
        z[4] + matrix[i, 4] * factor,
    )


@compiled()
def row_of(matrix: NDArray, i: int) -> tuple:
    return matrix[i, 0], matrix[i, 1], matrix[i, 2], matrix[i, 3], matrix[i, 4]


@compiled()
def of_axis(axis: int, x: NDArray, k: int) -> tuple:
    """z (5,) of an axis from row k of states or references (..., 10)."""
    i = AXIS_STATES
    z0, z1, z2, z3 = x[k, i[axis, 0]], x[k, i[axis, 1]], x[k, i[axis, 2]], x[k, i[axis, 3]]
    return z0, z1, z2, z3, AXIS_SIGNS[axis] * x[k, i[axis, 4]]
