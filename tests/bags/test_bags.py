"""A flight survives the bag unchanged, an independent reader agrees, and damage is one clear error."""

import argparse
import json
import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.rosbag2 import StoragePlugin, Writer

from fiplib import recording
from fiplib.bags import command as bag_command
from fiplib.bags import messages as layouts
from fiplib.bags import reader as bag_reader
from fiplib.bags.reader import read
from fiplib.bags.writer import BagRecorder
from fiplib.params import STATE_NAMES, FipError, Params
from fiplib.recording import BagError, Event
from fiplib.replay import why_not_refit

FRAMES = 96  # 0.4 s of motion capture: small, yet enough for every kind of message
PERIOD = 1_000_000_000 // 240
LATENCY = 4_166_667
SERIES = ("state", "command", "reference", "length", "truth_state", "truth_length")


PUSH = {"impulse": [-0.006, 0.0], "duration": 0.05}


class Numbers:
    """The numbers of a made-up flight, so that what was read can be held against what was written."""

    def __init__(self, frames: int = FRAMES, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self.stamp = np.arange(frames, dtype=np.int64) * PERIOD
        self.position = {body: rng.standard_normal((frames, 3)) for body in ("vehicle", "pendulum")}
        quaternion = {body: rng.standard_normal((frames, 4)) for body in ("vehicle", "pendulum")}
        self.orientation = {b: q / np.linalg.norm(q, axis=1, keepdims=True) for b, q in quaternion.items()}
        self.truth_state = rng.standard_normal((frames, 11))
        self.tick = self.stamp[::2]
        self.state, self.reference = rng.standard_normal((2, len(self.tick), 10))
        self.rates = rng.standard_normal((len(self.tick), 3))
        self.thrust = rng.uniform(0.0, 1.0, len(self.tick))
        self.estimated = self.stamp[::24]
        self.length = rng.uniform(0.5, 1.5, (len(self.estimated), 3))
        self.length[0, 1:] = np.nan  # no estimate yet


METADATA = {
    "origin": "simulated",
    "scenario": "push-in-hover, \u03bb = 3/4: # {'quoted'}",
    "seed": 7,
    "version": "0.1.0",
    "params": json.loads(json.dumps(Params().replace(pendulum__length=0.8, control__nodes=50).to_dict())),
}


def write(
    path: Path, numbers: Numbers, metadata: dict | None = None, recorder: Callable[..., BagRecorder] = BagRecorder
) -> Path:
    """Record the numbers the way a flight does: everything of one instant together."""
    with recorder(path, METADATA if metadata is None else metadata) as bag:
        for i, stamp in enumerate(numbers.stamp):
            bag.truth(stamp, numbers.truth_state[i])
            bag.truth_length(stamp, 0.8)
            for body in ("vehicle", "pendulum"):
                bag.pose(body, stamp, stamp + LATENCY, numbers.position[body][i], numbers.orientation[body][i])
            if i % 2 == 0:
                bag.state(stamp, numbers.state[i // 2])
                bag.reference(stamp, numbers.reference[i // 2])
                bag.command(stamp, numbers.rates[i // 2], numbers.thrust[i // 2])
            if i % 24 == 0:
                bag.length(stamp, *numbers.length[i // 24])
            if i == 30:
                bag.event(stamp, "info", "push of 6 mN s along \u2212x", "push", PUSH)
                bag.event(stamp, "warn", "failsafe")
    return path


@pytest.fixture(scope="module")
def numbers() -> Numbers:
    return Numbers()


@pytest.fixture(scope="module")
def bag(numbers: Numbers, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One bag that no test changes."""
    return write(tmp_path_factory.mktemp("bags") / "flight", numbers)


def mcap(bag: Path) -> Path:
    return bag / f"{bag.name}.mcap"


def copy(bag: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(bag, tmp_path / "flight"))


def arrays(flight: recording.Flight) -> dict[str, np.ndarray]:
    """Every number of a flight, by name."""
    found = {}
    for role in ("vehicle", "pendulum", *SERIES):
        data = getattr(flight, role)
        if data is not None:
            fields = ("stamp", "values") if role in SERIES else ("stamp", "received", "position", "orientation")
            found |= {f"{role}.{field}": getattr(data, field) for field in fields}
    return found


def same(one: recording.Flight, other: recording.Flight) -> bool:
    """Equal to the last bit (bytes, so that NaN equals NaN and 0.0 does not equal -0.0)."""
    ours, theirs = arrays(one), arrays(other)
    return (
        ours.keys() == theirs.keys()
        and all(ours[name].tobytes() == theirs[name].tobytes() for name in ours)
        and one.events == other.events
        and one.start_ns == other.start_ns
        and one.metadata == {key: other.metadata.get(key) for key in one.metadata}
    )


# --- what goes in comes out ----------------------------------------------------------------------------------------


def test_every_number_comes_back_to_the_last_bit(bag: Path, numbers: Numbers) -> None:
    flight = read(bag)
    for body in ("vehicle", "pendulum"):
        poses = getattr(flight, body)
        np.testing.assert_array_equal(poses.stamp, numbers.stamp)
        np.testing.assert_array_equal(poses.received, numbers.stamp + LATENCY)
        np.testing.assert_array_equal(poses.position, numbers.position[body])
        np.testing.assert_array_equal(poses.orientation, numbers.orientation[body])
    # AttitudeTarget carries thrust as float32: that rounding, and no other, is part of the contract.
    command = np.column_stack([numbers.rates, numbers.thrust.astype(np.float32).astype(float)])
    expected = {
        "state": (numbers.tick, numbers.state),
        "reference": (numbers.tick, numbers.reference),
        "command": (numbers.tick, command),
        "length": (numbers.estimated, numbers.length),
        "truth_state": (numbers.stamp, numbers.truth_state),
        "truth_length": (numbers.stamp, np.full((FRAMES, 1), 0.8)),
    }
    for role, (stamp, values) in expected.items():
        np.testing.assert_array_equal(getattr(flight, role).stamp, stamp, err_msg=role)
        np.testing.assert_array_equal(getattr(flight, role).values, values, err_msg=role)
    assert flight.events == (
        (30 * PERIOD, "info", "push of 6 mN s along \u2212x", "push", PUSH),
        (30 * PERIOD, "warn", "failsafe", "note", {}),
    )


def test_the_metadata_come_back_and_say_that_the_flight_is_simulated(bag: Path) -> None:
    flight = read(bag)
    assert flight.metadata == METADATA
    assert flight.simulated
    assert flight.params == Params().replace(pendulum__length=0.8, control__nodes=50)


def test_names_units_and_times_come_with_the_arrays(bag: Path, numbers: Numbers) -> None:
    flight = read(bag)
    assert flight.state.names == STATE_NAMES and flight.truth_state.names == (*STATE_NAMES, "z")
    assert flight.command.units == ("rad/s", "rad/s", "rad/s", "1")
    np.testing.assert_array_equal(flight.truth_state.column("z"), numbers.truth_state[:, 10])
    np.testing.assert_array_equal(flight.time(flight.state), numbers.tick / 1e9)
    assert flight.time(flight.events[0]) == 30 * PERIOD / 1e9
    assert flight.duration == numbers.stamp[-1] / 1e9
    with pytest.raises(KeyError, match="columns are x, x_dot"):
        flight.state.column("altitude")


def test_all_arrays_are_read_only(bag: Path) -> None:
    for name, array in arrays(read(bag)).items():
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0
        assert array.flags.c_contiguous, name


def test_the_same_flight_is_written_to_the_same_bytes(bag: Path, tmp_path: Path) -> None:
    again = write(tmp_path / "flight", Numbers())
    assert sorted(os.listdir(again)) == ["flight.mcap", "metadata.yaml"]
    for name in os.listdir(again):
        assert (again / name).read_bytes() == (bag / name).read_bytes()


def test_messages_lie_in_the_order_of_log_time(bag: Path) -> None:
    with mcap(bag).open("rb") as stream:
        times = [message.log_time for _, _, message in make_reader(stream).iter_messages(log_time_order=False)]
    assert len(times) > 5 * FRAMES and times == sorted(times)


def test_more_messages_than_are_held_back_for_sorting_keep_their_order(tmp_path: Path) -> None:
    numbers = Numbers(frames=2 * 240 * 5)  # 10 s: 13 000 messages, six times what the recorder holds back
    flight = read(write(tmp_path / "long", numbers))
    np.testing.assert_array_equal(flight.vehicle.position, numbers.position["vehicle"])
    with (tmp_path / "long" / "long.mcap").open("rb") as stream:
        times = [message.log_time for _, _, message in make_reader(stream).iter_messages(log_time_order=False)]
    assert times == sorted(times)
    assert why_not_refit(flight) is None


def test_an_independent_reader_agrees_on_every_value(bag: Path) -> None:
    flight = read(bag)
    seen = {role: [] for role in recording.ROLES}
    roles = {topic: role for role, topic in recording.TOPICS.items()}
    with mcap(bag).open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for schema, channel, message, ros in reader.iter_decoded_messages():
            role = roles[channel.topic]
            assert schema.name == recording.ROLES[role].type
            stamp = ros.stamp if role == "events" else ros.header.stamp
            time = stamp.sec * 1_000_000_000 + stamp.nanosec
            match schema.name.rpartition("/")[2]:
                case "PoseStamped":
                    p, q = ros.pose.position, ros.pose.orientation
                    seen[role].append((time, message.log_time, p.x, p.y, p.z, q.x, q.y, q.z, q.w))
                    assert ros.header.frame_id == "world"
                case "JointState":
                    assert tuple(ros.name) == recording.ROLES[role].names
                    assert len(ros.velocity) == len(ros.effort) == 0
                    seen[role].append((time, *ros.position))
                case "AttitudeTarget":
                    rate, q = ros.body_rate, ros.orientation
                    assert ros.type_mask == 128 and (q.x, q.y, q.z, q.w) == (0.0, 0.0, 0.0, 1.0)
                    seen[role].append((time, rate.x, rate.y, rate.z, ros.thrust))
                case "PointStamped":
                    seen[role].append((time, ros.point.x, ros.point.y, ros.point.z))
                case "Log":
                    assert ros.name == "fip"
                    seen[role].append((time, {20: "info", 30: "warn"}[ros.level], ros.msg, ros.function))
                    assert json.loads(ros.file or "{}") == (PUSH if ros.function == "push" else {})
    for body in ("vehicle", "pendulum"):
        poses, rows = getattr(flight, body), seen[body]
        assert [row[:2] for row in rows] == list(zip(poses.stamp, poses.received, strict=True))
        np.testing.assert_array_equal(np.array([row[2:] for row in rows])[:, :3], poses.position)
        np.testing.assert_array_equal(np.array([row[2:] for row in rows])[:, 3:], poses.orientation)
    for role in SERIES:
        series = getattr(flight, role)
        assert [row[0] for row in seen[role]] == series.stamp.tolist()
        values = np.array([row[1:] for row in seen[role]])
        np.testing.assert_array_equal(values[:, : series.values.shape[1]], series.values, err_msg=role)
    assert tuple(seen["events"]) == tuple(event[:4] for event in flight.events)


@pytest.mark.parametrize("kind", [recording.POSE, recording.POINT, recording.JOINTS, recording.ATTITUDE])
@pytest.mark.parametrize("frame", ["", "w", "map", "world", "a_frame_of_some_length"])
def test_the_vectorised_decoder_agrees_with_the_library(kind: str, frame: str) -> None:
    """CDR pads by alignment, so the length of the frame id moves every number."""
    layout = layouts.Layout.of(kind, frame, ("one", "joint_two", "3") if kind == recording.JOINTS else ())
    rng = np.random.default_rng(len(frame))
    rows = rng.standard_normal((5, layout.doubles + layout.singles)).astype(np.float32).astype(float)
    messages = [layout.encode(10**18 + i, row) for i, row in enumerate(rows)]
    stamp, values = layout.decode(messages)
    slow_stamp, slow_values = bag_reader._decode_one_by_one(kind, messages)
    np.testing.assert_array_equal(stamp, 10**18 + np.arange(5))
    np.testing.assert_array_equal(stamp, slow_stamp)
    np.testing.assert_array_equal(values, rows)
    np.testing.assert_array_equal(values, slow_values)
    message = layouts.typestore().deserialize_cdr(messages[0], kind)
    assert bytes(layouts.typestore().serialize_cdr(message, kind)) == messages[0]


# --- the recorder --------------------------------------------------------------------------------------------------


def test_the_recorder_does_not_overwrite(bag: Path) -> None:
    before = mcap(bag).read_bytes()
    with pytest.raises(BagError, match="exists already"):
        BagRecorder(bag, METADATA)
    assert mcap(bag).read_bytes() == before


@pytest.mark.parametrize(
    ("metadata", "words"),
    [
        ({}, "origin"),
        ({"origin": "flown"}, "origin"),
        ({"origin": "real", "checksum": 1}, "'checksum' is written by the recorder"),
        ({"origin": "real", "limit": float("inf")}, "do not fit into JSON"),
        ({"origin": "real", "limit": np.zeros(2)}, "do not fit into JSON"),
    ],
)
def test_the_recorder_refuses_metadata_that_would_not_come_back(tmp_path: Path, metadata: dict, words: str) -> None:
    with pytest.raises(BagError, match=words):
        BagRecorder(tmp_path / "flight", metadata)
    assert not (tmp_path / "flight").exists()


def test_the_recorder_refuses_what_the_contract_does_not_hold(tmp_path: Path) -> None:
    with BagRecorder(tmp_path / "flight", METADATA) as bag:
        with pytest.raises(BagError, match=r"cannot record state .* x, x_dot"):
            bag.state(0, np.zeros(9))
        with pytest.raises(BagError, match="cannot record state"):
            bag.state(0, ["fast"] * 10)
        with pytest.raises(BagError, match="bodies are vehicle and pendulum"):
            bag.pose("state", 0, 0, (0, 0, 0), (0, 0, 0, 1))
        with pytest.raises(BagError, match="levels are debug"):
            bag.event(0, "loud", "bang")
        for stamp in (-1, 2**31 * 10**9):
            with pytest.raises(BagError, match="does not fit into a ROS time"):
                bag.length(stamp, 1.0, 1.0, 0.1)


def test_a_flight_that_ends_by_an_exception_is_recorded_up_to_there(tmp_path: Path, numbers: Numbers) -> None:
    with pytest.raises(KeyboardInterrupt), BagRecorder(tmp_path / "flight", METADATA) as bag:
        for i in range(10):
            for body in ("vehicle", "pendulum"):
                bag.pose(body, i, i + 5, numbers.position[body][i], numbers.orientation[body][i])
        raise KeyboardInterrupt
    flight = read(tmp_path / "flight")
    assert len(flight.vehicle.stamp) == 10
    assert flight.events == ((14, "fatal", "recording ended by KeyboardInterrupt", "note", {}),)


# --- bags of others ------------------------------------------------------------------------------------------------

TYPES = layouts.typestore().types


def foreign(
    path: Path,
    messages: list[tuple[str, str, int, bytes]],
    storage: StoragePlugin = StoragePlugin.MCAP,
    metadata: dict[str, str] | None = None,
) -> Path:
    """A bag made by the library alone: (topic, type, log time, message)."""
    with Writer(path, version=9, storage_plugin=storage) as writer:
        for key, value in (metadata or {}).items():
            writer.set_custom_data(key, value)
        connections = {}
        for topic, kind, time, data in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=layouts.typestore())
            if data:
                writer.write(connections[topic], time, data)
    return path


def poses(topic: str, frame: str = "map", count: int = 5) -> list[tuple[str, str, int, bytes]]:
    layout = layouts.Layout.of(recording.POSE, frame)
    rows = [(10**18 + i * PERIOD, (0.1 * i, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)) for i in range(count)]
    return [(topic, recording.POSE, stamp + 10, layout.encode(stamp, row)) for stamp, row in rows]


MOCAP = poses("/mocap/quad/pose") + poses("/mocap/pendulum/pose")


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_two_mocap_topics_alone_are_a_flight(tmp_path: Path, storage: StoragePlugin) -> None:
    flight = read(foreign(tmp_path / "lab", MOCAP, storage))
    assert flight.metadata == {"origin": "unknown"} and not flight.simulated
    assert flight.params == Params()
    assert [getattr(flight, role) for role in SERIES] == [None] * len(SERIES) and flight.events == ()
    np.testing.assert_array_equal(flight.vehicle.position[:, 0], 0.1 * np.arange(5))
    np.testing.assert_array_equal(flight.time(flight.vehicle), np.arange(5) * PERIOD / 1e9)
    assert "holds no commands (topic /fip/command)" in why_not_refit(flight)


def test_events_that_are_sentences_only_are_understood(tmp_path: Path) -> None:
    """So were all events of the first recordings; the impulses of pushes stood in the metadata alone."""
    said = {
        "push of 8 mN s on the rod's COM": ("push", {"impulse": [0.008, 0.0], "duration": 0.05}),
        "pilot is told the length 0.4 m": ("length", {"length": 0.4}),
        "MPC status max_iterations": ("status", {"status": "max_iterations"}),
        "no estimate: too little: of all": ("refusal", {"reason": "too little: of all"}),
        "failsafe: flying -> level: no pose for 0.1 s: blind": (
            "mode",
            {"from": "flying", "to": "level", "reason": "no pose for 0.1 s: blind"},
        ),
        "a push by hand": ("note", {}),
        "pushed again": ("push", {}),
        "rod or vehicle fell: flight ended": ("fall", {}),
    }
    pushes = [{"start": 5.3, "impulse": [0.008, 0.0], "duration": 0.05}]
    events = []
    for i, text in enumerate(said):
        time = TYPES["builtin_interfaces/msg/Time"](10**9, i)
        message = TYPES[recording.LOG](time, 20, "fip", text, "", "", 0)
        data = bytes(layouts.typestore().serialize_cdr(message, recording.LOG))
        events.append(("/fip/events", recording.LOG, 10**18 + i, data))
    path = foreign(tmp_path / "old", MOCAP + events, metadata={"pushes": json.dumps(pushes)})
    flight = read(path)
    assert flight.events == tuple(
        Event(10**18 + i, "info", text, *known) for i, (text, known) in enumerate(said.items())
    )
    assert not flight.survived


def test_a_flight_shorter_than_a_window_says_so(bag: Path) -> None:
    # 55 samples span 54 periods of 0.1 s; poses and commands share 94 frames.
    assert "overlap for 0.4 s only, one estimation window is 5.4 s" in why_not_refit(read(bag))


def test_topics_can_be_remapped(tmp_path: Path) -> None:
    topics = {"vehicle": "/vrpn_mocap/quad/pose", "pendulum": "/natnet_ros/rod/pose"}
    flight = read(foreign(tmp_path / "lab", [m for topic in topics.values() for m in poses(topic)]), topics)
    assert len(flight.vehicle.stamp) == len(flight.pendulum.stamp) == 5
    assert {info.topic: info.role for info in flight.topics} == {topic: role for role, topic in topics.items()}


def test_a_missing_topic_is_named_with_those_present_and_the_way_to_remap(tmp_path: Path) -> None:
    lab = foreign(tmp_path / "lab", poses("/vrpn_mocap/quad/pose") + poses("/mocap/pendulum/pose"))
    with pytest.raises(BagError) as caught:
        read(lab)
    for words in (str(lab), "/mocap/quad/pose (vehicle)", "/vrpn_mocap/quad/pose", "topics={", "--topic vehicle="):
        assert words in str(caught.value)
    with pytest.raises(BagError, match=r"no topic /elsewhere \(state\)"):
        read(lab, {"vehicle": "/vrpn_mocap/quad/pose", "state": "/elsewhere"})
    with pytest.raises(BagError, match="no such role 'quad'"):
        read(lab, {"quad": "/vrpn_mocap/quad/pose"})


def test_messages_that_differ_in_frame_or_byte_order_are_read_too(tmp_path: Path) -> None:
    mixed = poses("/mocap/quad/pose", "map", 3) + poses("/mocap/quad/pose", "mocap_frame", 5)[3:]
    store = layouts.typestore()
    big = [
        (topic, kind, time, bytes(store.serialize_cdr(store.deserialize_cdr(data, kind), kind, little_endian=False)))
        for topic, kind, time, data in poses("/mocap/pendulum/pose")
    ]
    flight = read(foreign(tmp_path / "lab", mixed + big))
    reference = read(foreign(tmp_path / "plain", MOCAP))
    assert same(reference, flight)


def test_a_real_bag_can_be_labelled_by_hand(tmp_path: Path) -> None:
    lab = foreign(tmp_path / "lab", MOCAP)
    text = (lab / "metadata.yaml").read_text()
    assert "custom_data: null" in text
    labelled = text.replace("custom_data: null", "custom_data: {origin: real, pilot: Ada}")
    (lab / "metadata.yaml").write_text(labelled)
    assert read(lab).metadata == {"origin": "real", "pilot": "Ada"}
    (lab / "metadata.yaml").write_text(labelled.replace("real", "Real"))
    with pytest.raises(BagError, match="its origin 'Real' is none of simulated, real, unknown"):
        read(lab)


def joints(names: list[str], count: int) -> bytes:
    header = TYPES["std_msgs/msg/Header"](TYPES["builtin_interfaces/msg/Time"](0, 0), "world")
    empty = np.zeros(0)
    message = TYPES[recording.JOINTS](header, names, np.zeros(count), empty, empty)
    return bytes(layouts.typestore().serialize_cdr(message, recording.JOINTS))


def changed(index: int, **changes: object) -> list[tuple[str, str, int, bytes]]:
    """The mocap messages with message ``index`` of the vehicle changed: its stamp, position or orientation."""
    topic, kind, time, data = MOCAP[index]
    stamp, values = layouts.Layout.of(recording.POSE, "map").decode([data])
    row = [*changes.get("position", values[0, :3]), *changes.get("orientation", values[0, 3:])]
    data = layouts.Layout.of(recording.POSE, "map").encode(int(changes.get("stamp", stamp[0])), row)
    return [*MOCAP[:index], (topic, kind, time, data), *MOCAP[index + 1 :]]


def command(type_mask: int) -> bytes:
    data = bytearray(layouts.Layout.of(recording.ATTITUDE, "world").template)
    assert data[22] == 128  # 4 bytes of encapsulation, 8 of stamp, 4 of length, "world" and its zero
    data[22] = type_mask
    return bytes(data)


NAN, STAMP = float("nan"), 10**18
FAULTS = {
    "NaN position": (changed(2, position=(NAN, 0.0, 0.0)), "quad/pose", "message 2 of 5 holds a NaN"),
    "infinite position": (changed(4, position=(0.0, float("inf"), 0.0)), "quad/pose", "message 4 of 5"),
    "NaN orientation": (changed(0, orientation=(NAN, 0.0, 0.0, 1.0)), "quad/pose", "message 0 of 5"),
    "zero quaternion": (changed(3, orientation=(0.0,) * 4), "quad/pose", "quaternion of message 3 has norm 0"),
    "long quaternion": (changed(1, orientation=(0.0, 0.0, 0.0, 1.002)), "quad/pose", "has norm 1.002"),
    "stamp goes back": (changed(3, stamp=STAMP), "quad/pose", "stamp of message 3 .* is not after"),
    "stamp stands still": (changed(1, stamp=STAMP), "quad/pose", "stamp of message 1"),
    "wrong type": (
        [("/mocap/quad/pose", recording.POINT, 0, layouts.Layout.of(recording.POINT, "map").template), *MOCAP[5:]],
        "quad/pose",
        "is of type geometry_msgs/msg/PointStamped, not geometry_msgs/msg/PoseStamped",
    ),
    "empty topic": ([("/mocap/quad/pose", recording.POSE, 0, b""), *MOCAP[5:]], "quad/pose", "is empty"),
    "no topics": ([], "quad/pose", "the bag holds none"),
    "other names": (
        [*MOCAP, ("/fip/state", recording.JOINTS, 0, joints([*"abcdefghij"], 10))],
        "/fip/state",
        "its names are a, b, c, .* not x, x_dot",
    ),
    "no names": ([*MOCAP, ("/fip/state", recording.JOINTS, 0, joints([], 0))], "/fip/state", "its names are none"),
    "too few positions": (
        [*MOCAP, ("/fip/state", recording.JOINTS, 0, joints([*STATE_NAMES], 9))],
        "/fip/state",
        "not one position for each",
    ),
    "names change": (
        [
            *MOCAP,
            ("/fip/state", recording.JOINTS, 0, joints([*STATE_NAMES], 10)),
            ("/fip/state", recording.JOINTS, 0, joints([*STATE_NAMES[:9], "thetb"], 10)),
        ],
        "/fip/state",
        "message 1 has other names",
    ),
    "attitude command": (
        [*MOCAP, ("/fip/command", recording.ATTITUDE, 0, command(7))],
        "/fip/command",
        "no body rates",
    ),
    "message of one byte": ([("/mocap/quad/pose", recording.POSE, 0, b"x"), *MOCAP[5:]], "quad/pose", "CDR"),
    "message cut short": (
        [*MOCAP[:4], (*MOCAP[4][:3], MOCAP[4][3][:40]), *MOCAP[5:]],
        "quad/pose",
        "Could not deserialize",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_of_a_topic_is_one_line_with_file_and_topic(tmp_path: Path, fault: str) -> None:
    messages, topic, words = FAULTS[fault]
    lab = foreign(tmp_path / "lab", messages)
    with pytest.raises(BagError, match=words) as caught:
        read(lab)
    assert str(lab) in str(caught.value) and topic in str(caught.value) and "\n" not in str(caught.value)


def test_an_attitude_that_is_sent_along_does_not_disturb_the_rates(tmp_path: Path) -> None:
    messages = [*MOCAP, *(("/fip/command", recording.ATTITUDE, i, command(mask)) for i, mask in enumerate((0,)))]
    np.testing.assert_array_equal(read(foreign(tmp_path / "lab", messages)).command.values, np.zeros((1, 4)))


@pytest.mark.parametrize("role", ["command", "length", "events"])
def test_an_optional_topic_without_messages_counts_as_absent(tmp_path: Path, role: str) -> None:
    entry = recording.ROLES[role]
    flight = read(foreign(tmp_path / "lab", [*MOCAP, (entry.topic, entry.type, 0, b"")]))
    assert not getattr(flight, role)


# --- damage --------------------------------------------------------------------------------------------------------


def test_a_missing_path_and_a_path_that_is_no_bag_say_so(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("not a bag")
    for path, words in (("gone", "no such file"), ("notes.txt", "not a bag"), (".", "not a bag: neither metadata")):
        with pytest.raises(BagError, match=words):
            read(tmp_path / path)


@pytest.mark.parametrize("bare", [True, False])
def test_without_metadata_yaml_the_copy_inside_the_mcap_speaks(bag: Path, tmp_path: Path, bare: bool) -> None:
    whole = read(bag)
    broken = copy(bag, tmp_path)
    (broken / "metadata.yaml").unlink()
    assert same(whole, read(mcap(broken) if bare else broken))


def test_two_mcap_files_without_metadata_are_not_guessed_at(bag: Path, tmp_path: Path) -> None:
    broken = copy(bag, tmp_path)
    (broken / "metadata.yaml").unlink()
    shutil.copy(mcap(broken), broken / "other.mcap")
    with pytest.raises(BagError, match="there are 2"):
        read(broken)


def test_edited_metadata_are_refused(bag: Path, tmp_path: Path) -> None:
    broken = copy(bag, tmp_path)
    text = (broken / "metadata.yaml").read_text()
    assert text.count('"simulated"') == 1
    (broken / "metadata.yaml").write_text(text.replace('"simulated"', '"real"'))
    with pytest.raises(BagError, match="damaged or edited since the recording"):
        read(broken)


def test_parameters_of_another_version_are_an_error_only_where_they_are_used(tmp_path: Path, numbers: Numbers) -> None:
    flight = read(write(tmp_path / "flight", numbers, {"origin": "real", "params": {"wings": {"span": 1.0}}}))
    assert flight.vehicle.position.shape == (FRAMES, 3)
    with pytest.raises(BagError, match="not those of this version"):
        _ = flight.params


@pytest.mark.parametrize("bare", [True, False])
def test_a_truncated_file_says_how_many_messages_are_intact(tmp_path: Path, bare: bool) -> None:
    long = write(tmp_path / "flight", Numbers(frames=3000))  # 14 000 messages: several chunks of 1 MiB
    total = sum(info.count for info in read(long).topics)
    data = mcap(long).read_bytes()
    mcap(long).write_bytes(data[: int(0.8 * len(data))])
    with pytest.raises(BagError, match="damaged or incomplete") as caught:
        read(mcap(long) if bare else long)
    intact = int(str(caught.value).split(").")[1].split()[0])
    # Whole chunks survive, the one that was cut does not: some are lost, and not all.
    assert 0.3 * total < intact < total
    assert f"fip bag recover {mcap(long) if bare else long}" in str(caught.value)


@pytest.mark.parametrize("part", [0.0, 0.3, 0.9])
def test_a_zeroed_tail_is_an_error(bag: Path, tmp_path: Path, part: float) -> None:
    broken = copy(bag, tmp_path)
    data = mcap(broken).read_bytes()
    kept = int(part * len(data))
    mcap(broken).write_bytes(data[:kept] + bytes(len(data) - kept))
    with pytest.raises(BagError, match="damaged or incomplete"):
        read(broken)


def outcome(whole: recording.Flight, directory: Path, files: dict[str, bytes], bare: bool) -> str:
    """Read a bag made of these bytes: it must be the same flight, or a BagError on one line; never anything else."""
    for name, data in files.items():
        (directory / name).write_bytes(data)
    try:
        flight = read(directory / "flight.mcap" if bare else directory)
        why_not_refit(flight)
        assert same(whole, flight), "a damaged bag was read as another flight"
    except BagError as error:
        assert "\n" not in str(error) and str(directory) in str(error)
        return "refused"
    return "same"


@settings(max_examples=80, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(data=st.data(), name=st.sampled_from(["flight.mcap", "metadata.yaml"]), bare=st.booleans())
def test_no_damage_passes_as_another_flight(bag: Path, data: st.DataObject, name: str, bare: bool) -> None:
    whole, files = read(bag), {file.name: file.read_bytes() for file in bag.iterdir()}
    damaged = bytearray(files[name])
    for _ in range(data.draw(st.integers(1, 3), label="faults")):
        at = data.draw(st.integers(0, max(len(damaged) - 1, 0)), label="at")
        match data.draw(st.sampled_from(["flip", "cut", "zero", "insert", "drop"]), label="fault"):
            case "flip":
                damaged[at : at + 1] = bytes(
                    b ^ data.draw(st.integers(1, 255), label="xor") for b in damaged[at : at + 1]
                )
            case "cut":
                del damaged[at:]
            case "zero":
                end = at + data.draw(st.integers(1, 64), label="count")
                damaged[at:end] = bytes(len(damaged[at:end]))
            case "insert":
                damaged[at:at] = data.draw(st.binary(min_size=1, max_size=8), label="bytes")
            case "drop":
                del damaged[at : at + data.draw(st.integers(1, 8), label="count")]
    with tempfile.TemporaryDirectory() as directory:
        outcome(whole, Path(directory), files | {name: bytes(damaged)}, bare)


def test_no_flipped_bit_of_the_index_passes_as_another_flight(bag: Path, tmp_path: Path) -> None:
    """The index at the end of the file has no checksum: the counts that the bag carries must catch it."""
    files = {file.name: file.read_bytes() for file in bag.iterdir()}
    whole, data = read(bag), files["flight.mcap"]
    tally = {"same": 0, "refused": 0}
    rng = np.random.default_rng(1)
    for at in range(len(data) - 400, len(data), 3):  # the chunk index, the statistics, the footer
        damaged = bytearray(data)
        damaged[at] ^= int(rng.integers(1, 256))
        tally[outcome(whole, tmp_path, files | {"flight.mcap": bytes(damaged)}, bare=at % 2 == 0)] += 1
    assert tally["refused"] > 20  # otherwise the bytes that matter were not among them


# --- command line --------------------------------------------------------------------------------------------------


def run(*arguments: object, **remarks: Callable[[recording.Flight], str]) -> int:
    parser = argparse.ArgumentParser()
    bag_command.add_arguments(parser, remarks)
    return bag_command.run(parser.parse_args([str(argument) for argument in arguments]))


def test_info_says_what_a_bag_holds(bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("info", bag, refit=lambda flight: f"{flight.duration:.1f} s are too short") == 0
    printed = capsys.readouterr().out
    lines = printed.splitlines()
    assert "refit      0.4 s are too short" in lines
    for words in (
        "SIMULATED",
        "push-in-hover",
        "0.1.0",
        "0.40 s",
        "pendulum.length = 0.8 m (default 1.0)",
        "control.nodes = 50",
    ):
        assert words in printed
    # 96 poses in 95 periods of 1/240 s; 48 commands with the same end points but one frame.
    assert ["/mocap/quad/pose", recording.POSE, "96", "240.0", "vehicle"] in [line.split() for line in lines]
    assert ["/fip/command", recording.ATTITUDE, "48", "118.7", "command"] in [line.split() for line in lines]


def test_info_remaps_topics(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lab = foreign(tmp_path / "lab", poses("/quad/pose") + poses("/mocap/pendulum/pose"))
    assert run("info", lab, "--topic", "vehicle=/quad/pose") == 0
    printed = capsys.readouterr().out
    assert "unknown (the bag does not say)" in printed and "none" in printed


def test_info_of_no_bag_says_so_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(FipError, match="no such file") as caught:
        run("info", tmp_path / "gone")
    assert "\n" not in str(caught.value)
