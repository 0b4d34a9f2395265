"""The recorded flights: whole, small, documented, and what the scenarios say."""

import hashlib
from pathlib import Path

import pytest
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from fiplib import bags
from fiplib.recording import LOG
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
    assert set(listed) == files
    for name, digest in listed.items():
        assert hashlib.sha256((DATA / name).read_bytes()).hexdigest() == digest, f"data/{name}: run make bags"


def test_the_recordings_stay_under_25_megabytes():
    assert sum(path.stat().st_size for path in DATA.glob("*/*")) < 25e6


@pytest.mark.parametrize("name", SCENARIOS)
def test_a_recorded_flight_is_that_of_its_scenario_and_says_that_it_is_simulated(name):
    flight, scenario = bags.read(DATA / name), SCENARIOS[name]
    assert flight.simulated and flight.params == scenario.params and flight.metadata["seed"] == scenario.seed
    assert flight.truth_length.values[0, 0] == scenario.params.pendulum.length
    assert not flight.survived or flight.duration == pytest.approx(scenario.duration, abs=0.01)


def messages(path: Path, blank: bool) -> list[tuple]:
    """All messages of a bag as they lie in it; if asked, the events without their fields ``function`` and ``file``."""
    store, found = get_typestore(Stores.ROS2_HUMBLE), []
    with Reader(path) as reader:
        for connection, log_time, data in reader.messages():
            if blank and connection.msgtype == LOG:
                event = store.deserialize_cdr(data, LOG)
                data = (event.stamp, event.level, event.name, event.msg, event.line)
            found.append((connection.topic, log_time, data))
    return found


@pytest.mark.parametrize("name", ["push-hover", "length-jump"])
def test_a_scenario_flown_again_is_its_bag_byte_for_byte(name, tmp_path):
    scenario = SCENARIOS[name]
    with bags.BagRecorder(tmp_path / name, scenario.metadata()) as recorder:
        flight = fly(scenario, recorder)
    # data/ was recorded when events were sentences only: once it is recorded again, compare the files themselves
    assert messages(tmp_path / name, True) == messages(DATA / name, True)
    again, recorded = bags.read(tmp_path / name), bags.read(DATA / name)
    assert flight.events == again.events == recorded.events
    assert {event.kind for event in flight.events} <= {"push", "length", "fall", "status", "refusal"}
    assert flight.metadata == again.metadata == recorded.metadata
