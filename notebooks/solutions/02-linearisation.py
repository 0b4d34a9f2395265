"""Solutions of the exercises in 02-linearisation."""

import math

import numpy as np

from fiplib.params import GRAVITY


def growth_rate(length, gyration_ratio, g=GRAVITY):
    # lambda = (l/2)^2 / ((l/2)^2 + k^2), and d'' = s^2 d
    inertia_factor = 1 / (1 + 4 * gyration_ratio)
    return math.sqrt(inertia_factor * 2 * g / length)


def axis_matrix(length, inertia_factor, g=GRAVITY):
    a = np.zeros((5, 5))
    a[0, 1] = a[2, 3] = 1
    a[1, 4] = g
    a[3, 2] = inertia_factor * 2 * g / length
    a[3, 4] = -inertia_factor * g
    return a


def steady_lean(radius, period, length, g=GRAVITY):
    # -w^2 c = 2 g c / l + w^2 R
    w = 2 * math.pi / period
    return -radius * w**2 / (w**2 + 2 * g / length)


def controllable_states(first_length, second_length, g=GRAVITY):
    a, b = np.zeros((7, 7)), np.eye(7)[:, 6:]
    a[0, 1] = a[2, 3] = a[4, 5] = 1
    a[1, 6], a[3, 6], a[5, 6] = g, -g, -g
    a[3, 2], a[5, 4] = 2 * g / first_length, 2 * g / second_length
    return np.linalg.matrix_rank(
        np.hstack([np.linalg.matrix_power(a, n) @ b for n in range(7)])
    )
