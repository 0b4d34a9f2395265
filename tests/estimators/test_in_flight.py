"""The pose estimator in flight: growing windows, then everything since the first pose; and the profile likelihood."""

import functools
import math
from dataclasses import replace

import numpy as np
import pytest

from fiplib import ga, replay
from fiplib.estimators import ESTIMATORS, brent, grid
from fiplib.estimators.base import Estimate
from fiplib.estimators.poses.estimate import estimate
from fiplib.estimators.poses.in_flight import InFlight, body_of, knowledge_in_flight, profile_of
from fiplib.estimators.poses.knowledge import Told
from fiplib.estimators.windows import RawWindow
from fiplib.params import NANO, Params
from fiplib.recording import Flight
from fiplib.references import Circle
from fiplib.simulate import Push, Scenario
from fiplib.studies.batch import fly_many

PARAMS = Params().replace(
    piloting__estimate=True, piloting__handover="trusted", piloting__initial_length=0.5, estimation__estimator="poses"
)


@functools.cache
def flown(pushed: bool = False, seconds: float = 7.0) -> Flight:
    pushes = (Push(4.0, (0.006, 0.0)),) if pushed else ()
    circle = Circle(0.4, 8.0, start=0.0, ramp=2.0)
    [flight] = fly_many([Scenario("test", "", seconds, circle, pushes, params=PARAMS, seed=91)])
    assert flight.survived
    return flight


@functools.cache
def windows(pushed: bool = False) -> tuple[RawWindow, ...]:
    return tuple(found.window for found in replay.windows(flown(pushed)))


def answers(given: tuple[RawWindow, ...], params: Params = PARAMS) -> list[Estimate]:
    estimator = InFlight()
    return [estimator(window, params) for window in given]


def given(found: list[Estimate]) -> np.ndarray:
    return np.array([(one.length, one.standard_deviation) for one in found])


def test_the_first_answer_is_that_of_the_first_window_alone():
    window = replay.raw_window_between(flown(), 3.0, 5.5)
    bodies = (body_of(poses, int(window.vehicle.stamp[0])) for poses in window)
    alone, first = estimate(*bodies, knowledge_in_flight(PARAMS)), InFlight()(window, PARAMS)
    assert (first.length, first.standard_deviation) == (alone.length, alone.standard_deviation)
    assert any("seat is 80 +- 2 mm" in sentence for sentence in first.assumed)


def test_answers_sharpen_for_as_long_as_the_flight_goes_on_and_hold_the_length():
    found = given(answers(windows()))
    known = np.isfinite(found[:, 0])
    assert not known[:1].all() and known[4:].all(), "the first windows hold too little"
    lengths, deviations = found[known].T
    # 4 deviations are passed once in 16 000
    assert (np.abs(lengths - 1.0) < 4 * deviations).all()
    assert deviations[-1] < 0.004 < 0.03 < deviations[0]
    # what all poses together say; they take turns to be smoothed, and the last 0.15 s are still to come
    bodies = (body_of(poses, flown().start_ns) for poses in replay.raw_window_between(flown(), 0.1, 7.0))
    whole = estimate(*bodies, knowledge_in_flight(PARAMS))
    assert lengths[-1] == pytest.approx(whole.length, abs=0.5 * whole.standard_deviation)
    assert deviations[-1] == pytest.approx(whole.standard_deviation, rel=0.1)


def test_a_window_that_is_lost_loses_no_poses():
    every, second = given(answers(windows())), given(answers(windows()[::2]))
    # the same poses in other portions, smoothed at other ends
    assert second[-1, 0] == pytest.approx(every[2 * (len(second) - 1), 0], abs=0.3 * every[-1, 1])


def test_after_a_gap_it_begins_anew():
    late = windows()[-3:]
    estimator = InFlight()
    for window in windows()[:4]:
        estimator(window, PARAMS)
    again = [estimator(window, PARAMS) for window in late]
    np.testing.assert_array_equal(given(again), given(answers(late)))


def test_a_push_is_refused_once_and_the_estimate_begins_anew():
    found = answers(windows(pushed=True))
    reasons = [one.reason for one in found]
    pushed = [index for index, reason in enumerate(reasons) if reason and "nothing in the model does" in reason]
    assert len(pushed) == 1
    known = [one for one in found[pushed[0] + 1 :] if one.reason is None]
    assert known[0].standard_deviation > 2 * found[pushed[0] - 1].standard_deviation
    assert all(abs(one.length - 1.0) < 4 * one.standard_deviation for one in known)


def test_a_seat_that_is_stated_wrong_is_contradicted():
    wrong = PARAMS.replace(piloting__seat_height=0.04)
    found = InFlight()(replay.raw_window_between(flown(), 3.0, 5.5), wrong)
    assert math.isnan(found.length) and "contradicts the seat height" in found.reason


def test_the_measured_distance_of_the_two_bodies_is_not_what_the_length_is_read_from():
    """Both rods move alike; the second one's points seem 2 cm further apart, as a wrong height of the mocap's would."""
    window = replay.raw_window_between(flown(), 3.0, 5.5)
    raised = replace(window.rod, position=window.rod.position + np.array([0.0, 0.0, 0.02]))
    found, other = InFlight()(window, PARAMS), InFlight()(RawWindow(window.vehicle, raised), PARAMS)
    assert other.length == pytest.approx(found.length, abs=0.2 * found.standard_deviation)


def test_a_window_without_a_body_is_refused_with_the_reason():
    window = windows()[0]
    nothing = window.rod.part(np.zeros(0, dtype=int))
    with pytest.raises(ValueError, match="poses of both bodies"):
        InFlight()(RawWindow(window.vehicle, nothing), PARAMS)


def test_the_profile_is_the_posterior_and_every_search_finds_its_minimum():
    window = replay.raw_window_between(flown(), 3.0, 5.5)
    found, fitness = InFlight()(window, PARAMS), profile_of(window, PARAMS)
    near = found.length + found.standard_deviation * np.arange(-2.0, 3.0)
    values = fitness(near)
    # two deviations off it has risen by 4: the same curvature, and the same maximum within a tenth of a deviation
    np.testing.assert_allclose(values - values[2], [4.0, 1.0, 0.0, 1.0, 4.0], atol=0.6)
    best = grid.search(fitness, PARAMS.estimation)
    assert best == pytest.approx(found.length, abs=0.2 * found.standard_deviation)
    assert brent.search(fitness, PARAMS.estimation) == pytest.approx(best, abs=1.1e-4)
    evolved = ga.evolve(fitness, PARAMS.estimation, np.random.default_rng(1))
    assert evolved.length == pytest.approx(best, abs=0.5 * found.standard_deviation)
    assert evolved.standard_deviation == pytest.approx(found.standard_deviation, rel=0.15)
    same = ESTIMATORS["ga_poses"].function(window, PARAMS, np.random.default_rng(1))
    assert (same.length, same.standard_deviation) == (evolved.length, evolved.standard_deviation)


def test_a_profile_with_another_inertia_has_its_minimum_elsewhere():
    window = replay.raw_window_between(flown(), 3.0, 5.5)
    point = brent.search(profile_of(window, PARAMS, Told(1.0, 1e-4)), PARAMS.estimation)
    # a uniform rod taken for a point mass: longer, by a third at most, which is what the fast motion alone would say
    assert 1.02 < point < 1.4


def test_poses_are_those_of_the_recording():
    window = windows()[2]
    assert window.seconds == pytest.approx(0.7, abs=2 / 240)
    stamps = flown().vehicle.stamp
    assert np.isin(window.vehicle.stamp, stamps).all()
    assert (window.vehicle.stamp[0] - stamps[0]) / NANO == pytest.approx(0.1, abs=2 / 240)
