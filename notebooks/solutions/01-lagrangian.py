"""Solutions of the exercises in 01-lagrangian."""

import numpy as np

from fiplib.params import GRAVITY


def height_rate(a, b, a_rate, b_rate, length):
    # a a' + b b' + zeta zeta' = 0: the height falls as the offsets grow
    return -(a * a_rate + b * b_rate) / np.sqrt((length / 2) ** 2 - a**2 - b**2)


def mass_matrix(a, b, length):
    # t_a . t_a = 1 + a^2 / zeta^2, t_a . t_b = a b / zeta^2
    n = np.array([a, b])
    return np.eye(2) + np.outer(n, n) / ((length / 2) ** 2 - a**2 - b**2)


def accelerations(a, b, a_rate, b_rate, seat_acceleration, length, g=GRAVITY):
    r = length / 2
    height = np.sqrt(r**2 - a**2 - b**2)
    q = np.array([a, b, height]) / r
    q_rate = np.array([a_rate, b_rate, -(a * a_rate + b * b_rate) / height]) / r
    alpha = seat_acceleration + np.array([0, 0, g])
    acceleration = -r * (q_rate @ q_rate) * q - (alpha - q * (q @ alpha))
    return acceleration[:2]


def inertia_factor(ratio):
    # both sums for a rod of mass 1 and length 1, divided by the whole mass
    r = (1 / 2 + ratio) / (1 + ratio)
    about_seat = (1 / 3 + ratio) / (1 + ratio)
    return r**2 / about_seat
