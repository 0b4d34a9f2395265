"""Nonlinear model predictive control by the real-time iteration: one Newton-type step of the optimal plan per tick.

The cost, the bounds, the horizon and the states are the MPC's (``mpc.problem``); only the model is exact. The pilot's
altitude loop keeps the vertical specific thrust at g, so the seat accelerates with

    x'' = g tan(theta) / cos(phi),   y'' = -g tan(phi),   phi' = omega_x / cos(theta),   theta' = omega_y,

(yaw held at zero) and the rod follows its Lagrangian on that base (``dynamics.exact_pendulum``, a point mass, as in
the paper's model). Discretised by RK4 on the nodes of the MPC this is a nonlinear program in the plan
w = (x_0, u_0, x_1, ..., x_N), multiple shooting. At every tick the plan of the tick before is linearised once and

    minimise  dw' H dw / 2 + g' dw   subject to   A dw + gap = 0,  |u + du| <= u_max,  x_0 + dx_0 = the measured state

is solved by HPIPM, which uses the block structure of A; w + dw is the next plan. H is the Gauss-Newton matrix. The soft
bounds of the states are a cost, slack_weight * max(|x| - bound, 0)^2: the value of the slack's minimum, so it is the
MPC's problem; the active ones are those of the plan that is linearised. The first plan, and the one after a
failure, is the MPC's. It has no parameters of its own. A tick takes 4.4 ms of one core, half of them in HPIPM.

Source: M. Diehl, H. G. Bock, J. P. Schloeder, "A real-time iteration scheme for nonlinear optimization in optimal
feedback control", SIAM J. Control Optim. 43(5), 2005, doi:10.1137/S0363012902400713; S. Gros et al., "From linear to
nonlinear MPC: bridging the gap via the real-time iteration", Int. J. Control 93(1), 2020,
doi:10.1080/00207179.2016.1222553.
"""

import math
from dataclasses import replace

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from fiplib.dynamics import exact_pendulum, rk4
from fiplib.mpc import MPC, SLACK_TOLERANCE, Solution, Status, Weights, weights
from fiplib.params import A_DOT, B_DOT, GRAVITY, INPUTS, PHI, STATES, THETA, X_DOT, Y_DOT, A, B, Params

STATE, STAGE = len(STATES), len(STATES) + len(INPUTS)
"""Numbers of a state, and of a node with its input."""


def exact_model() -> ca.Function:
    """Return the exact model x' = f(x, u, l) in the states and inputs of the prediction model, as a CasADi function."""
    x, u, length = ca.SX.sym("x", STATE), ca.SX.sym("u", len(INPUTS)), ca.SX.sym("l")
    phi, theta = x[PHI], x[THETA]
    seat = ca.vertcat(GRAVITY * ca.tan(theta) / ca.cos(phi), -GRAVITY * ca.tan(phi), 0)
    rod = exact_pendulum()(x[[A, B, A_DOT, B_DOT]], seat, length)
    x_dot = ca.vertcat(
        x[X_DOT], seat[0], x[Y_DOT], seat[1], x[A_DOT], rod[0], x[B_DOT], rod[1], u[0] / ca.cos(theta), u[1]
    )
    return ca.Function("f", [x, u, length], [x_dot], ["x", "u", "l"], ["x_dot"])


def newton_step(params: Params, cost: Weights) -> ca.Function:
    """One step's quadratic program: (plan (12 N + 10,), x_ref (10, N+1), l) -> H, g, A, gap of the module's text."""
    control, nodes = params.control, params.control.nodes
    z, x_ref, length = ca.SX.sym("z", STAGE), ca.SX.sym("x_ref", STATE), ca.SX.sym("l")
    x, u = z[:STATE], z[STATE:]

    def quadratic(value: ca.SX, variable: ca.SX) -> list[ca.SX]:
        excess = ca.fmax(ca.fabs(x) - ca.DM(control.state_bounds), 0)
        return [ca.densify(part) for part in ca.hessian(value + control.slack_weight * ca.sumsqr(excess), variable)]

    e = x - x_ref
    x_next = rk4(exact_model(), control.step)(x, u, length)
    hessian, gradient = quadratic(ca.bilin(ca.DM(cost.state), e) + ca.bilin(ca.DM(cost.input), u), z)
    stages = ca.Function("stage", [z, x_ref, length], [hessian, gradient, ca.jacobian(x_next, z), x_next]).map(nodes)
    last = ca.Function("last", [x, x_ref], quadratic(ca.bilin(ca.DM(cost.terminal), e), x))

    plan, reference, l = ca.MX.sym("w", STAGE * nodes + STATE), ca.MX.sym("x_ref", STATE, nodes + 1), ca.MX.sym("l")
    before, end = ca.reshape(plan[: STAGE * nodes], STAGE, nodes), plan[STAGE * nodes :]
    hessians, gradients, jacobians, reached = stages(before, reference[:, :nodes], l)
    end_hessian, end_gradient = last(end, reference[:, nodes])
    after = ca.horzcat(before[:STATE, 1:], end)
    # x_{k+1}, of which A takes minus one, lies a stage after x_k
    shifted = ca.kron(ca.DM.eye(nodes), ca.vertcat(ca.DM.eye(STATE), ca.DM(len(INPUTS), STATE)).T)
    shifted = ca.horzcat(ca.DM(STATE * nodes, STAGE), shifted)[:, : STAGE * nodes + STATE]
    steps = ca.horzcat(ca.diagcat(*ca.horzsplit(jacobians, STAGE)), ca.MX(STATE * nodes, STATE)) - shifted
    quadratic_program = [
        ca.diagcat(*ca.horzsplit(hessians, STAGE), end_hessian),
        ca.vertcat(ca.vec(gradients), end_gradient),
        steps,
        ca.vec(reached - after),
    ]
    return ca.Function("step", [plan, reference, l], quadratic_program)


class NonlinearMPC:
    """Nonlinear MPC; it remembers its plan, which the next tick improves.

    ``params`` as for ``mpc.MPC``; ValueError where that has one, and for an infinite ``slack_weight``.
    """

    def __init__(self, params: Params) -> None:
        if math.isinf(params.control.slack_weight):
            raise ValueError("control.slack_weight must be finite: here the state bounds are a cost")
        self.params, self._linear = params, MPC(params)
        self._step = newton_step(params, weights(params))
        blocks = {"h": self._step.sparsity_out(0), "a": self._step.sparsity_out(2)}
        self._solver = ca.conic("qp", "hpipm", blocks, {"error_on_fail": False})
        self._largest = np.full(STAGE * params.control.nodes + STATE, np.inf)
        self._stages(self._largest)[:, STATE:] = params.vehicle.max_body_rate
        self._plan: NDArray | None = None

    def solve(self, state: ArrayLike, reference: ArrayLike, length: float | None = None) -> Solution:
        """As ``mpc.MPC.solve``, but for one Newton-type step from the plan of the call before."""
        length = self.params.pendulum.length if length is None else float(length)
        plan = self._plan
        if plan is None:
            linear = self._linear.solve(state, reference, length)
            plan = np.concatenate([np.hstack([linear.states[:-1], linear.inputs]).ravel(), linear.states[-1]])
        self._plan = plan = self._improved(plan, np.asarray(state, dtype=float), reference, length)
        if plan is None:
            return replace(self._linear.solve(state, reference, length), status=Status.FAILED)
        limit = self.params.vehicle.max_body_rate
        stages = self._stages(plan)
        inputs = np.clip(stages[:, STATE:], -limit, limit)  # of an interior-point method: inside up to its tolerance
        states = np.vstack([stages[:, :STATE], plan[-STATE:]])
        softened = (np.abs(states[1:]) > np.add(self.params.control.state_bounds, SLACK_TOLERANCE)).any()
        bounded = bool(softened or (np.abs(inputs) > limit * (1 - SLACK_TOLERANCE)).any())
        return Solution(inputs[0], inputs, states, Status.SOFTENED if softened else Status.OPTIMAL, bounded)

    def _improved(self, plan: NDArray, state: NDArray, reference: ArrayLike, length: float) -> NDArray | None:
        """The plan one step on; ``None`` if it leaves the model's domain (a rod that lies down) or the solver fails."""
        hessian, gradient, steps, gap = self._step(plan, np.transpose(reference), length)
        if not (np.isfinite(np.array(gap)).all() and np.isfinite(state).all()):
            return None
        low, high = -self._largest - plan, self._largest - plan
        low[:STATE] = high[:STATE] = state - plan[:STATE]
        found = self._solver(h=hessian, g=gradient, a=steps, lba=-gap, uba=-gap, lbx=low, ubx=high)
        plan = plan + np.array(found["x"]).ravel()
        return plan if self._solver.stats()["success"] and np.isfinite(plan).all() else None

    def _stages(self, plan: NDArray) -> NDArray:
        """View of a plan without its last state: (N, 12)."""
        return plan[: STAGE * self.params.control.nodes].reshape(-1, STAGE)
