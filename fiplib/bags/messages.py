"""The bytes of the messages in a bag: their definitions, and those of our own written fast."""

import functools
import json
import struct
import sys
import zlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from fiplib.bags import guards
from fiplib.params import NANO
from fiplib.recording import ATTITUDE, JOINTS, POINT, POSE

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd  # the copy that rosbags itself depends on

ZSTD = b"\x28\xb5\x2f\xfd"
"""The first bytes of whatever zstd compressed; no message begins so."""

IGNORE_RATES, IGNORE_ATTITUDE = 1 | 2 | 4, 128
ATTITUDE_DEFINITION = """\
std_msgs/Header header
uint8 type_mask
uint8 IGNORE_ROLL_RATE = 1
uint8 IGNORE_PITCH_RATE = 2
uint8 IGNORE_YAW_RATE = 4
uint8 IGNORE_THRUST = 64
uint8 IGNORE_ATTITUDE = 128
geometry_msgs/Quaternion orientation
geometry_msgs/Vector3 body_rate
float32 thrust
"""


SIDECAR = "recording.yaml"
"""File in which a bag, while it is being recorded live, says what its metadata.yaml says once it is finished."""


@functools.cache
def typestore() -> Typestore:
    """ROS 2 message definitions, with mavros_msgs/AttitudeTarget added."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(ATTITUDE_DEFINITION, ATTITUDE))
    return store


def definitions(kind: str, text: str) -> Typestore:
    """The types in the definition of a message that a bag carries (msg or IDL). Raises what the library raises."""
    store, rule = get_typestore(Stores.EMPTY), "=" * 80 + "\n"
    if text.startswith(f"{rule}IDL: "):
        for part in text.split(rule)[1:]:
            store.register(get_types_from_idl(part.partition("\n")[2]))
    else:
        store.register(get_types_from_msg(text, kind))
    return store


def unpacked(message: bytes) -> bytes:
    """A message, decompressed if it was compressed by itself. Raises ValueError if that makes it too large."""
    if not message.startswith(ZSTD):
        return message
    plain = b""
    while message:  # a frame at a time
        unpacker = zstd.ZstdDecompressor()
        plain += unpacker.decompress(message, guards.UNPACKED - len(plain) + 1)
        if not unpacker.eof or len(plain) > guards.UNPACKED:
            raise ValueError(f"compressed data that are cut, or unpack to more than {guards.UNPACKED >> 20} MB")
        message = unpacker.unused_data
    return plain


class Layout(NamedTuple):
    """Where the numbers of a message lie, given the strings in it (frame id, names of joints).

    ROS 2 messages travel as CDR, where only strings and sequences vary in length: with these fixed, every message of a
    topic is the same bytes but for its stamp and its numbers. ``template`` is a message as the library serialises it;
    at ``offset`` lie ``doubles`` float64, then ``singles`` float32.
    """

    template: bytes
    offset: int
    doubles: int
    singles: int

    @classmethod
    def of(cls, message_type: str, frame: str, names: Sequence[str] = ()) -> "Layout":
        """Return the layout of a message type with a header, for one frame id and (JointState) one list of names."""
        types = typestore().types
        point = types["geometry_msgs/msg/Point"](0.0, 0.0, 0.0)
        identity = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
        rates = types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
        empty = np.zeros(0)
        # Per type: the fields after the header, the count of doubles and singles, and the bytes behind them (the two
        # empty sequences, velocity and effort, of a JointState).
        fields, doubles, singles, tail = {
            POSE: ((types["geometry_msgs/msg/Pose"](point, identity),), 7, 0, 0),
            POINT: ((point,), 3, 0, 0),
            JOINTS: ((list(names), np.zeros(len(names)), empty, empty), len(names), 0, 8),
            ATTITUDE: ((IGNORE_ATTITUDE, identity, rates, 0.0), 3, 1, 0),
        }[message_type]
        header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](0, 0), frame)
        template = bytes(typestore().serialize_cdr(types[message_type](header, *fields), message_type))
        return cls(template, len(template) - tail - 8 * doubles - 4 * singles, doubles, singles)

    def encode(self, stamp: int, values: Sequence[float] | np.ndarray) -> bytes:
        """One message; ``stamp`` in ns. Raises struct.error if the count of values is wrong."""
        message = bytearray(self.template)
        struct.pack_into("<iI", message, 4, *divmod(stamp, NANO))
        struct.pack_into(f"<{self.doubles}d{self.singles}f", message, self.offset, *values)
        return bytes(message)


def checksum(entries: Mapping[str, str]) -> str:
    """CRC-32 of a bag's metadata entries, as recorded under the key ``checksum``."""
    return f"{zlib.crc32(json.dumps(entries, sort_keys=True).encode()):08x}"


def genuine(entries: Mapping[str, Any]) -> bool:
    """Return whether a bag's metadata entries are as they were recorded; those of other recorders carry no checksum."""
    rest = {key: value for key, value in entries.items() if key != "checksum"}
    if "checksum" not in entries:
        return "messages" not in rest  # ours never come without
    return entries["checksum"] == checksum(rest)
