"""The ledger's numbers of one flight, on made-up flights whose answer is known."""

import dataclasses
import math

import numpy as np
import pytest

from fiplib import ga, kalman, replay
from fiplib.dynamics import prediction_model, rk4
from fiplib.estimators.grid import best_length
from fiplib.kalman import Window
from fiplib.params import A, B, Params, X, Y
from fiplib.recording import Poses
from fiplib.references import Circle
from fiplib.reproduction import quantities
from tests.reproduction.made_up import RATE, TICK, bump, circling, estimating, flight, moments, series

# --- pushes


def test_pushes_are_kept_until_the_rod_falls():
    pushes = (5.3, 12.0, 20.2)
    assert quantities.kept(flight(26, pushes=pushes)) == 3
    assert quantities.kept(flight(26, {B: np.where(moments(26) > 13, 0.4, 0.0)}, pushes=pushes)) == 1


def test_the_largest_deviation_counts_from_the_first_push_on():
    time = moments(10)
    before = np.where(time < 1, 0.2, 0.0)
    assert quantities.push_lean(flight(10, {A: before - bump(time, 5.0, 0.05, 0.5)}, pushes=(5.0,))) == 0.05


def test_the_slowest_push_gives_the_settling_time():
    time = moments(30)
    a, b = bump(time, 5.0, 0.05, 0.5), -bump(time, 15.0, 0.05, 1.25)
    slowest = quantities.settling(flight(30, {A: a, B: b}, pushes=(5.0, 15.0)))
    assert slowest == pytest.approx(1.25 * math.log(5), abs=TICK)  # from 5 cm to 1 cm


def test_errors_of_the_axes_are_compared_after_the_first_push_only():
    time = moments(10)
    late = time >= 5.0
    x, y = np.where(late, 0.02, 0.5), np.where(late, -0.03, 0.0)
    assert quantities.pushed_axes(flight(10, {X: x, Y: y}, pushes=(5.0,))) == pytest.approx(1.5)


# --- circle


def test_the_circles_numbers_are_those_of_a_known_response():
    late = Circle(radius=0.8, period=9.0).at(moments(26) - 0.1)
    on_time = Circle(radius=0.8, period=9.0).at(moments(26))
    flown = circling({X: 0.93 * late[:, X], Y: on_time[:, Y] - 0.19, B: np.full(26 * RATE, -0.023)})
    assert quantities.circle_lean(flown) == pytest.approx(0.023)
    assert quantities.x_gain(flown) == pytest.approx(0.93, abs=1e-6)
    assert quantities.x_delay(flown) == pytest.approx(0.1, abs=1e-6)
    assert quantities.y_error(flown) == pytest.approx(0.19)


# --- length


def test_the_length_is_the_last_median_and_converges_when_it_comes_to_stay():
    flown = estimating([(0.0, 0.8), (5.5, 1.01), (13.0, 0.94), (14.5, 1.0)])
    assert (quantities.final_length(flown), quantities.converged(flown)) == (1.0, 14.5)


def test_late_convergence_is_the_share_of_the_initial_error_that_goes_after_14_s():
    # initial error 0.4 m; after 14 s it goes from 0.03 to 0.01 m, a twentieth; or from 0.21 to 0.01 m, a half
    early, late = ([(0.0, 1.4), (5.5, length), (16.0, 1.01)] for length in (1.03, 1.21))
    assert quantities.late_share(estimating(early)) == pytest.approx(0.05)
    assert quantities.late_share(estimating(late)) == pytest.approx(0.5)


def test_tracking_before_and_after_the_update_is_compared_on_the_same_arc():
    time = moments(25)
    reference = Circle(radius=0.4, period=8.0).at(time)
    errors = {
        X: reference[:, X] + np.where(time < 5.5, 0.1, 0.02),
        Y: reference[:, Y] + np.where(time < 5.5, 0.1, 0.2),
    }
    # a large error between update and next lap lies on another arc and does not count
    errors[X][(time > 5.5) & (time < 7)] += 1.0
    flown = flight(25, errors, reference, lengths=[(0.0, 1.4), (5.5, 1.0)])
    assert quantities.x_tracking(flown) == pytest.approx(0.2)
    assert quantities.y_tracking(flown) == pytest.approx(2.0)


def test_there_is_no_arc_to_compare_where_the_circle_begins_after_the_update():
    assert math.isnan(quantities.x_tracking(estimating([(0.0, 1.4), (0.5, 1.0)])))


def test_fluctuation_and_error_are_those_of_the_estimators_answers_not_of_the_used_length():
    answers = np.array([1.0, 1.02] * 20)
    values = np.stack([np.full(40, 1.5), answers, np.full(40, 0.1)], axis=1)
    values[0, 1] = np.nan  # nothing is estimated yet
    flown = estimating([(0.0, 1.5)])
    told = series(np.arange(40) * 0.2, values, ("used", "estimate", "sd"))
    flown = dataclasses.replace(flown, length=told)
    assert quantities.fluctuation(flown) == pytest.approx(0.02)
    assert quantities.estimate_error(flown) == pytest.approx(0.02 * math.sqrt(20 / 39))
    assert math.isnan(quantities.fluctuation(estimating([(0.0, 1.5), (5.0, math.nan)])))


# --- the search


@pytest.fixture(scope="module")
def window() -> Window:
    """A window of the prediction model itself with l = 1.05 m and small noise."""
    rng, step = np.random.default_rng(0), 0.1
    advance = rk4(prediction_model(), step)
    states = [np.zeros(10)]
    inputs = rng.normal(size=(40, 2)) * 0.02
    for rates in inputs[:-1]:
        states.append(np.array(advance(states[-1], rates, 1.05)).ravel())
    return Window(np.array(states) + rng.normal(size=(40, 10)) * 1e-4, inputs, step)


def test_the_two_steps_of_the_exhaustive_search_find_the_best_of_all_lengths(window):
    params = Params().replace(estimation__length_min=0.9, estimation__length_max=1.2)  # 3 001 codes are quick
    best = best_length(window, params)
    assert best == ga.landscape(window, params).best
    assert best == pytest.approx(1.05, abs=0.01)  # the model is unstable, so that 4 s of it tell the length well
    assert kalman.fitness([best], window, params.estimation) < kalman.fitness([best + 0.01], window, params.estimation)


def test_the_gaps_of_the_search_are_medians_against_that_optimum(window, monkeypatch):
    monkeypatch.setattr(replay, "spaced_windows", lambda flight: [window, window])
    params = Params().replace(estimation__length_min=0.9, estimation__length_max=1.2)
    flown, explored, optimum, count = quantities.search_gaps(flight(1, params=params))
    assert count == 2
    assert optimum == pytest.approx(abs(best_length(window, params) - 1.0))
    # 20 generations of 60 see most of 3 001 codes about the optimum: within 5 mm with either setting
    assert 0 <= flown < 5e-3 and 0 <= explored < 5e-3


def test_the_gaps_of_one_flight_are_three_columns_of_one_search(monkeypatch):
    monkeypatch.setattr(quantities, "search_gaps", lambda *flights: (0.01, 0.02, 0.03, 7))
    some = flight(1)
    found = quantities.search_gap(some), quantities.explored_gap(some), quantities.optimum_error(some)
    assert found == (0.01, 0.02, 0.03)


def test_the_printed_fitness_is_searched_by_its_own_name_over_all_windows(monkeypatch):
    class Found:
        def __init__(self, best):
            self.best = best

    def landscape(window, params):
        assert params.estimation.fitness == "paper"
        return Found(0.3 if params.estimation.process_noise == (1.0,) * 10 else window)

    monkeypatch.setattr(replay, "spaced_windows", lambda flight: [0.9, 1.01, 1.02])
    monkeypatch.setattr(ga, "landscape", landscape)
    assert quantities.printed_best(flight(1)) == 1.01
    assert quantities.printed_identity(flight(1)) == 0.3


# --- changes of the length


def jumping(wild: float = 0.6, falls: bool = True):
    """The length changes by 0.6 m twice, then by 0.85 m at 16 s, after which the rod falls at 20 s."""
    time = moments(26)
    rates = np.where(time < 16, 0.3, wild)
    lengths = [(0.0, 1.0), (6.0, 0.4), (11.0, 1.0), (16.0, 1.85)]
    return flight(26, {A: np.where(time > 20, 0.4 * falls, 0.0)}, lengths=lengths, rates=rates)


def test_the_largest_change_survived_and_the_smallest_fatal_one():
    assert quantities.survived_change(jumping()) == pytest.approx(0.6)
    assert quantities.fatal_change(jumping()) == pytest.approx(0.85)
    assert quantities.fatal_jump(jumping()).end == pytest.approx(20.0, abs=TICK)
    assert quantities.survived_change(jumping(falls=False)) == pytest.approx(0.85)
    assert math.isnan(quantities.fatal_change(jumping(falls=False)))
    assert quantities.fatal_jump(jumping(falls=False)) is None


def test_commands_are_compared_over_the_largest_change():
    assert quantities.command_ratio(jumping(wild=0.6)) == pytest.approx(2.0)


# --- altitude and yaw


def test_height_and_yaw_sway_by_what_the_poses_say_once_settled():
    time = np.arange(0, 20, 0.01)
    stamp = np.round(time * 1e9).astype(np.int64)
    yaw = np.radians(6.0) * np.sin(time)
    height = 1.3 + np.where(time < 1, 5.0, 0.1 * np.sin(time))
    attitude = np.stack([0 * yaw, 0 * yaw, np.sin(yaw / 2), np.cos(yaw / 2)], axis=1)
    position = np.stack([0 * height, 0 * height, height], axis=1)
    flown = dataclasses.replace(flight(20), vehicle=Poses(stamp, stamp, position, attitude))
    assert quantities.height_sway(flown) == pytest.approx(0.1, abs=0.02)  # the median is that of a few waves
    assert quantities.yaw_sway(flown) == pytest.approx(6.0, abs=1e-3)
