"""Is this a plausible flight of a vehicle and its rod? What speaks against it, and what mends it.

Each check compares two things the recording says of one quantity: the tilt with the acceleration, the rod's axis with
the direction to it, a body's stamps with the log's. So a wrong convention is found from the motion, without a word
from anybody. What a check finds is mended before the next one looks: all cures together mend the flight.
"""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from fiplib.bags import motion
from fiplib.bags.conventions import QUATERNIONS, UNITS, body_z, restated, rotated
from fiplib.bags.roles import BODIES
from fiplib.params import NANO
from fiplib.recording import Flight, Poses

EXPLANATIONS = {
    "roles": "Vehicle and rod are two bodies, the rod above the vehicle.",
    "clocks": "Both bodies are stamped by one clock, the time of exposure: the rod's foot goes where the vehicle goes.",
    "tracking": "Both bodies are tracked: no pose stays the same in every digit, none jumps faster than 30 m/s.",
    "rate": "Poses come at 50 Hz at least; 100 Hz or more are better.",
    "up axis": "The rod stands along z, the world's axis that points up.",
    "quaternion": "Quaternions are x, y, z, w and turn the body into the world: the vehicle accelerates to where it "
    "tilts, and the rod's z axis points from the vehicle to the rod.",
    "attitude": "Each body has its z axis up when it is upright, in the frame in which positions are.",
    "unit": "Positions are in m: the vehicle accelerates as much as its tilt lets it.",
    "distance": "The distance of the two tracked points stays the same: twice it is the rod's length, if the vehicle "
    "is tracked at the seat and the rod at its middle.",
    "frames": "Both bodies are recorded in one frame, which stands still.",
    "rod point": "The rod is tracked at least 10 cm from its seat; at its foot its orientation alone tells the length.",
    "commands": "Commands are body rates in rad/s, stamped by the poses' clock: the vehicle turns as they say, within "
    "a quarter of a second. A length from poses alone needs none.",
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

LEAST_RATE = 45.0
"""Poses that come less often than this, Hz, hardly tell how a rod falls."""

LONGEST_DELAY = 0.25
"""A vehicle turns as commanded within this time, s."""

FASTEST_TURN = 30.0
"""No vehicle that balances a rod is commanded to turn faster than this, rad/s."""

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


def passed(found: Iterable[Finding]) -> list[str]:
    """Return the names of the checks that a flight with these findings passed."""
    names = {finding.name for finding in found}
    last = list(EXPLANATIONS)
    # a refusal without a cure ends the checks: what comes after it was not looked at
    if ended := [finding.name for finding in found if finding.refuses and not finding.cure]:
        last = last[: last.index(ended[0])]
    return [name for name in last if name not in names]


_KNOWN: "WeakKeyDictionary[Flight, list[Finding]]" = WeakKeyDictionary()


def _found(flight: Flight) -> Iterator[Finding]:
    for check in _CHECKS:
        for finding in check(flight):
            yield finding
            if finding.cure:
                flight = restated(flight, **finding.cure)
            elif finding.refuses:
                return
        if check is _still:
            flight = tracked(flight)


def tracked(flight: Flight) -> Flight:
    """Return the flight without the poses of bodies that stand still in every digit."""
    bodies = {body: _body(flight, body) for body in BODIES}
    kept = {body: ~still(poses) for body, poses in bodies.items()}
    if all(keep.all() for keep in kept.values()) or not all(keep.any() for keep in kept.values()):
        return flight
    return replace(flight, vehicle=_part(flight.vehicle, kept["vehicle"]),
                   pendulum=_part(flight.pendulum, kept["pendulum"]))  # fmt: skip


def still(poses: Poses) -> np.ndarray:
    """Return which poses (n,) bool belong to a stretch of at least ``STILL`` s in which no digit changes."""
    same = np.zeros(len(poses.stamp) + 1, bool)
    same[1:-1] = (np.diff(poses.position, axis=0) == 0.0).all(axis=1)
    same[1:-1] &= (np.diff(poses.orientation, axis=0) == 0.0).all(axis=1)
    begins, ends = np.flatnonzero(~same[:-1] & same[1:]), np.flatnonzero(same[:-1] & ~same[1:])
    found = np.zeros(len(poses.stamp), bool)
    for begin, end in zip(begins, ends, strict=True):
        found[begin : end + 1] = poses.stamp[end] - poses.stamp[begin] >= STILL * NANO
    return found


def _part(poses: Poses, keep: np.ndarray) -> Poses:
    return Poses(*(array[keep] for array in (poses.stamp, poses.received, poses.position, poses.orientation)))


def _one_body(flight: Flight) -> Iterator[Finding]:
    vehicle, rod = flight.vehicle, flight.pendulum
    same = len(vehicle.stamp) == len(rod.stamp) and np.array_equal(vehicle.position, rod.position)
    if same and np.array_equal(vehicle.orientation, rod.orientation):
        yield Finding(
            "roles", "vehicle and rod have the same poses: one body stands for both; say which is which, "
            "--topic vehicle=/its/name --topic pendulum=/its/name", {}, True,
        )  # fmt: skip


def _still(flight: Flight) -> Iterator[Finding]:
    for body in BODIES:
        poses = _body(flight, body)
        if not (found := still(poses)).any():
            continue
        share, first = float(found.mean()), flight.time(poses)[int(np.argmax(found))]
        where = " (at the origin)" if not poses.position[found].any() else ""
        yield Finding(
            "tracking", f"the {_NAMES[body]}'s pose stands still{where} in every digit for {100 * share:.0f} % of the "
            f"recording, first at {first:.1f} s: it was not tracked there; "
            + ("record it again" if share > 0.5 else "these poses are left out"), {}, share > 0.5,
        )  # fmt: skip


def _clock(flight: Flight) -> Iterator[Finding]:
    """Stamps that differ so much that bodies would be paired wrongly at sight."""
    vehicle, rod = flight.vehicle, flight.pendulum
    apart = _late(rod) - _late(vehicle)
    start, end = (pick(int(one.stamp[i]) for one in (vehicle, rod)) for pick, i in ((max, 0), (min, -1)))
    shortest = min(int(one.stamp[-1] - one.stamp[0]) for one in (vehicle, rod))
    if abs(apart) < 0.5 and end - start > shortest / 2:
        return
    logged = restated(flight, stamps="log")
    start, end = (pick(int(_body(logged, one).stamp[i]) for one in BODIES) for pick, i in ((max, 0), (min, -1)))
    far = f"their stamps are {abs(apart):.1f} s apart, as the log shows" if abs(apart) > 0.5 else "they hardly overlap"
    if end - start > shortest / 2 and abs(apart) > 0.5:
        yield Finding("clocks", f"vehicle and rod are stamped by different clocks: {far}; take the times at which they "
                      "were logged with --stamps log", {"stamps": "log"}, True)  # fmt: skip
    else:
        yield Finding("clocks", f"vehicle and rod were not recorded at the same time: {far}; record both bodies "
                      "together, stamped by one clock", {}, True)  # fmt: skip


def _late(poses: Poses) -> float:
    """By how many s poses were logged after their stamps, as a rule."""
    return float(np.median(poses.received - poses.stamp)) / NANO


def _delay(flight: Flight) -> Iterator[Finding]:
    if not (late := _behind(flight)):
        return
    whose = f"the rod's stamps are {1e3 * abs(late):.0f} ms {'late' if late > 0 else 'early'} against the vehicle's"
    logged = restated(flight, stamps="log")
    if not _behind(logged):
        yield Finding("clocks", f"{whose}, the times of logging are not: take those with --stamps log",
                      {"stamps": "log"}, True)  # fmt: skip
    else:
        yield Finding("clocks", f"{whose}: stamp both bodies by one clock with the time of exposure", {}, True)


def _behind(flight: Flight) -> float:
    """By how many s the rod's stamps are late against the vehicle's; 0 if they are not, or it cannot be told."""
    found = motion.delay(flight.vehicle, flight.pendulum)
    if found is None or abs(found[0]) < max(LATEST, 5.0 * found[1]):
        return 0.0
    return found[0]


def _up(flight: Flight) -> Iterator[Finding]:
    vehicle, rod = flight.vehicle, flight.pendulum
    reach = motion.arm(vehicle, rod)
    if not motion.distance_of(reach) > LEAST_ARM:
        return
    along = np.nanmedian(reach / np.linalg.norm(reach, axis=1, keepdims=True), axis=0)
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
        far = motion.distance_of(motion.arm(vehicle, poses)) > LEAST_ARM
        moved, against = motion.leaning(vehicle, poses) if far else None, "direction from the vehicle"
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
    distance = motion.distance_of(motion.arm(flight.vehicle, flight.pendulum))
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


def _distance(flight: Flight) -> Iterator[Finding]:
    reach = motion.arm(flight.vehicle, flight.pendulum)
    distance, lengths = motion.distance_of(reach), np.linalg.norm(reach, axis=1)
    lengths = lengths[np.isfinite(lengths)]
    away = float(np.mean(np.abs(lengths - distance) > 0.1 * distance + 0.02)) if len(lengths) else 0.0
    frames = [set(info.frames) for body in BODIES for info in flight.topics if body in info.role]
    differ = len(set().union(*frames)) > 1
    names = " and ".join(sorted(repr(name) for name in set().union(*frames)))
    if away > 0.2:
        low, high = np.quantile(lengths, [0.05, 0.95])
        varies = f"the distance of the two bodies varies from {low:.2f} to {high:.2f} m"
        if differ:
            yield Finding("frames", f"{varies}, and their frames are {names}: one is recorded relative to the other; "
                          "record both in the frame of the world", {}, True)  # fmt: skip
        else:
            yield Finding("distance", f"{varies}: they do not belong together; check the topics (--topic "
                          "vehicle=/its/name) and the names of the bodies", {}, True)  # fmt: skip
    elif differ:
        yield Finding("frames", f"the frames of the bodies are {names}; they fit together and are taken for one",
                      {}, False)  # fmt: skip
    if distance < LEAST_ARM:
        yield Finding("rod point", f"the rod is tracked {100 * distance:.0f} cm from the vehicle, at its foot: its "
                      "orientation alone tells its length, if it is uniform; track its middle", {}, False)  # fmt: skip


def _speed(flight: Flight) -> Iterator[Finding]:
    for body in BODIES:
        poses = _body(flight, body)
        step = np.linalg.norm(np.diff(poses.position, axis=0), axis=1)
        fast = step > FASTEST * np.maximum(np.diff(poses.stamp) / NANO, 1e-3)
        if not (count := int(fast.sum())):
            continue
        at, often = flight.time(poses)[int(np.argmax(fast))], count > 0.02 * len(step)
        yield Finding("tracking", f"the {_NAMES[body]} jumps {count} times faster than {FASTEST:.0f} m/s, first at "
                      f"{at:.1f} s: it was mistracked there; {'record it again' if often else 'cut that stretch out'}",
                      {}, often)  # fmt: skip


def _rate(flight: Flight) -> Iterator[Finding]:
    for body in BODIES:
        stamp = _body(flight, body).stamp
        rate = NANO / float(np.median(np.diff(stamp))) if len(stamp) > 1 else 0.0
        if 0.0 < rate < LEAST_RATE:
            yield Finding("rate", f"the {_NAMES[body]}'s poses come at {rate:.0f} Hz, hardly enough for a rod that is "
                          "balanced: record at 100 Hz or more", {}, False)  # fmt: skip


def _commands(flight: Flight) -> Iterator[Finding]:
    if (command := flight.command) is None or len(command.stamp) < 2:
        return
    fastest = float(np.quantile(np.abs(command.values[:, :3]), 0.99))
    found = motion.followed(flight.vehicle, command)
    if found and abs(found[2]) > 0.5:
        late, ratio, _ = found
        if ratio < 0:
            yield Finding("commands", "the vehicle turns against the commanded body rates: they are in other axes than "
                          "x forward, y left, z up", {}, False)  # fmt: skip
        elif 20.0 < ratio < 200.0:
            yield Finding("commands", f"the commanded body rates are {ratio:.0f} times as large as those flown: they "
                          "are in deg/s, it seems; record rad/s", {}, False)  # fmt: skip
        if not -0.05 < late < LONGEST_DELAY:
            logged = motion.followed(restated(flight, stamps="log").vehicle, command)
            cure = {"stamps": "log"} if logged and -0.05 < logged[0] < LONGEST_DELAY else {}
            way = "the times of logging agree: --stamps log takes those" if cure else "stamp both by one clock"
            when = f"{abs(late):.2f} s {'after' if late > 0 else 'before'} it is commanded to"
            yield Finding("commands", f"the vehicle turns {when}: poses and commands are stamped by different clocks; "
                          f"{way}", cure, False)  # fmt: skip
    elif fastest > FASTEST_TURN:
        yield Finding("commands", f"the commanded body rates reach {fastest:.0f} rad/s: they are in deg/s, it seems; "
                      "record rad/s", {}, False)  # fmt: skip


def _option(name: str, value: str) -> str:
    return f"{name}={value}" if value.startswith("-") else f"{name} {value}"


_CHECKS: tuple[Callable[[Flight], Iterator[Finding]], ...] = (
    _one_body, _still, _clock, _up, _quaternions, _unit, _distance, _delay, _speed, _rate, _commands,
)  # fmt: skip
