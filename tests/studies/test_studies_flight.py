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

FLAT = {"vehicle__seat_height": 0.0, "piloting__seat_height": 0.0}
"""The vehicle without a raised seat, and a pilot who knows it."""


@pytest.fixture
def flat(monkeypatch):
    """A function that takes the raised seat away from the studies."""

    def take_away() -> None:
        for module in (survival, length_jumps, weights):
            monkeypatch.setattr(module, "Params", lambda: Params().replace(**FLAT))

    return take_away


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


@pytest.mark.parametrize("true, used, raised", [(1.5, 0.2, False), (0.5, 2.0, True), (0.5, 2.0, False)])
def test_a_length_that_the_linear_loop_cannot_bear_falls_within_seconds(brief, monkeypatch, flat, true, used, raised):
    monkeypatch.setattr(survival, "SECONDS", 6.0)
    if not raised:
        flat()
    row = survival.run({"used_length": used, "true_length": true, "rod": "point mass"})
    # grows more than a hundredfold in 6 s, from millimetres
    assert row["growth_rate"] > 0.8
    assert row["survived"] == 0 and row["flown"] < 6.0


def test_on_a_raised_seat_the_fast_oscillation_of_a_far_too_short_length_fells_no_rod(brief, monkeypatch):
    monkeypatch.setattr(survival, "SECONDS", 6.0)
    row = survival.run({"used_length": 0.2, "true_length": 1.5, "rod": "point mass"})
    # 4.8 1/s at 75 rad/s; without the seat 1.3 1/s, and a fall within 2.4 s
    assert row["growth_rate"] > 4.0 and 70.0 < row["frequency"] < 80.0
    # at 12 Hz the bounded rates hardly move the rod: 7 mm of lean; those that fall pass 150 mm
    assert row["survived"] == 1 and row["flown"] == 6.0 and row["largest_lean"] < 0.02


# rad/s; 3.2 and 75 on the seat, 3.5 and 15 without: the ranges leave 6 % or more
@pytest.mark.parametrize("changes, slow, fast", [({}, (3.0, 3.5), (70.0, 80.0)), (FLAT, (3.0, 4.0), (12.0, 18.0))])
def test_a_long_length_fails_slowly_with_or_without_delay_and_a_short_one_fast_and_only_with_it(changes, slow, fast):
    """What docs/studies.md says of the two sides."""
    rod = Params().replace(**changes)
    point = rod.replace(pendulum__gyration_ratio=0.0)
    long, short = (margins.closed_loop(used, params) for used, params in ((2.0, rod), (0.2, point)))
    assert long.growth_rate > 0.0 and slow[0] < long.frequency < slow[1]
    assert short.growth_rate > 0.0 and fast[0] < short.frequency < fast[1]
    prompt = {"simulation__rate_delay": 0.0, "simulation__mocap_latency": 0.0}
    assert margins.closed_loop(2.0, rod.replace(**prompt)).growth_rate > 0.0
    assert margins.closed_loop(0.2, point.replace(**prompt)).growth_rate < 0.0


def _outlier(change: str) -> dict:
    return length_jumps.run({"length": 0.2, "rod": "uniform", "lasting": "2 s", "change": change})


def test_small_steps_survive_an_outlier_that_a_jump_does_not_without_a_raised_seat(brief, flat):
    flat()
    jump, steps = _outlier("at once"), _outlier("in steps")
    assert jump["survived"] == 0 and 0.5 < jump["flown"] < 2.5 and jump["rate_ratio"] > 2.0
    assert steps["survived"] == 1 and steps["flown"] == length_jumps.SECONDS
    assert steps == _outlier("in steps")


def test_on_a_raised_seat_a_jump_survives_the_outlier_too_and_small_steps_save_commands(brief):
    jump, steps = _outlier("at once"), _outlier("in steps")
    for row in (jump, steps):
        assert row["survived"] == 1 and row["flown"] == length_jumps.SECONDS
    # 1.85 and 1.10 here: the commands nearly double for 2 of the 3 s, or hardly change; midway there is 1.5
    assert jump["rate_ratio"] > 1.6 and steps["rate_ratio"] < 1.3
    assert steps == _outlier("in steps")


def test_the_default_weights_pass_the_linear_part_of_their_own_search_only_without_the_seat_and_the_prototype_always():
    default, prototype = weights.cases()[:2]
    control = Params().control
    assert weights._weighted(**{name: default[name] for name in weights.COLUMNS}).control == control
    failed = []
    for case in (default, prototype):
        params = weights._weighted(**{name: case[name] for name in weights.COLUMNS})
        for changes in ({}, FLAT):
            for start in weights.STARTS:
                loop = margins.closed_loop(start, params.replace(**changes))
                if not (loop.growth_rate < 0.0 and loop.margins.delay > weights.DELAY):
                    failed.append((case["candidate"], bool(changes), start, loop.growth_rate))
    # they were chosen before the seat was modelled; with it they fail at l0 = 1.4 m, by a growth of 0.028 1/s
    [(candidate, without, start, growth)] = failed
    assert (candidate, without, start) == (0, False, 1.4)
    assert growth == pytest.approx(0.028, abs=5e-4)  # as rounded in docs/studies.md and here
    row = weights.run(default)
    assert row["linear"] == row["passes"] == 0 and math.isnan(row["starts"]), "so its own search would not fly it"
    assert row["growth_rate"] == pytest.approx(growth, abs=1e-6)  # of all rods and axes the worst; 1e-6: rounding


def test_weights_that_are_unstable_at_some_start_are_not_flown():
    # unit weights: the rod falls from 1.2 m on
    case = {"candidate": -1, "position": 1.0, "velocity": 1.0, "offset": 1.0, "offset_rate": 1.0, "rate": 1.0}
    case["y_share"] = 1.0
    row = weights.run(case)
    assert row["linear"] == row["passes"] == 0 and row["growth_rate"] > 0.0 and row["delay_margin"] == 0.0
    assert math.isnan(row["starts"]) and math.isnan(row["D1"])


# the default is flown without the seat only: with it, the linear part fails; the prototype's set passes that
@pytest.mark.parametrize("candidate, raised", [(0, False), (1, True)])
def test_weights_are_judged_by_the_rows_of_the_ledger(monkeypatch, flat, candidate, raised):
    if not raised:
        flat()
    monkeypatch.setattr(weights, "START_SECONDS", 1.0)
    monkeypatch.setitem(weights.FLIGHTS, "push-hover", {"duration": 9.0, "pushes": weights.PUSHES[:1]})
    case = weights.cases()[candidate]
    row = weights.run(case)
    assert row["linear"] == 1 and row["starts"] == 3
    assert row["D1"] == 1 and row["holds_D1"] == 0, "the paper's three pushes are not one"
    assert row["holds_C1"] == row["holds_C2.gain"] == 1 and row["passes"] == 0
    # 22 or 23 mm, and 55 or 56 mm
    assert 0.02 < row["C1"] < 0.025 and 0.03 < row["D2"] < 0.075
    assert set(row) == set(weights.run({**case, "offset": 1.0, "offset_rate": 1.0}))


def test_a_variant_of_the_ledger_changes_what_it_says_and_nothing_else():
    heavier = SCENARIOS["circle-0.8"].params.replace(**ledger_seeds.VARIANTS["y heavy"].changes).control
    changed = [a != b for a, b in zip(heavier.state_weights, Params().control.state_weights, strict=True)]
    assert [index for index, differs in enumerate(changed) if differs] == [2, 3]
    default = [case for case in ledger_seeds.cases() if case["variant"] == "default"]
    assert all(sum(case["scenario"] == name for case in default) >= 20 for name in SCENARIOS)


def test_flights_from_different_first_lengths_share_no_seed_and_pairs_share_theirs():
    def seeds(variant: str, scenario: str) -> set[int]:
        return {c["seed"] for c in ledger_seeds.cases() if (c["variant"], c["scenario"]) == (variant, scenario)}

    first, second, third = (seeds("default", scenario) for scenario in ledger_seeds.STARTS)
    assert not (first & second or second & third or first & third)
    assert seeds("hover", "estimate-1.2") < second
    assert seeds("swaying", "circle-0.8") == seeds("massless", "circle-0.8") < seeds("default", "circle-0.8")
    assert seeds("standing", "length-jump") == seeds("standing in steps", "length-jump")


def test_a_seed_of_the_ledger_gives_the_numbers_of_its_scenario_and_no_others():
    row = ledger_seeds.run({"variant": "y heavy", "scenario": "circle-0.8", "seed": 4})
    assert set(ledger_seeds.COLUMNS) < set(row)
    measured = {name for name, value in row.items() if math.isfinite(value)}
    assert measured == {"survived", "flown", "circle_lean", "x_gain", "x_delay", "y_error"}
    assert row["survived"] == 1 and row["y_error"] < 0.1, "with the weights of x, y errs as x does"


def test_a_swaying_vehicle_moves_in_height_and_yaw_and_the_rod_stays_up():
    row = ledger_seeds.run({"variant": "swaying", "scenario": "circle-0.8", "seed": 1})
    # 20 % of the thrust at half a hertz: 0.2 g / (pi)^2 = 0.2 m, less what the altitude loop takes off
    assert row["survived"] == 1 and 0.1 < row["height_sway"] < 0.2
    assert 3.0 < row["yaw_sway"] < 7.0  # deg; 0.35 rad/s at half a hertz are 6.4 without the loop


def test_a_wrong_length_of_two_seconds_is_survived_and_one_that_stays_is_not():
    outlier, standing = (
        ledger_seeds.run({"variant": variant, "scenario": "length-jump", "seed": 1})
        for variant in ("outlier", "standing")
    )
    assert (outlier["survived"], standing["survived"]) == (1, 0)
    assert outlier["flown"] == 21.0 and 6.0 < standing["flown"] < 21.0


def test_the_estimators_flight_reports_length_convergence_and_fluctuation(monkeypatch):
    scenario = SCENARIOS["estimate-1.4"]
    fewer = scenario.params.replace(estimation__generations=4, estimation__population=24, estimation__resolution=1e-3)
    monkeypatch.setitem(
        ledger_seeds.SCENARIOS, "estimate-1.4", dataclasses.replace(scenario, params=fewer, duration=18.0)
    )
    row = ledger_seeds.run({"variant": "every 5 s", "scenario": "estimate-1.4", "seed": 2})
    measured = {name for name, value in row.items() if math.isfinite(value)}
    names = {"final_length", "converged", "late_share", "fluctuation", "estimate_error"}
    assert measured == {"survived", "flown"} | names
    assert row["final_length"] == pytest.approx(1.0, abs=0.3)  # few candidates: between the start and the truth
    assert 0.0 < row["estimate_error"] < 0.3


def test_a_short_rod_flies_on_a_known_seat_and_falls_within_seconds_on_an_unknown_one(monkeypatch):
    monkeypatch.setattr(seat, "SEEDS", (1,))
    case = {"motion": "circle", "length": 0.4, "seat": 0.08}
    known, unknown = (seat.run({**case, "stated": stated}) for stated in (0.08, 0.0))
    # the linear loop of the unknown seat grows by 1.7 1/s, from millimetres of noise in a and 1 mrad of tilt
    assert unknown["survived"] == 0 and unknown["seconds"] < 3.0 and unknown["growth_rate"] > 1.0
    assert known["survived"] == 1 and known["growth_rate"] < 0.0 and known["error"] < 0.1
    again = seat.run({**case, "stated": 0.08})
    assert again == pytest.approx(known, rel=0, abs=0, nan_ok=True), "repeatable"
