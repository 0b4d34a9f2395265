"""The role of each topic of a bag: by its default name or as stated, else guessed from types and names."""

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import NamedTuple, TypeVar

from fiplib.bags.decoding import COMMANDS, TWIST, Decoder, carries_poses
from fiplib.bags.sources import Source
from fiplib.recording import ROLES, TOPICS, BagError, Flight

_T = TypeVar("_T")

BODIES = ("vehicle", "pendulum")

# Words in the names of topics and bodies, between letters that do not belong to them.
_PENDULUM = re.compile(r"pend|(?<![a-z])(rod|pole|stick|bar|mast)(?![a-z])")
_VEHICLE = re.compile(r"quad|drone|copter|uav|mav|vehicle|crazyflie|(?<![a-z])(cf|robot|base_link)(?![a-z])")
_MOCAP = re.compile(r"mocap|vrpn|natnet|optitrack|vicon|qualisys|motive|rigid")
_NOT_MEASURED = re.compile(r"setpoint|goal|target|reference|desired|command|cmd|truth")
_COMMAND = re.compile(r"setpoint|command|cmd|target")
_ROLE = re.compile(r"(?:^|, )(vehicle|pendulum|command)(?: \(([^)]*)\))?(?=, |$)")  # as a flight's topics have it
_HIGHER = 0.1  # m by which the rod lies above the vehicle at least, for heights to say which is which
_SELDOM = 0.1  # share of the messages of the most frequent poses below which others are not motion capture
_PEEK = 20  # blocks of a topic in which its bodies are looked for


class Place(NamedTuple):
    """The place of a role in a bag: a topic and, where one topic holds several bodies, the name of one."""

    topic: str
    body: str = ""

    def __str__(self) -> str:
        return f"{self.topic}:{self.body}" if self.body else self.topic


def places_of(source: Source, path: Path, given: Mapping[str, str]) -> tuple[dict[str, Place], tuple[str, ...]]:
    """Where each role is recorded, and what was guessed, in sentences. Raises BagError if a role cannot be found."""
    places = {role: Place(*name.partition(":")[::2]) for role, name in {**TOPICS, **given}.items()}
    present = {role for role, place in places.items() if place.topic in source.topics}
    guesses = _guessed(source, {role: place for role, place in places.items() if role in present or role in given})
    notes = []
    for role, (place, reason) in guesses.items():
        places[role] = place
        notes.append(f"{place} is taken for the {role}, {reason}; another: --topic {role}=/its/name")
    for role, place in places.items():
        stored = source.topics.get(place.topic)
        if stored is None:
            if role in BODIES or role in given:
                raise BagError(
                    f"{path}: no topic {place.topic} ({role}); the bag holds "
                    f"{', '.join(sorted(source.topics)) or 'none'}. "
                    f'Say which one it is: read(path, topics={{"{role}": "/its/name"}}), or --topic {role}=/its/name'
                )
            continue
        kind = ROLES[role].type
        readable = stored.type == kind or (role == "command" and stored.type in COMMANDS)
        if not (carries_poses(stored) if role in BODIES else readable):
            raise BagError(
                f"{path}: topic {place.topic} ({role}) is of type {stored.type}, not {kind}: convert it, or remap "
                f"{role} to another topic"
            )
        if role in BODIES and not place.body and stored.type != kind and (bodies := _bodies(source, place.topic)):
            if len(bodies) > 1:
                raise BagError(
                    f"{path}: topic {place.topic} ({role}) holds several bodies, {', '.join(sorted(bodies))}: say "
                    f"which one it is, --topic {role}={place.topic}:NAME"
                )
            places[role] = Place(place.topic, *bodies)
    return places, tuple(notes)


def choices(source: Source) -> dict[str, list[str]]:
    """Return what could be the vehicle, the pendulum and the command of a bag, as names that ``read`` takes."""
    kinds = [(topic, stored) for topic, stored in sorted(source.topics.items()) if stored.count]
    places = [
        str(Place(topic, body)) for topic, stored in kinds if carries_poses(stored) for body in _bodies(source, topic)
    ]
    return dict.fromkeys(BODIES, places) | {"command": [topic for topic, stored in kinds if stored.type in COMMANDS]}


def chosen(flight: Flight) -> dict[str, str]:
    """Return where the vehicle, the pendulum and the command of a flight were read from; see ``choices``."""
    return {role: str(Place(info.topic, body)) for info in flight.topics for role, body in _ROLE.findall(info.role)}


def _guessed(source: Source, known: Mapping[str, Place]) -> dict[str, tuple[Place, str]]:
    """A place and the reason for each role that has none, where the bag leaves no doubt."""
    taken = set(known.values())
    found: dict[str, tuple[Place, str]] = {}
    if missing := [body for body in BODIES if body not in known]:
        measured = {
            topic: stored.count
            for topic, stored in source.topics.items()
            if stored.count and not _NOT_MEASURED.search(topic.lower()) and carries_poses(stored)
        }
        most = max(measured.values(), default=0)
        heights = {
            place: height
            for topic, count in measured.items()
            if count > _SELDOM * most  # plans, maps and anchors come seldom
            for body, height in _bodies(source, topic).items()
            if (place := Place(topic, body)) not in taken
        }
        found = {role: choice for role, choice in two_bodies(heights, missing).items() if role in missing}
    if "command" not in known:
        kinds = {topic: stored.type for topic, stored in source.topics.items() if stored.count}
        named = [topic for topic, kind in kinds.items() if kind in COMMANDS and _COMMAND.search(topic.lower())]
        typed = [topic for topic, kind in kinds.items() if kind in COMMANDS and kind != TWIST]
        if topic := _only(named) or _only(typed):
            found["command"] = Place(topic), "by its type"
    return found


def two_bodies(heights: Mapping[Place, float], missing: list[str]) -> dict[str, tuple[Place, str]]:
    """Vehicle and pendulum among the places of poses, by their names or by their heights in m."""
    rods = [place for place in heights if _PENDULUM.search(str(place).lower())]
    others = [place for place in heights if place not in rods]
    found: dict[str, tuple[Place, str]] = {}
    if "vehicle" in missing:
        named = [place for place in others if _VEHICLE.search(str(place).lower())]
        if vehicle := _only(named) or (_only(others) if rods or "pendulum" not in missing else None):
            found["vehicle"] = vehicle, "by its name" if vehicle in named else "as no other body is left"
            others.remove(vehicle)
    if pendulum := _only(rods):
        found["pendulum"] = pendulum, "by its name"
    elif not rods and len(others) == 1 and ("vehicle" in found or "vehicle" not in missing):
        found["pendulum"] = others[0], "as no other body is left"
    if not found and len(heights) == len(missing) == 2:
        low, high = sorted(heights, key=heights.__getitem__)
        if heights[high] - heights[low] > _HIGHER:
            return {"vehicle": (low, "as it is the lower one"), "pendulum": (high, "as it is the higher one")}
    return found


def _only(places: Sequence[_T]) -> _T | None:
    """Return the one in the list, or the one that motion capture measured; None if there is none, or a doubt."""
    measured = [place for place in places if _MOCAP.search(str(place).lower())]
    return next((found[0] for found in (places, measured) if len(found) == 1), None)


def _bodies(source: Source, topic: str) -> dict[str, float]:
    """Return the bodies of a topic, each with its first height in m; one without a name where a message is one pose."""
    decoder = Decoder(source.topics[topic])
    with suppress(Exception):  # damage is found, and named, where the topic is read
        for block in islice(source.blocks([topic]), _PEEK):
            decoder.take(block)
    return {body: float(position[2]) for body, position in decoder.poses.items()}
