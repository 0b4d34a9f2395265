"""The paper's optimal control problem, written once as it reads, and its fast exact solver.

``problem`` is the definition (paper, eq. mpc_main) in CasADi. ``MPC`` solves the same problem some hundred times faster
than a general solver does, in four steps that lose nothing:

1. *Axes.* The prediction model (paper, eq. prediction_model) is linear and falls into two copies of one system with the
   state z = (s, s', d, d', tilt) and the body rate u as input (``params.AXES``). Bounds are element-wise, so only
   weights could couple the copies, and such weights are refused.
2. *Feedback first.* Completing squares along the Riccati recursion of the unconstrained problem, with
   H_k = R + B'P_{k+1}B, K_k = B'P_{k+1}A / H_k and u_k = -K_k z_k + w_k / sqrt(H_k), turns the cost into |w - w*|^2
   plus a constant. Without the feedback a condensed problem is hopeless: over 6 s the pendulum grows by e^26.
3. *Least distance.* With w = w* + dw the plan (all inputs, all states) is y = y* + M dw, y* the unconstrained plan.
   If y* keeps every bound, it is the answer. Neither M nor anything else of size N^2 is formed: one sweep back along
   the horizon gives w* or a row of M, one sweep forward gives a plan.
4. *Active set.* Otherwise a dual active-set method minimises |dw|^2 + price * |slack|^2 subject to |y* + M dw| <=
   bounds + slack. It starts from no active bound every time: there is no memory between ticks.

The sweeps are compiled loops, in ``kernels.control``.
"""

import enum
import functools
import math
from dataclasses import dataclass
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from fiplib.dynamics import prediction_model, rk4
from fiplib.params import AXES, INPUTS, STATES, Axis, Params

SLACK_TOLERANCE = 1e-6
"""A state bound counts as softened when it is exceeded by more than this, in the unit of the state."""

CACHED_LENGTHS = 8
"""Lengths whose set-up is kept."""


class Weights(NamedTuple):
    """The cost matrices of eq. mpc_main: Q and P (10, 10), R (2, 2)."""

    state: NDArray
    input: NDArray
    terminal: NDArray


def weights(
    params: Params,
    state_weights: ArrayLike | None = None,
    input_weights: ArrayLike | None = None,
    terminal_weights: ArrayLike | None = None,
) -> Weights:
    """Q, R and P of eq. mpc_main: from ``params.control``, where P = terminal_factor Q, unless given.

    Args:
        params: supplies what is not given.
        state_weights: Q, shape (10, 10) or its diagonal (10,), in the order of ``STATES``.
        input_weights: R, shape (2, 2) or its diagonal (2,), in the order of ``INPUTS``.
        terminal_weights: P, as Q.

    Raises:
        ValueError: wrong shape, not finite, not symmetric, Q or P negative, R not positive.
    """
    q = params.control.state_weights if state_weights is None else state_weights
    r = params.control.input_weights if input_weights is None else input_weights
    q, r = _weight_matrix("state_weights Q", q, len(STATES)), _weight_matrix("input_weights R", r, len(INPUTS))
    p = params.control.terminal_factor * q if terminal_weights is None else terminal_weights
    p = _weight_matrix("terminal_weights P", p, len(STATES))
    if np.linalg.eigvalsh(r)[0] <= 0.0:
        raise ValueError("input_weights R must be positive: otherwise the optimal input is not unique")
    return Weights(q, r, p)


class OptimalControlProblem(NamedTuple):
    """The problem of eq. mpc_main as CasADi symbols: parameters, decision variables, and the problem itself."""

    opti: ca.Opti
    state: ca.MX
    reference: ca.MX
    length: ca.MX
    inputs: ca.MX
    states: ca.MX


def problem(params: Params, matrices: Weights | None = None) -> OptimalControlProblem:
    """The definition: the paper's optimal control problem (eq. mpc_main), to be read and to be solved by any solver.

    The input bounds are hard. The state bounds hold at nodes 1..N (x_0 is given) and are soft: they may be exceeded by
    a slack s_k at the price slack_weight |s_k|^2. slack_weight = inf gives the paper's hard bounds.

    Args:
        params: horizon, weights, bounds.
        matrices: Q, R, P; from ``params`` by default.

    Returns:
        The problem in the symbols of the paper, without a solver: parameters state (10,), reference (10, N+1),
        length m; variables inputs (2, N) rad/s, states (10, N+1).
    """
    control, (Q, R, P) = params.control, matrices or weights(params)
    N = control.nodes
    u_max, x_max = params.vehicle.max_body_rate, ca.DM(control.state_bounds)
    f_rk4 = rk4(prediction_model(), control.step)

    opti = ca.Opti()
    x_now, x_ref, l = opti.parameter(10), opti.parameter(10, N + 1), opti.parameter()
    x, u = opti.variable(10, N + 1), opti.variable(2, N)
    soft = math.isfinite(control.slack_weight)
    s = opti.variable(10, N) if soft else ca.MX(10, N)
    e = x - x_ref

    cost = ca.bilin(P, e[:, N])
    opti.subject_to(x[:, 0] == x_now)
    for k in range(N):
        cost += ca.bilin(Q, e[:, k]) + ca.bilin(R, u[:, k])
        opti.subject_to(x[:, k + 1] == f_rk4(x[:, k], u[:, k], l))
        opti.subject_to(opti.bounded(-u_max, u[:, k], u_max))
        opti.subject_to(opti.bounded(-x_max, x[:, k + 1] - s[:, k], x_max))
    if soft:
        cost += control.slack_weight * ca.sumsqr(s)
    opti.minimize(cost)
    return OptimalControlProblem(opti, x_now, x_ref, l, u, x)


class Status(enum.Enum):
    """How a solution relates to the problem, from best to worst."""

    OPTIMAL = "optimal"
    """All bounds are kept (to ``SLACK_TOLERANCE``)."""
    SOFTENED = "softened"
    """Optimal, with some state bound exceeded at its price."""
    FAILED = "failed"
    """The solver gave no answer; the inputs are the unconstrained ones, cut off at their bounds."""


STATUSES = tuple(Status)
"""The statuses, in the order of their numbers in ``kernels.control``."""


@dataclass(frozen=True)
class Solution:
    """The optimal plan. ``inputs[k]`` acts from node k to node k + 1.

    Attributes:
        input: u_0, shape (2,), rad/s: what is sent to the vehicle. Finite and within bounds whatever the status.
        inputs: u_0 .. u_{N-1}, shape (N, 2), rad/s.
        states: x_0 .. x_N, shape (N+1, 10).
        status: see ``Status``.
        bounded: some bound is active, i.e. the unconstrained plan is not allowed.
    """

    input: NDArray
    inputs: NDArray
    states: NDArray
    status: Status
    bounded: bool


@dataclass(frozen=True)
class AxisProblem:
    """One axis for one length: N nodes, 5 states, 1 input; steps 2 and 3 of the module's text, for a look inside.

    Attributes:
        transition: A, the RK4 map of the states z, (5, 5).
        input: B, (5,).
        gains: K_k of the unconstrained problem, (N, 5).
        roots: sqrt(H_k), (N,).
        bounds: of (u, z), (6,).
    """

    transition: NDArray
    input: NDArray
    gains: NDArray
    roots: NDArray
    bounds: NDArray

    @property
    def plan(self) -> NDArray:
        """Return the map (6 N, 5 + N) from (z_0, w) to the plan, whose rows are (u_k, z_{k+1}), k = 0 .. N-1."""
        nodes = len(self.roots)
        z, rows = np.eye(5, 5 + nodes), []
        for k in range(nodes):
            u = -self.gains[k] @ z
            u[5 + k] = 1.0 / self.roots[k]
            z = self.transition @ z + np.outer(self.input, u)
            rows += [u, *z]
        return np.array(rows)

    @property
    def rows(self) -> NDArray:
        """Those rows of ``plan`` that have a finite bound."""
        return np.flatnonzero(np.isfinite(np.tile(self.bounds, len(self.roots))))


class MPC:
    """The paper's model predictive controller (section 2.2, eq. mpc_main), solved exactly in well under a millisecond.

    Calls do not depend on each other: the same arguments give the same bits, whatever was solved before.

    Args:
        params: horizon, weights, bounds, and the length where ``solve`` is given none.
        state_weights, input_weights, terminal_weights: Q, R, P as in ``weights``; from ``params`` by default.

    Raises:
        ValueError: weights that ``weights`` refuses or that couple the axes; a horizon or bound that is not positive.
    """

    def __init__(
        self,
        params: Params,
        state_weights: ArrayLike | None = None,
        input_weights: ArrayLike | None = None,
        terminal_weights: ArrayLike | None = None,
    ) -> None:
        control = params.control
        if not isinstance(control.nodes, int) or control.nodes < 1 or not 0.0 < control.horizon < math.inf:
            raise ValueError(
                f"the horizon needs a whole number of nodes and a positive time: {control.nodes}, {control.horizon} s"
            )
        bounds = np.array([control.slack_weight, params.vehicle.max_body_rate, *control.state_bounds], dtype=float)
        if bounds.shape != (2 + len(STATES),) or not (bounds > 0.0).all():
            raise ValueError("slack_weight, max_body_rate and the ten state_bounds must be positive; inf is no bound")
        # here and not above: numba takes a while, and not all who read this module's problem solve it
        from fiplib.kernels import control as kernels

        self.params = params
        self.weights = weights(params, state_weights, input_weights, terminal_weights)
        self._kernels, self._softness = kernels, 1.0 / control.slack_weight
        self._q, self._r, self._p = _per_axis(self.weights)
        self._bounds = np.array([bounds[[1, *(2 + np.array(axis.states))]] for axis in AXES])
        self._work = np.empty(kernels.work_shape(control.nodes))
        self._prepared = functools.lru_cache(CACHED_LENGTHS)(self._prepare)

    def solve(self, state: ArrayLike, reference: ArrayLike, length: float | None = None) -> Solution:
        """The optimal plan from the present state along a reference (eq. mpc_main).

        Args:
            state: x, shape (10,), in the order of ``STATES``.
            reference: x_ref of nodes 0 .. N, shape (N+1, 10), ``params.control.step`` apart.
            length: pendulum length l of the prediction model in m; ``params.pendulum.length`` by default.

        Raises:
            ValueError: a wrong shape, a number that is not finite, a length that is not positive.
        """
        nodes = self.params.control.nodes
        state, reference = (np.array(value, dtype=float, order="C") for value in (state, reference))
        states, inputs = np.empty((nodes + 1, len(STATES))), np.empty((nodes, len(INPUTS)))
        if state.shape != (len(STATES),) or reference.shape != states.shape:
            _finite("state", state, (len(STATES),))
            _finite("reference", reference, states.shape)
        answer = self._kernels.solve(state, reference, *self.prepared(length), states, inputs)
        if answer < 0:
            _finite("state", state, state.shape)
            _finite("reference", reference, reference.shape)
        return Solution(inputs[0], inputs, states, STATUSES[answer & 3], answer > 3)

    def prepared(self, length: float | None = None) -> tuple:
        """Return the arguments of ``kernels.control.solve`` after state and reference, for a length as in ``solve``."""
        length = self.params.pendulum.length if length is None else float(length)
        if not 0.0 < length < math.inf:
            raise ValueError(f"length must be positive and finite, got {length} m")
        return self._prepared(length)

    def prepare(self, length: float | None = None) -> list[AxisProblem]:
        """Set up for a length (as in ``solve``), one problem per axis; ``solve`` does it, the latest few are kept."""
        model, feedback, *_ = self.prepared(length)
        return [
            AxisProblem(model[:5], model[5], rows[:, :5], rows[:, 5], bounds)
            for rows, bounds in zip(feedback, self._bounds, strict=True)
        ]

    def _prepare(self, length: float) -> tuple:
        control = self.params.control
        model, feedback = np.empty((6, 5)), np.empty((len(AXES), control.nodes, 6))
        self._kernels.riccati(length, control.step, self._q, self._r, self._p, model, feedback)
        return model, feedback, self._q, self._p, self._bounds, self._softness, SLACK_TOLERANCE, self._work


def _per_axis(cost: Weights) -> Weights:
    """Return the blocks Q (2, 5, 5), R (2,), P (2, 5, 5) of the axes; a ValueError where a weight couples them."""
    home = {signal: axis for axis in AXES for signal in (*(STATES[i] for i in axis.states), INPUTS[axis.input])}
    for signals, matrix in ((STATES, cost.state), (INPUTS, cost.input), (STATES, cost.terminal)):
        for i, j in np.argwhere(matrix):
            if home[signals[i]] != home[signals[j]]:
                raise ValueError(f"a weight couples the two axes: {signals[i].name} with {signals[j].name}")

    def block(matrix: NDArray, axis: Axis) -> NDArray:
        return matrix[np.ix_(axis.states, axis.states)] * np.outer(signs := [1, 1, 1, 1, axis.sign], signs)

    q, p = (np.array([block(matrix, axis) for axis in AXES]) for matrix in (cost.state, cost.terminal))
    return Weights(q, np.array([cost.input[axis.input, axis.input] for axis in AXES]), p)


def _finite(name: str, value: ArrayLike, shape: tuple[int, ...]) -> NDArray:
    value = np.asarray(value, dtype=float)
    if value.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, got {value.shape}")
    if not np.isfinite(value).all():
        raise ValueError(f"{name} must be finite")
    return value


def _weight_matrix(name: str, value: ArrayLike, size: int) -> NDArray:
    """A symmetric, positive semidefinite matrix from a matrix or its diagonal."""
    value = np.asarray(value, dtype=float)
    value = _finite(name, np.diag(value) if value.ndim == 1 else value, (size, size))
    if not np.array_equal(value, value.T):
        raise ValueError(f"{name} must be symmetric")
    # eigvalsh is exact to rounding only: a semidefinite matrix may show -1e-16 of its norm
    if np.diag(value).min() < 0.0 or np.linalg.eigvalsh(value)[0] < -1e-12 * np.abs(value).max():
        raise ValueError(f"{name} must not be negative")
    return value
