"""The recorded flights: whole, small, documented, and what the scenarios say."""

import hashlib
from pathlib import Path

import pytest

from fiplib import bags
from fiplib.simulate import SCENARIOS, fly

DATA = Path(__file__).parent.parent / "data"


def test_every_scenario_is_recorded_and_described_in_the_readme():
    assert {path.parent.name for path in DATA.glob("*/metadata.yaml")} == set(SCENARIOS)
    readme = (DATA / "README.md").read_text(encoding="utf-8")
    for name in SCENARIOS:
        assert f"| `{name}` |" in readme


def test_the_checksums_are_those_of_the_files():
    listed = dict(reversed(line.split()) for line in (DATA / "SHA256SUMS").read_text().splitlines())
    files = {f"{name}/{file}" for name in SCENARIOS for file in (f"{name}.mcap", "metadata.yaml")}
    assert set(listed) == files | {"faults.csv"} | {f"sweeps/{path.name}" for path in (DATA / "sweeps").glob("*.csv")}
    for name, digest in listed.items():
        assert hashlib.sha256((DATA / name).read_bytes()).hexdigest() == digest, (
            f"data/{name}: made again without its checksum? see stored.py"
        )


def test_the_recordings_stay_under_25_megabytes():
    assert sum(path.stat().st_size for path in DATA.glob("*/*")) < 25e6


@pytest.mark.parametrize("name", SCENARIOS)
def test_a_recorded_flight_is_that_of_its_scenario_and_says_that_it_is_simulated(name):
    flight, scenario = bags.read(DATA / name), SCENARIOS[name]
    assert flight.simulated and flight.params == scenario.params and flight.metadata["seed"] == scenario.seed
    assert flight.truth_length.values[0, 0] == scenario.params.pendulum.length
    assert not flight.survived or flight.duration == pytest.approx(scenario.duration, abs=0.01)


@pytest.mark.parametrize("name", SCENARIOS)
def test_a_scenario_flown_again_is_its_bag_byte_for_byte(name, tmp_path):
    scenario = SCENARIOS[name]
    with bags.BagRecorder(tmp_path / name, scenario.metadata()) as recorder:
        flight = fly(scenario, recorder)
    assert flight.survived == bags.read(DATA / name).survived
    for file in (f"{name}.mcap", "metadata.yaml"):
        assert (tmp_path / name / file).read_bytes() == (DATA / name / file).read_bytes()


def test_a_recorded_push_is_data():
    flight = bags.read(DATA / "push-hover")
    pushes = [event for event in flight.events if event.kind == "push"]
    expected = [(list(push.impulse), push.duration) for push in SCENARIOS["push-hover"].pushes]
    assert [(event.data["impulse"], event.data["duration"]) for event in pushes] == expected
