"""docs/safety.md says what the code does: its limits and its state machine are those of ``params`` and ``failsafe``."""

import dataclasses
import re
from pathlib import Path

from fiplib.flight import failsafe, setpoint
from fiplib.params import Safety

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/safety.md").read_text(encoding="utf-8")


def limits() -> str:
    """The page's table of limits: what to paste there when a limit has changed."""
    rows = ["| limit | default | what, and whose choice |", "|---|---|---|"]
    for entry in dataclasses.fields(Safety):
        values = entry.default if isinstance(entry.default, tuple) else (entry.default,)
        unit = "" if entry.metadata["unit"] == "1" else f" {entry.metadata['unit']}"
        default = ", ".join(f"{value:.3g}" for value in values) + unit
        rows.append(f"| `{entry.name}` | {default} | {entry.metadata['source'].replace('|', chr(92) + '|')} |")
    return "\n".join(rows)


def states() -> str:
    """The page's table of transitions, from the docstring of ``failsafe``."""
    lines = [line.strip() for line in (failsafe.__doc__ or "").splitlines() if line.startswith("    ") and "->" in line]
    parts = [re.fullmatch(r"(\w+) -> (\w+) +(.+)", line) for line in lines]
    rows = [f"| `{part[1]}` to `{part[2]}` | {part[3].replace('``', '`')} |".replace("`any`", "any") for part in parts]
    return "\n".join(["| transition | when |", "|---|---|", *rows])


def test_the_table_of_limits_is_that_of_the_parameters():
    assert f"\n\n{limits()}\n" in PAGE


def test_the_state_machine_is_that_of_the_guard():
    assert states().count("\n") == 1 + 6  # the docstring names six
    assert f"\n\n{states()}\n" in PAGE


def test_every_mode_of_the_guard_is_explained():
    assert [mode.name for mode in setpoint.Mode if f"| `{mode.name}` |" not in PAGE] == []


def test_the_page_says_first_that_nothing_has_flown_and_that_a_kill_switch_is_required():
    begin = " ".join(PAGE.split("\n## ")[0].split())
    assert "Nothing here has flown on hardware" in begin
    assert "An independent kill switch is required" in begin
