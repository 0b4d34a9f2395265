"""The records of an MCAP file, sound or damaged.

They follow one another, each with its length. Where one is damaged, the next one that makes sense is looked for: a
chunk of messages is compressed and carries a checksum, so it makes sense as a whole or not at all. (Messages of other
recorders may lie outside chunks, and then without a checksum.) The index at the end of a file is not needed.
"""

import re
import struct
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

from rosbags.rosbag2.storage_mcap import decompress, read_bytes, read_string
from ruamel.yaml import YAML

__all__ = ["Gap", "Remains", "Topic", "embedded_metadata"]

_MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _ATTACHMENT = 2, 3, 4, 5, 6, 9
_METADATA, _METADATA_INDEX, _DATA_END = 12, 13, 15
# Records that consist of some bytes and then of so many blocks, each behind its length in 4 bytes: header, footer,
# schema, channel, index of messages, metadata, end of the data.
_SHAPES = {1: (0, 2), 2: (20, 0), 3: (2, 3), 4: (4, 3), 7: (2, 1), 12: (0, 2), 15: (4, 0)}
# Records that come between the end of the data and the footer, and may hold anything.
_SUMMARY = (3, 4, 8, 10, 11, 13, 14)
_DAMAGE = 0  # no opcode of MCAP: stands for bytes that are no record
# Opcode and length of a message, a chunk or a metadata record; lengths from 2^40 on are none.
_HEAD = re.compile(rb"(?=[\x05\x06\x0c].{5}\x00{3})", re.DOTALL)


class Gap(NamedTuple):
    """Bytes of a file that could not be read."""

    size: int
    start: int | None
    """Log time in ns of the last message before them, or None."""
    end: int | None
    """Log time in ns of the first message after them, or None."""
    index: bool
    """Whether they lie behind all messages, where nothing but the index is."""


class Topic(NamedTuple):
    """A channel of MCAP with its schema."""

    name: str
    type: str
    definition: str
    metadata: bytes


class Remains:
    """What is left in the bytes of one MCAP file."""

    def __init__(self, content: bytes) -> None:
        self._content = content
        self.magic = content.startswith(_MAGIC)
        self.finished = content.endswith(_MAGIC) and len(content) > len(_MAGIC)
        self.entries: Mapping[str, Any] = {}
        self.gaps: list[Gap] = []
        schemas: dict[int, tuple[str, str, str]] = {}
        channels: dict[int, tuple[int, str, str, bytes]] = {}
        counts: Counter[int] = Counter()
        spans: dict[int, tuple[int, int]] = {}
        last: int | None = None
        open_gap, ended = 0, False
        for opcode, data in _walk(content):
            if opcode == _MESSAGE:
                channel, log_time = _message(data)
                if open_gap:
                    self.gaps.append(Gap(open_gap, last, log_time, False))
                    open_gap = 0
                first, latest = spans.get(channel, (log_time, log_time))
                spans[channel] = min(first, log_time), max(latest, log_time)
                last = latest if last is None else max(last, log_time)
                counts[channel] += 1
            elif opcode == _DAMAGE:
                open_gap += len(data)
            elif opcode == _DATA_END:
                ended = True
            else:
                with suppress(Exception):  # what does not hold what it should is as good as absent
                    if opcode == _SCHEMA:
                        stream = BytesIO(data[2:])
                        schemas[_number(data)] = read_string(stream), read_string(stream), read_string(stream)
                    elif opcode == _CHANNEL:
                        stream = BytesIO(data[4:])
                        words = read_string(stream), read_string(stream), read_bytes(stream)
                        channels[_number(data)] = (_number(data[2:]), *words)
                    elif opcode == _METADATA:
                        self.entries = _custom_data(data) or self.entries
        if open_gap:
            self.gaps.append(Gap(open_gap, last, None, ended))
        self.topics: dict[int, Topic] = {}
        for channel, (schema, name, encoding, metadata) in sorted(channels.items()):
            kind, language, definition = schemas.get(schema, ("", "", ""))
            if language in ("ros2msg", "ros2idl") and encoding == "cdr":
                self.topics[channel] = Topic(name, kind, definition, metadata)
        self.counts = {channel: count for channel, count in counts.items() if channel in self.topics}
        self.nameless = sum(counts.values()) - sum(self.counts.values())
        self.start_ns = min((spans[channel][0] for channel in self.counts), default=0)
        self.end_ns = max((spans[channel][1] for channel in self.counts), default=0)

    def messages(self) -> Iterator[tuple[Topic, int, bytes]]:
        """Topic, log time in ns and content of every message whose topic is known, in the order of the file."""
        for opcode, data in _walk(self._content):
            if opcode == _MESSAGE:
                channel, log_time = _message(data)
                if channel in self.topics:
                    yield self.topics[channel], log_time, data[22:]


def _number(data: bytes) -> int:
    return struct.unpack_from("<H", data)[0]


def _message(data: bytes) -> tuple[int, int]:
    """Channel and log time in ns of a message."""
    channel, _, log_time = struct.unpack_from("<HIQ", data)
    return channel, log_time


def _sound(data: bytes) -> bool:
    """Whether this may be a message: its head is complete, and its log time one that ROS knows."""
    return len(data) >= 22 and _message(data)[1] < 1 << 63


def _walk(content: bytes) -> Iterator[tuple[int, bytes]]:
    """Opcode and content of every record of a file and of its chunks, and ``_DAMAGE`` with the bytes between them."""
    at = before = len(_MAGIC) if content.startswith(_MAGIC) else 0
    channels: set[int] = set()
    ended = False
    while at < len(content):
        records, end = _records_at(content, at, ended)
        if at == len(_MAGIC) and content[at] == _MESSAGE:
            records = None  # a file begins with its header: this was one
        if records is None:
            # A chunk with a wrong checksum goes as a whole. Else the record before may be damaged: its length led here.
            whole = end > at and content[at] == _CHUNK and _framed(content, at + 9, end)
            end = _next(content, end if whole else before + 1, channels)
            yield _DAMAGE, content[at:end]
            before = at = end
            continue
        for opcode, data in records:
            if opcode == _CHANNEL:
                channels.add(_number(data))
            ended |= opcode == _DATA_END
            yield opcode, data
            if opcode == _FOOTER:
                return
        before, at = at, end


def _next(content: bytes, at: int, channels: Collection[int]) -> int:
    """Where the next chunk, message or metadata record begins that makes sense; else the end of the file."""
    for match in _HEAD.finditer(content, at):
        start = match.start()
        records, end = _records_at(content, start, False)
        if records is None:
            continue
        if content[start] == _MESSAGE:  # may be an accident, unless its channel is known and another record follows
            known = _number(records[0][1]) in channels
            if not known or (end < len(content) and _records_at(content, end, False)[0] is None):
                continue
        return start
    return len(content)


def _records_at(content: bytes, at: int, ended: bool) -> tuple[list[tuple[int, bytes]] | None, int]:
    """The record at a place, or the records of the chunk there, and where it ends; None if it makes no sense.

    ``ended`` says that the end of the data has passed, and the summary lies here.
    """
    head = _head(content, at)
    if head is None:
        return None, at
    opcode, start, end = head
    if opcode == _CHUNK:
        return _inside(content, start, end), end
    data = content[start:end]
    if opcode in _SHAPES:
        sound = _has_shape(data, *_SHAPES[opcode])
    else:
        sound = _sound(data) if opcode == _MESSAGE else opcode == _ATTACHMENT or (ended and opcode in _SUMMARY)
    return ([(opcode, data)] if sound else None), end


def _head(content: bytes, at: int) -> tuple[int, int, int] | None:
    """Opcode of the record at a place, start and end of its content; None if the file ends before."""
    if at + 9 > len(content):
        return None
    opcode, length = struct.unpack_from("<BQ", content, at)
    return None if at + 9 + length > len(content) else (opcode, at + 9, at + 9 + length)


def _has_shape(data: bytes, start: int, blocks: int) -> bool:
    for _ in range(blocks):
        if start + 4 > len(data):
            return False
        start += 4 + struct.unpack_from("<I", data, start)[0]
    return start == len(data)


def _framed(content: bytes, start: int, end: int) -> tuple[int, int, str, int] | None:
    """Size unpacked, checksum, compression of a chunk, and where it begins; None if its lengths do not agree."""
    try:
        size, crc, letters = struct.unpack_from("<QII", content, start + 16)
        packed = start + 40 + letters
        (length,) = struct.unpack_from("<Q", content, packed - 8)
        return (size, crc, content[start + 32 : packed - 8].decode(), packed) if packed + length == end else None
    except (struct.error, UnicodeDecodeError):
        return None


def _inside(content: bytes, start: int, end: int) -> list[tuple[int, bytes]] | None:
    """The records of a chunk; None if it is damaged."""
    try:
        size, crc, compression, packed = _framed(content, start, end) or ()
        raw = decompress(content[packed:end], compression, size, crc)
    except Exception:  # the libraries raise many kinds on damage, up to MemoryError
        return None
    records, at = [], 0
    while head := _head(raw, at):
        opcode, first, at = head
        data = raw[first:at]
        shape = _SHAPES.get(opcode) if opcode in (_SCHEMA, _CHANNEL) else None
        if (opcode == _MESSAGE and _sound(data)) or (shape and _has_shape(data, *shape)):
            records.append((opcode, data))
    return records


def embedded_metadata(source: Path) -> Mapping[str, Any]:
    """The copy of metadata.yaml's custom data that an MCAP file carries; empty if it carries none.

    Raises ValueError if there should be a copy and there is none, or another exception if it cannot be decoded.
    """
    files = [source] if source.is_file() else sorted(source.glob("*.mcap"))
    if not files or files[0].suffix != ".mcap":
        return {}
    content, at = files[0].read_bytes(), len(_MAGIC)
    while head := _head(content, at):
        opcode, start, at = head
        data = content[start:at]
        if opcode == _METADATA and (entries := _custom_data(data)) is not None:
            return entries
        if opcode == _FOOTER:
            return {}
        if not opcode or (opcode == _METADATA_INDEX and data[20:27] == b"rosbag2"):  # offset, length, name
            break
    raise ValueError("its copy of the metadata cannot be found")


def _custom_data(data: bytes) -> Mapping[str, Any] | None:
    """The custom data in the metadata record of rosbag2; None in that of somebody else."""
    stream = BytesIO(data)
    if read_string(stream) != "rosbag2":
        return None
    stream.read(4)  # the size of the map
    if read_string(stream) != "serialized_metadata":
        return None
    information = YAML(typ="safe").load(read_string(stream))
    if "custom_data" not in information and information["version"] >= 6:
        return None
    return dict(information.get("custom_data") or {})
