"""Wind, gusts, a hindered rotor and a sagging battery: each against its formula, and nothing at all by default."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fiplib.dynamics import PLANT
from fiplib.kernels.disturbance import GUST_TIME, INTEGRAL_TIME, Disturbance
from fiplib.mpc import MPC
from fiplib.params import GRAVITY, A, Params, X
from fiplib.references import Hover
from fiplib.simulate import Plant, Scenario, SimulatedVehicle, fly

PARAMS = Params()
QUIET = PARAMS.replace(simulation__position_noise=0.0, simulation__attitude_noise=0.0, simulation__initial_lean=0.0)
MASS = PARAMS.vehicle.mass + PARAMS.pendulum.mass


def test_by_default_the_load_is_the_force_itself_and_no_bag_names_the_options():
    force, disturbance = np.array([1.0, 2.0, 0.0]), Disturbance(PARAMS, 1)
    assert disturbance.load(force) is force and disturbance.size == 3 and not disturbance.acts
    options = {"wind", "gusts", "drag", "rotor_loss", "rotor_loss_start", "battery_sag"}
    assert not options & set(PARAMS.to_dict()["simulation"])
    windy = PARAMS.replace(simulation__wind=(1.0, 0.0))
    assert windy.to_dict()["simulation"]["wind"] == [1.0, 0.0]
    assert Params.from_dict(windy.to_dict()) == windy


def test_a_motion_through_still_air_has_the_drag_that_wind_has_against_a_vehicle_at_rest():
    """Galilean: the same relative motion, the same forces."""
    params = PARAMS.replace(simulation__wind=(1e-9, 0.0))  # the option on, and no wind
    moving, blown = Plant(params, (0, 0, 1.3)), Plant(params, (0, 0, 1.3))
    moving.x[PLANT["velocity"]] = -2.0, 1.0, 0.0
    windy = np.array([0.0, 0.0, 0.0, 2.0, -1.0, 0.0, 0.0, 1.0])
    still = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    for _ in range(48):
        moving.advance(still)
        blown.advance(windy)
    gained = moving.x[PLANT["velocity"]] - (-2.0, 1.0, 0.0)
    np.testing.assert_allclose(gained, blown.x[PLANT["velocity"]], rtol=0, atol=1e-12)
    assert gained[0] > 0.15  # 0.27 N on 0.6 kg for 0.2 s, and the rod falls with it


def test_in_steady_wind_vehicle_and_rod_lean_against_it_by_the_formula():
    wind, (vehicle, rod) = 2.0, PARAMS.simulation.drag
    params = PARAMS.replace(simulation__wind=(wind, 0.0))
    thrust = np.array([-(vehicle + rod) * wind, 0.0, MASS * GRAVITY])
    along = np.array([-rod * wind / PARAMS.pendulum.mass, 0.0, GRAVITY])
    plant = Plant(params, (0, 0, 1.3))
    plant.x[PLANT["attitude"]] = Rotation.from_euler("y", math.atan2(thrust[0], thrust[2])).as_quat()
    plant.x[PLANT["direction"]] = along / np.linalg.norm(along)
    plant.x[PLANT["thrust"]] = np.linalg.norm(thrust)
    plant.command((0, 0, 0), np.linalg.norm(thrust), at=0)
    start, disturbance = plant.x.copy(), Disturbance(params, 1)
    for _ in range(24):
        plant.advance(disturbance.load(np.zeros(3)))
    np.testing.assert_allclose(plant.x, start, rtol=0, atol=1e-12)


def test_a_controller_without_an_integral_stands_off_in_wind_by_the_formula():
    """u = -K (s, 0, d, 0, tilt) = 0 at rest: s = -(K_d d + K_tilt tilt) / K_s, with the leans of the test above."""
    wind, (vehicle, rod) = 1.0, PARAMS.simulation.drag
    params = QUIET.replace(simulation__wind=(wind, 0.0))
    end = fly(Scenario("", "", 12.0, Hover(), params=params)).truth_state.values[-1]
    tilt = -(vehicle + rod) * wind / (MASS * GRAVITY)
    lean = -PARAMS.pendulum.length / 2 * rod * wind / (PARAMS.pendulum.mass * GRAVITY)
    gain = MPC(params).prepare(1.0)[0].gains[0]
    assert end[A] == pytest.approx(lean, rel=0.01)
    # second order of the tilt, 0.1 %; and the plant's seat is not the model's
    assert end[X] == pytest.approx(-(gain[2] * lean + gain[4] * tilt) / gain[0], rel=0.02)


def test_gusts_have_their_deviation_and_time_and_leave_the_noise_of_motion_capture_alone():
    params, rate = PARAMS.replace(simulation__gusts=0.5), PARAMS.piloting.mocap_rate
    disturbance, frames = Disturbance(params, 3), 240_000
    gusts = np.array([disturbance.load(np.zeros(3))[3:5] for _ in range(frames)])
    lag = round(GUST_TIME * rate)
    # 1000 s hold 500 independent samples of each axis: a deviation is known to 3 %, a correlation to 0.05
    np.testing.assert_allclose(gusts.std(axis=0), 0.5, rtol=0.12)
    correlation = (gusts[lag:] * gusts[:-lag]).mean(axis=0) / gusts.var(axis=0)
    np.testing.assert_allclose(correlation, math.exp(-1.0), atol=0.15)
    calm, windy = (SimulatedVehicle(Scenario("", "", 1.0, Hover(), params=one, seed=4)) for one in (PARAMS, params))
    np.testing.assert_array_equal(calm.mocap(100).noise, windy.mocap(100).noise)
    np.testing.assert_array_equal(calm.plant.x, windy.plant.x)


def test_a_hindered_rotor_turns_the_vehicle_until_the_rate_loop_has_taken_it_over():
    params = QUIET.replace(simulation__rotor_loss=0.2)
    simulation, plant, disturbance = params.simulation, Plant(params, (0, 0, 1.3)), Disturbance(params, 1)
    torque = 0.05 * MASS * GRAVITY * 0.16 / 2**1.5
    offset = simulation.rate_lag * torque / (PARAMS.vehicle.mass * 0.032**2)
    assert disturbance.offset == pytest.approx(offset) and math.degrees(offset) == pytest.approx(24.6, abs=0.1)
    plant.command((0, 0, 0), MASS * GRAVITY, at=0)
    times, rates = np.arange(1, 49) / 240.0, []
    for _ in times:
        plant.advance(disturbance.load(np.zeros(3)))
        rates.append(plant.x[PLANT["body_rate"]].copy())
    decays = np.exp(-times / INTEGRAL_TIME) - np.exp(-times / simulation.rate_lag)
    expected = offset * decays / (1.0 - simulation.rate_lag / INTEGRAL_TIME)
    # the offset is held over a frame of 4 ms: half a frame of 74 ms, 3 %
    np.testing.assert_allclose(np.array(rates)[:, 1], expected, atol=0.03 * offset)
    np.testing.assert_allclose(np.array(rates)[:, 0], -expected, atol=0.03 * offset)
    assert plant.x[PLANT["thrust"]][0] == pytest.approx(0.95 * MASS * GRAVITY, rel=0.002)


def test_the_altitude_loop_makes_up_for_the_thrust_that_a_hindered_rotor_lacks():
    params = QUIET.replace(simulation__rotor_loss=0.2, simulation__rotor_loss_start=2.0)
    flight = fly(Scenario("", "", 10.0, Hover(), params=params))
    thrust, time = flight.command.values[:, 3], flight.time(flight.command)
    before, after = thrust[(time > 1.0) & (time < 2.0)].mean(), thrust[time > 9.0].mean()
    assert after / before == pytest.approx(1.0 / 0.95, rel=0.002)
    height = flight.truth_state.values[:, 10]
    lost, proportional, integral = 1.3 - height.min(), *params.piloting.altitude_gains[:2]
    assert 0.01 < lost < 0.05
    # it comes back with the slow pole of the loop, near K_i / K_p = 1 / (3 s): 7 % of it are left after 8 s
    assert 1.3 - height[-1] == pytest.approx(lost * math.exp(-8.0 * integral / proportional), rel=0.5)


def test_under_a_sagging_battery_the_height_lags_by_the_formula_of_a_ramp():
    """The integral must grow by g sag a second, and it grows by K_i times the error."""
    params = QUIET.replace(simulation__battery_sag=0.005)
    height = fly(Scenario("", "", 12.0, Hover(), params=params)).truth_state.values[-1, 10]
    # the command must grow faster than linearly: by 1/(1 - 0.06)^2 = 1.13 in the end
    assert 1.3 - height == pytest.approx(1.13 * GRAVITY * 0.005 / params.piloting.altitude_gains[1], rel=0.1)


@pytest.mark.parametrize("drag", [(10.0, 10.0), (0.0, 0.01), (0.26, 0.0)])
def test_every_drag_that_is_accepted_is_one_that_the_plant_can_integrate(drag):
    flight = fly(
        Scenario("", "", 0.5, Hover(), params=PARAMS.replace(simulation__wind=(0.2, 0.0), simulation__drag=drag))
    )
    assert np.isfinite(flight.truth_state.values).all()
    with pytest.raises(ValueError, match=r"simulation\.drag must be 2 numbers from 0 to 10"):
        PARAMS.replace(simulation__drag=(1e6, 1e6))
