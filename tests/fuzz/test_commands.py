"""Command lines at random: an answer, or one line and status 1, 2 or 3; never a traceback, nothing left behind."""

import argparse
import contextlib
import io
import random
import shutil
import signal
from pathlib import Path

import pytest

from fiplib import __main__ as command
from fiplib.params import Params
from fiplib.simulate import SCENARIOS
from tests.fuzz.budget import tried

ROOT = Path(__file__).parents[2]
PATHS = [
    *("data/circle-0.8", "data/circle-0.8/circle-0.8.mcap", "data", "nowhere", "", ".", "/", "/dev/null", "/dev/zero"),
    *("data/faults.csv", "-", "--", "stra\u00dfe", "a\udcffb", "a\nb", "x" * 300, "~", "file:///etc/passwd"),
]
NUMBERS = [
    *("0", "1", "-1", "0.5", "1e-300", "1e300", "nan", "inf", "-inf", "1e9999", "0x10", "one", "", "1,2", "(1,)", "[]"),
    *("{}", "None", "True", "'", "(" * 300, "9" * 5000),
]
NAMES = [f"{group}.{name}" for group, values in Params().to_dict(complete=True).items() for name in values]
SETTINGS = [*NAMES, "safety.pose_flag", "radio.baud", "nonsense", "pendulum", "pendulum.", ".length", "a.b.c", ""]
WORDS = [
    *("info", "length", "recover", "convert", "check", "cut", "export", *SCENARIOS, "fig2-vehicle", "claims"),
    *("survival", "--help", "--version", "--nonsense", "-x", "--json", "--list", "--force", "--arm"),
]
QUICK = ("info", "length", "recover", "convert", "--list", "nonsense")


def declared() -> dict[str, list[str]]:
    """The options of each subcommand, those of its own subcommands too."""
    found = {}
    for name, (module, _) in command.COMMANDS.items():
        parser = argparse.ArgumentParser()
        __import__(module, fromlist=["add_arguments"]).add_arguments(parser)
        options, parsers = [], [parser]
        while parsers:
            for action in parsers.pop()._actions:
                options += action.option_strings
                if isinstance(action, argparse._SubParsersAction):
                    parsers += action.choices.values()
        found[name] = sorted(set(options))
    return found


OPTIONS = declared()


def line(rng: random.Random) -> list[str]:
    """A command line: mostly well-formed, somewhere wrong."""
    name = rng.choice([*command.COMMANDS, "nonsense", ""])
    words = [name]
    if name == "bag" and rng.random() < 0.9:
        words.append(rng.choice(QUICK))
    for _ in range(rng.randrange(5)):
        kind = rng.random()
        if kind < 0.35 and OPTIONS.get(name):
            words.append(rng.choice(OPTIONS[name]))
        elif kind < 0.5:
            words += ["--set", f"{rng.choice(SETTINGS)}{rng.choice(('=', '=', '=', ''))}{rng.choice(NUMBERS)}"]
        elif kind < 0.75:
            words.append(rng.choice(PATHS))
        else:
            words.append(rng.choice(WORDS if rng.random() < 0.5 else NUMBERS))
    # what would work for minutes or hours is not asked for, but refused before it begins
    if name in ("sweep", "faults", "firmware", "figures", "claims", "fly", "view") and "--list" not in words:
        refused = {"claims": ["--data", "nowhere"], "view": ["nowhere", "nowhere"]}
        refused["fly"] = "--scenario push-hover --duration 1e-4 --link sim".split()
        words += refused.get(name, ["nonsense", "nonsense"])  # one may be taken by an option
    return [word.replace("\0", "") for word in words]


@pytest.mark.fuzz
def test_a_command_line_is_answered_or_refused_in_one_line(tmp_path, monkeypatch):
    shutil.copytree(ROOT / "data/circle-0.8", tmp_path / "data/circle-0.8")
    shutil.copy(ROOT / "data/faults.csv", tmp_path / "data")
    monkeypatch.chdir(tmp_path)
    before = signal.getsignal(signal.SIGTERM)
    statuses: set[int] = set()

    def check(rng: random.Random) -> str:
        words = line(rng)
        out, err = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            try:
                status = command.main(words)
            except SystemExit as ended:  # argparse
                status = ended.code or 0
        statuses.add(status)
        said = err.getvalue()
        assert status in (0, 1, 2, 3), (words, said)
        assert "Traceback" not in said and len(said) < 20_000, (words, said)
        if status == 2:
            assert out.getvalue() == "", (words, out.getvalue())
            last = said.splitlines()[-1]
            assert (last.startswith("fip") and last.isprintable()) or "\udcff" in last, (words, said)
        return f"{words}: {status}"

    tried(check, "tests/fuzz/test_commands.py")
    signal.signal(signal.SIGTERM, before)
    assert statuses & {0, 2}
