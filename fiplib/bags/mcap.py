"""The records of an MCAP file, sound or damaged.

They follow one another, each with its length. Where one is damaged, the next one that makes sense is looked for: a
chunk of messages is compressed and carries a checksum, so it makes sense as a whole or not at all. (Messages of other
recorders may lie outside chunks, and then without a checksum.) The index at the end of a file is not needed. Never is
more of a file in memory than one record.
"""

import re
import struct
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from lz4.frame import LZ4FrameDecompressor
from numpy.typing import NDArray
from rosbags.rosbag2.storage_mcap import decompress, read_bytes, read_string

from fiplib.bags import guards
from fiplib.bags.messages import ZSTD, unpacked

__all__ = ["File", "Gap", "Remains", "Topic", "chunk_at", "embedded_metadata", "places"]

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
_OPCODES = (b"\x05", b"\x06", b"\x0c")
_WINDOW = 1 << 20  # bytes in which they are looked for at once
_LARGEST = guards.UNPACKED  # a length beyond is damage
_START = struct.Struct("<BQH")  # opcode and length of a record, and channel of a message


class File:
    """The bytes of a file, of which only the slices that are asked for are read; a context manager."""

    def __init__(self, path: Path) -> None:
        self._stream = path.open("rb")
        self._size = path.stat().st_size

    def __len__(self) -> int:
        return self._size

    def __getitem__(self, part: slice) -> bytes:
        start, end, _ = part.indices(self._size)
        self._stream.seek(start)
        return self._stream.read(max(end - start, 0))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stream.close()


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
    """What is left in one MCAP file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        with File(path) as content:
            self.magic = content[:8] == _MAGIC
            self.finished = content[-8:] == _MAGIC and len(content) > len(_MAGIC)
        self.entries: Mapping[str, Any] = {}
        self.gaps: list[Gap] = []
        schemas: dict[int, tuple[str, str, str]] = {}
        channels: dict[int, tuple[int, str, str, bytes]] = {}
        counts: Counter[int] = Counter()
        spans: dict[int, tuple[int, int]] = {}
        last: int | None = None
        open_gap, ended = 0, False
        for opcode, data in _walk(path):
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
                open_gap += int.from_bytes(data)
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
        for opcode, data in _walk(self._path):
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


def _walk(path: Path) -> Iterator[tuple[int, bytes]]:
    """Opcode and content of every record of a file and of its chunks, and ``_DAMAGE`` with the size of what is none.

    Of attachments and indexes, which may be large, the content is left out.
    """
    with File(path) as content:
        at = before = len(_MAGIC) if content[:8] == _MAGIC else 0
        channels: set[int] = set()
        ended = False
        while at < len(content):
            records, end = _records_at(content, at, ended)
            if at == len(_MAGIC) and records and records[0][0] == _MESSAGE:
                records = None  # a file begins with its header: this was one
            if records is None:
                # A chunk with a wrong checksum goes as a whole. Else the record before may be damaged: its length led
                # here. Not so a chunk, whose two lengths agree: its messages must not be found twice.
                whole = end > at and content[at : at + 1] == b"\x06" and _framed(content, at + 9, end)
                end = _next(content, end if whole else before + 1, channels)
                yield _DAMAGE, max(end - at, 0).to_bytes(8)
                before = at = end
                continue
            for opcode, data in records:
                if opcode == _CHANNEL:
                    channels.add(_number(data))
                ended |= opcode == _DATA_END
                yield opcode, data
                if opcode == _FOOTER:
                    return
            before, at = (end - 1 if content[at : at + 1] == b"\x06" else at), end


def _next(content: File, at: int, channels: Collection[int]) -> int:
    """Where the next chunk, message or metadata record begins that makes sense; else the end of the file."""
    for base in range(at, len(content), _WINDOW):
        window = content[base : base + _WINDOW + 8]
        if not any(opcode in window for opcode in _OPCODES):  # nothing: a sparse file has gigabytes of zeros
            continue
        for match in _HEAD.finditer(window):
            start = base + match.start()
            records, end = _records_at(content, start, False)
            if records is None:
                continue
            if content[start : start + 1] == b"\x05":
                # may be an accident, unless its channel is known and another record follows
                known = _number(records[0][1]) in channels
                if not known or (end < len(content) and _records_at(content, end, False)[0] is None):
                    continue
            return start
    return len(content)


def _records_at(content: File, at: int, ended: bool) -> tuple[list[tuple[int, bytes]] | None, int]:
    """The record at a place, or the records of the chunk there, and where it ends; None if it makes no sense.

    ``ended`` says that the end of the data has passed, and the summary lies here.
    """
    head = _head(content, at)
    if head is None:
        return None, at
    opcode, start, end = head
    if opcode == _CHUNK:
        return _inside(content, start, end), end
    if opcode in _SHAPES:
        sound = _has_shape(content, start, end, *_SHAPES[opcode])
    elif opcode == _MESSAGE:
        sound = end - start <= _LARGEST and _sound(content[start : min(end, start + 22)])
    else:
        sound = opcode == _ATTACHMENT or (ended and opcode in _SUMMARY)
    kept = opcode in (_MESSAGE, _SCHEMA, _CHANNEL, _METADATA)
    return ([(opcode, content[start:end] if kept else b"")] if sound else None), end


def _head(content: File | bytes, at: int) -> tuple[int, int, int] | None:
    """Opcode of the record at a place, start and end of its content; None if the file ends before."""
    if at + 9 > len(content):
        return None
    opcode, length = struct.unpack("<BQ", content[at : at + 9])
    return None if at + 9 + length > len(content) else (opcode, at + 9, at + 9 + length)


def _has_shape(content: File | bytes, at: int, end: int, start: int, blocks: int) -> bool:
    at += start
    for _ in range(blocks):
        if at + 4 > end:
            return False
        at += 4 + struct.unpack("<I", content[at : at + 4])[0]
    return at == end


def _framed(content: File, start: int, end: int) -> tuple[int, int, str, int] | None:
    """Size unpacked, checksum, compression of a chunk, and where it begins; None if its lengths do not agree."""
    try:
        head = content[start : min(end, start + 72)]
        size, crc, letters = struct.unpack_from("<QII", head, 16)
        (length,) = struct.unpack_from("<Q", head, 32 + letters)
        packed = start + 40 + letters
        return (size, crc, head[32 : 32 + letters].decode(), packed) if packed + length == end else None
    except (struct.error, UnicodeDecodeError):
        return None


def _unpacked(content: File, start: int, end: int) -> bytes:
    """The bytes of a chunk. Raises whatever the libraries raise on damage, up to MemoryError."""
    size, crc, compression, packed = _framed(content, start, end) or ()
    if max(size, end - packed) > _LARGEST:
        raise ValueError(f"a chunk of {size} bytes")
    data = content[packed:end]
    if compression == "zstd":
        data, compression = unpacked(data) if data.startswith(ZSTD) else b"", ""
    elif compression == "lz4":
        data, compression = LZ4FrameDecompressor().decompress(data, size + 1), ""
    return decompress(data, compression, size, crc)


def _inside(content: File, start: int, end: int) -> list[tuple[int, bytes]] | None:
    """The records of a chunk; None if it is damaged."""
    try:
        raw = _unpacked(content, start, end)
    except Exception:
        return None
    records, at = [], 0
    while head := _head(raw, at):
        opcode, first, at = head
        shape = _SHAPES.get(opcode) if opcode in (_SCHEMA, _CHANNEL) else None
        if (opcode == _MESSAGE and _sound(raw[first:at])) or (shape and _has_shape(raw, first, at, *shape)):
            records.append((opcode, raw[first:at]))
    return records


def chunk_at(content: File, at: int) -> bytes:
    """The records of the chunk at a place of a file. Raises ValueError if it is damaged."""
    head = _head(content, at)
    try:
        if head and head[0] == _CHUNK:
            return _unpacked(content, head[1], head[2])
        reason = "no chunk is there"
    except Exception as error:
        reason = str(error)
    raise ValueError(f"the chunk at byte {at}: {reason}")


def places(raw: bytes, channels: Collection[int]) -> dict[int, tuple[NDArray, NDArray, NDArray]]:
    """Log times in ns, starts and ends of the messages in a chunk, (n,) int64 each, for those channels that occur.

    Raises ValueError if its records do not fill it.
    """
    found: dict[int, list[int]] = {channel: [] for channel in channels}
    at, size, start = 0, len(raw), _START.unpack_from
    try:
        while at < size:
            opcode, length, channel = start(raw, at)
            if opcode == _MESSAGE and channel in found:
                found[channel].append(at)
            at += 9 + length
    except struct.error:
        at = -1
    if at != size:
        raise ValueError("a chunk whose records do not fill it")
    view = np.frombuffer(raw, np.uint8)
    result = {}
    for channel, starts in found.items():
        if starts:
            head = np.array(starts)
            length, log_time = (_numbers(view, head + offset) for offset in (1, 15))
            if (length < 22).any() or (log_time < 0).any():
                raise ValueError("a message without its head")
            result[channel] = log_time, head + 31, head + 9 + length
    return result


def _numbers(view: NDArray, at: NDArray) -> NDArray:
    """The 8-byte integers at these places, (n,) int64."""
    return view[at[:, None] + np.arange(8)].view("<i8")[:, 0]


def embedded_metadata(source: Path) -> Mapping[str, Any]:
    """The copy of metadata.yaml's custom data that an MCAP file carries; empty if it carries none.

    Raises ValueError if there should be a copy and there is none, or another exception if it cannot be decoded.
    """
    at = len(_MAGIC)
    with File(source) as content:
        while head := _head(content, at):
            opcode, start, at = head
            if (
                opcode == _METADATA
                and at - start <= guards.WORDS
                and (entries := _custom_data(content[start:at])) is not None
            ):
                return entries
            if opcode == _FOOTER:
                return {}
            # of the index: offset, length, name
            if not opcode or (opcode == _METADATA_INDEX and content[start + 20 : start + 27] == b"rosbag2"):
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
    information = guards.words(read_string(stream))
    if "custom_data" not in information and information["version"] >= 6:
        return None
    return dict(information.get("custom_data") or {})
