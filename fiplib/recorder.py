"""Flight -> ROS 2 bag: the topics, the bytes of their messages, and the recorder that writes them.

``ROLES`` is the bag contract. ``Layout`` knows where the numbers lie in a message; the recorder writes with it and
``fiplib.bags`` reads with it, so that both sides share one definition.
"""

import functools
import json
import struct
import sys
import zlib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import numpy as np
from rosbags.interfaces import Connection
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer, WriterError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from fiplib.params import NANO, STATE_NAMES, STATES

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd  # the copy that rosbags itself depends on

POSE = "geometry_msgs/msg/PoseStamped"
POINT = "geometry_msgs/msg/PointStamped"
JOINTS = "sensor_msgs/msg/JointState"
ATTITUDE = "mavros_msgs/msg/AttitudeTarget"
LOG = "rcl_interfaces/msg/Log"

IGNORE_RATES, IGNORE_ATTITUDE = 1 | 2 | 4, 128
ATTITUDE_DEFINITION = """\
std_msgs/Header header
uint8 type_mask
uint8 IGNORE_ROLL_RATE = 1
uint8 IGNORE_PITCH_RATE = 2
uint8 IGNORE_YAW_RATE = 4
uint8 IGNORE_THRUST = 64
uint8 IGNORE_ATTITUDE = 128
geometry_msgs/Quaternion orientation
geometry_msgs/Vector3 body_rate
float32 thrust
"""


class BagError(Exception):
    """A bag cannot be written or read; the message names the file and the topic and says what to do."""


class Role(NamedTuple):
    """What one topic is for: its default name, message type, frame, and the names and units of its numbers."""

    topic: str
    type: str
    frame: str
    names: tuple[str, ...]
    units: tuple[str, ...]


_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw"), ("m", "m", "m", "1", "1", "1", "1")
_STATE_UNITS = tuple(signal.unit for signal in STATES)

ROLES = {
    "vehicle": Role("/mocap/quad/pose", POSE, "world", *_POSE),
    "pendulum": Role("/mocap/pendulum/pose", POSE, "world", *_POSE),
    "state": Role("/fip/state", JOINTS, "world", STATE_NAMES, _STATE_UNITS),
    "command": Role(
        "/fip/command",
        ATTITUDE,
        "base_link",
        ("omega_x", "omega_y", "omega_z", "thrust"),
        ("rad/s", "rad/s", "rad/s", "1"),
    ),
    "reference": Role("/fip/reference", JOINTS, "world", STATE_NAMES, _STATE_UNITS),
    "length": Role("/fip/length", POINT, "world", ("used", "estimate", "standard_deviation"), ("m", "m", "m")),
    "events": Role("/fip/events", LOG, "", (), ()),
    "truth_state": Role("/truth/state", JOINTS, "world", (*STATE_NAMES, "z"), (*_STATE_UNITS, "m")),
    "truth_length": Role("/truth/length", POINT, "world", ("length",), ("m",)),
}
"""The bag contract. Topics can be remapped when a bag is read; types, names and units cannot."""

TOPICS = {role: entry.topic for role, entry in ROLES.items()}
"""Default topic of each role."""

ORIGINS = ("simulated", "real", "unknown")
SIDECAR = "recording.yaml"
"""File in which a bag, while it is being recorded live, says what its metadata.yaml says once it is finished."""
LEVELS = {"debug": 10, "info": 20, "warn": 30, "error": 40, "fatal": 50}
"""Severity of an event: the constants of rcl_interfaces/Log."""


@functools.cache
def typestore() -> Typestore:
    """ROS 2 message definitions, with mavros_msgs/AttitudeTarget added."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(ATTITUDE_DEFINITION, ATTITUDE))
    return store


class Layout(NamedTuple):
    """Where the numbers of a message lie, given the strings in it (frame id, names of joints).

    ROS 2 messages travel as CDR, where only strings and sequences vary in length: with these fixed, every message of a
    topic is the same bytes but for its stamp and its numbers. ``template`` is a message as the library serialises it;
    at ``offset`` lie ``doubles`` float64, then ``singles`` float32.
    """

    template: bytes
    offset: int
    doubles: int
    singles: int

    @classmethod
    def of(cls, message_type: str, frame: str, names: Sequence[str] = ()) -> "Layout":
        """The layout of a message type with a header, for one frame id and (JointState) one list of names."""
        types = typestore().types
        point = types["geometry_msgs/msg/Point"](0.0, 0.0, 0.0)
        identity = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
        rates = types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
        empty = np.zeros(0)
        # Per type: the fields after the header, the count of doubles and singles, and the bytes behind them (the two
        # empty sequences, velocity and effort, of a JointState).
        fields, doubles, singles, tail = {
            POSE: ((types["geometry_msgs/msg/Pose"](point, identity),), 7, 0, 0),
            POINT: ((point,), 3, 0, 0),
            JOINTS: ((list(names), np.zeros(len(names)), empty, empty), len(names), 0, 8),
            ATTITUDE: ((IGNORE_ATTITUDE, identity, rates, 0.0), 3, 1, 0),
        }[message_type]
        header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](0, 0), frame)
        template = bytes(typestore().serialize_cdr(types[message_type](header, *fields), message_type))
        return cls(template, len(template) - tail - 8 * doubles - 4 * singles, doubles, singles)

    def encode(self, stamp: int, values: Sequence[float] | np.ndarray) -> bytes:
        """One message; ``stamp`` in ns. Raises struct.error if the count of values is wrong."""
        message = bytearray(self.template)
        struct.pack_into("<iI", message, 4, *divmod(stamp, NANO))
        struct.pack_into(f"<{self.doubles}d{self.singles}f", message, self.offset, *values)
        return bytes(message)

    def decode(self, messages: Sequence[bytes]) -> tuple[np.ndarray, np.ndarray] | None:
        """Stamps (n,) in ns and values (n, k) of n messages at once, or None if one of them has another layout."""
        size = len(self.template)
        if any(len(message) != size for message in messages):
            return None
        raw = np.frombuffer(b"".join(messages), np.uint8).reshape(-1, size)
        fixed = np.ones(size, bool)
        fixed[4:12] = fixed[self.offset : self.offset + 8 * self.doubles + 4 * self.singles] = False
        if (raw[:, fixed] != np.frombuffer(self.template, np.uint8)[fixed]).any():
            return None
        second, nanosecond, doubles, singles = (
            np.ascontiguousarray(raw[:, start : start + np.dtype(kind).itemsize * count]).view(kind)
            for start, kind, count in (
                (4, "<i4", 1),
                (8, "<u4", 1),
                (self.offset, "<f8", self.doubles),
                (self.offset + 8 * self.doubles, "<f4", self.singles),
            )
        )
        stamp = second[:, 0].astype(np.int64) * NANO + nanosecond[:, 0]
        return stamp, np.concatenate([doubles, singles], axis=1, dtype=np.float64)


def checksum(entries: Mapping[str, str]) -> str:
    """CRC-32 of a bag's metadata entries, as recorded under the key ``checksum``."""
    return f"{zlib.crc32(json.dumps(entries, sort_keys=True).encode()):08x}"


def genuine(entries: Mapping[str, Any]) -> bool:
    """Whether a bag's metadata entries are as they were recorded; those of other recorders carry no checksum."""
    rest = {key: value for key, value in entries.items() if key != "checksum"}
    if "checksum" not in entries:
        return "messages" not in rest  # ours never come without
    return entries["checksum"] == checksum(rest)


def open_bag(path: Path) -> Writer:
    """The library's writer of a new MCAP bag. Raises BagError if it cannot be written there."""
    try:
        # Version 8 of metadata.yaml is read by ROS 2 Humble, Iron, Jazzy and later alike.
        writer = Writer(path, version=8, storage_plugin=StoragePlugin.MCAP)
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        writer.open()
    except (WriterError, OSError) as error:
        raise BagError(
            f"{path}: cannot record here ({error}); choose another path, or move the old bag away"
        ) from error
    # The library leaves the CRC of a chunk empty: let zstd carry one, so that every reader notices a damaged byte.
    options = {zstd.CompressionParameter.checksum_flag: 1}
    writer.storage.compressor = functools.partial(zstd.compress, options=options)
    return writer


def close_bag(writer: Writer, entries: Mapping[str, str], counts: Mapping[str, int]) -> None:
    """Write index and metadata: the entries, and how many messages each topic must hold. Raises BagError."""
    entries = {**entries, "messages": json.dumps(dict(sorted(counts.items())))}
    for key, value in {**entries, "checksum": checksum(entries)}.items():
        writer.set_custom_data(key, value)
    try:
        writer.close()
    except OSError as error:
        raise BagError(f"{writer.path}: cannot finish the bag ({error})") from error


class Recorder:
    """Writes one flight as a ROS 2 bag (a directory with one MCAP file and metadata.yaml); a context manager.

    Stamps are int nanoseconds, from 0 (or the epoch) on. Messages are written in the order of their log time: for a
    pose the time it was received, else the stamp. The same calls write the same bytes. Leaving the ``with`` block by
    an exception closes the bag properly too, with an event that says so: a flight that ended badly is worth reading.
    It stops for as long as the disk takes: ``live.LiveRecorder`` is the one for real time.

    Args:
        path: the directory to create.
        metadata: what a bag says about itself, ready for JSON: ``origin`` (``simulated``, ``real`` or ``unknown``),
            ``scenario``, ``seed``, ``version``, ``params`` (``Params.to_dict()``), and anything else.

    Raises:
        BagError: the path exists already, cannot be written, or the metadata are not fit.
    """

    _REORDER = 2048  # messages held back to be sorted, about 2 s of flight: more than any latency between two topics

    def __init__(self, path: str | Path, metadata: Mapping[str, Any]) -> None:
        self.path = Path(path)
        if metadata.get("origin") not in ORIGINS:
            raise BagError(f"{path}: metadata must say an origin, one of {', '.join(ORIGINS)}")
        if reserved := {"messages", "checksum"} & set(metadata):
            raise BagError(f"{path}: the metadata key {min(reserved)!r} is written by the recorder itself: rename it")
        try:
            self._metadata = {key: json.dumps(value, allow_nan=False) for key, value in metadata.items()}
        except (TypeError, ValueError) as error:
            raise BagError(f"{path}: metadata do not fit into JSON ({error})") from error
        self._layouts = {
            role: Layout.of(entry.type, entry.frame, entry.names if entry.type == JOINTS else ())
            for role, entry in ROLES.items()
            if entry.type != LOG
        }
        self._connections: dict[str, Connection] = {}
        self._pending: list[tuple[int, str, bytes]] = []
        self._counts: Counter[str] = Counter()
        self._last = 0
        self._open()

    def _open(self) -> None:
        self._writer = open_bag(self.path)

    def pose(
        self, body: str, stamp: int, received: int, position: Sequence[float], orientation: Sequence[float]
    ) -> None:
        """Pose of ``vehicle`` or ``pendulum``: position (3,) in m, quaternion (4,) as x, y, z, w.

        ``stamp`` is the time of exposure, ``received`` the time of delivery.
        """
        if body not in ("vehicle", "pendulum"):
            raise BagError(f"{self.path}: no such body {body!r}; bodies are vehicle and pendulum")
        self._numbers(body, stamp, (*position, *orientation), received)

    def state(self, stamp: int, values: Sequence[float]) -> None:
        """The state the controller used, (10,) in the order of ``params.STATES``."""
        self._numbers("state", stamp, values)

    def reference(self, stamp: int, values: Sequence[float]) -> None:
        """The reference at this tick, (10,) in the order of ``params.STATES``."""
        self._numbers("reference", stamp, values)

    def command(self, stamp: int, rates: Sequence[float], thrust: float) -> None:
        """Body rates (3,) in rad/s and normalised thrust, 0 to 1. The message carries thrust in single precision."""
        self._numbers("command", stamp, (*rates, thrust))

    def length(self, stamp: int, used: float, raw: float, std: float) -> None:
        """Length that the controller uses, the raw estimate, and its standard deviation (both may be NaN), in m."""
        self._numbers("length", stamp, (used, raw, std))

    def truth(self, stamp: int, values: Sequence[float]) -> None:
        """True state, (11,): ``params.STATES`` and the altitude z. Simulator only."""
        self._numbers("truth_state", stamp, values)

    def truth_length(self, stamp: int, length: float) -> None:
        """True length of the rod in m. Simulator only."""
        self._numbers("truth_length", stamp, (length, 0.0, 0.0))

    def event(self, stamp: int, level: str, text: str) -> None:
        """Something worth a word: ``level`` is a key of ``LEVELS``."""
        if level not in LEVELS:
            raise BagError(f"{self.path}: no such level {level!r} of an event; levels are {', '.join(LEVELS)}")
        stamp = self._time(stamp)
        time = typestore().types["builtin_interfaces/msg/Time"](*divmod(stamp, NANO))
        message = typestore().types[LOG](time, LEVELS[level], "fip", text, "", "", 0)
        self._put("events", stamp, bytes(typestore().serialize_cdr(message, LOG)))

    def _time(self, stamp: int) -> int:
        """A stamp as a plain int (NumPy's integers do not serialise), if it is one that a message can carry."""
        if not 0 <= stamp < 2**31 * NANO:
            raise BagError(f"{self.path}: the stamp {stamp} ns does not fit into a ROS time (0 to 2038)")
        return int(stamp)

    def _numbers(
        self, role: str, stamp: int, values: Sequence[float] | np.ndarray, received: int | None = None
    ) -> None:
        stamp = self._time(stamp)
        try:
            data = self._layouts[role].encode(stamp, values)
        except (struct.error, OverflowError, TypeError) as error:
            names = ", ".join(ROLES[role].names)
            raise BagError(f"{self.path}: cannot record {role} ({error}); it takes the numbers {names}") from error
        self._put(role, stamp if received is None else self._time(received), data)

    def _put(self, role: str, log_time: int, data: bytes) -> None:
        self._last = max(self._last, log_time)
        self._pending.append((log_time, role, data))
        if len(self._pending) >= 2 * self._REORDER:
            self._flush(self._REORDER)

    def _flush(self, keep: int) -> None:
        self._pending.sort(key=itemgetter(0))  # stable: messages of one instant keep the order of the calls
        ready = self._pending[: len(self._pending) - keep]
        del self._pending[: len(ready)]
        try:
            self._write(ready)
        except OSError as error:
            raise BagError(f"{self.path}: cannot write any further ({error})") from error

    def _write(self, messages: Iterable[tuple[int, str, bytes]]) -> None:
        for log_time, role, data in messages:
            if role not in self._connections:
                entry = ROLES[role]
                self._connections[role] = self._writer.add_connection(entry.topic, entry.type, typestore=typestore())
            self._writer.write(self._connections[role], log_time, data)
            self._counts[ROLES[role].topic] += 1

    def close(self) -> None:
        """Write what is pending, the index and the metadata."""
        self._flush(0)
        close_bag(self._writer, self._metadata, self._counts)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            self.event(self._last, "fatal", f"recording ended by {kind.__name__}")
        self.close()
