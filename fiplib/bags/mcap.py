"""The records of an MCAP file, sound or damaged.

They follow one another, each with its length. Where one is damaged, the next one that makes sense is looked for: a
chunk of messages is compressed and carries a checksum, so it makes sense as a whole or not at all. (Messages of other
recorders may lie outside chunks, and then without a checksum.) The index at the end of a file is not needed. Never is
more of a file in memory than one record, or a megabyte of small ones.
"""

import re
import struct
import zlib
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from lz4.frame import LZ4FrameDecompressor
from numpy.typing import NDArray
from rosbags.rosbag2.storage_mcap import read_bytes, read_string

from fiplib.bags import guards
from fiplib.bags.messages import zstd

__all__ = ["HEAD", "File", "Gap", "Piece", "Remains", "Topic", "chunk_at", "embedded_metadata", "piece_of", "profile"]

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
_AHEAD = 1 << 16  # bytes that are read at once where little is asked for
_LARGEST = guards.UNPACKED  # a length beyond is damage
_START = struct.Struct("<BQ")  # opcode and length of a record
_MESSAGE_HEAD = struct.Struct("<BQHIQQ")  # the same, channel, sequence, log and publish time
HEAD = _MESSAGE_HEAD.size
"""Bytes of a message's record before its content."""


class File:
    """The bytes of a file, of which only the slices that are asked for are read; a context manager."""

    def __init__(self, path: Path) -> None:
        self._stream = path.open("rb")
        self._size = path.stat().st_size
        self._at, self._held = 0, b""

    def __len__(self) -> int:
        return self._size

    def __getitem__(self, part: slice) -> bytes:
        start, end, _ = part.indices(self._size)
        size = max(end - start, 0)
        if start < self._at or end > self._at + len(self._held):
            self._stream.seek(start)
            if size > _AHEAD // 2:
                return self._stream.read(size)
            self._at, self._held = start, self._stream.read(_AHEAD)
        return self._held[start - self._at : start - self._at + size]

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


class Piece(NamedTuple):
    """Messages in one piece of memory, in the order of their file; their records are left as they are."""

    content: bytes
    channel: NDArray
    """(n,) int64."""
    time: NDArray
    """(n,) int64, ns: log time."""
    start: NDArray
    """(n,) int64: where the content of a message begins in ``content``, ``HEAD`` bytes behind its record."""
    end: NDArray

    def part(self, keep: NDArray) -> "Piece":
        """Return some of the messages."""
        return Piece(self.content, *(column[keep] for column in self[1:]))


def piece_of(messages: Collection[tuple[int, int, bytes]]) -> Piece:
    """Return the records of messages: channel, log time in ns and content of each."""
    parts, at, ends = [], 0, []
    for channel, time, content in messages:
        parts += (_MESSAGE_HEAD.pack(_MESSAGE, 22 + len(content), channel, 0, time, time), content)
        at += HEAD + len(content)
        ends.append(at)
    channels, times, _ = zip(*messages, strict=True)
    end = np.array(ends, np.int64)
    start = np.append(0, end[:-1]) + HEAD
    return Piece(b"".join(parts), np.array(channels, np.int64), np.array(times, np.int64), start, end)


class Remains:
    """The readable remains of one damaged MCAP file.

    Args:
        path: the file.
        seen: the chunks of the recording that were found before; one that is found again is left out, and its messages
            are counted in ``repeated``.
    """

    def __init__(self, path: Path, seen: set[tuple[int, ...]] | None = None) -> None:
        self._path = path
        seen = set() if seen is None else seen
        self.entries: Mapping[str, Any] = {}
        self.gaps: list[Gap] = []
        self.repeated = 0
        schemas: dict[int, tuple[str, str, str]] = {}
        channels: dict[int, tuple[int, str, str, bytes]] = {}
        counts: Counter[int] = Counter()
        spans: dict[int, tuple[int, int]] = {}
        self._places: list[int] = []
        last: int | None = None
        open_gap, ended = 0, False
        with File(path) as content:
            self.magic = content[:8] == _MAGIC
            self.finished = content[-8:] == _MAGIC and len(content) > len(_MAGIC)
            for opcode, data, at in _walk(content):
                if opcode == _MESSAGE:
                    key = len(data.content), zlib.crc32(data.content), int(data.time[0]), int(data.time[-1])
                    if key in seen:
                        self.repeated += len(data.time)
                        continue
                    if content[at : at + 1] == b"\x06":
                        seen.add(key)
                    self._places.append(at)
                    if open_gap:
                        self.gaps.append(Gap(open_gap, last, int(data.time[0]), False))
                        open_gap = 0
                    for channel, count in zip(*np.unique(data.channel, return_counts=True), strict=True):
                        times = data.time[data.channel == channel]
                        first, latest = spans.get(channel, (times[0], times[0]))
                        spans[channel] = min(first, times.min()), max(latest, times.max())
                        counts[int(channel)] += int(count)
                    last = max(last or 0, int(data.time.max()))
                elif opcode == _DAMAGE:
                    open_gap += data
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
        self.foreign: set[str] = set()
        """Encodings of messages that are not ROS 2."""
        for channel, (schema, name, encoding, metadata) in sorted(channels.items()):
            kind, language, definition = schemas.get(schema, ("", "", ""))
            if language in ("ros2msg", "ros2idl") and encoding == "cdr":
                self.topics[channel] = Topic(name, kind, definition, metadata)
            elif counts[channel]:
                self.foreign.add(encoding or language)
        self.counts = {channel: count for channel, count in counts.items() if channel in self.topics}
        self.nameless = sum(counts.values()) - sum(self.counts.values())
        self.start_ns = int(min((spans[channel][0] for channel in self.counts), default=0))
        self.end_ns = int(max((spans[channel][1] for channel in self.counts), default=0))

    def pieces(self) -> Iterator[Piece]:
        """All messages that are left, in the order of the file."""
        with File(self._path) as content:
            for at in self._places:
                records, _ = _records_at(content, at, False)
                yield from (data for opcode, data in records or () if opcode == _MESSAGE)


def _number(data: bytes) -> int:
    return struct.unpack_from("<H", data)[0]


def _walk(content: File) -> Iterator[tuple[int, Any, int]]:
    """Opcode and content of every record of a file and of its chunks, and the place of the record.

    Messages come as a ``Piece`` for each chunk, or for each megabyte of those outside; ``_DAMAGE`` comes with the
    number of bytes that are no record. Of attachments and indexes, which may be large, the content is left out.
    """
    at = before = len(_MAGIC) if content[:8] == _MAGIC else 0
    channels: set[int] = set()
    ended = False
    while at < len(content):
        records, end = _records_at(content, at, ended)
        if at == len(_MAGIC) and records and content[at : at + 1] == b"\x05":
            records = None  # a file begins with its header: this was one
        if records is None:
            # A chunk with a wrong checksum goes as a whole. Else the record before may be damaged: its length led
            # here. Not so a chunk, whose two lengths agree: its messages must not be found twice.
            whole = end > at and content[at : at + 1] == b"\x06" and _framed(content, at + 9, end)
            end = _next(content, end if whole else before + 1, channels)
            yield _DAMAGE, max(end - at, 0), at
            before = at = end
            continue
        last = at
        for opcode, data in records:
            if opcode == _CHANNEL:
                channels.add(_number(data))
            elif opcode == _MESSAGE:
                last = at + int(data.start[-1]) - HEAD
            ended |= opcode == _DATA_END
            yield opcode, data, at
            if opcode == _FOOTER:
                return
        before, at = (end - 1 if content[at : at + 1] == b"\x06" else last), end


def _next(content: File, at: int, channels: Collection[int]) -> int:
    """Return where the next chunk, message or metadata record begins that makes sense; else the end of the file."""
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
                piece = records[0][1]
                alone = len(piece.time) == 1 and end < len(content) and _records_at(content, end, False)[0] is None
                if int(piece.channel[0]) not in channels or alone:
                    continue
            return start
    return len(content)


def _records_at(content: File, at: int, ended: bool) -> tuple[list[tuple[int, Any]] | None, int]:
    """Return the record at a place, or those of the chunk or the messages there, and where they end; None if no sense.

    ``ended`` says that the end of the data has passed, and the summary lies here.
    """
    head = _head(content, at)
    if head is None:
        return None, at
    opcode, start, end = head
    if opcode == _CHUNK:
        return _inside(content, start, end), end
    if opcode == _MESSAGE:
        if end - start > _LARGEST:
            return None, end
        piece, _, stop = _messages(content[at : max(end, min(at + _WINDOW, len(content)))], True)
        return ([(_MESSAGE, piece)], at + stop) if len(piece.time) else (None, end)
    if opcode in _SHAPES:
        sound = _has_shape(content, start, end, *_SHAPES[opcode])
    else:
        sound = opcode == _ATTACHMENT or (ended and opcode in _SUMMARY)
    kept = opcode in (_SCHEMA, _CHANNEL, _METADATA)
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
    """Return the bytes of a chunk. Raises whatever the libraries raise on damage, up to MemoryError."""
    size, crc, compression, packed = _framed(content, start, end) or ()
    if max(size, end - packed) > _LARGEST:
        raise ValueError(f"a chunk of {size} bytes")
    raw = content[packed:end]
    # never more than it says: some kilobytes can be made that unpack to more than fits into memory
    if compression == "zstd":
        raw = zstd.ZstdDecompressor().decompress(raw, max_length=size + 1)
    elif compression == "lz4":
        raw = LZ4FrameDecompressor().decompress(raw, max_length=size + 1)
    elif compression:
        raise ValueError(f"compressed by {compression}, which is none of MCAP's compressions")
    if len(raw) != size or (crc and zlib.crc32(raw) != crc):
        raise ValueError("its checksum is wrong" if len(raw) == size else f"{len(raw)} bytes in place of {size}")
    return raw


def _messages(raw: bytes, alone: bool = False) -> tuple[Piece, list[int], int]:
    """Return the messages among the records of a chunk, the places of other records, and where the last record ends.

    ``alone`` says that these are no chunk's: what is no message ends them, and so does one that makes no sense.
    """
    found: list[int] = []
    others: list[int] = []
    at, size, start = 0, len(raw), _START.unpack_from
    with suppress(struct.error):
        while at < size:
            opcode, length = start(raw, at)
            end = at + 9 + length
            if end > size or (alone and opcode != _MESSAGE):
                break
            (found if opcode == _MESSAGE else others).append(at)
            at = end
    head = np.array(found, np.int64)
    if len(head):
        view = np.frombuffer(raw, np.uint8)
        if head[-1] + HEAD > size:  # too short to be one
            head = head[:-1]
        length, time = (_numbers(view, head + offset) for offset in (1, 15))
        sound = (length >= 22) & (time >= 0)
        if alone and not sound.all():
            at, sound[np.argmin(sound) :] = int(head[np.argmin(sound)]), False
        channel = view[head + 9] + 256 * view[head + 10].astype(np.int64)
        piece = Piece(raw, channel, time, head + HEAD, head + 9 + length)
        return (piece if sound.all() else piece.part(sound)), others, at
    return Piece(raw, head, head, head, head), others, at


def _inside(content: File, start: int, end: int) -> list[tuple[int, Any]] | None:
    """Return the records of a chunk; None if it is damaged."""
    try:
        raw = _unpacked(content, start, end)
    except Exception:
        return None
    piece, others, stop = _messages(raw)
    records: list[tuple[int, Any]] = []
    for opcode, first, last in (_head(raw, at) or (0, 0, 0) for at in others):
        if opcode in (_SCHEMA, _CHANNEL) and _has_shape(raw, first, last, *_SHAPES[opcode]):
            records.append((opcode, raw[first:last]))
    if len(piece.time):
        records.append((_MESSAGE, piece))
    if stop < len(raw):  # only where it has no checksum
        records.append((_DAMAGE, len(raw) - stop))
    return records


def chunk_at(content: File, at: int) -> Piece:
    """Return the messages of the chunk at a place of a file. Raises ValueError if it is damaged."""
    head = _head(content, at)
    try:
        if head and head[0] == _CHUNK:
            raw = _unpacked(content, head[1], head[2])
            piece, _, stop = _messages(raw)
            if stop == len(raw):
                return piece
            reason = "its records do not fill it"
        else:
            reason = "no chunk is there"
    except Exception as error:
        reason = str(error)
    raise ValueError(f"the chunk at byte {at}: {reason}")


def _numbers(view: NDArray, at: NDArray) -> NDArray:
    """Return the 8-byte integers at these places, (n,) int64."""
    return view[at[:, None] + np.arange(8)].view("<i8")[:, 0]


def profile(file: Path) -> str:
    """Return the profile in the header of an MCAP file: ``ros2``, or another word."""
    with File(file) as content:
        head = _head(content, len(_MAGIC))
        return read_string(BytesIO(content[head[1] : head[2]])) if head and head[0] == 1 else "ros2"


def embedded_metadata(source: Path) -> Mapping[str, Any]:
    """Return the copy of metadata.yaml's custom data that an MCAP file carries; empty if it carries none.

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
    """Return the custom data in the metadata record of rosbag2; None in that of somebody else."""
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
