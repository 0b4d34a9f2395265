"""The two observers of the pilot: what they see of a moving vehicle and rod, and what upsets them."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.linalg import expm, solve_discrete_are
from scipy.spatial.transform import Rotation

from fiplib import observers, replay
from fiplib.controllers import margins
from fiplib.kernels import observing
from fiplib.observers import OBSERVERS, Observer
from fiplib.params import A_DOT, AXES, B_DOT, GRAVITY, NANO, STATE_NAMES, THETA, X_DOT, Y_DOT, A, B, Params, X, Y
from fiplib.pilot import Pilot
from fiplib.recording import Measurement
from fiplib.references import Hover
from fiplib.simulate import Push, Scenario, SimulatedVehicle, fly

KALMAN = Params().replace(piloting__observer="kalman")
FRAME = NANO // 240
HANGING = Scenario("", "", 2.0, Hover(0.3, -0.2), pushes=(Push(1.0, (0.004, 0.002)),), params=KALMAN)
VELOCITIES = [X_DOT, Y_DOT, A_DOT, B_DOT]


def frames(scenario: Scenario = HANGING) -> tuple[list[Measurement], np.ndarray]:
    """The frames of a flight and its true states, (n, 10)."""
    flight = fly(scenario)
    vehicle, pendulum = flight.vehicle, flight.pendulum
    columns = (vehicle.stamp, vehicle.position, vehicle.orientation, pendulum.position, pendulum.orientation)
    return [Measurement(int(row[0]), *row[1:]) for row in zip(*columns, strict=True)], flight.truth_state.values[:, :10]


def seen(measurements: list[Measurement], params: Params = KALMAN, length: float = 1.0) -> np.ndarray:
    observer = Observer(params)
    return np.array([observer.update(measurement, length)[0] for measurement in measurements])


def constants(params: Params = KALMAN) -> np.ndarray:
    return Observer(params).constants


@pytest.mark.parametrize("length", [0.2, 1.0, 2.0])
@pytest.mark.parametrize("step", [1 / 1000, 1 / 240, observing.LONGEST_STEP])
def test_the_step_of_the_filter_is_the_exact_one_of_its_model(length, step):
    transition, noise = np.empty((2, 6, 6))
    about = constants()
    observing.model(length, step, about, transition, noise)
    a, forces = np.zeros((6, 6)), np.zeros((6, 3))
    a[[0, 1, 2, 4], [1, 2, 3, 5]] = 1.0
    a[3, 3], a[5, 4] = -1 / observing.RATE_LAG, 2 * GRAVITY / length
    a[5, 2] = -1.0 - 2 * about[observing.SEAT] / length  # of both, 2 g / l times h / g
    np.testing.assert_allclose(transition, expm(a * step), rtol=1e-8, atol=1e-12)
    densities = about[observing.FORCE], about[observing.THRUST] / observing.RATE_LAG**2, about[observing.FORCE]
    forces[[1, 3, 5], [0, 1, 2]] = np.sqrt(densities)
    # van Loan's integral of the noise
    block = expm(np.block([[-a, forces @ forces.T], [np.zeros((6, 6)), a.T]]) * step)
    exact = block[6:, 6:].T @ block[:6, 6:]
    # the largest relative difference is that of an impulse in the middle, (step / lag)^2 / 6 of the fastest state
    np.testing.assert_allclose(
        np.diag(noise)[[1, 3, 5]], np.diag(exact)[[1, 3, 5]], rtol=1.01 * (step / observing.RATE_LAG) ** 2 / 6
    )
    measured = np.zeros((3, 6))
    measured[0, 0] = measured[1, 2] = measured[2, 0] = measured[2, 4] = 1.0
    variances = np.diag(np.square([0.2e-3, GRAVITY * 1e-3, 0.2e-3]))
    settled = [solve_discrete_are(transition.T, measured.T, each, variances) for each in (noise, exact)]
    # what that makes of the deviations of the states: 1 % at 240 Hz, 4 % at the longest step
    np.testing.assert_allclose(*(np.sqrt(np.diag(each)) for each in settled), rtol=0.05)


def test_the_covariance_settles_where_the_library_says():
    observer, vehicle = Observer(KALMAN), SimulatedVehicle(HANGING)
    for index in range(480):
        observer.update(vehicle.measure(index * FRAME), 0.7)
    settled = observers.module(KALMAN).linear(KALMAN, 0.7)
    x = np.zeros((2, 6))
    x[0, :] = 1e-3 * np.array([1.0, -2.0, 3.0, 30.0, 4.0, 5.0])
    observer.memory[3:15] = x.ravel()
    measurement = Measurement(480 * FRAME, np.zeros(3), np.array([0, 0, 0, 1.0]), np.array([0, 0, 0.35]), np.zeros(4))
    state, _ = observer.update(measurement, 0.7)
    expected = settled.c @ (settled.a @ x[0])
    # frames of 1/240 s rounded to 1 ns; the arc tangent of 3e-4 rad
    np.testing.assert_allclose(state[list(AXES[0].states)], expected, rtol=1e-5)


@pytest.mark.parametrize("name", OBSERVERS)
def test_the_linear_observer_is_the_compiled_one(name):
    params = Params().replace(piloting__observer=name)
    linear, observer = observers.module(params).linear(params, 1.0), Observer(params)
    rng = np.random.default_rng(5)
    given = np.cumsum(1e-5 * rng.normal(size=(700, 3)), axis=0)
    given[:300] = 0.0
    z, followed, states = np.zeros(len(linear.a)), [], []
    for index, (place, offset, tilt) in enumerate(given):
        q = Rotation.from_euler("y", tilt).as_quat()
        rod = np.array([place + offset, 0, 0.5])
        states.append(observer.update(Measurement(index * FRAME, np.array([place, 0, 0]), q, rod, q), 1.0)[0])
        measured = place, place + offset, tilt
        z = linear.a @ z + linear.b @ measured
        followed.append(linear.c @ z + linear.d @ measured)
    states, followed = np.array(states)[:, list(AXES[0].states)], np.array(followed)
    # after 300 frames at rest the covariance is steady to 1e-4; angles are of 1e-4 rad, and their tangents too
    assert (np.abs(states - followed).max(axis=0) < 1e-3 * np.abs(followed).max(axis=0)).all()


def test_velocities_are_less_noisy_than_differentiated_ones():
    measurements, truth = frames()
    calm, usual = (seen(measurements, params) - truth for params in (KALMAN, Params()))
    rms = np.sqrt(np.mean(calm[48:, VELOCITIES] ** 2, axis=0) / np.mean(usual[48:, VELOCITIES] ** 2, axis=0))
    assert (rms < 0.5).all(), dict(zip(np.array(STATE_NAMES)[VELOCITIES], rms, strict=True))
    # the push is among them: its force is more than the filter expects
    assert np.abs(calm[48:, [X, Y, A, B]]).max() < 1.5e-3


def test_frames_may_be_lost_late_and_irregular():
    measurements, truth = frames()
    rng = np.random.default_rng(2)
    kept = rng.random(len(measurements)) > 0.3
    kept[300:312] = False
    some = [measurement for measurement, keep in zip(measurements, kept, strict=True) if keep]
    error = (seen(some) - truth[kept])[60:]
    whole = (seen(measurements) - truth)[60:]
    for states, factor in ((VELOCITIES, 2.0), ([X, Y, A, B], 2.0)):
        assert np.sqrt((error[:, states] ** 2).mean()) < factor * np.sqrt((whole[:, states] ** 2).mean())


def test_an_old_stamp_changes_nothing_and_a_long_gap_begins_anew():
    measurements, _ = frames()
    observer = Observer(KALMAN)
    for measurement in measurements[:200]:
        state, _ = observer.update(measurement, 1.0)
    again, _ = observer.update(measurements[199]._replace(vehicle_position=np.array([0.5, 0.0, 1.3])), 1.0)
    np.testing.assert_array_equal(again, state)
    late = measurements[200]._replace(stamp=measurements[199].stamp + 30 * NANO)
    fresh, _ = Observer(KALMAN).update(late, 1.0)
    np.testing.assert_array_equal(observer.update(late, 1.0)[0], fresh)
    # of the first frame both observers make the same, without velocities
    np.testing.assert_allclose(fresh, seen([late], Params())[0], atol=1e-12)


def test_a_gap_of_half_a_second_is_bridged_without_a_jump_to_infinity():
    measurements, truth = frames()
    states = seen(measurements[:200] + measurements[320:])
    assert np.isfinite(states).all()
    error = np.abs(states[-100:] - truth[-100:])
    assert error[:, [X, Y, A, B]].max() < 2e-3 and error[:, VELOCITIES].max() < 0.05


def test_velocities_are_there_a_tenth_of_a_second_after_the_start():
    observer = Observer(KALMAN)
    for index in range(24):
        t = index / 240
        position = np.array([0.4 * t, -0.3 * t, 1.3])
        rod = position + np.array([0.02 * t, 0, 0.5])
        level = np.array([0, 0, 0, 1.0])
        state, _ = observer.update(Measurement(index * FRAME, position, level, rod, level), 1.0)
    np.testing.assert_allclose(state[[X_DOT, Y_DOT, A_DOT]], [0.4, -0.3, 0.02], atol=0.01)


def test_the_tilt_comes_out_as_euler_angles_at_large_angles_too():
    q = Rotation.from_euler("XYZ", [0.3, -0.25, 0.4]).as_quat()
    state, (_, _, yaw) = Observer(KALMAN).update(Measurement(0, np.zeros(3), q, np.array([0, 0, 0.5]), q), 1.0)
    np.testing.assert_allclose(state[[THETA - 1, THETA]], [0.3, -0.25], atol=1e-12)
    assert yaw == pytest.approx(0.4)


def test_a_new_length_is_used_from_the_next_frame_on():
    measurements, _ = frames()
    observer = Observer(KALMAN)
    for measurement in measurements[:-1]:
        observer.update(measurement, 1.0)
    x = observer.memory[3:15].reshape(2, 6).copy()
    p = observer.memory[15:].copy()
    observer.update(measurements[-1], 0.5)
    other = Observer(KALMAN)
    other.memory[:] = np.concatenate([[1.0, 1.3, 0.0], x.ravel(), p])
    other.update(measurements[-2], 2.0)  # starts its clock: elapsed is 0, so nothing moves
    other.update(measurements[-1], 0.5)
    np.testing.assert_array_equal(observer.memory[3:], other.memory[3:])


def test_the_kalman_observer_takes_the_rods_direction():
    direction = KALMAN.replace(piloting__pendulum_measurement="direction")
    measurements, truth = frames(dataclasses.replace(HANGING, params=direction))
    error = seen(measurements, direction) - truth
    # the direction's noise of 1 mrad is half a millimetre at the COM
    assert np.abs(error[48:, [A, B]]).max() < 2e-3


def test_hover_needs_a_third_of_the_rate_commands():
    rates = []
    for params in (Params(), KALMAN):
        flight = fly(Scenario("", "", 6.0, Hover(), params=params))
        late = flight.command.values[flight.time(flight.command) > 3.0, :2]
        rates.append(math.degrees(np.sqrt(np.mean(late**2))))
    assert rates[0] > 15.0 and rates[1] < rates[0] / 3


@pytest.mark.parametrize("measurement", ["position", "direction"])
def test_a_flight_is_replayed_to_the_bit(measurement):
    params = KALMAN.replace(piloting__pendulum_measurement=measurement, estimation__median_length=1)
    flight = fly(Scenario("", "", 2.0, Hover(), told_lengths=((0.7, 0.8), (1.2, 1.1)), params=params))
    assert set(np.unique(flight.length.values[:, 0])) == {0.8, 1.0, 1.1}
    np.testing.assert_array_equal(replay.commands(flight).values, flight.command.values)
    np.testing.assert_array_equal(replay.commands(flight).stamp, flight.command.stamp)


def test_states_derived_from_a_recording_are_those_that_were_flown():
    flight = fly(dataclasses.replace(HANGING, duration=1.0))
    derived = replay.states(dataclasses.replace(flight, state=None))
    flown = np.searchsorted(derived.stamp, flight.state.stamp)
    np.testing.assert_array_equal(derived.values[flown], flight.state.values)


def test_margins_know_both_observers():
    usual, calm = (margins.closed_loop(1.0, params) for params in (Params(), KALMAN))
    assert calm.margins.delay > 0.0 and calm.margins != usual.margins
    with pytest.raises(ValueError, match="observer must be one of differentiate, kalman, not 'eye'"):
        margins.closed_loop(1.0, KALMAN.replace(piloting__observer="eye"))


def test_an_unknown_observer_is_refused_with_those_there_are():
    with pytest.raises(ValueError, match="observer must be one of differentiate, kalman, not 'guess'"):
        Pilot(Params().replace(piloting__observer="guess"), Hover())
