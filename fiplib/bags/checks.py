"""Checks whether a recording is a plausible flight of a vehicle and its rod: each fault with its remedy.

Each check compares two things the recording says of one quantity: the tilt with the acceleration, the rod's axis with
the direction to it, a body's stamps with the log's. So a wrong convention is found from the motion alone. A fault
is corrected before the next check: all remedies together correct the flight.
"""

import math
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from fiplib.bags import motion
from fiplib.bags.conventions import QUATERNIONS, UNITS, restated, rotated
from fiplib.bags.explanations import EXPLANATIONS
from fiplib.bags.roles import BODIES
from fiplib.bags.tracking import LONGEST_GAP, lost, tracked
from fiplib.params import NANO
from fiplib.recording import Flight, Poses

LEAST_ARM = 0.1
"""Tracked points closer than this, m, say nothing of the rod's direction."""

FASTEST = 30.0
"""No body moves faster than this between two poses, m/s."""

LATEST = 1.5e-3
"""The stamps of both bodies may differ by this much, s."""

LEAST_RATE = 45.0
"""Least rate of poses, Hz: at a lower one they hardly show how a rod falls."""

LONGEST_DELAY = 0.25
"""A vehicle turns as commanded within this time, s."""

FASTEST_TURN = 30.0
"""No vehicle that balances a rod is commanded to turn faster than this, rad/s."""

_TURNED = 0.15  # rad by which two frames may differ in yaw; the best fit of a rod that circles errs by 0.05
_UPRIGHT = 0.7  # least z component of an axis that points up
_FAR = 20.0  # m: no rod is that long
_NAMES = {"vehicle": "vehicle", "pendulum": "rod"}


class Finding(NamedTuple):
    """A reason to doubt a recording."""

    name: str
    """A key of ``EXPLANATIONS``."""
    sentence: str
    """The fault and its remedy."""
    cure: dict[str, Any]
    """Keyword arguments of ``bags.read`` that correct it; empty if none does."""
    refuses: bool
    """Whether a length would be meaningless."""


def findings(flight: Flight) -> list[Finding]:
    """Return what speaks against a flight, the first cause first; empty if nothing does.

    The cures can be taken together: ``bags.read(path, **first.cure, **second.cure)``.
    """
    if min(len(flight.vehicle.stamp), len(flight.pendulum.stamp)) < 2:
        return []  # too few to say anything, or for a length
    if flight not in _KNOWN:
        _KNOWN[flight] = list(_found(flight))
    return list(_KNOWN[flight])


def passed(flight: Flight, found: Iterable[Finding]) -> list[str]:
    """Return the names of the checks that a flight with these findings passed; what it does not hold is not checked."""
    names = {finding.name for finding in found}
    if flight.command is None or len(flight.command.stamp) < 2:
        names.add("commands")
    last = list(EXPLANATIONS)
    # a refusal without a cure ends the checks: what comes after it was not looked at
    if ended := [finding.name for finding in found if finding.refuses and not finding.cure]:
        last = last[: last.index(ended[0])]
    return [name for name in last if name not in names]


_KNOWN: "WeakKeyDictionary[Flight, list[Finding]]" = WeakKeyDictionary()


_Tried = Callable[..., Flight]
"""Returns the flight as it would be with all cures so far, and with these, too."""


def _found(flight: Flight) -> Iterator[Finding]:
    cures: dict[str, Any] = {}

    def tried(**cure: Any) -> Flight:
        return restated(flight, **cures | cure)

    for check in _CHECKS:
        for finding in check(tried(), tried):
            yield finding
            cures |= finding.cure
            if finding.refuses and not finding.cure:
                return
        if check is _lost:
            flight = tracked(flight)


def _one_body(flight: Flight, tried: _Tried) -> Iterator[Finding]:
    vehicle, rod = flight.vehicle, flight.pendulum
    same = len(vehicle.stamp) == len(rod.stamp) and np.array_equal(vehicle.position, rod.position)
    if same and np.array_equal(vehicle.orientation, rod.orientation):
        yield Finding(
            "roles", "vehicle and rod have the same poses: one body stands for both; say which is which, "
            "--topic vehicle=/its/name --topic pendulum=/its/name", {}, True,
        )  # fmt: skip


def _relative(flight: Flight, tried: _Tried) -> Iterator[Finding]:
    """A rod whose own position keeps its length, while its distance from the vehicle does not."""
    reach = motion.arm(flight.vehicle, flight.pendulum)
    apart = np.linalg.norm(reach[np.isfinite(reach).all(axis=1)], axis=1)
    alone = np.linalg.norm(flight.pendulum.position, axis=1)
    if len(apart) and apart.std() > 0.01 * apart.mean() and alone.std() < min(0.3 * apart.std(), 0.02 * alone.mean()):
        yield Finding("frames", "the rod's position is relative to the vehicle, it seems: its own length stays the "
                      "same; record both bodies in the frame of the world", {}, True)  # fmt: skip


def _lost(flight: Flight, tried: _Tried) -> Iterator[Finding]:
    for body, out in zip(BODIES, lost(flight), strict=True):
        poses, name, count = _body(flight, body), _NAMES[body], len(out.any)
        if out.repeated.any():
            origin = " (some at the origin)" if not poses.position[out.repeated].any(axis=1).all() else ""
            first = flight.time(poses)[int(np.argmax(out.repeated))]
            yield Finding("tracking", f"{int(out.repeated.sum())} of {count} poses of the {name}{origin}, first at "
                          f"{first:.1f} s, repeat the one before in every digit, as of a body that is lost: they are "
                          "left out", {}, False)  # fmt: skip
        if out.stray.any():
            first = flight.time(poses)[int(np.argmax(out.stray))]
            yield Finding("tracking", f"{int(out.stray.sum())} of {count} poses of the {name}, first at {first:.1f} s, "
                          "lie far from those around them: they are left out", {}, False)  # fmt: skip
    if out.beyond.any():
        time = flight.time(flight.pendulum)[~out.beyond]
        where = f"from {time[0]:.1f} to {time[-1]:.1f} s" if len(time) else "of no length"
        yield Finding("tracking", f"a body was lost for more than {LONGEST_GAP:g} s: the longest stretch without such "
                      f"a gap, {where}, is used alone", {}, False)  # fmt: skip


def _clock(flight: Flight, tried: _Tried) -> Iterator[Finding]:
    """Stamps that differ so much that bodies would be paired wrongly at sight."""
    vehicle, rod = flight.vehicle, flight.pendulum
    apart = _late(rod) - _late(vehicle)
    start, end = (pick(int(one.stamp[i]) for one in (vehicle, rod)) for pick, i in ((max, 0), (min, -1)))
    shortest = min(int(one.stamp[-1] - one.stamp[0]) for one in (vehicle, rod))
    if abs(apart) < 0.5 and end - start > shortest / 2:
        return
    logged = tried(stamps="log")
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


def _delay(flight: Flight, tried: _Tried) -> Iterator[Finding]:
    if not (late := _behind(flight)):
        return
    whose = f"the rod's stamps are {1e3 * abs(late):.0f} ms {'late' if late > 0 else 'early'} against the vehicle's"
    logged = tried(stamps="log")
    if not _behind(logged):
        yield Finding("clocks", f"{whose}, the times of logging are not: take those with --stamps log",
                      {"stamps": "log"}, True)  # fmt: skip
    else:
        yield Finding("clocks", f"{whose}: stamp both bodies by one clock with the time of exposure", {}, True)


def _behind(flight: Flight) -> float:
    """Return the delay of the rod's stamps against the vehicle's, s; 0 if there is none, or it cannot be determined."""
    found = motion.leaning(flight.vehicle, flight.pendulum)
    if found is None or not found.proven or abs(found.late[0]) < max(LATEST, 5.0 * found.late[1]):
        return 0.0
    return found.late[0]


def _up(flight: Flight, tried: _Tried) -> Iterator[Finding]:
    vehicle, rod = flight.vehicle, flight.pendulum
    reach = motion.arm(vehicle, rod)
    if not motion.distance_of(reach) > LEAST_ARM:
        return
    along = np.nanmedian(reach / np.linalg.norm(reach, axis=1, keepdims=True), axis=0)
    axis = int(np.argmax(np.abs(along)))
    if abs(along[axis]) < _UPRIGHT:
        yield Finding("up axis", "the rod stands along none of the axes: turn the world's frame so that z points up, "
                      "or cut the recording to where the rod is balanced", {}, True)  # fmt: skip
        return
    # with the rod along an axis, up is along it, or against it with the bodies swapped: the vehicle's tilt says which
    signs = ("-", "") if along[axis] < 0 else ("", "-")
    up, down = (f"{sign}{'xyz'[axis]}" for sign in signs)
    cures: list[dict[str, Any]] = [{"up": up}, {"up": down, "swap": True}]
    if axis == 2:
        low = float(np.median(rod.position[:, 2])) < 0 and float(np.median(vehicle.position[:, 2])) < 0
        cures = [{}] if along[2] > 0 else [{"up": up}, {"swap": True}] if low else [{"swap": True}, {"up": up}]
    cure = next((one for one in cures if one and _flies(tried(**one))), cures[0])
    if not cure:
        return
    how = " ".join(_option(f"--{key}", value) if key == "up" else "--swap" for key, value in cure.items())
    if axis < 2:
        name, what = "up axis", f"the rod stands along {up}, not along z (or it lies on its side)"
    elif "swap" in cure:
        name, what = "roles", "the rod is below the vehicle: the bodies are swapped, it seems (or the rod hangs)"
    else:
        name, what = "up axis", "the rod is below the vehicle, and the vehicle tilts as if z pointed down"
    yield Finding(name, f"{what}; read it with {how}", cure, True)


def _flies(flight: Flight) -> bool:
    """Return whether the vehicle is seen to accelerate to where it tilts."""
    moved = motion.thrust(flight.vehicle)
    return moved is not None and moved.proven and moved.scale > 0 and abs(moved.turn) < 1.0


def _quaternions(flight: Flight, tried: _Tried) -> Iterator[Finding]:
    mended: dict[str, str] = {}
    for body in BODIES:
        vehicle = None if body == "vehicle" else flight.vehicle
        if (wrong := _attitude(_body(flight, body), vehicle)[0]) is None:
            continue
        others = {order: tried(quaternion=mended | {body: order}) for order in list(QUATERNIONS)[1:]}
        judged = {order: _attitude(_body(other, body), vehicle) for order, other in others.items()}
        healthy = [order for order, (still_wrong, proven) in judged.items() if proven and not still_wrong]
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


def _attitude(poses: Poses, vehicle: Poses | None) -> tuple[str | None, bool]:
    """Return the fault in the attitude of the vehicle, or of the rod on a ``vehicle``, or None; and whether the motion
    was enough to decide."""
    if np.ptp(poses.orientation, axis=0).max() < 1e-9:
        return "orientation never changes: track it as a body of several markers", True
    if vehicle is None:
        moved, against = motion.thrust(poses), "acceleration"
    else:
        far = motion.distance_of(motion.arm(vehicle, poses)) > LEAST_ARM
        moved, against = motion.leaning(vehicle, poses) if far else None, "direction from the vehicle"
    proven = moved is not None and moved.proven
    for axis, letter in enumerate("zxy"):
        height = float(np.median(rotated(poses.orientation, np.eye(3)["xyz".index(letter)])[:, 2]))
        if height > _UPRIGHT and not axis:
            break
        if abs(height) > _UPRIGHT:
            up = f"{'-' if height < 0 else ''}{letter}"
            return f"{up} axis points up, not its z axis: define the body with z up when it is upright", proven
    else:
        return "z axis does not point up: define the body with z up when it is upright", proven
    if moved is None or not (proven or moved.explained < 0.1):
        return None, False
    if not proven:
        if moved.deviation > 0.1:
            return None, False
        # it moves so much that its own tilt would have been seen in it
        return f"tilt has nothing to do with its {against}: is its orientation that of another body?", True
    if moved.mirrored:
        return f"tilt is mirrored against its {against}: the frame is left-handed, or an axis has a wrong sign", True
    if abs(moved.turn) > _TURNED:
        angle = math.degrees(moved.turn)
        return (
            f"tilt is turned by {angle:.0f} deg about z against its {against}: positions and orientations are in "
            "different frames; record both in one"
        ), True
    if vehicle is not None and not 0.55 < moved.scale < 1.8:
        return f"tilt is {1 / moved.scale:.2f} times its {against}: the two are not of one body", True
    return None, True


def _unit(flight: Flight, tried: _Tried) -> Iterator[Finding]:
    moved = motion.thrust(flight.vehicle)
    distance = motion.distance_of(motion.arm(flight.vehicle, flight.pendulum))
    if moved and moved.proven and moved.scale > 0:
        # a seat above the tracked point makes it accelerate up to a third more
        units = [
            unit
            for unit, size in UNITS.items()
            if (0.6 if unit == "m" else 0.85) < moved.scale * size < (1.7 if unit == "m" else 1.4)
        ]
        unit = units[0] if units else ""
        why = f"the vehicle accelerates {moved.scale:.3g} times as much as its tilt lets it"
    else:
        unit, why = "mm" if distance > _FAR else "m", f"the two bodies are {distance:.0f} m apart"
    if not unit:
        yield Finding("unit", f"{why}: positions are in no unit that is known, or the stamps in none; convert them",
                      {}, True)  # fmt: skip
    elif unit != "m":
        yield Finding("unit", f"{why}: positions are in {unit}, it seems; read them with --unit {unit}",
                      {"unit": unit}, True)  # fmt: skip


def _distance(flight: Flight, tried: _Tried) -> Iterator[Finding]:
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
                      "orientation alone determines its length, if uniform; track its middle", {}, False)  # fmt: skip


def _speed(flight: Flight, tried: _Tried) -> Iterator[Finding]:
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


def _rate(flight: Flight, tried: _Tried) -> Iterator[Finding]:
    for body in BODIES:
        stamp = _body(flight, body).stamp
        rate = NANO / float(np.median(np.diff(stamp))) if len(stamp) > 1 else 0.0
        if 0.0 < rate < LEAST_RATE:
            yield Finding("rate", f"the {_NAMES[body]}'s poses come at {rate:.0f} Hz, hardly enough for a rod that is "
                          "balanced: record at 100 Hz or more", {}, False)  # fmt: skip


def _commands(flight: Flight, tried: _Tried) -> Iterator[Finding]:
    if (command := flight.command) is None or len(command.stamp) < 2:
        return
    fastest = float(np.quantile(np.abs(command.values[:, :3]), 0.99))
    found = motion.followed(flight.vehicle, command)
    if found and abs(found[2]) > 0.5:
        late, ratio, _ = found
        if ratio < 0:
            yield Finding("commands", "the vehicle turns against the commanded body rates: they are in other axes than "
                          "x forward, y left, z up", {}, False)  # fmt: skip
        elif 15.0 < ratio < 300.0:
            yield Finding("commands", "the commanded body rates are far larger than those flown: they are in deg/s, it "
                          "seems; record rad/s", {}, False)  # fmt: skip
        if not -0.05 < late < LONGEST_DELAY:
            logged = motion.followed(tried(stamps="log").vehicle, command)
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


_CHECKS: tuple[Callable[[Flight, _Tried], Iterator[Finding]], ...] = (
    _one_body, _clock, _lost, _relative, _up, _quaternions, _unit, _distance, _delay, _speed, _rate, _commands,
)  # fmt: skip
