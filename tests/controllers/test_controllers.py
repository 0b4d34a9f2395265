"""Every controller of the registry flies the simulated vehicle in hover, and answers as the pilot expects."""

import numpy as np
import pytest

from fiplib.controllers import CONTROLLERS, answer, controller_of
from fiplib.mpc import Status
from fiplib.params import A, B, Params, X, Y
from fiplib.references import Hover
from fiplib.simulate import Scenario, fly


@pytest.mark.parametrize("name", CONTROLLERS)
def test_a_controller_balances_the_rod_in_hover_at_the_true_length(name):
    params = Params().replace(piloting__controller=name)
    flight = fly(Scenario("", "", 4.0, Hover(), params=params))
    truth = flight.truth_state.values[-240:]
    assert flight.survived
    # an initial lean of 3 mm and noisy commands: centimetres about the place, millimetres of lean
    assert np.abs(truth[:, [X, Y]]).max() < 0.15 and np.abs(truth[:, [A, B]]).max() < 0.02


@pytest.mark.parametrize("name", CONTROLLERS)
def test_a_controller_answers_two_finite_rates_within_their_bound(name):
    params = Params().replace(piloting__controller=name)
    controller, state = controller_of(params), np.zeros(10)
    state[[A, X]] = 0.3, -1.0  # far beyond what can be held
    solution = controller.solve(state, Hover().at(np.zeros(61)), 1.0)
    assert solution.input.shape == (2,) and np.isfinite(solution.input).all()
    assert np.abs(solution.input).max() <= params.vehicle.max_body_rate + 1e-12
    assert isinstance(solution.status, Status)


def test_an_unknown_controller_is_named_with_those_that_there_are():
    with pytest.raises(ValueError, match=r"piloting.controller must be one of lqr, lqr_ga, mpc.*, not 'pid'"):
        controller_of(Params().replace(piloting__controller="pid"))


def test_an_answer_without_a_plan_is_cut_off_and_says_so():
    found = answer(np.array([3.0, -0.5]), 1.0)
    assert found.input.tolist() == [1.0, -0.5] and found.bounded and found.states.shape == (0, 10)
    assert not answer(np.array([0.3, -0.5]), 1.0).bounded
