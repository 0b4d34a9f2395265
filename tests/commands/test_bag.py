"""``fip bag length``: the answer, what was assumed, and what the exit status says."""

import argparse
import io
import json
import os
from pathlib import Path

import numpy as np
import pytest

import fiplib as fip
from fiplib.bags import cut
from fiplib.commands import bag as command
from fiplib.estimators.poses import planar
from fiplib.params import FipError
from fiplib.recording import BagError
from fiplib.teaching.cart import simulated_cart

BAG = Path(__file__).parents[2] / "data" / "estimate-1.4"  # simulated, a uniform rod of 1 m


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
    assert abs(seat - 0.08) < 3 * deviation < 0.01  # of the simulated vehicle


def test_what_is_stated_is_used_and_a_wrong_value_is_contradicted(capsys):
    assert run(BAG, "--uniform", "--seat-height", "0.08,0.001") == 0
    assert "inertia factor is 0.750" in capsys.readouterr().out
    assert run(BAG, "--seat-height", "0.03") == 3
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


def table(path: Path, **changes: float) -> Path:
    known = simulated_cart(np.random.default_rng(0), **changes)
    np.savetxt(path, np.array(known).T, delimiter=",", header=",".join(planar.COLUMNS), comments="")
    return path


def test_encoders_of_a_cart_are_answered_as_a_bag_is(tmp_path, capsys):
    cart = table(tmp_path / "cart.csv")
    assert run(cart, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    value, deviation = found["effective_length"]
    assert abs(value - 0.4) < 3.5 * deviation < 0.07
    # of a uniform rod whose foot does not move: L = 3/2 L_e
    assert found["length"] == pytest.approx(1.5 * value, rel=0.01) and found["refused"] is None
    assert found["checks"]["passed"] == [] and any("base" in sentence for sentence in found["assumed"])
    assert run(cart) == 0
    printed = capsys.readouterr().out
    assert printed.startswith("length     0.") and "\nL_e        0." in printed and "passed" not in printed
    assert run(cart, "--inertia-factor", "1", "--json") == 0
    point = json.loads(capsys.readouterr().out)
    assert point["length"] == pytest.approx(2.0 * point["effective_length"][0], rel=0.01)


def test_encoders_are_refused_or_not_readable_as_a_bag_is(tmp_path, capsys):
    assert run(table(tmp_path / "coarse.csv", angle_step=0.05), "--json") == 3
    assert "quantisation" in json.loads(capsys.readouterr().out)["refused"]
    (damaged := tmp_path / "damaged.csv").write_text(",".join(planar.COLUMNS) + "\n1,2\n")
    with pytest.raises(FipError, match=r"damaged\.csv"):  # the command ends with status 2
        run(damaged)
    with pytest.raises(BagError, match="leave out --arm-radius"):
        run(BAG, "--arm-radius", "0.1")
    with pytest.raises(BagError, match="leave out --plot"):
        run(table(tmp_path / "cart.csv"), "--plot", tmp_path / "length.pdf")
    (poses := tmp_path / "poses.csv").write_text("t,x,y\n1,2,3\n")
    with pytest.raises(BagError, match=r"poses\.csv"):
        run(poses)


def test_a_rotary_arm_has_a_radius(tmp_path, capsys):
    # the same table, read as of an arm: the centrifugal force makes the rod fall faster, so that it must be longer
    cart, lengths = table(tmp_path / "cart.csv"), []
    for options in ((), ("--arm-radius", "0.3")):
        run(cart, "--json", *options)
        lengths.append(json.loads(capsys.readouterr().out)["effective_length"][0])
    assert lengths[0] != lengths[1]
    for wrong in ("0", "-1", "nan", "wide"):
        with pytest.raises(SystemExit):
            run(cart, f"--arm-radius={wrong}")


def test_a_real_rotary_arm_of_six_centimetres_is_answered(capsys):
    root = os.environ.get("FIP_REAL", Path(__file__).parents[2] / "../shared/real")
    path = Path(root) / "furuta/upright.csv"
    if not path.exists():
        pytest.skip(f"no recording at {path}; FIP_REAL names the directory that holds furuta/upright.csv")
    assert run(path, "--arm-radius", "0.062", "--json") == 0
    value, deviation = json.loads(capsys.readouterr().out)["effective_length"]
    assert value == pytest.approx(57.9e-3, abs=0.1e-3) and deviation == pytest.approx(2.9e-3, abs=0.1e-3)


def test_a_stated_noise_is_used(capsys):
    assert run(BAG, "--noise", "0.0002,0.001") == 0
    assert run(BAG, "--noise", "0.00001,0.00005") == 3
    assert "--noise 0.0002,0.001" in capsys.readouterr().out
    for wrong in ("0.001", "0,0.001", "a,b", "nan,1", "inf,1"):
        with pytest.raises(SystemExit):
            run(BAG, "--noise", wrong)


def test_long_work_shows_its_progress_and_short_work_does_not(monkeypatch, capsys):
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    for patience, shown in ((0.0, True), (1e3, False)):
        monkeypatch.setattr(command, "PATIENCE", patience)
        monkeypatch.setattr("sys.stderr", terminal := Terminal())
        assert run(BAG) == 0
        assert ("estimate-1.4" in terminal.getvalue()) == shown
        assert capsys.readouterr().out.startswith("length ")
