"""Other conventions than ours: another axis up, other units and quaternions, the two bodies the other way round."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from fiplib.bags.roles import BODIES
from fiplib.recording import BagError, Flight, Poses

UNITS = {"m": 1.0, "dm": 0.1, "cm": 1e-2, "mm": 1e-3, "in": 0.0254, "ft": 0.3048}
"""Units of positions, in m."""

_HALF = np.sqrt(0.5)
UPWARDS = {
    "z": (0.0, 0.0, 0.0, 1.0),
    "y": (_HALF, 0.0, 0.0, _HALF),
    "x": (0.0, -_HALF, 0.0, _HALF),
    "-z": (1.0, 0.0, 0.0, 0.0),
    "-y": (-_HALF, 0.0, 0.0, _HALF),
    "-x": (0.0, _HALF, 0.0, _HALF),
}
"""The rotation that makes an axis z, as a quaternion x, y, z, w; ``-z`` is for north-east-down."""

QUATERNIONS = {
    "xyzw": ((0, 1, 2, 3), (1, 1, 1, 1)),
    "wxyz": ((1, 2, 3, 0), (1, 1, 1, 1)),
    "xyzw-inverse": ((0, 1, 2, 3), (-1, -1, -1, 1)),
    "wxyz-inverse": ((1, 2, 3, 0), (-1, -1, -1, 1)),
}
"""Places of x, y, z, w and their signs; ``inverse``: the quaternion turns the world into the body."""


def restated(
    flight: Flight,
    *,
    up: str | None = None,
    unit: str | None = None,
    swap: bool = False,
    quaternion: str | Mapping[str, str] | None = None,
    stamps: str | None = None,
) -> Flight:
    """Return the flight with its poses in our conventions: z up, m, x, y, z, w, the rod above the vehicle.

    Args:
        flight: as its bag has it.
        up: the axis that points up, a key of ``UPWARDS``. The bodies' axes are turned with the world's, unless their
            z axes point up already.
        unit: of positions, a key of ``UNITS``.
        swap: what was taken for the vehicle is the rod, and the other way round.
        quaternion: order and sense, a key of ``QUATERNIONS``, of both bodies or of some, by their names in ``BODIES``.
        stamps: "log" takes the times at which poses were logged for their stamps.

    Raises:
        BagError: no such axis, unit, order, body or stamps.
    """
    orders = quaternion if isinstance(quaternion, Mapping) else dict.fromkeys(BODIES, quaternion or "xyzw")
    bodies = {"vehicle": flight.vehicle, "pendulum": flight.pendulum}
    for what, given, known in (
        ("axis", [up or "z"], UPWARDS), ("unit", [unit or "m"], UNITS),
        ("order of quaternions", orders.values(), QUATERNIONS), ("body", orders, bodies),
        ("stamps", [stamps or "log"], ("log",)),
    ):  # fmt: skip
        if unknown := [one for one in given if one not in known]:
            raise BagError(f"{flight.path}: no such {what}: {unknown[0]!r}; there are {', '.join(known)}")
    if swap:
        bodies = {"vehicle": flight.pendulum, "pendulum": flight.vehicle}
    for body, order in orders.items():
        places, signs = QUATERNIONS[order]
        poses = bodies[body]
        if order != "xyzw":
            bodies[body] = _frozen(poses, poses.position, poses.orientation[:, places] * np.array(signs, float))
    if up not in (None, "z"):
        bodies = {body: _turned(poses, up) for body, poses in bodies.items()}
    if unit not in (None, "m"):
        bodies = {body: _frozen(one, one.position * UNITS[unit], one.orientation) for body, one in bodies.items()}
    if stamps:
        bodies = {body: _logged(poses) for body, poses in bodies.items()}
    said = {
        f"{up} points up, as stated: the frame is turned": up and up != "z",
        f"positions are in {unit}, as stated": unit and unit != "m",
        "vehicle and rod are swapped, as stated": swap,
        "the times at which poses were logged stand for their stamps, as stated": stamps,
        **{f"the quaternions of the {body} are {order}, as stated": order != "xyzw" for body, order in orders.items()},
    }
    notes = tuple(note for note, holds in said.items() if holds)
    topics = flight.topics
    if swap:
        other = str.maketrans({"\0": "pendulum", "\1": "vehicle"})
        topics = tuple(
            info._replace(role=info.role.replace("vehicle", "\0").replace("pendulum", "\1").translate(other))
            for info in topics
        )
    if not notes:
        return flight
    start = min(int(poses.stamp[0]) for poses in bodies.values())
    return replace(flight, **bodies, start_ns=start, topics=topics, notes=(*flight.notes, *notes))


def rotated(quaternion: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Return vectors (n, 3) or (3,) rotated by quaternions (n, 4) or (4,)."""
    axis, w = quaternion[..., :3], quaternion[..., 3:]
    across = 2.0 * np.cross(axis, vector)
    return vector + w * across + np.cross(axis, across)


def body_z(poses: Poses) -> np.ndarray:
    """Return the z axis of a body in the world, (n, 3)."""
    return rotated(poses.orientation, np.array([0.0, 0.0, 1.0]))


def _turned(poses: Poses, up: str) -> Poses:
    turn = np.array(UPWARDS[up])
    position = rotated(turn, poses.position)
    with_body = np.column_stack([rotated(turn, poses.orientation[:, :3]), poses.orientation[:, 3]])
    vector, w = poses.orientation[:, :3], poses.orientation[:, 3:]
    world_alone = np.column_stack(
        [turn[3] * vector + w * turn[:3] + np.cross(turn[:3], vector), turn[3] * w[:, 0] - vector @ turn[:3]]
    )
    turns = (_frozen(poses, position, orientation) for orientation in (with_body, world_alone))
    return max(turns, key=lambda one: float(np.median(body_z(one)[:, 2])))


def _logged(poses: Poses) -> Poses:
    order = np.argsort(poses.received, kind="stable")
    stamp = poses.received[order]
    keep = order[np.diff(stamp, prepend=stamp[0] - 1) > 0]
    arrays = tuple(np.ascontiguousarray(array[keep]) for array in (poses.position, poses.orientation))
    for array in (stamp := poses.received[keep], *arrays):
        array.flags.writeable = False
    return Poses(stamp, stamp, *arrays)


def _frozen(poses: Poses, position: np.ndarray, orientation: np.ndarray) -> Poses:
    arrays = np.ascontiguousarray(position), np.ascontiguousarray(orientation)
    for array in arrays:
        array.flags.writeable = False
    return Poses(poses.stamp, poses.received, *arrays)
