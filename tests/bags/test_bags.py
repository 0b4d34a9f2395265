"""A flight survives the bag unchanged, an independent reader agrees, and damage is one clear error."""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from operator import itemgetter
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.interfaces import Nodetype
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from fiplib import recording
from fiplib.bags import messages as layouts
from fiplib.bags.decoding import Decoder
from fiplib.bags.mending import mended
from fiplib.bags.reader import read
from fiplib.bags.recovery import recover
from fiplib.bags.sources import Block, Stored
from fiplib.bags.writer import BagRecorder
from fiplib.commands import bag as bag_command
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
            bag.numbers("truth_state", stamp, numbers.truth_state[i])
            bag.numbers("truth_length", stamp, [0.8])
            for body in ("vehicle", "pendulum"):
                bag.pose(body, stamp, stamp + LATENCY, numbers.position[body][i], numbers.orientation[body][i])
            if i % 2 == 0:
                bag.numbers("state", stamp, numbers.state[i // 2])
                bag.numbers("reference", stamp, numbers.reference[i // 2])
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


def decoded(kind: str, messages: list[bytes], body: str = "", definition: str = "") -> tuple[np.ndarray, ...]:
    """Stamps, log times and values of messages that lie in one piece of memory, each behind some other bytes."""
    decoder = Decoder(Stored(kind, len(messages), definition), body)
    end = np.cumsum([len(message) + 3 for message in messages])
    start = end - [len(message) for message in messages]
    content = b"".join(b"\xff\xff\xff" + message for message in messages)
    decoder.take(Block("/topic", np.arange(len(messages)), content, start, end))
    return decoder.arrays()


@pytest.mark.parametrize("kind", [recording.POSE, recording.POINT, recording.JOINTS, recording.ATTITUDE])
@pytest.mark.parametrize("frame", ["", "w", "map", "world", "a_frame_of_some_length"])
def test_the_vectorised_decoder_agrees_with_the_library(kind: str, frame: str) -> None:
    """CDR pads by alignment, so the length of the frame id moves every number."""
    layout = layouts.Layout.of(kind, frame, ("one", "joint_two", "3") if kind == recording.JOINTS else ())
    rng = np.random.default_rng(len(frame))
    rows = rng.standard_normal((5, layout.doubles + layout.singles)).astype(np.float32).astype(float)
    messages = [layout.encode(10**18 + i, row) for i, row in enumerate(rows)]
    stamp, _, values = decoded(kind, messages)
    np.testing.assert_array_equal(stamp, 10**18 + np.arange(5))
    np.testing.assert_array_equal(values[:, : rows.shape[1]], rows)
    store = layouts.typestore()
    message = store.deserialize_cdr(messages[0], kind)
    assert bytes(store.serialize_cdr(message, kind)) == messages[0]
    turned = store.serialize_cdr(message, kind, little_endian=False)
    np.testing.assert_array_equal(decoded(kind, [messages[1], bytes(turned)])[2], values[[1, 0]])


TYPES = layouts.typestore().types


def header(stamp: int, frame: str = "map") -> object:
    return TYPES["std_msgs/msg/Header"](TYPES["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9)), frame)


def made(kind: str, fields: dict[str, object], store: Typestore) -> object:
    """A message of any type: zeros everywhere but where ``fields`` (``pose.position.x``) say otherwise."""

    def build(node: Nodetype, detail: object, name: str) -> object:
        if name in fields:
            return fields[name]
        if node == Nodetype.NAME:
            inner = [build(*about, f"{name}.{field}".lstrip(".")) for field, about in store.fielddefs[detail][1]]
            return store.types[detail](*inner)
        if node == Nodetype.BASE:
            return "" if detail[0] == "string" else 0
        (inner, _), count = detail
        assert inner == Nodetype.BASE or node == Nodetype.SEQUENCE
        return np.zeros(count) if node == Nodetype.ARRAY else []

    return build(Nodetype.NAME, kind, "")


NAMED_POSES = (
    "std_msgs/Header header\nmotion_capture_tracking_interfaces/NamedPose[] poses\n"
    + "=" * 80
    + "\nMSG: motion_capture_tracking_interfaces/NamedPose\nstring name\ngeometry_msgs/Pose pose\n"
)


@pytest.mark.parametrize(
    ("kind", "place"),
    [
        ("geometry_msgs/msg/PoseWithCovarianceStamped", "pose.pose"),
        ("nav_msgs/msg/Odometry", "pose.pose"),
        ("geometry_msgs/msg/TransformStamped", "transform"),
    ],
)
def test_a_pose_is_found_in_any_type_that_carries_one(kind: str, place: str) -> None:
    store = layouts.typestore()
    names = ("translation", "rotation") if place == "transform" else ("position", "orientation")
    rows = np.random.default_rng(0).standard_normal((6, 7))
    messages = []
    for i, row in enumerate(rows):
        fields = {f"{place}.{names[0]}.{axis}": x for axis, x in zip("xyz", row, strict=False)}
        fields |= {f"{place}.{names[1]}.{axis}": x for axis, x in zip("xyzw", row[3:], strict=True)}
        fields |= {"header": header(10**18 + i, "w" * (i % 3)), "child_frame_id": "body"[: i % 2]}
        messages.append(bytes(store.serialize_cdr(made(kind, fields, store), kind)))
    stamp, received, values = decoded(kind, messages)
    np.testing.assert_array_equal(stamp, 10**18 + np.arange(6))
    np.testing.assert_array_equal(received, np.arange(6))
    np.testing.assert_array_equal(values, rows)


def transforms(names: list[str], stamp: int, row: np.ndarray) -> bytes:
    """A message of tf whose i-th child lies at ``row`` + i."""
    vector, turn = TYPES["geometry_msgs/msg/Vector3"], TYPES["geometry_msgs/msg/Quaternion"]
    moved = [TYPES["geometry_msgs/msg/Transform"](vector(*(row[:3] + i)), turn(*row[3:])) for i in range(len(names))]
    kind = "geometry_msgs/msg/TransformStamped"
    found = [TYPES[kind](header(stamp), name, transform) for name, transform in zip(names, moved, strict=True)]
    return bytes(layouts.typestore().serialize_cdr(TYPES[TF](found), TF))


TF = "tf2_msgs/msg/TFMessage"


def test_a_body_is_found_in_tf_wherever_it_stands_in_a_message() -> None:
    """Several children in one message, in any order, or one of them alone; others come and go."""
    lists = [["quad", "rod"], ["rod"], ["camera"], ["rod", "a", "quad"], [], ["rod", "quad"]]
    rows = np.random.default_rng(1).standard_normal((len(lists), 7))
    messages = [transforms(names, 10**18 + i, row) for i, (names, row) in enumerate(zip(lists, rows, strict=True))]
    for body in ("quad", "rod"):
        stamp, received, values = decoded(TF, messages, body)
        expected = [i for i, names in enumerate(lists) if body in names]
        np.testing.assert_array_equal(received, expected)
        np.testing.assert_array_equal(stamp, 10**18 + np.array(expected))
        shift = np.array([lists[i].index(body) for i in expected])
        np.testing.assert_array_equal(values[:, :3], rows[expected, :3] + shift[:, None])


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
            bag.numbers("state", 0, np.zeros(9))
        with pytest.raises(BagError, match="cannot record state"):
            bag.numbers("state", 0, ["fast"] * 10)
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


def foreign(
    path: Path,
    messages: list[tuple[str, str, int, bytes]],
    storage: StoragePlugin = StoragePlugin.MCAP,
    metadata: dict[str, str] | None = None,
    compression: CompressionMode | None = None,
) -> Path:
    """A bag made by the library alone: (topic, type, log time, message)."""
    writer = Writer(path, version=9, storage_plugin=storage)
    if compression:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
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
    bodies = poses("/vrpn_mocap/one/pose") + poses("/vrpn_mocap/two/pose")  # at the same height
    lab = foreign(tmp_path / "lab", bodies + poses("/mocap/pendulum/pose"))
    with pytest.raises(BagError) as caught:
        read(lab)
    for words in (str(lab), "/mocap/quad/pose (vehicle)", "/vrpn_mocap/one/pose", "topics={", "--topic vehicle="):
        assert words in str(caught.value)
    with pytest.raises(BagError, match=r"no topic /elsewhere \(state\)"):
        read(lab, {"vehicle": "/vrpn_mocap/one/pose", "state": "/elsewhere"})
    with pytest.raises(BagError, match="no such role 'quad'"):
        read(lab, {"quad": "/vrpn_mocap/quad/pose"})


@pytest.mark.parametrize(
    ("vehicle", "pendulum", "others"),
    [
        ("/uav1/vrpn_mocap/quad_01/pose", "/uav1/vrpn_mocap/rod/pose", []),
        ("/natnet_ros/cf2/pose", "/natnet_ros/stick/pose", ["/cf2/setpoint/pose", "/natnet_ros/wand/pose"]),
        ("/vicon/frame/pose", "/vicon/Pendulum/pose", ["/frame/goal_pose"]),
        ("/mocap/quad/pose", "/vrpn_mocap/thing/pose", []),
        ("/optitrack/drone/pose", "/optitrack/x/pose", []),
        ("/vrpn_mocap/uav/pose", "/vrpn_mocap/pole/pose", ["/mavros/local_position/pose"]),
    ],
)
def test_bodies_are_guessed_by_their_names_and_the_guess_is_said(
    tmp_path: Path, vehicle: str, pendulum: str, others: list[str]
) -> None:
    topics = [vehicle, pendulum, *others]
    if vehicle.startswith("/mocap"):  # the default is there: only the other is guessed
        with pytest.raises(BagError, match="no topic /mocap/pendulum/pose"):
            read(foreign(tmp_path / "doubt", [m for topic in (*topics, "/vrpn_mocap/that/pose") for m in poses(topic)]))
    flight = read(foreign(tmp_path / "lab", [m for topic in topics for m in poses(topic)]))
    roles = {info.role: info.topic for info in flight.topics if info.role}
    assert roles == {"vehicle": vehicle, "pendulum": pendulum}
    for role, topic in roles.items():
        guessed = topic != recording.TOPICS[role]
        assert any(note.startswith(f"{topic} is taken for the {role}") for note in flight.notes) == guessed


def test_bodies_without_a_telling_name_are_guessed_by_their_heights(tmp_path: Path) -> None:
    layout = layouts.Layout.of(recording.POSE, "map")
    high = [
        ("/tracker/a", kind, time, layout.encode(10**18 + i, (0, 0, 1.5, 0, 0, 0, 1)))
        for i, (_, kind, time, _) in enumerate(poses("/tracker/a"))
    ]
    flight = read(foreign(tmp_path / "lab", high + poses("/tracker/b")))
    assert (flight.vehicle.position[0, 2], flight.pendulum.position[0, 2]) == (1.0, 1.5)
    assert "/tracker/a is taken for the pendulum, as it is the higher one" in flight.notes[1]
    with pytest.raises(BagError, match=r"no topic /mocap/quad/pose"):
        read(foreign(tmp_path / "level", poses("/tracker/a") + poses("/tracker/b")))


def test_one_of_several_bodies_in_a_topic_can_be_named(tmp_path: Path) -> None:
    rows = np.tile([0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0], (4, 1))
    messages = [("/tf", TF, i, transforms(["one", "two"], 10**18 + i, row)) for i, row in enumerate(rows)]
    lab = foreign(tmp_path / "lab", messages)
    flight = read(lab, {"vehicle": "/tf:two", "pendulum": "/tf:one"})
    assert (flight.vehicle.position[0, 2], flight.pendulum.position[0, 2]) == (2.0, 1.0)
    assert [info.role for info in flight.topics] == ["vehicle (two), pendulum (one)"] and flight.notes == ()
    assert read(lab).pendulum.position[0, 2] == 2.0  # by its height
    with pytest.raises(BagError, match="holds several bodies, one, two: say which one"):
        read(lab, {"vehicle": "/tf", "pendulum": "/tf:one"})
    with pytest.raises(BagError, match=r"topic /tf:three \(pendulum\) is empty"):
        read(lab, {"vehicle": "/tf:two", "pendulum": "/tf:three"})


def test_rigid_bodies_of_a_type_that_only_the_bag_defines_are_found_by_name(tmp_path: Path) -> None:
    kind = "motion_capture_tracking_interfaces/msg/NamedPoseArray"
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(NAMED_POSES, kind))
    types, path = store.types, tmp_path / "lab"
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/poses", kind, typestore=store)
        for i in range(4):
            places = [types["geometry_msgs/msg/Point"](0.1 * i, 0.0, z) for z in (1.0, 1.5)]
            turn = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
            bodies = [
                types["motion_capture_tracking_interfaces/msg/NamedPose"](
                    name, types["geometry_msgs/msg/Pose"](at, turn)
                )
                for name, at in zip(("cf7", "rod"), places, strict=True)
            ]
            writer.write(connection, i, bytes(store.serialize_cdr(types[kind](header(10**18 + i), bodies), kind)))
    flight = read(path)
    assert (flight.vehicle.position[3, 0], flight.pendulum.position[0, 2]) == (pytest.approx(0.3), 1.5)
    assert flight.notes[0].startswith("/poses:cf7 is taken for the vehicle, by its name")


def test_commands_of_other_types_are_read(tmp_path: Path) -> None:
    store = layouts.typestore()
    kind, twist = "geometry_msgs/msg/TwistStamped", {"twist.angular.x": 0.1, "twist.angular.z": 0.3}
    twist |= {"twist.linear.z": 0.5, "header": header(10**18)}
    data = bytes(store.serialize_cdr(made(kind, twist, store), kind))
    velocity = ("/vrpn_mocap/quad/twist", kind, 0, data)  # a twist that commands nothing
    flight = read(foreign(tmp_path / "lab", [*MOCAP, velocity, ("/cmd_rates", kind, 0, data)]))
    np.testing.assert_array_equal(flight.command.values, [[0.1, 0.0, 0.3, 0.5]])
    assert read(foreign(tmp_path / "measured", [*MOCAP, velocity])).command is None
    kind, other = "px4_msgs/msg/VehicleRatesSetpoint", get_typestore(Stores.ROS2_HUMBLE)
    text = "uint64 timestamp\nfloat32 roll\nfloat32 pitch\nfloat32 yaw\nfloat32[3] thrust_body\nbool reset_integral"
    other.register(get_types_from_msg(text, kind))
    rates = {"roll": 0.5, "pitch": 0.25, "yaw": -1.0, "thrust_body": np.array([0, 0, -0.75], np.float32)}
    data = bytes(other.serialize_cdr(made(kind, rates, other), kind))
    with Writer(tmp_path / "px4", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic, name, time, message in MOCAP:
            link = next((one for one in writer.connections if one.topic == topic), None)
            writer.write(link or writer.add_connection(topic, name, typestore=store), time, message)
        writer.write(writer.add_connection("/fmu/in/vehicle_rates_setpoint", kind, typestore=other), 7, data)
    flight = read(tmp_path / "px4")
    np.testing.assert_array_equal(flight.command.values, [[0.5, -0.25, 1.0, 0.75]])  # x forward, y left, z up
    assert flight.command.stamp.tolist() == [7] and "no header" in flight.notes[-1]


def split(folder: Path, bag: Path) -> Path:
    """The messages of a bag in two files, one after the other."""
    folder.mkdir()
    with Reader(bag) as reader:
        found = [(link.topic, link.msgtype, time, data) for link, time, data in reader.messages()]
    for i, part in enumerate((found[len(found) // 2 :], found[: len(found) // 2])):  # the later one first
        half = foreign(folder.parent / f"half_{i}", part)
        shutil.move(half / f"half_{i}.mcap", folder / f"lab_{i}.mcap")
    return folder


@pytest.mark.parametrize("how", ["split", "renamed", "newer", "file", "file, bare", "message", "message, bare", "db3"])
def test_the_same_flight_comes_out_of_every_storage(bag: Path, tmp_path: Path, how: str) -> None:
    with Reader(bag) as reader:
        found = [(link.topic, link.msgtype, time, data) for link, time, data in reader.messages()]
    mode = {"file": CompressionMode.FILE, "message": CompressionMode.MESSAGE}.get(how.partition(",")[0])
    storage = StoragePlugin.SQLITE3 if how == "db3" else StoragePlugin.MCAP
    path = foreign(tmp_path / "lab", found, storage, compression=mode)
    if how == "split":
        path = split(tmp_path / "split", path)
    elif how == "renamed":
        (path / "lab.mcap").rename(path / "flight of today.mcap")
    elif how == "newer":
        text = (path / "metadata.yaml").read_text()
        (path / "metadata.yaml").write_text(text.replace("version: 9", "version: 10"))
    if "bare" in how or how == "db3":
        (path / "metadata.yaml").unlink()
    flight, whole = read(path), read(bag)
    assert {name: array.tobytes() for name, array in arrays(flight).items()} == {
        name: array.tobytes() for name, array in arrays(whole).items()
    }
    if "message" in how:  # and what is recovered is not compressed twice
        with Reader(recover(path).output) as reader:
            assert [data for _, _, data in reader.messages()] == [data for *_, data in found]


def test_a_bag_of_ros_1_is_named_with_the_converter(tmp_path: Path) -> None:
    (tmp_path / "lab.bag").write_bytes(b"#ROSBAG V2.0\n")
    with pytest.raises(BagError, match=r"ROS 1; .* fip bag convert .*lab\.bag$"):
        read(tmp_path / "lab.bag")


MEMORY = """
import resource, sys
import numpy as np
from fiplib.bags import read
kilobytes = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
before, flight = kilobytes(), read(sys.argv[1])
print(before, kilobytes(), len(flight.vehicle.stamp))
"""


def test_a_camera_beside_the_poses_costs_no_memory(tmp_path: Path) -> None:
    """64 MB of pictures between the poses: a reader that kept a tenth of them would show."""
    kind = "std_msgs/msg/ByteMultiArray"
    store = layouts.typestore()
    picture = np.random.default_rng(0).integers(0, 256, 1 << 19, np.uint8)
    empty = TYPES["std_msgs/msg/MultiArrayLayout"]([], 0)
    data = bytes(store.serialize_cdr(TYPES[kind](empty, picture), kind))
    found = poses("/mocap/quad/pose", count=1280) + poses("/mocap/pendulum/pose", count=1280)
    found += [("/camera", kind, 10**18 + i * 10 * PERIOD, data) for i in range(128)]
    path = foreign(tmp_path / "lab", sorted(found, key=itemgetter(2)))
    for place in (path, path / "lab.mcap"):
        done = subprocess.run([sys.executable, "-c", MEMORY, str(place)], capture_output=True, text=True, check=True)
        before, after, count = map(int, done.stdout.split())
        assert count == 1280 and after - before < 1.5 * 2**14  # 24 MiB, most of it code and definitions


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
    stamp, _, values = decoded(recording.POSE, [data])
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


MENDED = {
    "NaN position": (changed(2, position=(NAN, 0.0, 0.0)), "vehicle: 1 of 5 messages hold no pose: they are left out"),
    "infinite position": (changed(4, position=(0.0, float("inf"), 0.0)), "vehicle: 1 of 5 messages hold no pose"),
    "NaN orientation": (changed(0, orientation=(NAN, 0.0, 0.0, 1.0)), "vehicle: 1 of 5 messages hold no pose"),
    "zero quaternion": (changed(3, orientation=(0.0,) * 4), "vehicle: 1 of 5 messages hold no pose"),
    "sent twice": ([MOCAP[0], *MOCAP], "vehicle: 1 of 6 messages were sent twice: one of each is used"),
}


@pytest.mark.parametrize("fault", MENDED)
def test_a_frame_without_a_pose_or_sent_twice_is_left_out_and_counted(tmp_path: Path, fault: str) -> None:
    messages, words = MENDED[fault]
    flight = read(foreign(tmp_path / "lab", messages))
    [note] = flight.notes
    assert note.startswith(words)
    assert len(flight.vehicle.stamp) == (5 if fault == "sent twice" else 4)
    assert np.isfinite(flight.vehicle.position).all() and (np.diff(flight.vehicle.stamp) > 0).all()


def test_stamps_are_sorted_or_replaced_only_where_one_cause_is_likely() -> None:
    rng, count = np.random.default_rng(3), 400
    stamp = np.arange(1, count + 1, dtype=np.int64) * 4_000_000
    values = np.concatenate([rng.normal(size=(count, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))], axis=1)
    swapped, notes = stamp.copy(), []
    swapped[[50, 51]] = swapped[[51, 50]]
    at, log, poses = mended("rod", swapped, stamp + 7, values, notes)
    np.testing.assert_array_equal(at, stamp)
    np.testing.assert_array_equal(poses[50], values[51])
    assert (np.diff(log) >= 0).all() and notes == ["rod: 1 of 400 messages came out of order: sorted by their stamps"]
    at, _, _ = mended("rod", np.zeros_like(stamp), stamp + 7, values, notes := [])
    np.testing.assert_array_equal(at, stamp + 7)
    assert notes[0].startswith("rod: no message has a stamp")
    two_publishers = np.sort(stamp.reshape(2, -1), axis=0).T.ravel()  # every second stamp lies far back
    at, _, _ = mended("rod", two_publishers, stamp + 7, values, notes := [])
    assert (np.diff(at) < 0).any() and notes == []  # left as it is: the reader refuses it


def test_commands_without_body_rates_are_left_out_and_counted(tmp_path: Path) -> None:
    masks = (128, 7, 128 + 2, 64)
    messages = [*MOCAP]
    for i, mask in enumerate(masks):
        data = bytearray(command(mask))
        data[8] = i  # the stamp, in ns
        messages.append(("/fip/command", recording.ATTITUDE, i, bytes(data)))
    flight = read(foreign(tmp_path / "lab", messages))
    np.testing.assert_array_equal(flight.command.stamp, [0, 3])
    assert flight.notes == ("2 of 4 commands hold no body rates (type_mask): they are left out",)
    flight = read(foreign(tmp_path / "none", messages[:-3] + messages[-3:-1]))
    assert len(flight.command.stamp) == 1
    flight = read(foreign(tmp_path / "all", [*MOCAP, messages[-3]]))
    assert flight.command is None and "1 of 1 commands" in flight.notes[0]


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
    for path, words in (("gone", "no such file"), ("notes.txt", "not a bag"), (".", r"not a bag: no \.mcap")):
        with pytest.raises(BagError, match=words):
            read(tmp_path / path)


@pytest.mark.parametrize("bare", [True, False])
def test_without_metadata_yaml_the_copy_inside_the_mcap_speaks(bag: Path, tmp_path: Path, bare: bool) -> None:
    whole = read(bag)
    broken = copy(bag, tmp_path)
    (broken / "metadata.yaml").unlink()
    assert same(whole, read(mcap(broken) if bare else broken))


def test_without_metadata_a_stray_file_is_left_alone_or_the_choice_is_the_users(bag: Path, tmp_path: Path) -> None:
    broken = copy(bag, tmp_path)
    (broken / "metadata.yaml").unlink()
    shutil.copy(mcap(broken), broken / "other.mcap")
    assert same(read(bag), read(broken))  # the folder has the name of one of them
    renamed = broken.rename(tmp_path / "today")
    with pytest.raises(BagError, match=r"2 recordings \(flight, other\).*give one of the files"):
        read(renamed)


def test_a_file_that_is_gone_is_named(bag: Path, tmp_path: Path) -> None:
    path = split(tmp_path / "lab", bag)
    with Writer(tmp_path / "named", version=9, storage_plugin=StoragePlugin.MCAP):
        pass
    text = (tmp_path / "named" / "metadata.yaml").read_text()
    (path / "metadata.yaml").write_text(text.replace("- named.mcap", "- lab_0.mcap\n  - lab_1.mcap"))
    (path / "lab_1.mcap").unlink()
    with pytest.raises(BagError, match=r"lab_1\.mcap of its files is not there.*fip bag recover"):
        read(path)
    recovery = recover(path)
    assert recovery.missing == ("lab_1.mcap",) and "lab_1.mcap" in recovery.describe() and not recovery.undamaged


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
    # Otherwise the bytes that matter were not among them: sizes and times of a chunk are taken from the chunk itself.
    assert tally["refused"] > 10


# --- command line --------------------------------------------------------------------------------------------------


def run(*arguments: object) -> int:
    parser = argparse.ArgumentParser()
    bag_command.add_arguments(parser)
    return bag_command.run(parser.parse_args([str(argument) for argument in arguments]))


def test_info_says_what_a_bag_holds(bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("info", bag) == 0
    printed = capsys.readouterr().out
    lines = printed.splitlines()
    assert "\nrefit      Poses and commands overlap for 0.4 s only, one estimation window is 5.4 s" in printed
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
