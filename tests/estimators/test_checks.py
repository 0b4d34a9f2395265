"""What may be stated as a result: no end of the search interval, nothing that the residuals contradict."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from fiplib import bags, replay
from fiplib.estimators import ESTIMATORS
from fiplib.estimators.base import Estimate
from fiplib.estimators.checks import checked, why_no_length
from fiplib.kalman import Window
from fiplib.params import Params

DATA = Path(__file__).parents[2] / "data"
STATED = [name for name, estimator in ESTIMATORS.items() if estimator.kind == "states"]


def windows(name: str, estimator: str = "grid") -> tuple[list[Window], Params]:
    flight = bags.read(DATA / name)
    params = flight.params.replace(estimation__estimator=estimator)
    return [timed.window for timed in replay.windows(flight, params)][::50], params


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.mark.parametrize("name", STATED)
def test_an_undisturbed_window_is_answered_as_before(name):
    found, params = windows("estimate-1.4")
    for window in found:
        answer = ESTIMATORS[name].answer(window, params, rng())
        raw = ESTIMATORS[name].function(window, params, rng())
        np.testing.assert_equal(dataclasses.astuple(answer), dataclasses.astuple(raw))
        assert answer.reason is None


@pytest.mark.parametrize("name", STATED)
@pytest.mark.parametrize("ends", [(0.2, 0.6), (1.5, 2.0)])
def test_no_estimator_states_an_end_of_its_interval(name, ends):
    """The rod is 1 m long, outside of both intervals."""
    found, params = windows("estimate-1.4")
    params = params.replace(estimation__length_min=ends[0], estimation__length_max=ends[1])
    answer = ESTIMATORS[name].answer(found[0], params, rng())
    assert math.isnan(answer.length) and math.isnan(answer.standard_deviation)
    assert "at the end of the interval" in answer.reason or "not a rod in question" in answer.reason


@pytest.mark.parametrize("name", STATED)
def test_what_states_an_interval_tests_its_residuals(name):
    """A push is a force that no model here knows: without the test, 0.50 +- 0.006 m for a rod of 1 m."""
    found, params = windows("push-hover")
    answers = [ESTIMATORS[name].answer(window, params, rng()) for window in found]
    assert all(math.isnan(answer.standard_deviation) for answer in answers)
    if name != "concurrent_learning":  # which states no interval
        assert all("does not explain" in answer.reason or "not a rod" in answer.reason for answer in answers)


def test_commands_of_the_other_axis_are_named_by_the_state_that_they_do_not_explain():
    (window, *_), params = windows("estimate-1.4")
    crossed = dataclasses.replace(window, inputs=window.inputs[:, ::-1])
    answer = ESTIMATORS["grid"].answer(crossed, params, rng())
    assert math.isnan(answer.length) and "the model does not explain" in answer.reason


def test_a_refusal_keeps_its_own_reason_and_other_windows_are_not_filtered():
    params = Params()
    assert checked(Estimate(math.nan, math.nan, "too short"), None, params).reason == "too short"
    assert checked(Estimate(1.0, 0.01), None, params) == Estimate(1.0, 0.01)
    assert "at the end" in checked(Estimate(params.estimation.length_max, 0.01), None, params).reason


@pytest.mark.parametrize("name", sorted(path.parent.name for path in DATA.glob("*/metadata.yaml")))
def test_nothing_speaks_against_our_own_flights(name):
    assert why_no_length(bags.read(DATA / name), commands=True) is None
