"""The study of observers: its cases, one short run of each kind, and what its table and facts make of rows."""

import math

import pytest

from fiplib.studies import observers as study

ROW = {
    "survived": 1, "flown": 26.0, "lean": 0.05, "delay_margin": 0.06, "gain_low": 0.5, "gain_high": 2.5, "rate": 7.0,
    "error": 0.004, "bound": 0.05, "answered": 4, "deviation": 0.017, "length_error": 0.02,
    "answered_seat": 4, "deviation_seat": 0.005, "length_error_seat": 0.004,
}  # fmt: skip


def rows() -> list[dict]:
    """Every case, as if all had flown alike but for lengths from 1.4 m on, with which nobody survives."""
    return [case | ROW | {"survived": int(case["length"] < 1.4)} for case in study.cases()]


def test_every_observer_flies_the_same_cases_and_enough_seeds():
    cases = study.cases()
    assert len(cases) == len({tuple(case.values()) for case in cases}) == 4 * 20 * (2 + 13)
    assert set(cases[0]) == set(study.KEYS)


@pytest.mark.parametrize("flight", study.FLIGHTS)
def test_a_case_says_what_became_of_it(flight, monkeypatch):
    monkeypatch.setattr(study, "WINDOWS", 1)
    row = study.run({"flight": flight, "observer": "Kalman", "length": 1.0, "seed": 3})
    assert set(row) == set(ROW) and row["survived"] == 1
    assert 0.04 < row["lean"] < 0.07 if flight == "pushes" else row["lean"] < 0.02
    if flight == "pushes":
        assert math.isnan(row["rate"]) and math.isnan(row["bound"])
    else:
        assert 0.04 < row["delay_margin"] < 0.1 and row["gain_low"] < 1.0 < row["gain_high"]
        assert 3.0 < row["rate"] < 12.0 and row["answered"] == 1 and 0.0 < row["deviation"] < 0.05


def test_a_length_counts_as_survived_when_most_flights_surely_survive():
    some = rows()
    share, low, high = study.survival(some, "Kalman", 1.0)
    # Wilson's interval of 20 of 20
    assert (share, high) == (1.0, 1.0) and low == pytest.approx(0.839, abs=1e-3)
    assert study.surviving(some, "Kalman") == [length for length in study.LENGTHS if length < 1.4]
    for row in some:
        if row["length"] == 0.4 and row["flight"] == "pushes":
            row["survived"] = int(row["seed"] < 13)  # 13 of 20: the interval reaches from 0.43 to 0.82
    assert study.surviving(some, "Kalman")[0] == 0.5


def test_the_table_has_a_column_for_each_observer_and_facts_name_both():
    table, facts = study.table15_observers(rows()), study.facts(rows())
    assert table.header[1:] == tuple(study.OBSERVED)
    assert all(len(line) == len(table.header) == len(table.alignment) for line in table.rows)
    assert table.rows[0][1] == r"7.0 $\pm$ 0.0" and table.rows[7][:2] == ("Lengths that survive (m)", "0.4--1.3")
    assert facts["Kalman", "longest"] == "1.3" and facts["differentiated", "hover", "bound"] == "50.0"
