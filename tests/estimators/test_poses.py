"""The pose filter: recovery of a known rod, refusals that name the cause, and the recursion itself.

Deviations are judged in the estimate's own standard deviations. A test of one window allows 3.5 of them, which chance
exceeds once in 2000 windows; the flights are seeded, so a test that passes once passes always.
"""

import functools
import math
import os
import re
import time
from pathlib import Path

import numpy as np
import pytest
from scipy import signal
from scipy.spatial.transform import Rotation

from fiplib.estimators.poses import filter as kf
from fiplib.estimators.poses.checks import jumps
from fiplib.estimators.poses.estimate import estimate
from fiplib.estimators.poses.fit import FORCE_FREE, STEP
from fiplib.estimators.poses.history import history
from fiplib.estimators.poses.knowledge import Knowledge, Told
from fiplib.estimators.poses.planar import COLUMNS, planar, read_encoders
from fiplib.estimators.poses.rows import Body, rows_of, upright_axis
from fiplib.estimators.poses.stream import Stream
from fiplib.params import FipError
from fiplib.simulate import Push
from fiplib.studies.poses import Condition, flown, interval, observed
from fiplib.teaching.cart import simulated_cart

CHANCE = 3.5
AT_MIDDLE = Knowledge(marker_offset=Told(0.0, 1e-3))


@functools.cache
def states(seat=0.08, seed=1, duration=9.0, length=1.0, gyration_ratio=1 / 12, pushes=()):
    """True states (n, 20) at 240 Hz of a flight on a circle of 0.4 m."""
    changes = {"pendulum__gyration_ratio": gyration_ratio}
    return flown(Condition(length=length, seat=seat, changes=changes), seed, duration, pushes).states


def poses(x, seed=0, length=1.0, below=0.08, above=0.0, position=0.2e-3, attitude=1e-3, start=3.0, seconds=2.5):
    """Vehicle and rod as motion capture sees them in a stretch of flight; their clock is the flight's."""
    x = x[round(240 * start) : round(240 * (start + seconds))]
    bodies = observed(x, np.random.default_rng(seed), length, below, above, (position, attitude))
    return tuple(body._replace(time=body.time + start) for body in bodies)


def at(body, keep):
    return Body(*(None if column is None else column[keep] for column in body))


def check(value, truth, chance=CHANCE):
    assert abs(value.value - truth) < chance * value.deviation, (value, truth)


def check_length(answer, truth, chance=CHANCE):
    assert answer.reason is None, answer.reason
    assert abs(answer.length - truth) < chance * answer.standard_deviation, answer


def rows_and_point(seconds=2.5):
    """Rows of a window and a point near their maximum."""
    rows = rows_of(*poses(states(), seconds=seconds))
    theta = np.zeros(16)
    theta[[kf.LE, kf.R, kf.H, kf.HC, kf.MU]] = math.log(0.64), 0.5, 0.08, 0.08, 0.053
    theta[[kf.Q, kf.OMEGA, kf.ZETA, kf.ZERO]] = np.log([0.05, 66.0, 0.4, 1.0])
    theta[[kf.NV, kf.NT, kf.NR, kf.ND, kf.NF]] = np.log([0.2e-3, 1e-3, 0.2e-3, 1e-3, FORCE_FREE])
    return rows, theta


def test_the_score_is_the_gradient_of_the_likelihood():
    rows, theta = rows_and_point(1.0)
    free = np.array([kf.LE, kf.R, kf.H, kf.HC, kf.Q, kf.OMEGA, kf.ZETA, kf.ZERO, kf.NV, kf.LEVER])
    lanes = np.tile(theta, (len(free) + 1, 1))
    lanes[1 + np.arange(len(free)), free] += STEP
    score = kf.run(rows, lanes, np.full(len(free), STEP)).score
    shifts = 1e-4 * np.eye(len(theta))[free]
    ahead, behind = kf.run(rows, theta + shifts).total, kf.run(rows, theta - shifts).total
    # forward differences of 1e-5 inside, central ones of 1e-4 here: both right to about 1e-4 of the curvature
    np.testing.assert_allclose(score, (ahead - behind) / 2e-4, rtol=2e-2, atol=2.0)


def test_a_prediction_in_two_parts_is_the_prediction_in_one():
    rows, theta = rows_and_point(0.5)
    # rows that say nothing, between the frames, cut every step in two
    idle = rows.time[:-1] + np.diff(rows.time) * 0.3
    mixed = np.concatenate([rows.time, idle])
    order = np.argsort(mixed, kind="stable")
    doubled = kf.Rows(*(np.concatenate([column, column[:-1]])[order] for column in rows))
    scale = np.concatenate([rows.scale, np.full(len(idle), 1e9)])[order]
    doubled = doubled._replace(time=mixed[order], scale=scale)
    whole = kf.run(rows, theta[None], innovations=True).deviation
    parts = kf.run(doubled, theta[None], innovations=True).deviation[scale < 1e8]
    # the quadrature of the process noise and the held second-order terms: 1e-5 of a deviation
    np.testing.assert_allclose(parts, whole, rtol=1e-4)


def test_the_same_likelihood_whatever_runs_beside_it():
    rows, theta = rows_and_point(1.0)
    alone = kf.run(rows, theta[None]).total[0]
    beside = kf.run(rows, np.tile(theta, (16, 1))).total
    assert np.all(beside == alone)  # one lane or sixteen: the same operations in the same order


def test_a_pass_goes_on_where_it_stopped():
    rows, theta = rows_and_point(1.0)
    whole = kf.run(rows, theta[None]).total[0]
    state = kf.State.at(rows.time[0], 2)
    parts = [kf.Rows(*(column[half] for column in rows)) for half in (slice(0, 501), slice(501, None))]
    assert sum(kf.run(part, theta[None], state=state).total[0] for part in parts) == pytest.approx(whole, rel=1e-12)


def test_without_noise_the_model_is_the_exact_plant():
    for seat in (0.0, 0.08):
        window = poses(states(seat), below=seat, position=1e-5, attitude=1e-4)
        answer = estimate(*window, Knowledge(noise=(1e-5, 1e-4)))
        # what is left of smoothing and of second order: 0.5 mm, a tenth of the deviation with real noise
        check_length(answer, 1.0)
        assert answer.length == pytest.approx(1.0, abs=1.5e-3)
        assert answer.seat_height.value == pytest.approx(seat, abs=5e-4)


@pytest.mark.parametrize("seat", [0.0, 0.03, 0.08, 0.12])
def test_length_inertia_and_seat_come_out_together(seat):
    answer = estimate(*poses(states(seat), below=seat), AT_MIDDLE)
    check_length(answer, 1.0)
    check(answer.seat_height, seat)
    check(answer.com_height, seat)
    check(answer.inertia_factor, 0.75)
    check(answer.uniform_length, 1.0)
    assert abs(answer.distance.deviation) < CHANCE
    # 4.9 mm in the study of 160 windows; a window can be a little better or worse
    assert 0.003 < answer.standard_deviation < 0.008
    assert answer.interval[0] < answer.length < answer.interval[1]


def test_what_was_not_stated_widens_the_interval():
    window = poses(states())
    told, untold = estimate(*window, AT_MIDDLE), estimate(*window)
    assert untold.length == told.length
    # two lengths, of which only one holds if either assumption fails: their difference has a deviation of 9 to 13 mm
    assert 1.6 < untold.standard_deviation / told.standard_deviation < 6.0
    assert "neither was stated" in untold.assumed[-1] and "stated" not in " ".join(told.assumed)


@pytest.mark.parametrize("above", [-0.03, -0.01, 0.01, 0.02])
def test_a_marker_slightly_off_the_middle_is_covered_or_refused(above):
    for start in (2.5, 5.5):
        answer = estimate(*poses(states(), above=above, seed=round(start), start=start))
        if answer.reason is None:
            check_length(answer, 1.0, chance=2.5)
        else:
            assert "not at its middle" in answer.reason


def test_stamps_that_are_all_zero_are_named():
    vehicle, rod = (body._replace(time=np.zeros(len(body.time))) for body in poses(states()))
    assert "repeat the stamp" in estimate(vehicle, rod).reason


def test_the_vehicle_may_be_tracked_at_its_seat():
    answer = estimate(*poses(states(), below=0.0))
    check_length(answer, 1.0)
    check(answer.seat_height, 0.0)
    check(answer.com_height, 0.08)


def test_positions_of_the_rod_are_enough():
    vehicle, rod = poses(states())
    check_length(estimate(vehicle, rod._replace(axis=None)), 1.0)


def test_the_rod_direction_alone_gives_the_length_of_a_uniform_rod():
    vehicle, rod = poses(states(duration=16.0), seconds=12.5)
    answer = estimate(vehicle, rod._replace(position=None))
    check_length(answer, 1.0)
    assert any("uniform" in sentence for sentence in answer.assumed)


@pytest.mark.parametrize("length", [0.5, 0.7, 1.5])
def test_other_rods(length):
    check_length(estimate(*poses(states(length=length), length=length)), length)


@pytest.mark.parametrize("gyration_ratio", [0.0, 1 / 18, 1 / 9])
def test_a_rod_that_is_not_uniform(gyration_ratio):
    window = poses(states(gyration_ratio=gyration_ratio))
    factor = 0.25 / (0.25 + gyration_ratio)
    told = estimate(*window, AT_MIDDLE)
    check_length(told, 1.0)
    check(told.inertia_factor, factor)
    untold = estimate(*window)
    # the poses cannot tell a rod that is not uniform from one that is tracked off its middle
    assert "not at its middle" in untold.reason or abs(untold.length - 1.0) < CHANCE * untold.standard_deviation


@pytest.mark.parametrize("above", [-0.3, -0.1, 0.1, 0.3])
def test_a_rod_tracked_off_its_middle(above):
    window = poses(states(), above=above)
    check_length(estimate(*window, Knowledge(inertia_factor=Told(0.75, 0.003))), 1.0)
    untold = estimate(*window)
    if untold.reason is None:
        check_length(untold, 1.0)
    else:
        assert "not at its middle" in untold.reason
        check(untold.rod_point, 0.5 + above)
        check(untold.uniform_length, 1.0)


def test_a_wrong_told_value_is_contradicted_by_name():
    window = poses(states())
    seat = estimate(*window, Knowledge(seat_height=Told(0.0, 2e-3)))
    assert "contradicts the seat height" in seat.reason
    inertia = Knowledge(inertia_factor=Told(1.0, 5e-3), marker_offset=Told(0.0, 1e-3))
    assert "contradicts" in estimate(*window, inertia).reason
    assert math.isnan(seat.length)


def test_a_right_told_value_narrows_the_interval():
    window = poses(states())
    told = Knowledge(seat_height=Told(0.08, 1e-3), inertia_factor=Told(0.75, 2e-3), marker_offset=Told(0.0, 1e-3))
    answer = estimate(*window, told)
    check_length(answer, 1.0)
    assert answer.standard_deviation < 0.7 * estimate(*window, AT_MIDDLE).standard_deviation


def test_noise_that_was_not_told_is_found():
    answer = estimate(*poses(states(), position=0.4e-3, attitude=2e-3))
    check_length(answer, 1.0)
    # 1200 numbers of each kind give a deviation to 2 %
    assert answer.noise["vehicle"] == pytest.approx(0.4e-3, rel=0.1)
    assert answer.noise["tilt"] == pytest.approx(2e-3, rel=0.1)


def test_the_order_of_arrival_does_not_matter():
    vehicle, rod = poses(states())
    shuffle = np.random.default_rng(1).permutation(len(rod.time))
    answer, again = estimate(vehicle, rod), estimate(vehicle, at(rod, shuffle))
    assert again.length == answer.length
    assert again.standard_deviation == answer.standard_deviation
    assert any("out of order" in note for note in again.notes)


def test_rates_stamps_losses_and_gaps():
    vehicle, rod = poses(states())
    rng, n = np.random.default_rng(2), len(rod.time)
    late = np.sort(rod.time + rng.exponential(0.3e-3, n))
    lost = (np.arange(n) > 250) & (np.arange(n) < 370)
    nan = rod._replace(position=np.where(lost[:, None], np.nan, rod.position))
    zero = rod._replace(position=np.where(lost[:, None], 0.0, rod.position))
    cases = {
        "half the rate": (vehicle, at(rod, slice(None, None, 2))),
        "losses": (vehicle, at(rod, rng.random(n) > 0.3)),
        "own stamps": (vehicle, rod._replace(time=rod.time + 50e-6)),
        "jitter": (vehicle, rod._replace(time=late)),
        "80 Hz": (at(vehicle, slice(None, None, 3)), at(rod, slice(1, None, 3))),
        "nan": (vehicle, nan),
        "zero": (vehicle, zero),
        "twice": (vehicle, at(rod, np.repeat(np.arange(n), 2))),
        "clock": (vehicle._replace(time=vehicle.time + 1e6), rod._replace(time=rod.time + 1e6)),
    }
    for name, (first, second) in cases.items():
        answer = estimate(first, second)
        assert answer.reason is None, (name, answer.reason)
        assert abs(answer.length - 1.0) < CHANCE * answer.standard_deviation, (name, answer)
        if name in ("nan", "zero", "twice"):
            assert any("left out" in note for note in answer.notes), name


def test_a_tracked_point_far_from_the_markers_shares_their_error():
    vehicle, rod = poses(states(0.0), below=0.0)
    frame = vehicle._replace(position=vehicle.position - 0.08 * vehicle.axis)
    answer = estimate(frame, rod)
    check_length(answer, 1.0)
    check(answer.seat_height, 0.08)
    check(answer.com_height, 0.0)


def test_offsets_of_markers_and_body_frame_do_no_harm():
    vehicle, rod = poses(states())
    tilted = vehicle.axis + np.array([0.02, -0.01, 0.0])
    moved = rod._replace(position=rod.position + np.array([0.002, 0.001, 0.0]))
    check_length(estimate(vehicle._replace(axis=tilted / np.linalg.norm(tilted, axis=1)[:, None]), moved), 1.0)


def turned_axis(axis):
    return Rotation.from_rotvec([math.radians(20.0), 0.0, 0.0]).apply(axis)


def averaged(position):
    """Positions as software for motion capture smooths them: a moving average over three frames."""
    inner = (position[:-2] + position[1:-1] + position[2:]) / 3
    return np.concatenate([position[:1], inner, position[-1:]])


@functools.cache
def refusals():
    vehicle, rod = poses(states())
    yup = [body._replace(position=body.position[:, [0, 2, 1]], axis=body.axis[:, [0, 2, 1]]) for body in (vehicle, rod)]
    lean = np.linspace(-0.1, 0.5, len(rod.time)) ** 3 * 4
    fall = rod._replace(position=vehicle.position + 0.58 * np.column_stack([np.sin(lean), 0 * lean, np.cos(lean)]))
    slope = Rotation.from_rotvec([0.2, 0.1, 0.0])
    tilted = [
        body._replace(position=slope.apply(body.position), axis=slope.apply(body.axis)) for body in (vehicle, rod)
    ]
    rounded = rod._replace(position=np.round(rod.position, 2))
    return {
        "along y, not along z": (yup[0]._replace(axis=vehicle.axis), yup[1]._replace(axis=rod.axis)),
        "millimetres": [body._replace(position=1000 * body.position) for body in (vehicle, rod)],
        "swapped": (rod, vehicle),
        "order of its quaternion": (vehicle._replace(axis=-vehicle.axis), rod),
        "at its foot": (vehicle, rod._replace(position=rod.position - 0.5 * rod.axis - [0, 0, 0.04], axis=None)),
        "too few poses": (at(vehicle, slice(0, 30)), at(rod, slice(0, 30))),
        "too far for the model": (vehicle, fall),
        "not level": tilted,
        "vehicle leans by 20 deg": (vehicle._replace(axis=turned_axis(vehicle.axis)), rod),
        "not white": [body._replace(position=averaged(body.position)) for body in (vehicle, rod)],
        "quantisation: the rod moves by": (vehicle, rounded),
        "position does not change": (vehicle, rod._replace(position=np.tile(rod.position[:1], (len(rod.time), 1)))),
    }


@pytest.mark.parametrize("cause", [
    "along y, not along z", "millimetres", "swapped", "order of its quaternion", "at its foot", "too few poses",
    "too far for the model", "not level", "vehicle leans by 20 deg", "not white", "quantisation: the rod moves by",
    "position does not change",
])  # fmt: skip
def test_a_refusal_names_its_cause(cause):
    answer = estimate(*refusals()[cause])
    assert answer.reason is not None and cause in answer.reason, answer
    assert math.isnan(answer.length) and math.isnan(answer.interval[0])
    assert "\n" not in answer.reason


def test_a_push_is_refused_with_its_time():
    x = states(pushes=(Push(4.0, (0.008, 0.0)),))
    answer = estimate(*poses(x))
    assert "pushed" in answer.reason
    # seconds by the clock of the poses; the innovations over a tenth of a second tell
    assert 3.9 <= float(re.search(r"at ([0-9.]+) s", answer.reason)[1]) <= 4.1


def test_all_pushes_are_named_and_the_longest_stretch_without():
    x = states(duration=16.0, pushes=(Push(4.0, (0.008, 0.0)), Push(9.0, (0.008, 0.0))))
    reason = estimate(*poses(x, start=2.0, seconds=13.0)).reason
    first, second, begin, end = (float(one) for one in re.findall(r"(?:at|and|from|to) ([0-9.]+)", reason))
    assert 3.9 <= first <= 4.2 and 8.9 <= second <= 9.2
    assert 10.0 < begin < 11.5 and end == 15.0


def test_jumps_are_found_where_all_innovations_are_large_too():
    clock, rng = np.arange(0.0, 10.0, 0.004), np.random.default_rng(0)
    innovation = rng.standard_normal((len(clock), 2))
    assert jumps(clock, innovation) == []
    innovation[np.abs(clock - 4.05) < 0.05] *= 4.0
    innovation[np.abs(clock - 7.05) < 0.05] *= 4.0
    for scale, relative in ((1.0, False), (1.0, True), (5.0, True)):
        starts, ends = np.array(jumps(clock, scale * innovation, relative)).T
        # within the tenth of a second over which the mean square is taken
        assert starts == pytest.approx([3.95, 6.95], abs=0.05) and ends == pytest.approx([4.15, 7.15], abs=0.05)


@pytest.mark.parametrize("noise", [0.0, 1e-6])
def test_poses_without_noise_are_named(noise):
    answer = estimate(*poses(states(), position=noise, attitude=5.0 * noise))
    assert "hold no noise" in answer.reason


@pytest.mark.parametrize("corner", [8.0, 30.0])  # Hz
def test_poses_that_were_smoothed_are_named(corner):
    def smoothed(values):
        return signal.lfilter(*signal.butter(2, corner / 120.0), values - values[0], axis=0) + values[0]

    bodies = poses(states(), seconds=5.0)
    answer = estimate(*(Body(body.time, smoothed(body.position), smoothed(body.axis)) for body in bodies))
    assert "low-pass filter" in answer.reason


def test_noise_is_refused_with_the_option_that_states_it_and_answered_with_that():
    bodies = poses(states(), position=1e-3, attitude=5e-3, seconds=5.0)
    reason = estimate(*bodies).reason
    noise = tuple(float(one) for one in re.search(r"--noise ([0-9.e-]+),([0-9.e-]+)", reason).groups())
    assert noise == pytest.approx((1e-3, 5e-3), rel=0.1)
    check_length(estimate(*bodies, Knowledge(noise=noise)), 1.0)


def test_too_little_excitation_is_refused():
    # motion of 1 cm and 1 deg, seen with 5 mm and 1 deg of noise
    answer = estimate(*poses(states(), position=5e-3, attitude=0.02), Knowledge(noise=(5e-3, 0.02)))
    assert "too little excitation" in answer.reason
    assert math.isnan(answer.length)


def test_bodies_that_do_not_belong_together_are_refused():
    vehicle, _ = poses(states())
    _, other = poses(states(seed=2))
    assert estimate(vehicle, other).reason is not None


def test_a_length_outside_the_interval_is_refused():
    assert "outside the interval" in estimate(*poses(states()), Knowledge(lengths=(0.1, 0.8))).reason


def test_intervals_hold_the_truth():
    scores = []
    for seed in range(1, 7):
        x = states(seed=seed)
        for start in (2.5, 5.5):
            answer = estimate(*poses(x, seed=[seed, round(start)], start=start), AT_MIDDLE)
            scores.append((answer.length - 1.0) / answer.standard_deviation)
    # 12 windows: the root mean square of 12 normal numbers lies between 0.5 and 1.6 but once in 1000 times
    assert 0.5 < math.sqrt(np.mean(np.square(scores))) < 1.6


def test_a_coverage_comes_with_an_interval_over_flights():
    share, low, high = interval([4, 4, 4, 3], [4, 4, 4, 4])
    assert share == 15 / 16 and low < share < high == 1.0
    # flights that all agree leave nothing to draw
    assert interval([3, 3], [4, 4]) == (0.75, 0.75, 0.75)
    # where no interval misses, the rule of three: 3 / n, here of Wilson, 3.84 / (n + 3.84)
    assert interval([4] * 10, [4] * 10) == pytest.approx((1.0, 1.0 - 3.8415 / 43.8415, 1.0), abs=1e-4)


def test_a_stream_gives_what_the_whole_flight_gives():
    vehicle, rod = poses(states(duration=16.0), seconds=8.0)
    stream = Stream(*(at(body, body.time < 5.5) for body in (vehicle, rod)))
    deviation = stream.length.deviation
    for begin in np.arange(5.5, 10.95, 0.25):
        stream.push(*(at(body, (body.time >= begin) & (body.time < begin + 0.25)) for body in (vehicle, rod)))
    whole = estimate(vehicle, rod, AT_MIDDLE)
    assert stream.length.deviation < 0.8 * deviation
    # one Newton step from the first window's maximum, and 0.15 s of poses that still wait
    assert stream.length.value == pytest.approx(whole.length, abs=0.25 * whole.standard_deviation)


def test_a_history_ends_at_the_answer_and_shrinks():
    vehicle, rod = poses(states(duration=16.0), seconds=8.0)
    found = history(vehicle, rod, AT_MIDDLE, points=12)
    assert found.time[0] == 1.0 and found.time[-1] == pytest.approx(8.0, abs=0.01)
    assert np.all(np.diff(found.standard_deviation) < 0.0)
    # the maximum is found within a tenth of a squared standard deviation, and the last step ends it
    assert found.length[-1] == pytest.approx(found.answer.length, abs=0.1 * found.answer.standard_deviation)
    assert found.standard_deviation[-1] == pytest.approx(found.answer.standard_deviation, rel=0.02)
    # earlier answers agree with an estimate of those poses alone
    at_four = int(np.searchsorted(found.time, 4.0))
    until = 3.0 + found.time[at_four]
    alone = estimate(*(at(body, body.time <= until) for body in (vehicle, rod)), AT_MIDDLE)
    assert found.length[at_four] == pytest.approx(alone.length, abs=0.3 * alone.standard_deviation)
    assert found.standard_deviation[at_four] == pytest.approx(alone.standard_deviation, rel=0.15)


def test_a_history_that_is_refused_at_once_is_empty():
    vehicle, rod = poses(states())
    found = history(rod, vehicle)
    assert "swapped" in found.answer.reason and len(found.time) == len(found.length) == 0


@pytest.mark.parametrize("angle", [0.05, 0.1])
def test_a_world_that_is_not_quite_level_does_no_harm(angle):
    slope = Rotation.from_euler("xyz", [angle, angle / 2, 0.3])
    turned = [
        body._replace(position=slope.apply(body.position), axis=slope.apply(body.axis)) for body in poses(states())
    ]
    check_length(estimate(*turned, AT_MIDDLE), 1.0)


def test_a_body_frame_that_is_turned_is_set_upright():
    x = states()[720:1320]
    attitude, offset = Rotation.from_quat(x[:, 6:10]), Rotation.from_rotvec([0.3, -0.2, 0.9])
    axis, angle = upright_axis((attitude * offset).as_quat())
    # the flight's own mean tilt, of a degree, is what remains
    assert angle == pytest.approx(np.arccos(offset.as_matrix()[2, 2]), abs=0.03)
    true = attitude.apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(axis - axis.mean(axis=0), true - true.mean(axis=0), atol=2e-3)
    level, none = upright_axis(attitude.as_quat())
    assert none == 0.0
    np.testing.assert_allclose(level, true, atol=1e-12)


def test_poses_without_an_attitude_have_no_axis():
    axis, angle = upright_axis([[0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0, 0.0], [np.nan, 0.0, 0.0, 1.0]])
    assert angle == 0.0
    assert np.isfinite(axis).all(axis=1).tolist() == [True, False, False]
    assert np.isnan(upright_axis(np.zeros((2, 4)))[0]).all()


def test_a_whole_flight_takes_linear_time():
    x = states(duration=16.0)
    short, long = (rows_of(*poses(x, start=1.0, seconds=seconds)) for seconds in (3.0, 12.0))
    _, theta = rows_and_point()
    lanes = np.tile(theta, (16, 1))

    def seconds(rows):
        spent = []
        for _ in range(5):
            begin = time.process_time()
            kf.run(rows, lanes)
            spent.append(time.process_time() - begin)
        return min(spent)

    # four times the rows; a quadratic recursion would take 16 times as long
    assert seconds(long) < 8.0 * seconds(short)


def test_a_simulated_cart():
    clock, base, angle = simulated_cart(np.random.default_rng(0))
    answer = planar(clock, base, clock + 1e-9, angle)
    assert answer.reason is None, answer.reason
    check(answer.effective_length, 0.4)
    assert answer.effective_length.deviation < 0.02
    assert "base" in " ".join(answer.assumed)


def test_encoders_are_read_from_a_table_in_any_order(tmp_path):
    known = simulated_cart(np.random.default_rng(0), seconds=1.0)
    order = (2, 0, 1)
    header = ",".join(COLUMNS[column] for column in order)
    table = tmp_path / "cart.csv"
    np.savetxt(table, np.array(known)[list(order)].T, delimiter=",", header=header, comments="", fmt="%.17g")
    np.testing.assert_array_equal(read_encoders(table), known)
    table.write_text(table.read_text() + "0.1,,2\n")
    np.testing.assert_array_equal(read_encoders(table), known)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("a,b\n1,2\n", "not a CSV file of encoders"),
        ("time_s,base_position_m,angle_rad\n1,2,3\n", "1 rows hold numbers"),
        ("time_s,base_position_m,angle_rad\n1,2,3,4\n", "damaged"),
        ("time_s,base_position_m,angle_rad\n1,two,3\n", "damaged"),
        ("", "not a CSV file of encoders"),
    ],
)
def test_what_is_no_table_of_encoders_is_said(tmp_path, text, why):
    (table := tmp_path / "cart.csv").write_text(text)
    with pytest.raises(FipError, match=f"cart.csv: .*{why}"):
        read_encoders(table)


def test_a_rod_that_hardly_moves_is_refused_for_its_encoder():
    clock, base, angle = simulated_cart(np.random.default_rng(0), angle_step=0.05)
    assert "quantisation" in planar(clock, base, clock, angle).reason


def test_a_real_rotary_pendulum():
    root = os.environ.get("FIP_REAL", Path(__file__).parents[2] / "../shared/real")
    path = Path(root) / "furuta/upright.csv"
    if not path.exists():
        pytest.skip(f"no recording at {path}; FIP_REAL names the directory that holds furuta/upright.csv")
    clock, base, angle = read_encoders(path)
    known = Knowledge(noise=(1e-4, 1e-3), lengths=(0.03, 1.0))
    for radius in (math.inf, 0.062):
        answer = planar(clock, base, clock, angle, known, arm_radius=radius)
        assert answer.reason is None
        value, deviation = answer.effective_length
        # 62.3 mm from CAD, 60.0 to 63.6 from free swings; the model leaves out friction, and the answer says so
        assert abs(value - 62.3e-3) < 0.08 * 62.3e-3
        assert abs(value - 62.3e-3) < 2.0 * deviation < 0.15 * value
        assert any("not white" in note for note in answer.notes)
