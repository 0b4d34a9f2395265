"""ROS 2 bag -> Flight: a recorded flight as plain arrays, checked.

A bag with the two motion-capture topics alone is a flight; everything else may be absent. Whatever is wrong with a bag
is one ``BagError`` that names the file and the topic and says what to do.
"""

import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from fiplib.bags.conventions import restated
from fiplib.bags.decoding import RATES, Decoder
from fiplib.bags.mending import mended
from fiplib.bags.messages import IGNORE_RATES, SIDECAR, genuine, typestore
from fiplib.bags.recovery import intact_messages
from fiplib.bags.roles import BODIES, Place, places_of
from fiplib.bags.sources import Block, Source, opened
from fiplib.params import NANO
from fiplib.recording import (
    ATTITUDE,
    LEVELS,
    ORIGINS,
    ROLES,
    BagError,
    Event,
    Flight,
    Poses,
    Series,
    TopicInfo,
)


def read(
    path: str | Path,
    topics: Mapping[str, str] | None = None,
    *,
    up: str | None = None,
    unit: str | None = None,
    swap: bool = False,
    quaternion: str | Mapping[str, str] | None = None,
    stamps: str | None = None,
) -> Flight:
    """Read a flight from a ROS 2 bag.

    Args:
        path: the bag's directory, or a bare .mcap file.
        topics: names of topics that differ from ``TOPICS``, by role: ``{"vehicle": "/vrpn_mocap/quad/pose"}``, or
            ``"/tf:quad"`` for one of several bodies in a topic. What is not named and not there is guessed from types
            and names, and said in ``Flight.notes``.
        up, unit, swap, quaternion, stamps: conventions of the poses that differ from ours, as
            ``conventions.restated`` takes them; ``checks.findings`` says which correct a flight.

    Raises:
        BagError: the bag is missing, damaged, or does not hold what the bag contract says.
    """
    path, topics = Path(path), dict(topics or {})
    if unknown := set(topics) - set(ROLES):
        raise BagError(f"{path}: no such role {min(unknown)!r} to remap; roles are {', '.join(ROLES)}")
    try:
        with opened(path) as source:
            metadata = _metadata(path, source.custom)
            places, guesses = places_of(source, path, topics)
            gathered = _gathered(path, source, places, metadata.pop("messages", {}))
    except BagError:
        raise
    except OSError as error:
        raise BagError(f"{path}: cannot be opened ({_line(error)})") from error
    except Exception as error:  # the library raises a dozen kinds on damage, from struct.error to MemoryError
        raise BagError(f"{path}: {_damage(path, error)}") from error
    # what was assumed when a table was converted holds for all that is read from its bag
    converted = metadata.get("converted")
    notes, decoded = [*(converted.get("assumed", ()) if isinstance(converted, dict) else ()), *guesses], {}
    for role, decoder in gathered.items():
        with _named(path, places[role], role):
            if role == "events":
                decoded[role] = _events(decoder, metadata.get("pushes"))
            else:
                decoded[role] = _checked(role, decoder, source.topics[places[role].topic].type, notes)
    for role in BODIES:
        if not decoded.get(role):
            raise BagError(f"{path}: topic {places[role]} ({role}) is empty: was the body tracked and its name right?")
    flight = Flight(
        path=path,
        metadata=metadata,
        events=decoded.pop("events", ()),
        start_ns=int(min(decoded["vehicle"].stamp[0], decoded["pendulum"].stamp[0])),
        topics=_table(source, places, gathered),
        notes=tuple(notes),
        **{role: decoded.get(role) for role in ROLES if role != "events"},
    )
    return restated(flight, up=up, unit=unit, swap=swap, quaternion=quaternion, stamps=stamps)


def _damage(path: Path, error: Exception) -> str:
    """Return why a bag cannot be read, and what its user can do."""
    unfinished = (path / SIDECAR).exists()
    words = f"damaged or incomplete ({_line(error)})"
    if unfinished:
        words = "not finished: it is being recorded still, or its recording was killed"
    with suppress(BagError):
        if count := intact_messages(path):
            return f"{words}. {count} messages are intact; into a new bag with: fip bag recover {path}"
    if unfinished:
        return f"{words}. It holds no message yet"
    return f"{words}. Nothing in it can be read: copy it again from where it was recorded, and keep this one"


class _Messages:
    """Gathers messages as they are, with their log times: for the few events, which are text."""

    def __init__(self) -> None:
        self.received: list[int] = []
        self.messages: list[bytes] = []

    def take(self, block: Block) -> None:
        self.received += block.received.tolist()
        self.messages += [block.message(index) for index in range(len(block.start))]


@contextmanager
def _named(path: Path, place: Place, role: str) -> Iterator[None]:
    """Whatever goes wrong within is a BagError that names file, topic and role."""
    try:
        yield
    except BagError:
        raise
    except Exception as error:  # whatever the library raises on damaged bytes
        raise BagError(f"{path}: topic {place} ({role}): {_line(error)}") from error


def _gathered(path: Path, source: Source, places: Mapping[str, Place], expected: Mapping[str, int]) -> dict[str, Any]:
    """Return the numbers of each role that is recorded. Raises ValueError if messages are missing."""
    gathered: dict[str, Any] = {}
    for role, place in places.items():
        if (stored := source.topics.get(place.topic)) and stored.count:
            gathered[role] = _Messages() if role == "events" else Decoder(stored, place.body)
    found: Counter[str] = Counter()
    for block in source.blocks({places[role].topic for role in gathered}):
        found[block.topic] += len(block.start)
        for role, decoder in gathered.items():
            if places[role].topic == block.topic:
                with _named(path, places[role], role):
                    decoder.take(block)
    # A damaged index hides messages silently: what was counted while recording must be there.
    counts = {topic: stored.count for topic, stored in source.topics.items()}
    wanted = {place.topic for place in places.values()}
    for topic, count in {**counts, **expected}.items():
        there = found[topic] if topic in wanted else counts.get(topic, 0)
        if there != count:
            raise ValueError(f"topic {topic} should hold {count} messages and holds {there}")
    return gathered


def _table(source: Source, places: Mapping[str, Place], gathered: Mapping[str, Any]) -> tuple[TopicInfo, ...]:
    roles: dict[str, list[str]] = {}
    frames: dict[str, set[str]] = {}
    for role, place in places.items():
        roles.setdefault(place.topic, []).append(f"{role} ({place.body})" if place.body else role)
        if role in BODIES and role in gathered:
            frames.setdefault(place.topic, set()).update(gathered[role].frames)
    return tuple(
        TopicInfo(
            topic, stored.type, stored.count, ", ".join(roles.get(topic, ())), tuple(sorted(frames.get(topic, ())))
        )
        for topic, stored in sorted(source.topics.items())
    )


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
        raise BagError(f"{source}: its origin {metadata['origin']!r} is none of {', '.join(ORIGINS)}: correct it")
    return metadata


def _checked(role: str, decoder: Decoder, kind: str, notes: list[str]) -> Poses | Series | None:
    """Arrays of one topic, checked; None if nothing of use is left. Raises ValueError with what is wrong."""
    entry = ROLES[role]
    if decoder.names is not None and decoder.names != entry.names:
        names = ", ".join(decoder.names) or "none"
        raise ValueError(f"its names are {names}, not {', '.join(entry.names)}: rename or remap")
    stamp, received, values = decoder.arrays()
    if role == "command":
        stamp, values = _commands(kind, stamp, values, notes)
    values = values[:, : len(entry.names)]
    if role in BODIES:
        stamp, received, values = mended(role, stamp, received, values, notes)
    if not len(stamp):
        return None
    _check_stamps(stamp, strict=role != "length")
    # Only the estimate and its deviation may be absent (NaN): before the first estimate there is none.
    finite = np.isfinite(values[:, :1] if role == "length" else values).all(axis=1)
    if not finite.all():
        at = int(np.argmin(finite))
        raise ValueError(
            f"message {at} of {len(stamp)} holds a NaN or infinite number, {len(stamp) - int(finite.sum())} do in all: "
            "cut the bag to where all numbers are known (a body that is not tracked has no pose)"
        )
    if role not in BODIES:
        return Series(_frozen(stamp), _frozen(values), entry.names, entry.units)
    norm = np.linalg.norm(values[:, 3:], axis=1)
    if (off := np.abs(norm - 1.0) > 1e-3).any():
        at = int(np.argmax(off))
        raise ValueError(
            f"the quaternion of message {at} has norm {norm[at]:.4g}, not 1: a driver fault; "
            "normalise the orientations, or cut the bag to where they are right"
        )
    return Poses(_frozen(stamp), _frozen(received), _frozen(values[:, :3]), _frozen(values[:, 3:]))


def _commands(kind: str, stamp: np.ndarray, values: np.ndarray, notes: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Body rates and thrust out of the commands of any type."""
    if kind == RATES:  # x forward, y right, z down, and the three components of a thrust
        notes.append("the commands have no header of ROS: the times at which they were logged stand for their stamps")
        return stamp, values[:, [0, 1, 2, 5]] * [1.0, -1.0, -1.0, -1.0]
    if kind != ATTITUDE:
        return stamp, values
    rates = values[:, 4].astype(int) & IGNORE_RATES == 0
    if not rates.all():
        without = len(rates) - int(rates.sum())
        notes.append(f"{without} of {len(rates)} commands hold no body rates (type_mask): they are left out")
    return stamp[rates], values[rates]


def _events(received: _Messages, pushes: Any) -> tuple[Event, ...]:
    levels = {number: name for name, number in LEVELS.items()}
    order = np.argsort(received.received, kind="stable")
    messages = [typestore().deserialize_cdr(received.messages[index], ROLES["events"].type) for index in order]
    stamps = np.array([message.stamp.sec * NANO + message.stamp.nanosec for message in messages], np.int64)
    _check_stamps(stamps, strict=False)
    events, left = [], [push for push in pushes if isinstance(push, dict)] if isinstance(pushes, list) else []
    for stamp, message in zip(stamps, messages, strict=True):
        if message.name == "fip" and message.function:
            kind, data = message.function, json.loads(message.file or "{}")
        else:
            kind, data = _event_from_words(message.msg, left)
        events.append(Event(int(stamp), levels.get(message.level, str(message.level)), message.msg, kind, data))
    return tuple(events)


_WORDS = {
    "push": r"push",
    "length": r"pilot is told the length (?P<length>[-+.\de]+) m",
    "fall": r"rod or vehicle fell",
    "status": r"MPC status (?P<status>.*)",
    "refusal": r"no estimate: (?P<reason>.*)",
    "mode": r"failsafe: (?P<from>.*) -> (?P<to>.*?): (?P<reason>.*)",
}


def _event_from_words(text: str, pushes: list[dict[str, Any]]) -> tuple[str, dict[str, Any]]:
    """Kind and data of an event that is a sentence only, as they all were once; takes a push from the list."""
    for kind, pattern in _WORDS.items():
        if found := re.match(pattern, text, re.DOTALL):
            if kind == "push":
                return kind, {key: value for key, value in pushes.pop(0).items() if key != "start"} if pushes else {}
            return kind, {"length": float(found["length"])} if kind == "length" else found.groupdict()
    return "note", {}


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
    """Return the words of an error on one line; its kind if it has none."""
    return " ".join(str(error).split())[:300].rstrip(".") or type(error).__name__
