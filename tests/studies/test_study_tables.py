"""The tables of the studies count, average and leave out what they say."""

import math

import pytest

from fiplib import studies
from fiplib.studies import benchmarks, estimators, handover, imperfections, ledger_seeds, poses, seat, weights
from fiplib.studies.imperfections import IMPERFECTIONS


def handover_rows() -> list[dict]:
    """Four flights: told loses the last; printed loses two more; trusted keeps all that telling keeps.

    The same again with shorter and longer rods, where literal was not flown.
    """
    rows, outcomes = [], [(1, 1, 1), (1, 0, 1), (1, 0, 1), (0, 0, 0)]
    for index, (told, printed, trusted) in enumerate([*outcomes, *outcomes]):
        index += (handover.EXPECTED - 4) * (index >= 4)
        policies = (
            ("told", told),
            ("printed", printed),
            ("short", printed),
            ("trusted", trusted),
            ("literal", printed),
        )
        for policy, up in policies[: 4 if index >= handover.EXPECTED else 5]:
            settled = 1.0 + index if up else math.nan
            rows.append({"policy": policy, "index": index, "survived": up, "settled": settled, "longest_used": 1.1})
    return rows


def test_a_policy_is_held_against_the_flights_that_telling_the_length_keeps_up():
    trusted, printed = (handover.handed_over(handover_rows(), policy) for policy in ("trusted", "printed"))
    assert (trusted.flights, trusted.up, trusted.kept, trusted.right) == (4, 3, 1.0, 1.0)
    assert trusted.mean_time == 2.0 and trusted.longest == 1.1
    assert (printed.up, printed.kept) == (1, 1 / 3)
    # one of three: the exact binomial interval from 1 - 0.975^(1/3) on
    assert printed.low == pytest.approx(1 - 0.975 ** (1 / 3)) and trusted.high == 1.0
    assert trusted.low == pytest.approx(0.025 ** (1 / 3))
    longer = handover.handed_over(handover_rows(), "trusted", "longer")
    assert (longer.flights, longer.up) == (2, 1)
    assert handover.facts(handover_rows())["short", "outside", "flights"] == "4"


def test_times_of_the_hand_over_have_an_interval_from_six_flights_on():
    def late(count: int) -> tuple[str, ...]:
        told = [{"policy": "told", "index": index, "survived": 1.0, "settled": 0.0} for index in range(count)]
        flown = [row | {"policy": "trusted", "settled": 1.0 + row["index"] % 2} for row in told]
        return handover.table8_handover([row | {"longest_used": 1.0} for row in told + flown]).rows[1][6:8]

    assert late(5) == ("1.40", "2.00")
    assert late(6) == ("1.50 (1.17 to 1.83)", "2.00 (2.00 to --)")
    # 0.95^72 is the first power below 2.5 %: from here on the largest of all times bounds the quantile
    assert late(71)[1].endswith("to --)") and late(72)[1].endswith("to 2.00)")


def test_the_hand_over_table_has_a_line_for_each_policy_and_no_times_for_the_told_one():
    table = handover.table8_handover(handover_rows())
    assert list(dict.fromkeys(row[0] for row in table.rows)) == list(handover.LABELS.values())
    assert [row[1] for row in table.rows] == [*list(handover.RODS.values()) * 4, handover.RODS["expected"]]
    assert table.rows[0][4:8] == ("--",) * 4
    assert table.rows[3][1:6] == ("0.5 to 1.5", "4", "3", "100 (29 to 100)", "100 (29 to 100)")


def seeds_row(scenario: str, survived: int = 1, **values: float) -> dict:
    columns = dict.fromkeys(ledger_seeds.COLUMNS, math.nan)
    return {"variant": "default", "scenario": scenario, "survived": survived, **columns, **values}


def test_the_seeds_table_has_median_spread_and_the_flights_that_agree():
    rows = [seeds_row("push-hover", push_lean=lean, kept=3.0) for lean in (0.05, 0.055, 0.06, 0.065, 0.07, 0.08)]
    rows.append(seeds_row("push-hover", survived=0))
    lines = {row[0]: row[1:] for row in ledger_seeds.table5_seeds(rows).rows}
    # of six values the interval of the median is from the least to the most; the seventh flight fell
    assert lines["D2"] == ("0.058", "0.062", "0.050 to 0.080", "0.050", "0.080", "m", "7", "5 (0.29 to 0.96)")
    assert lines["D1"][-2:] == ("7", "6 (0.42 to 1.00)")
    assert lines["C1"][1:5] == ("--",) * 4 and lines["C1"][-2:] == ("0", "--")


def test_the_seeds_table_is_in_the_order_of_the_ledger():
    names = [row[0] for row in ledger_seeds.table5_seeds([]).rows]
    assert names[:4] == ["D1", "D2", "D3", "D4"] and names[-1] == "G7"
    assert not {"M3", "G6.fatal", "R1.ga"} & set(names), "what is no number of one flight stands in the ledger only"


def test_the_table_of_interpretations_has_the_default_first_and_both_starts():
    flown = [{"final_length": length, "fluctuation": 0.02} for length in (0.98, 1.0, 1.04)]
    default = [seeds_row(scenario, **values) for scenario in ledger_seeds.STARTS for values in flown]
    readings = [row | {"variant": "every 5 s"} for row in default if row["scenario"] == "estimate-0.8"]
    rows = ledger_seeds.table6_readings(default, readings).rows
    assert [row[:2] for row in rows] == [(name, l0) for name in ("default", "every 5 s") for l0 in ("0.8", "1.4")]
    assert rows[0][2:5] == ("3", "3", "1.000") and rows[0][6:8] == ("0.026", "0.020")
    assert rows[0][8].startswith("2 (") and rows[3][2] == "0"


def test_the_weights_table_counts_conditions_alone_and_together():
    flags = {f"holds_{id}": 1 for id in ("D1", "D2", "D3", "C1", "C2.gain")}
    rows = [
        {"y_share": 1.0, "linear": 1, "starts": 3, "passes": 1, **flags, "holds_C2.delay": 0, "holds_C2.y": 0},
        {"y_share": 1.0, "linear": 0, "starts": math.nan, "passes": 0, "holds_C2.delay": math.nan, "holds_C2.y": 1}
        | dict.fromkeys(flags, math.nan),
        {"y_share": 0.1, "linear": 1, "starts": 3, "passes": 1, **flags, "holds_C2.delay": 0, "holds_C2.y": 1},
    ]
    counts = {row[0]: row[1:] for row in weights.table7_weights(rows).rows}
    assert counts["linear loop stable, every start"] == ("1", "1")
    assert counts["C2.y holds"] == ("1", "1") and counts["C2.y and C2.gain"] == ("0", "1")
    assert counts["all but C2.delay"] == ("0", "1")


def test_pooling_weighs_flights_by_their_windows():
    rows = [
        {"n_ga": 1, "bias_ga": 0.3, "rms_ga": 0.3, "bound_ga": 0.1, "covered_ga": math.nan},
        {"n_ga": 3, "bias_ga": -0.1, "rms_ga": 0.1, "bound_ga": 0.1, "covered_ga": math.nan},
        {"n_ga": 0, "bias_ga": math.nan, "rms_ga": math.nan, "bound_ga": math.nan, "covered_ga": math.nan},
    ]
    found = estimators.pooled(rows, "ga")
    assert found.windows == 4 and found.bias == pytest.approx(0.0, abs=1e-15)  # rounding of 0.3 - 3 * 0.1
    assert found.rms == pytest.approx(math.sqrt((0.09 + 0.03) / 4)) and math.isnan(found.covered)


def test_the_rates_table_says_what_is_measured_and_what_extrapolated():
    rates = {
        "rate_1_worker_per_s": 2.0, "rate_2_workers_per_s": 3.6, "extrapolated_cores": 100.0,
        "flight_duration_s": 10.0, "extrapolated_hours": 1.39,
    }  # fmt: skip
    lines = benchmarks.table10_rates(rates).rows
    assert lines[1] == ("2", "3.60", "36", "1.80", "measured")
    assert lines[2] == ("100", "200", "2000", "100.00", "extrapolated: 1.4 h for a million")


def test_an_interval_of_a_pooled_error_comes_from_drawing_whole_flights():
    rows = [{"n_ga": 3, "rms_ga": 0.01, "bound_ga": 0.002}, {"n_ga": 1, "rms_ga": 0.03, "bound_ga": 0.002}]
    value, low, high = estimators.ratio(rows, "ga")
    assert value == pytest.approx(math.sqrt((3 * 0.01**2 + 0.03**2) / 4) / 0.002)
    # of two flights either is drawn twice in a quarter of all draws
    assert (low, high) == pytest.approx((5.0, 15.0))
    # no interval of zero width where all windows count: Wilson's, n / (n + z^2)
    assert estimators.interval([4, 4], [4, 4]) == pytest.approx((1.0, 8 / (8 + 1.959964**2), 1.0))


def imperfect_row(name: str, **values: float) -> dict:
    columns = {"n": 6, "refused": 0, "bias": 0.0, "rms": 0.004, "covered": 6}
    estimators = ("ga", "poses")
    made = {f"{column}_{one}": value for one in estimators for column, value in columns.items()}
    return {"imperfection": name, **made, **values}


def test_the_table_of_imperfections_says_how_many_windows_were_answered_and_how_well():
    refused = {f"{column}_poses": math.nan for column in ("bias", "rms", "covered")} | {
        "n_poses": 0,
        "refused_poses": 6,
    }
    half = {"n_poses": 3, "refused_poses": 3, "covered_poses": 2}
    rows = [imperfect_row(name, **(refused if name == "all of them" else half)) for name in IMPERFECTIONS]
    lines = {row[0]: row[1:] for row in imperfections.table11_imperfections(rows).rows}
    assert next(iter(lines)) == "none" and len(lines) == len(IMPERFECTIONS)
    # one flight, which is all that a bootstrap can draw
    assert lines["none"] == ("4 (4 to 4)", "50", "4.0 (4.0 to 4.0)", "67 (67 to 67)")
    assert lines["all of them"] == ("4 (4 to 4)", "0", "--", "--")
    found = imperfections.facts(rows)
    assert found["all", "poses", "answered"] == "0"
    assert ("all", "poses", "rms") not in found


def pose_rows() -> list[dict]:
    """Two flights a condition: both answered; where something wrong is stated, both refused."""
    none = {"n": 0, "refused": 4} | dict.fromkeys(("bias", "rms", "worst", "covered", "sd", "bound"), math.nan)
    rows = []
    for name, condition in poses.CONDITIONS.items():
        for seed, (covered, bias) in enumerate([(4, 0.001), (3, -0.003)]):
            given = {"n": 4, "refused": 0, "bias": bias, "rms": 0.006, "covered": covered, "sd": 0.005}
            row = none if condition.group == "wrong" else given | {"bound": 0.005 if condition.bound else math.nan}
            rows.append({"condition": name, "seed": seed} | row)
    return rows


def test_the_table_of_coverage_pools_windows_and_gives_an_interval_of_the_share():
    rows = pose_rows()
    lines = {row[0]: row[1:] for row in poses.table13_coverage(rows).rows}
    assert len(lines) == len(poses.CONDITIONS)
    # of two flights the bootstrap draws either twice in half of all draws
    assert lines["circle 0.4 m / 8 s"] == (
        "8",
        "0",
        r"$-$1.0 ($-$3.0 to 1.0)",
        "6.0 (6.0 to 6.0)",
        "5.0",
        "88 (75 to 100)",
        "1.20",
    )
    assert lines["noise doubled"][-1] == "--"
    assert lines["seat stated 0, is 8 cm"] == ("0", "100", "--", "--", "--", "--", "--")
    found = poses.facts(rows)
    assert found["ratio",] == "1.20" and found["covered",] == "88"
    assert found["wrong", "refused"] == "100" and found["untold", "least"] == "88"
    assert ("wrong", "least") not in found


def test_every_condition_of_the_pose_estimator_is_drawn_with_its_share():
    figure = poses.fig16_coverage(pose_rows())
    left, right = figure.axes
    assert [text.get_text() for text in left.get_yticklabels()] == list(poses.CONDITIONS)
    widths = [bar.get_width() for bar in right.patches]
    assert widths == [100.0 if one.group == "wrong" else 0.0 for one in poses.CONDITIONS.values()]


def test_a_study_that_is_not_complete_has_no_facts(tmp_path):
    assert studies.facts(tmp_path) == {}


def test_the_table_of_the_seat_counts_who_stays_up_with_an_exact_interval():
    result = {"flown": 20.0, "seconds": 20.0, "error": 0.05, "largest_lean": 0.02, "rate": 0.5}
    result |= {f"{name}{end}": result[name] for name in ("error", "largest_lean", "rate") for end in ("_low", "_high")}
    margins = {"growth_rate": -1.0, "gain_high": 2.0}
    rows = [{**case, **result, **margins, "survived": 20.0 if case["stated"] else 0.0} for case in seat.cases()]
    # all of 20: the lower limit p of the exact interval has p^20 = 2.5 %
    assert seat.survival(rows[1]) == (0.0, 0.0, pytest.approx(1 - 0.025 ** (1 / 20)))
    table = seat.table14_seat(rows)
    assert len(table.rows) == len(seat.LENGTHS) * (1 + len(seat.STATED))
    assert table.rows[1][:4] == ("0.4", "8", "0", "0 (0 to 17)") and table.rows[2][3] == "20 (83 to 100)"
    assert table.rows[2][4] == "5.0 (5.0 to 5.0)"
    rows[2] |= {"error_low": math.nan, "error_high": math.nan, "rate": math.nan}
    # of fewer than six flights a median has no interval, of none no value
    assert seat.table14_seat(rows).rows[2][4:7] == ("5.0", "2.0 (2.0 to 2.0)", "--")
    found = seat.facts(rows)
    assert found["shortest", "known", "up"] == "40" and found["middle", "unknown", "up"] == "0"
    assert seat.fig17_seat(rows).axes
