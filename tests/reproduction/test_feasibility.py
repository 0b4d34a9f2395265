"""The linear programmes of the terminal constraint, against searches by hand."""

import math

import numpy as np
import pytest

from fiplib.mpc import MPC
from fiplib.params import A_DOT, B, Params
from fiplib.reproduction import feasibility
from fiplib.reproduction.feasibility import terminal_error, terminal_loss
from tests.reproduction.made_up import flight, moments

PARAMS, REST = Params(), np.zeros(5)


def test_at_rest_the_constraint_is_kept_and_too_large_an_offset_has_no_solution_at_all():
    assert terminal_error(REST, REST, 1.0, PARAMS) == pytest.approx(0.0, abs=1e-9)
    # 14 cm beside the seat, at rest: 100 deg/s turn the vehicle too slowly to come under the rod again
    assert terminal_error(np.array([0.0, 0.0, 0.14, 0.0, 0.0]), REST, 1.0, PARAMS) == math.inf
    # the longer rod falls more slowly
    assert terminal_error(np.array([0.0, 0.0, 0.135, 0.0, 0.0]), REST, 1.6, PARAMS) < feasibility.REACHED


def test_the_largest_offset_that_can_be_caught_is_the_same_with_the_constraint_and_without():
    # docs/studies.md states 11.4 cm with 1 m in use
    caught, lost = (terminal_error(np.array([0.0, 0.0, d, 0.0, 0.0]), REST, 1.0, PARAMS) for d in (0.114, 0.1145))
    assert caught < feasibility.REACHED and lost == math.inf


def test_in_one_step_the_smallest_terminal_error_is_that_of_a_search_over_the_input():
    one = PARAMS.replace(control__nodes=2, control__horizon=0.2)
    problem = MPC(one).prepare(1.0)[0]
    bound = np.array(one.control.state_bounds)[[0, 1, 4, 5, 9]]
    start = np.array([0.1, 0.0, 0.01, 0.0, 0.05])
    inputs = np.linspace(-1, 1, 201) * one.vehicle.max_body_rate
    first = problem.transition @ start + np.outer(inputs, problem.input)
    last = (first @ problem.transition.T)[:, None] + np.multiply.outer(inputs, problem.input)
    inside = (np.abs(first) <= bound).all(axis=1)[:, None] & (np.abs(last) <= bound).all(axis=2)
    searched = np.where(inside, np.abs(last / bound).max(axis=2), np.inf).min()
    # steps of 1 deg/s in the search: a hundredth of the tilt's bound at most
    assert terminal_error(start, REST, 1.0, one) == pytest.approx(searched, abs=0.01)
    assert searched > 0.03, "x is 4 % of its bound off and cannot be mended in 0.2 s"


def test_the_loss_is_the_share_of_solvable_problems_that_cannot_end_at_rest(monkeypatch):
    errors = iter([0.0, 0.5, math.inf] * 20)
    monkeypatch.setattr(feasibility, "terminal_error", lambda *_: next(errors))
    hover = flight(9, {B: np.full(len(moments(9)), 0.01)}, pushes=(5.0,))
    assert terminal_loss(hover) == 0.5


def test_the_problems_are_those_of_both_axes_after_every_push(monkeypatch):
    asked = []
    monkeypatch.setattr(feasibility, "terminal_error", lambda *what: asked.append(what) or math.inf)
    velocity = np.where(moments(26) > 12, 0.1, 0.0)
    assert math.isnan(terminal_loss(flight(26, {A_DOT: velocity}, pushes=(5.0, 13.0))))
    assert len(asked) == 2 * 10 * 2 * 3
    assert [tuple(start) for start, *_ in asked[60::6]] == [(0, 0, 0, 0.1, 0)] * 10
    assert {length for _, _, length, _ in asked} == set(feasibility.LENGTHS)
