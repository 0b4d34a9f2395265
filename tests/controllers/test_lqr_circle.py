"""The regulator on a circle: its nominal motion solves the prediction model, and in hover it is the regulator."""

import numpy as np
import pytest

from fiplib.controllers import rates_of
from fiplib.controllers.lqr import LQR
from fiplib.controllers.lqr_circle import CircleLQR, circular_motion
from fiplib.dynamics import prediction_model
from fiplib.params import A, B, Params
from fiplib.references import Circle

STEP, LENGTH = 0.1, 1.13


def nominal(circle: Circle, time: float) -> tuple[np.ndarray, np.ndarray]:
    return circular_motion(circle.at(time + STEP * np.arange(2)), STEP, LENGTH)


@pytest.mark.parametrize("period", [2.0, 8.0])
def test_the_nominal_motion_on_a_steady_circle_solves_the_prediction_model(period):
    circle, change = Circle(0.1, period), 1e-4
    state, forward = nominal(circle, 7.3)
    derivative = (nominal(circle, 7.3 + change)[0] - nominal(circle, 7.3 - change)[0]) / (2 * change)
    model = np.array(prediction_model()(state, rates_of(forward), LENGTH)).ravel()
    # central differences leave change^2 times the third derivative: 5e-9 times 0.1 w^3 = 3
    np.testing.assert_allclose(derivative, model, atol=1e-7)
    assert np.hypot(*state[[A, B]]) == pytest.approx(0.1 / (1 + 2 * 9.81 / LENGTH / (2 * np.pi / period) ** 2))


def test_in_hover_it_is_the_regulator():
    params, state = Params(), 0.01 * np.arange(1.0, 11.0)
    still = np.zeros((params.control.nodes + 1, 10))
    answers = [controller(params).solve(state, still, LENGTH).input for controller in (LQR, CircleLQR)]
    np.testing.assert_allclose(answers[0], answers[1], rtol=1e-12)
