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
   If y* keeps every bound, it is the answer.
4. *Active set.* Otherwise DAQP minimises |dw|^2 + price * |slack|^2 subject to |y* + M dw| <= bounds + slack. M depends
   on the length only; between ticks nothing but y* changes.
"""

import enum
import functools
import math
from dataclasses import dataclass
from typing import NamedTuple

import casadi as ca
import daqp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from fiplib.dynamics import axis_matrices, prediction_model, rk4
from fiplib.params import AXES, INPUTS, STATES, Axis, Control, Params

SLACK_TOLERANCE = 1e-6
"""A state bound counts as softened when it is exceeded by more than this, in the unit of the state."""

SOLVER_SETTINGS = {"primal_tol": 1e-9, "iter_limit": 200}
"""DAQP: feasible far beyond the 1e-6 rad/s asked of u_0. Where more iterations would be needed the rod is already
falling (bounds exceeded severalfold); the limit keeps such a tick, too, within the control period."""

SOFT = 8
"""DAQP's mark of a row that may be exceeded at a price."""

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
        raise ValueError("input_weights R must be positive: an input that costs nothing has no best value")
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


TO_AXES = np.array([i for axis in AXES for i in axis.states])
AXIS_SIGNS = np.array([sign for axis in AXES for sign in (1.0, 1.0, 1.0, 1.0, axis.sign)])
"""z of both axes, one after the other, is ``AXIS_SIGNS * x[TO_AXES]``: the signs make the axes one system."""

FROM_AXES = np.argsort([i for axis in AXES for i in (len(STATES) + axis.input, *axis.states)])
PLAN_SIGNS = np.array([sign for axis in AXES for sign in (axis.sign, 1.0, 1.0, 1.0, 1.0, axis.sign)])[FROM_AXES]
"""With (u, z) of both axes one after the other in p, the state and then the input are ``PLAN_SIGNS * p[FROM_AXES]``."""


class AxisProblem:
    """One axis of the problem for one length: N nodes, 5 states, 1 input; steps 2 to 4 of the module's text.

    A plan is an array (6 N,) with the rows (u_k, z_{k+1}), k = 0 .. N-1.

    Args:
        length: l in m.
        control: horizon and price of the slack.
        cost: Q (5, 5), R (1, 1), P (5, 5).
        bounds: of (u, z), shape (6,); rows with infinite bounds are left out.
    """

    def __init__(self, length: float, control: Control, cost: Weights, bounds: NDArray):
        nodes = control.nodes
        self.a, self.b = _discretised(length, control.step)
        self.input_bound = bounds[0]
        self.bounds = np.tile(bounds, nodes)
        gains, roots = _riccati(self.a, self.b, nodes, cost)
        z = np.zeros((nodes + 1, 5, 5 + nodes))
        z[0, :, :5] = np.eye(5)
        for k, closed_loop in enumerate(self.a - self.b * gains):
            np.matmul(closed_loop, z[k], out=z[k + 1])
            z[k + 1, :, 5 + k] = self.b[:, 0] / roots[k]
        u = -gains @ z[:-1]
        u[range(nodes), 0, range(5, 5 + nodes)] += 1.0 / roots
        self.plan = np.concatenate([u, z[1:]], axis=1).reshape(6 * nodes, 5 + nodes)  # (z_0, w) -> y

        # w* = M_z' Q z_ref: the adjoint of the map from w to the states carries the reference back
        weighted = cost.state @ z[1:, :, 5:]
        weighted[-1] = cost.terminal @ z[-1, :, 5:]
        self.target = np.ascontiguousarray(weighted.reshape(5 * nodes, nodes).T)  # z_ref of nodes 1..N -> w*

        self.rows = np.flatnonzero(np.isfinite(self.bounds))
        self.room = self.bounds[self.rows]
        soft = (self.rows % 6 > 0) & math.isfinite(control.slack_weight)
        self.sense = np.where(soft, SOFT, 0).astype(np.intc)
        self.solver = daqp.Model()
        self.solver.settings = SOLVER_SETTINGS
        if self.rows.size:
            m = self.plan[self.rows, 5:]
            self.solver.setup(np.eye(nodes), np.zeros(nodes), m, self.room, -self.room, self.sense)
            price = np.where(soft, 1.0 / control.slack_weight, 0.0)
            self.solver.soft_weights(price, price)

    def solve(self, z0: NDArray, z_ref: NDArray) -> tuple[NDArray, Status, bool]:
        """The optimal plan (6 N,) from z_0 (5,) along z_ref (5 N,), its status, and whether a bound is active."""
        y = self.plan @ np.concatenate((z0, self.target @ z_ref))
        if (np.abs(y) <= self.bounds).all():
            return y, Status.OPTIMAL, False
        dw = self._correction(y)
        if dw is None:
            return self._saturated(z0, y), Status.FAILED, True
        y += self.plan[:, 5:] @ dw
        y[::6] = np.clip(y[::6], -self.input_bound, self.input_bound)  # DAQP keeps them to its tolerance only
        softened = (np.abs(y) > self.bounds + SLACK_TOLERANCE).any()
        return y, Status.SOFTENED if softened else Status.OPTIMAL, True

    def _correction(self, y: NDArray) -> NDArray | None:
        """dw of the least-distance problem around y*, or None if DAQP has no answer."""
        if not np.isfinite(y).all():
            return None
        y = y[self.rows]
        # Handing over the kinds of the rows again makes DAQP forget its last active set: no memory between ticks
        if self.solver.update(bupper=self.room - y, blower=-self.room - y, sense=self.sense) < 0:
            return None
        dw, _, exit_flag, _ = self.solver.solve()
        return dw if exit_flag in (1, 2) and np.isfinite(dw).all() else None

    def _saturated(self, z: NDArray, y: NDArray) -> NDArray:
        """The unconstrained inputs cut off at their bounds, and where the model goes with them."""
        y = y.reshape(-1, 6)
        y[:, 0] = np.clip(np.nan_to_num(y[:, 0]), -self.input_bound, self.input_bound)
        for node in y:
            node[1:] = z = self.a @ z + self.b[:, 0] * node[0]
        return y.ravel()


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
    ):
        control = params.control
        if not isinstance(control.nodes, int) or control.nodes < 1 or not 0.0 < control.horizon < math.inf:
            raise ValueError(
                f"the horizon needs a whole number of nodes and a positive time: {control.nodes}, {control.horizon} s"
            )
        bounds = np.array([control.slack_weight, params.vehicle.max_body_rate, *control.state_bounds], dtype=float)
        if bounds.shape != (2 + len(STATES),) or not (bounds > 0.0).all():
            raise ValueError("slack_weight, max_body_rate and the ten state_bounds must be positive; inf is no bound")
        self.params = params
        self.weights = weights(params, state_weights, input_weights, terminal_weights)
        axis_bounds = [bounds[[1, *(2 + np.array(axis.states))]] for axis in AXES]
        axis_weights = _per_axis(self.weights)
        alike = np.array_equal(*axis_bounds) and all(map(np.array_equal, *axis_weights))
        # One set-up serves both axes where they are alike
        self._axes = list(zip(axis_weights, axis_bounds, strict=True))[: 1 if alike else len(AXES)]
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
        state = _finite("state", state, (len(STATES),))
        reference = _finite("reference", reference, (nodes + 1, len(STATES)))
        z0 = state.take(TO_AXES) * AXIS_SIGNS
        z_ref = reference.take(TO_AXES, axis=1)[1:] * AXIS_SIGNS
        answers = [
            axis_problem.solve(z0[part], z_ref[:, part].ravel())
            for axis_problem, part in zip(self.prepare(length), (slice(0, 5), slice(5, 10)), strict=True)
        ]
        plans = np.concatenate([plan.reshape(nodes, 6) for plan, _, _ in answers], axis=1)
        plans = plans.take(FROM_AXES, axis=1) * PLAN_SIGNS
        states, inputs = np.concatenate((state[None], plans[:, : len(STATES)])), plans[:, len(STATES) :]
        statuses = [status for _, status, _ in answers]
        worst = next(status for status in (Status.FAILED, Status.SOFTENED, Status.OPTIMAL) if status in statuses)
        return Solution(inputs[0], inputs, states, worst, any(bounded for _, _, bounded in answers))

    def prepare(self, length: float | None = None) -> list[AxisProblem]:
        """Set up for a length (as in ``solve``), one problem per axis; ``solve`` calls it, the latest few are kept."""
        length = self.params.pendulum.length if length is None else float(length)
        if not 0.0 < length < math.inf:
            raise ValueError(f"length must be positive and finite, got {length} m")
        return self._prepared(length)

    def _prepare(self, length: float) -> list[AxisProblem]:
        problems = [AxisProblem(length, self.params.control, cost, bounds) for cost, bounds in self._axes]
        return problems * (len(AXES) // len(problems))


def _discretised(length: float, step: float) -> tuple[NDArray, NDArray]:
    """The RK4 map of one axis, A (5, 5) and B (5, 1): of a linear system it is the Taylor series to fourth order."""
    a, b = axis_matrices(length)
    eye, ha = np.eye(5), step * a
    phi = eye + ha / 2 @ (eye + ha / 3 @ (eye + ha / 4))
    return eye + ha @ phi, step * phi @ b


def _riccati(a: NDArray, b: NDArray, nodes: int, cost: Weights) -> tuple[NDArray, NDArray]:
    """Gains K_k (N, 1, 5) and sqrt(H_k) (N,) of the unconstrained problem, backwards from P."""
    gains, h = np.empty((nodes, 1, 5)), np.empty(nodes)
    ab, p = np.hstack([a, b]), cost.terminal
    for k in reversed(range(nodes)):
        g = ab.T @ p @ ab
        h[k] = cost.input[0, 0] + g[5, 5]
        gains[k] = g[5, :5] / h[k]
        p = cost.state + g[:5, :5] - gains[k].T * g[5, :5]
        p = (p + p.T) / 2  # a skew part, born of rounding, would grow like the falling pendulum
    return gains, np.sqrt(h)


def _per_axis(cost: Weights) -> list[Weights]:
    """The blocks Q (5, 5), R (1, 1), P (5, 5) of each axis; a ValueError where a weight couples the axes."""
    home = {signal: axis for axis in AXES for signal in (*(STATES[i] for i in axis.states), INPUTS[axis.input])}
    for signals, matrix in ((STATES, cost.state), (INPUTS, cost.input), (STATES, cost.terminal)):
        for i, j in np.argwhere(matrix):
            if home[signals[i]] != home[signals[j]]:
                raise ValueError(f"a weight couples the two axes: {signals[i].name} with {signals[j].name}")

    def block(matrix: NDArray, axis: Axis) -> NDArray:
        return matrix[np.ix_(axis.states, axis.states)] * np.outer(signs := [1, 1, 1, 1, axis.sign], signs)

    r = cost.input.diagonal()[:, None, None]
    return [Weights(block(cost.state, axis), r[axis.input], block(cost.terminal, axis)) for axis in AXES]


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
