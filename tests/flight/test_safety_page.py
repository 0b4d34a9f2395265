"""docs/safety.md says what the code does: its limits and its state machine are those of the code."""

import dataclasses
from pathlib import Path

from fiplib.flight import setpoint
from fiplib.flight.limits import Safety
from fiplib.flight.transitions import ARMED, TRANSITIONS

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
    """The page's table of transitions, from the failsafe's own: what to paste there when one has changed."""
    rows = ["| from | when | to |", "|---|---|---|"]
    for row in TRANSITIONS:
        before = {ARMED: "any armed", tuple(setpoint.Mode): "any"}.get(row.before)
        before = before or ", ".join(f"`{mode.name}`" for mode in row.before)
        rows.append(f"| {before} | {row.words} | `{row.after.name}`{', final' if row.final else ''} |")
    return "\n".join(rows)


def test_the_table_of_limits_is_that_of_the_parameters():
    assert f"\n\n{limits()}\n" in PAGE


def test_the_state_machine_is_that_of_the_guard():
    assert f"\n\n{states()}\n" in PAGE


def test_every_mode_of_the_guard_is_explained():
    assert [mode.name for mode in setpoint.Mode if f"| `{mode.name}` |" not in PAGE] == []


def test_the_page_says_first_that_nothing_has_flown_and_that_a_kill_switch_is_required():
    begin = " ".join(PAGE.split("\n## ")[0].split())
    assert "Nothing here has flown on hardware" in begin
    assert "An independent kill switch is required" in begin
