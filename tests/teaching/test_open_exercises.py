"""What students write flies and is scored; what cannot fly is refused in one sentence."""

import dataclasses
import re
import runpy
from pathlib import Path

import numpy as np
import pytest

from fiplib.controllers import controller_of
from fiplib.estimators.base import Estimate
from fiplib.estimators.windows import RawWindow
from fiplib.kalman import Window
from fiplib.params import STATES, Params
from fiplib.simulate import fly
from fiplib.teaching.exercises import open_controller, open_estimator
from fiplib.teaching.exercises.grading import NotYet

SOLUTIONS = runpy.run_path(str(Path(__file__).parents[2] / "notebooks/solutions/12-fly-it-yourself.py"))


def still(state, reference, length):
    return 0.0, 0.0


@pytest.fixture(scope="module")
def controllers() -> list[open_controller.Score]:
    return open_controller.scores(SOLUTIONS["controller"])


@pytest.fixture(scope="module")
def estimators() -> list[open_estimator.Score]:
    return open_estimator.scores(SOLUTIONS["estimator"])


def test_the_solution_and_every_rival_keep_the_rod_up_within_the_bounds_of_the_vehicle(controllers):
    assert [row.controller for row in controllers] == 3 * ["yours", "mpc", "lqr"]
    for row in controllers:
        assert np.isnan(row.fell)
        assert 0.01 < row.error < 0.3, row  # noise alone moves the vehicle by centimetres
        assert 0.0 < row.effort < np.sqrt(2) * Params().vehicle.max_body_rate


def test_a_score_is_that_of_the_flight_that_the_library_flies(controllers):
    scenario = open_controller.FLIGHTS[1]
    flight = fly(scenario)
    wanted = scenario.reference.at(flight.time(flight.truth_state))
    late = flight.time(flight.truth_state) > open_controller.SETTLED
    missed = (flight.truth_state.values[late][:, [0, 2]] - wanted[late][:, [0, 2]]) ** 2
    [row] = [row for row in controllers if row.controller == "mpc" and row.flight == scenario.name]
    assert row.error == pytest.approx(np.sqrt(missed.sum(axis=1).mean()), rel=1e-12)


def test_a_controller_of_the_library_given_as_the_student_s_has_the_score_of_the_library_s():
    mpc = controller_of(Params())
    mine = open_controller.scores(lambda state, reference, length: mpc.solve(state, reference, length).input)
    rows = {(row.controller, row.flight): dataclasses.replace(row, controller="") for row in mine}
    for scenario in open_controller.FLIGHTS[:2]:  # the third has other parameters than this MPC
        assert rows["yours", scenario.name] == rows["mpc", scenario.name]
    assert "its error is 1.00 times" in open_controller.verdict([row for row in mine if "0.6" not in row.flight])


def test_the_same_controller_has_the_same_score_each_time():
    scenario = open_controller.FLIGHTS[0]
    scored = [
        open_controller.score("yours", lambda params: open_controller.OwnController(still, params), scenario)
        for _ in range(2)
    ]
    assert repr(scored[0]) == repr(scored[1])


def test_a_stub_falls_and_says_so(capsys):
    open_controller.check(still)
    printed = capsys.readouterr().out
    assert re.search(r"hover, pushed twice +yours +[012]\.\d s\n", printed)
    assert "Your controller keeps the rod up in 0 of 3 flights" in printed


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (None, "returns nothing yet"),
        (..., "returns nothing yet"),
        ((1.0, 2.0, 3.0), "shape (3,)"),
        (np.array([1j, 0.0]), "not two numbers"),
        (1.0, "shape ()"),
        ((np.nan, 0.0), "[nan, 0.0]"),
        ((np.inf, 0.0), "[inf, 0.0]"),
        ("left", "'left', and not two numbers"),
        ((1j, 0.0), "not two numbers"),
        ({"x": 1}, "not two numbers"),
    ],
    ids=repr,
)
def test_what_is_no_pair_of_rates_is_refused_in_one_sentence(answer, words, capsys):
    open_controller.check(lambda state, reference, length: answer)
    printed = capsys.readouterr().out
    assert printed.startswith("not yet: your controller returns") and words in printed and printed.count("\n") == 1


@pytest.mark.parametrize(
    "answer", [[0.1, 0.2], np.array([[0.1], [0.2]]), np.array([[0.1, 0.2]]), ("0.1", 0.2)], ids=repr
)
def test_lists_columns_and_rows_of_two_rates_are_accepted(answer):
    np.testing.assert_array_equal(open_controller.two_rates(answer), [0.1, 0.2])


def test_a_controller_that_stops_or_takes_other_arguments_is_refused_in_one_sentence(capsys):
    open_controller.check(lambda state, reference, length: 1 / 0)
    open_controller.check(lambda state: (0.0, 0.0))
    open_controller.check(3)
    printed = capsys.readouterr().out.splitlines()
    assert len(printed) == 3 and all(line.startswith("not yet: your controller stops with") for line in printed)


def test_a_mistake_in_the_middle_of_a_flight_is_a_sentence_too(capsys):
    def late(state, reference, length):
        return (0.0, 0.0) if not state.any() else (np.nan, 0.0)

    open_controller.check(late)
    assert capsys.readouterr().out.startswith("not yet: your controller returns [nan, 0.0]")


def test_a_controller_cannot_change_what_it_is_given():
    state = np.ones(len(STATES))

    def spoils(given, reference, length):
        given[:] = reference[:] = 0.0
        return 0.0, 0.0

    open_controller.OwnController(spoils, Params()).solve(state, reference := np.ones((61, 10)), 1.0)
    assert state.all() and reference.all()


def test_estimators_are_scored_by_error_and_coverage(estimators):
    rows = {(row.estimator, row.flight): row for row in estimators}
    assert len(rows) == 6
    for scenario in open_estimator.FLIGHTS:
        own, ga, poses = (rows[name, scenario.name] for name in ("yours", "ga", "poses"))
        assert np.isnan(own.fell) and own.runs == own.answers == ga.answers
        # notebook 12: the paper's model costs decimetres, the poses' estimator is right to millimetres
        assert poses.error < 0.02 < own.error < 0.5 and ga.error > 0.05
        assert poses.covered == 1.0 and 0.0 <= own.covered <= 1.0


def test_an_oracle_has_no_error_and_the_score_says_how_often_its_interval_holds():
    scenario = open_estimator.FLIGHTS[0]
    true = scenario.params.pendulum.length
    answers = iter([Estimate(true + 0.02, 0.01), *(Estimate(true - 0.02, 0.02) for _ in range(20))])
    row = open_estimator.score("yours", "states", lambda window, params, rng: next(answers), scenario)
    assert row.error == pytest.approx(0.02) and row.covered == pytest.approx((row.answers - 1) / row.answers)


@pytest.mark.parametrize(("kind", "window"), [("states", Window), ("raw", RawWindow)])
def test_an_estimator_is_given_windows_of_its_kind(kind, window):
    given = []

    def looks(seen):
        given.append(seen)
        return 1.0

    own = [row for row in open_estimator.scores(looks, kind) if row.estimator == "yours"]
    assert len(given) == sum(row.runs for row in own) > 10 and {type(one) for one in given} == {window}
    assert [row.error for row in own] == pytest.approx([0.2, 0.3])  # rods of 0.8 and 1.3 m


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (None, "returns nothing yet"),
        ((1.0, 0.1, 0.2), "shape (3,)"),
        (np.array(1.0 + 0.1j), "not a length in m"),
        (np.nan, "a length of nan"),
        (np.inf, "a length of inf"),
        (-1.0, "-1 m"),
        (0.0, "0 m"),
        (1000.0, "1000 m"),
        ((1.0, -0.1), "standard deviation of -0.1 m"),
        ((1.0, np.inf), "standard deviation of inf m"),
        ("long", "'long', and not a length"),
    ],
    ids=repr,
)
def test_what_is_no_length_is_refused_in_one_sentence(answer, words):
    with pytest.raises(NotYet) as refusal:
        open_estimator.own_estimate(answer)
    assert words in str(refusal.value) and str(refusal.value).startswith("your estimator returns")


@pytest.mark.parametrize("answer", [0.9, [0.9], np.array(0.9), np.array([[0.9]]), (0.9, np.nan), Estimate(0.9, np.nan)])
def test_a_length_alone_is_an_estimate_without_a_deviation(answer):
    found = open_estimator.own_estimate(answer)
    assert found.length == 0.9 and np.isnan(found.standard_deviation)


def test_an_estimator_that_stops_and_a_kind_that_is_none_are_refused_in_one_sentence(capsys):
    open_estimator.check(lambda window: 1 / 0)
    open_estimator.check(lambda: 1.0)
    open_estimator.check(lambda window: 1.0, kind="both")
    printed = capsys.readouterr().out.splitlines()
    assert len(printed) == 3 and all(line.startswith("not yet: ") for line in printed)
    assert printed[2] == "not yet: kind must be one of 'states', 'raw', not 'both'"
