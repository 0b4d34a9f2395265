"""The data of a flight: frames, signals, events, and the recorder that they are written to."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fiplib.params import NANO, STATE_NAMES, STATES, FipError, Params


class Measurement(NamedTuple):
    """One frame of motion capture: both bodies at one exposure.

    ``stamp`` is the time of exposure in ns; positions (3,) in m, world frame, the pendulum's at its COM; attitudes (4,)
    are quaternions (x, y, z, w), the pendulum's z axis along the rod.
    """

    stamp: int
    vehicle_position: NDArray
    vehicle_attitude: NDArray
    pendulum_position: NDArray
    pendulum_attitude: NDArray


def numbers_of(measurement: Measurement) -> NDArray:
    """Return the 14 numbers of a frame in their order. Raises ValueError if it is not two poses."""
    try:
        _, *parts = measurement
        shapes, values = [np.shape(part) for part in parts], np.concatenate(parts, dtype=float)
    except Exception as error:  # whatever NumPy raises about what is no array
        raise ValueError(f"malformed frame: {type(measurement).__name__} ({error})") from error
    if shapes != [(3,), (4,), (3,), (4,)]:
        raise ValueError(f"malformed frame: two poses have the shapes (3,), (4,), (3,), (4,), not {shapes}")
    return values


def nanoseconds(now: int) -> int:
    """Return a time as a plain int. Raises ValueError if a ROS message cannot carry it, 0 to 2038."""
    if isinstance(now, int | np.integer) and not isinstance(now, bool) and 0 <= now < 2**31 * NANO:
        return int(now)
    raise ValueError(f"a time must be an integer in ns, from 0 to the year 2038, not {now!r}")


POSE = "geometry_msgs/msg/PoseStamped"
POINT = "geometry_msgs/msg/PointStamped"
JOINTS = "sensor_msgs/msg/JointState"
ATTITUDE = "mavros_msgs/msg/AttitudeTarget"
LOG = "rcl_interfaces/msg/Log"


class BagError(FipError):
    """A bag cannot be written or read; the message names the file and the topic and says what to do."""


class Role(NamedTuple):
    """The role of one topic: its default name, message type, frame, and the names and units of its numbers."""

    topic: str
    type: str
    frame: str
    names: tuple[str, ...]
    units: tuple[str, ...]


_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw"), ("m", "m", "m", "1", "1", "1", "1")
_COMMAND = ("omega_x", "omega_y", "omega_z", "thrust"), ("rad/s", "rad/s", "rad/s", "1")
_STATE_UNITS = tuple(signal.unit for signal in STATES)

ROLES = {
    "vehicle": Role("/mocap/quad/pose", POSE, "world", *_POSE),
    "pendulum": Role("/mocap/pendulum/pose", POSE, "world", *_POSE),
    "state": Role("/fip/state", JOINTS, "world", STATE_NAMES, _STATE_UNITS),
    "command": Role("/fip/command", ATTITUDE, "base_link", *_COMMAND),
    "reference": Role("/fip/reference", JOINTS, "world", STATE_NAMES, _STATE_UNITS),
    "length": Role("/fip/length", POINT, "world", ("used", "estimate", "standard_deviation"), ("m", "m", "m")),
    "events": Role("/fip/events", LOG, "", (), ()),
    "truth_state": Role("/truth/state", JOINTS, "world", (*STATE_NAMES, "z"), (*_STATE_UNITS, "m")),
    "truth_length": Role("/truth/length", POINT, "world", ("length",), ("m",)),
}
"""The bag contract. Topics can be remapped when a bag is read, and poses and commands may be of other types."""

TOPICS = {role: entry.topic for role, entry in ROLES.items()}
"""Default topic of each role."""

ORIGINS = ("simulated", "real", "unknown")

LEVELS = {"debug": 10, "info": 20, "warn": 30, "error": 40, "fatal": 50}
"""Severity of an event: the constants of rcl_interfaces/Log."""


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

    @classmethod
    def of(cls, role: str, stamp: np.ndarray, values: np.ndarray) -> "Series":
        """Return the signal of a role, with its names and units."""
        return cls(stamp, values, ROLES[role].names, ROLES[role].units)

    def column(self, name: str) -> np.ndarray:
        """Return the column (n,) of that name. Raises KeyError, with the names there are."""
        if name not in self.names:
            raise KeyError(f"no column {name!r}; columns are {', '.join(self.names)}")
        return self.values[:, self.names.index(name)]


class Event(NamedTuple):
    """Something that happened, as data and in words.

    What ``data`` holds, by ``kind``: "push" (on the rod's COM) ``impulse``, [x, y] in N s, and ``duration`` in s;
    "length" (prescribed) ``length`` in m; "status" (of the MPC) ``status``; "refusal" (of an estimate) ``reason``;
    "mode" (of the failsafe) ``from``, ``to`` and ``reason``; "fall" and "note" nothing.
    """

    stamp: int
    """ns"""
    level: str
    """A key of ``LEVELS``, or the number in the message if it is none of them."""
    text: str
    kind: str = "note"
    data: Mapping[str, Any] = {}


class TopicInfo(NamedTuple):
    """One topic of a bag; ``role`` is empty if it is not used, ``frames`` are those in which it gives poses."""

    topic: str
    type: str
    count: int  # type: ignore[assignment]  # a name of tuple's, which nobody calls here
    role: str
    frames: tuple[str, ...] = ()


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
    notes: tuple[str, ...] = ()
    """Assumptions and omissions of the reader, one sentence each."""

    def time(self, data: Poses | Series | Event) -> Any:
        """Seconds since the start of the flight: (n,) float64 for arrays, one float for an event."""
        return (data.stamp - self.start_ns) / NANO

    @property
    def duration(self) -> float:
        """Seconds from the first exposure to the last."""
        return (max(int(body.stamp[-1]) for body in (self.vehicle, self.pendulum)) - self.start_ns) / NANO

    @property
    def survived(self) -> bool:
        """Return whether no fall was recorded: rod and vehicle were up to the end."""
        return all(event.kind != "fall" for event in self.events)

    @property
    def simulated(self) -> bool:
        """Return whether a simulator made this flight. Every figure and number made from it must state this."""
        return self.metadata["origin"] == "simulated"

    @property
    def params(self) -> Params:
        """The parameters the flight was flown with; what the bag does not say has its default. Raises BagError."""
        try:
            return Params.from_dict(self.metadata.get("params", {}))
        except (ValueError, TypeError, AttributeError) as error:
            raise BagError(f"{self.path}: its parameters are not those of this version of fiplib ({error})") from error


EPOCH = 1_767_225_600 * NANO
"""Start of every simulated flight, ns: a fixed date, so that a bag does not depend on the day it was made."""


Numbers = Sequence[float] | NDArray
"""A few numbers in a fixed order, which a recorder takes."""


class Recorder(Protocol):
    """Where a flight is written to. Stamps are int nanoseconds; ``bags.BagRecorder`` writes a ROS 2 bag.

    A recorder takes ``numbers`` and events; the other methods put together the numbers of some roles.
    """

    failed: str | None = None
    """Why the recording stopped, in one sentence; ``None`` while it goes on."""

    def numbers(self, role: str, stamp: int, values: Numbers, received: int | None = None) -> None:
        """Take one message: the numbers that ``ROLES`` names, and for a pose the time at which it was received."""
        ...

    def event(self, stamp: int, level: str, text: str, kind: str = "note", data: Mapping | None = None) -> None:
        """Take what happened: ``level`` is a key of ``LEVELS``, ``kind`` and ``data`` are those of ``Event``."""
        ...

    def pose(self, body: str, stamp: int, received: int, position: Numbers, orientation: Numbers) -> None:
        """Pose of a body, exposed at ``stamp``, delivered at ``received``: (3,) in m, quaternion (4,) as x, y, z, w."""
        self.numbers(body, stamp, (*position, *orientation), received)

    def command(self, stamp: int, rates: Numbers, thrust: float) -> None:
        """Body rates (3,) in rad/s and normalised thrust, 0 to 1. A bag carries thrust in single precision."""
        self.numbers("command", stamp, (*rates, thrust))

    def length(self, stamp: int, used: float, raw: float, std: float) -> None:
        """Length that the controller uses, the raw estimate, and its standard deviation (both may be NaN), in m."""
        self.numbers("length", stamp, (used, raw, std))


class MemoryRecorder(Recorder):
    """Keeps a flight in memory, and hands it on to another recorder if there is one.

    ``stamps`` (ns) and ``values`` by role, and ``events``, are what has come so far; ``flight`` makes a flight of it.
    """

    def __init__(self, other: Recorder | None = None) -> None:
        self._other = other
        self.stamps: defaultdict[str, list[int]] = defaultdict(list)
        self.values: defaultdict[str, list[tuple[float, ...]]] = defaultdict(list)
        self.events: list[Event] = []

    def numbers(self, role: str, stamp: int, values: Numbers, received: int | None = None) -> None:
        self.stamps[role].append(stamp)
        self.values[role].append(tuple(values))
        if received is not None:
            self.stamps[f"{role} received"].append(received)
        if self._other:
            self._other.numbers(role, stamp, values, received)

    def event(self, stamp: int, level: str, text: str, kind: str = "note", data: Mapping | None = None) -> None:
        self.events.append(Event(stamp, level, text, kind, data or {}))
        if self._other:
            self._other.event(stamp, level, text, kind, data)

    def flight(self, path: str | Path, metadata: dict[str, Any]) -> Flight:
        """Return the flight so far, as ``bags.read`` would give it from its bag; at least one frame must be there."""
        return flight_of(path, metadata, self.stamps, self.values, self.events)


def flight_of(
    path: str | Path,
    metadata: dict[str, Any],
    stamps: Mapping[str, ArrayLike],
    values: Mapping[str, ArrayLike],
    events: Iterable[Event],
) -> Flight:
    """The flight of stamps (ns) and values by role, as a ``MemoryRecorder`` keeps them; the arrays are copied."""
    times = {role: np.array(known, np.int64) for role, known in stamps.items()}
    arrays = {role: np.array(known, np.float64) for role, known in values.items()}
    for array in (*times.values(), *arrays.values()):
        array.flags.writeable = False
    bodies: dict[str, Any] = {
        body: Poses(times[body], times[f"{body} received"], arrays[body][:, :3], arrays[body][:, 3:])
        for body in ("vehicle", "pendulum")
    }
    series: dict[str, Any] = {
        role: Series.of(role, times[role], arrays[role]) if role in times else None
        for role in ROLES
        if role not in (*bodies, "events")
    }
    start = int(min(poses.stamp[0] for poses in bodies.values()))
    return Flight(Path(path), metadata, events=tuple(events), start_ns=start, topics=(), **bodies, **series)
