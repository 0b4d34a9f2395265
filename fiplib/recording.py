"""What a flight leaves behind: frames, signals, events, and what they are recorded to."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fiplib.params import NANO, STATE_NAMES, STATES, Params


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


POSE = "geometry_msgs/msg/PoseStamped"

POINT = "geometry_msgs/msg/PointStamped"

JOINTS = "sensor_msgs/msg/JointState"

ATTITUDE = "mavros_msgs/msg/AttitudeTarget"

LOG = "rcl_interfaces/msg/Log"


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


EPOCH = 1_767_225_600 * NANO
"""Start of every simulated flight, ns: a fixed date, so that a bag does not depend on the day it was made."""


class Recorder(Protocol):
    """What a flight is written to; times in ns. ``bags.Recorder`` writes a ROS 2 bag, ``MemoryRecorder`` keeps arrays."""

    def pose(self, body: str, stamp: int, received: int, position: ArrayLike, orientation: ArrayLike) -> None: ...
    def state(self, stamp: int, values: ArrayLike) -> None: ...
    def reference(self, stamp: int, values: ArrayLike) -> None: ...
    def command(self, stamp: int, rates: ArrayLike, thrust: float) -> None: ...
    def length(self, stamp: int, used: float, raw: float, std: float) -> None: ...
    def event(self, stamp: int, level: str, text: str) -> None: ...
    def truth(self, stamp: int, values: ArrayLike) -> None: ...
    def truth_length(self, stamp: int, length: float) -> None: ...


class MemoryRecorder:
    """A recorder in memory: ``tape["state"]`` is an array of (time in s since the start, values...).

    ``stamps`` and ``values`` hold the same by topic, times in ns; ``replay.flight_of`` makes a ``Flight`` of them.
    """

    def __init__(self) -> None:
        self.stamps: dict[str, list[int]] = {}
        self.values: dict[str, list[tuple[float, ...]]] = {}
        self.events: list[tuple[int, str, str]] = []

    def _add(self, topic: str, stamp: int, *values: float) -> None:
        self.stamps.setdefault(topic, []).append(stamp)
        self.values.setdefault(topic, []).append(values)

    def pose(self, body: str, stamp: int, received: int, position: ArrayLike, orientation: ArrayLike) -> None:
        self._add(body, stamp, *position, *orientation)
        self.stamps.setdefault(f"{body} received", []).append(received)

    def state(self, stamp: int, values: ArrayLike) -> None:
        self._add("state", stamp, *values)

    def reference(self, stamp: int, values: ArrayLike) -> None:
        self._add("reference", stamp, *values)

    def command(self, stamp: int, rates: ArrayLike, thrust: float) -> None:
        self._add("command", stamp, *rates, thrust)

    def length(self, stamp: int, used: float, raw: float, std: float) -> None:
        self._add("length", stamp, used, raw, std)

    def event(self, stamp: int, level: str, text: str) -> None:
        self.events.append((stamp, level, text))

    def truth(self, stamp: int, values: ArrayLike) -> None:
        self._add("truth_state", stamp, *values)

    def truth_length(self, stamp: int, length: float) -> None:
        self._add("truth_length", stamp, length)

    def __getitem__(self, topic: str) -> NDArray:
        seconds = (np.array(self.stamps.get(topic, []), dtype=np.int64) - EPOCH) / NANO
        return np.column_stack([seconds, np.array(self.values.get(topic, []))]) if len(seconds) else np.zeros((0, 0))
