"""Kalman filter over a window of flight data, for one or for thousands of candidate lengths at once.

Every state is measured (H = I), noise covariances are diagonal, and the model splits into two equal axes
(``params.AXES``). Two facts then make the filter short and fast:

- Covariances, and so the gains, depend on the length but not on the data: ``gains`` computes them once, ``score``
  reuses them for every window.
- With H = I the inverse innovation covariance G = S^-1 says all: K = I - R G, P+ = R - R G R, x - x+ = R G y. The
  filter shrinks to a recursion of the innovation, y_{k+1} = e_k + F R G_k y_k, where e_k = x_{k+1} - F x_k - B u_k
  is the one-step prediction error of the raw data.

The paper does not say how the filter starts. Our choice: the first measurement, with covariance R_e, is the first
posterior; the first innovation is that of the second sample.

Each candidate is computed on its own, by element-wise operations or by products of its own 5 x 5 matrices: its fitness
is the same to the last bit whatever else is in the batch.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fiplib.dynamics import axis_matrices
from fiplib.params import AXES, INPUTS, STATES, Estimation

CHUNK = 1000
"""Candidates filtered together: few enough for the cache, many enough to hide Python's own time."""

CHUNK_SAMPLES = 300_000
"""Candidates times samples filtered together at most: bounds the memory of long windows to about 120 MB."""


class Reading(NamedTuple):
    """One reading of the paper's filter: how the state and its covariance advance, and what is summed as fitness."""

    transition: str
    score: str


READINGS = {
    f"{t}_{s}": Reading(t, s) for t in ("printed", "euler", "rk4") for s in ("posterior", "prior", "likelihood")
}
READINGS["paper"] = READINGS["printed_posterior"]
"""Transitions: 'printed' advances the state by Euler and its covariance with the continuous J = df/dx, as the paper
writes it; 'euler' takes J = I + dt df/dx; 'rk4' takes the Runge-Kutta map of the MPC for both. Scores, summed over the
window: 'posterior' |x - x+|^2, as printed; 'prior' |y|^2; 'likelihood' y' S^-1 y + log det S, i.e. -2 log L."""

_ORDER = [index for axis in AXES for index in axis.states]
_SIGNS = np.array([[1.0, 1.0, 1.0, 1.0, axis.sign] for axis in AXES])


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
class Gains:
    """What the filter knows of C candidates before it sees the data. Axes of equal noise share one filter, A = 1.

    Attributes:
        transition: F of one axis, (C, 5, 5).
        feedback: F R_e, (C, A, 5, 5).
        input_matrix: discrete-time B of one axis, (C, 5).
        information: S_k^-1 for the samples 1 to n - 1, (n - 1, C, A, 5, 5).
        log_determinant: sum over samples and axes of log det S_k, (C,).
    """

    transition: NDArray
    feedback: NDArray
    input_matrix: NDArray
    information: NDArray
    log_determinant: NDArray

    def __getitem__(self, candidates: slice | NDArray) -> "Gains":
        """The gains of some of the candidates."""
        first, last = (self.transition, self.feedback, self.input_matrix), self.log_determinant
        return Gains(*(value[candidates] for value in first), self.information[:, candidates], last[candidates])


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
    """The reading named by ``estimation.fitness``; ValueError with the known names if there is none."""
    try:
        return READINGS[estimation.fitness]
    except KeyError:
        raise ValueError(f"unknown reading {estimation.fitness!r}; readings are {', '.join(READINGS)}") from None


def fitness(lengths: ArrayLike, window: Window, estimation: Estimation) -> NDArray:
    """Fitness of candidate lengths (paper, section 2.3), smaller is better.

    Args:
        lengths: candidates in m, (C,).
        window: the data.
        estimation: noise covariances and the name of the reading.

    Returns:
        (C,): a sum of squares in mixed units, as printed, for 'posterior' and 'prior'; -2 log likelihood up to a
        constant for 'likelihood'. Infinite where the filter overflowed.

    Raises:
        ValueError: unknown reading, noise of the wrong size or sign, lengths that are not positive and finite.
    """
    lengths = _checked_lengths(lengths)
    if lengths.ndim != 1:
        raise ValueError(f"lengths must have shape (C,), got {lengths.shape}")
    result = np.empty(len(lengths))
    for part in _chunks(len(lengths), len(window.states)):
        result[part] = score(gains(lengths[part], len(window.states), window.step, estimation), window, estimation)
    return result


def filter_window(lengths: ArrayLike, window: Window, estimation: Estimation) -> Filtered:
    """The whole filter, for a look inside. Memory: about 1 kB per candidate and sample. Errors as ``fitness``."""
    lengths = _checked_lengths(lengths)
    gain = gains(lengths.ravel(), len(window.states), window.step, estimation)
    _, r = _noise(estimation)
    y, weighted = (np.stack(values, axis=1) for values in zip(*_filter(gain, window), strict=True))
    innovations, residuals = _unsplit(y), _unsplit(r[:, :, None] * weighted)
    covariances = np.zeros((*innovations.shape, len(STATES)))
    blocks = np.linalg.inv(gain.information).swapaxes(0, 1)
    for axis, sign, block in zip(AXES, _SIGNS, (0, -1), strict=True):  # a shared filter has one block, first and last
        rows = np.array(axis.states)
        covariances[..., rows[:, None], rows] = blocks[:, :, block] * np.outer(sign, sign)
    nis = np.sum(y * weighted, axis=(2, 3, 4))
    values = (innovations, covariances, window.states[1:] - residuals, nis)
    return Filtered(*(value.reshape(*lengths.shape, *value.shape[1:]) for value in values))


def gains(lengths: NDArray, samples: int, step: float, estimation: Estimation) -> Gains:
    """The covariance recursion over ``samples`` samples, ``step`` s apart, for the lengths (C,). Errors as ``fitness``.

    Candidates lie along the last axis here: every operation is element-wise over contiguous memory.
    """
    lengths = _checked_lengths(lengths)
    transition, input_matrix, jacobian = _discretise(lengths, step, reading(estimation).transition)
    q, r = (np.ascontiguousarray(noise.T)[..., None] for noise in _noise(estimation))  # (5, A, 1)
    identity, groups = np.eye(5)[..., None, None], r.shape[1]
    prediction_noise, r_diagonal, r_outer = (q + r) * identity, r * identity, r[:, None] * r
    information = np.empty((samples - 1, len(lengths), groups, 5, 5))
    log_determinant = np.zeros((groups, len(lengths)))
    for part in _chunks(len(lengths), samples):
        j = np.ascontiguousarray(np.moveaxis(jacobian[part], 0, -1))[:, :, None]  # (5, 5, 1, C)
        posterior = np.broadcast_to(r_diagonal, (5, 5, groups, j.shape[-1]))
        for k in range(samples - 1):
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
                s = _times(j, _times(j, posterior).swapaxes(0, 1))  # J (J P)' = J P J', as P is symmetric
                s += prediction_noise
                log_determinant[:, part] += np.log(_invert(s))
                information[k, part] = s.transpose(3, 2, 0, 1)
                posterior = r_diagonal - r_outer * s
    feedback = transition[:, None] * r[..., 0].T[:, None]
    total = len(AXES) // groups * log_determinant.sum(axis=0)  # a shared filter counts once for each axis
    return Gains(transition, feedback, input_matrix, information, total)


def score(gain: Gains, window: Window, estimation: Estimation) -> NDArray:
    """Fitness (C,) of the candidates whose gains are given, computed for this window's size, step and estimation."""
    _, r = _noise(estimation)
    kind = reading(estimation).score
    result = np.empty(len(gain.log_determinant))
    for chunk in _chunks(len(result), len(window.states)):
        part = gain[chunk]
        total = 0.0
        with np.errstate(over="ignore", invalid="ignore"):
            for y, weighted in _filter(part, window):
                if kind == "prior":
                    total += y * y
                elif kind == "posterior":
                    total += (r[:, :, None] * weighted) ** 2  # x - x+ = R S^-1 y
                else:
                    total += y * weighted
        result[chunk] = total.sum(axis=(1, 2, 3)) + (part.log_determinant if kind == "likelihood" else 0.0)
    result[~np.isfinite(result)] = np.inf
    return result


def _filter(gain: Gains, window: Window) -> Iterator[tuple[NDArray, NDArray]]:
    """Innovation y_k and S_k^-1 y_k for the samples 1 to n - 1, each (C, A, 5, M) with A * M = 2 axes."""
    updates, candidates, groups = gain.information.shape[:3]
    # One column per sample and axis, so that each candidate needs a single product
    states = (window.states[:, _ORDER].reshape(-1, len(AXES), 5) * _SIGNS).reshape(-1, 5).T
    rates = np.stack([axis.sign * window.inputs[:-1, axis.input] for axis in AXES], axis=1).ravel()
    predicted = gain.transition @ states[:, : -len(AXES)] + gain.input_matrix[:, :, None] * rates
    errors = (states[:, len(AXES) :] - predicted).reshape(candidates, 5, updates, groups, len(AXES) // groups)
    errors = np.ascontiguousarray(errors.transpose(2, 0, 3, 1, 4))
    correction = 0.0
    for error, information in zip(errors, gain.information, strict=True):
        y = error + correction
        weighted = information @ y
        yield y, weighted
        correction = gain.feedback @ weighted


def _discretise(lengths: NDArray, step: float, transition: str) -> tuple[NDArray, NDArray, NDArray]:
    """F (C, 5, 5) and B (C, 5) that advance one axis of the state, and J (C, 5, 5) that advances its covariance."""
    a, b = axis_matrices(lengths)
    # Of the exponential series of A dt, Euler keeps the first order, RK4 the fourth; the input is held over the step
    power = np.broadcast_to(np.eye(5), a.shape)
    f, integral = power, 0.0
    for order in range(1, 5 if transition == "rk4" else 2):
        integral = integral + power * (step / order)
        power = power @ a * (step / order)
        f = f + power
    return f, (integral @ b)[..., 0], a if transition == "printed" else f


_FED_BY = {0: slice(0, 1), 1: slice(0, 2), 2: slice(2, 4), 3: slice(2, 4)}
"""Rows that are not zero in the first four columns of F and J; the tilt, column 4, feeds every row."""


def _times(jacobian: NDArray, matrix: NDArray) -> NDArray:
    """Product J M over the first two axes, element-wise over the others, leaving out the zeros of J."""
    result = jacobian[:, 4, None] * matrix[4]
    for column, rows in _FED_BY.items():
        result[rows] += jacobian[rows, column, None] * matrix[column]
    return result


def _invert(matrix: NDArray) -> NDArray:
    """Replace positive definite matrices (5, 5, ...) by their inverses (sweep operator); return their determinants."""
    determinant = 1.0
    for i in range(5):
        row = matrix[i].copy()
        determinant = determinant * row[i]
        scaled = row / row[i]
        matrix -= row[:, None] * scaled
        matrix[i] = matrix[:, i] = scaled
        matrix[i, i] = -1.0 / row[i]
    np.negative(matrix, out=matrix)
    return determinant


def _unsplit(values: NDArray) -> NDArray:
    """From one block per axis, (..., A, 5, M), to the ten states, (..., 10)."""
    leading = values.shape[:-3]
    values = values.swapaxes(-1, -2).reshape(*leading, len(AXES), 5) * _SIGNS
    return values.reshape(*leading, -1)[..., np.argsort(_ORDER)]


def _noise(estimation: Estimation) -> tuple[NDArray, NDArray]:
    """Diagonals of Q_e and R_e per axis: (1, 5) each if both axes have the same noise, else (2, 5)."""
    diagonals = []
    for name, positive in (("process_noise", False), ("measurement_noise", True)):
        noise = np.asarray(getattr(estimation, name), dtype=float)
        if noise.shape != (len(STATES),):
            raise ValueError(f"{name} must hold {len(STATES)} variances, got shape {noise.shape}")
        if not (np.isfinite(noise).all() and (noise > 0 if positive else noise >= 0).all()):
            raise ValueError(f"{name} must be finite and {'positive' if positive else 'not negative'}, got {noise}")
        diagonals.append(noise[_ORDER].reshape(len(AXES), 5))
    shared = all((noise == noise[0]).all() for noise in diagonals)
    return tuple(noise[:1] if shared else noise for noise in diagonals)


def _chunks(candidates: int, samples: int) -> Iterator[slice]:
    """Slices that cut a number of candidates into chunks of bounded memory."""
    size = max(1, min(CHUNK, CHUNK_SAMPLES // samples))
    return (slice(start, start + size) for start in range(0, candidates, size))


def _checked_lengths(lengths: ArrayLike) -> NDArray:
    lengths = np.asarray(lengths, dtype=float)
    if not (np.isfinite(lengths).all() and (lengths > 0).all()):
        raise ValueError("lengths must be positive and finite")
    return lengths
