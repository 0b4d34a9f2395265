"""Is this a plausible flight of a vehicle and its rod? What speaks against it, and what mends it.

Each check compares two things the recording says of one quantity: the tilt with the acceleration, the rod's axis with
the direction to it, a body's stamps with the log's. So a wrong convention is found from the motion, without a word
from anybody. What a check finds is mended before the next one looks: all cures together mend the flight.
"""

import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from fiplib.bags import motion
from fiplib.bags.conventions import QUATERNIONS, UNITS, body_z, restated, rotated
from fiplib.bags.roles import BODIES
from fiplib.recording import Flight, Poses

EXPLANATIONS = {
    "roles": "Vehicle and rod are two bodies, the rod above the vehicle.",
    "up axis": "The rod stands along z, the world's axis that points up.",
    "quaternion": "Quaternions are x, y, z, w and turn the body into the world: the vehicle accelerates to where it "
    "tilts, and the rod's z axis points from the vehicle to the rod.",
    "attitude": "Each body has its z axis up when it is upright, in the frame in which positions are.",
    "unit": "Positions are in m: the vehicle accelerates as much as its tilt lets it.",
}
"""What each check expects of a recording, by name of its finding."""

LEAST_ARM = 0.1
"""Tracked points closer than this, m, say nothing of the rod's direction."""

FASTEST = 30.0
"""No body moves faster than this between two poses, m/s."""

LATEST = 3e-3
"""The stamps of both bodies may differ by this much, s."""

STILL = 0.1
"""A body whose pose does not change in any digit for this long, s, is not tracked."""

_SURE = 0.2  # largest standard deviation of a relation that is believed, relative
_NEAR = 0.45  # largest deviation of an entry of a relation from the one it should have; 12 cm of seat reach 0.3
_UPRIGHT = 0.7  # least z component of an axis that points up
_FAR = 20.0  # m: no rod is that long
_EYE = np.eye(2)
_NAMES = {"vehicle": "vehicle", "pendulum": "rod"}


class Finding(NamedTuple):
    """What speaks against a flight."""

    name: str
    """A key of ``EXPLANATIONS``."""
    sentence: str
    """What is wrong and what to do about it."""
    cure: dict[str, Any]
    """Keyword arguments of ``bags.read`` that mend it; empty if none does."""
    refuses: bool
    """Whether a length would be meaningless."""


def findings(flight: Flight) -> list[Finding]:
    """Return what speaks against a flight, the first cause first; empty if nothing does.

    The cures can be taken together: ``bags.read(path, **first.cure, **second.cure)``.
    """
    if flight not in _KNOWN:
        _KNOWN[flight] = list(_found(flight))
    return list(_KNOWN[flight])


def refusal(flight: Flight) -> Finding | None:
    """Return the first finding that makes every length of this flight meaningless, or None."""
    return next((finding for finding in findings(flight) if finding.refuses), None)


_KNOWN: "WeakKeyDictionary[Flight, list[Finding]]" = WeakKeyDictionary()


def _found(flight: Flight) -> Iterator[Finding]:
    for check in _CHECKS:
        for finding in check(flight):
            yield finding
            if finding.cure:
                flight = restated(flight, **finding.cure)
            elif finding.refuses:
                return


def _one_body(flight: Flight) -> Iterator[Finding]:
    vehicle, rod = flight.vehicle, flight.pendulum
    same = len(vehicle.stamp) == len(rod.stamp) and np.array_equal(vehicle.position, rod.position)
    if same and np.array_equal(vehicle.orientation, rod.orientation):
        yield Finding(
            "roles", "vehicle and rod have the same poses: one body stands for both; say which is which, "
            "--topic vehicle=/its/name --topic pendulum=/its/name", {}, True,
        )  # fmt: skip


def _up(flight: Flight) -> Iterator[Finding]:
    vehicle, rod = flight.vehicle, flight.pendulum
    reach = motion.arm(vehicle, rod)
    lengths = np.linalg.norm(reach, axis=1)
    if np.median(lengths) < LEAST_ARM:
        return
    along = np.median(reach / np.maximum(lengths, 1e-9)[:, None], axis=0)
    axis = int(np.argmax(np.abs(along)))
    if abs(along[axis]) < _UPRIGHT:
        yield Finding("up axis", "the rod stands along none of the axes: turn the world's frame so that z points up, "
                      "or cut the recording to where the rod is balanced", {}, True)  # fmt: skip
    elif axis < 2:
        up = ("-" if along[axis] < 0 else "") + "xy"[axis]
        yield Finding("up axis", f"the rod stands along {up}, not along z: {up} points up, it seems (or the rod lies "
                      f"on its side); turn the frame with {_option('--up', up)}", {"up": up}, True)  # fmt: skip
    elif along[2] < 0:
        moved = motion.thrust(vehicle)
        if moved and moved.deviation < _SURE * abs(np.trace(moved.matrix)):
            down = np.trace(moved.matrix) < 0
        else:
            down = float(np.median(rod.position[:, 2])) < 0 and float(np.median(vehicle.position[:, 2])) < 0
        if down:
            yield Finding("up axis", "the rod is below the vehicle, and the vehicle tilts as if z pointed down: turn "
                          "the frame with --up=-z", {"up": "-z"}, True)  # fmt: skip
        else:
            yield Finding("roles", "the rod is below the vehicle: the bodies are swapped, it seems; swap them with "
                          "--swap (a rod that hangs is not balanced)", {"swap": True}, True)  # fmt: skip


def _quaternions(flight: Flight) -> Iterator[Finding]:
    mended: dict[str, str] = {}
    for body in BODIES:
        vehicle = None if body == "vehicle" else flight.vehicle
        if (wrong := _attitude(_body(flight, body), vehicle)) is None:
            continue
        others = {order: restated(flight, quaternion={body: order}) for order in list(QUATERNIONS)[1:]}
        healthy = [order for order, other in others.items() if _attitude(_body(other, body), vehicle) is None]
        if not healthy:
            yield Finding("attitude", f"the {_NAMES[body]}'s {wrong}", {}, True)
            return
        mended[body], flight = healthy[0], others[healthy[0]]
    if mended:
        same = len(mended) == len(BODIES) and len(set(mended.values())) == 1
        options = [mended["vehicle"]] if same else [f"{body}={order}" for body, order in mended.items()]
        orders = " and ".join(dict.fromkeys(
            f"{', '.join(order[:4])}{' and turn the world into the body' if order.endswith('inverse') else ''}"
            for order in mended.values()
        ))  # fmt: skip
        whose = "both bodies" if len(mended) == len(BODIES) else f"the {_NAMES[next(iter(mended))]}"
        yield Finding(
            "quaternion", f"the attitude of {whose} does not fit the motion, and does if the quaternions are {orders}: "
            f"read them with {' '.join(f'--quaternion {option}' for option in options)}",
            {"quaternion": mended["vehicle"] if same else mended}, True,
        )  # fmt: skip


def _body(flight: Flight, body: str) -> Poses:
    return flight.vehicle if body == "vehicle" else flight.pendulum


def _attitude(poses: Poses, vehicle: Poses | None) -> str | None:
    """What is wrong with the attitude of the vehicle, or of the rod on a ``vehicle``; None if nothing is."""
    upright = float(np.median(body_z(poses)[:, 2]))
    if vehicle is None:
        moved, against = motion.thrust(poses), "acceleration"
    else:
        reach = motion.arm(vehicle, poses)
        lengths = np.linalg.norm(reach, axis=1)
        if np.median(lengths) < LEAST_ARM:
            moved = None
        else:
            moved, against = motion.leaning(vehicle, poses), "direction from the vehicle"
    if upright < _UPRIGHT:
        for axis, letter in enumerate("xyz"):
            height = float(np.median(rotated(poses.orientation, np.eye(3)[axis])[:, 2]))
            if abs(height) > _UPRIGHT:
                sign = "-" if height < 0 else ""
                return f"{sign}{letter} axis points up, not its z axis: define the body with z up when it is upright"
        return "z axis does not point up: define the body with z up when it is upright, or check its quaternions"
    if moved is None:
        return None
    scale = float(np.trace(moved.matrix)) / 2.0 if vehicle is None else 1.0
    size = float(np.linalg.norm(moved.matrix)) / math.sqrt(2.0)
    if moved.deviation > _SURE * max(size, 0.5):
        return None
    if scale > 0 and motion.Relation(moved.matrix / scale, 0.0).is_near(_EYE, _NEAR) and size > 1 - _NEAR:
        return None
    if size < 0.3:
        return f"tilt has nothing to do with its {against}: is its orientation that of another body, or not tracked?"
    if np.linalg.det(moved.matrix) < 0:
        return f"tilt is mirrored against its {against}: the frame is left-handed, or one axis has the wrong sign"
    angle = math.degrees(math.atan2(moved.matrix[1, 0] - moved.matrix[0, 1], np.trace(moved.matrix)))
    return (
        f"tilt is turned by {angle:.0f} deg about z against its {against}: positions and orientations are in different "
        "frames; record both in one"
    )


def _unit(flight: Flight) -> Iterator[Finding]:
    moved = motion.thrust(flight.vehicle)
    distance = float(np.median(np.linalg.norm(motion.arm(flight.vehicle, flight.pendulum), axis=1)))
    if moved and moved.deviation < _SURE * (scale := float(np.trace(moved.matrix)) / 2.0) and scale > 0:
        ratio = {unit: abs(math.log(scale * size)) for unit, size in UNITS.items()}
        unit = min(ratio, key=ratio.__getitem__)
        fits, why = ratio[unit] < 0.5, f"the vehicle accelerates {scale:.3g} times as much as its tilt lets it"
    else:
        unit, fits = ("mm" if distance > _FAR else "m"), True
        why = f"the two bodies are {distance:.0f} m apart"
    if not fits:
        yield Finding("unit", f"{why}: positions are in no unit that is known; convert them to m", {}, True)
    elif unit != "m":
        yield Finding("unit", f"{why}: positions are in {unit}, it seems; read them with --unit {unit}",
                      {"unit": unit}, True)  # fmt: skip


def _option(name: str, value: str) -> str:
    return f"{name}={value}" if value.startswith("-") else f"{name} {value}"


_CHECKS: tuple[Callable[[Flight], Iterator[Finding]], ...] = (_one_body, _up, _quaternions, _unit)
