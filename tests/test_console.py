"""What the command lines share."""

import subprocess
import sys
from pathlib import Path

import pytest

from fiplib.console import READER_GONE

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize(
    "command",
    [
        ("-m", "fiplib", "figures", "--list"),
        ("scripts/fly.py", "--list"),
        ("-m", "fiplib", "faults", "--list"),
    ],
)
@pytest.mark.parametrize("unbuffered", ["1", ""])
def test_a_reader_that_has_seen_enough_gets_no_traceback(command, unbuffered):
    process = subprocess.Popen(
        [sys.executable, *command],
        cwd=ROOT,
        env={"PATH": "", "PYTHONUNBUFFERED": unbuffered},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    process.stdout.close()  # as head does
    said = process.stderr.read()
    assert process.wait(timeout=120) == READER_GONE and said == ""
