"""The linear closed loop: its plant, its delays and its observer against the simulator, its margins against theory."""

import dataclasses
import math

import control
import numpy as np
import pytest

from fiplib import dynamics
from fiplib.controllers import margins
from fiplib.dynamics import PLANT
from fiplib.mpc import MPC
from fiplib.params import AXES, GRAVITY, Params
from fiplib.references import Hover
from fiplib.simulate import Scenario, fly

PARAMS = Params()
MPC_OF_ALL = MPC(PARAMS)
ROD, POINT = 1.0 / 12.0, 0.0


def loop(used: float, true: float = 1.0, gyration_ratio: float = ROD, params: Params = PARAMS) -> margins.LinearLoop:
    rod = {"pendulum__length": true, "pendulum__gyration_ratio": gyration_ratio}
    return margins.closed_loop(used, params.replace(**rod), MPC_OF_ALL if params is PARAMS else None)


def grows(open_loop: control.StateSpace, factor: float = 1.0) -> bool:
    """Whether the loop closed with ``factor`` times its gain is unstable."""
    return bool(np.abs(np.linalg.eigvals(open_loop.A - factor * open_loop.B @ open_loop.C)).max() > 1.0)


@pytest.mark.parametrize("gyration_ratio", [POINT, ROD, 0.2])
@pytest.mark.parametrize("length", [0.4, 1.0, 1.7])
def test_the_linear_plant_is_the_derivative_of_the_coupled_plant_in_the_upright_hover(length, gyration_ratio):
    params = PARAMS.replace(pendulum__length=length, pendulum__gyration_ratio=gyration_ratio)
    upright, hover = np.zeros(20), np.zeros(4)
    upright[[9, 12]] = 1.0
    upright[PLANT["thrust"]] = hover[3] = (params.vehicle.mass + params.pendulum.mass) * GRAVITY
    jacobians = dynamics.jacobians(dynamics.coupled_plant(params))
    df_dx, df_du = (np.array(matrix) for matrix in jacobians(upright, hover, np.zeros(3)))
    a, b = margins.linear_plant(params)
    # (s, s', d, d', tilt, rate) in the plant's coordinates: d = r q_x, tilt = 2 q_y of the quaternion, about y
    scale = np.array([1.0, 1.0, length / 2, length / 2, 2.0, 1.0])
    for states, command, sign in (((0, 3, 10, 13, 7, 17), 1, 1.0), ((1, 4, 11, 14, 6, 16), 0, -1.0)):
        signed = scale * np.array([1.0, 1.0, 1.0, 1.0, sign, sign])
        # equal up to the rounding of terms as large as 2 g / l = 49
        expected = df_dx[np.ix_(states, states)] * np.outer(signed, 1 / signed)
        np.testing.assert_allclose(a, expected, atol=1e-12)
        np.testing.assert_allclose(b, sign * signed[:, None] * df_du[np.ix_(states, [command])], atol=1e-12)


@pytest.mark.parametrize("used, true", [(1.0, 1.0), (0.7, 1.0), (1.2, 0.8)])
def test_a_flight_from_a_small_lean_follows_the_linear_loop_tick_by_tick(used, true):
    """Noise-free, so that all that differs is of third order in the lean, or rounding to single precision."""
    params = PARAMS.replace(
        simulation__position_noise=0.0,
        simulation__attitude_noise=0.0,
        simulation__initial_lean=1e-3,
        pendulum__length=true,
        piloting__initial_length=used,
    )
    flight = fly(Scenario("small lean", "", 1.5, Hover(), params=params, seed=3))
    truth = flight.truth_state.values[::2]
    for index, axis in enumerate(AXES):
        signs = np.array([1.0, 1.0, 1.0, 1.0, axis.sign])
        flown = truth[:, list(axis.states)] * signs
        linear = margins.closed_loop(used, params, axis=index).open_loop
        state = np.zeros(linear.nstates)
        state[[2, 7]] = flown[0, 2]  # the observer's first frame gives no velocity
        followed = []
        for _ in flown:
            followed.append(state[:5])
            state = (linear.A - linear.B @ linear.C) @ state
        followed = np.array(followed)
        largest = np.abs(followed).max(axis=0)
        # single precision of positions about 1 m (6e-8) in a lean of 1e-3: 1e-4, times the differentiation's gain
        assert (np.abs(flown - followed).max(axis=0) < 3e-3 * largest).all()
        assert np.ptp(flown[:, 2]) > abs(flown[0, 2]), "the rod really moved"


@pytest.mark.parametrize("used, true, gyration_ratio", [(1.0, 1.0, ROD), (0.6, 1.0, POINT), (1.3, 1.0, ROD)])
def test_the_gain_margins_are_where_the_closed_loop_turns_unstable(used, true, gyration_ratio):
    linear = loop(used, true, gyration_ratio)
    low, high = linear.margins.gain_low, linear.margins.gain_high
    assert low < 1.0 < high
    # 1 %: the crossing is interpolated between frequencies 2.6 % apart
    for factor, unstable in ((0.99 * low, True), (1.01 * low, False), (0.99 * high, False), (1.01 * high, True)):
        assert grows(linear.open_loop, factor) == unstable


@pytest.mark.parametrize("used, gyration_ratio", [(0.4, POINT), (1.0, POINT), (1.0, ROD)])
def test_the_delay_margin_is_the_delay_at_which_the_closed_loop_turns_unstable(used, gyration_ratio):
    margin = loop(used, 1.0, gyration_ratio).margins.delay
    substep = 1.0 / PARAMS.simulation.plant_rate
    # the loop takes delays in whole substeps, of 1 ms; 1 %: the crossing is interpolated
    for extra, unstable in ((math.floor(0.99 * margin / substep), False), (math.ceil(1.01 * margin / substep), True)):
        delay = PARAMS.simulation.rate_delay + extra * substep
        delayed = PARAMS.replace(simulation__rate_delay=delay)
        assert (loop(used, 1.0, gyration_ratio, delayed).growth_rate > 0.0) == unstable


def test_the_disk_margin_is_that_of_python_control():
    linear = loop(0.8)
    omega = np.geomspace(margins.SLOWEST, 0.999 * np.pi / linear.step, margins.FREQUENCIES)
    expected, _, _ = control.disk_margins(linear.open_loop, omega)
    assert linear.margins.disk == pytest.approx(expected, rel=1e-9)  # the same formula on the same frequencies
    # along the real axis the disk lies within the gain margins
    assert linear.margins.gain_low <= (2 - linear.margins.disk) / (2 + linear.margins.disk)
    assert linear.margins.gain_high >= (2 + linear.margins.disk) / (2 - linear.margins.disk)


def test_an_unstable_loop_has_no_margins():
    linear = loop(2.0)
    assert linear.growth_rate > 0.0 and linear.spectral_radius > 1.0
    assert dataclasses.astuple(linear.margins) == (1.0, 1.0, 0.0, 0.0)


def test_the_gain_is_what_the_mpc_answers_to_a_small_state():
    linear = loop(0.9)
    for index, state in enumerate(AXES[0].states):
        small = np.zeros(10)
        small[state] = 1e-4
        answer = MPC_OF_ALL.solve(small, np.zeros((PARAMS.control.nodes + 1, 10)), 0.9)
        assert not answer.bounded
        # the plan is a sum of 65 products in double precision
        assert answer.input[AXES[0].input] == pytest.approx(-linear.gain[index] * 1e-4, rel=1e-9)


def test_without_delay_lag_and_filter_a_fast_loop_has_the_eigenvalues_of_continuous_feedback():
    fast = PARAMS.replace(
        simulation__rate_delay=0.0,
        simulation__mocap_latency=0.0,
        simulation__rate_lag=1e-4,
        simulation__plant_rate=9600.0,
        piloting__mocap_rate=9600.0,
        piloting__control_rate=9600.0,
        piloting__velocity_cutoff=1e6,
        pendulum__mass=1e-9,
        vehicle__seat_height=0.0,
        piloting__seat_height=0.0,
    )
    linear = loop(1.0, 1.0, POINT, fast)
    a, b = dynamics.axis_matrices(1.0)
    expected = np.sort_complex(np.linalg.eigvals(a - b @ linear.gain[None]))
    slow = np.log(linear.eigenvalues[:5]) / linear.step
    # what is left of lag and sampling, 0.2 ms, beside the fastest mode of about 6 1/s
    np.testing.assert_allclose(np.sort_complex(slow), expected, rtol=0.02)


@pytest.mark.parametrize("stated", [0.04, 0.1])
def test_a_flight_whose_pilot_is_mistaken_about_its_seat_follows_the_linear_loop(stated):
    params = PARAMS.replace(
        simulation__position_noise=0.0,
        simulation__attitude_noise=0.0,
        simulation__initial_lean=1e-3,
        piloting__seat_height=stated,
    )
    truth = fly(Scenario("small lean", "", 1.0, Hover(), params=params, seed=3)).truth_state.values[::2]
    flown, linear = truth[:, list(AXES[0].states)], margins.closed_loop(1.0, params).open_loop
    state, followed = np.zeros(linear.nstates), []
    state[[2, 7]] = flown[0, 2]
    for _ in flown:
        followed.append(state[:5])
        state = (linear.A - linear.B @ linear.C) @ state
    # single precision of positions about 1 m in a lean of 1e-3, as above
    assert (np.abs(flown - followed).max(axis=0) < 3e-3 * np.abs(followed).max(axis=0)).all()


def test_rates_that_do_not_fit_and_other_measurements_are_refused():
    with pytest.raises(ValueError, match="whole multiples"):
        margins.closed_loop(1.0, PARAMS.replace(piloting__control_rate=100.0))
    with pytest.raises(ValueError, match="position"):
        margins.closed_loop(1.0, PARAMS.replace(piloting__pendulum_measurement="direction"))
