"""Solutions of the exercises in 04-kalman-filter."""

import math

import numpy as np


def predict_covariance(j, p, q, step):
    # the derivative of x + f(x) dt
    f = np.eye(len(j)) + step * j
    return f @ p @ f.T + q


def normalised_innovations(y, s):
    nis = np.array(
        [
            row @ np.linalg.solve(covariance, row)
            for row, covariance in zip(y, s, strict=True)
        ]
    )
    return nis


def log_likelihood(y, s):
    _, log_determinants = np.linalg.slogdet(s)
    constant = y.size * math.log(2 * math.pi)
    return -(normalised_innovations(y, s).sum() + log_determinants.sum() + constant) / 2
