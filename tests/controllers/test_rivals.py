"""The rivals of the paper's MPC: they balance, keep the bounds, repeat themselves, and do what each is for."""

import numpy as np
import pytest

from fiplib.controllers import CONTROLLERS, by_axis, controller_of, rates_by_axis, rates_of
from fiplib.controllers.geometric import CALMER, QUICKER
from fiplib.controllers.nmpc import NonlinearMPC, exact_model
from fiplib.dynamics import axis_matrices, jacobians, prediction_model
from fiplib.mpc import MPC, Status
from fiplib.params import AXES, GRAVITY, PHI, THETA, A, B, Params, X, Y
from fiplib.recording import Flight
from fiplib.references import Hover
from fiplib.simulate import Plant, Scenario, fly

RIVALS = ("nonlinear_mpc", "mpc_l1", "offset_free_mpc", "geometric")
STILL = np.zeros((Params().control.nodes + 1, 10))
DIRECTION = np.array([0.1, 0.05, -0.1, 0.02, 0.03, 0.01, -0.02, 0.05, 0.02, -0.03])
QUIET = {f"simulation__{name}": 0.0 for name in ("position_noise", "attitude_noise", "initial_lean")}
"""A flight without noise."""


def with_controller(name: str, **changes) -> Params:
    return Params().replace(piloting__controller=name, **changes)


def settled(flight: Flight, seconds: float = 5.0) -> np.ndarray:
    """Mean distance (x, y) from the hover over the last seconds, m."""
    times = flight.time(flight.truth_state)
    return flight.truth_state.values[times > times[-1] - seconds][:, [X, Y]].mean(axis=0)


class BiasedRates(Plant):
    """A plant whose inner loop adds 3 and -2 deg/s to the commanded rates."""

    def command(self, body_rate, thrust, at=None):
        super().command(np.add(body_rate, np.radians([3.0, -2.0, 0.0])), thrust, at)


@pytest.mark.parametrize("name", RIVALS)
def test_a_rival_brings_a_leaning_rod_upright(name):
    params = with_controller(name, simulation__initial_lean=0.04)
    flight = fly(Scenario("", "", 6.0, Hover(), params=params, seed=2))
    lean = np.abs(flight.truth_state.values[:, [A, B]])
    assert lean[0].max() > 0.02  # it did lean, 2 degrees
    assert flight.survived
    assert lean[flight.time(flight.truth_state) > 5.0].max() < 0.01  # still hover is within 8 mm, by its noise


@pytest.mark.parametrize("name", RIVALS)
def test_rates_are_finite_and_bounded_whatever_the_state(name):
    params, rng = with_controller(name), np.random.default_rng(0)
    controller = controller_of(params)
    for scale in (0.01, 1.0, 10.0, 40.0):  # of the last the rod lies down, which no model covers
        for _ in range(3):
            rates = controller.solve(scale * rng.uniform(-1, 1, 10) * DIRECTION, STILL, rng.uniform(0.4, 1.6)).input
            assert np.isfinite(rates).all() and (np.abs(rates) <= params.vehicle.max_body_rate).all()


@pytest.mark.parametrize("name", RIVALS)
def test_the_same_calls_give_the_same_bits(name):
    def answers() -> np.ndarray:
        controller, rng = controller_of(with_controller(name)), np.random.default_rng(1)
        return np.array([controller.solve(rng.uniform(-1, 1, 10) * DIRECTION, STILL, 0.9).input for _ in range(10)])

    np.testing.assert_array_equal(answers(), answers())


@pytest.mark.parametrize("name", CONTROLLERS)
def test_a_state_that_is_not_finite_gets_no_answer(name):
    with pytest.raises(ValueError, match="must be finite"):
        controller_of(with_controller(name)).solve(np.full(10, np.nan), STILL, 1.0)


def test_noises_for_which_there_is_no_filter_are_named():
    controller = controller_of(with_controller("offset_free_mpc", estimation__process_noise=(0.0,) * 10))
    with pytest.raises(ValueError, match=r"estimation\.process_noise"):
        controller.solve(np.zeros(10), STILL, 1.0)


def test_values_by_axis_have_the_common_sign():
    np.testing.assert_array_equal(by_axis(np.arange(10.0)), [[0, 1, 4, 5, 9], [2, 3, 6, 7, -8]])
    np.testing.assert_array_equal(rates_by_axis(np.array([1.0, 2.0])), [2.0, -1.0])
    np.testing.assert_array_equal(rates_of(rates_by_axis(np.array([1.0, 2.0]))), [1.0, 2.0])


def test_the_exact_model_linearised_upright_is_the_prediction_model():
    upright = np.zeros(10), np.zeros(2), 0.7
    for exact, linear in zip(jacobians(exact_model())(*upright), jacobians(prediction_model())(*upright), strict=True):
        np.testing.assert_allclose(np.array(exact), np.array(linear), atol=1e-12)  # rounding of 2 g / l = 28


def test_nonlinear_mpc_differs_from_mpc_by_the_third_power_of_the_state():
    """Every term that the linear model leaves out is odd: half the state gives an eighth of the difference."""
    linear, differences = MPC(Params()), []
    for scale in (0.2, 0.1, 0.05):
        nonlinear = NonlinearMPC(Params())
        for _ in range(4):  # one step is not the solution, four are to 1e-9
            plan = nonlinear.solve(scale * DIRECTION, STILL, 1.0)
        differences.append(np.abs(plan.inputs - linear.solve(scale * DIRECTION, STILL, 1.0).inputs).max())
    assert differences[0] < 1e-3  # of inputs up to 0.6 rad/s
    ratios = np.divide(differences[:-1], differences[1:])
    np.testing.assert_allclose(ratios, 8.0, rtol=0.01)  # the fifth power is 0.03 % here; the solver stops at 1e-8


def test_one_step_a_tick_keeps_nonlinear_mpc_at_its_solution():
    controller, state = NonlinearMPC(Params()), 0.5 * DIRECTION
    model, period = exact_model(), 1.0 / Params().piloting.control_rate
    for _ in range(20):
        answered = controller.solve(state, STILL, 1.0)
        state = state + period * np.array(model(state, answered.input, 1.0)).ravel()
    converged = NonlinearMPC(Params())
    for _ in range(6):
        solution = converged.solve(state, STILL, 1.0)
    # the rate moves by 0.03 rad/s a tick; a step that is short of the solution would lag by about that
    np.testing.assert_allclose(controller.solve(state, STILL, 1.0).input, solution.input, atol=1e-3)


def test_where_the_model_ends_nonlinear_mpc_answers_as_mpc_and_says_so():
    state = np.zeros(10)
    state[A] = 0.45
    controller = NonlinearMPC(Params())
    answered = controller.solve(state, STILL, 1.0)
    assert answered.status is Status.FAILED
    np.testing.assert_array_equal(answered.input, MPC(Params()).solve(state, STILL, 1.0).input)
    assert controller.solve(0.1 * DIRECTION, STILL, 1.0).status is Status.OPTIMAL  # and it recovers


def test_nonlinear_mpc_refuses_hard_state_bounds():
    with pytest.raises(ValueError, match="slack_weight must be finite"):
        NonlinearMPC(Params().replace(control__slack_weight=np.inf))


WINDS = {
    "on the vehicle": {"simulation__wind": (1.0, -0.6), "simulation__drag": (0.26, 1e-9)},
    "on the rod": {"simulation__wind": (1.0, -0.6), "simulation__drag": (1e-9, 8e-3)},
    "on both": {"simulation__wind": (1.0, -0.6)},
}


@pytest.mark.parametrize("wind", WINDS)
@pytest.mark.parametrize("name", ["mpc_l1", "offset_free_mpc", "geometric"])
def test_steady_wind_leaves_no_offset_where_it_is_estimated(name, wind):
    """The slowest estimate settles with 1 / (0.05 sqrt(2 g / l)) = 4.5 s: 25 s leave 0.4 % of some 0.5 m, 2 mm.

    The L1 law's estimate is short by 1 - exp(-5 / 120) = 4.1 % besides.
    """
    flights = [
        fly(Scenario("", "", 30.0, Hover(), params=with_controller(one, **QUIET, **WINDS[wind])))
        for one in ("mpc", name)
    ]
    paper, rival = (np.abs(settled(flight)) for flight in flights)
    assert (paper > 0.05).all()
    assert (rival < 0.002 + (0.041 * paper if name == "mpc_l1" else 0.0)).all()


@pytest.mark.parametrize("name", ["mpc_l1", "offset_free_mpc"])
def test_a_biased_inner_loop_leaves_no_offset_where_it_is_estimated(name):
    """The rate's estimate settles with 1 / (0.25 sqrt(2 g / l)) = 0.9 s; of the L1 law, see above."""
    flights = [
        fly(Scenario("", "", 20.0, Hover(), params=with_controller(one, **QUIET)), vehicle=BiasedRates)
        for one in ("mpc", name)
    ]
    paper, rival = (np.abs(settled(flight)) for flight in flights)
    assert (paper > 0.01).all()
    assert (rival < 0.0001 + (0.041 * paper if name == "mpc_l1" else 0.0)).all()


@pytest.mark.parametrize("length", [0.5, 1.0])
def test_the_geometric_law_places_the_poles_that_it_names(length):
    """Before its observers have seen anything it is a state feedback; the prediction model closed by it, upright."""
    a, b = axis_matrices(length)
    falls, gain = np.sqrt(2 * GRAVITY / length), np.empty((1, 5))
    for column, state in enumerate(AXES[0].states):
        lean = np.zeros(10)
        lean[state] = 1e-6
        rates = controller_of(with_controller("geometric")).solve(lean, STILL, length).input
        gain[0, column] = -rates[AXES[0].input] / 1e-6
    wanted = np.poly(-falls * np.array([1 / CALMER, 1 / CALMER, 1, 1, QUICKER]))
    # of double poles the polynomial is compared: the poles themselves are off by the root of a rounding error
    np.testing.assert_allclose(np.poly(a - b @ gain), wanted, rtol=1e-6)


def test_the_geometric_law_turns_towards_the_rod_on_every_side_alike():
    """It has no preferred axis: a state turned by 90 degrees gives rates turned by 90 degrees."""
    state = np.zeros(10)
    state[[A, B, THETA, PHI]] = 0.003, 0.002, 0.05, -0.04
    turned = np.zeros(10)
    turned[[A, B, THETA, PHI]] = -0.002, 0.003, -0.04, -0.05  # (x, y) -> (-y, x); the thrust is along (theta, -phi)
    rates = [controller_of(with_controller("geometric")).solve(one, STILL, 1.0).input for one in (state, turned)]
    # Rx Ry keeps an order of the two angles: equal up to the third power of 0.05, times rates of 1 rad/s
    np.testing.assert_allclose(rates[1], [-rates[0][1], rates[0][0]], atol=2e-3)
