"""ROS 2 bag -> Flight: a recorded flight as plain arrays, checked.

``python -m fiplib.bags info BAG`` describes one, ``python -m fiplib.bags recover BAG`` saves what is left of a damaged
one. A bag with the two motion-capture topics alone is a flight; everything else may be absent. Whatever is wrong with a
bag is one ``BagError`` that names the file and the topic and says what to do.
"""

import argparse
import dataclasses
import json
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rosbags.rosbag2 import Reader

from fiplib import console
from fiplib.params import NANO, Params
from fiplib.recorder import (
    IGNORE_RATES,
    JOINTS,
    LEVELS,
    ORIGINS,
    POINT,
    POSE,
    ROLES,
    SIDECAR,
    TOPICS,
    BagError,
    Layout,
    Recorder,
    genuine,
    typestore,
)
from fiplib.records import embedded_metadata
from fiplib.recover import intact_messages, recover

__all__ = ["TOPICS", "BagError", "Event", "Flight", "Poses", "Recorder", "Series", "TopicInfo", "read"]


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses of one tracked body, n of them; read-only arrays."""

    stamp: np.ndarray
    """(n,) int64, ns: time of exposure (the message's own stamp); strictly increasing."""
    received: np.ndarray
    """(n,) int64, ns: time of delivery (the bag's log time)."""
    position: np.ndarray
    """(n, 3) float64, m, frame ``world``, z up."""
    orientation: np.ndarray
    """(n, 4) float64, unit quaternion as x, y, z, w."""


@dataclass(frozen=True, eq=False)
class Series:
    """A signal of k named columns over n stamps; read-only arrays."""

    stamp: np.ndarray
    """(n,) int64, ns."""
    values: np.ndarray
    """(n, k) float64."""
    names: tuple[str, ...]
    units: tuple[str, ...]

    def column(self, name: str) -> np.ndarray:
        """The column (n,) of that name. Raises KeyError, with the names there are."""
        if name not in self.names:
            raise KeyError(f"no column {name!r}; columns are {', '.join(self.names)}")
        return self.values[:, self.names.index(name)]


class Event(NamedTuple):
    """Something that happened: a disturbance, a failsafe, a change of a parameter."""

    stamp: int
    """ns"""
    level: str
    """A key of ``recorder.LEVELS``, or the number in the message if it is none of them."""
    text: str


class TopicInfo(NamedTuple):
    """One topic of a bag, whether used or not; ``role`` is empty if it is not."""

    topic: str
    type: str
    count: int
    role: str


@dataclass(frozen=True, eq=False)
class Flight:
    """A recorded flight. What the bag does not hold is None (events: empty)."""

    path: Path
    metadata: dict[str, Any]
    """``origin`` (``simulated``, ``real``, ``unknown``) always; ``scenario``, ``seed``, ``version``, ``params`` ..."""
    vehicle: Poses
    pendulum: Poses
    state: Series | None
    """The ten states the controller used, in the order of ``params.STATES``."""
    command: Series | None
    """omega_x, omega_y, omega_z in rad/s and normalised thrust (recorded in single precision)."""
    reference: Series | None
    length: Series | None
    """used, estimate, standard_deviation in m; the latter two are NaN before the first estimate."""
    events: tuple[Event, ...]
    truth_state: Series | None
    truth_length: Series | None
    start_ns: int
    """The first exposure of either body: time zero of the flight."""
    topics: tuple[TopicInfo, ...]

    def time(self, data: Poses | Series | Event) -> Any:
        """Seconds since the start of the flight: (n,) float64 for arrays, one float for an event."""
        return (data.stamp - self.start_ns) / NANO

    @property
    def duration(self) -> float:
        """Seconds from the first exposure to the last."""
        return (max(int(body.stamp[-1]) for body in (self.vehicle, self.pendulum)) - self.start_ns) / NANO

    @property
    def simulated(self) -> bool:
        """Whether a simulator made this flight. Every figure and number made from it must say so."""
        return self.metadata["origin"] == "simulated"

    @property
    def params(self) -> Params:
        """The parameters the flight was flown with; what the bag does not say has its default. Raises BagError."""
        try:
            return Params.from_dict(self.metadata.get("params", {}))
        except (ValueError, TypeError, AttributeError) as error:
            raise BagError(f"{self.path}: its parameters are not those of this version of fiplib ({error})") from error

    def why_not_refit(self) -> str | None:
        """None if the length can be estimated from this flight, else one sentence that says why not."""
        if self.command is None:
            return (
                f"The bag holds no commands (topic {TOPICS['command']}), which the filter needs as its input: "
                "record them, or say under which name they are recorded."
            )
        estimation = self.params.estimation
        window = (estimation.window - 1) * estimation.sample_period
        common = min(self.command.stamp[-1], self.vehicle.stamp[-1], self.pendulum.stamp[-1])
        common = (common - max(self.command.stamp[0], self.vehicle.stamp[0], self.pendulum.stamp[0])) / NANO
        if common < window:
            return (
                f"Poses and commands overlap for {max(common, 0.0):.1f} s only, one estimation window is "
                f"{window:.1f} s: record a longer flight, or take a shorter window."
            )
        return None


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
                decoded[role] = _events(received) if role == "events" else _decode(role, received)
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
            return f"{words}. {count} messages are intact; into a new bag with: python -m fiplib.bags recover {path}"
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


def _events(received: _Received) -> tuple[Event, ...]:
    levels = {number: name for name, number in LEVELS.items()}
    messages = [typestore().deserialize_cdr(data, ROLES["events"].type) for _, data in received]
    stamps = np.array([message.stamp.sec * NANO + message.stamp.nanosec for message in messages], np.int64)
    _check_stamps(stamps, strict=False)
    return tuple(
        Event(int(stamp), levels.get(message.level, str(message.level)), message.msg)
        for stamp, message in zip(stamps, messages, strict=True)
    )


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


# --- command line --------------------------------------------------------------------------------------------------


def describe(flight: Flight) -> str:
    """What ``info`` prints: origin, scenario, duration, topics, parameters that differ from the default."""
    origin = {"simulated": "SIMULATED, not a real vehicle", "real": "real", "unknown": "unknown (the bag does not say)"}
    words = {key: flight.metadata.get(key, "-") for key in ("scenario", "version", "seed")}
    lines = [f"{'bag':<10} {flight.path}", f"{'origin':<10} {origin[flight.metadata['origin']]}"]
    lines += [f"{key:<10} {value}" for key, value in words.items()]
    if isinstance(recovered := flight.metadata.get("recovered"), dict):
        lines.append(f"{'recovered':<10} from {recovered.get('from')}, {recovered.get('damaged_bytes')} bytes damaged")
        lines[-1] += "" if recovered.get("finished") else ", without the end of the recording"
    lines += [f"{'duration':<10} {flight.duration:.2f} s", f"{'events':<10} {len(flight.events)}"]
    lines += [f"{'refit':<10} {flight.why_not_refit() or 'possible'}", ""]
    width = max(len(info.topic) for info in flight.topics)
    kind = max(len(info.type) for info in flight.topics)
    lines.append(f"{'topic':<{width}}  {'type':<{kind}}  {'messages':>8}  {'Hz':>6}  role")
    for info in flight.topics:
        rate = f"{(info.count - 1) / flight.duration:.1f}" if info.count > 1 and flight.duration > 0 else "-"
        lines.append(f"{info.topic:<{width}}  {info.type:<{kind}}  {info.count:>8}  {rate:>6}  {info.role}".rstrip())
    lines += ["", "parameters that differ from the default"]
    params, default = flight.params.to_dict(), Params().to_dict()
    changed = [
        f"  {group}.{name} = {value} {field.metadata['unit']} (default {default[group][name]})"
        for group, values in params.items()
        for (name, value), field in zip(values.items(), dataclasses.fields(getattr(Params(), group)), strict=True)
        if value != default[group][name]
    ]
    return "\n".join(lines + (changed or ["  none"]))


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line: ``info BAG``, ``recover BAG``. Returns the exit code: 0, or 2 with one line on stderr."""
    parser = argparse.ArgumentParser(prog="python -m fiplib.bags", description="Look into recorded flights.")
    commands = parser.add_subparsers(dest="command", required=True)
    info = commands.add_parser("info", help="say what a bag holds, and check it")
    info.add_argument("bag", type=Path, help="directory of a ROS 2 bag, or a bare .mcap file")
    info.add_argument(
        "--topic", action="append", default=[], metavar="ROLE=NAME", help=f"remap a topic; roles: {', '.join(ROLES)}"
    )
    rescue = commands.add_parser("recover", help="write what is left of a damaged or unfinished bag into a new one")
    rescue.add_argument("bag", type=Path, help="directory of a ROS 2 bag, or a bare .mcap file; it is not changed")
    rescue.add_argument("--output", type=Path, metavar="NEW", help="folder of the new bag (default: BAG-recovered)")
    options = parser.parse_args(arguments)
    try:
        if options.command == "info":
            print(describe(read(options.bag, dict(pair.partition("=")[::2] for pair in options.topic))))
        else:
            print(recover(options.bag, options.output).describe())
    except BagError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(console.run(main))
