"""The pilot on its own: references, states from poses, ticks, the estimator's schedule, the hand-over of the length."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fiplib.estimators.windows import LEAD
from fiplib.mpc import Status
from fiplib.observers import OBSERVERS, Observer
from fiplib.params import A_DOT, GRAVITY, NANO, PHI, X_DOT, Y_DOT, A, B, Params, X, Y
from fiplib.pilot import Pilot, Tick
from fiplib.recording import Measurement
from fiplib.references import Circle, Hover

PARAMS = Params()
NO_SEAT = PARAMS.replace(piloting__seat_height=0.0)
FRAME = NANO // 240
UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])


def frame(stamp: int, position=(0.0, 0.0, 1.3), attitude=UPRIGHT, offset=(0.0, 0.0)) -> Measurement:
    position = np.array(position)
    return Measurement(stamp, position, np.asarray(attitude), position + np.array([*offset, 0.49]), UPRIGHT)


@pytest.mark.parametrize("reference", [Hover(0.2, -0.1), Circle(0.8, 9.0), Circle(0.4, 8.0, start=2.0, ramp=3.0)])
def test_the_velocity_of_a_reference_is_the_derivative_of_its_position(reference):
    times, step = np.linspace(0.01, 20, 500), 1e-5
    states = reference.at(times)
    slope = (reference.at(times + step) - reference.at(times - step)) / (2 * step)
    # central difference of a smooth path: error of order step^2 plus rounding of 1e-16 / step
    np.testing.assert_allclose(states[:, [X_DOT, Y_DOT]], slope[:, [X, Y]], atol=1e-9)
    np.testing.assert_array_equal(np.delete(states, [X, X_DOT, Y, Y_DOT], axis=1), 0)


def test_a_circle_starts_at_rest_and_comes_to_its_period():
    circle = Circle(0.8, 9.0, start=1.0, ramp=4.0)
    np.testing.assert_array_equal(circle.at(np.array([0.0, 0.9]))[:, [X, X_DOT, Y, Y_DOT]], [[0.8, 0, 0, 0]] * 2)
    late = circle.at(np.array([7.0, 16.0]))
    np.testing.assert_allclose(late[0], late[1], atol=1e-14)
    assert math.hypot(late[0, X], late[0, Y]) == pytest.approx(0.8)


def test_differentiated_velocities_settle_on_those_of_a_ramp():
    observer = Observer(NO_SEAT)
    for index in range(240):
        seconds = index / 240
        measurement = frame(index * FRAME, (0.3 * seconds, -0.2 * seconds, 1.3), offset=(0.05 * seconds, 0))
        state, (height, climb_rate, yaw) = observer.update(measurement, 1.0)
    expected = [0.3, -0.2, 0.05]
    # a whole second is 125 time constants of the 20 Hz filter: nothing is left of the start; FRAME is rounded to 1 ns
    np.testing.assert_allclose(state[[X_DOT, Y_DOT, A_DOT]], expected, rtol=1e-6)
    assert (height, yaw) == (1.3, 0) and climb_rate == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("observer", OBSERVERS)
def test_states_refer_to_the_seat_above_the_tracked_point_however_the_vehicle_is_turned(observer):
    turned = Rotation.from_euler("XYZ", [0.2, -0.3, 1.0])
    seat, rod = np.array([0.4, -0.1, 1.3]), np.array([0.43, -0.12, 1.8])
    place = seat - 0.08 * turned.as_matrix()[:, 2]
    measurement = Measurement(0, place, turned.as_quat(), rod, UPRIGHT)
    params = PARAMS.replace(piloting__observer=observer)
    state, (height, _, _) = Observer(params).update(measurement, 1.0)
    np.testing.assert_allclose([*state[[X, Y]], height], seat, atol=1e-15)
    np.testing.assert_allclose(state[[A, B]], rod[:2] - seat[:2], atol=1e-15)
    unaware, (height, _, _) = Observer(params.replace(piloting__seat_height=0.0)).update(measurement, 1.0)
    np.testing.assert_array_equal([*unaware[[X, Y]], height], place)


def test_a_frame_with_an_old_stamp_changes_no_velocity():
    observer = Observer(PARAMS)
    observer.update(frame(0), 1.0)
    before, _ = observer.update(frame(FRAME, (0.001, 0, 1.3)), 1.0)
    after, _ = observer.update(frame(FRAME, (0.002, 0, 1.3)), 1.0)
    assert after[X] == 0.002 and after[X_DOT] == before[X_DOT] != 0


def test_the_two_readings_of_the_pendulum_measurement_differ_by_the_length_in_use():
    lean = Rotation.from_rotvec([0.0, 0.1, 0.0]).as_quat()
    measurement = Measurement(0, np.zeros(3), UPRIGHT, 0.5 * np.array([math.sin(0.1), 0, math.cos(0.1)]), lean)
    by_position, _ = Observer(PARAMS).update(measurement, 1.2)
    direction = PARAMS.replace(piloting__pendulum_measurement="direction")
    by_direction, _ = Observer(direction).update(measurement, 1.2)
    assert by_position[A] == pytest.approx(0.5 * math.sin(0.1), abs=1e-15)
    assert by_direction[A] == pytest.approx(0.6 * math.sin(0.1), abs=1e-15)
    assert by_direction[B] == pytest.approx(0, abs=1e-15)
    with pytest.raises(ValueError, match="pendulum_measurement must be 'position' or 'direction', not 'guess'"):
        Observer(PARAMS.replace(piloting__pendulum_measurement="guess"))


def test_commands_come_at_the_control_rate_even_when_arrivals_jitter():
    pilot, rng = Pilot(PARAMS, Hover()), np.random.default_rng(1)
    stamps = np.arange(480) * FRAME
    arrivals = stamps + rng.integers(0, FRAME // 5, size=480)
    commands = [pilot.step(int(now), frame(int(stamp))) for now, stamp in zip(arrivals, stamps, strict=True)]
    assert [command is not None for command in commands] == [True, False] * 240


def test_at_rest_the_pilot_commands_no_rate_and_the_weight():
    command = Pilot(NO_SEAT, Hover()).step(0, frame(0))
    weight = (PARAMS.vehicle.mass + PARAMS.pendulum.mass) * GRAVITY / PARAMS.vehicle.max_thrust
    np.testing.assert_allclose(command.body_rate, 0, atol=1e-12)
    assert command.thrust == pytest.approx(weight, rel=1e-7)  # single precision


def test_a_tilted_vehicle_gets_the_thrust_that_still_carries_it_and_is_turned_back():
    tilted = Rotation.from_euler("XYZ", [0.2, 0.0, 0.3]).as_quat()
    level = Pilot(NO_SEAT, Hover()).step(0, frame(0))
    command = Pilot(NO_SEAT, Hover()).step(0, frame(0, attitude=tilted))
    assert command.state[PHI] == pytest.approx(0.2)
    assert command.thrust * math.cos(0.2) == pytest.approx(level.thrust, rel=1e-6)
    assert command.body_rate[2] == pytest.approx(-0.3 * PARAMS.piloting.yaw_gains[0], rel=1e-6)


def test_low_flight_is_answered_with_more_thrust_within_bounds():
    pilot = Pilot(PARAMS, Hover())
    low, far = pilot.step(0, frame(0, (0, 0, 1.2))), Pilot(PARAMS, Hover(height=50.0)).step(0, frame(0))
    assert Pilot(PARAMS, Hover()).step(0, frame(0)).thrust < low.thrust < far.thrust == 1.0


def flown(params: Params, seconds: float) -> list[tuple[float, object]]:
    """(time, window) of every run that falls due on a hover of that length."""
    pilot, found, rng = Pilot(params.replace(piloting__estimate=True), Hover()), [], np.random.default_rng(1)
    for index in range(round(240 * seconds)):
        pilot.step(index * FRAME, frame(index * FRAME, offset=1e-4 * rng.normal(size=2)))
        if window := pilot.window_due():
            found.append((index / 240, window))
    return found


@pytest.mark.parametrize("run_period", [0.2, 5.0])
def test_the_estimator_runs_by_either_reading_of_its_rate_once_the_window_is_full(run_period):
    found = flown(PARAMS.replace(estimation__run_period=run_period), 11.0)
    times = np.array([time for time, _ in found])
    assert times[0] == pytest.approx(54 * 0.1, abs=1 / 240)  # 55 samples, 0.1 s apart
    np.testing.assert_allclose(np.diff(times), run_period, atol=1 / 240)
    for _, window in found:
        assert window.states.shape == (55, 10) and window.inputs.shape == (55, 2) and window.step == 0.1


def test_a_window_at_the_control_rate_lasts_half_a_second():
    found = flown(PARAMS.replace(estimation__sample_period=1 / 120), 1.0)
    assert found[0][0] == pytest.approx(54 / 120, abs=1e-9) and found[0][1].step == pytest.approx(1 / 120)


def test_no_window_falls_due_when_nothing_is_to_be_estimated():
    pilot = Pilot(PARAMS, Hover())
    for index in range(240 * 6):
        pilot.step(index * FRAME, frame(index * FRAME))
        assert pilot.window_due() is None


def test_the_inputs_of_a_window_move_the_tilt_as_the_applied_ones_did():
    """Mean rates over a sample: their sum over the window is that of all applied rates."""
    pilot = Pilot(PARAMS.replace(piloting__estimate=True), Hover())
    rng, applied, window = np.random.default_rng(2), [], None
    for index in range(round(240 * 5.5)):
        offset = 0.01 * rng.normal(size=2)
        command = pilot.step(index * FRAME, frame(index * FRAME, offset=offset))
        window = pilot.window_due()
        if window is not None:
            break
        if command is not None:
            applied.append(command.body_rate[:2])
    np.testing.assert_allclose(window.inputs[:-1].sum(0), np.sum(applied, axis=0) / 12, rtol=1e-12)


def test_a_new_length_is_taken_over_at_once_or_in_limited_steps():
    at_once = Pilot(PARAMS.replace(estimation__median_length=1), Hover())
    assert at_once.receive_estimate(1.7) == at_once.length == 1.7
    careful = Pilot(PARAMS.replace(estimation__median_length=1, piloting__length_step=0.1), Hover())
    assert [careful.receive_estimate(length) for length in (1.25, 1.25, 1.25, 0.2)] == pytest.approx(
        [1.1, 1.2, 1.25, 1.15]
    )


def test_outliers_absurd_and_non_finite_estimates_do_not_reach_the_controller():
    pilot = Pilot(PARAMS.replace(estimation__median_length=3), Hover())
    used = [pilot.receive_estimate(length) for length in (1.1, 1.2, 1.15, 1.9, math.nan, math.inf, 1.18)]
    assert used == pytest.approx([1.1, 1.15, 1.15, 1.2, 1.2, 1.2, 1.18])
    bounded = Pilot(PARAMS.replace(estimation__median_length=1), Hover())
    assert bounded.receive_estimate(50.0) == PARAMS.estimation.length_max
    assert bounded.receive_estimate(-1.0) == PARAMS.estimation.length_min


RAW = PARAMS.replace(estimation__estimator="poses")


def test_an_estimator_of_raw_data_is_given_full_windows_at_control_ticks():
    found = flown(RAW, 4.0)
    times = np.array([time for time, _ in found])
    # the first command is given at 0, so frames count from 0.1 s on, and 2.5 s later the window is full
    assert times[0] == pytest.approx(LEAD + RAW.estimation.raw_window, abs=2 / 240)
    np.testing.assert_allclose(np.diff(times), RAW.estimation.run_period, atol=1e-9)
    np.testing.assert_allclose(times * 120, np.round(times * 120), atol=1e-9)
    for _, window in found:
        assert [len(body.stamp) for body in window] == pytest.approx([2.5 * 240] * 2, abs=2)


def test_with_the_trusted_hand_over_raw_windows_come_early_and_grow():
    found = flown(RAW.replace(piloting__handover="trusted"), 4.0)
    times = np.array([time for time, _ in found])
    spans = np.array([window.seconds for _, window in found])
    assert times[0] == pytest.approx(LEAD + RAW.estimation.first_raw_window, abs=2 / 240)
    np.testing.assert_allclose(np.diff(times), RAW.estimation.run_period, atol=1e-9)
    np.testing.assert_allclose(spans, np.minimum(times - LEAD, 2.5), atol=2 / 240)


def test_a_pose_of_the_rod_that_comes_twice_counts_once():
    pilot = Pilot(RAW.replace(piloting__estimate=True, piloting__handover="trusted"), Hover())
    rng, offset, window = np.random.default_rng(1), np.zeros(2), None
    for index in range(200):
        if index % 3:  # every third frame repeats the pose before
            offset = 1e-4 * rng.normal(size=2)
        one, other = (
            frame(index * FRAME, 0.001 * rng.normal(size=3) + [0.0, 0.0, 1.3]),
            frame(index * FRAME, offset=offset),
        )
        pilot.step(index * FRAME, one._replace(pendulum_position=other.pendulum_position))
        window = pilot.window_due() or window
    assert len(window.rod.stamp) == pytest.approx(len(window.vehicle.stamp) * 2 / 3, abs=1)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"piloting__handover": "hope"}, "piloting.handover must be one of printed, trusted, not 'hope'"),
        ({"estimation__estimator": "guess"}, "estimation.estimator must be one of ga, .*not 'guess'"),
    ],
)
def test_an_unknown_policy_or_estimator_is_refused_with_those_there_are(changes, message):
    with pytest.raises(ValueError, match=message):
        Pilot(PARAMS.replace(**changes), Hover())


def test_the_trusted_hand_over_starts_short_and_takes_the_deviation_into_account():
    trusted = PARAMS.replace(piloting__handover="trusted", piloting__initial_length=1.4)
    sure, unsure = Pilot(trusted, Hover()), Pilot(trusted, Hover())
    assert sure.length == trusted.piloting.rod_lengths[0]
    for _ in range(5):
        assert sure.receive_estimate(1.3, 0.01) == sure.length
        unsure.receive_estimate(1.3, 0.4)
    assert unsure.length < 0.9 * sure.length < 1.3


# --- what is given that is not what is asked for

POSES = Measurement(
    0,
    np.array((0.0, 0.0, 1.3)),
    np.array((0.0, 0.0, 0.0, 1.0)),
    np.array((0.0, 0.0, 1.88)),
    np.array((0.0, 0.0, 0.0, 1.0)),
)


def tick() -> Tick:
    return Pilot(Params(), Hover()).observe(0, POSES)


MISUSES = {
    "no parameters": lambda pilot: Pilot(None, Hover()),
    "no reference": lambda pilot: Pilot(Params(), None),
    "a reference without height": lambda pilot: Pilot(Params(), SimpleNamespace(at=Hover().at)),
    "a reference of nan": lambda pilot: Pilot(Params(), Hover(x=math.nan)),
    "a reference of two states": lambda pilot: Pilot(
        Params(), SimpleNamespace(at=lambda t: np.zeros((1, 2)), height=1.0)
    ),
    "no time": lambda pilot: pilot.step(None, POSES),
    "a time of nan": lambda pilot: pilot.step(math.nan, POSES),
    "a time in s": lambda pilot: pilot.step(1.5, POSES),
    "a time before 1970": lambda pilot: pilot.step(-1, POSES),
    "no frame": lambda pilot: pilot.step(0, None),
    "a frame of numbers": lambda pilot: pilot.step(0, (0, 1, 2, 3, 4)),
    "a frame without a stamp": lambda pilot: pilot.step(0, POSES._replace(stamp=None)),
    "a stamp of nan": lambda pilot: pilot.step(0, POSES._replace(stamp=math.nan)),
    "a position in the plane": lambda pilot: pilot.step(0, POSES._replace(vehicle_position=np.zeros(2))),
    "position and attitude mixed up": lambda pilot: pilot.step(
        0, Measurement(0, POSES[2], POSES[1], POSES[3], POSES[4])
    ),
    "no attitude": lambda pilot: pilot.step(0, POSES._replace(pendulum_attitude=None)),
    "an attitude of nan": lambda pilot: pilot.step(0, POSES._replace(pendulum_attitude=np.full(4, math.nan))),
    "words": lambda pilot: pilot.step(0, POSES._replace(vehicle_position="lost")),
    "no tick to solve": lambda pilot: pilot.solve(None),
    "no tick to answer": lambda pilot: pilot.answer(None, np.zeros(2), Status.OPTIMAL),
    "three rates": lambda pilot: pilot.answer(tick(), np.zeros(3), Status.OPTIMAL),
    "no rates": lambda pilot: pilot.answer(tick(), None, Status.OPTIMAL),
    "no tick to hold": lambda pilot: pilot.hold(None, np.zeros(10)),
    "no place to hold": lambda pilot: pilot.hold(tick(), None),
    "no length": lambda pilot: pilot.receive_estimate(None),
    "a length in words": lambda pilot: pilot.receive_estimate("long"),
    "two lengths": lambda pilot: pilot.receive_estimate(np.zeros(2)),
}


@pytest.mark.parametrize("name", MISUSES)
def test_a_misuse_is_one_value_error_in_words_and_changes_nothing(name):
    pilot = Pilot(Params(), Hover())
    with pytest.raises(ValueError) as caught:
        MISUSES[name](pilot)
    assert str(caught.value) and caught.type is ValueError
    fresh = Pilot(Params(), Hover())
    command, expected = (one.step(NANO // 60, POSES._replace(stamp=NANO // 60)) for one in (pilot, fresh))
    np.testing.assert_array_equal(command.body_rate, expected.body_rate)


def test_a_controller_that_answers_no_number_is_named_and_not_the_frame_after_it():
    pilot = Pilot(PARAMS, Hover())
    solve = pilot.solve
    pilot.solve = lambda tick: replace(solve(tick), input=np.array([np.nan, 0.0]))
    with pytest.raises(ValueError, match=r"the controller answered .*nan.*finite"):
        pilot.step(0, frame(0))
