"""Exercises of notebook 04, the Kalman filter."""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.stats import multivariate_normal

from fiplib.teaching.exercises.grading import Exercise, positive_definite


def _predicted(j: NDArray, p: NDArray, q: NDArray, step: float) -> NDArray:
    f = np.eye(len(j)) + step * j
    return f @ p @ f.T + q


predict_covariance = Exercise(
    _predicted,
    lambda rng: (rng.normal(size=(4, 4)), *(positive_definite(rng, 4) for _ in range(2)), rng.uniform(0.05, 0.2)),
    {
        "that is the printed form: J alone forgets the identity, and the past": lambda j, p, q, step: j @ p @ j.T + q,
        "dt J forgets the identity: a step adds to the state": lambda j, p, q, step: step**2 * j @ p @ j.T + q,
        "dt is missing: f is a rate, a step of it is dt f": lambda j, p, q, step: _predicted(j, p, q, 1.0),
        "Q_e is missing: the filter would trust its model fully": lambda j, p, q, step: _predicted(j, p, 0 * q, step),
        "transposes are exchanged: F x has the covariance F P F'": lambda j, p, q, step: _predicted(j.T, p, q, step),
        "the transpose is missing: F stands on both sides, transposed on the right": lambda j, p, q, step: (
            (f := np.eye(len(j)) + step * j) @ p @ f + q
        ),
        "F stands on both sides: a covariance is turned from the left and from the right": lambda j, p, q, step: (
            (np.eye(len(j)) + step * j) @ p + q
        ),
        "1 is added to every entry: the identity is np.eye": lambda j, p, q, step: (f := 1 + step * j) @ p @ f.T + q,
        "the term of second order in dt is missing: multiply F P F' out": lambda j, p, q, step: (
            p + step * (j @ p + p @ j.T) + q
        ),
        "Q_e is added after the step, it does not go through it": lambda j, p, q, step: _predicted(
            j, p + q, 0 * q, step
        ),
        "* multiplies entry by entry: matrices are multiplied by @": lambda j, p, q, step: (
            (f := np.eye(len(j)) + step * j) * p * f.T + q
        ),
        "no exponential of the entries: an Euler step is the identity plus dt J": lambda j, p, q, step: (
            (f := np.exp(step * j)) @ p @ f.T + q
        ),
        "the right factor is transposed, not inverted": lambda j, p, q, step: (
            (f := np.eye(len(j)) + step * j) @ p @ np.linalg.inv(f) + q
        ),
        "the covariance does not follow an Euler step of its own: the state's map turns it": lambda j, p, q, step: (
            p + step * j @ p @ j.T + q
        ),
    },
    "a linear map turns a covariance from both sides; which map does the state follow, and what does noise add?",
    "the covariance of F x is F P F'; F is the derivative of x + dt f(x), and the process noise adds Q_e",
    "state and covariance follow the same map now",
    terms=lambda j, p, q, step: {
        "P": p,
        "dt J P": step * j @ p,
        "dt P J'": step * p @ j.T,
        "dt^2 J P J'": step**2 * j @ p @ j.T,
        "Q_e": q,
        "dt Q_e": step * q,
        "dt^2 Q_e": step**2 * q,
    },
)
"""Predicted covariance in the consistent form."""


def _nis(y: NDArray, s: NDArray) -> NDArray:
    return np.einsum("ni,ni->n", y, np.linalg.solve(s, y[..., None])[..., 0])


def _innovations(rng: np.random.Generator) -> tuple[NDArray, NDArray]:
    return rng.normal(size=(5, 3)), np.array([positive_definite(rng, 3) for _ in range(5)])


normalised_innovations = Exercise(
    _nis,
    _innovations,
    {
        "that is the plain square: metres and radians are added, nothing is normalised": lambda y, s: (y**2).sum(1),
        "S is to be inverted: a large covariance makes an innovation small": lambda y, s: _nis(y, np.linalg.inv(s)),
        "only the diagonal of S is used: innovations of different states go together": (
            lambda y, s: (y**2 / np.diagonal(s, axis1=1, axis2=2)).sum(axis=1)
        ),
        "that is the mean: one value for each sample is asked for": lambda y, s: _nis(y, s).mean(),
        "dividing by a determinant is no inverse: directions of small variance count more": lambda y, s: (
            (y**2).sum(1) / np.linalg.det(s)
        ),
        "that is the largest component alone: add all components": lambda y, s: (
            y**2 / np.diagonal(s, axis1=1, axis2=2)
        ).max(axis=1),
        "each sample has its own S: the mean of them all is no one's": lambda y, s: _nis(
            y, np.broadcast_to(s.mean(axis=0), s.shape)
        ),
        "that is y' S^-1 without the second y: S^-1 stands between two innovations": lambda y, s: np.linalg.solve(
            s, y[..., None]
        )[..., 0].sum(axis=1),
        "a trace is one number for all directions: S is to be inverted": lambda y, s: (
            (y**2).sum(1) / np.trace(s, axis1=1, axis2=2)
        ),
    },
    "each innovation is weighed by its own covariance, from both sides",
    "y' S^-1 y for each sample; np.linalg.solve takes a stack of matrices",
    "its mean is the number of measured states, if model and noise are right",
)
"""Normalised innovation squared."""


def _log_likelihood(y: NDArray, s: NDArray) -> float:
    return sum(multivariate_normal.logpdf(row, cov=covariance) for row, covariance in zip(y, s, strict=True))


log_likelihood = Exercise(
    _log_likelihood,
    _innovations,
    {
        "log det S is missing: without it the vaguest filter wins, as it expects anything": (
            lambda y, s: _log_likelihood(y, s) + np.linalg.slogdet(s)[1].sum() / 2
        ),
        "the sign is wrong: large innovations make a length less likely": lambda y, s: -_log_likelihood(y, s),
        "that is -2 log L, small where the likelihood is large: divide by -2": lambda y, s: -2 * _log_likelihood(y, s),
        "the constant n log 2 pi is missing: it moves no optimum, yet belongs to a likelihood": (
            lambda y, s: _log_likelihood(y, s) + y.size * math.log(2 * math.pi) / 2
        ),
        "only the exponential is there: log det S and the constant are missing": lambda y, s: -_nis(y, s).sum() / 2,
        "the determinant itself is added: take its logarithm": lambda y, s: (
            _log_likelihood(y, s) + (np.linalg.slogdet(s)[1] - np.linalg.det(s)).sum() / 2
        ),
        "the sign of log det S is wrong: a large covariance makes each value less likely": lambda y, s: (
            _log_likelihood(y, s) + np.linalg.slogdet(s)[1].sum()
        ),
    },
    "add the logarithms of the densities: each has an exponential, a determinant, and a constant",
    "the sum over the samples of -(y' S^-1 y + log det S + n log 2 pi) / 2",
    "neither a large gain nor a large covariance can flatter this score",
    terms=lambda y, s: {
        "-y' S^-1 y / 2": -_nis(y, s).sum() / 2,
        "-log det S / 2": -np.linalg.slogdet(s)[1].sum() / 2,
        "-n log 2 pi / 2": -y.size * math.log(2 * math.pi) / 2,
    },
)
"""Log likelihood of the innovations."""
