"""The study of the field: its cases, one short flight of each kind, and what figure, table and facts make of rows."""

import math

import pytest

from fiplib.controllers import CONTROLLERS
from fiplib.estimators.handover import TrustedHandOver
from fiplib.params import Params
from fiplib.studies import field as study

ROW = {
    "survived": 1, "hovered": 1, "flown": 12.0, "lean": 0.05, "settled": 2.0, "rate": 26.0, "error": 0.1, "sunk": 0.01,
}  # fmt: skip


def rows() -> list[dict]:
    """Every case, as if all had flown alike but for lengths from 1.3 m on, with which nobody survives the push."""
    fallen = {"survived": 0, "flown": 9.0, **dict.fromkeys(study.SCORES, math.nan)}
    return [case | ROW | (fallen if case["length"] >= 1.3 else {}) for case in study.cases()]


def test_every_controller_of_the_registry_is_in_the_field_and_flies_the_same_cases():
    named = {changes.get("piloting__controller", "mpc") for _, changes in study.FIELD.values()}
    assert named == set(CONTROLLERS) - {"lqr_circle"}  # the outside check's; off a circle it is "lqr"
    cases = study.cases()
    assert len(cases) == len({tuple(case.values()) for case in cases})
    flown = {
        name: [(case["flight"], case["length"], case["seed"]) for case in cases if case["controller"] == name]
        for name in study.FIELD
    }
    assert len(flown["mpc"]) == 20 * (len(study.LENGTHS) + 5)
    fewer = {"nonlinear_mpc", "adaptive_mpc"}
    assert all(set(flown[name]) < set(flown["mpc"]) for name in fewer)
    assert all(found == flown["mpc"] for name, found in flown.items() if name not in fewer)
    assert [length for flight, length, seed in flown["adaptive_mpc"] if (flight, seed) == ("pushed", 0)] == [
        1,
        1.6,
        1.8,
    ]


def test_a_first_length_among_the_rods_to_expect_changes_nothing_for_the_adaptive_mpc():
    for length in study.LENGTHS:
        stands_for = study.flown_with("adaptive_mpc", length)
        one, other = (
            TrustedHandOver(Params().replace(piloting__initial_length=value)) for value in (length, stands_for)
        )
        assert (one.used, *one.believed) == (other.used, *other.believed)
    assert study.flown_with("mpc", 1.3) == 1.3


@pytest.mark.parametrize("flight", study.FLIGHTS)
def test_a_case_says_what_became_of_it(flight):
    row = study.run({"controller": "mpc", "flight": flight, "length": 1.0, "seed": 3})
    assert set(row) == set(ROW) and row["survived"] == row["hovered"] == 1
    assert 20.0 < row["rate"] < 32.0 and 0.0 < row["error"] < 0.35
    pushed = flight in ("pushed", "seat")
    assert math.isnan(row["settled"]) != (pushed and row["settled"] >= 0.0)
    low, high = {"pushed": (0.04, 0.07), "seat": (0.03, 0.08), "wind": (0.02, 0.06)}.get(flight, (0.0, 0.07))
    assert low < row["lean"] < high
    # the twentieth of the thrust costs centimetres; a seat that the pilot does not know, none in the true height
    assert (0.02 < row["sunk"] < 0.06) if flight == "rotor" else row["sunk"] < 0.02


def test_a_flight_that_falls_has_no_scores_and_says_whether_the_push_was_met():
    row = study.run({"controller": "lqr", "flight": "pushed", "length": 1.6, "seed": 1})
    assert row["survived"] == 0 and row["hovered"] == int(row["flown"] >= study.PUSHED)
    assert all(math.isnan(row[name]) for name in study.SCORES)


def test_shares_have_the_exact_interval_and_means_that_of_the_bootstrap():
    some = rows()
    up, count, low, high = study.share(some, "mpc", "pushed", 1.0)
    assert (up, count, high) == (20, 20, 1.0) and low == pytest.approx(0.025 ** (1 / 20))  # of all of n: the n-th root
    assert study.surviving(some, "mpc") == [length for length in study.LENGTHS if length < 1.3]
    assert study.surviving(some, "mpc", "hovered") == list(study.LENGTHS)
    for row in some:
        row["rate"] = 20.0 + row["seed"] % 2
    value, low, high = study.mean(some, "mpc", "pushed", "rate")
    # a mean of 20 coins has a standard deviation of 0.5 / sqrt(20), and is a multiple of 0.05
    assert value == pytest.approx(20.5) and high - low == pytest.approx(2 * 1.96 * 0.5 / math.sqrt(20), abs=0.1)
    assert all(math.isnan(one) for one in study.mean([], "mpc", "pushed", "rate"))


def test_the_table_has_a_column_for_each_controller_and_times_where_they_were_measured():
    table = study.table18_field(rows(), {"mpc_p50_us": 14.0, "mpc_p99_us": 95.0})
    assert all(len(line) == len(table.header) == len(table.alignment) == 1 + len(study.FIELD) for line in table.rows)
    lines = {line[0]: line[1:] for line in table.rows}
    at = list(study.FIELD).index("mpc")
    assert lines["Lengths up, hover 8 s (m)"][at] == "0.6--1.8"
    assert lines["And after a push (m)"][at] == "0.6--1.2"
    assert lines["Up, wind"][at] == "20/20" and lines["RMS rates in hover (deg/s)"][at] == r"26.0 $\pm$ 0.0"
    assert lines["A tick, p50 (us)"][at] == "14" and lines["A tick, p50 (us)"][0] == "--"


def test_the_figure_shows_every_share_and_facts_are_words_and_numbers():
    figure = study.fig21_field(rows())
    shown = [text.get_text() for axes in figure.axes for text in axes.texts]
    expected = {name: ["100"] * 5 + ["0"] * 5 for name in study.FIELD}
    expected["adaptive_mpc"] = ["100"] * 8 + ["0"] * 2  # up to 1.5 m the flight with 1 m stands for the others
    expected["nonlinear_mpc"] = ["", "", "100", "", "", "", "0", "", "0", ""]  # three lengths
    assert shown == [word for words in expected.values() for word in words]
    facts = study.facts(rows())
    assert facts["mpc", "longest"] == "1.2" and facts["mpc", "pushed", "rate"] == "26.0"
