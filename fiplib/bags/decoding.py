"""Messages -> arrays, for every type that carries a pose, and for those of the bag contract.

ROS 2 messages travel as CDR, where only strings and sequences vary in length: messages whose strings and lengths are
the same have their numbers at the same places. So one message of each such form is walked along its definition, and
all others of the form are read at once.
"""

import functools
import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype
from rosbags.typesys.store import Typestore

from fiplib.bags.messages import definitions, typestore
from fiplib.bags.sources import Block, Stored
from fiplib.params import NANO
from fiplib.recording import ATTITUDE, JOINTS, POINT

__all__ = ["COMMANDS", "RATES", "TWIST", "Decoder", "carries_poses", "store_of"]

TWIST = "geometry_msgs/msg/TwistStamped"
RATES = "px4_msgs/msg/VehicleRatesSetpoint"
COMMANDS = (ATTITUDE, TWIST, RATES)
"""Types of a command: body rates and thrust."""

_COLUMNS = {
    POINT: ("point.x", "point.y", "point.z"),
    JOINTS: ("position",),
    ATTITUDE: ("body_rate.x", "body_rate.y", "body_rate.z", "thrust", "type_mask"),
    TWIST: ("twist.angular.x", "twist.angular.y", "twist.angular.z", "twist.linear.z"),
    RATES: ("roll", "pitch", "yaw", "thrust_body"),
}
_PLACES = (("position", "orientation"), ("translation", "rotation"))
_PLACE = re.compile(r"((?:.*\.)?)(position|translation)\.x")
_SIZES = {"bool": "u1", "byte": "u1", "char": "u1", "octet": "u1", "float32": "f4", "float64": "f8"}
_SIZES |= {f"{sign}int{8 * size}": f"{sign or 'i'}{size}" for sign in ("", "u") for size in (1, 2, 4, 8)}
_FORMS = 64  # how many forms of one topic are remembered


class _Pick(NamedTuple):
    """Numbers to take from a message: their names in its form, and that of their stamp (empty: it has none)."""

    stamp: str
    columns: tuple[str, ...]


@dataclass(frozen=True)
class _Form:
    """Where everything lies in the messages that have the strings and the lengths of this one."""

    sample: NDArray
    fixed: NDArray
    """(size,) bool: the bytes that all messages of the form share."""
    fields: Mapping[str, tuple[int, np.dtype, int]]
    """Offset, kind and count of the numbers, by name: ``pose.position.x``, ``transforms.0.header.stamp.sec``."""
    strings: Mapping[str, str]

    @classmethod
    def of(cls, data: bytes, kind: str, store: Typestore) -> "_Form":
        """Walk a message along its definition. Raises what the library raises if it does not follow it."""
        store.deserialize_cdr(data, kind)
        order = "<" if data[1] else ">"
        fixed = np.zeros(len(data), bool)
        fixed[:4] = True
        fields: dict[str, tuple[int, np.dtype, int]] = {}
        strings: dict[str, str] = {}

        def length(at: int) -> tuple[int, int]:
            at = (at + 3) & -4
            fixed[at : at + 4] = True
            return struct.unpack_from(f"{order}I", data, at)[0], at + 4

        def walk(node: Nodetype, detail: Any, name: str, at: int, count: int | None = None) -> int:
            if node == Nodetype.NAME:
                for field, (inner, about) in store.fielddefs[detail][1]:
                    at = walk(inner, about, f"{name}.{field}" if name else field, at)
            elif node != Nodetype.BASE:
                (inner, about), number = detail
                if node == Nodetype.SEQUENCE:
                    number, at = length(at)
                if inner == Nodetype.BASE and about[0] != "string":
                    return walk(inner, about, name, at, number)
                for index in range(number):
                    at = walk(inner, about, f"{name}.{index}", at)
            elif detail[0] == "string":
                size, at = length(at)
                fixed[at : at + size] = True
                strings[name] = data[at : at + size - 1].decode()
                at += size
            elif count != 0:
                number = np.dtype(order + _SIZES[detail[0]])
                at = 4 + ((at - 4 + number.itemsize - 1) & -number.itemsize)
                fields[name] = at, number, 1 if count is None else count
                at += number.itemsize * (1 if count is None else count)
            return at

        walk(Nodetype.NAME, kind, "", 4)
        return cls(np.frombuffer(data, np.uint8), fixed, fields, strings)

    def fits(self, data: NDArray) -> NDArray:
        """Return which of the messages (n, size) have this form, (n,) bool."""
        return (data[..., self.fixed] == self.sample[self.fixed]).all(axis=-1)

    def take(self, data: NDArray, columns: Sequence[str]) -> NDArray:
        """These numbers of the messages (n, size), (n, k) float64."""
        runs: list[tuple[int, np.dtype, int]] = []
        for offset, number, count in (self.fields[column] for column in columns):
            if runs and runs[-1][1] == number and runs[-1][0] + runs[-1][2] * number.itemsize == offset:
                runs[-1] = (runs[-1][0], number, runs[-1][2] + count)
            else:
                runs.append((offset, number, count))
        parts = [_cut(data, *run) for run in runs]
        return np.concatenate(parts, axis=1, dtype=np.float64) if len(parts) > 1 else parts[0].astype(np.float64)

    def stamps(self, data: NDArray, name: str) -> NDArray:
        """Return the stamps of that name, (n,) int64, ns."""
        second, nanosecond = (_cut(data, *self.fields[f"{name}.{part}"])[:, 0] for part in ("sec", "nanosec"))
        return second.astype(np.int64) * NANO + nanosecond

    def poses(self) -> Iterator[tuple[str, _Pick]]:
        """Yield the poses in a message, each with the name of its body (empty if it has none)."""
        for field in self.fields:
            if not (found := _PLACE.fullmatch(field)):
                continue
            holder, (place, turn) = found[1], next(pair for pair in _PLACES if found[2] in pair)
            columns = [f"{holder}{place}.{axis}" for axis in "xyz"] + [f"{holder}{turn}.{axis}" for axis in "xyzw"]
            if not all(column in self.fields for column in columns):
                continue
            item = (re.match(r".*\.\d+\.", holder) or [""])[0]
            names = [text for name, text in self.strings.items() if re.fullmatch(re.escape(item) + r"\w+", name)]
            stamp = next((name for name in (f"{item}header.stamp", "header.stamp") if f"{name}.sec" in self.fields), "")
            yield (names[0] if item and names else ""), _Pick(stamp, tuple(columns))


def _cut(data: NDArray, offset: int, number: np.dtype, count: int) -> NDArray:
    return np.ascontiguousarray(data[:, offset : offset + number.itemsize * count]).view(number)


def store_of(stored: Stored) -> Typestore | None:
    """Return the definitions with which a topic is decoded; None if neither the bag nor ROS 2 itself has them."""
    return _store(stored.type, stored.definition)


@functools.lru_cache
def _store(kind: str, definition: str) -> Typestore | None:
    if kind in typestore().fielddefs:
        return typestore()
    try:
        return definitions(kind, definition) if definition else None
    except Exception:  # the library's parser raises many kinds on what it does not know
        return None


def carries_poses(stored: Stored) -> bool:
    """Return whether messages of a topic hold poses: by their definition, whatever their type is called."""
    store = store_of(stored)

    def holds(kind: str, depth: int) -> bool:
        if kind in ("geometry_msgs/msg/Pose", "geometry_msgs/msg/Transform"):
            return True
        for _, (node, detail) in store.fielddefs[kind][1] if depth and store else ():
            inner = (node, detail) if node in (Nodetype.NAME, Nodetype.BASE) else detail[0]
            if inner[0] == Nodetype.NAME and holds(inner[1], depth - 1):
                return True
        return False

    return store is not None and holds(stored.type, 4)


class Decoder:
    """Gathers the numbers of one topic, block by block.

    Args:
        stored: the topic.
        body: of a type with several named poses (tf, rigid bodies), whose pose is taken.
    """

    def __init__(self, stored: Stored, body: str = "") -> None:
        store = store_of(stored)
        if store is None:
            raise ValueError(f"the bag does not hold the definition of its type {stored.type}: record it as MCAP")
        self._kind, self._store, self._body = stored.type, store, body
        self._forms: list[tuple[_Form, tuple[_Pick, ...]]] = []
        self._parts: list[tuple[NDArray, NDArray, NDArray]] = []
        self.count = 0
        """How many messages came."""
        self.names: tuple[str, ...] | None = None
        """Those of the joints, if the type has them."""
        self.poses: dict[str, NDArray] = {}
        """Bodies that occur, each with its first position."""
        self.frames: set[str] = set()
        """Frames in which the poses are given, as far as the messages say."""

    def take(self, block: Block) -> None:
        """Decode the messages of a block. Raises ValueError or what the library raises; both say what is wrong."""
        size = block.end - block.start
        content = np.frombuffer(block.content, np.uint8)
        pending = np.arange(len(size))
        pieces: list[tuple[NDArray, NDArray, NDArray]] = []
        while len(pending):
            first = int(pending[0])
            form, picks = self._form(block.message(first), self.count + first)
            alike = pending[size[pending] == len(form.sample)]
            data = _gathered(content, block.start[alike], len(form.sample))
            fits = form.fits(data)
            if not fits.all():
                alike, data = alike[fits], data[fits]
            for pick in picks:
                stamp = form.stamps(data, pick.stamp) if pick.stamp else block.received[alike]
                pieces.append((alike, stamp, form.take(data, pick.columns)))
            pending = pending[~np.isin(pending, alike, assume_unique=True)] if len(alike) < len(pending) else alike[:0]
        self.count += len(size)
        if not pieces:
            return
        index, stamp, values = pieces[0]
        if len(pieces) > 1:
            index, stamp, values = (np.concatenate(part) for part in zip(*pieces, strict=True))
            order = np.argsort(index, kind="stable")
            index, stamp, values = index[order], stamp[order], values[order]
        self._parts.append((stamp, block.received[index], values))

    def arrays(self) -> tuple[NDArray, NDArray, NDArray]:
        """Stamps and log times (n,) in ns and values (n, k), in the order of log time; nothing is kept."""
        parts, self._parts = self._parts, []
        if not parts:
            return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 7))
        stamp, received = (np.concatenate([part[i] for part in parts]) for i in (0, 1))
        values = np.concatenate([part[2] for part in parts])
        if (np.diff(received) < 0).any():
            order = np.argsort(received, kind="stable")
            stamp, received, values = stamp[order], received[order], values[order]
        return stamp, received, values

    def _form(self, message: bytes, index: int) -> tuple[_Form, tuple[_Pick, ...]]:
        data = np.frombuffer(message, np.uint8)
        for known in self._forms:
            if len(known[0].sample) == len(data) and known[0].fits(data):
                return known
        form = _Form.of(message, self._kind, self._store)
        found = form, self._picks(form, index)
        self._forms = [found, *self._forms[: _FORMS - 1]]
        return found

    def _picks(self, form: _Form, index: int) -> tuple[_Pick, ...]:
        stamp = "header.stamp" if "header.stamp.sec" in form.fields else ""
        if self._kind not in _COLUMNS:
            found = list(form.poses())
            for body, pick in found:
                if body not in self.poses:
                    self.poses[body] = form.take(form.sample[None], pick.columns[:3])[0]
            picks = tuple(pick for body, pick in found if body == self._body)
            names = (pick.stamp.removesuffix("stamp") + "frame_id" for pick in picks)
            self.frames |= {form.strings[name] for name in names if name in form.strings}
            return picks
        if self._kind == JOINTS:
            names = tuple(text for name, text in form.strings.items() if name.startswith("name."))
            if self.names is None:
                self.names = names
            elif names != self.names:
                raise ValueError(_NAMES.format(index))
            if not names:
                return ()
            if form.fields.get("position", (0, 0, 0))[2] != len(names):
                raise ValueError(_NAMES.format(index))
        return (_Pick(stamp, _COLUMNS[self._kind]),)


_NAMES = "message {} has other names than the first, or not one position for each"


def _gathered(content: NDArray, start: NDArray, size: int) -> NDArray:
    """Return the messages of one size that begin at these places, (n, size) bytes."""
    if len(start) > 1 and (np.diff(start) == size).all():
        return content[start[0] : start[0] + len(start) * size].reshape(-1, size)
    windows = np.ndarray(len(content) - size + 1, f"V{size}", content, strides=(1,))
    return windows[start].view(np.uint8).reshape(-1, size)
