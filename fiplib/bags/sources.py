"""Where the messages of a bag lie: one file or several, MCAP or sqlite3, compressed or not, with metadata.yaml or not.

Messages come in blocks, a chunk of the file at a time: what a bag needs in memory does not grow with its size.
"""

import shlex
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Connection
from rosbags.rosbag2.storage_mcap import McapReader
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

from fiplib.bags import guards
from fiplib.bags.mcap import File, chunk_at, embedded_metadata, places
from fiplib.bags.messages import ZSTD, unpacked, zstd
from fiplib.recording import BagError

_BLOCK = 4096  # messages in a block where the storage has no chunks, and their bytes
_BYTES = 1 << 22
_FILES = ("*.mcap", "*.db3", "*.mcap.zst*", "*.db3.zst*")


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
    """What a bag says about one topic."""

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
            if isinstance(storage, McapReader) and storage.chunks:
                found = _chunks(storage, wanted)
            else:
                found = _batches(storage, wanted)
            for block in found:
                yield _decompressed(block) if block.message(0).startswith(ZSTD) else block


@contextmanager
def opened(path: Path) -> Iterator[Source]:
    """Open a bag. Raises BagError, or whatever the libraries raise where it is damaged."""
    with ExitStack() as stack:
        information = _information(path)
        storages = []
        for file in _files(path, information):
            storage = _storage(_whole(file, stack))
            storage.open()
            stack.callback(storage.close)
            storages.append(storage)
        storages.sort(key=lambda storage: storage.metadata.start_time)
        spans = [storage.metadata for storage in storages]
        if not information and any(one.end_time > other.start_time + 1 for one, other in pairwise(spans)):
            raise _no_bag(path, f"{len(storages)}, which overlap in time")
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


def _information(path: Path) -> Mapping[str, Any]:
    """What metadata.yaml says; empty if there is none."""
    guards.recording(path)
    file = path / "metadata.yaml"
    if path.is_file() or not file.exists():
        return {}
    return dict(guards.words(file)["rosbag2_bagfile_information"])


def _files(path: Path, information: Mapping[str, Any]) -> list[Path]:
    if path.is_file():
        if is_ros1(path) or path.suffix.lower() in (".csv", ".tsv"):
            kind = "a bag of ROS 1" if is_ros1(path) else "a CSV file"
            raise BagError(f"{path}: {kind}; convert it into a ROS 2 bag with: {suggestion(path)}")
        if path.suffix not in (".mcap", ".db3", ".zst", ".zstd") and not _magic(path):
            raise BagError(f"{path}: not a bag; give the bag's directory or its .mcap file")
        return [path]
    files = [guards.inside(path, name) for name in information.get("relative_file_paths", ())]
    if not files or not all(file.is_file() for file in files):  # no metadata, or files that were renamed since
        files = sorted(file for pattern in _FILES for file in path.glob(pattern) if file.is_file())
    if not files:
        raise _no_bag(path, "0")
    return files


def is_ros1(path: Path) -> bool:
    """Whether a file is a bag of ROS 1, by its first bytes or its name."""
    return path.suffix == ".bag" or _magic(path) == "ros1"


def suggestion(path: Path) -> str:
    """The command that converts a recording of another kind."""
    return f"fip bag convert {shlex.quote(str(path))}"


def _no_bag(path: Path, count: str) -> BagError:
    return BagError(f"{path}: not a bag: neither metadata.yaml nor exactly one .mcap file (there are {count})")


def _magic(file: Path) -> str:
    """The kind of a file by its first bytes."""
    with file.open("rb") as stream:
        head = stream.read(16)
    kinds = {b"\x89MCAP0\r\n": "mcap", b"SQLite format 3\0": "sqlite3", b"#ROSBAG": "ros1", ZSTD: "zstd"}
    return next((kind for magic, kind in kinds.items() if head.startswith(magic)), "")


def _whole(file: Path, stack: ExitStack) -> Path:
    """The file, or its content in a temporary one if it was compressed as a whole."""
    if _magic(file) != "zstd":
        return file
    target = Path(stack.enter_context(TemporaryDirectory())) / file.stem
    with zstd.open(file, "rb") as packed, target.open("wb") as plain:
        guards.copied(packed, plain, file.stat().st_size)
    return target


def _storage(file: Path) -> McapReader | Sqlite3Reader:
    kind = _magic(file) or ("sqlite3" if file.suffix == ".db3" else "mcap")
    return Sqlite3Reader(file) if kind == "sqlite3" else McapReader(file)


def _chunks(storage: McapReader, wanted: Mapping[int, Connection]) -> Iterator[Block]:
    """Of every chunk that holds what is wanted, unpacked and checked, the places of its messages."""
    with File(Path(storage.path)) as file:
        for info in sorted(storage.chunks, key=lambda info: info.chunk_start_offset):
            if info.channel_count and not any(info.channel_count.get(channel) for channel in wanted):
                continue
            content = chunk_at(file, info.chunk_start_offset)
            for channel, (received, start, end) in places(content, wanted).items():
                yield Block(wanted[channel].topic, received, content, start, end)


def _batches(storage: McapReader | Sqlite3Reader, wanted: Mapping[int, Connection]) -> Iterator[Block]:
    """Messages as the library finds them, joined."""
    held: dict[str, tuple[list[int], list[bytes]]] = {link.topic: ([], []) for link in wanted.values()}
    size: Counter[str] = Counter()
    for link, log_time, data in storage.messages(list(wanted.values())):
        times, messages = held[link.topic]
        times.append(log_time)
        messages.append(data)
        size[link.topic] += len(data)
        if len(times) == _BLOCK or size[link.topic] > _BYTES:
            yield _joined(link.topic, times, messages)
            held[link.topic], size[link.topic] = ([], []), 0
    for topic, (times, messages) in held.items():
        if times:
            yield _joined(topic, times, messages)


def _joined(topic: str, received: Any, messages: list[bytes]) -> Block:
    end = np.cumsum([len(message) for message in messages])
    start = np.concatenate([[0], end[:-1]])
    return Block(topic, np.asarray(received, np.int64), b"".join(messages), start, end)


def _decompressed(block: Block) -> Block:
    """The block with every message unpacked that was compressed by itself."""
    return _joined(block.topic, block.received, [unpacked(block.message(i)) for i in range(len(block.start))])
