"""Messages of recordings into a new bag: whole pieces at a time, each message with the bytes that it has."""

import functools
import shutil
import zlib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Connection
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2.storage_mcap import McapReader

from fiplib.bags.mcap import HEAD, File, Piece, chunk_at, piece_of
from fiplib.bags.messages import ZSTD, definitions, typestore, unpacked, zstd
from fiplib.bags.sources import opened
from fiplib.bags.writer import close_bag, open_bag
from fiplib.recording import BagError

_CHUNK = 1 << 20  # bytes from which on a chunk is closed


class Copy:
    """A new bag that pieces of others are copied into; a context manager.

    It is there whole or not at all: left by an exception, it is removed again. Messages that were compressed one by one
    are unpacked: an MCAP bag is compressed in chunks.

    Args:
        path: the directory to create.
        storage: MCAP or sqlite3.

    Raises:
        BagError: the path exists already, or cannot be written.
    """

    def __init__(self, path: Path, storage: StoragePlugin = StoragePlugin.MCAP) -> None:
        self._path = path
        self._writer: Any = open_bag(path, storage)
        self._links: dict[tuple[str, str], Connection] = {}
        self._sum = 0  # of the CRCs of what is written, which does not depend on its order
        self._mcap = storage == StoragePlugin.MCAP
        if self._mcap:
            self._writer.storage.compressor = self._noting(self._writer.storage.compressor)
        self.counts: Counter[str] = Counter()
        """Messages by topic."""
        self.unreadable = 0
        """Messages that could not be unpacked, and were left out."""

    def topic(self, name: str, kind: str, definition: str, profiles: Sequence[Any], encoding: str = "cdr") -> int:
        """Add a topic, if it is not there; return its number in the new bag."""
        if (name, kind) not in self._links:
            if not definition and kind in typestore().fielddefs:  # older sqlite3 bags hold none
                definition = typestore().generate_msgdef(kind, ros_version=2)[0]
            self._links[name, kind] = self._writer.add_connection(
                name,
                kind,
                msgdef=definition,
                rihs01=_type_hash(kind, definition),
                serialization_format=encoding,
                offered_qos_profiles=profiles,
            )
        return self._links[name, kind].id

    @property
    def topics(self) -> dict[str, str]:
        """Return the topics by name, with their types."""
        return dict(self._links.keys())

    def put(self, piece: Piece, topics: Mapping[int, int]) -> None:
        """Append the messages of those channels that are named, each with its number from ``topic``."""
        table = np.zeros(1 << 16, np.int64)
        table[list(topics)] = list(topics.values())
        numbers = table[piece.channel]
        if not numbers.all():
            piece, numbers = piece.part(numbers > 0), numbers[numbers > 0]
        if not len(numbers):
            return
        if _packed(piece).any():
            piece, numbers = self._unpacked(piece, numbers)
        links = {link.id: link for link in self._links.values()}
        for number, count in zip(*np.unique(numbers, return_counts=True), strict=True):
            self.counts[links[number].topic] += int(count)
        try:
            if self._mcap:
                self._append(piece, numbers)
            else:
                for number, time, start, end in zip(numbers, piece.time, piece.start, piece.end, strict=True):
                    content = piece.content[start:end]
                    self._sum += zlib.crc32(content)
                    self._writer.write(links[number], int(time), content)
        except OSError as error:
            raise self._failure(error) from error

    def finish(self, entries: Mapping[str, str]) -> None:
        """Write the index and the metadata, and read all of it back. Raises BagError if it is not as it should be."""
        try:
            close_bag(self._writer, entries, self.counts)
            self._check()
        except OSError as error:
            raise self._failure(error) from error

    def _failure(self, error: OSError) -> BagError:
        return BagError(f"{self._path}: cannot write the new bag ({error.strerror or error})")

    def _noting(self, compress: Callable[[bytes], bytes]) -> Callable[[bytes], bytes]:
        def noting(raw: bytes) -> bytes:
            self._sum += zlib.crc32(raw)
            return compress(raw)

        return noting

    def _unpacked(self, piece: Piece, numbers: NDArray) -> tuple[Piece, NDArray]:
        """Return the piece with every message unpacked, without those that are damaged."""
        messages = []
        for number, time, start, end in zip(numbers, piece.time, piece.start, piece.end, strict=True):
            try:
                messages.append((int(number), int(time), unpacked(piece.content[start:end])))
            except (zstd.ZstdError, MemoryError):
                self.unreadable += 1
        if not messages:
            return piece.part(np.zeros(0, np.int64)), numbers[:0]
        piece = piece_of(messages)
        return piece, piece.channel

    def _append(self, piece: Piece, numbers: NDArray) -> None:
        """Append records to the chunk that is open, as the library's writer does with one message at a time."""
        begin, size = piece.start - HEAD, piece.end - piece.start + HEAD
        breaks = np.flatnonzero(begin[1:] != piece.end[:-1]) + 1
        runs = zip(begin[np.append(0, breaks)], piece.end[np.append(breaks, len(begin)) - 1], strict=True)
        block = bytearray().join(memoryview(piece.content)[start:end] for start, end in runs)
        offset = np.append(0, np.cumsum(size)[:-1])
        view = np.frombuffer(block, np.uint8)
        view[offset + 9], view[offset + 10] = numbers & 255, numbers >> 8
        writer, storage = self._writer, self._writer.storage
        first, last = int(piece.time.min()), int(piece.time.max())
        offset += storage.chunk.bio.tell()
        storage.chunk.bio.write(block)
        for number in np.unique(numbers).tolist():
            mine = numbers == number
            storage.chunk.msgs[number] += zip(piece.time[mine].tolist(), offset[mine].tolist(), strict=True)
            storage.channel_stats[number] += int(mine.sum())
            writer.counts[number] += int(mine.sum())
        for times in (storage, storage.chunk):
            times.message_start_time = min(times.message_start_time, first)
            times.message_end_time = max(times.message_end_time, last)
        writer.min_timestamp, writer.max_timestamp = min(writer.min_timestamp, first), max(writer.max_timestamp, last)
        if storage.chunk.bio.tell() > _CHUNK:
            storage.close_chunk()

    def _check(self) -> None:
        """Read the new bag back. Raises BagError if it is not what was written."""
        total = 0
        try:
            with opened(self._path) as source:
                counts = {topic: stored.count for topic, stored in source.topics.items() if stored.count}
                for storage in source.storages:
                    if isinstance(storage, McapReader):
                        with File(Path(storage.path)) as file:
                            for info in storage.chunks:
                                total += zlib.crc32(chunk_at(file, info.chunk_start_offset).content)
                        continue
                    links = [link for link in storage.connections if link.msgcount]
                    total += sum(zlib.crc32(content) for _, _, content in storage.messages(links)) if links else 0
            if counts != self.counts or total != self._sum:
                raise ValueError("its messages are not those that were written")
        except Exception as error:
            raise BagError(
                f"{self._path}: the new bag does not read back as it was written ({error}) and was removed: "
                "check the disk, or choose another --output"
            ) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            with suppress(Exception):  # already closed, or what it still holds cannot be written
                self._writer.abort()
            shutil.rmtree(self._path, ignore_errors=True)  # half a bag helps nobody


def _packed(piece: Piece) -> NDArray:
    """Return which messages were compressed one by one, (n,) bool."""
    view = np.frombuffer(piece.content, np.uint8)
    long = piece.end - piece.start >= len(ZSTD)
    at = np.where(long, piece.start, 0)[:, None] + np.arange(len(ZSTD))
    return long & (view[at] == np.frombuffer(ZSTD, np.uint8)).all(axis=1)


@functools.cache
def _type_hash(kind: str, definition: str) -> str:
    """Return the hash by which ROS 2 names a message definition."""
    with suppress(Exception):  # a definition that the library cannot parse: no reader of bags needs the hash
        return definitions(kind, definition).hash_rihs01(kind)
    return f"RIHS01_{0:064}"
