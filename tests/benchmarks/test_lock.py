"""The rivals' lock: every rival pinned by hash, and what both locks hold in one version."""

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]


def locked(path: str) -> dict[str, str]:
    return dict(re.findall(r"^([a-z0-9-]+)==(\S+)", (ROOT / path).read_text(), re.MULTILINE))


def test_the_rivals_lock_pins_every_rival_and_holds_no_address():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    names = [
        re.match(r"[\w-]+", line)[0] for line in [*project["dependencies"], *project["optional-dependencies"]["bench"]]
    ]
    assert set(names) <= set(locked("benchmarks/requirements.lock"))
    text = (ROOT / "benchmarks/requirements.lock").read_text()
    assert "://" not in text and text.count("==") <= text.count("--hash=sha256:")


def test_rivals_are_measured_with_the_versions_that_we_fly():
    ours, rivals = locked("requirements.lock"), locked("benchmarks/requirements.lock")
    assert {name: rivals[name] for name in ours.keys() & rivals.keys()} == {
        name: ours[name] for name in ours.keys() & rivals.keys()
    }
