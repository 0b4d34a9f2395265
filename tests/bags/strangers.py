"""Bags as strangers record them, written by rosbags alone, from 12 s of a flight of ours with a rod of 1.00 m."""

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from fiplib.bags import read

FLIGHT = Path(__file__).parents[2] / "data" / "estimate-1.4"
NANO = 1_000_000_000
VEHICLE, ROD, COMMAND = "/mocap/quad/pose", "/mocap/pendulum/pose", "/fip/command"
POSE, TRANSFORM = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/TransformStamped"
COVARIANCE, ODOMETRY = "geometry_msgs/msg/PoseWithCovarianceStamped", "nav_msgs/msg/Odometry"
TREE, RIGID = "tf2_msgs/msg/TFMessage", "mocap4r2_msgs/msg/RigidBodies"
ATTITUDE, TWIST = "mavros_msgs/msg/AttitudeTarget", "geometry_msgs/msg/TwistStamped"
_DEFINED = {
    ATTITUDE: "std_msgs/Header header\nuint8 type_mask\ngeometry_msgs/Quaternion orientation\n"
    "geometry_msgs/Vector3 body_rate\nfloat32 thrust",
    "mocap4r2_msgs/msg/RigidBody": "string rigid_body_name\ngeometry_msgs/Pose pose",
    RIGID: "std_msgs/Header header\nuint32 frame_number\nmocap4r2_msgs/RigidBody[] rigidbodies",
}
STORE = get_typestore(Stores.ROS2_HUMBLE)
for _name, _text in _DEFINED.items():
    STORE.register(get_types_from_msg(_text, _name))
_T = STORE.types


class Body(NamedTuple):
    """Stamps and log times (n,) ns, positions (n, 3), quaternions (n, 4) x, y, z, w."""

    stamp: np.ndarray
    log: np.ndarray
    position: np.ndarray
    orientation: np.ndarray

    def part(self, keep: Any) -> "Body":
        return Body(*(array[keep] for array in self))

    def later(self, stamp: float = 0.0, log: float = 0.0) -> "Body":
        """By so many s in its stamps and in the log."""
        return self._replace(stamp=self.stamp + round(stamp * NANO), log=self.log + round(log * NANO))

    def scaled(self, factor: float) -> "Body":
        return self._replace(position=factor * self.position)

    def ordered(self, *places: int) -> "Body":
        return self._replace(orientation=self.orientation[:, places])

    def inverse(self) -> "Body":
        return self._replace(orientation=self.orientation * [-1, -1, -1, 1])

    def seen_from(self, turn: Rotation, bodies_too: bool = True) -> "Body":
        """In a frame that is turned; the body's own axes are named alike, or kept."""
        own = turn.inv() if bodies_too else Rotation.identity()
        orientation = turn * Rotation.from_quat(self.orientation) * own
        return self._replace(position=turn.apply(self.position), orientation=orientation.as_quat())

    def moved(self, *offset: float) -> "Body":
        """With its tracked point elsewhere in the body, m."""
        return self._replace(position=self.position + Rotation.from_quat(self.orientation).apply(offset))


class Recording(NamedTuple):
    """What a bag is made of; commands (n, 5): times in s from the first, rates, thrust."""

    vehicle: Body
    rod: Body
    stamp: np.ndarray
    command: np.ndarray

    def both(self, change: Callable[[Body], Body]) -> "Recording":
        return self._replace(vehicle=change(self.vehicle), rod=change(self.rod))

    def of_rod(self, change: Callable[[Body], Body]) -> "Recording":
        return self._replace(rod=change(self.rod))

    def of_vehicle(self, change: Callable[[Body], Body]) -> "Recording":
        return self._replace(vehicle=change(self.vehicle))


def recorded(start: float = 5.0, end: float = 17.0) -> Recording:
    """Return a stretch of our flight, in s."""
    flight = read(FLIGHT)
    bodies = []
    for poses in (flight.vehicle, flight.pendulum):
        keep = (flight.time(poses) >= start) & (flight.time(poses) < end)
        bodies.append(Body(poses.stamp, poses.received, poses.position, poses.orientation).part(keep))
    keep = (flight.time(flight.command) >= start) & (flight.time(flight.command) < end)
    return Recording(*bodies, flight.command.stamp[keep], flight.command.values[keep])


def header(stamp: int, frame: str) -> Any:
    return _T["std_msgs/msg/Header"](_T["builtin_interfaces/msg/Time"](int(stamp) // NANO, int(stamp) % NANO), frame)


def _of(kind: str, values: Iterable[float]) -> Any:
    return _T[f"geometry_msgs/msg/{kind}"](*map(float, values))


def _pose(position: np.ndarray, orientation: np.ndarray) -> Any:
    return _T["geometry_msgs/msg/Pose"](_of("Point", position), _of("Quaternion", orientation))


Row = tuple[int, str, str, bytes]
"""Log time, topic, type, message."""


def poses(topic: str, body: Body, kind: str = POSE, frame: str = "world", child: str = "") -> Iterator[Row]:
    child = child or {VEHICLE: "quad", ROD: "pendulum"}.get(topic, topic)
    still = _T["geometry_msgs/msg/TwistWithCovariance"](
        _T["geometry_msgs/msg/Twist"](_of("Vector3", (0, 0, 0)), _of("Vector3", (0, 0, 0))), np.zeros(36)
    )
    for stamp, log, position, orientation in zip(*body, strict=True):
        head = header(stamp, frame)
        if kind == POSE:
            message = _T[kind](head, _pose(position, orientation))
        elif kind in (COVARIANCE, ODOMETRY):
            sure = _T["geometry_msgs/msg/PoseWithCovariance"](_pose(position, orientation), np.zeros(36))
            message = _T[kind](head, sure) if kind == COVARIANCE else _T[kind](head, child, sure, still)
        else:
            moved = _T["geometry_msgs/msg/Transform"](_of("Vector3", position), _of("Quaternion", orientation))
            message = _T[TRANSFORM](head, child, moved)
            message = _T[TREE]([message]) if kind == TREE else message
        yield int(log), "/tf" if kind == TREE else topic, kind, bytes(STORE.serialize_cdr(message, kind))


def rigid_bodies(flight: Recording) -> Iterator[Row]:
    kind, one = _T[RIGID], _T["mocap4r2_msgs/msg/RigidBody"]
    named = {"quad": flight.vehicle, "pendulum": flight.rod}
    for i, (stamp, log) in enumerate(zip(flight.vehicle.stamp, flight.vehicle.log, strict=True)):
        bodies = [one(name, _pose(body.position[i], body.orientation[i])) for name, body in named.items()]
        message = kind(header(stamp, "world"), i, bodies)
        yield int(log), "/rigid_bodies", RIGID, bytes(STORE.serialize_cdr(message, RIGID))


def commands(flight: Recording, topic: str = COMMAND, kind: str = ATTITUDE, mask: int = 128) -> Iterator[Row]:
    for stamp, (x, y, z, thrust) in zip(flight.stamp, flight.command, strict=True):
        head, rates = header(stamp, "base_link"), _of("Vector3", (x, y, z))
        if kind == ATTITUDE:
            message = _T[kind](head, mask, _of("Quaternion", (0, 0, 0, 1)), rates, float(thrust))
        else:
            message = _T[kind](head, _T["geometry_msgs/msg/Twist"](_of("Vector3", (0, 0, thrust)), rates))
        yield int(stamp), topic, kind, bytes(STORE.serialize_cdr(message, kind))


def rows(flight: Recording, kind: str = POSE, with_commands: bool = True) -> list[Row]:
    """All messages of a recording, as our own topics are named."""
    told = commands(flight) if with_commands else ()
    return [*poses(VEHICLE, flight.vehicle, kind), *poses(ROD, flight.rod, kind), *told]


def write(
    path: Path,
    messages: Iterable[Row],
    storage: StoragePlugin = StoragePlugin.MCAP,
    compression: CompressionMode | None = None,
    metadata: bool = True,
) -> Path:
    """Write messages in the order of their log times."""
    writer, links = Writer(path, version=9, storage_plugin=storage), {}
    if compression:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        for log, topic, kind, data in sorted(messages, key=lambda row: row[0]):
            if topic not in links:
                links[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(links[topic], log, data)
    if not metadata:
        (path / "metadata.yaml").unlink()
    return path


def split(path: Path, messages: Iterable[Row]) -> Path:
    """Three files that lost their metadata.yaml."""
    path.mkdir()
    ordered = sorted(messages, key=lambda row: row[0])
    for number, part in enumerate(np.array_split(np.arange(len(ordered)), 3)):
        written = write(path / "part", [ordered[index] for index in part])
        next(written.glob("*.mcap")).rename(path / f"split_{number}.mcap")
        for left in written.iterdir():
            left.unlink()
        written.rmdir()
    return path


def ros1(path: Path, flight: Recording) -> Path:
    store = get_typestore(Stores.ROS1_NOETIC)
    types = store.types
    with Ros1Writer(path) as writer:
        for topic, body in ((VEHICLE, flight.vehicle), (ROD, flight.rod)):
            link = writer.add_connection(topic, POSE, typestore=store)
            for i, (stamp, log, position, orientation) in enumerate(zip(*body, strict=True)):
                time = types["builtin_interfaces/msg/Time"](int(stamp) // NANO, int(stamp) % NANO)
                message = types[POSE](types["std_msgs/msg/Header"](i, time, "world"), _pose(position, orientation))
                writer.write(link, int(log), store.serialize_ros1(message, POSE))
    return path


def motive(path: Path, flight: Recording) -> Path:
    """The layout of an OptiTrack export: y up, millimetres, quaternions x, y, z, w."""
    up = Rotation.from_euler("x", -90, degrees=True)
    bodies = [body.seen_from(up) for body in (flight.vehicle, flight.rod)]
    names = ["quad"] * 7 + ["pendulum"] * 7
    turned, placed = ["Rotation"] * 4, ["Position"] * 3
    lines = [
        ["Format Version", "1.23", "Export Frame Rate", "240", "Rotation Type", "Quaternion", "Length Units",
         "Millimeters"],
        [],
        ["", "", *["Rigid Body"] * 14],
        ["", "", *names],
        ["", "", *(turned + placed) * 2],
        ["Frame", "Time (Seconds)", *["X", "Y", "Z", "W", "X", "Y", "Z"] * 2],
    ]  # fmt: skip
    time = (bodies[0].stamp - bodies[0].stamp[0]) / NANO
    table = np.column_stack([part for body in bodies for part in (body.orientation, 1000 * body.position)])
    lines += [[str(i), f"{time[i]:.6f}", *(f"{x:.6f}" for x in row)] for i, row in enumerate(table)]
    path.write_text("\n".join(",".join(line) for line in lines) + "\n")
    return path
