"""The one command: its help, its errors, its interruptions, and streams that are gone."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from fiplib.__main__ import COMMANDS, READER_GONE, guarded
from fiplib.recording import BagError

ROOT = Path(__file__).parents[1]


def start(*arguments: str, **options) -> subprocess.Popen:
    return subprocess.Popen([sys.executable, "-m", "fiplib", *arguments], cwd=ROOT, text=True, **options)


def fip(*arguments: str, **options) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-m", "fiplib", *arguments], cwd=ROOT, text=True, capture_output=True, **options
    )


def test_help_names_every_command_and_each_has_its_own():
    done = fip("--help")
    assert done.returncode == 0 and done.stderr == ""
    for name in COMMANDS:
        assert f"\n    {name} " in done.stdout
        told = fip(name, "--help")
        assert told.returncode == 0 and f"usage: fip {name}" in told.stdout


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("bag", "info", "no-such-bag"), "no-such-bag: no such file or directory"),
        (("fly", "--scenario", "loop"), "no scenario 'loop'"),
        (("figures", "fig99"), "fig99"),
        (("claims", "--data", "nowhere"), "nowhere"),
        (("sweep", "nonsense"), "nonsense"),
        (("dance",), "dance"),
    ],
)
def test_a_mistake_is_one_line_and_status_2(arguments, words):
    done = fip(*arguments)
    assert done.returncode == 2 and done.stdout == ""
    assert words in done.stderr and "Traceback" not in done.stderr
    assert done.stderr.startswith(("fip: ", "usage: "))


@pytest.mark.parametrize("arguments", [("bag", "info", "data/circle-0.8"), ("figures", "--list"), ("fly", "--list")])
@pytest.mark.parametrize("unbuffered", ["1", ""])
def test_a_reader_that_has_seen_enough_gets_no_traceback(arguments, unbuffered):
    process = start(
        *arguments,
        env={"PATH": "", "PYTHONUNBUFFERED": unbuffered},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    process.stdout.close()  # as head does
    said = process.stderr.read()
    assert process.wait(timeout=120) == READER_GONE and said == ""


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full on this system")
def test_a_full_output_is_one_line():
    with open("/dev/full", "w") as full:
        process = start("bag", "info", "data/circle-0.8", stdout=full, stderr=subprocess.PIPE)
        said = process.stderr.read()
    assert process.wait(timeout=120) == 2
    assert said.startswith("fip: the output cannot be written") and said.count("\n") == 1


@pytest.mark.parametrize("closed", [0, 1, 2])
def test_streams_that_are_closed_from_the_start_do_no_harm(closed):
    done = subprocess.run(
        ["sh", "-c", f'exec "$0" -m fiplib fly --list {closed}>&-', sys.executable],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0 and done.stderr == ""
    assert ("circle-0.8" in done.stdout) == (closed != 1)


def test_names_that_are_not_ascii_are_printed_in_any_locale(tmp_path):
    done = fip("bag", "info", str(tmp_path / "stra\u00dfe"), env={**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0"})
    assert done.returncode == 2 and "no such file" in done.stderr and "Traceback" not in done.stderr


@pytest.mark.parametrize(("ended", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_a_flight_with_its_status_and_leaves_a_readable_bag(tmp_path, ended, status):
    bag = tmp_path / "flight"
    with start("fly", "--scenario", "circle-0.8", "--output", str(bag), stderr=subprocess.PIPE) as process:
        while process.poll() is None and sum(file.stat().st_size for file in bag.glob("*.mcap")) < 10_000:
            time.sleep(0.02)  # until some of the flight is on the disk
        process.send_signal(ended)
        said = process.stderr.read()
        assert process.wait(timeout=120) == status
    assert "Traceback" not in said
    assert fip("bag", "info", str(bag)).returncode == 0


def test_errors_of_the_package_are_mistakes_and_others_are_not_hidden(capsys):
    def wrong() -> int:
        raise BagError("bag: broken")

    def broken() -> int:
        raise ZeroDivisionError

    assert guarded(wrong) == 2
    assert capsys.readouterr().err == "fip: bag: broken\n"
    with pytest.raises(ZeroDivisionError):
        guarded(broken)
