"""The flight script as its user runs it."""

import filecmp
import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

from fiplib import bags
from fiplib.simulate import SCENARIOS

ROOT = Path(__file__).parent.parent


def fly(*arguments: object, folder: Path = ROOT) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(ROOT / "scripts" / "fly.py"), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, cwd=folder, env=os.environ)


def test_list_names_every_scenario():
    listed = fly("--list")
    assert listed.returncode == 0
    assert [line.split()[0] for line in listed.stdout.splitlines()] == list(SCENARIOS)


# One scenario with every kind of message but estimates is enough to notice; `make bags` rewrites all.
@pytest.mark.skipif(platform.machine() != "x86_64", reason="committed bags were made with the arithmetic of x86-64")
def test_a_committed_bag_is_regenerated_byte_for_byte(tmp_path):
    made = fly("--scenario", "push-hover", "--output", tmp_path / "push-hover")
    assert made.returncode == 0, made.stderr
    assert "simulated 26.00 s" in made.stdout and "still balanced" in made.stdout
    for name in ("push-hover.mcap", "metadata.yaml"):
        assert filecmp.cmp(tmp_path / "push-hover" / name, ROOT / "data" / "push-hover" / name, shallow=False), name


def test_parameters_and_seed_can_be_set_and_are_recorded(tmp_path):
    made = fly(
        "--scenario", "circle-0.8", "--seed", 7, "--set", "pendulum.length=0.8",
        "--set", "simulation.position_noise=1e-3", "--output", tmp_path / "short",
    )  # fmt: skip
    assert made.returncode == 0, made.stderr
    flight = bags.read(tmp_path / "short")
    assert flight.metadata["seed"] == 7 and flight.simulated
    assert flight.params.pendulum.length == 0.8 and flight.params.simulation.position_noise == 1e-3
    assert flight.truth_length.values[0, 0] == 0.8


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--scenario", "loop"], "no scenario 'loop'; there are push-hover, circle-0.8"),
        (["--scenario", "push-hover", "--set", "pendulum.lenght=1"], "unknown parameter 'pendulum__lenght'"),
        (["--scenario", "push-hover", "--set", "pendulum.length"], "write GROUP.NAME=VALUE"),
        (["--scenario", "push-hover", "--set", "pendulum.length=long"], "pendulum.length must be a number"),
        (["--scenario", "push-hover", "--set", "pendulum.length=-1"], "pendulum.length"),
    ],
)
def test_a_mistake_is_answered_in_one_line_without_a_traceback(arguments, message, tmp_path):
    answer = fly(*arguments, "--output", tmp_path / "bag")
    assert answer.returncode == 2 and message in answer.stderr
    assert answer.stderr.count("\n") == 1, answer.stderr
    assert not (tmp_path / "bag").exists()


def test_nothing_recorded_is_overwritten_unless_asked_and_then_only_a_bag(tmp_path):
    folder = tmp_path / "notes"
    folder.mkdir()
    (folder / "thesis.txt").write_text("years of work")
    for force in ([], ["--force"]):
        answer = fly("--scenario", "push-hover", "--output", folder, *force)
        assert answer.returncode == 2 and "exists" in answer.stderr
    assert (folder / "thesis.txt").read_text() == "years of work"
