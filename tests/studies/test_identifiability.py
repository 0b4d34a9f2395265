"""The response that tells three lengths apart is that of the plant."""

import casadi as ca
import numpy as np
import pytest
from scipy.signal import welch

from fiplib import dynamics
from fiplib.params import GRAVITY, Params
from fiplib.references import Circle
from fiplib.simulate import Scenario, fly
from fiplib.studies import identifiability


@pytest.mark.parametrize("changes", [{}, {"vehicle__seat_height": 0.0}, {"pendulum__gyration_ratio": 1 / 24}])
def test_the_response_is_that_of_the_linearised_plant(changes):
    params = Params().replace(pendulum__length=0.7, **changes)
    plant = dynamics.coupled_plant(params)
    x, command, force = plant.sx_in()
    rate = plant(x, command, force)
    jacobian = ca.Function("jacobian", [x, command, force], [ca.jacobian(rate, ca.vertcat(x, command))])
    weight = (params.vehicle.mass + params.pendulum.mass) * GRAVITY
    hover = np.zeros(20)
    hover[[9, 12, 19]] = 1.0, 1.0, weight
    both = jacobian(hover, [0, 0, 0, weight], np.zeros(3)).full()
    a, pitching = both[:, :20], both[:, 21]
    height, middle = params.vehicle.seat_height, params.pendulum.length / 2
    share = params.pendulum.mass / (params.pendulum.mass + params.vehicle.mass)
    for frequency in (0.05, 0.4, 1.3, 6.0, 30.0):
        amplitude = np.linalg.solve(2j * np.pi * frequency * np.eye(20) - a, pitching)
        e = 2.0 * amplitude[7]  # of a small rotation about y
        difference = middle * amplitude[10] + height * e
        expected = identifiability.response(frequency, *identifiability.lengths_of(params), share)
        assert difference / e == pytest.approx(expected, abs=1e-9)  # both are exact: rounding only


def test_slow_motion_tells_the_sum_and_fast_motion_the_parts():
    flight = fly(Scenario("circle", "", 20.0, Circle(0.4, 8.0)))
    slow, fast = identifiability.deviations(flight, 2.5, np.array([0.5, 20.0]))
    assert slow[:3].min() > 10 * slow[3]
    assert (fast < slow).all()
    # rho, L_e and h of one axis: the pose estimator, which has both, states 2, 4 and 1 mm
    assert (fast[:3] < 0.03).all()


def test_the_measured_response_follows_the_formula():
    flight = fly(Scenario("circle", "", 20.0, Circle(0.4, 8.0)))
    frequency, measured = identifiability.measured_response(flight)
    band = (frequency > 1.0) & (frequency < 4.0)
    share = flight.params.pendulum.mass / (flight.params.pendulum.mass + flight.params.vehicle.mass)
    model = identifiability.response(frequency[band], *identifiability.lengths_of(flight.params), share)
    # 24 values of three averaged segments each scatter by 1 to 2 cm, their mean by 4 mm
    assert measured[band].real.mean() == pytest.approx(model.mean(), abs=0.012)


@pytest.mark.parametrize("seconds", [20.0, 54.0])
def test_the_interval_of_a_spectrum_holds_that_of_white_noise_in_95_of_100(seconds):
    rate = 60.0
    noise = np.random.default_rng(1).normal(size=(400, round(seconds * rate)))
    segment = round(identifiability.RESOLUTION * rate)
    _, power = welch(noise, rate, nperseg=segment, detrend="linear")
    low, high = identifiability.spectrum_interval(seconds)
    # 4 of the 241 frequencies are left out: detrending takes the lowest, the last is real; 95 000 values correlate
    held = (low * power[:, 3:-1] <= 2.0 / rate) & (2.0 / rate <= high * power[:, 3:-1])
    assert held.mean() == pytest.approx(0.95, abs=0.005)
