"""Solutions of the exercises in 03-mpc."""

import numpy as np


def riccati_step(a, b, q, r, p):
    gain = np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)
    return q + a.T @ p @ a - a.T @ p @ b @ gain


def growths(a, b, k, n):
    growth = np.linalg.norm(np.linalg.matrix_power(a, n), 2)
    growth_with_feedback = np.linalg.norm(np.linalg.matrix_power(a - b @ k, n), 2)
    return growth, growth_with_feedback


def state_when_it_acts(a, b, x, sent):
    for u in sent:
        x = a @ x + b @ u
    return x
