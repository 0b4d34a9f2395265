"""Whoever recorded it, and however: a bag gives its rod's length of 1.00 m, or one sentence that names the cause."""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from scipy.spatial.transform import Rotation

from fiplib.bags import read
from fiplib.bags.checks import EXPLANATIONS, findings
from fiplib.bags.convert import convert
from fiplib.recording import BagError
from fiplib.replay import estimate, why_not_refit
from tests.bags import strangers
from tests.bags.strangers import COVARIANCE, NANO, ODOMETRY, ROD, TRANSFORM, TREE, TWIST, VEHICLE, Body, Recording

LENGTH = 1.0
WIDEST = 0.06
"""Width of a 95 % interval, m, that still counts as an answer; the plain bag's is 0.023 m."""


class Case(NamedTuple):
    """One kind of bag, and what is right to say of it.

    ``make`` writes it into a folder from 12 s of flight. ``finding`` names the check that fails (of those without a
    cure that an estimator makes, "estimator"), ``says`` are words of what is said. Without a cure a finding that
    refuses leaves no length; with it, the length is right.
    """

    make: Callable[[Path, Recording], Path]
    finding: str = ""
    says: str = ""
    refuses: bool = False
    cure: Mapping[str, Any] = {}


def bag(change: Callable[[Recording], Recording] = lambda flight: flight, **options: Any) -> Callable[..., Path]:
    """Poses and commands under our own names, changed."""
    kind = options.pop("kind", strangers.POSE)
    told = options.pop("commands", True)
    return lambda path, flight: strangers.write(path / "bag", strangers.rows(change(flight), kind, told), **options)


def both(change: Callable[[Body], Body], **options: Any) -> Callable[..., Path]:
    return bag(lambda flight: flight.both(change), **options)


def rod(change: Callable[[Body], Body]) -> Callable[..., Path]:
    return bag(lambda flight: flight.of_rod(change))


def vehicle(change: Callable[[Body], Body]) -> Callable[..., Path]:
    return bag(lambda flight: flight.of_vehicle(change))


def chance(seed: int, body: Body) -> np.random.Generator:
    return np.random.default_rng([seed, len(body.stamp)])


def lost(body: Body, position: float, orientation: list[float]) -> Body:
    gone = np.zeros((len(body.stamp), 1), bool)
    gone[1000:1240] = True
    return body._replace(
        position=np.where(gone, position, body.position), orientation=np.where(gone, orientation, body.orientation)
    )


def frozen(start: int, end: int) -> Callable[[Body], Body]:
    """The pose of ``start`` is sent again and again."""

    def change(body: Body) -> Body:
        at = np.where((np.arange(len(body.stamp)) >= start) & (np.arange(len(body.stamp)) < end), start,
                      np.arange(len(body.stamp)))  # fmt: skip
        return body._replace(position=body.position[at], orientation=body.orientation[at])

    return change


def jittered(body: Body, log: float, stamp: float = 0.0) -> Body:
    late = chance(1, body).exponential((log + stamp) * NANO, len(body.log)).astype(np.int64)
    stamps = np.sort(body.stamp + late) + np.arange(len(late)) % 2 if stamp else body.stamp
    return body._replace(stamp=stamps, log=np.sort(body.log + late))


def out_of_order(body: Body) -> Body:
    order = np.arange(len(body.stamp))
    order[[500, 501]] = 501, 500
    return body.part(order)._replace(log=body.log)


def seen(axis: str, degrees: float, bodies_too: bool = True) -> Callable[[Body], Body]:
    return lambda body: body.seen_from(Rotation.from_euler(axis, degrees, degrees=True), bodies_too)


def axes(axis: str, degrees: float) -> Callable[[Body], Body]:
    """The body's own axes are turned."""
    turn = Rotation.from_euler(axis, degrees, degrees=True)
    return lambda body: body._replace(orientation=(Rotation.from_quat(body.orientation) * turn).as_quat())


def placed(axis: str, degrees: float) -> Callable[[Body], Body]:
    """Positions alone are turned."""
    turn = Rotation.from_euler(axis, degrees, degrees=True)
    return lambda body: body._replace(position=turn.apply(body.position))


def jumping(body: Body) -> Body:
    position = body.position.copy()
    position[chance(5, body).choice(len(position), 10, replace=False)] += [1.0, 0.5, 0.3]
    return body._replace(position=position)


def low_pass(body: Body) -> Body:
    """Positions behind a filter of 20 ms, as some drivers smooth them."""
    position = body.position.copy()
    for i in range(1, len(position)):
        position[i] += 0.8 * (position[i - 1] - position[i])
    return body._replace(position=position)


def relative(flight: Recording) -> Recording:
    """The rod as the vehicle sees it."""
    turn = Rotation.from_quat(flight.vehicle.orientation).inv()
    return flight.of_rod(
        lambda body: body._replace(
            position=turn.apply(body.position - flight.vehicle.position),
            orientation=(turn * Rotation.from_quat(body.orientation)).as_quat(),
        )
    )


def interrupted(_: Recording) -> Recording:
    """8 s, 30 s without any message, 10 s."""
    flight = strangers.recorded(2.0, 24.0)

    def change(body: Body) -> Body:
        time = (body.stamp - body.stamp[0]) / NANO
        return body.part((time < 8.0) | (time > 14.0))

    cut = flight.both(change)
    late = [np.where(body.stamp - body.stamp[0] > 10 * NANO, 24 * NANO, 0) for body in (cut.vehicle, cut.rod)]
    vehicle, rod = (
        body._replace(stamp=body.stamp + by, log=body.log + by)
        for body, by in zip((cut.vehicle, cut.rod), late, strict=True)
    )
    return cut._replace(vehicle=vehicle, rod=rod)


def namespaced(path: Path, flight: Recording) -> Path:
    named = {"/uav1/vrpn_mocap/quad_01/pose": flight.vehicle, "/uav1/vrpn_mocap/rod/pose": flight.rod}
    messages = [row for topic, body in named.items() for row in strangers.poses(topic, body)]
    return strangers.write(path / "bag", [*messages, *strangers.commands(flight, "/uav1/mavros/setpoint_raw/attitude")])


def in_frames(vehicle: str, rod: str, kind: str = strangers.POSE, change: Any = None) -> Callable[..., Path]:
    def make(path: Path, flight: Recording) -> Path:
        flight = change(flight) if change else flight
        first = strangers.poses(VEHICLE, flight.vehicle, kind, vehicle)
        return strangers.write(path / "bag", [*first, *strangers.poses(ROD, flight.rod, kind, rod)])

    return make


ZERO = {"position": 0.0, "orientation": [0.0, 0.0, 0.0, 1.0]}
HANDED = {
    "plain": Case(bag()),
    "poses-only": Case(bag(commands=False)),
    "rod-arrives-50us-later": Case(rod(lambda body: body.later(log=50e-6))),
    "rod-stamped-50us-later": Case(rod(lambda body: body.later(50e-6, 50e-6))),
    "rod-at-120hz": Case(rod(lambda body: body.part(slice(None, None, 2)))),
    "rod-drops-30pc": Case(rod(lambda body: body.part(chance(3, body).random(len(body.stamp)) > 0.3))),
    "both-drop-05pc": Case(both(lambda body: body.part(chance(4, body).random(len(body.stamp)) > 0.05))),
    "log-jitter-2ms": Case(both(lambda body: jittered(body, 2e-3))),
    "stamps-jitter-0.3ms": Case(both(lambda body: jittered(body, 0.0, 3e-4))),
    "duplicate-frames": Case(
        both(lambda body: body.part(np.repeat(np.arange(len(body.stamp)), 1 + (np.arange(len(body.stamp)) % 97 == 0)))),
        says="30 of 2910 messages were sent twice",
    ),
    "out-of-order": Case(vehicle(out_of_order), says="1 of 2880 messages came out of order"),
    "rod-nan-when-lost": Case(rod(lambda body: lost(body, math.nan, [math.nan] * 4)), says="240 of 2880 messages hold"),
    "rod-zero-when-lost": Case(rod(lambda body: lost(body, **ZERO)), "tracking", "239 of 2880 poses of the rod"),
    "zero-stamps": Case(both(lambda body: body._replace(stamp=0 * body.stamp)), says="no message has a stamp"),
    "clock-3.7s-off": Case(both(lambda body: body.later(-3.7)), "commands", "3.67 s before", cure={"stamps": "log"}),
    "y-up": Case(both(seen("x", -90)), "up axis", "stands along y", True, {"up": "y"}),
    "millimetres": Case(both(lambda body: body.scaled(1000)), "unit", "in mm", True, {"unit": "mm"}),
    "quaternion-wxyz": Case(
        both(lambda body: body.ordered(3, 0, 1, 2)), "quaternion", "w, x, y, z", True, {"quaternion": "wxyz"}
    ),
    "bodies-swapped": Case(
        bag(lambda flight: flight._replace(vehicle=flight.rod, rod=flight.vehicle)), "roles", "below", True,
        {"swap": True},
    ),
    "rod-pivot-at-foot": Case(rod(lambda body: body.moved(0, 0, -0.5)), "rod point", "at its foot"),
    "vehicle-8cm-below-seat": Case(vehicle(lambda body: body.moved(0, 0, -0.08))),
    "odometry": Case(bag(kind=ODOMETRY)),
    "transformstamped": Case(bag(kind=TRANSFORM)),
    "pose-covariance": Case(bag(kind=COVARIANCE)),
    "tf": Case(bag(kind=TREE), says="/tf:quad is taken for the vehicle, by its name"),
    "rigid-bodies": Case(
        lambda path, flight: strangers.write(
            path / "bag", [*strangers.rigid_bodies(flight), *strangers.commands(flight)]
        ),
        says="/rigid_bodies:pendulum is taken for the pendulum, by its name",
    ),
    "namespaced": Case(namespaced, says="/uav1/vrpn_mocap/rod/pose is taken for the pendulum, by its name"),
    "twist-commands": Case(
        lambda path, flight: strangers.write(
            path / "bag", [*strangers.rows(flight, with_commands=False), *strangers.commands(flight, kind=TWIST)]
        )
    ),
    "mask-without-rates": Case(
        lambda path, flight: strangers.write(
            path / "bag", [*strangers.rows(flight, with_commands=False), *strangers.commands(flight, mask=7)]
        ),
        says="commands hold no body rates",
    ),
    "db3": Case(bag(storage=StoragePlugin.SQLITE3)),
    "db3-no-metadata": Case(bag(storage=StoragePlugin.SQLITE3, metadata=False)),
    "split": Case(lambda path, flight: strangers.split(path / "bag", strangers.rows(flight))),
    "zstd-file-no-metadata": Case(bag(compression=CompressionMode.FILE, metadata=False)),
    "zstd-message": Case(bag(compression=CompressionMode.MESSAGE)),
    "ros1.bag": Case(lambda path, flight: strangers.ros1(path / "lab.bag", flight), "convert", "a bag of ROS 1"),
    "motive.csv": Case(lambda path, flight: strangers.motive(path / "take.csv", flight), "convert", "a CSV file"),
}  # fmt: skip
NEIGHBOURS = {
    "inches": Case(both(lambda body: body.scaled(1 / 0.0254)), "unit", "in in", True, {"unit": "in"}),
    "centimetres": Case(both(lambda body: body.scaled(100)), "unit", "in cm", True, {"unit": "cm"}),
    "feet": Case(both(lambda body: body.scaled(1 / 0.3048)), "unit", "in ft", True, {"unit": "ft"}),
    "scale-twice": Case(both(lambda body: body.scaled(2.0)), "unit", "in no unit that is known", True),
    "scale-1.1": Case(both(lambda body: body.scaled(1.1)), "estimator", "distance of the two tracked points", True),
    "stamps-half-speed": Case(
        both(lambda body: body._replace(stamp=2 * body.stamp - body.stamp[0], log=2 * body.log - body.log[0])),
        "unit", "or the stamps in none", True,
    ),
    "x-up": Case(both(seen("y", 90)), "up axis", "stands along x", True, {"up": "x"}),
    "y-up-bodies-z-up": Case(both(seen("x", -90, False)), "up axis", "stands along y", True, {"up": "y"}),
    "north-east-down": Case(both(seen("x", 180)), "up axis", "--up=-z", True, {"up": "-z"}),
    "z-down-bodies-up": Case(both(seen("x", 180, False)), "up axis", "--up=-z", True, {"up": "-z"}),
    "y-up-swapped": Case(
        bag(lambda flight: flight._replace(vehicle=flight.rod, rod=flight.vehicle).both(seen("x", -90))),
        "up axis", "--up y --swap", True, {"up": "y", "swap": True},
    ),
    "frame-tilted-5-deg": Case(both(seen("x", 5))),
    "frame-tilted-20-deg": Case(both(seen("x", 20)), "estimator", "leans by 20 deg on average", True),
    "left-handed": Case(
        both(lambda body: body._replace(position=body.position * [1, -1, 1])), "attitude", "left-handed", True
    ),
    "inverse": Case(
        both(Body.inverse), "quaternion", "turn the world into the body", True, {"quaternion": "xyzw-inverse"}
    ),
    "wxyz-inverse": Case(
        both(lambda body: body.inverse().ordered(3, 0, 1, 2)), "quaternion", "w, x, y, z and turn", True,
        {"quaternion": "wxyz-inverse"},
    ),
    "rod-wxyz": Case(
        rod(lambda body: body.ordered(3, 0, 1, 2)), "quaternion", "--quaternion pendulum=wxyz", True,
        {"quaternion": {"pendulum": "wxyz"}},
    ),
    "vehicle-wxyz": Case(
        vehicle(lambda body: body.ordered(3, 0, 1, 2)), "quaternion", "--quaternion vehicle=wxyz", True,
        {"quaternion": {"vehicle": "wxyz"}},
    ),
    "y-up-mm-wxyz": Case(
        both(lambda body: seen("x", -90)(body).scaled(1000).ordered(3, 0, 1, 2)), "up axis", "stands along y", True,
        {"up": "y", "quaternion": "wxyz", "unit": "mm"},
    ),
    "rod-clock-3.7s-off": Case(
        rod(lambda body: body.later(-3.7)), "clocks", "3.7 s apart", True, {"stamps": "log"}
    ),
    "rod-clock-since-boot": Case(
        rod(lambda body: body._replace(stamp=body.stamp - body.stamp[0] + NANO)), "clocks", "different clocks", True,
        {"stamps": "log"},
    ),
    "rod-stamped-20ms-late": Case(
        rod(lambda body: body.later(0.02)), "clocks", "20 ms late", True, {"stamps": "log"}
    ),
    "rod-20ms-late": Case(rod(lambda body: body.later(0.02, 0.02)), "clocks", "20 ms late", True),
    "first-stamp-zero": Case(
        both(lambda body: body._replace(stamp=np.where(np.arange(len(body.stamp)) > 0, body.stamp, 0))), "tracking",
        "is used alone",
    ),
    "vehicle-without-stamps": Case(
        # logged a frame after its exposure: with a raised seat too little for the finding, and too much for the model
        vehicle(lambda body: body._replace(stamp=0 * body.stamp)), "estimator", "not white", True
    ),
    "rod-half-frozen": Case(rod(frozen(1440, 2880)), "tracking", "from 0.0 to 6.0 s, is used alone"),
    "vehicle-frozen-2s": Case(vehicle(frozen(1000, 1480)), "tracking", "479 of 2880 poses of the vehicle"),
    "each-pose-sent-twice": Case(
        both(lambda body: body._replace(**{
            name: getattr(body, name)[np.arange(len(body.stamp)) // 2 * 2] for name in ("position", "orientation")
        })), "tracking", "1440 of 2880 poses of the rod",
    ),
    "vehicle-jumps": Case(vehicle(jumping), "tracking", "10 of 2880 poses of the vehicle"),
    "rod-jumps": Case(rod(jumping), "tracking", "10 of 2880 poses of the rod"),
    "gap-30s": Case(bag(interrupted), "tracking", "is used alone"),
    "30hz": Case(both(lambda body: body.part(slice(None, None, 8))), "rate", "come at 30 Hz"),
    "degrees-per-second": Case(
        bag(lambda flight: flight._replace(command=flight.command * [57.3, 57.3, 57.3, 1.0])), "commands", "deg/s"
    ),
    "commands-north-east-down": Case(
        bag(lambda flight: flight._replace(command=flight.command * [-1.0, -1.0, -1.0, 1.0])), "commands",
        "in other axes",
    ),
    "one-topic-for-both": Case(
        bag(lambda flight: flight._replace(rod=flight.vehicle)), "roles", "have the same poses", True
    ),
    "frames-by-two-names": Case(in_frames("map", "world"), "frames", "'map' and 'world'"),
    "rod-relative-to-vehicle": Case(
        in_frames("world", "quad", TREE, relative), "frames", "relative to the vehicle", True
    ),
    "positions-yawed-90-deg": Case(both(placed("z", 90)), "attitude", "turned by 90 deg", True),
    "positions-yawed-20-deg": Case(both(placed("z", 20)), "attitude", "turned by 20 deg", True),
    "all-yawed-90-deg": Case(both(seen("z", 90))),
    "bodies-yawed-77-deg": Case(both(axes("z", 77))),
    "vehicle-x-up": Case(vehicle(axes("y", 90)), "attitude", "-x axis points up", True),
    "rod-z-down": Case(rod(axes("x", 180)), "attitude", "-z axis points up", True),
    "rod-never-turns": Case(
        rod(lambda body: body._replace(orientation=0 * body.orientation + [0, 0, 0, 1.0])), "attitude",
        "never changes", True,
    ),
    "vehicle-never-turns": Case(
        vehicle(lambda body: body._replace(orientation=0 * body.orientation + [0, 0, 0, 1.0])), "attitude",
        "never changes", True,
    ),
    "whole-millimetres": Case(both(lambda body: body._replace(position=body.position.round(3)))),
    "rod-tracked-at-tip": Case(rod(lambda body: body.moved(0, 0, 0.5))),
    "markers-3cm-aside": Case(both(lambda body: body.moved(0.03, 0, 0))),
    "positions-filtered-20ms": Case(both(low_pass), "estimator", "no maximum", True),
    "a-third-of-a-second": Case(both(lambda body: body.part(slice(0, 72))), "estimator", "too little excitation", True),
}  # fmt: skip
CASES = HANDED | NEIGHBOURS


@pytest.fixture(scope="module")
def flight() -> Recording:
    return strangers.recorded()


@pytest.mark.parametrize("name", CASES)
def test_a_strangers_bag_gives_its_length_or_the_cause(name: str, flight: Recording, tmp_path: Path) -> None:
    case = CASES[name]
    path = case.make(tmp_path, flight)
    if case.finding == "convert":
        with pytest.raises(BagError, match=case.says) as refused:
            read(path)
        assert f"fip bag convert {path}" in str(refused.value)
        convert(path, tmp_path / "bag")
        path = tmp_path / "bag"
    recording = read(path)
    found, against = estimate(recording), findings(recording)
    words = "" if case.finding == "convert" else case.says
    said = [*recording.notes, *found.assumed, *found.notes, *(one.sentence for one in against), str(found.reason)]
    assert any(words in sentence for sentence in said), said
    if case.finding in EXPLANATIONS:
        assert case.finding in [one.name for one in against]
    else:
        assert against == []
    assert (found.reason is not None) == case.refuses, found.reason
    if not case.refuses:
        rightly(found)
    elif case.finding != "estimator":
        assert found.reason == next(one.sentence for one in against if one.refuses)
        assert why_not_refit(recording)  # nor do the estimators that need commands
    cures: dict[str, Any] = {}
    for one in against:
        cures |= one.cure
    assert cures == case.cure
    if cures:
        cured = read(path, **cures)
        assert not any(one.refuses for one in findings(cured))
        rightly(estimate(cured))


def rightly(found: Any) -> None:
    """The length is right, and known well."""
    assert found.reason is None
    low, high = found.interval
    assert low < LENGTH < high and high - low < WIDEST
