"""The flight script as its user runs it."""

import filecmp
import os
import platform
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from fiplib import bags, recording, replay
from fiplib.flight.limits import Limits
from fiplib.reproduction import measures
from fiplib.simulate import SCENARIOS

ROOT = Path(__file__).parents[2]


def fly(*arguments: object, folder: Path = ROOT) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(ROOT / "scripts" / "fly.py"), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, cwd=folder, env=os.environ)


def test_list_names_every_scenario():
    listed = fly("--list")
    assert listed.returncode == 0
    assert [line.split()[0] for line in listed.stdout.splitlines()] == list(SCENARIOS)


# One scenario is enough to notice; `make bags` rewrites all. The others hold events, whose form has changed since.
@pytest.mark.skipif(platform.machine() != "x86_64", reason="committed bags were made with the arithmetic of x86-64")
def test_a_committed_bag_is_regenerated_byte_for_byte(tmp_path):
    made = fly("--scenario", "circle-0.8", "--output", tmp_path / "circle-0.8")
    assert made.returncode == 0, made.stderr
    assert "simulated 26.00 s" in made.stdout and "still balanced" in made.stdout
    for name in ("circle-0.8.mcap", "metadata.yaml"):
        assert filecmp.cmp(tmp_path / "circle-0.8" / name, ROOT / "data" / "circle-0.8" / name, shallow=False), name


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


def contents(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


REFUSALS = {
    "no such port": ("--link", "crsf", "--crsf-port", "/dev/absent", "--poses", "sim", "--arm"),
    "no ROS 2": ("--link", "ros2", "--ros2-origin", "simulated"),
    "no origin": ("--link", "ros2"),
    "no terminal": ("--link", "crsf", "--crsf-port", "/dev/absent", "--poses", "sim"),
    "no such parameter": ("--set", "pendulum.lenght=1"),
    "a parameter out of range": ("--set", "pendulum.length=-1"),
    "no such estimator": ("--set", "estimation.estimator=crystal_ball"),
    "no duration": ("--duration", "0"),
    "a negative seed": ("--seed", "-1"),
    "limits without failsafe": ("--set", "safety.pose_level=0.2"),
}


def test_a_flight_that_does_not_begin_leaves_the_bag_that_it_was_to_replace(tmp_path):
    bag = tmp_path / "bag"
    assert fly("--scenario", "push-hover", "--duration", 1, "--output", bag).returncode == 0
    before = contents(tmp_path)
    for name, options in REFUSALS.items():
        answer = fly("--scenario", "push-hover", *options, "--output", bag, "--force")
        assert answer.returncode == 2 and answer.stderr.count("fip: ") == 1, name
        assert contents(tmp_path) == before, name
    assert fly("--scenario", "push-hover", "--duration", 2, "--output", bag, "--force").returncode == 0
    assert (bag / "bag.mcap").read_bytes() != before["bag/bag.mcap"]
    assert [entry.name for entry in tmp_path.iterdir()] == ["bag"] and bags.read(bag).duration > 1.9


@pytest.mark.parametrize(("number", "status"), [(signal.SIGKILL, -9), (signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_the_old_bag_stays_until_the_new_one_is_whole(tmp_path, number, status):
    bag = tmp_path / "bag"
    assert fly("--scenario", "push-hover", "--duration", 1, "--output", bag).returncode == 0
    before = contents(bag)
    process = started("--scenario", "estimate-1.4", "--output", bag, "--force")
    while not any(file.stat().st_size > 50_000 for file in tmp_path.glob("bag.new-*/bag/*.mcap")):
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(number)
    out, said = process.communicate(timeout=60)
    assert process.returncode == status and "Traceback" not in said
    assert contents(bag) == before
    [beside] = tmp_path.glob("bag.new-*/bag")
    if number != signal.SIGKILL:
        assert f"{bag} stays as it was; what was recorded of this flight is in {beside}" in out
        assert any(event.text.startswith("recording ended by") for event in bags.read(beside).events)


# --- behind the failsafe


def started(*arguments: object) -> subprocess.Popen[str]:
    command = [sys.executable, str(ROOT / "scripts" / "fly.py"), *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT)


def until_flying(process: subprocess.Popen[str]) -> list[str]:
    assert process.stderr is not None
    said = []
    while "ready -> flying" not in "".join(said[-1:]):
        said.append(process.stderr.readline())
        assert said[-1], "it ended before it flew"
    return said


def test_a_flight_behind_the_failsafe_is_the_same_every_time_and_replays_bit_for_bit(tmp_path):
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        made = fly(
            "--scenario", "push-hover", "--failsafe", "--duration", 7, "--set", "safety.descent=0.6",
            "--output", tmp_path / name / "bag",
        )  # fmt: skip
        assert made.returncode == 0, made.stderr
        assert "simulated: 7.00 s" in made.stdout and "still balanced (landed)" in made.stdout
    assert filecmp.cmp(tmp_path / "one/bag/bag.mcap", tmp_path / "two/bag/bag.mcap", shallow=False)
    flight = bags.read(tmp_path / "one/bag")
    assert flight.simulated and Limits.from_dict(flight.metadata["params"]).safety.descent == 0.6
    texts = [event.text for event in flight.events]
    assert texts == [
        "failsafe: disarmed -> ready: arm checks passed",
        "failsafe: ready -> flying: armed",
        "push of 8 mN s on the rod's COM",
        "failsafe: flying -> level: end of the scenario",
        "failsafe: level -> disarmed: landed",
    ]
    assert [event.kind for event in flight.events] == ["mode", "mode", "push", "mode", "mode"]
    assert flight.events[3].data == {"from": "flying", "to": "level", "reason": "end of the scenario"}
    # the scenario pushes 5.3 s after the first armed command, which answers the first recorded frame
    [push] = measures.push_times(flight)
    assert push == pytest.approx(5.3, abs=3 / 240) and flight.events[2].data["impulse"] == [0.008, 0.0]
    assert_replays(flight)


def assert_replays(flight: recording.Flight) -> None:
    """What was commanded until the pilot was first overruled is what it commands again."""
    overruled = next(
        event.stamp for event in flight.events if event.text.startswith("failsafe: flying ->") or event.level == "fatal"
    )
    again = replay.commands(flight)
    count = int((again.stamp < overruled).sum())
    np.testing.assert_array_equal(again.values[:count], flight.command.values[:count])
    # a command is stamped when it is sent; the replay stamps it as of when its frame was due
    late = flight.command.stamp[:count] - again.stamp[:count]
    assert (late >= 0).all() and (late == 0).mean() > 0.9
    assert count > 1


@pytest.mark.realtime
def test_in_real_time_a_length_is_estimated_beside_the_flight_and_a_bag_is_recorded(tmp_path):
    # a machine that stalls for half a second ends a flight, and a busy one has few estimates: that is not the subject
    for attempt in range(3):
        made = fly(
            "--scenario", "estimate-1.4", "--set", "estimation.estimator=poses", "--real-time",
            "--duration", 6, "--output", tmp_path / "live", *(["--force"] * (attempt > 0)),
        )  # fmt: skip
        assert made.returncode == 0, made.stderr
        flight = bags.read(tmp_path / "live")
        if "simulated: 6.00 s" in made.stdout and flight.length is not None and len(flight.length.values) >= 5:
            break
    assert "simulated: 6.00 s" in made.stdout and "ticks" in made.stdout
    # no terminal here: lines, and no control sequences
    assert "ready -> flying: armed" in made.stderr and " flying" in made.stderr and "\x1b" not in made.stderr
    assert flight.simulated and flight.metadata["real_time"] is True and flight.metadata["link"] == "sim"
    assert any("landed" in event.text for event in flight.events)
    # 2.5 s of frames come before the first run; on a machine that is not busy there are 13 of them
    assert flight.length is not None and len(flight.length.values) >= 5
    # a Cramer-Rao bound of some 3 mm for such windows; l0 was 0.4 m away
    assert flight.length.values[-1, 1] == pytest.approx(1.0, abs=0.1)
    assert_replays(flight)


@pytest.mark.realtime
@pytest.mark.parametrize(
    ("number", "reason"), [(signal.SIGINT, "operator abort (Ctrl-C)"), (signal.SIGHUP, "terminal lost (SIGHUP)")]
)
def test_ctrl_c_or_a_lost_terminal_lands_the_vehicle_and_leaves_a_whole_bag(tmp_path, number, reason):
    process = started("--scenario", "push-hover", "--real-time", "--output", tmp_path / "live")
    until_flying(process)
    process.send_signal(number)
    out, said = process.communicate(timeout=120)
    assert process.returncode == 130, said
    assert "not balanced to the end (landed)" in out and "Traceback" not in said
    texts = [event.text for event in bags.read(tmp_path / "live").events]
    assert texts[-2:] == [f"failsafe: flying -> level: {reason}", "failsafe: level -> disarmed: landed"] or (
        f": {reason}" in "".join(texts) and texts[-1].endswith("landed")  # coasting when it came, on a busy machine
    )


@pytest.mark.realtime
@pytest.mark.skipif(sys.platform != "linux", reason="finds the recorder's process in /proc")
def test_a_recording_that_stops_hides_neither_the_flight_nor_itself(tmp_path):
    process = started("--scenario", "push-hover", "--real-time", "--duration", 3, "--output", tmp_path / "live")
    until_flying(process)
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    [recorder] = [child for child in children if b"fiplib.bags.live" in Path(f"/proc/{child}/cmdline").read_bytes()]
    os.kill(int(recorder), signal.SIGKILL)
    out, said = process.communicate(timeout=120)
    assert process.returncode == 2 and "Traceback" not in said
    assert "simulated: 3.00 s" in out and "still balanced (landed)" in out and "wrote" not in out
    assert f"fip: {tmp_path / 'live'}: recording stopped: its process was killed" in said
    assert f"fip bag recover {tmp_path / 'live'}" in said


def test_limits_of_the_failsafe_are_refused_where_no_failsafe_flies(tmp_path):
    answer = fly("--scenario", "push-hover", "--set", "safety.pose_level=0.2", "--output", tmp_path / "bag")
    assert answer.returncode == 2 and "they fly with --real-time, --failsafe or --link crsf only" in answer.stderr
    answer = fly("--scenario", "push-hover", "--duration", "-1", "--output", tmp_path / "bag")
    assert answer.returncode == 2 and "give seconds > 0" in answer.stderr
    assert not (tmp_path / "bag").exists()
