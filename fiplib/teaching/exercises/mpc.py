"""Exercises of notebook 03, model predictive control."""

import numpy as np
from numpy.typing import NDArray

from fiplib.teaching.exercises.grading import Exercise, positive_definite


def _riccati(a: NDArray, b: NDArray, q: NDArray, r: NDArray, p: NDArray) -> NDArray:
    gain = np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)
    closed = a - b @ gain
    return q + gain.T @ r @ gain + closed.T @ p @ closed


def _riccati_terms(a: NDArray, b: NDArray, q: NDArray, r: NDArray, p: NDArray) -> dict[str, NDArray]:
    k = np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)
    return {"Q": q, "A'PA": a.T @ p @ a, "K'RK": -k.T @ r @ k, "K'B'PBK": -k.T @ b.T @ p @ b @ k, "P": p}


riccati_step = Exercise(
    _riccati,
    lambda rng: (rng.normal(size=(4, 4)), rng.normal(size=(4, 2)), *(positive_definite(rng, n) for n in (4, 2, 4))),
    {
        "the sign of the last term is wrong: being free to choose u makes the future cheaper, not dearer": (
            lambda a, b, q, r, p: 2 * (q + a.T @ p @ a) - _riccati(a, b, q, r, p)
        ),
        "the cost of the step itself is missing: add Q": lambda a, b, q, r, p: _riccati(a, b, 0 * q, r, p),
        "R is missing beside B'PB: then control costs nothing": lambda a, b, q, r, p: _riccati(a, b, q, 0 * r, p),
        "the last term is missing: that is the cost of doing nothing, u = 0": lambda a, b, q, r, p: q + a.T @ p @ a,
        "the cost of the input is missing: u'Ru counts as well": lambda a, b, q, r, p: (
            _riccati(a, b, q, r, p) - (k := np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)).T @ r @ k
        ),
        "the input moves the next state, too: R alone is not what the gain is weighed with": lambda a, b, q, r, p: (
            q + a.T @ p @ a - (k := np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)).T @ r @ k
        ),
        "the inverse is missing: the gain is a solution of (R + B'PB) K = B'PA": lambda a, b, q, r, p: (
            q + a.T @ p @ a - a.T @ p @ b @ (r + b.T @ p @ b) @ b.T @ p @ a
        ),
        "the sign of the feedback is wrong: u = -K x, so the loop is A - B K": lambda a, b, q, r, p: (
            q + (k := np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)).T @ r @ k + (closed := a + b @ k).T @ p @ closed
        ),
        "* multiplies entry by entry: matrices are multiplied by @": lambda a, b, q, r, p: q + a.T * p * a,
    },
    "write the whole cost with x+ = A x + B u, find the best u, and put it back in; mind the transposes",
    "minimise x'Qx + u'Ru + (Ax + Bu)'P(Ax + Bu) over u and put the best u back in; mind the transposes",
    "sixty such steps backwards from P are the whole MPC, as long as no bound is active",
    terms=_riccati_terms,
)
"""One step of the Riccati recursion."""


def _grown(a: NDArray, b: NDArray, k: NDArray, n: int, order: float | str = 2) -> tuple[float, float]:
    first, second = (np.linalg.matrix_power(matrix, n) for matrix in (a, a - b @ k))
    return np.linalg.norm(first, order), np.linalg.norm(second, order)


growths = Exercise(
    _grown,
    lambda rng: (rng.normal(size=(3, 3)), rng.normal(size=(3, 1)), rng.normal(size=(1, 3)), int(rng.integers(3, 9))),
    {
        "the sign of the feedback is wrong: u = -K x, so the loop is A - B K": lambda a, b, k, n: _grown(a, -b, k, n),
        "** raises single entries to a power: take np.linalg.matrix_power": (
            lambda a, b, k, n: tuple(np.linalg.norm(matrix**n, 2) for matrix in (a, a - b @ k))
        ),
        "that is the Frobenius norm: the largest growth is np.linalg.norm(M, 2)": lambda *of: _grown(*of, "fro"),
        "that is the growth of one step: raise the matrices to the power n": lambda a, b, k, n: _grown(a, b, k, 1),
        "the two are exchanged: first without feedback, then with it": lambda *of: _grown(*of)[::-1],
        "the power of a norm is only a bound: raise the matrix to the power, then take the norm": lambda a, b, k, n: (
            tuple(np.linalg.norm(matrix, 2) ** n for matrix in (a, a - b @ k))
        ),
        "the largest eigenvalue rules in the long run only: take the largest singular value": lambda a, b, k, n: tuple(
            np.abs(np.linalg.eigvals(matrix)).max() ** n for matrix in (a, a - b @ k)
        ),
        "that is the largest entry: the largest growth is np.linalg.norm(M, 2), in the worst direction": (
            lambda a, b, k, n: tuple(np.abs(np.linalg.matrix_power(m, n)).max() for m in (a, a - b @ k))
        ),
        "that is another norm, of column sums: np.linalg.norm(M, 2) takes the worst direction": lambda *of: _grown(
            *of, 1
        ),
        "that is another norm, of row sums: np.linalg.norm(M, 2) takes the worst direction": lambda *of: _grown(
            *of, np.inf
        ),
        "that is the smallest singular value: the largest growth is np.linalg.norm(M, 2)": lambda *of: _grown(*of, -2),
    },
    "raise each of the two matrices to the power first, then take the norm",
    "the largest growth over n steps is the largest singular value of the n-th power of the step's matrix",
    "now try it on the rod: without feedback the end of the plan hangs on the last digits of its beginning",
)
"""Growth over the horizon, without and with feedback."""


def _moved(a: NDArray, b: NDArray, x: NDArray, sent: NDArray) -> NDArray:
    for u in sent:
        x = a @ x + b @ u
    return x


def _moved_terms(a: NDArray, b: NDArray, x: NDArray, sent: NDArray) -> dict[str, NDArray]:
    """Where the state and each command, the oldest first, get by steps: too few, right, one too many."""
    moved = {f"A^{n} x": np.linalg.matrix_power(a, n) @ x for n in range(len(sent) + 2)}
    for k, u in enumerate(sent):
        moved |= {f"A^{n} B u_{k}": np.linalg.matrix_power(a, n) @ b @ u for n in range(len(sent) + 1)}
    return moved


state_when_it_acts = Exercise(
    _moved,
    lambda rng: (rng.normal(size=(4, 4)), rng.normal(size=(4, 2)), rng.normal(size=4), rng.normal(size=(3, 2))),
    {
        "that is the state as measured: commands on their way will have moved it": lambda a, b, x, sent: x,
        "commands act in the order they were sent, the oldest first": lambda a, b, x, sent: _moved(a, b, x, sent[::-1]),
        "all commands on their way act, not only the oldest": lambda a, b, x, sent: _moved(a, b, x, sent[:1]),
        "the rod goes on falling meanwhile: A acts in every step": lambda a, b, x, sent: x + b @ sent.sum(axis=0),
        "that is one step, with the newest command: there is a step for each command": lambda a, b, x, sent: (
            a @ x + b @ sent[-1]
        ),
        "that is one step with all commands at once: there is a step for each command": lambda a, b, x, sent: (
            a @ x + b @ sent.sum(axis=0)
        ),
        "steps are added up: each one starts from where the step before has ended": lambda a, b, x, sent: sum(
            a @ x + b @ u for u in sent
        ),
        "A x is the next state already: nothing of the old one is added": lambda a, b, x, sent: _moved(
            a + np.eye(len(x)), b, x, sent
        ),
        "a command goes on acting through A in the steps after its own": lambda a, b, x, sent: (
            np.linalg.matrix_power(a, len(sent)) @ x + b @ sent.sum(axis=0)
        ),
    },
    "simulate: the vehicle goes on moving, one step for each command",
    "one step x = A x + B u for each command that is on its way",
    "planning from where the vehicle will be takes the delay out of the loop, as far as the model holds",
    terms=_moved_terms,
)
"""The state at which a delayed command will act."""
