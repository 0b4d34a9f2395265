"""Where the messages of a bag lie: one file or several, MCAP or sqlite3, compressed or not, with metadata.yaml or not.

Messages come in blocks, a chunk of the file at a time: what a bag needs in memory does not grow with its size.
"""

import shlex
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Connection
from rosbags.rosbag2.storage_mcap import McapReader
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

from fiplib.bags.files import files_of, information_of, magic, name_what_it_is, plain
from fiplib.bags.mcap import File, Piece, chunk_at, embedded_metadata, piece_of
from fiplib.bags.messages import ZSTD, unpacked
from fiplib.recording import BagError

_BLOCK = 4096  # messages in a block where the storage has no chunks, and their bytes
_BYTES = 1 << 22
FOREIGN = ("jsonschema", "protobuf", "flatbuffer", "ros1msg")
"""How MCAP calls the definitions of messages that are not ROS 2."""


class Block(NamedTuple):
    """Messages of one topic that lie in one piece of memory."""

    topic: str
    received: NDArray
    """(n,) int64, ns: log time."""
    content: bytes
    start: NDArray
    """(n,) int64: where each message begins in ``content``; ``end`` is where it ends."""
    end: NDArray

    def message(self, index: int) -> bytes:
        """One message."""
        return self.content[self.start[index] : self.end[index]]


class Stored(NamedTuple):
    """One topic of a bag."""

    type: str
    count: int
    definition: str
    """Definition of the message type; empty where the bag holds none."""


class Source(NamedTuple):
    """An open bag."""

    custom: Mapping[str, Any]
    """Its own words about itself, not decoded."""
    topics: Mapping[str, Stored]
    storages: tuple[McapReader | Sqlite3Reader, ...]
    """The files in the order of their first messages."""

    def blocks(self, topics: Collection[str]) -> Iterator[Block]:
        """All messages of some topics, in the order of the files; nothing else is unpacked."""
        for storage in self.storages:
            wanted = {link.id: link for link in storage.connections if link.topic in topics}
            if not wanted:
                continue
            for block in _blocks(storage, wanted):
                yield _decompressed(block) if block.message(0).startswith(ZSTD) else block

    def pieces(self, start: int, stop: int) -> Iterator[tuple[McapReader | Sqlite3Reader, Piece]]:
        """All messages from a log time to before another, in ns, in the order of the files, and the file of each."""
        for storage in self.storages:
            links = {link.id: link for link in storage.connections}
            if isinstance(storage, McapReader) and storage.chunks:
                found = _chunks(storage, links, start, stop)
            else:
                found = _batches(storage, links, start, stop)
            for piece in found:
                keep = (piece.time >= start) & (piece.time < stop)
                if keep.any():
                    yield storage, piece if keep.all() else piece.part(keep)


@contextmanager
def opened(path: Path) -> Iterator[Source]:
    """Open a bag. Raises BagError, or whatever the libraries raise where it is damaged."""
    with ExitStack() as stack:
        information = information_of(path)
        storages = []
        for file in files_of(path, information):
            storage = _storage(plain(file, stack))
            try:
                storage.open()
            except Exception as error:
                name_what_it_is(file)
                if isinstance(error, KeyError) and error.args[0] in FOREIGN:
                    raise BagError(
                        f"{file}: some of its topics are no ROS 2 messages ({error.args[0]}); the others into a new "
                        f"bag with: fip bag recover {shlex.quote(str(path))}"
                    ) from error
                raise
            stack.callback(storage.close)
            storages.append(storage)
        storages.sort(key=lambda storage: storage.metadata.start_time)
        spans = [storage.metadata for storage in storages]
        if not information and any(one.end_time > other.start_time + 1 for one, other in pairwise(spans)):
            raise BagError(f"{path}: its {len(storages)} files overlap in time: name one of them instead")
        counts: Counter[str] = Counter()
        topics: dict[str, Stored] = {}
        for link in (link for storage in storages for link in storage.connections):
            counts[link.topic] += link.msgcount
            topics.setdefault(link.topic, Stored(link.msgtype, 0, link.msgdef.data))
        for entry in information.get("topics_with_message_count", ()):
            name = entry["topic_metadata"]["name"]
            counts[name] = entry["message_count"]
            topics.setdefault(name, Stored(entry["topic_metadata"]["type"], 0, ""))
        custom = information.get("custom_data") or {}
        if not custom and isinstance(storages[0], McapReader):
            custom = embedded_metadata(Path(storages[0].path))
        topics = {name: topic._replace(count=counts[name]) for name, topic in topics.items()}
        yield Source(custom, topics, tuple(storages))


def _storage(file: Path) -> McapReader | Sqlite3Reader:
    kind = magic(file) or ("sqlite3" if file.suffix == ".db3" else "mcap")
    return Sqlite3Reader(file) if kind == "sqlite3" else McapReader(file)


def _chunks(storage: McapReader, wanted: Collection[int], start: int = 0, stop: int = 1 << 63) -> Iterator[Piece]:
    """Yield every chunk that holds wanted messages between two log times in ns, unpacked and checked."""
    with File(Path(storage.path)) as file:
        for info in sorted(storage.chunks, key=lambda info: info.chunk_start_offset):
            if info.channel_count and not any(info.channel_count.get(channel) for channel in wanted):
                continue
            if start <= info.message_end_time and info.message_start_time < stop:
                yield chunk_at(file, info.chunk_start_offset)


def _blocks(storage: McapReader | Sqlite3Reader, wanted: Mapping[int, Connection]) -> Iterator[Block]:
    """Yield the messages of some topics, a block for each topic of each chunk."""
    chunked = isinstance(storage, McapReader) and storage.chunks
    for piece in _chunks(storage, wanted) if chunked else _batches(storage, wanted):
        for channel, link in wanted.items():
            if (keep := piece.channel == channel).any():
                yield Block(link.topic, piece.time[keep], piece.content, piece.start[keep], piece.end[keep])


def _batches(
    storage: McapReader | Sqlite3Reader,
    wanted: Mapping[int, Connection],
    start: int | None = None,
    stop: int | None = None,
) -> Iterator[Piece]:
    """Messages as the library finds them, joined."""
    held: list[tuple[int, int, bytes]] = []
    size = 0
    for link, time, data in storage.messages(list(wanted.values()), start, stop):
        held.append((link.id, time, data))
        size += len(data)
        if len(held) == _BLOCK or size > _BYTES:
            yield piece_of(held)
            held, size = [], 0
    if held:
        yield piece_of(held)


def _decompressed(block: Block) -> Block:
    """Return the block with every message unpacked that was compressed by itself."""
    contents = [unpacked(block.message(index)) for index in range(len(block.start))]
    end = np.cumsum([len(content) for content in contents])
    return Block(block.topic, block.received, b"".join(contents), np.append(0, end[:-1]), end)
