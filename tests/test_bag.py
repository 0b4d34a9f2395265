"""``fip bag length``: the answer, what was assumed, and what the exit status says."""

import argparse
import json
from pathlib import Path

import pytest

import fiplib as fip
from fiplib import bag as command
from fiplib.bags import cut
from fiplib.recording import BagError

BAG = Path(__file__).parents[1] / "data" / "estimate-1.4"  # simulated, a uniform rod of 1 m


def run(*arguments: object) -> int:
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    return command.run(parser.parse_args([str(argument) for argument in ("length", *arguments)]))


def test_a_length_comes_with_its_interval_and_what_was_assumed(capsys):
    assert run(BAG, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert set(found) >= {"length", "standard_deviation", "interval", "refused", "assumed", "checks"}
    low, high = found["interval"]
    assert low < 1.0 < high and high - low < 0.02 and found["refused"] is None
    assert any("seat" in sentence for sentence in found["assumed"])
    seat, deviation = found["seat_height"]
    assert abs(seat) < 3 * deviation < 0.01  # the recorded flights have their seat in the tracked point


def test_what_is_stated_is_used_and_a_wrong_value_is_contradicted(capsys):
    assert run(BAG, "--uniform", "--seat-height", "0,0.001") == 0
    assert "inertia factor is 0.750" in capsys.readouterr().out
    assert run(BAG, "--seat-height", "0.05") == 3
    assert "contradicts" in capsys.readouterr().out


def test_a_refusal_is_one_sentence_and_status_3(capsys):
    swapped = "--topic", "vehicle=/mocap/pendulum/pose", "--topic", "pendulum=/mocap/quad/pose"
    assert run(BAG, *swapped, "--json") == 3
    found = json.loads(capsys.readouterr().out)
    assert "swapped" in found["refused"] and found["length"] is None and found["interval"] is None
    assert run(BAG, *swapped) == 3
    assert capsys.readouterr().out.startswith("refused    the rod is below the vehicle")


def test_a_bag_that_cannot_be_read_is_a_mistake_of_the_user(tmp_path):
    with pytest.raises(BagError, match="no such file"):  # the command ends with status 2
        run(tmp_path / "nowhere")


def test_the_library_says_the_same_as_the_command(capsys):
    run(BAG, "--json")
    printed = json.loads(capsys.readouterr().out)
    found = fip.estimate(fip.read(BAG))
    assert [printed["length"], printed["standard_deviation"]] == [found.length, found.standard_deviation]
    assert printed["interval"] == list(found.interval) and printed["assumed"] == list(found.assumed)


@pytest.mark.parametrize("suffix", [".png", ".pdf"])
def test_a_figure_is_written_once_and_does_not_change_the_answer(tmp_path, capsys, suffix):
    short = cut(BAG, tmp_path / "short", end=8.0).output
    run(short, "--json")
    alone = capsys.readouterr().out
    assert run(short, "--json", "--plot", tmp_path / f"length{suffix}") == 0
    assert capsys.readouterr().out == alone
    content = (tmp_path / f"length{suffix}").read_bytes()
    assert content.startswith(b"\x89PNG" if suffix == ".png" else b"%PDF") and len(content) > 5000
    with pytest.raises(BagError, match="exists already"):
        run(short, "--plot", tmp_path / f"length{suffix}")
    assert (tmp_path / f"length{suffix}").read_bytes() == content
