"""The fast solver is the paper's optimal control problem: same optimum, same bounds, no memory, clear refusals."""

import math

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fiplib.dynamics import jacobians, prediction_model, rk4
from fiplib.mpc import CACHED_LENGTHS, MPC, SLACK_TOLERANCE, Status, problem, weights
from fiplib.params import A_DOT, AXES, B_DOT, PHI, THETA, X_DOT, Y_DOT, A, B, Control, Params, Vehicle, X, Y

PARAMS = Params()
N = PARAMS.control.nodes
U_MAX = PARAMS.vehicle.max_body_rate
X_MAX = np.array(PARAMS.control.state_bounds)
TICK = 1.0 / PARAMS.piloting.control_rate
HOVER = np.zeros((N + 1, 10))
NO_BOUNDS = PARAMS.replace(vehicle__max_body_rate=math.inf, control__state_bounds=(math.inf,) * 10)
HARD_BOUNDS = PARAMS.replace(control__slack_weight=math.inf)

PUSH = 0.35
"""Largest speed that a push gives to the COM of a 1 m rod, m/s; the paper's kind, 6 mN s on 32 g, gives 0.19 m/s."""

ALIKE = PARAMS.replace(control__state_weights=(20.0, 5.0, 20.0, 5.0, 1000.0, 50.0, 1000.0, 50.0, 1.0, 1.0))
"""Both axes weighted as x is."""


def circle(time, radius):
    """Position and velocity on a circle of 9 s over the horizon, from a time on."""
    rate = 2 * np.pi / 9.0
    phase = rate * (time + PARAMS.control.step * np.arange(N + 1))
    reference = np.zeros((N + 1, 10))
    reference[:, X], reference[:, Y] = radius * np.cos(phase), radius * np.sin(phase)
    reference[:, X_DOT], reference[:, Y_DOT] = -rate * reference[:, Y], rate * reference[:, X]
    return reference


def flight(length, rng, inertia_factor, radius, ticks=300, every=12):
    """(state, reference) at every n-th tick of the linear model in closed loop, pushed every half second.

    A rod that is past saving (the plan leaves the bounds severalfold and the solve fails) is set up again; the pushes
    shrink with the rod, which falls the faster the shorter it is.
    """
    mpc, step = MPC(PARAMS), rk4(prediction_model(inertia_factor), TICK)
    spread = np.array([0.4, 0.2, 0.4, 0.2, 0.01, 0.02, 0.01, 0.02, 0.03, 0.03])
    state = circle(0.0, radius)[0] + spread * rng.uniform(-1, 1, 10)
    for tick in range(ticks):
        reference = circle(tick * TICK, radius)
        if tick % 60 == 30:
            state[[A_DOT, B_DOT]] += PUSH * length**0.6 * rng.uniform(-1, 1, 2)
        solution = mpc.solve(state, reference, length)
        if solution.status is Status.FAILED:
            state = reference[0] + spread * rng.uniform(-1, 1, 10)
            solution = mpc.solve(state, reference, length)
        if tick % every == 0:
            yield state.copy(), reference
        state = step(state, solution.input, length).full().ravel()


def flights(length):
    """At least 100 states of four closed-loop flights: with and without rod inertia, in hover and on the circle."""
    rng = np.random.default_rng(round(1000 * length))
    return [x for factor in (1.0, 0.75) for radius in (0.0, 0.8) for x in flight(length, rng, factor, radius)]


def independent_solver(params, matrices=None):
    """ipopt on the problem as it is written, all 10 states at once: (state, reference, length) -> (u, x).

    Its own error at this tolerance: tightened to 1e-12 (three times slower) its answers move by up to 1.1e-7 rad/s,
    and end 5e-11 from ours.
    """
    ocp = problem(params, matrices)
    ipopt = {"tol": 1e-9, "bound_relax_factor": 0.0, "mehrotra_algorithm": "yes", "print_level": 0, "sb": "yes"}
    constant = {"jac_c_constant": "yes", "jac_d_constant": "yes", "hessian_constant": "yes"}
    casadi = {"expand": True, "detect_simple_bounds": True, "print_time": False}
    ocp.opti.solver("ipopt", casadi, ipopt | constant)
    function = ocp.opti.to_function("ocp", [ocp.state, ocp.reference, ocp.length], [ocp.inputs, ocp.states])
    return lambda state, reference, length: tuple(m.full().T for m in function(state, reference.T, length))


IPOPT = independent_solver(PARAMS)


@pytest.mark.parametrize("length", [0.2, 0.5, 1.0, 1.4, 2.0])
def test_the_first_input_is_that_of_an_independent_solver_of_the_written_problem(length):
    mpc, visited = MPC(PARAMS), flights(length)
    bounded = []
    for state, reference in visited:
        solution = mpc.solve(state, reference, length)
        inputs, states = IPOPT(state, reference, length)
        # the project's requirement; most of the largest difference is ipopt's own error
        assert np.abs(solution.input - inputs[0]).max() < 1e-6
        # the rest of the plan is as exact; the states' units are not the input's, hence ten times wider
        assert np.abs(solution.states - states).max() < 1e-5
        # within 10 times the tolerance on either side of it the two may differ
        excess = (np.abs(states[1:]) - X_MAX).max()
        if not 0.1 * SLACK_TOLERANCE < excess < 10 * SLACK_TOLERANCE:
            assert solution.status is (Status.SOFTENED if excess > SLACK_TOLERANCE else Status.OPTIMAL)
        bounded.append(solution.bounded)
    assert len(visited) >= 100  # five lengths: 500 states
    assert np.mean(bounded) >= 0.3


def random_state(rng, size=1.0):
    """Lively, yet recoverable for a 1 m rod at size 1."""
    return size * rng.uniform(-1, 1, 10) * np.array([0.8, 0.5, 0.8, 0.5, 0.03, 0.12, 0.03, 0.12, 0.1, 0.1])


def test_full_weight_matrices_within_an_axis_are_solved_exactly():
    rng = np.random.default_rng(1)
    q, p = np.zeros((2, 10, 10))
    for axis in AXES:
        for matrix in (q, p):
            root = rng.normal(size=(5, 5))
            matrix[np.ix_(axis.states, axis.states)] = root @ root.T
    # symmetric to the bit: BLAS does not promise it for a product of a matrix with its transpose
    q, p = (q + q.T) / 2, (p + p.T) / 2
    r = np.diag([0.3, 0.7])
    mpc, solver = MPC(PARAMS, q, r, p), independent_solver(PARAMS, weights(PARAMS, q, r, p))
    solutions = []
    for _ in range(12):
        state, reference = random_state(rng), circle(rng.uniform(0.0, 9.0), 0.8)
        solutions.append(mpc.solve(state, reference, 1.0))
        # as above: the requirement on u_0
        assert np.abs(solutions[-1].input - solver(state, reference, 1.0)[0][0]).max() < 1e-6
    assert {solution.bounded for solution in solutions} == {True, False}


def test_infinite_bounds_are_dropped_and_hard_state_bounds_are_kept():
    some = PARAMS.replace(control__state_bounds=(*[math.inf] * 4, 0.1, math.inf, 0.1, 0.4, math.inf, 0.2))
    rng, bounded = np.random.default_rng(2), 0
    for params in (some, some.replace(control__slack_weight=math.inf)):
        mpc, solver = MPC(params), independent_solver(params)
        for _ in range(10):
            state = random_state(rng, 0.7)
            solution = mpc.solve(state, HOVER)
            assert solution.status is not Status.FAILED
            # as above: the requirement on u_0
            assert np.abs(solution.input - solver(state, HOVER, params.pendulum.length)[0][0]).max() < 1e-6
            bounded += solution.bounded
    # hard bounds are kept to the QP solver's tolerance, scaled by the size of its rows
    assert (np.abs(solution.states[1:]) <= np.array(params.control.state_bounds) + 1e-8).all()
    assert bounded >= 5


def test_without_bounds_and_with_the_riccati_terminal_weight_it_is_the_linear_quadratic_regulator():
    step = rk4(prediction_model(), PARAMS.control.step)
    a, b = (matrix.full() for matrix in jacobians(step)(np.zeros(10), np.zeros(2), 1.4))
    q, r = np.diag(PARAMS.control.state_weights), np.diag(PARAMS.control.input_weights)
    gain, cost, _ = control.dlqr(a, b, q, r)
    mpc = MPC(NO_BOUNDS, terminal_weights=(cost + cost.T) / 2 * (np.abs(cost) > 1e-6))  # off-axis entries are rounding
    for state in np.random.default_rng(3).normal(size=(20, 10)):
        solution = mpc.solve(state, HOVER, 1.4)
        # two Riccati solvers on gains of order 100: 1e-9 relative
        assert np.allclose(solution.input, -gain @ state, rtol=0, atol=1e-7)
        assert not solution.bounded


def test_the_plan_follows_the_model_within_hard_input_bounds():
    rng, mpc = np.random.default_rng(4), MPC(PARAMS)
    step = rk4(prediction_model(), PARAMS.control.step)
    for length in (0.5, 1.0, 2.0):
        state = random_state(rng, 0.8)
        solution = mpc.solve(state, circle(0.0, 0.4), length)
        assert solution.inputs.shape == (N, 2) and solution.states.shape == (N + 1, 10)
        assert np.array_equal(solution.input, solution.inputs[0]) and np.array_equal(solution.states[0], state)
        assert np.abs(solution.inputs).max() <= U_MAX
        successors = step.map(N)(solution.states[:-1].T, solution.inputs.T, length).full().T
        # one step each, so that rounding is not multiplied by the pendulum's instability
        assert np.abs(solution.states[1:] - successors).max() < 1e-8


def test_the_two_axes_weighted_alike_are_one_system_after_the_sign_flip():
    mpc = MPC(ALIKE)
    (x_axis, y_axis), state = AXES, np.zeros(10)
    state[list(x_axis.states)] = 0.5, -0.2, 0.02, 0.1, 0.05
    mirrored = np.zeros(10)
    mirrored[list(y_axis.states)] = state[list(x_axis.states)]
    mirrored[PHI] = -state[THETA]
    original, mirror = mpc.solve(state, HOVER), mpc.solve(mirrored, HOVER)
    assert original.bounded and original.input[1] != 0.0
    assert original.input[1] == -mirror.input[0]
    assert np.array_equal(original.states[:, [X, A, THETA]], mirror.states[:, [Y, B, PHI]] * [1, 1, -1])


def test_a_solve_does_not_depend_on_what_was_solved_before():
    rng, experienced = np.random.default_rng(5), MPC(PARAMS)
    # more lengths than are kept, each returned to, so that set-ups are made, reused, dropped and made again
    lengths = np.resize(np.linspace(0.4, 2.0, CACHED_LENGTHS + 3), 40)
    for length in np.concatenate([lengths, np.repeat(lengths[:3], 4)]):
        state = random_state(rng, rng.choice([0.3, 1.0, 4.0]))  # free, bounded, past saving
        solution, fresh = experienced.solve(state, HOVER, length), MPC(PARAMS).solve(state, HOVER, length)
        assert np.array_equal(solution.states, fresh.states) and np.array_equal(solution.inputs, fresh.inputs)
        assert solution.status is fresh.status


def test_the_length_is_that_of_the_parameters_unless_given():
    state = random_state(np.random.default_rng(6))
    mpc = MPC(PARAMS.replace(pendulum__length=0.7))
    assert np.array_equal(mpc.solve(state, HOVER).states, mpc.solve(state, HOVER, 0.7).states)
    assert not np.array_equal(mpc.solve(state, HOVER).states, mpc.solve(state, HOVER, 1.0).states)


def test_a_state_outside_its_bounds_is_brought_back_at_the_price_of_slack():
    state = np.zeros(10)
    state[X] = X_MAX[X] + 0.5
    solution = MPC(PARAMS).solve(state, HOVER)
    assert solution.status is Status.SOFTENED and solution.bounded
    assert abs(solution.states[1, X]) > X_MAX[X] and abs(solution.states[-1, X]) < X_MAX[X]


def test_a_failed_solve_gives_the_saturated_unconstrained_inputs():
    state = np.zeros(10)
    state[[X, A]] = X_MAX[X] + 0.5, 0.01  # no input keeps x_1 within a hard bound that x_0 exceeds by 0.5 m
    solution = MPC(HARD_BOUNDS).solve(state, HOVER)
    free = MPC(NO_BOUNDS).solve(state, HOVER)
    assert solution.status is Status.FAILED
    assert np.array_equal(solution.inputs, np.clip(free.inputs, -U_MAX, U_MAX))
    step = rk4(prediction_model(), PARAMS.control.step)
    assert np.allclose(
        solution.states[1], step(state, solution.input, PARAMS.pendulum.length).full().ravel(), atol=1e-12
    )


def test_a_failed_axis_leaves_the_other_axis_its_optimum():
    state = random_state(np.random.default_rng(7), 0.5)
    good = MPC(HARD_BOUNDS).solve(state, HOVER)
    state[X] = X_MAX[X] + 0.5
    bad = MPC(HARD_BOUNDS).solve(state, HOVER)
    assert good.status is Status.OPTIMAL and bad.status is Status.FAILED
    assert bad.input[0] == good.input[0]


@settings(max_examples=40)
@given(
    st.lists(st.floats(-1.0, 1.0), min_size=10, max_size=10),
    st.sampled_from([0.3, 1.0]),
    st.floats(0.3, 2.0),
    st.floats(0.0, 9.0),
    st.sampled_from([0.0, 0.4, 0.8]),
)
def test_the_compiled_plan_is_that_of_the_written_problem(direction, size, length, time, radius):
    state = (
        size * min(length, 1.0) * np.array(direction) * np.array([0.8, 0.5, 0.8, 0.5, 0.03, 0.12, 0.03, 0.12, 0.1, 0.1])
    )
    reference = circle(time, radius)
    state += reference[0]
    solution = MPC(PARAMS).solve(state, reference, length)
    inputs, states = IPOPT(state, reference, length)
    assert solution.status is not Status.FAILED
    assert np.abs(solution.input - inputs[0]).max() < 1e-6
    assert np.abs(solution.states - states).max() < 1e-5


def test_read_only_and_strided_arguments_give_the_same_plan():
    state, reference = random_state(np.random.default_rng(8)), circle(0.0, 0.4)
    plain = MPC(PARAMS).solve(state, reference)
    wide = np.zeros((N + 1, 20))
    wide[:, ::2] = reference
    state.flags.writeable = wide.flags.writeable = False
    assert np.array_equal(MPC(PARAMS).solve(state, wide[:, ::2]).states, plain.states)
    assert np.array_equal(MPC(PARAMS).solve(state, np.asfortranarray(reference)).states, plain.states)
    assert np.array_equal(MPC(PARAMS).solve(list(state), reference.tolist()).inputs, plain.inputs)


def test_the_map_to_the_plan_is_the_plan_where_no_bound_is_active():
    problem_x = MPC(NO_BOUNDS).prepare(1.0)[0]
    state = 0.1 * random_state(np.random.default_rng(9))
    solution, axis = MPC(NO_BOUNDS).solve(state, HOVER, 1.0), list(AXES[0].states)
    plan = (problem_x.plan[:, :5] @ state[axis]).reshape(N, 6)  # in hover w* = 0
    # two orders of the same sums
    assert np.allclose(plan[:, 0], solution.inputs[:, AXES[0].input], atol=1e-12)
    assert np.allclose(plan[:, 1:], solution.states[1:, axis], atol=1e-12)
    assert problem_x.rows.size == 0 and MPC(PARAMS).prepare(1.0)[0].rows.size == 6 * N


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.floats(-1.0, 1.0), min_size=10, max_size=10),
    st.sampled_from([1e-2, 1.0, 1e3, 1e12]),
    st.floats(0.2, 2.0),
)
def test_whatever_the_state_the_input_is_finite_and_within_bounds(direction, size, length):
    solution = MPC(PARAMS).solve(size * np.array(direction), HOVER, length)
    assert np.isfinite(solution.inputs).all()
    assert np.abs(solution.inputs).max() <= U_MAX


@pytest.mark.parametrize(
    ("state", "reference", "length", "message"),
    [
        (np.full(10, np.nan), HOVER, 1.0, "state must be finite"),
        (np.zeros(9), HOVER, 1.0, r"state must have shape \(10,\)"),
        (np.zeros(10), np.full((N + 1, 10), np.inf), 1.0, "reference must be finite"),
        (np.zeros(10), np.zeros((N, 10)), 1.0, r"reference must have shape \(61, 10\)"),
        (np.zeros(10), HOVER, 0.0, "length must be positive"),
        (np.zeros(10), HOVER, -1.0, "length must be positive"),
        (np.zeros(10), HOVER, math.nan, "length must be positive"),
        (np.zeros(10), HOVER, math.inf, "length must be positive"),
    ],
)
def test_what_cannot_be_solved_is_refused(state, reference, length, message):
    with pytest.raises(ValueError, match=message):
        MPC(PARAMS).solve(state, reference, length)


def with_entry(matrix, i, j, value):
    matrix = np.array(matrix, dtype=float)
    matrix[i, j] = matrix[j, i] = value
    return matrix


Q, R = np.diag(PARAMS.control.state_weights), np.diag(PARAMS.control.input_weights)


@pytest.mark.parametrize(
    ("matrices", "message"),
    [
        ({"state_weights": with_entry(Q, X, Y, 0.1)}, "couples the two axes: x with y"),
        ({"terminal_weights": with_entry(Q, A, PHI, 0.1)}, "couples the two axes: a with phi"),
        ({"input_weights": with_entry(R, 0, 1, 0.1)}, "couples the two axes: omega_x with omega_y"),
        ({"state_weights": with_entry(Q, X, X, -1e-9)}, "state_weights Q must not be negative"),
        ({"state_weights": with_entry(Q, X, X_DOT, 100.0)}, "state_weights Q must not be negative"),
        ({"state_weights": Q + np.eye(10, k=1)}, "state_weights Q must be symmetric"),
        ({"state_weights": np.ones(9)}, "state_weights Q must have shape"),
        ({"state_weights": np.full(10, np.nan)}, "state_weights Q must be finite"),
        ({"terminal_weights": -Q}, "terminal_weights P must not be negative"),
        ({"input_weights": [0.5, 0.0]}, "input_weights R must be positive"),
    ],
)
def test_weights_that_are_no_prices_or_couple_the_axes_are_refused(matrices, message):
    with pytest.raises(ValueError, match=message):
        MPC(PARAMS, **matrices)


@pytest.mark.parametrize(
    "unchecked",
    [
        Params(control=Control(nodes=0)),
        Params(control=Control(nodes=60.0)),
        Params(control=Control(horizon=0.0)),
        Params(control=Control(horizon=math.inf)),
        Params(control=Control(slack_weight=0.0)),
        Params(control=Control(state_bounds=(1.0,) * 9)),
        Params(control=Control(state_bounds=(math.nan,) * 10)),
        Params(control=Control(terminal_factor=-1.0)),
        Params(vehicle=Vehicle(max_body_rate=-1.0)),
    ],
)
def test_parameters_that_make_no_problem_are_refused(unchecked):
    with pytest.raises(ValueError, match=r"must be positive|must not be negative|needs a whole number of nodes"):
        MPC(unchecked)
