"""The study of excitation: its cases, a flight of it, the design, and what its table, figure and facts make of rows."""

import math
from dataclasses import replace

import pytest

from fiplib.studies import excitation as study


def rows() -> list[dict]:
    """Every case, as if a designed flight knew its length a second sooner than others and hover never to 5 mm."""
    found = []
    for case in study.cases():
        late = 0.0 if "designed" in case["excitation"] else 1.0
        row = {
            "survived": 1, "flown": 12.0, "lean": 0.02 + 1e-4 * case["seed"], "within": 1.0, "rate": 0.4,
            "fastest": 1.0, "tracking": 0.1, "away": 0.2, "reached_20": 1.0 + late, "reached_10": 1.5 + late,
            "reached_5": math.nan if case["excitation"] == "hover" else 2.0 + late,
        }  # fmt: skip
        if case["estimator"] == "ga":
            row |= dict.fromkeys(("reached_20", "reached_10", "reached_5"), math.nan)
        for time in study.TIMES:
            sign = 1 if case["seed"] % 2 else -1
            known = time > 0.9 and (case["estimator"] == "poses" or time > 5.5)
            row |= {f"deviation_{time:g}": 0.01 / time if known else math.nan}
            row |= {f"error_{time:g}": sign * 0.012 / time if known else math.nan}
            row |= {f"bound_{time:g}": 0.009 / time if time <= study.BOUND_SECONDS else math.nan}
            row |= {f"lean_{time:g}": 0.01, f"x_{time:g}": 0.1 * time, f"y_{time:g}": 0.0}
        found.append(case | row)
    return found


def test_the_paper_s_estimator_flies_every_trajectory_that_it_does_not_end():
    cases = study.cases()
    assert len(cases) == len({tuple(case.values()) for case in cases}) == 20 * (10 + 4)
    assert set(cases[0]) == set(study.KEYS)
    flown = {case["excitation"] for case in cases if case["estimator"] == "ga"}
    assert flown == set(study.TO_THE_END)


def test_a_flight_ends_its_excitation_and_states_what_the_bound_allows():
    row = study.run({"excitation": "designed, until known", "estimator": "poses", "seed": 0})
    assert set(row) == set(rows()[0]) - set(study.KEYS)
    assert row["survived"] == 1 and row["lean"] < study.LEAN and row["within"] == 1.0
    assert row["reached_20"] <= row["reached_10"] < row["reached_5"]
    assert row["away"] < 0.1, "it hovers again"
    for time in (1.4, 2.0, 4.0):
        # an answer is of poses up to 0.1 s before; the estimator also fits the noise, which the bound knows
        earlier = row[f"bound_{time - 0.2:g}"] if time < 3.0 else row[f"bound_{time:g}"]
        assert 0.9 * row[f"bound_{time:g}"] < row[f"deviation_{time:g}"] < 1.25 * earlier
        assert abs(row[f"error_{time:g}"]) < 4.0 * row[f"deviation_{time:g}"]


def test_the_design_is_sooner_than_the_circle_and_keeps_lean_and_room():
    designed, found, circle = (
        study.tried(one) for one in (study.DESIGNED, study.FOUND, study.EXCITATIONS["circle 0.8 m / 9 s"].reference)
    )
    assert study.time_of(found.flight) < study.time_of(designed.flight) < study.time_of(circle.flight) - 0.2
    # what the search scales to
    assert found.lean == pytest.approx(study.LEAN - study.MARGIN, rel=0.02)
    assert designed.lean.max() < found.lean.max() < circle.lean.max() and designed.reach.max() <= study.REACH
    # hover has not reached it after 2 s: the time goes on with the bound
    still = replace(study.DESIGNED, x=(0.0,) * 4, y=(0.0,) * 4)
    assert study.time_of(study.tried(still).flight) > study.DESIGN_SECONDS


def test_the_design_is_what_was_found_scaled_until_no_noise_leans_too_far():
    assert study.finished(study.FOUND) == study.DESIGNED


def test_a_shape_is_scaled_to_the_lean_along_both_axes():
    first = study.shape((0.2, 0.7, 0.3, 0.0, 0.0, 0.4))
    # the second harmonic has 0.4 Hz; an acceleration of 0.4 m/s^2 in all
    assert first.x == pytest.approx((0.24 / 1.257**2, 0.0, 0.0, 0.32 / 2.513**2), rel=1e-3) and first.y == first.x
    found = study.scaled(first)
    # two steps: noise is part of the lean and does not grow with it
    assert found.lean == pytest.approx(study.LEAN - study.MARGIN, rel=0.05)
    assert found.reference.x[3] / found.reference.x[0] == pytest.approx(first.x[3] / first.x[0], rel=1e-2)
    assert found.reference.y[0] > found.reference.x[0], "y has the lighter weights"


def test_the_search_is_the_same_for_the_same_seed(monkeypatch):
    monkeypatch.setattr(study, "cost", lambda parameters, wanted: abs(parameters[0] - 0.3) + abs(parameters[1] - 0.5))
    monkeypatch.setattr(study, "scaled", lambda shape: study.Tried(shape, None, None, None))
    found = study.design(generations=30)
    assert found == study.design(generations=30) != study.design(generations=30, seed=1)
    # 30 generations of 24 members bring two of six parameters within a hundredth
    assert found.frequency == pytest.approx(0.3, abs=0.01) and found.ramp == pytest.approx(0.5, abs=0.01)


def test_what_is_gained_comes_from_the_same_seeds():
    some = rows()
    assert study.gain(some, "designed", "circle 0.4 m / 8 s", "10") == pytest.approx((1.0, 1.0, 1.0))
    # what is never reached counts as the whole flight
    assert study.gain(some, "designed", "hover", "5").value == pytest.approx(study.SECONDS - 2.0)
    assert study.rms_error(some, "designed", "poses", 2.0) == pytest.approx(0.006)
    assert math.isnan(study.stated(some, "designed", "ga", 2.0))


def test_the_table_has_a_line_for_each_trajectory_and_estimator_and_facts_state_the_gain():
    some = rows()
    table, facts = study.table20_excitation(some), study.facts(some)
    assert len(table.rows) == 10 + 4
    assert all(len(line) == len(table.header) == len(table.alignment) for line in table.rows)
    assert table.rows[0][4] == "--" and table.rows[0][2] == "2.00 (2.00 to 2.00)"
    assert facts["hover", "five", "gain"] == "10.00" and facts["designed", "lean"] == "2.19"
    assert len(study.fig22_excitation(some).axes) == 3
