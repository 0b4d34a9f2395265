"""Every command that README and pages show: run as it stands, or named here with the reason why it is not."""

import re
import shlex
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fiplib.__main__ import main
from fiplib.estimators.poses import planar
from fiplib.recording import NANO
from fiplib.teaching.cart import simulated_cart
from tests.bags import strangers
from tests.bags.strangers import Recording

ROOT = Path(__file__).parents[1]
BLOCK = re.compile(r"^```sh\n(.*?)^```", re.DOTALL | re.MULTILINE)
FENCES = re.compile(r"^```(\w*)[^\n]*\n(.*?)^```", re.DOTALL | re.MULTILINE)
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(ROOT.glob("docs/*.md"))]

NOT_RUN = {
    r"make \S+( .*)?|.ci/run": "the targets are run by .ci/run and by hand: tests do not call make from within make",
    r"source .*|pip install .*|git .*": "changes the environment or the repository of whoever runs the tests",
    r"fip firmware (install|step|fly|push).*": "needs Betaflight's simulator: tests/studies/test_firmware.py runs them",
    r"FIP_FIRMWARE=1 .*": "needs Betaflight's simulator",
    r"python (scripts/fly.py|tests/flight/ros2_vehicle.py) .*|python tests/flight/ros2_vehicle.py": "needs ROS 2 or a "
    "radio: tests/flight/test_ros2.py and test_crsf.py run them",
    r"\.venv/bin/python -m nbconvert .*": "runs a notebook: tests/teaching/test_clean_runs.py does",
    r"fip claims.*": "takes minutes; make figures writes what it prints, and .ci/run compares the two",
}
"""Patterns of commands that are not run here, with the reason."""


def prepare_recordings(folder: Path) -> None:
    """What a reader of "Your own recording" has: a flight, exports of it, and encoders of a cart and of an arm."""
    recorded = strangers.recorded(end=29.0)
    strangers.write(folder / "my-flight", strangers.rows(recorded))
    strangers.motive(folder / "take.csv", recorded)
    strangers.ros1(folder / "lab.bag", recorded)
    time = (recorded.vehicle.stamp - recorded.vehicle.stamp[0]) / NANO
    save(folder / "table.csv", np.column_stack([time, poses(recorded)]), ["t", *POSES])
    y_up = Rotation.from_euler("x", -90, degrees=True)
    save(folder / "numbers.csv", poses(recorded.both(lambda body: body.seen_from(y_up)), unit=1e3), [])
    known = np.array(simulated_cart(np.random.default_rng(0))).T
    for name in ("cart.csv", "furuta.csv"):
        save(folder / name, known, planar.COLUMNS)


POSES = ["x", "y", "z", "qx", "qy", "qz", "qw", "px", "py", "pz", "pqx", "pqy", "pqz", "pqw"]


def poses(recorded: Recording, unit: float = 1.0) -> NDArray:
    bodies = recorded.vehicle, recorded.rod
    return np.column_stack([part for body in bodies for part in (unit * body.position, body.orientation)])


def save(path: Path, table: NDArray, names: Sequence[str]) -> None:
    np.savetxt(path, table, delimiter=",", header=",".join(names), comments="", fmt="%.9f")
    if not names:
        path.write_text(path.read_text().lstrip("\n"))


PREPARED: dict[str, Callable[[Path], None]] = {"your-own-recording.md": prepare_recordings}
"""What a page's commands find in the folder, beside a link to ``data``."""

ENDS = {
    "fip bag length furuta.csv --arm-radius 0.062 --json": 3,  # here a cart's table, which no arm made: refused
    "fip bag length my-flight --up y --unit mm --quaternion wxyz": 3,  # the flight here has no such mistake: refused
}
"""Exit status of the commands that do not end with 0 here, by command."""


def shown(page: Path) -> list[str]:
    """The commands of a page, without their comments, lines that go on joined."""
    lines = "".join(BLOCK.findall(page.read_text(encoding="utf-8"))).replace("\\\n", " ").splitlines()
    return [" ".join(shlex.split(line, comments=True)) for line in lines if line.split("#")[0].strip()]


def reason(command: str) -> str | None:
    """Why a command is not run here; None if it is."""
    return next((why for pattern, why in NOT_RUN.items() if re.fullmatch(pattern, command)), None)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_blocks_of_commands_are_named_as_such(page):
    unnamed = [block for language, block in FENCES.findall(page.read_text(encoding="utf-8")) if not language]
    assert [block for block in unnamed if re.match(r"(fip|make|python|pip|git|source) ", block)] == []


@pytest.mark.parametrize(
    "page", [page for page in PAGES if shown(page) and page.name != "extend.md"], ids=lambda p: p.name
)
def test_commands_of_a_page_work_in_their_order(page, tmp_path, monkeypatch, capsys):
    PREPARED.get(page.name, lambda folder: None)(tmp_path)
    (tmp_path / "data").symlink_to(ROOT / "data")
    monkeypatch.chdir(tmp_path)
    for command in shown(page):
        if reason(command):
            continue
        name, *arguments = shlex.split(command)
        assert name == "fip", f"{command}: neither run nor in NOT_RUN"
        try:
            status = main(arguments)
        except SystemExit as ended:  # --help
            status = ended.code or 0
        printed = capsys.readouterr()
        assert status == ENDS.get(command, 0), f"{command}\n{printed.out}\n{printed.err}"
        assert printed.out or printed.err


def test_the_python_of_your_own_vehicle_runs(capsys):
    page = (ROOT / "docs/your-own-vehicle.md").read_text(encoding="utf-8")
    code = "".join(block for language, block in FENCES.findall(page) if language == "python")
    exec(compile(code, "your-own-vehicle.md", "exec"), {})
    *rates, growth = re.findall(r"-?\d+\.\d+", capsys.readouterr().out)
    # 10 cm beside its place: it rolls or pitches towards it; the loop of a 0.7 m rod is stable
    assert len(rates) == 1 and float(rates[0]) != 0.0 and float(growth) < 0.0


def test_every_reason_is_of_a_command_that_is_shown():
    commands = [command for page in PAGES for command in shown(page)]
    assert all(
        any(re.fullmatch(pattern, command) for command in commands) for pattern in NOT_RUN if "view" not in pattern
    )
