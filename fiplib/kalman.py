"""Kalman filter over a window of flight data, with a candidate length in its model: the fitness of that length.

``filter_step`` is the filter as a textbook has it, one line an equation of the paper, and ``filter_window`` runs it
over a window. ``fitness`` is the same filter in a compiled loop (``kernels.filtering``), for thousands of lengths: each
candidate is computed on its own, so its fitness is the same to the last bit whatever else is in the batch.

Every state is measured (H = I) and noise covariances are diagonal. The paper does not say how the filter starts. Our
choice: the first measurement, with covariance R_e, is the first posterior; the first innovation is that of the second
sample.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from fiplib.dynamics import jacobians, prediction_model, rk4
from fiplib.params import AXES, INPUTS, STATES, Estimation


class LinearModel(NamedTuple):
    """x_{k+1} = F x_k + B u_k, (10, 10) and (10, 2); J (10, 10) advances the covariance."""

    transition: NDArray
    input_matrix: NDArray
    jacobian: NDArray


def filter_step(
    x: NDArray, P: NDArray, u: NDArray, z: NDArray, model: LinearModel, Q: NDArray, R: NDArray
) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Advance the filter by one sample: eqs. (19) to (25) of the paper, H = I.

    Args:
        x: last posterior, (10,).
        P: its covariance, (10, 10).
        u: input since then, (2,).
        z: measured state, (10,).
        model: F, B and J.
        Q: process noise Q_e, (10, 10).
        R: measurement noise R_e, (10, 10).

    Returns:
        Posterior x (10,) and its covariance P (10, 10); innovation y (10,) and its covariance S (10, 10).
    """
    F, B, J = model
    x = F @ x + B @ u  # (19)
    P = J @ P @ J.T + Q  # (20)
    y = z - x  # (21)
    S = P + R  # (22)
    K = P @ np.linalg.inv(S)  # (23)
    return x + K @ y, (np.eye(len(x)) - K) @ P, y, S  # (24), (25)


class Reading(NamedTuple):
    """One interpretation of the paper's filter: propagation of state and covariance, and summand of the fitness."""

    transition: str
    score: str


TRANSITIONS, SCORES = ("printed", "euler", "rk4"), ("posterior", "prior", "likelihood")

READINGS = {f"{t}_{s}": Reading(t, s) for t in TRANSITIONS for s in SCORES}
READINGS["paper"] = READINGS["printed_posterior"]
"""Transitions: 'printed' advances the state by Euler and its covariance with the continuous J = df/dx, as the paper
writes it; 'euler' takes J = I + dt df/dx; 'rk4' takes the Runge-Kutta map of the MPC for both. Scores, summed over the
window: 'posterior' |x - x+|^2, as printed; 'prior' |y|^2; 'likelihood' y' S^-1 y + log det S, i.e. -2 log L."""


@dataclass(frozen=True)
class Window:
    """A stretch of evenly sampled flight data.

    Attributes:
        states: measured states, (n, 10), in the order and units of ``params.STATES``.
        inputs: body rates in rad/s, (n, 2); ``inputs[k]`` acts from sample k to k + 1, so the last one is not used.
        step: sampling period in s.

    Raises:
        ValueError: wrong shapes, fewer than two samples, a value that is not finite, a step that is not positive.
    """

    states: NDArray
    inputs: NDArray
    step: float

    def __post_init__(self) -> None:
        for name, width in (("states", len(STATES)), ("inputs", len(INPUTS))):
            array = np.asarray(getattr(self, name), dtype=float)
            if array.shape[1:] != (width,):
                raise ValueError(f"window {name} must have shape (n, {width}), got {array.shape}")
            if not np.isfinite(array).all():
                raise ValueError(f"window {name} hold values that are not finite")
            object.__setattr__(self, name, array)
        if len(self.states) != len(self.inputs):
            raise ValueError(f"window has {len(self.states)} states but {len(self.inputs)} inputs")
        if len(self.states) < 2:
            raise ValueError(f"window must hold at least 2 samples, got {len(self.states)}")
        if not (np.isfinite(self.step) and self.step > 0):
            raise ValueError(f"window step must be positive and finite, got {self.step}")


@dataclass(frozen=True)
class Filtered:
    """A filtered window for lengths of any shape (...); all in the order of ``params.STATES``, samples 1 to n - 1.

    Attributes:
        innovations: y_k, (..., n - 1, 10).
        covariances: S_k, (..., n - 1, 10, 10).
        posteriors: x_k+, (..., n - 1, 10).
        nis: normalised innovation squared y' S^-1 y, (..., n - 1); chi-squared with 10 degrees of freedom if the
            model and the noise are right.
    """

    innovations: NDArray
    covariances: NDArray
    posteriors: NDArray
    nis: NDArray


def reading(estimation: Estimation) -> Reading:
    """Return the interpretation that ``estimation.fitness`` names; ValueError with the known names if there is none."""
    try:
        return READINGS[estimation.fitness]
    except KeyError:
        raise ValueError(f"unknown reading {estimation.fitness!r}; readings are {', '.join(READINGS)}") from None


def linear_model(length: float, step: float, transition: str) -> LinearModel:
    """Return the prediction model of a length in m over ``step`` s, in one of the ``TRANSITIONS``."""
    continuous, discrete = _derivatives(step)
    A, B = (matrix.full() for matrix in continuous(0, 0, length))
    if transition == "rk4":
        F, B_rk4 = (matrix.full() for matrix in discrete(0, 0, length))
        return LinearModel(F, B_rk4, F)
    F = np.eye(len(STATES)) + step * A
    return LinearModel(F, step * B, A if transition == "printed" else F)


@lru_cache(maxsize=4)
def _derivatives(step: float) -> tuple[ca.Function, ca.Function]:
    f = prediction_model()
    return jacobians(f), jacobians(rk4(f, step))


def fitness(lengths: ArrayLike, window: Window, estimation: Estimation) -> NDArray:
    """Fitness of candidate lengths (paper, section 2.3), smaller is better.

    Args:
        lengths: candidates in m, (C,).
        window: the data.
        estimation: noise covariances and the name of the interpretation.

    Returns:
        (C,): a sum of squares in mixed units, as printed, for 'posterior' and 'prior'; -2 log likelihood up to a
        constant for 'likelihood'. Infinite where the filter overflowed.

    Raises:
        ValueError: unknown interpretation, noise of the wrong size or sign, lengths that are not positive and finite.
    """
    from fiplib.kernels import (
        filtering,  # here and not above: numba takes a while, and not all who read windows filter them
    )

    lengths = _checked_lengths(lengths)
    if lengths.ndim != 1:
        raise ValueError(f"lengths must have shape (C,), got {lengths.shape}")
    transition, score = reading(estimation)
    q, r = (variances[[axis.states for axis in AXES]] for variances in _noise(estimation))
    result = np.empty(len(lengths))
    data = (np.array(window.states, order="C"), np.array(window.inputs, order="C"), window.step)  # copies lie as C asks
    filtering.fitness(lengths, *data, TRANSITIONS.index(transition), SCORES.index(score), q, r, result)
    return result


def filter_window(lengths: ArrayLike, window: Window, estimation: Estimation) -> Filtered:
    """Return the textbook's filter over a window, for a look inside; takes some ms a length. Errors as ``fitness``."""
    lengths = _checked_lengths(lengths)
    transition, (Q, R) = reading(estimation).transition, map(np.diag, _noise(estimation))
    samples = len(window.states) - 1
    y, posterior = np.empty((2, lengths.size, samples, len(STATES)))
    S = np.empty((*y.shape, len(STATES)))
    for i, length in enumerate(lengths.flat):
        x, P, system = window.states[0], R, linear_model(length, window.step, transition)
        for k in range(samples):
            x, P, y[i, k], S[i, k] = filter_step(x, P, window.inputs[k], window.states[k + 1], system, Q, R)
            posterior[i, k] = x
    nis = np.einsum("...i,...i", y, np.linalg.solve(S, y[..., None])[..., 0])
    return Filtered(*(value.reshape(*lengths.shape, *value.shape[1:]) for value in (y, S, posterior, nis)))


def _noise(estimation: Estimation) -> list[NDArray]:
    """Diagonals of Q_e and R_e, (10,) each."""
    diagonals = []
    for name, positive in (("process_noise", False), ("measurement_noise", True)):
        noise = np.asarray(getattr(estimation, name), dtype=float)
        if noise.shape != (len(STATES),):
            raise ValueError(f"{name} must hold {len(STATES)} variances, got shape {noise.shape}")
        if not (np.isfinite(noise).all() and (noise > 0 if positive else noise >= 0).all()):
            raise ValueError(f"{name} must be finite and {'positive' if positive else 'not negative'}, got {noise}")
        diagonals.append(noise)
    return diagonals


def _checked_lengths(lengths: ArrayLike) -> NDArray:
    lengths = np.array(lengths, dtype=float)
    if not (np.isfinite(lengths).all() and (lengths > 0).all()):
        raise ValueError("lengths must be positive and finite")
    return lengths
