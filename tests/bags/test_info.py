"""What `fip bag info` says of any bag, and what it explains."""

import ast
import re
from pathlib import Path

import numpy as np
import pytest

from fiplib.__main__ import main
from fiplib.bags import checks
from fiplib.bags.explanations import EXPLANATIONS, markdown, words
from tests.bags import strangers

ROOT = Path(__file__).parents[2]


def info(*arguments: object) -> int:
    return main(["bag", "info", *map(str, arguments)])


def row(printed: str, start: str) -> list[str]:
    """The cells of the last line that begins so."""
    return [line for line in printed.splitlines() if line.startswith(start)][-1].split()


def test_stamps_are_described_topic_by_topic(tmp_path, capsys):
    flight = strangers.recorded(5.0, 9.0)
    late = flight.rod.part(np.delete(np.arange(960), np.arange(300, 360))).later(log=0.002)  # 60 frames lost
    doubled = flight.vehicle.part(np.repeat(np.arange(960), 1 + (np.arange(960) % 100 == 50)))
    path = strangers.write(tmp_path / "bag", strangers.rows(flight._replace(vehicle=doubled, rod=late)))
    assert info(path) == 0
    printed = capsys.readouterr().out
    vehicle, rod = row(printed, strangers.VEHICLE), row(printed, strangers.ROD)
    # Hz, jitter, gaps, longest, twice, back, log - stamp, its half width, frame
    assert vehicle[1:7] == ["242.5", "0.00", "0", "0.004", "10", "0"]  # 970 messages in 959 periods
    assert rod[1:7] == ["225.0", "0.00", "1", "0.254", "0", "0"]  # 900 messages, a gap of 61 periods
    assert float(rod[7]) - float(vehicle[7]) == pytest.approx(0.002, abs=1e-5)
    assert vehicle[9] == "world"
    assert "a pose of the rod lies 0.000 ms from the vehicle's next in time" in printed
    apart = r"the tracked points are 0\.5[78]\d\d \+- 0\.00\d+ m apart: the rod is 1\.1[56]\d m long, if"
    assert re.search(apart, printed)
    assert "passed: roles, clocks, tracking, frames" in printed


def test_a_bag_without_poses_is_listed(tmp_path, capsys):
    flight = strangers.recorded(5.0, 6.0)
    path = strangers.write(tmp_path / "bag", strangers.commands(flight, "/cmd"))
    assert info(path) == 0
    printed = capsys.readouterr().out
    assert "flight     none: no topic /mocap/quad/pose (vehicle); the bag holds /cmd" in printed
    assert ["/cmd", strangers.ATTITUDE, "120"] in [line.split() for line in printed.splitlines()]
    assert row(printed, "/cmd")[1] == "120.0"


def test_a_plan_that_comes_seldom_is_not_taken_for_motion_capture(tmp_path, capsys):
    flight = strangers.recorded(5.0, 9.0)
    bodies = {"/a": flight.vehicle, "/b": flight.rod, "/plan": flight.rod.part(slice(None, None, 48))}
    rows = [one for topic, body in bodies.items() for one in strangers.poses(topic, body)]
    assert info(strangers.write(tmp_path / "bag", rows)) == 0
    printed = capsys.readouterr().out
    assert "/a is taken for the vehicle, as it is the lower one" in printed
    assert "/b is taken for the pendulum, as it is the higher one" in printed


def test_conventions_are_stated_on_the_command_line(tmp_path, capsys):
    flight = strangers.recorded(5.0, 9.0).both(lambda body: body.scaled(1000).ordered(3, 0, 1, 2))
    path = strangers.write(tmp_path / "bag", strangers.rows(flight))
    assert main(["bag", "length", str(path)]) == 3
    refused = capsys.readouterr().out
    assert "--quaternion wxyz" in refused and "--unit mm" in refused
    assert main(["bag", "length", str(path), "--unit", "mm", "--quaternion", "wxyz"]) == 0
    assert main(["bag", "length", str(path), "--unit", "mm", "--quaternion", "vehicle=wxyz"]) == 3
    with pytest.raises(SystemExit):
        main(["bag", "info", str(path), "--quaternion", "zyx"])
    assert "zyx is none of xyzw, wxyz" in capsys.readouterr().err


def test_every_finding_is_explained_on_the_page_and_by_the_command(capsys):
    made = {
        node.args[0].value
        for node in ast.walk(ast.parse(Path(checks.__file__).read_text()))
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Finding"
        if isinstance(node.args[0], ast.Constant)
    }
    assert made <= set(EXPLANATIONS) and len(made) >= 10
    with pytest.raises(SystemExit) as ended:
        info("--explain")
    assert ended.value.code == 0
    printed = capsys.readouterr().out
    assert printed == words() + "\n"
    assert all(f"\n{name}: " in printed for name in EXPLANATIONS)
    page = (ROOT / "docs/your-own-recording.md").read_text()
    record, findings = markdown().split("\n## What each finding means")
    assert record.strip() in page and findings.strip() in page
