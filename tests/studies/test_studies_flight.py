"""The studies of flights: their tables are complete and repeatable, and say what clear-cut cases must give."""

import dataclasses
import importlib
import math

import pytest

from fiplib.controllers import margins
from fiplib.params import Params
from fiplib.simulate import SCENARIOS
from fiplib.studies import ledger_seeds, length_jumps, seat, survival, weights

STUDIES = ("survival", "weights", "ledger_seeds", "length_jumps", "seat")


@pytest.fixture
def brief(monkeypatch):
    """Flights short enough for a test."""
    monkeypatch.setattr(survival, "SECONDS", 3.0)
    monkeypatch.setattr(survival, "SEEDS", (1,))
    monkeypatch.setattr(length_jumps, "SECONDS", 3.0)
    monkeypatch.setattr(length_jumps, "START", 4.0)
    monkeypatch.setattr(length_jumps, "SEEDS", (1,))


@pytest.mark.parametrize("name", STUDIES)
def test_the_cases_of_a_study_are_plain_and_told_apart_by_its_keys(name):
    study = importlib.import_module(f"fiplib.studies.{name}")
    cases = study.cases()
    assert cases == study.cases()
    assert len({tuple(case[key] for key in study.KEYS) for case in cases}) == len(cases)
    assert {type(value) for case in cases for value in case.values()} <= {str, int, float}


def test_a_row_of_the_survival_map_is_repeatable_and_finite(brief):
    case = {"used_length": 0.8, "true_length": 1.0, "rod": "uniform"}
    row = survival.run(case)
    assert row == survival.run(case)
    assert all(math.isfinite(value) for value in row.values())
    assert row["survived"] == 1 and row["flown"] == survival.SECONDS and row["growth_rate"] < 0.0
    assert row["gain_low"] < 1.0 < row["gain_high"] and row["pendulum_low"] < 1.0 < row["pendulum_high"]


@pytest.mark.parametrize("true, used", [(1.5, 0.2), (0.5, 2.0)])
def test_a_length_that_the_linear_loop_cannot_bear_falls_within_seconds(brief, monkeypatch, true, used):
    monkeypatch.setattr(survival, "SECONDS", 6.0)
    row = survival.run({"used_length": used, "true_length": true, "rod": "point mass"})
    # grows more than a hundredfold in 6 s, from millimetres
    assert row["growth_rate"] > 0.8
    assert row["survived"] == 0 and row["flown"] < 6.0


def test_a_long_length_fails_slowly_with_or_without_delay_and_a_short_one_fast_and_only_with_it():
    """What the module says of the two sides."""
    rod, point = Params(), Params().replace(pendulum__gyration_ratio=0.0)
    long, short = (margins.closed_loop(used, params) for used, params in ((2.0, rod), (0.2, point)))
    assert long.growth_rate > 0.0 and 3.0 < long.frequency < 4.0
    assert short.growth_rate > 0.0 and 12.0 < short.frequency < 18.0
    prompt = {"simulation__rate_delay": 0.0, "simulation__mocap_latency": 0.0}
    assert margins.closed_loop(2.0, rod.replace(**prompt)).growth_rate > 0.0
    assert margins.closed_loop(0.2, point.replace(**prompt)).growth_rate < 0.0


def test_small_steps_survive_an_outlier_that_a_jump_does_not(brief):
    case = {"length": 0.2, "rod": "uniform", "lasting": "2 s"}
    jump, steps = (length_jumps.run({**case, "change": change}) for change in ("at once", "in steps"))
    assert jump["survived"] == 0 and 0.5 < jump["flown"] < 2.5 and jump["rate_ratio"] > 2.0
    assert steps["survived"] == 1 and steps["flown"] == length_jumps.SECONDS
    assert steps == length_jumps.run({**case, "change": "in steps"})


def test_the_default_weights_pass_the_linear_part_of_their_own_search_and_the_prototype_too():
    default, prototype = weights.cases()[:2]
    control = Params().control
    assert weights._weighted(**{name: default[name] for name in weights.COLUMNS}).control == control
    for case in (default, prototype):
        params = weights._weighted(**{name: case[name] for name in weights.COLUMNS})
        for start in weights.STARTS:
            loop = margins.closed_loop(start, params)
            assert loop.growth_rate < 0.0 and loop.margins.delay > weights.DELAY


def test_weights_that_are_unstable_at_some_start_are_not_flown():
    # unit weights: the rod falls from 1.2 m on
    case = {"candidate": -1, "position": 1.0, "velocity": 1.0, "offset": 1.0, "offset_rate": 1.0, "rate": 1.0}
    case["y_share"] = 1.0
    row = weights.run(case)
    assert row["linear"] == row["passes"] == 0 and row["growth_rate"] > 0.0 and row["delay_margin"] == 0.0
    assert math.isnan(row["starts"]) and math.isnan(row["D1"])


def test_weights_are_judged_by_the_rows_of_the_ledger(monkeypatch):
    monkeypatch.setattr(weights, "START_SECONDS", 1.0)
    monkeypatch.setitem(weights.FLIGHTS, "push-hover", {"duration": 9.0, "pushes": weights.PUSHES[:1]})
    row = weights.run(weights.cases()[0])
    assert row["linear"] == 1 and row["starts"] == 3
    assert row["D1"] == 1 and row["holds_D1"] == 0, "the paper's three pushes are not one"
    assert row["holds_C1"] == row["holds_C2.gain"] == 1 and row["passes"] == 0
    assert 0.02 < row["C1"] < 0.025 and 0.03 < row["D2"] < 0.075
    assert set(row) == set(weights.run({**weights.cases()[0], "offset": 1.0, "offset_rate": 1.0}))


def test_a_variant_of_the_ledger_changes_what_it_says_and_nothing_else():
    heavier = SCENARIOS["circle-0.8"].params.replace(**ledger_seeds.VARIANTS["y heavy"].changes).control
    changed = [a != b for a, b in zip(heavier.state_weights, Params().control.state_weights, strict=True)]
    assert [index for index, differs in enumerate(changed) if differs] == [2, 3]
    default = [case for case in ledger_seeds.cases() if case["variant"] == "default"]
    assert all(sum(case["scenario"] == name for case in default) >= 20 for name in SCENARIOS)


def test_a_seed_of_the_ledger_gives_the_rows_of_its_scenario_and_no_others():
    case = {"variant": "y heavy", "scenario": "circle-0.8", "seed": 4}
    row = ledger_seeds.run(case)
    assert set(ledger_seeds.COLUMNS) | {f"holds_{column}" for column in ledger_seeds.COLUMNS} < set(row)
    measured = {name for name, value in row.items() if math.isfinite(value)}
    judged = {"largest_lean", "x_gain", "x_delay", "y_error"}
    assert measured == {"survived", "flown", "axes"} | judged | {f"holds_{column}" for column in judged}
    assert row["survived"] == 1 and 0.5 < row["axes"] < 1.5, "with the weights of x, y errs as x does"


def test_the_estimators_flight_reports_length_convergence_and_tracking(monkeypatch):
    scenario = SCENARIOS["estimate-1.4"]
    fewer = scenario.params.replace(estimation__generations=4, estimation__population=24, estimation__resolution=1e-3)
    monkeypatch.setitem(
        ledger_seeds.SCENARIOS, "estimate-1.4", dataclasses.replace(scenario, params=fewer, duration=18.0)
    )
    row = ledger_seeds.run({"variant": "every 5 s", "scenario": "estimate-1.4", "seed": 2})
    measured = {name for name, value in row.items() if math.isfinite(value) and not name.startswith("holds_")}
    assert measured == {
        "survived", "flown", "final_length", "final_error", "converged", "late_share", "tracking"
    }  # fmt: skip
    assert row["holds_tracking"] == 1
    assert row["final_length"] == pytest.approx(1.0, abs=0.3)  # few candidates: between the start and the truth
    assert row["tracking"] < 1.0


def test_a_short_rod_flies_on_a_known_seat_and_falls_within_seconds_on_an_unknown_one(monkeypatch):
    monkeypatch.setattr(seat, "SEEDS", (1,))
    case = {"motion": "circle", "length": 0.4, "seat": 0.08}
    known, unknown = (seat.run({**case, "stated": stated}) for stated in (0.08, 0.0))
    # the linear loop of the unknown seat grows by 1.7 1/s, from millimetres of noise in a and 1 mrad of tilt
    assert unknown["survived"] == 0 and unknown["seconds"] < 3.0 and unknown["growth_rate"] > 1.0
    assert known["survived"] == 1 and known["growth_rate"] < 0.0 and known["error"] < 0.1
    assert known == seat.run({**case, "stated": 0.08}), "repeatable"
