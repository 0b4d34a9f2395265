"""The harness: contenders agree first, take turns, and one that is missing or wrong is named and stops nothing."""

import csv
import math

import numpy as np
import pytest

from benchmarks import harness
from benchmarks.harness import Absent, Contender, Row, compare, interleaved, load, needs, save


def twice(value: float) -> float:
    return 2.0 * value


def test_a_rival_that_is_not_installed_is_named_and_the_others_are_measured():
    def missing() -> Contender:
        needs("a_solver_that_nobody_wrote")
        raise AssertionError

    rows = compare("topic", "work", Contender(twice), {"ghost": missing, "same": lambda: Contender(twice)}, [1.0, 2.0])
    assert {row.contender: row.calls for row in rows} == {"fip": 2, "same": 2, "ghost": 0}
    assert rows[-1].remark == "not installed: a_solver_that_nobody_wrote" and not rows[-1].agrees


def test_a_rival_whose_answers_differ_does_not_agree_but_is_shown_with_its_difference():
    rows = compare("topic", "work", Contender(twice), {"off": lambda: Contender(lambda x: 2.0 * x + 1e-3)}, [1.0, 2.0])
    assert rows[1].agrees == 0 and rows[1].difference == pytest.approx(1e-3)
    rows = compare("topic", "work", Contender(twice), {"nan": lambda: Contender(lambda x: math.nan)}, [1.0])
    assert rows[1].agrees == 0 and rows[1].difference == math.inf


def test_a_rival_that_fails_or_answers_in_another_shape_stops_nothing():
    def fails(_: float) -> float:
        raise RuntimeError("no solution\nand a long trace")

    rivals = {"fails": lambda: Contender(fails), "wide": lambda: Contender(lambda x: np.zeros(3))}
    rows = compare("topic", "work", Contender(twice), rivals, [1.0])
    assert [row.calls for row in rows] == [1, 0, 0]
    assert rows[1].remark == "failed: RuntimeError: no solution"
    assert rows[2].remark.startswith("failed: ValueError: answer of shape (3,)")


def test_our_own_failure_is_not_hidden():
    def fails(_: float) -> float:
        raise RuntimeError("ours")

    with pytest.raises(RuntimeError, match="ours"):
        compare("topic", "work", Contender(fails), {}, [1.0])


def test_contenders_take_turns_in_blocks_and_a_slow_one_gets_blocks_spread_over_all_arguments():
    order: list[tuple[str, int]] = []
    calls = {name: lambda x, name=name: order.append((name, x)) for name in ("fip", "quick", "slow")}
    found = interleaved(calls, range(24), {"fip": 0.0, "quick": 0.0, "slow": 1.0}, budget=14.0, block=4)
    assert sorted(found["fip"]) == sorted(found["quick"]) == list(range(24))
    assert sorted(found["slow"]) == [0, 1, 2, 3, 12, 13, 14, 15]
    turns = [name for i, (name, _) in enumerate(order) if i == 0 or order[i - 1][0] != name]
    assert turns[:4] == ["fip", "quick", "slow", "quick"]  # the order rotates; quick came last and comes first
    assert order.count(("fip", 0)) == 2 and order.count(("fip", 1)) == 1  # one call ahead of a block is not counted


def test_ratios_compare_the_same_arguments():
    clock = iter(range(10**9))

    class Counting:
        @staticmethod
        def process_time_ns() -> int:
            return next(clock) * 1000

        process_time = staticmethod(lambda: 0.0)

    original, harness.time = harness.time, Counting
    try:
        rows = compare("topic", "work", Contender(twice), {"same": lambda: Contender(twice)}, [1.0, 2.0, 3.0])
    finally:
        harness.time = original
    assert [row.ratio for row in rows] == [1.0, 1.0] and [row.p50_us for row in rows] == [1.0, 1.0]


def test_results_keep_the_rows_of_other_topics_and_name_the_machine_once(tmp_path):
    path = tmp_path / "results.csv"
    row = Row("mpc", "circle", "fip", 1.0, 9.0, 11.0, 100, 0.0, 1)
    save("mpc", [row], path)
    save("bags", [Row("bags", "reading", "fip", 1.0, 9.0, 11.0, 100, 0.0, 1, "a, comma")], path)
    save("mpc", [row, Row("mpc", "circle", "PIQP", 80.0, 720.0, 900.0, 50, 1e-9, 1)], path)
    rows = load(path)
    assert [(row["topic"], row["contender"]) for row in rows if row["topic"] != "machine"] == [
        ("bags", "fip"), ("mpc", "fip"), ("mpc", "PIQP"),
    ]  # fmt: skip
    assert [row["topic"] for row in rows].count("machine") == 1
    assert "Python" in next(row["contender"] for row in rows if row["topic"] == "machine")
    with path.open(newline="") as file:
        assert next(csv.reader(file)) == list(harness.COLUMNS)


def test_absent_is_an_ordinary_exception_with_its_reason():
    with pytest.raises(Absent, match="not installed: nothing_of_this_name"):
        needs("nothing_of_this_name.inside")
