"""The length of a recorded flight: whole or in parts, its windows, and how its interval shrank."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import fiplib as fip
from fiplib.estimators.poses import history
from fiplib.estimators.poses.estimate import length_of
from fiplib.estimators.poses.knowledge import Knowledge
from fiplib.recording import Flight, Poses

DATA = Path(__file__).parents[2] / "data"


@pytest.fixture(scope="module")
def flight() -> Flight:
    return fip.read(DATA / "estimate-1.4")  # simulated, 25 s, a uniform rod of 1 m


def test_a_whole_flight_gives_what_its_poses_give_with_and_without_a_history(flight):
    knowledge, left = Knowledge.of_flight(flight), []
    alone = history.length_of_flight(flight, knowledge, advance=left.append)
    assert alone.answer == length_of(flight, knowledge) and len(alone.time) == 0
    assert left == [6, 5, 4, 3, 2, 1, 0]
    shrunk = history.length_of_flight(flight, knowledge, points=20)
    assert shrunk.answer == alone.answer
    assert shrunk.time[-1] == pytest.approx(flight.duration, abs=0.01)
    assert np.all(np.diff(shrunk.standard_deviation) < 0.0)


def test_a_long_flight_is_the_mean_of_its_parts_and_only_as_exact_as_they_are(flight, monkeypatch):
    knowledge = Knowledge()
    whole = history.length_of_flight(flight, knowledge).answer
    monkeypatch.setattr(history, "LONGEST", 10.0)  # six parts of four seconds
    left = []
    found = history.length_of_flight(flight, knowledge, points=10, advance=left.append)
    answer = found.answer
    parts = [part.found for part in history.windows(flight, knowledge, 6)]
    assert left == [6, 5, 4, 3, 2, 1, 0]
    assert any("6 parts of 4 s" in note for note in answer.notes)
    deviations = [part.standard_deviation for part in parts]
    assert min(deviations) <= answer.standard_deviation <= max(deviations)
    assert whole.standard_deviation < answer.standard_deviation
    # both rest on the same poses: they differ by less than the parts can tell
    assert abs(answer.length - whole.length) < answer.standard_deviation
    assert abs(answer.length - 1.0) < 3.5 * answer.standard_deviation
    assert answer.interval[0] < answer.length < answer.interval[1]
    # ten points within the first part, then one for each of the other five; the last is the answer
    assert len(found.time) == 15 and found.time[-1] == pytest.approx(flight.duration)
    assert np.all(np.diff(found.time) > 0.0)
    assert found.length[-1] == answer.length and found.standard_deviation[-1] == answer.standard_deviation


@pytest.mark.parametrize("longest", [600.0, 10.0])
def test_a_rod_that_was_changed_in_flight_is_refused_however_long_it_flew(flight, monkeypatch, longest):
    # from the middle on the rod is 1.3 times as long
    monkeypatch.setattr(history, "LONGEST", longest)
    parts = list(history.windows(flight, Knowledge(), 6))
    changed = [
        replace(part.found, length=part.found.length * (1.3 if index > 2 else 1.0)) for index, part in enumerate(parts)
    ]
    answers = iter([changed[0], *changed] if longest > flight.duration else changed)
    monkeypatch.setattr(history, "estimate", lambda *_: next(answers))
    found = history.length_of_flight(flight, Knowledge()).answer
    assert "contradict each other" in found.reason and np.isnan(found.length)


def test_a_push_in_a_long_flight_is_named_with_its_part_and_its_time(monkeypatch):
    pushed = fip.read(DATA / "push-hover")  # at 5.3, 12.0 and 20.2 s
    assert "at 5.3, 12.0 and 20.2 s" in fip.estimate(pushed).reason
    monkeypatch.setattr(history, "LONGEST", 10.0)
    reason = fip.estimate(pushed).reason
    assert reason.startswith("from 4.3 to 8.7 s: ") and "at 5.4 s" in reason


def test_what_a_refusal_of_pushes_suggests_to_cut_is_answered(tmp_path):
    from fiplib.bags import cut

    words = fip.estimate(fip.read(DATA / "push-hover")).reason.split()
    start, end = (float(words[words.index(option) + 1]) for option in ("--from", "--to"))
    found = fip.estimate(fip.read(cut(DATA / "push-hover", tmp_path / "quiet", start=start, end=end).output))
    assert found.reason is None and abs(found.length - 1.0) < 3.5 * found.standard_deviation


def test_only_the_time_in_which_both_bodies_were_tracked_is_cut_into_parts(flight):
    def part(body: Poses, before: float) -> Poses:
        keep = (flight.time(body) < before) | (flight.time(body) > 24.0)
        return Poses(body.stamp[keep], body.received[keep], body.position[keep], body.orientation[keep])

    lost = replace(flight, vehicle=part(flight.vehicle, 8.0), pendulum=part(flight.pendulum, 8.0))
    windows = list(history.windows(lost, Knowledge()))
    assert len(windows) == 3 and windows[0].start == 0.0 and windows[-1].end == pytest.approx(8.0, abs=0.01)
    assert all(part.found.reason is None for part in windows)
    assert fip.estimate(lost).reason is None


def test_a_first_stamp_of_zero_makes_no_flight_of_decades(flight):
    stamp = flight.vehicle.stamp.copy()
    stamp[0] = 0
    found = fip.estimate(replace(flight, vehicle=replace(flight.vehicle, stamp=stamp)))
    assert found.reason is None and abs(found.length - 1.0) < 3.5 * found.standard_deviation


def test_what_is_no_flight_is_said():
    for wrong in (None, "my-flight", DATA):
        with pytest.raises(ValueError, match="takes a Flight"):
            fip.estimate(wrong)
