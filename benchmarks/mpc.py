"""The MPC and its rivals on the ticks of simulated flights: ``python -m benchmarks.mpc``.

Every contender solves the problem that ``fiplib.mpc.problem`` defines, for the same ticks in flight order: the rod
pushed in hover, a circle, a circle with pushes, and those ticks of pushed flights at which a bound is active. All are
set up once for the length; a solver that can start from its last solution does. Agreement is that of all planned
inputs, in rad/s.

The sparse quadratic program of the general solvers is taken from ``problem`` itself by differentiation. quadprog is
dense and gets a problem it can solve: condensed along a stabilising feedback. acados is on no package index; where
``acados_template`` can be imported, it takes part.
"""

import csv
import functools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from benchmarks.harness import Absent, Contender, Row, compare, main, needs
from fiplib.dynamics import jacobians, prediction_model, rk4
from fiplib.mpc import MPC, problem
from fiplib.params import AXES, NANO, Control, Params, Vehicle
from fiplib.references import Circle, Hover
from fiplib.simulate import SCENARIOS, Push, Scenario, fly

TOPIC = "mpc"
CLOSE = 1e-4
"""The difference of planned rates, rad/s, at which the answers of interior-point solvers count as ours."""

SAVED = Path(__file__).with_name("solve_times.csv")
"""What the ledger's row R1 reads. Committed, since times differ from run to run and ledgers should not."""


class Tick(NamedTuple):
    """What one call solves: state (10,), reference (N+1, 10)."""

    state: NDArray
    reference: NDArray


# --- the sequences


def pushed(impulse: float) -> tuple[Push, ...]:
    """A push of ``impulse`` N s every 2 s, in directions that never repeat."""
    return tuple(Push(2.0 + 2.0 * i, (impulse * math.cos(2.4 * i), impulse * math.sin(2.4 * i))) for i in range(12))


FLIGHTS = {
    "hover with pushes": SCENARIOS["push-hover"],
    "circle": SCENARIOS["circle-0.8"],
    "circle with pushes": Scenario("circle", "", 26.0, Circle(radius=0.8, period=9.0), pushes=pushed(0.010)),
}
HARD = Scenario("hover", "", 26.0, Hover(), pushes=pushed(0.015))
"""Pushes so large that state bounds are softened, too."""


def ticks(scenario: Scenario) -> list[Tick]:
    """What the MPC was given at each tick of a simulated flight."""
    control, signal = scenario.params.control, fly(scenario).state
    horizon = np.arange(control.nodes + 1) * control.step
    times = (signal.stamp - signal.stamp[0]) / NANO
    return [Tick(state, scenario.reference.at(now + horizon)) for now, state in zip(times, signal.values, strict=True)]


def sequences(params: Params) -> dict[str, list[Tick]]:
    """The sequences by name; "bounded ticks only" gathers those of all flights at which a bound is active."""
    found = {name: ticks(scenario) for name, scenario in FLIGHTS.items()}
    mpc = MPC(params)
    everything = [tick for name in ("hover with pushes", "circle with pushes") for tick in found[name]] + ticks(HARD)
    return found | {"bounded ticks only": [tick for tick in everything if mpc.solve(*tick).bounded]}


# --- ours


def ours(params: Params) -> Contender:
    """``fiplib.mpc.MPC``, called as a user calls it."""
    mpc = MPC(params)
    return Contender(lambda tick: mpc.solve(tick.state, tick.reference), lambda solution: solution.inputs)


# --- the problem as a sparse quadratic program


class QuadraticProgram(NamedTuple):
    """min z'Hz/2 + (gradient p)'z over lower(p) <= A z <= upper(p), with p = (state, reference node by node).

    The bounds are ``lower + shift p`` and ``upper + shift p``; z holds the states (10, N+1), the inputs (2, N) and the
    slacks, each column by column.
    """

    hessian: sparse.csc_matrix
    gradient: sparse.csr_matrix
    rows: sparse.csc_matrix
    lower: NDArray
    upper: NDArray
    shift: sparse.csr_matrix
    nodes: int

    def vectors(self, tick: Tick) -> tuple[NDArray, NDArray, NDArray]:
        """Gradient, lower and upper bounds of a tick."""
        p = np.concatenate((tick.state, tick.reference.ravel()))
        shift = self.shift @ p
        return self.gradient @ p, self.lower + shift, self.upper + shift

    def inputs(self, z: Any) -> NDArray:
        """The planned inputs (N, 2) in a solution."""
        return np.asarray(z, dtype=float).ravel()[10 * (self.nodes + 1) :][: 2 * self.nodes].reshape(-1, 2)


def quadratic_program(params: Params) -> QuadraticProgram:
    """The problem of ``fiplib.mpc.problem`` for the length of the parameters: its derivatives are its matrices."""
    values = _derivatives(params.control, params.vehicle)(0, 0, params.pendulum.length)
    h, g, a, shift = (_scipy(value) for value in values[:4])
    lower, upper = (value.full().ravel() for value in values[4:])
    return QuadraticProgram(h, g.tocsr(), a, lower, upper, shift.tocsr(), params.control.nodes)


@functools.lru_cache(maxsize=8)
def _derivatives(control: Control, vehicle: Vehicle) -> ca.Function:
    """(z, p, length) -> Hessian, derivatives of gradient, rows and bounds, the bounds at p = 0; derived once."""
    opti = problem(Params(control=control, vehicle=vehicle)).opti
    f = ca.Function("f", [opti.x, opti.p], [opti.f, opti.g, opti.lbg, opti.ubg]).expand()
    z, p, length = ca.SX.sym("z", opti.nx), ca.SX.sym("p", opti.np - 1), ca.SX.sym("l")
    cost, rows, low, high = f(z, ca.vertcat(p, length))
    hessian, gradient = ca.hessian(cost, z)
    wanted = [hessian, ca.jacobian(gradient, p), ca.jacobian(rows, z), ca.jacobian(low - rows, p)]
    return ca.Function("qp", [z, p, length], [*wanted, low - rows, high - rows])


def _scipy(matrix: ca.DM) -> sparse.csc_matrix:
    """A CasADi matrix as SciPy has it, zeros left out."""
    found = sparse.csc_matrix(matrix.sparse())
    found.eliminate_zeros()
    return found


# --- general solvers of quadratic programs


def osqp(qp: QuadraticProgram) -> Contender:
    """OSQP, warm started."""
    (module,) = needs("osqp")
    solver = module.OSQP()
    q, lower, upper = qp.vectors(Tick(np.zeros(10), np.zeros((qp.nodes + 1, 10))))
    upper_half = sparse.triu(qp.hessian, format="csc")
    options = {"eps_abs": 1e-6, "eps_rel": 1e-6, "max_iter": 20000, "verbose": False}
    solver.setup(upper_half, q, qp.rows, lower, upper, **options)

    def call(tick: Tick) -> NDArray:
        q, lower, upper = qp.vectors(tick)
        solver.update(q=q, l=lower, u=upper)
        return solver.solve().x

    return Contender(call, qp.inputs, 1e-3, "tolerance 1e-6, warm start")


class Split(NamedTuple):
    """The rows of a quadratic program by kind, as masks: equations, bounds of one variable, and all others."""

    equal: NDArray
    simple: NDArray
    general: NDArray


def split(qp: QuadraticProgram) -> Split:
    equal = qp.lower == qp.upper
    simple = (np.diff(qp.rows.tocsr().indptr) == 1) & ~equal
    return Split(equal, simple, ~equal & ~simple)


def piqp(qp: QuadraticProgram) -> Contender:
    """PIQP's sparse interface."""
    (module,) = needs("piqp")
    kinds, rows = split(qp), qp.rows.tocsr()
    bounded = rows[kinds.simple].indices
    low, high = np.full(rows.shape[1], -np.inf), np.full(rows.shape[1], np.inf)
    low[bounded], high[bounded] = qp.lower[kinds.simple], qp.upper[kinds.simple]
    solver = module.SparseSolver()
    solver.settings.eps_abs = solver.settings.eps_rel = 1e-10
    solver.settings.eps_duality_gap_abs = solver.settings.eps_duality_gap_rel = 1e-10
    solver.settings.compute_timings = solver.settings.verbose = False
    equal, general = rows[kinds.equal].tocsc(), rows[kinds.general].tocsc()
    q, lower, upper = qp.vectors(Tick(np.zeros(10), np.zeros((qp.nodes + 1, 10))))
    sides = {"h_l": lower[kinds.general], "h_u": upper[kinds.general], "x_l": low, "x_u": high}
    solver.setup(P=qp.hessian, c=q, A=equal, b=lower[kinds.equal], G=general, **sides)

    def call(tick: Tick) -> NDArray:
        q, lower, _ = qp.vectors(tick)
        solver.update(c=q, b=lower[kinds.equal])
        solver.solve()
        return solver.result.x

    return Contender(call, lambda x: qp.inputs(np.array(x)), CLOSE, "tolerance 1e-10")


def clarabel(qp: QuadraticProgram) -> Contender:
    """Clarabel, its matrices set up once."""
    (module,) = needs("clarabel")
    equal = qp.lower == qp.upper
    rows = qp.rows.tocsr()
    a = sparse.vstack([rows[equal], rows[~equal], -rows[~equal]], format="csc")
    cones = [module.ZeroConeT(int(equal.sum())), module.NonnegativeConeT(2 * int((~equal).sum()))]
    settings = module.DefaultSettings()
    settings.verbose = settings.presolve_enable = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-10

    def sides(tick: Tick) -> tuple[NDArray, NDArray]:
        q, lower, upper = qp.vectors(tick)
        return q, np.concatenate((upper[equal], upper[~equal], -lower[~equal]))

    q, b = sides(Tick(np.zeros(10), np.zeros((qp.nodes + 1, 10))))
    solver = module.DefaultSolver(sparse.triu(qp.hessian, format="csc"), q, a, b, cones, settings)

    def call(tick: Tick) -> Any:
        q, b = sides(tick)
        solver.update(q=q, b=b)
        return solver.solve().x

    return Contender(call, qp.inputs, CLOSE, "tolerance 1e-10")


def quadprog(params: Params) -> Contender:
    """quadprog, dense, one axis at a time; the Hessian is factorised once.

    Condensed plainly the problem has a condition number of e^50. Here u = -K z + v with the gain K of the
    infinite-horizon problem, and the variables are v (N,) and the slacks (5 N,).
    """
    (module,) = needs("quadprog")
    from scipy.linalg import cho_factor, solve_discrete_are, solve_triangular

    control, nodes = params.control, params.control.nodes
    q, r = np.diag(control.state_weights), control.input_weights
    a, b = linear(params)
    axes = []
    for axis in AXES:
        places = list(axis.states)
        ai, bi, qi = a[np.ix_(places, places)], b[places, axis.input][:, None], q[np.ix_(places, places)]
        riccati = solve_discrete_are(ai, bi, qi, np.array([[r[axis.input]]]))
        gain = np.linalg.solve(r[axis.input] + bi.T @ riccati @ bi, bi.T @ riccati @ ai)
        states = np.zeros((nodes + 1, 5, 5 + nodes))  # of (z_0, v)
        states[0, :, :5] = np.eye(5)
        inputs = np.zeros((nodes, 5 + nodes))
        for k in range(nodes):
            inputs[k] = -(gain @ states[k])[0]
            inputs[k, 5 + k] += 1.0
            states[k + 1] = ai @ states[k] + bi * inputs[k]
        stage = np.kron(np.eye(nodes), qi)
        stage[-5:, -5:] *= control.terminal_factor
        flat = states[1:].reshape(5 * nodes, 5 + nodes)
        free, held = flat[:, 5:], flat[:, :5]
        h = 2 * (free.T @ stage @ free + r[axis.input] * inputs[:, 5:].T @ inputs[:, 5:])
        full = np.zeros((6 * nodes, 6 * nodes))
        full[:nodes, :nodes] = h
        full[nodes:, nodes:] = 2 * control.slack_weight * np.eye(5 * nodes)
        root = cho_factor(full)[0]
        inverse = solve_triangular(root, np.eye(6 * nodes))
        slack = np.hstack([free, -np.eye(5 * nodes)])
        rates = np.hstack([inputs[:, 5:], np.zeros((nodes, 5 * nodes))])
        c = np.ascontiguousarray(np.vstack([rates, -rates, slack, -slack]).T)
        cost = 2 * free.T @ stage, 2 * r[axis.input] * inputs[:, 5:].T @ inputs[:, :5]
        room = np.tile(np.array(control.state_bounds)[places], nodes)
        axes.append((places, inverse, c, cost, held, inputs, room))
    limit = params.vehicle.max_body_rate

    def call(tick: Tick) -> list[NDArray]:
        found = []
        for places, inverse, c, (weighted, crossed), held, inputs, room in axes:
            z0, reference = tick.state[places], tick.reference[1:, places].ravel()
            there, turned = held @ z0, inputs[:, :5] @ z0
            linear_part = np.zeros(6 * nodes)
            linear_part[:nodes] = weighted @ (reference - there) - crossed @ z0
            sides = np.concatenate([-limit - turned, -limit + turned, -room - there, -room + there])
            v = module.solve_qp(inverse, linear_part, c, sides, 0, True)[0][:nodes]
            found.append(turned + inputs[:, 5:] @ v)
        return found

    def answer(found: list[NDArray]) -> NDArray:
        plan = np.empty((nodes, 2))
        for axis, inputs in zip(AXES, found, strict=True):
            plan[:, axis.input] = inputs
        return plan

    return Contender(call, answer, remark="dense, condensed along a feedback")


def linear(params: Params) -> tuple[NDArray, NDArray]:
    """A (10, 10) and B (10, 2) of one step of the prediction model."""
    a, b = _linear(params.control.step)(0, 0, params.pendulum.length)
    return a.full(), b.full()


@functools.lru_cache(maxsize=8)
def _linear(step: float) -> ca.Function:
    return jacobians(rk4(prediction_model(), step))


# --- through CasADi


def plugin(name: str, qp: QuadraticProgram, options: dict[str, Any], tolerance: float, remark: str) -> Contender:
    """A solver of CasADi's own interface to quadratic programs."""
    if not ca.has_conic(name):
        raise Absent(f"not installed: CasADi without {name}")
    h, a = ca.DM(qp.hessian), ca.DM(qp.rows)
    solver = ca.conic("qp", name, {"h": h.sparsity(), "a": a.sparsity()}, {"print_time": False} | options)
    last: dict[str, Any] = {"x0": 0, "lam_x0": 0, "lam_a0": 0}

    def call(tick: Tick) -> ca.DM:
        q, lower, upper = qp.vectors(tick)
        found = solver(h=h, g=q, a=a, lba=lower, uba=upper, **last)
        last.update(x0=found["x"], lam_x0=found["lam_x"], lam_a0=found["lam_a"])
        return found["x"]

    return Contender(call, qp.inputs, tolerance, remark)


def casadi_osqp(qp: QuadraticProgram) -> Contender:
    """OSQP through CasADi."""
    inner = {"eps_abs": 1e-6, "eps_rel": 1e-6, "max_iter": 20000, "verbose": False}
    return plugin("osqp", qp, {"osqp": inner}, 1e-3, "through CasADi, tolerance 1e-6")


def casadi_piqp(qp: QuadraticProgram) -> Contender:
    """PIQP through CasADi."""
    inner = {"eps_abs": 1e-10, "eps_rel": 1e-10, "eps_duality_gap_abs": 1e-10, "eps_duality_gap_rel": 1e-10}
    return plugin("piqp", qp, {"piqp": inner}, CLOSE, "through CasADi, tolerance 1e-10")


def casadi_hpipm(params: Params, soft: bool = True) -> Contender:
    """HPIPM through CasADi: the same problem stage by stage, the slack of node k + 1 being an input of stage k.

    Without slacks the state bounds are hard: far less work, and no answer where the problem needs softening.
    """
    if not ca.has_conic("hpipm"):
        raise Absent("not installed: CasADi without hpipm")
    nodes = params.control.nodes
    function, matrices = _hpipm(params.control, params.vehicle, soft), np.hstack(linear(params))
    return Contender(
        lambda tick: function(tick.state, tick.reference.T, matrices),
        lambda inputs: inputs.full().reshape(nodes, 2),
        CLOSE,
        f"through CasADi, {'slacks as inputs' if soft else 'hard bounds'}",
    )


@functools.lru_cache(maxsize=4)
def _hpipm(control: Control, vehicle: Vehicle, soft: bool) -> ca.Function:
    """(state, reference (10, N+1), [A B]) -> inputs, node by node.

    A and B are symbols, so that the blocks of the rows stay dense: the interface crashes on sparse ones.
    """
    nodes, slacks = control.nodes, 10 if soft else 0
    q, r = ca.diag(ca.DM(control.state_weights)), ca.diag(ca.DM(control.input_weights))
    limit, room, free = ca.DM([vehicle.max_body_rate] * 2), ca.DM(control.state_bounds), ca.DM([math.inf] * 10)
    reference, matrices = ca.SX.sym("reference", 10, nodes + 1), ca.SX.sym("ab", 10, 12)
    x = [ca.SX.sym(f"x{k}", 10) for k in range(nodes + 1)]
    u, s = ([ca.SX.sym(f"{name}{k}", size) for k in range(nodes)] for name, size in (("u", 2), ("s", slacks)))
    cost, rows, z = control.terminal_factor * ca.bilin(q, x[nodes] - reference[:, nodes]), [], []
    for k in range(nodes):
        ahead, error = matrices @ ca.vertcat(x[k], u[k]), x[k] - reference[:, k]
        rows += [ahead - x[k + 1], ahead - s[k]] if soft else [ahead - x[k + 1]]
        cost += ca.bilin(q, error) + ca.bilin(r, u[k]) + control.slack_weight * ca.sumsqr(s[k])
        z += [x[k], u[k], s[k]]
    sizes = {"N": nodes, "nx": [10] * (nodes + 1), "nu": [2 + slacks] * nodes + [0], "ng": [slacks] * nodes + [0]}
    parameters = ca.vertcat(ca.vec(reference), ca.vec(matrices))
    program = {"x": ca.vertcat(*z, x[nodes]), "f": cost, "g": ca.vertcat(*rows), "p": parameters}
    solver = ca.qpsol("qp", "hpipm", program, {"print_time": False, "error_on_fail": False, **sizes})
    stage = [limit, free, free] if soft else [limit, room]
    now, values = ca.MX.sym("now", 10), (ca.MX.sym("reference", *reference.shape), ca.MX.sym("ab", *matrices.shape))
    solved = solver(
        p=ca.vertcat(*map(ca.vec, values)),
        lbg=ca.vertcat(*([ca.DM.zeros(10), -room] if soft else [ca.DM.zeros(10)]) * nodes),
        ubg=ca.vertcat(*([ca.DM.zeros(10), room] if soft else [ca.DM.zeros(10)]) * nodes),
        lbx=ca.vertcat(now, *[-bound for bound in stage] * nodes),
        ubx=ca.vertcat(now, *stage * nodes),
    )
    places = [(12 + slacks) * k + 10 + i for k in range(nodes) for i in range(2)]
    return ca.Function("mpc", [now, *values], [solved["x"][places]])


def ipopt(params: Params) -> Contender:
    """ipopt on the problem as it is written; the length is a parameter of it."""
    function = _ipopt(params.control, params.vehicle)
    return Contender(
        lambda tick: function(tick.state, tick.reference.T, params.pendulum.length),
        lambda inputs: inputs.full().T,
        CLOSE,
        "tolerance 1e-8",
    )


@functools.lru_cache(maxsize=4)
def _ipopt(control: Control, vehicle: Vehicle) -> ca.Function:
    ocp = problem(Params(control=control, vehicle=vehicle))
    options = {"expand": True, "detect_simple_bounds": True, "print_time": False}
    ocp.opti.solver("ipopt", options, {"print_level": 0, "sb": "yes", "tol": 1e-8, "mehrotra_algorithm": "yes"})
    return ocp.opti.to_function("ocp", [ocp.state, ocp.reference, ocp.length], [ocp.inputs])


# --- frameworks


def do_mpc(params: Params) -> Contender:
    """do-mpc on the same discrete model, its slacks as inputs; it solves with ipopt, warm started."""
    (module,) = needs("do_mpc")
    control, nodes = params.control, params.control.nodes
    a, b = linear(params)
    model = module.model.Model("discrete")
    x, u = model.set_variable("_x", "x", (10, 1)), model.set_variable("_u", "u", (2, 1))
    s, reference = model.set_variable("_u", "s", (10, 1)), model.set_variable("_tvp", "reference", (10, 1))
    model.set_rhs("x", a @ x + b @ u)
    model.setup()
    controller = module.controller.MPC(model)
    quiet = {"ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": 0, "ipopt.tol": 1e-8}
    controller.set_param(n_horizon=nodes, t_step=control.step, store_full_solution=True, nlpsol_opts=quiet)
    q, r = ca.diag(ca.DM(control.state_weights)), ca.diag(ca.DM(control.input_weights))
    effort = ca.bilin(r, u) + control.slack_weight * ca.sumsqr(s)
    error = ca.bilin(q, x - reference)
    controller.set_objective(lterm=error + effort, mterm=control.terminal_factor * error)
    controller.bounds["lower", "_u", "u"] = -params.vehicle.max_body_rate
    controller.bounds["upper", "_u", "u"] = params.vehicle.max_body_rate
    room = np.array(control.state_bounds)[:, None]
    controller.set_nl_cons("above", a @ x + b @ u - s, ub=room)
    controller.set_nl_cons("below", -(a @ x + b @ u - s), ub=room)
    template, tick_now = controller.get_tvp_template(), [np.zeros((nodes + 1, 10))]

    def parameters(_: float) -> Any:
        for k in range(nodes + 1):
            template["_tvp", k, "reference"] = tick_now[0][k]
        return template

    controller.set_tvp_fun(parameters)
    controller.setup()
    controller.x0 = np.zeros(10)
    controller.set_initial_guess()

    def call(tick: Tick) -> NDArray:
        tick_now[0] = tick.reference
        controller.reset_history()
        controller.make_step(tick.state[:, None])
        return np.array([controller.opt_x_num["_u", k, 0].full().ravel()[:2] for k in range(nodes)])

    return Contender(call, tolerance=CLOSE, remark="ipopt inside, tolerance 1e-8")


def acados(params: Params) -> Contender:
    """acados with HPIPM on the same model, soft bounds and weights; needs ACADOS_SOURCE_DIR and a C compiler."""
    (template,) = needs("acados_template")
    from scipy.linalg import block_diag

    control, nodes = params.control, params.control.nodes
    a, b = linear(params)
    x, u = ca.SX.sym("x", 10), ca.SX.sym("u", 2)
    ocp = template.AcadosOcp()
    ocp.model.name, ocp.model.x, ocp.model.u = "fip", x, u
    ocp.model.disc_dyn_expr = a @ x + b @ u
    ocp.solver_options.N_horizon, ocp.solver_options.tf = nodes, float(nodes)  # a stage weighs 1, as in the problem
    q, r = np.diag(control.state_weights), np.diag(control.input_weights)
    ocp.cost.cost_type = ocp.cost.cost_type_0 = ocp.cost.cost_type_e = "LINEAR_LS"
    ocp.cost.W = ocp.cost.W_0 = 2 * block_diag(q, r)  # acados halves its weights
    ocp.cost.W_e = 2 * control.terminal_factor * q
    ocp.cost.Vx = ocp.cost.Vx_0 = np.vstack([np.eye(10), np.zeros((2, 10))])
    ocp.cost.Vu = ocp.cost.Vu_0 = np.vstack([np.zeros((10, 2)), np.eye(2)])
    ocp.cost.Vx_e = np.eye(10)
    ocp.cost.yref = ocp.cost.yref_0 = np.zeros(12)
    ocp.cost.yref_e = np.zeros(10)
    limit, room = np.full(2, params.vehicle.max_body_rate), np.array(control.state_bounds)
    ocp.constraints.x0, ocp.constraints.idxbu = np.zeros(10), np.arange(2)
    ocp.constraints.lbu, ocp.constraints.ubu = -limit, limit
    for suffix in ("", "_e"):
        for name, value in (("idxbx", np.arange(10)), ("lbx", -room), ("ubx", room), ("idxsbx", np.arange(10))):
            setattr(ocp.constraints, name + suffix, value)
        for name, price in (
            ("zl", 0.0),
            ("zu", 0.0),
            ("Zl", 2 * control.slack_weight),
            ("Zu", 2 * control.slack_weight),
        ):
            setattr(ocp.cost, name + suffix, np.full(10, price))
    options = ocp.solver_options
    options.qp_solver, options.integrator_type, options.nlp_solver_type = (
        "PARTIAL_CONDENSING_HPIPM",
        "DISCRETE",
        "SQP_RTI",
    )
    options.qp_solver_cond_N, options.qp_solver_warm_start, options.qp_tol = 20, 1, 1e-8
    solver = template.AcadosOcpSolver(ocp, verbose=False)

    def call(tick: Tick) -> NDArray:
        solver.set(0, "lbx", tick.state)
        solver.set(0, "ubx", tick.state)
        for k in range(nodes):
            solver.cost_set(k, "yref", np.concatenate((tick.reference[k], np.zeros(2))))
        solver.cost_set(nodes, "yref", tick.reference[nodes])
        solver.solve()
        return solver.get(0, "u")

    def answer(_: NDArray) -> NDArray:
        return np.array([solver.get(k, "u") for k in range(nodes)])

    return Contender(call, answer, 1e-4, "real-time iteration, N condensed to 20, warm start")


def rivals(params: Params) -> dict[str, Callable[[], Contender]]:
    """What makes each rival, by name."""
    qp = quadratic_program(params)
    return {
        "HPIPM (CasADi)": lambda: casadi_hpipm(params),
        "HPIPM (CasADi), hard bounds": lambda: casadi_hpipm(params, soft=False),
        "OSQP (CasADi)": lambda: casadi_osqp(qp),
        "PIQP (CasADi)": lambda: casadi_piqp(qp),
        "OSQP": lambda: osqp(qp),
        "PIQP": lambda: piqp(qp),
        "Clarabel": lambda: clarabel(qp),
        "quadprog": lambda: quadprog(params),
        "ipopt": lambda: ipopt(params),
        "do-mpc": lambda: do_mpc(params),
        "acados": lambda: acados(params),
    }


# --- a new length, cold caches


def new_length(params: Params, quick: bool) -> list[Row]:
    """The set-up for a length that was not seen before and its first solve; rivals set up what they keep."""
    tick = Tick(np.full(10, 0.01), np.zeros((params.control.nodes + 1, 10)))
    low, high = params.estimation.length_min, params.estimation.length_max
    lengths = np.random.default_rng(0).uniform(low, high, 30 if quick else 400)

    def at(make: Callable[[Params], Contender]) -> Callable[[], Contender]:
        def build() -> Contender:
            first = make(params)

            def call(length: float) -> Any:
                return make(params.replace(pendulum__length=float(length))).call(tick)

            return Contender(call, first.answer, first.tolerance, "set-up and first solve")

        return build

    mpc = MPC(params)
    own = Contender(
        lambda length: mpc.solve(*tick, length), lambda found: found.inputs, remark="set-up and first solve"
    )
    others = {
        "PIQP": at(lambda changed: piqp(quadratic_program(changed))),
        "OSQP": at(lambda changed: osqp(quadratic_program(changed))),
        "quadprog": at(quadprog),
        "HPIPM (CasADi)": at(casadi_hpipm),
        "ipopt": at(ipopt),
    }
    rows = compare(TOPIC, "new length", own, others, lengths, budget=0.5 if quick else 3.0, checks=3, block=2)
    prepared = Contender(mpc.prepare, lambda _: np.zeros(1), remark="set-up alone")
    return rows + compare(TOPIC, "new length, set-up alone", prepared, {}, lengths[::-1] + 1e-6, block=2)


def cold(params: Params, sequence: list[Tick], quick: bool) -> list[Row]:
    """Ours with caches emptied ahead of each call, compared with itself in a row: the ratio is the price of cold."""
    litter = np.zeros(8 << 20)

    def evict() -> None:
        litter.__iadd__(1.0)

    chosen = sequence[:: max(1, len(sequence) // (30 if quick else 300))]
    contender = ours(params)
    return compare(
        TOPIC, "cold caches", contender, {"PIQP": lambda: piqp(quadratic_program(params))}, chosen, before=evict
    )


def measure(quick: bool) -> list[Row]:
    """Every sequence, cold caches, new lengths."""
    params = Params()
    others = rivals(params)
    rows, found = [], sequences(params)
    for name, sequence in found.items():
        chosen = sequence[:: max(1, len(sequence) // 64)] if quick else sequence
        rows += compare(TOPIC, name, ours(params), others, chosen, budget=0.3 if quick else 4.0)
    rows += cold(params, found["circle with pushes"], quick) + new_length(params, quick)
    return rows


def quantities(rows: list[Row]) -> dict[str, float]:
    """What the ledger uses, in us: the median of all flights, and the longest 99th percentile."""
    own = [row for row in rows if row.contender == "fip"]
    flights = [row for row in own if row.work in (*FLIGHTS, "bounded ticks only")]
    return {
        "mpc_p50": float(np.median([row.p50_us for row in flights])),
        "mpc_p99": max(row.p99_us for row in flights),
        "new_length_p99": next(row.p99_us for row in own if row.work == "new length, set-up alone"),
    }


def keep(rows: list[Row]) -> None:
    """Write the quantities that the ledger uses."""
    with SAVED.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["quantity", "value_us"])
        writer.writerows([name, f"{value:.0f}"] for name, value in quantities(rows).items())
    print(f"wrote {SAVED}")


if __name__ == "__main__":
    main(TOPIC, measure, __doc__, keep)
