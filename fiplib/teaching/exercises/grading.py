"""Graders of the exercises in the notebooks: ``grade_NN_k(answer)`` judges the k-th exercise of notebook NN.

An exercise asks for a function. Its grader calls it at drawn inputs, always the same ones, and compares with the truth,
from fiplib where fiplib has it. A wrong answer is compared with the typical mistakes, each of which is a function too:
whoever made one is told which. To add an exercise, add one ``Exercise`` here.
"""

import copy
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import multivariate_normal

from fiplib.dynamics import axis_matrices
from fiplib.ga import Chromosome
from fiplib.params import GRAVITY, Pendulum

Answer = Callable[..., Any]
"""The function that a student has written."""

DRAWS = 6
"""Inputs that an answer is tried at."""

TOLERANCE = 1e-6
"""Relative to the largest value of a result: far above rounding, far below any mistake in the tables."""


class NotYet(Exception):
    """An answer is not right yet; the message says why, in words."""

    def _render_traceback_(self) -> list[str]:
        """What IPython shows: the message alone, not the path through the grader."""
        return [f"not yet: {self}"]


@dataclass(frozen=True)
class Exercise:
    """A grader: call it with the answer. It prints ``praise``, or raises ``NotYet``.

    Attributes:
        truth: the function asked for; returns a number, an array, or a tuple of these.
        draw: from a generator, the arguments of one trial.
        mistakes: by what is said to whoever makes it, the function that makes it.
        hint: what is said of any other wrong answer.
        praise: what is said of a right one.
    """

    truth: Answer = field(repr=False)
    draw: Callable[[np.random.Generator], tuple] = field(repr=False)
    mistakes: Mapping[str, Answer] = field(repr=False)
    hint: str
    praise: str = field(repr=False)

    def __call__(self, answer: Answer) -> None:
        """Grade an answer; ``NotYet`` says what is wrong with it."""
        rng = np.random.default_rng(0)
        trials = [self.draw(rng) for _ in range(DRAWS)]
        name = getattr(answer, "__name__", "the answer")
        given = [_parts(_called(answer, trial, name), name) for trial in trials]
        expected = self._results(self.truth, trials)
        if all(map(_agree, given, expected)):
            print(f"right: {self.praise}")
            return
        for words, mistake in self.mistakes.items():
            if all(map(_agree, given, self._results(mistake, trials))):
                raise NotYet(words)
        for mine, true in zip(given, expected, strict=True):
            if [part.shape for part in mine] != [part.shape for part in true]:
                raise NotYet(f"{name} should return {_described(true)}, not {_described(mine)}")
            if any(np.isnan(part).any() for part in mine):
                raise NotYet(f"{name} returns nan: is it filled in? is there a root of a negative number, or 0/0?")
        raise NotYet(self.hint)

    @staticmethod
    def _results(function: Answer, trials: list[tuple]) -> list[list[NDArray]]:
        return [_parts(_called(function, trial, "a grader's function"), "it") for trial in trials]


def check(grader: Exercise, answer: Answer) -> None:
    """Grade, and print what is not right yet instead of raising it, so that a notebook runs through."""
    try:
        grader(answer)
    except NotYet as words:
        print(f"not yet: {words}")


def _called(function: Answer, trial: tuple, name: str) -> Any:
    """The result at arguments of its own; whatever goes wrong in it is said in words."""
    try:
        with np.errstate(all="ignore"):
            return function(*copy.deepcopy(trial))
    except Exception as error:
        inside = error.__traceback__.tb_next  # none if the function could not be called
        where = f" in line {inside.tb_lineno} of its cell" if inside else ""
        raise NotYet(f"{name} stops{where} with {type(error).__name__}: {error}") from None


def _parts(result: Any, name: str) -> list[NDArray]:
    """The values of a result as arrays of numbers."""
    values = list(result) if isinstance(result, tuple) else [result]
    if any(value is None or value is ... for value in values):
        raise NotYet(f"{name} returns nothing yet: fill it in")
    try:
        parts = [np.asarray(value) for value in values]
        return [part.astype(complex if np.iscomplexobj(part) else float) for part in parts]
    except (TypeError, ValueError):
        raise NotYet(f"{name} returns neither numbers nor a tuple of them") from None


def _agree(first: list[NDArray], second: list[NDArray]) -> bool:
    """Whether two results are equal but for rounding; nan equals nan, as a mistake may be to make one."""
    if [part.shape for part in first] != [part.shape for part in second]:
        return False
    scales = (np.max(np.abs(part), initial=0.0, where=np.isfinite(part)) for part in second)
    return all(
        np.allclose(a, b, rtol=0.0, atol=TOLERANCE * scale, equal_nan=True)
        for a, b, scale in zip(first, second, scales, strict=True)
    )


def _described(parts: list[NDArray]) -> str:
    return " and ".join(f"an array of shape {part.shape}" if part.ndim else "a number" for part in parts)


def _positive(rng: np.random.Generator, size: int) -> NDArray:
    """A positive definite matrix."""
    root = rng.normal(size=(size, size))
    return root @ root.T + np.eye(size)


# 02: linearisation


def _rate(l: float, k2: float) -> float:
    return np.linalg.eigvals(axis_matrices(l, Pendulum(gyration_ratio=k2).inertia_factor)[0]).real.max()


grade_02_1 = Exercise(
    _rate,
    lambda rng: (rng.uniform(0.2, 2.0), rng.uniform(0.02, 0.2)),
    {
        "that is a point mass: the rod's inertia is missing, lambda = 1 / (1 + 4 k^2/l^2)": lambda l, k2: _rate(l, 0.0),
        "the centre of mass lies at l/2, not at l: 2 g / l": lambda l, k2: _rate(2 * l, k2),
        "that is the square of the rate, its unit 1/s^2: take the root": lambda l, k2: _rate(l, k2) ** 2,
        "that is the root that decays: a rod let go leaves along the other one": lambda l, k2: -_rate(l, k2),
        "the sign of g/l is wrong: a rod that leans falls further, yours swings": lambda l, k2: np.sqrt(-l),
    },
    "start from d'' = lambda 2 g d / l, try d = exp(s t), and keep the positive s",
    "the longer the rod, and the more of its mass at its ends, the slower it falls",
)
"""Growth rate of a leaning rod with inertia."""


def _axis(l: float, f: float, *entry: int, by: float = 1.0) -> NDArray:
    a, _ = axis_matrices(l, f)
    a[entry] *= by
    return a


grade_02_2 = Exercise(
    _axis,
    lambda rng: (rng.uniform(0.2, 2.0), rng.uniform(0.6, 0.95)),
    {
        "the matrix is still empty: five of its entries are not zero": lambda l, f: np.zeros((5, 5)),
        "the sign of g/l is wrong: a rod that leans falls further": lambda l, f: _axis(l, f, 3, 2, by=-1),
        "the sign of the tilt in d'' is wrong: the seat runs away from under the rod, which stays behind": (
            lambda l, f: _axis(l, f, 3, 4, by=-1)
        ),
        "the centre of mass lies at l/2, not at l: 2 g / l": lambda l, f: _axis(l, f, 3, 2, by=0.5),
        "lambda multiplies both terms of d'': the rod's answer to the seat, too": lambda l, f: _axis(
            l, f, 3, 4, by=1 / f
        ),
        "that is the paper's point mass: lambda is missing": lambda l, f: _axis(l, 1.0),
        "it is transposed: row i is the i-th equation": lambda l, f: _axis(l, f).T,
    },
    "row by row: s' = s', s'' = g tilt, d' = d', d'' = lambda (2 g d / l - g tilt), tilt' = rate",
    "this is the rod that flies; with lambda = 1 it is the paper's",
)
"""Matrix of one axis with the rod's inertia."""


def _lean(radius: float, period: float, l: float) -> float:
    w2 = (2 * math.pi / period) ** 2
    return -radius * w2 / (w2 + 2 * GRAVITY / l)


grade_02_3 = Exercise(
    _lean,
    lambda rng: (rng.uniform(0.2, 1.0), rng.uniform(3.0, 10.0), rng.uniform(0.3, 2.0)),
    {
        "the size is right, the side is not: the rod leans inwards, as a cyclist does": lambda r, t, l: -_lean(r, t, l),
        "the angular speed is 2 pi / period: 1 / period counts the rounds": lambda r, t, l: _lean(
            r, 2 * math.pi * t, l
        ),
        "the sign of g/l is wrong: a rod that leans falls further, yours hangs": lambda r, t, l: _lean(r, t, -l),
        "that is the slow limit: the offset goes round as well, and w^2 a counts": lambda r, t, l: (
            -r * (2 * math.pi / t) ** 2 * l / (2 * GRAVITY)
        ),
        "the centre of mass lies at l/2, not at l: 2 g / l": lambda r, t, l: _lean(r, t, 2 * l),
    },
    "put x = R cos(w t) and a = c cos(w t) into a'' = 2 g a / l - x'' and solve for c",
    "as the lean depends on the length, a steady circle tells the length",
)
"""Lean on a steady circle."""

grade_02_4 = Exercise(
    lambda first, second: 5 if first == second else 7,
    lambda rng: (first := rng.uniform(0.3, 1.0), first + rng.integers(2) * rng.uniform(0.3, 0.9)),
    {
        "rods of equal length answer every tilt alike: nothing moves one against the other": lambda first, second: 7,
        "rods of different length fall at different rates, enough to steer them apart": lambda first, second: 5,
        "the rank of [B, A B] alone is 2: go on to A^6 B": lambda first, second: 2,
    },
    "the rank of [B, A B, ..., A^6 B]; powers of matrices with @ or matrix_power, as ** acts on single entries",
    "a vehicle can balance two rods at once, unless they are twins",
)
"""Controllable states with two rods on one vehicle."""


# 03: model predictive control


def _riccati(a: NDArray, b: NDArray, q: NDArray, r: NDArray, p: NDArray) -> NDArray:
    gain = np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)
    closed = a - b @ gain
    return q + gain.T @ r @ gain + closed.T @ p @ closed


grade_03_1 = Exercise(
    _riccati,
    lambda rng: (rng.normal(size=(4, 4)), rng.normal(size=(4, 2)), *(_positive(rng, n) for n in (4, 2, 4))),
    {
        "the sign of the last term is wrong: being free to choose u makes the future cheaper, not dearer": (
            lambda a, b, q, r, p: 2 * (q + a.T @ p @ a) - _riccati(a, b, q, r, p)
        ),
        "the cost of the step itself is missing: add Q": lambda a, b, q, r, p: _riccati(a, b, 0 * q, r, p),
        "R is missing beside B'PB: then control costs nothing": lambda a, b, q, r, p: _riccati(a, b, q, 0 * r, p),
        "the last term is missing: that is the cost of doing nothing, u = 0": lambda a, b, q, r, p: q + a.T @ p @ a,
    },
    "minimise x'Qx + u'Ru + (Ax + Bu)'P(Ax + Bu) over u and put the best u back in; mind the transposes",
    "sixty such steps backwards from P are the whole MPC, as long as no bound is active",
)
"""One step of the Riccati recursion."""


def _grown(a: NDArray, b: NDArray, k: NDArray, n: int, order: float | str = 2) -> tuple[float, float]:
    first, second = (np.linalg.matrix_power(matrix, n) for matrix in (a, a - b @ k))
    return np.linalg.norm(first, order), np.linalg.norm(second, order)


grade_03_2 = Exercise(
    _grown,
    lambda rng: (rng.normal(size=(3, 3)), rng.normal(size=(3, 1)), rng.normal(size=(1, 3)), int(rng.integers(3, 9))),
    {
        "the sign of the feedback is wrong: u = -K x, so the loop is A - B K": lambda a, b, k, n: _grown(a, -b, k, n),
        "** raises single entries to a power: take np.linalg.matrix_power": lambda a, b, k, n: (
            np.linalg.norm(a**n, 2),
            np.linalg.norm((a - b @ k) ** n, 2),
        ),
        "that is the Frobenius norm: the largest growth is np.linalg.norm(M, 2)": (
            lambda a, b, k, n: _grown(a, b, k, n, "fro")
        ),
        "that is the growth of one step: raise the matrices to the number of steps": lambda a, b, k, n: _grown(
            a, b, k, 1
        ),
        "the two are exchanged: first without feedback, then with it": lambda a, b, k, n: _grown(a, b, k, n)[::-1],
    },
    "the largest growth over n steps is the largest singular value of the n-th power of the step's matrix",
    "now try it on the rod: without feedback the end of the plan hangs on the last digits of its beginning",
)
"""Growth over the horizon, without and with feedback."""


def _moved(a: NDArray, b: NDArray, x: NDArray, sent: NDArray) -> NDArray:
    for u in sent:
        x = a @ x + b @ u
    return x


grade_03_3 = Exercise(
    _moved,
    lambda rng: (rng.normal(size=(4, 4)), rng.normal(size=(4, 2)), rng.normal(size=4), rng.normal(size=(3, 2))),
    {
        "that is the state as measured: commands on their way will have moved it": lambda a, b, x, sent: x,
        "commands act in the order they were sent, the oldest first": lambda a, b, x, sent: _moved(a, b, x, sent[::-1]),
        "all commands on their way act before the new one, not only the oldest": (
            lambda a, b, x, sent: _moved(a, b, x, sent[:1])
        ),
        "the rod goes on falling meanwhile: A acts in every step": lambda a, b, x, sent: x + b @ sent.sum(axis=0),
    },
    "one step x = A x + B u for each command that is on its way",
    "planning from where the vehicle will be takes the delay out of the loop, as far as the model holds",
)
"""The state at which a delayed command will act."""


# 04: Kalman filter


def _predicted(j: NDArray, p: NDArray, q: NDArray, step: float) -> NDArray:
    f = np.eye(len(j)) + step * j
    return f @ p @ f.T + q


grade_04_1 = Exercise(
    _predicted,
    lambda rng: (rng.normal(size=(4, 4)), _positive(rng, 4), np.diag(rng.uniform(0.1, 1.0, 4)), rng.uniform(0.05, 0.2)),
    {
        "that is the printed form: J alone forgets the identity, and the filter what it knew": (
            lambda j, p, q, step: j @ p @ j.T + q
        ),
        "dt J alone forgets the identity: x + dt f(x) has the derivative I + dt J": (
            lambda j, p, q, step: step**2 * j @ p @ j.T + q
        ),
        "dt is missing: f is a rate, a step of it is dt f": lambda j, p, q, step: _predicted(j, p, q, 1.0),
        "Q_e is missing: the filter would trust its model wholly": lambda j, p, q, step: _predicted(j, p, 0 * q, step),
        "transposes are exchanged: F x has the covariance F P F'": lambda j, p, q, step: _predicted(j.T, p, q, step),
    },
    "the covariance of F x is F P F'; F is the derivative of x + dt f(x), and the process noise adds Q_e",
    "state and covariance follow the same map now",
)
"""Predicted covariance in the consistent form."""


def _nis(y: NDArray, s: NDArray) -> NDArray:
    return np.einsum("ni,ni->n", y, np.linalg.solve(s, y[..., None])[..., 0])


def _innovations(rng: np.random.Generator) -> tuple[NDArray, NDArray]:
    return rng.normal(size=(5, 3)), np.array([_positive(rng, 3) for _ in range(5)])


grade_04_2 = Exercise(
    _nis,
    _innovations,
    {
        "that is the plain square: metres and radians are added, nothing is normalised": lambda y, s: (y**2).sum(
            axis=1
        ),
        "S is to be inverted: a large covariance makes an innovation small": lambda y, s: _nis(y, np.linalg.inv(s)),
        "only the diagonal of S is used: innovations of different states go together": (
            lambda y, s: (y**2 / np.diagonal(s, axis1=1, axis2=2)).sum(axis=1)
        ),
        "that is the mean: one value for each sample is asked for": lambda y, s: _nis(y, s).mean(),
    },
    "y' S^-1 y for each sample; np.linalg.solve takes a stack of matrices",
    "its mean is the number of measured states, if model and noise are right",
)
"""Normalised innovation squared."""


def _log_likelihood(y: NDArray, s: NDArray) -> float:
    return sum(multivariate_normal.logpdf(row, cov=covariance) for row, covariance in zip(y, s, strict=True))


grade_04_3 = Exercise(
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
    },
    "the sum over the samples of -(y' S^-1 y + log det S + n log 2 pi) / 2",
    "neither a large gain nor a large covariance can flatter this score",
)
"""Log likelihood of the innovations."""


# 05: genetic algorithm


def _decoded(bits: NDArray, low: float, step: float) -> NDArray:
    chromosome = Chromosome(low, step, 2 ** bits.shape[-1])
    return chromosome.length(chromosome.decode(bits))


grade_05_1 = Exercise(
    _decoded,
    lambda rng: (rng.random((6, 15)) < 0.5, rng.uniform(0.1, 0.5), rng.choice([1e-4, 5e-4, 1e-3])),
    {
        "you read backwards: the first bit is the largest, 2^(n-1)": lambda bits, low, step: _decoded(
            bits[:, ::-1], low, step
        ),
        "l_min is missing: code 0 is the shortest length, not none": lambda bits, low, step: _decoded(bits, 0.0, step),
        "that is the code: times the resolution, plus l_min": lambda bits, low, step: _decoded(bits, 0.0, 1.0),
        "the number of ones is not the number they spell: weigh them by powers of two": (
            lambda bits, low, step: low + step * bits.sum(axis=1)
        ),
        "the last bit is worth 1, not 2": lambda bits, low, step: _decoded(bits, low, 2 * step),
    },
    "code = sum of bit_i 2^(n-1-i), i = 0 being the first bit; length = l_min + code * resolution",
    "with the paper's numbers some codes lie beyond 2 m: these are infeasible",
)
"""Lengths from bit strings."""


def _wheel(fitness: NDArray) -> NDArray:
    finite = np.isfinite(fitness)
    weight = np.where(finite, fitness[finite].max() - fitness, 0.0)
    return weight / weight.sum()


grade_05_2 = Exercise(
    _wheel,
    lambda rng: (np.where(np.arange(8) == rng.integers(8), np.inf, rng.normal(-500.0, 200.0, 8)),),
    {
        "your wheel favours the worst: a small fitness is a good one": (
            lambda f: (w := np.where(np.isfinite(f), f - f.min(), 0.0)) / w.sum()
        ),
        "inf - inf is not a number: take the worst of the finite ones": lambda f: (w := f.max() - f) / w.sum(),
        "probabilities sum to one: divide by the sum of the weights": (
            lambda f: np.where(np.isfinite(f), f[np.isfinite(f)].max() - f, 0.0)
        ),
        "1 / fitness is no weight: a fitness may be negative, and its zero means nothing": lambda f: (
            1 / f / (1 / f).sum()
        ),
    },
    "weight = worst finite fitness - fitness, none for the infeasible; divide by the sum of the weights",
    "neither the unit nor the zero of the fitness matters on this wheel",
)
"""Probabilities of the roulette wheel."""


def _diversity(bits: NDArray) -> float:
    ones, n = bits.sum(axis=0), len(bits)
    return (2 * ones * (n - ones)).sum() / (n * (n - 1))


grade_05_3 = Exercise(
    _diversity,
    lambda rng: (rng.random((int(rng.integers(5, 12)), 15)) < rng.uniform(0.1, 0.9, 15),),
    {
        "candidates are compared with themselves, too: there are N (N - 1) pairs": (
            lambda bits: _diversity(bits) * (len(bits) - 1) / len(bits)
        ),
        "that is the sum over the pairs: divide by their number": lambda bits: (
            _diversity(bits) * math.comb(len(bits), 2)
        ),
        "that is the share of the bits: their number is asked for": lambda bits: _diversity(bits) / bits.shape[1],
        "it is twice too large: N candidates make N (N - 1) / 2 pairs": lambda bits: 2 * _diversity(bits),
    },
    "count the bits in which two candidates differ; take the mean over all pairs of different candidates",
    "half the bits in a random population, none in one that has converged, to the truth or too early",
)
"""Diversity of a population."""


# 06: closed loop


def _settled(time: NDArray, offset: NDArray, band: float) -> float:
    inside = np.append(np.abs(offset) <= band, True)
    after = np.flatnonzero(~inside)[-1] + 1 if not inside.all() else 0
    return [*time, math.inf][after]


def _swing(rng: np.random.Generator) -> tuple[NDArray, NDArray, float]:
    """A swing that dies out, never does, or was never large."""
    since = np.arange(400) * 0.01
    size, decay = ((6.0, 1.2), (6.0, 1.2), (6.0, 0.0), (0.3, 0.0))[rng.integers(4)]
    swing = size * np.exp(-decay * since) * np.cos(rng.uniform(3.0, 5.0) * since + rng.uniform(0.0, 6.0))
    return since + rng.uniform(0.0, 5.0), swing, rng.uniform(0.4, 1.0)


grade_06_1 = Exercise(
    _settled,
    _swing,
    {
        "that is the first time inside the band: the rod swings through and leaves it again": (
            lambda t, d, band: t[np.argmax(np.abs(d) <= band)]
        ),
        "the other side counts, too: take the absolute value": lambda t, d, band: _settled(t, np.maximum(d, 0.0), band),
        "that is the last sample outside the band: settled is the next one, and inf if there is none": (
            lambda t, d, band: t[max(np.flatnonzero(np.append(True, np.abs(d) > band))[-1] - 1, 0)]
        ),
    },
    "the time of the sample after the last one outside: inf if there is none, time[0] if all are inside",
    "a settling time says nothing without its band, and the paper names none",
)
"""Settling time."""


def _fused(l1: float, s1: float, l2: float, s2: float, share: float, power: int = 2) -> tuple[float, float]:
    old, new = (1 - share) / s1**power, share / s2**power
    return (old * l1 + new * l2) / (old + new), (old + new) ** (-1 / power)


grade_06_2 = Exercise(
    _fused,
    lambda rng: tuple(rng.uniform([0.6, 0.02, 0.6, 0.02, 0.1], [1.4, 0.1, 1.4, 0.1, 0.4]).tolist()),
    {
        "precisions are added in full: these estimates share data, which is counted twice now": (
            lambda l1, s1, l2, s2, w: _fused(l1, s1 / math.sqrt(2), l2, s2 / math.sqrt(2), 0.5)
        ),
        "the second value is a variance: take the root": (
            lambda l1, s1, l2, s2, w: (_fused(l1, s1, l2, s2, w)[0], _fused(l1, s1, l2, s2, w)[1] ** 2)
        ),
        "a precision is 1 / deviation^2, not 1 / deviation": lambda l1, s1, l2, s2, w: _fused(l1, s1, l2, s2, w, 1),
        "the shares are exchanged: the new estimate has `share`": lambda l1, s1, l2, s2, w: _fused(
            l1, s1, l2, s2, 1 - w
        ),
    },
    "old = (1 - share) / s1^2, new = share / s2^2; these weigh the lengths, and their sum is the new precision",
    "consistent whatever the two estimates have in common: this is covariance intersection",
)
"""Fusing two estimates that share data."""

grade_06_3 = Exercise(
    lambda l, s, c: 1 / (1 / l + c * s / l**2),
    lambda rng: (rng.uniform(0.5, 1.5), rng.uniform(0.1, 0.4), rng.uniform(1.0, 3.0)),
    {
        "that is the wrong side: too long a length lets the rod fall, so be cautious towards short": lambda l, s, c: (
            l + c * s
        ),
        "that may fall below zero: the belief is Gaussian in 1/l, so step there and come back": lambda l, s, c: (
            l - c * s
        ),
        "the deviation of 1/l is not that of l: to first order deviation / length^2": lambda l, s, c: (
            1 / (1 / l + c * s)
        ),
        "the short side of l is the large side of 1/l: add": lambda l, s, c: 1 / (1 / l - c * s / l**2),
        "that is still 1/l: invert it": lambda l, s, c: 1 / l + c * s / l**2,
    },
    "1/l has the mean 1 / length and the deviation deviation / length^2: go up from there, then invert",
    "positive however vague the belief, and short when in doubt",
)
"""A cautious length."""


# 07: explore a bag


def _recording(rng: np.random.Generator) -> tuple[NDArray, NDArray]:
    """Stamps (n,) int64 in ns of a tracker that jitters, and positions (n, 3) in m."""
    steps = rng.integers(2_000_000, 9_000_000, 30)
    return 1_700_000_000_000_000_000 + np.cumsum(steps), np.cumsum(rng.normal(0.0, 1e-3, (30, 3)), axis=0)


def _velocities(stamp: NDArray, position: NDArray) -> NDArray:
    return np.diff(position, axis=0) / (np.diff(stamp)[:, None] / 1e9)


grade_07_1 = Exercise(
    _velocities,
    _recording,
    {
        "stamps are in nanoseconds: yours are a thousand million times too small": lambda t, p: _velocities(t, p) / 1e9,
        "frames do not come evenly: divide each difference by its own time, not by the mean": (
            lambda t, p: np.diff(p, axis=0) / (np.ptp(t) / 1e9 / (len(t) - 1))
        ),
        "frames do not come at exactly 240 Hz: divide each difference by its own time": (
            lambda t, p: np.diff(p, axis=0) * 240.0
        ),
        "the sign is wrong: later minus earlier": lambda t, p: -_velocities(t, p),
    },
    "np.diff(position, axis=0) by np.diff(stamp) in s; stamps are subtracted as whole numbers first",
    "but the closer the frames, the noisier the velocity",
)
"""Velocities between frames at uneven stamps."""

grade_07_2 = Exercise(
    lambda offset, tilt: 2 * (offset @ tilt) / (tilt @ tilt),
    lambda rng: (tilt := rng.normal(0.0, 0.03, 50), rng.uniform(0.15, 0.9) * tilt + rng.normal(0.0, 2e-3, 50))[::-1],
    {
        "that is half the length: the centre of mass lies at l/2": lambda d, tilt: (d @ tilt) / (tilt @ tilt),
        "a mean of ratios is ruled by the moments of hardly any tilt: fit one slope": lambda d, tilt: (
            2 * np.mean(d / tilt)
        ),
        "that regresses the tilt on the offset, whose noise then biases the length": lambda d, tilt: (
            2 * (d @ d) / (d @ tilt)
        ),
        "the ratio is upside down: offset over tilt is a length": lambda d, tilt: 2 * (d @ tilt) / (d @ d),
    },
    "offset = (l/2) tilt: the slope that fits best is sum(offset * tilt) / sum(tilt^2)",
    "in slow motion this ratio is the length, whatever the rod's inertia",
)
"""The length from offset and tilt in slow motion."""


def _fresh(stamp: NDArray, position: NDArray, whole: Answer = np.any) -> NDArray:
    return np.append(True, (np.diff(stamp) > 0) & whole(np.diff(position, axis=0) != 0, axis=1))


def _stuttering(rng: np.random.Generator) -> tuple[NDArray, NDArray]:
    """A recording with frames sent again, frozen poses, and coordinates that stand still by chance."""
    stamp, position = _recording(rng)
    again, frozen, still = np.sort(rng.permutation(np.arange(1, 30))[:9].reshape(3, 3))
    for k in frozen:
        position[k] = position[k - 1]
    position[still, 0] = position[still - 1, 0]
    stamp[again] = stamp[again - 1]
    return stamp, position


grade_07_3 = Exercise(
    _fresh,
    _stuttering,
    {
        "a frozen tracker sends new stamps with an old pose: look at the position, too": (
            lambda t, p: np.append(True, np.diff(t) > 0)
        ),
        "a frame sent again has the stamp of the one before: look at the stamps, too": (
            lambda t, p: _fresh(np.arange(len(t)), p)
        ),
        "one coordinate may stand still by chance: frozen are all three": lambda t, p: _fresh(t, p, np.all),
        "that is the other way round: True keeps a frame": lambda t, p: ~_fresh(t, p),
        "the first frame has none before it: keep it, one value for each frame": lambda t, p: _fresh(t, p)[1:],
    },
    "compare each frame with the one before; keep it if its stamp is later and any coordinate differs",
    "such frames would have said that the vehicle stands still",
)
"""Fresh frames, without those sent again or frozen."""
