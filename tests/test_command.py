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

ANSWERS = {
    "figures": ("figures", "--list"),
    "claims": ("claims", "--data", "nowhere"),
    "bag": ("bag", "info", "data/circle-0.8"),
    "fly": ("fly", "--list"),
    "sweep": ("sweep", "--list"),
    "faults": ("faults", "--list"),
    "firmware": ("firmware", "--help"),
    "view": ("view", "data/circle-0.8", "--output", os.devnull),
}
"""A quick call of each subcommand; that of ``claims`` is a mistake, since the ledger takes minutes."""
LONG = {
    "figures": ("figures", "fig10-intervals", "--output", "{folder}"),
    "claims": ("claims",),
    "bag": ("bag", "length", "data/circle-0.8"),
    "fly": ("fly", "--scenario", "estimate-1.4", "--output", "{folder}/flight"),
    "sweep": ("sweep", "survival", "--workers", "1", "--data", "{folder}"),
    "faults": ("faults", "--output", "{folder}/faults.csv"),
    "view": ("view",),
}
"""A call of each subcommand that takes seconds or more."""


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
        (("bag", "info", "a\nb\x1b[31m"), "a b [31m: no such file"),
        (("bag", "info", ".", "a\nb\x1b[31m"), "arguments: a b [31m"),
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


def shell(redirection: str, *arguments: str, **options) -> subprocess.CompletedProcess:
    """The command with streams as a shell makes them."""
    command = ["sh", "-c", f'exec "$0" -m fiplib "$@" {redirection}', sys.executable, *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, **options)


def test_every_subcommand_has_its_calls_here():
    assert set(ANSWERS) == set(COMMANDS) and set(LONG) == set(COMMANDS) - {"firmware"}  # firmware may not be built


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full on this system")
@pytest.mark.parametrize(
    "name", [name for name in ANSWERS if name != "firmware"]
)  # argparse swallows its help's errors
def test_a_full_output_is_one_line(name):
    done = shell(">/dev/full", *ANSWERS[name])
    expected = "fip: nowhere" if name == "claims" else "fip: the output cannot be written"
    assert done.returncode == 2 and done.stderr.startswith(expected) and done.stderr.count("\n") == 1
    done = shell("2>/dev/full", *ANSWERS[name])
    assert done.returncode == (2 if name == "claims" else 0) and done.stderr == ""


@pytest.mark.parametrize("name", ANSWERS)
@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"])
def test_streams_that_are_closed_from_the_start_do_no_harm(name, closed):
    done = shell(closed, *ANSWERS[name])
    assert done.returncode == (2 if name == "claims" else 0)
    mistake = name == "claims" and "2" not in closed
    assert done.stderr.startswith("fip: nowhere") if mistake else done.stderr == ""
    assert bool(done.stdout) == (">&-" not in closed.replace("2>&-", "") and name != "claims")


@pytest.mark.parametrize("name", ["bag", "claims", "figures"])
def test_names_that_are_no_text_are_printed_in_any_locale(name, tmp_path):
    words = {"bag": ("bag", "info"), "claims": ("claims", "--data"), "figures": ("figures", "fig3-pushes", "--data")}[
        name
    ]
    folder = os.fsencode(tmp_path) + b"/a\xffb\n\xc3\x9f"
    for locale in ("C", "C.UTF-8"):
        command = [sys.executable, "-m", "fiplib", *words, folder]
        done = subprocess.run(
            command, cwd=ROOT, capture_output=True, env={**os.environ, "LC_ALL": locale, "PYTHONUTF8": "0"}
        )
        assert done.returncode == 2 and b"Traceback" not in done.stderr and done.stderr.count(b"\n") == 1, done.stderr
        assert b"no such f" in done.stderr


@pytest.mark.parametrize("name", LONG)
def test_ctrl_c_ends_every_subcommand_with_its_status_and_one_line(name, tmp_path):
    arguments = [word.format(folder=tmp_path) for word in LONG[name]]
    with start(*arguments, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as process:
        time.sleep(2.0 if name != "bag" else 0.5)
        process.send_signal(signal.SIGINT)
        said = process.stderr.read()
        status = process.wait(timeout=120)
    assert "Traceback" not in said
    if status != 0:  # else it was done already
        assert status == 130 and said.rstrip().endswith("fip: interrupted")


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
