"""ROS 2 bag -> Flight: a recorded flight as plain arrays, checked.

A bag with the two motion-capture topics alone is a flight; everything else may be absent. Whatever is wrong with a bag
is one ``BagError`` that names the file and the topic and says what to do.
"""

import json
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import Reader

from fiplib.bags.mcap import embedded_metadata
from fiplib.bags.messages import IGNORE_RATES, SIDECAR, Layout, genuine, typestore
from fiplib.bags.recovery import intact_messages
from fiplib.params import NANO
from fiplib.recording import (
    JOINTS,
    LEVELS,
    ORIGINS,
    POINT,
    POSE,
    ROLES,
    TOPICS,
    BagError,
    Event,
    Flight,
    Poses,
    Series,
    TopicInfo,
)


def read(path: str | Path, topics: Mapping[str, str] | None = None) -> Flight:
    """Read a flight from a ROS 2 bag.

    Args:
        path: the bag's directory, or a bare .mcap file.
        topics: names of topics that differ from ``TOPICS``, by role: ``{"vehicle": "/vrpn_mocap/quad/pose"}``.

    Raises:
        BagError: the bag is missing, damaged, or does not hold what the bag contract says.
    """
    path, topics = Path(path), dict(topics or {})
    if unknown := set(topics) - set(ROLES):
        raise BagError(f"{path}: no such role {min(unknown)!r} to remap; roles are {', '.join(ROLES)}")
    names = {**TOPICS, **topics}
    metadata, table, messages = _load(path, names)
    present = {info.topic for info in table}
    for role in ("vehicle", "pendulum", *topics):
        if names[role] not in present:
            raise BagError(
                f"{path}: no topic {names[role]} ({role}); the bag holds {', '.join(sorted(present)) or 'none'}. "
                f'Say which one it is: read(path, topics={{"{role}": "/its/name"}}), or --topic {role}=/its/name'
            )
        if role in ("vehicle", "pendulum") and not messages[role]:
            raise BagError(f"{path}: topic {names[role]} ({role}) is empty: was the body tracked and its name right?")
    decoded = {}
    for role, received in messages.items():
        if received:
            try:
                decoded[role] = (
                    _events(received, metadata.get("pushes")) if role == "events" else _decode(role, received)
                )
            except Exception as error:  # whatever the library raises on damaged bytes
                raise BagError(f"{path}: topic {names[role]} ({role}): {_line(error)}") from error
    return Flight(
        path=path,
        metadata=metadata,
        events=decoded.pop("events", ()),
        start_ns=int(min(decoded["vehicle"].stamp[0], decoded["pendulum"].stamp[0])),
        topics=table,
        **{role: decoded.get(role) for role in ROLES if role != "events"},
    )


_Received = list[tuple[int, bytes]]  # log time in ns, message


_Loaded = tuple[dict[str, Any], tuple[TopicInfo, ...], dict[str, _Received]]


def _load(path: Path, names: Mapping[str, str]) -> _Loaded:
    """Metadata, table of topics, and per role the messages as they lie in the bag, in the order of log time."""
    source = _source(path)
    try:
        return _collect(source, names)
    except BagError:
        raise
    except OSError as error:
        raise BagError(f"{source}: cannot be opened ({_line(error)})") from error
    except Exception as error:  # the library raises a dozen kinds on damage, from struct.error to MemoryError
        raise BagError(f"{source}: {_damage(path, source, error)}") from error


def _damage(path: Path, source: Path, error: Exception) -> str:
    """What is wrong with a bag that cannot be read, and what its user can do."""
    unfinished = (path / SIDECAR).exists()
    words = f"damaged or incomplete ({_line(error)})"
    if unfinished:
        words = "not finished: it is being recorded still, or its recording was killed"
    with suppress(BagError):
        if count := intact_messages(source):
            return f"{words}. {count} messages are intact; into a new bag with: fip bag recover {path}"
    if unfinished:
        return f"{words}. It holds no message yet"
    return f"{words}. Nothing in it can be read: copy it again from where it was recorded, and keep this one"


def _collect(source: Path, names: Mapping[str, str]) -> _Loaded:
    roles: dict[str, list[str]] = {}
    for role, topic in names.items():
        roles.setdefault(topic, []).append(role)
    with Reader(source) as reader:
        connections = list(reader.connections)
        metadata = _metadata(source, reader.storage.metadata.custom or embedded_metadata(source))
        wanted = [connection for connection in connections if connection.topic in roles]
        for connection in wanted:
            for role in roles[connection.topic]:
                if connection.msgtype != ROLES[role].type:
                    raise BagError(
                        f"{source}: topic {connection.topic} ({role}) is of type {connection.msgtype}, not "
                        f"{ROLES[role].type}: convert it, or remap {role} to another topic"
                    )
        messages: dict[str, _Received] = {connection.topic: [] for connection in wanted}
        if wanted:  # the library takes an empty selection for "all"
            for connection, log_time, data in reader.messages(wanted):
                messages[connection.topic].append((log_time, data))
    counts: dict[str, int] = {}
    for connection in connections:
        counts[connection.topic] = counts.get(connection.topic, 0) + connection.msgcount
    # A damaged index hides messages silently: what was counted while recording must be there.
    for topic, count in {**counts, **metadata.pop("messages", {})}.items():
        found = len(messages[topic]) if topic in messages else counts.get(topic, 0)
        if found != count:
            raise ValueError(f"topic {topic} should hold {count} messages and holds {found}")
    types = {connection.topic: connection.msgtype for connection in connections}
    table = tuple(TopicInfo(t, types[t], counts[t], ", ".join(roles.get(t, ()))) for t in sorted(types))
    return metadata, table, {role: messages.get(topic, []) for role, topic in names.items()}


def _source(path: Path) -> Path:
    """What to hand to the library: a bag's directory, or a storage file."""
    if not path.exists():
        raise BagError(f"{path}: no such file or directory")
    if path.is_file():
        if path.suffix not in (".mcap", ".db3"):
            raise BagError(f"{path}: not a bag; give the bag's directory or its .mcap file")
        return path
    if (path / "metadata.yaml").exists():
        return path
    files = sorted(path.glob("*.mcap"))
    if len(files) != 1:
        raise BagError(f"{path}: not a bag: neither metadata.yaml nor exactly one .mcap file (there are {len(files)})")
    return files[0]


def _metadata(source: Path, entries: Mapping[str, Any]) -> dict[str, Any]:
    """Decode a bag's own words about itself (JSON values; other recorders may have put plain strings)."""
    if not genuine(entries):
        raise BagError(f"{source}: the metadata were damaged or edited since the recording: restore the original")
    metadata: dict[str, Any] = {"origin": "unknown"}
    for key, value in entries.items():
        if key == "checksum":
            continue
        try:
            metadata[key] = json.loads(value)
        except (TypeError, ValueError):
            metadata[key] = value
    if metadata["origin"] not in ORIGINS:
        raise BagError(f"{source}: its origin {metadata['origin']!r} is none of {', '.join(ORIGINS)}: mend it")
    return metadata


def _decode(role: str, received: _Received) -> Poses | Series:
    """Arrays of one topic, checked. Raises ValueError with what is wrong and what to do."""
    entry = ROLES[role]
    data = [message for _, message in received]
    first = typestore().deserialize_cdr(data[0], entry.type)
    names = tuple(getattr(first, "name", ()))
    if entry.type == JOINTS and names != entry.names:
        raise ValueError(f"its names are {', '.join(names) or 'none'}, not {', '.join(entry.names)}: rename or remap")
    layout = Layout.of(entry.type, first.header.frame_id, names)
    stamp, values = layout.decode(data) or _decode_one_by_one(entry.type, data)
    values = values[:, : len(entry.names)]
    _check_stamps(stamp, strict=role != "length")
    # Only the estimate and its deviation may be absent (NaN): before the first estimate there is none.
    finite = np.isfinite(values[:, :1] if role == "length" else values).all(axis=1)
    if not finite.all():
        at = int(np.argmin(finite))
        raise ValueError(
            f"message {at} of {len(stamp)} holds a NaN or infinite number, {len(stamp) - int(finite.sum())} do in all: "
            "cut the bag to where all numbers are known (a body that is not tracked has no pose)"
        )
    if entry.type != POSE:
        return Series(_frozen(stamp), _frozen(values), entry.names, entry.units)
    norm = np.linalg.norm(values[:, 3:], axis=1)
    if (off := np.abs(norm - 1.0) > 1e-3).any():
        at = int(np.argmax(off))
        raise ValueError(
            f"the quaternion of message {at} has norm {norm[at]:.4g}, not 1: a driver fault; "
            "normalise the orientations, or cut the bag to where they are right"
        )
    log_time = np.array([log_time for log_time, _ in received], np.int64)
    return Poses(_frozen(stamp), _frozen(log_time), _frozen(values[:, :3]), _frozen(values[:, 3:]))


def _decode_one_by_one(message_type: str, data: Sequence[bytes]) -> tuple[np.ndarray, np.ndarray]:
    """The slow way, for messages that differ in more than their numbers: another frame id, byte order, padding."""
    stamps, rows, names = [], [], None
    for message in (typestore().deserialize_cdr(raw, message_type) for raw in data):
        time = message.header.stamp
        stamps.append(time.sec * NANO + time.nanosec)
        if message_type == POSE:
            p, q = message.pose.position, message.pose.orientation
            rows.append((p.x, p.y, p.z, q.x, q.y, q.z, q.w))
        elif message_type == POINT:
            rows.append((message.point.x, message.point.y, message.point.z))
        elif message_type == JOINTS:
            names = names or message.name
            if message.name != names or len(message.position) != len(names):
                raise ValueError(f"message {len(rows)} has other names than the first, or not one position for each")
            rows.append(tuple(message.position))
        else:
            if message.type_mask & IGNORE_RATES:
                raise ValueError(f"message {len(rows)} commands no body rates (type_mask {message.type_mask})")
            rows.append((message.body_rate.x, message.body_rate.y, message.body_rate.z, message.thrust))
    return np.array(stamps, np.int64), np.array(rows, np.float64)


def _events(received: _Received, pushes: Any) -> tuple[Event, ...]:
    levels = {number: name for name, number in LEVELS.items()}
    messages = [typestore().deserialize_cdr(data, ROLES["events"].type) for _, data in received]
    stamps = np.array([message.stamp.sec * NANO + message.stamp.nanosec for message in messages], np.int64)
    _check_stamps(stamps, strict=False)
    events, left = [], [push for push in pushes if isinstance(push, dict)] if isinstance(pushes, list) else []
    for stamp, message in zip(stamps, messages, strict=True):
        if message.name == "fip" and message.function:
            kind, data = message.function, json.loads(message.file or "{}")
        else:
            kind, data = _event_from_words(message.msg, left)
        events.append(Event(int(stamp), levels.get(message.level, str(message.level)), message.msg, kind, data))
    return tuple(events)


_WORDS = {
    "push": r"push",
    "length": r"pilot is told the length (?P<length>[-+.\de]+) m",
    "fall": r"rod or vehicle fell",
    "status": r"MPC status (?P<status>.*)",
    "refusal": r"no estimate: (?P<reason>.*)",
    "mode": r"failsafe: (?P<from>.*) -> (?P<to>.*?): (?P<reason>.*)",
}


def _event_from_words(text: str, pushes: list[dict[str, Any]]) -> tuple[str, dict[str, Any]]:
    """Kind and data of an event that is a sentence only, as they all were once; takes a push from the list."""
    for kind, pattern in _WORDS.items():
        if found := re.match(pattern, text, re.DOTALL):
            if kind == "push":
                return kind, {key: value for key, value in pushes.pop(0).items() if key != "start"} if pushes else {}
            return kind, {"length": float(found["length"])} if kind == "length" else found.groupdict()
    return "note", {}


def _check_stamps(stamp: np.ndarray, strict: bool) -> None:
    back = np.diff(stamp) < (1 if strict else 0)
    if back.any():
        at = int(np.argmax(back))
        raise ValueError(
            f"the stamp of message {at + 1} ({stamp[at + 1]} ns) is not after the one before ({stamp[at]} ns): let "
            "one publisher only send the topic, and stamp each message with the time of its measurement"
        )


def _frozen(array: np.ndarray) -> np.ndarray:
    array = np.ascontiguousarray(array)
    array.flags.writeable = False
    return array


def _line(error: BaseException) -> str:
    """The words of an error on one line; its kind if it has none."""
    return " ".join(str(error).split())[:300].rstrip(".") or type(error).__name__
