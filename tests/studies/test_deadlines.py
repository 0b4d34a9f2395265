"""Which ticks were missed and whose fault it was, on ticks made up for it; and a real flight that is interrupted."""

import importlib.util
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fiplib.reproduction.sources import quantities

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads what Linux counts")

if sys.platform.startswith("linux"):
    spec = importlib.util.spec_from_file_location("bench_deadlines", ROOT / "benchmarks/bench_deadlines.py")
    bench = importlib.util.module_from_spec(spec)
    sys.modules["bench_deadlines"] = bench
    spec.loader.exec_module(bench)

MS = 1_000_000
TICK = 1_000_000_000 // 120
NOBODY = [np.zeros((0, 2), np.int64)] * 2
"""Two cores that never stood still."""


def ticks(count=20, answer=MS):
    """Ticks on time: each is taken when it is due, and its command leaves after ``answer`` ns."""
    made = np.zeros(count, bench.TICK)
    made["due"] = np.arange(count) * TICK
    made["sent"] = made["taken"] = made["due"]
    made["out"] = made["due"] + answer
    return made


def late_by(at, delay, **used):
    """Ticks of which one is answered ``delay`` ns after it was due; what was used between it and the one before."""
    made = ticks()
    made["out"][at] = made["due"][at] + delay
    for name, spent in used.items():
        made[name][at if name in ("answering", "solve") else slice(at, None)] += spent
    return made


def causes(made, stalls=NOBODY, urgent=True):
    return [bench.cause(bench.spent(miss, made, stalls, urgent), TICK) for miss in bench.missed(made, TICK)]


# --- what was missed


def test_ticks_answered_within_a_tick_are_not_missed():
    assert bench.missed(ticks(answer=TICK), TICK) == []


def test_a_tick_answered_later_than_one_tick_is_missed():
    made = late_by(5, TICK + 1)
    assert bench.missed(made, TICK) == [bench.Missed(5 * TICK, 6 * TICK + 1, 4, 5)]


@pytest.mark.parametrize(("frames", "lost"), [(2, 0), (3, 0), (4, 1), (5, 1), (6, 2), (12, 5)])
def test_ticks_without_any_command_are_missed_but_not_those_moved_by_half_a_period(frames, lost):
    made = ticks()
    for name in ("due", "sent", "taken", "out"):
        made[name][8:] += (frames - 2) * TICK // 2
    found = bench.missed(made, TICK)
    assert len(found) == lost
    assert all(miss.answered == 8 and made["due"][7] < miss.due < made["due"][8] for miss in found)


# --- whose fault it was


@pytest.mark.parametrize(
    ("used", "expected"),
    [
        ({"collecting": 15 * MS, "answering": MS, "thread": 16 * MS}, "garbage collection"),
        ({"answering": 19 * MS, "thread": 19 * MS}, "solver"),
        ({"answering": MS, "thread": 18 * MS}, "logging and hand-over"),
        ({"answering": MS, "thread": MS, "view": 17 * MS}, "view"),
        ({"answering": MS, "thread": MS}, "unexplained"),
        ({"answering": MS, "thread": MS, "waiting": 15 * MS}, "machine"),
        ({"answering": MS, "thread": MS, "waiting": 15 * MS, "sender": 15 * MS}, "sender"),
    ],
)
def test_a_missed_tick_is_put_down_to_what_took_its_time(used, expected):
    assert causes(late_by(5, 20 * MS, **used)) == [expected]


def test_a_collection_inside_the_answer_is_not_called_a_slow_solver():
    used = {"collecting": 15 * MS, "answering": 16 * MS, "thread": 16 * MS}
    assert causes(late_by(5, 20 * MS, **used)) == ["garbage collection"]


def test_the_vehicle_is_to_blame_for_frames_that_it_computed_too_long():
    made = late_by(5, 20 * MS, vehicle=19 * MS)
    made["sent"][5] = made["taken"][5] = made["due"][5] + 19 * MS
    assert causes(made) == ["vehicle"]


def test_a_core_that_stood_still_is_the_machines_fault_only_if_it_explains_the_delay():
    made = late_by(5, 20 * MS, answering=19 * MS, thread=19 * MS)
    due = int(made["due"][5])
    long, short = ([np.array([[due + MS, due + MS + stall]]), NOBODY[0]] for stall in (15 * MS, 8 * MS))
    elsewhere = [np.array([[due - 300 * MS, due - 280 * MS]]), NOBODY[0]]
    assert causes(made, long) == ["machine"]  # without it, 5 ms
    assert causes(made, short) == ["solver"]  # without it, still 12 ms
    assert causes(made, elsewhere) == ["solver"]


def test_only_what_is_urgent_can_hold_up_what_is_urgent():
    made = late_by(5, 20 * MS, answering=MS, thread=MS, waiting=16 * MS, estimator=18 * MS)
    assert causes(made, urgent=True) == ["machine"]
    assert causes(made, urgent=False) == ["estimator"]


def test_in_doubt_a_core_that_our_own_processes_kept_busy_did_not_stand_still():
    made = late_by(5, 20 * MS, answering=MS, thread=MS, waiting=16 * MS, estimator=18 * MS)
    still = [np.array([[made["due"][5], made["due"][5] + 17 * MS]]), NOBODY[0]]
    assert causes(made, still, urgent=True) == ["machine"]
    assert causes(made, still, urgent=False) == ["estimator"]


def test_a_tick_lost_after_one_just_in_time_is_put_down_to_what_made_that_one_late():
    made = ticks()
    made["taken"][5] += 7 * MS  # in time, but the pilot's next tick is a tick later
    made["out"][5] += 7 * MS
    for name in ("due", "sent", "taken", "out"):
        made[name][6:] += TICK
    still = [np.array([[made["due"][5], made["due"][5] + 7 * MS]]), NOBODY[0]]
    assert causes(made, still) == ["machine"]
    assert causes(made) == ["unexplained"]


# --- the table


@given(st.lists(st.integers(0, 10**10), max_size=50))
def test_a_distribution_keeps_every_time_in_the_bin_whose_upper_edge_it_does_not_exceed(times):
    counts = bench.histogram(np.array(times, np.int64))
    assert counts.sum() == len(times)
    for bin in range(len(bench.EDGES) - 1):
        assert counts[: bin + 1].sum() == sum(time / 1e3 <= bench.EDGES[bin] for time in times)


def test_the_names_of_bins_tell_their_edges_apart():
    names = list(bench.named("lateness", np.ones(len(bench.EDGES))))
    edges = [float(name.removeprefix("lateness_us_")) for name in names]
    assert len(set(names)) == len(bench.EDGES)
    assert np.allclose(edges, bench.EDGES, rtol=1e-3)  # four digits


def test_a_flight_of_ten_minutes_makes_a_small_table_that_the_figure_can_read(tmp_path):
    made = ticks(72000)
    made["taken"] += np.random.default_rng(0).integers(1, 10**9, len(made))  # every bin is used
    made["out"] = made["taken"] + MS
    values = bench.report([made], Watched(), MACHINE, MACHINE._replace(when=600 * 10**9), TICK)
    bench.save(values, tmp_path / "deadlines.csv")
    assert (tmp_path / "deadlines.csv").stat().st_size < 20_000
    read = quantities(tmp_path / "deadlines.csv")
    assert read.keys() == values.keys()
    assert read["ticks"] == 72000 == sum(count for name, count in read.items() if name.startswith("lateness_us_"))
    assert read["missed"] == read["missed_ours"] + read["missed_machine"] + read["missed_unexplained"]


class Watched:
    """What a watch has seen of two cores that never stood still."""

    urgent, lateness, stalls, spent = True, np.zeros(61, np.int64), NOBODY, 0


MACHINE = bench.Machine(0, 0, 0, 0, 0) if sys.platform.startswith("linux") else None


def test_flights_are_judged_one_by_one():
    values = bench.report(
        [ticks(), late_by(5, 20 * MS, view=20 * MS)], Watched(), MACHINE, MACHINE._replace(when=1), TICK
    )
    assert (values["flights"], values["ticks"], values["missed"], values["missed_view"]) == (2, 40, 1, 1)
    assert "missed 1 (2.5000%): 1 by our own code (1 view), 0 by the machine" in bench.summary(values)


# --- the real thing


def test_the_clock_of_a_process_is_its_processor_time():
    counters = bench.Counters({"vehicle": os.getpid()})
    before = time.process_time_ns()
    sum(range(100_000))
    assert before < counters.processor("vehicle") <= time.process_time_ns()
    assert counters.processor("nobody") == 0
    counters.close()


@pytest.mark.realtime
def test_a_flight_interrupted_in_the_air_reports_and_saves_what_was_flown(tmp_path):
    command = [
        sys.executable,
        ROOT / "benchmarks/bench_deadlines.py",
        "--minutes",
        "5",
        "--save",
        tmp_path / "table.csv",
    ]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as flight:
        for line in flight.stderr:
            # shown every 2 s once it flies; on a busy computer it may coast just then
            if re.match(r"[\d.]+ of [\d.]+ s (flying|coasting|hover only): ", line):
                flight.send_signal(signal.SIGINT)
                break
        said, _ = flight.communicate()
    assert flight.returncode == 130
    found = quantities(tmp_path / "table.csv")
    assert 0 < found["ticks"] < 0.5 * 5 * 60 * 120
    assert found["flights"] == 1
    for kind in ("lateness", "solve", "answer"):
        assert sum(count for name, count in found.items() if name.startswith(f"{kind}_us_")) == found["ticks"]
    assert f"simulated: {found['ticks']:.0f} ticks" in said


@pytest.mark.parametrize("minutes", ["0", "-1", "nan", "inf"])
def test_a_flight_of_no_length_is_refused_in_one_line(minutes, capsys):
    with pytest.raises(SystemExit):
        bench.main(["--minutes", minutes])
    assert f"--minutes {float(minutes):g}: give minutes > 0" in capsys.readouterr().err
