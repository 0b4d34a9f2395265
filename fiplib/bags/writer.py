"""Flight -> ROS 2 bag, chunk by chunk: whatever is killed meanwhile leaves a file that ``fip bag recover`` reads."""

import contextlib
import functools
import json
import os
import shutil
import signal
import struct
import tempfile
import threading
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from operator import itemgetter
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Self

from rosbags.interfaces import Connection
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer, WriterError
from rosbags.rosbag2.storage_mcap import write_channel, write_schema
from ruamel.yaml import YAML

from fiplib.bags.messages import SIDECAR, Layout, checksum, typestore, zstd
from fiplib.params import NANO
from fiplib.recording import JOINTS, LEVELS, LOG, ORIGINS, ROLES, BagError, Recorder

HOLD = NANO // 10
"""Messages wait for earlier ones of another topic so long, ns: a pose arrives within some 20 ms."""
CHUNK = NANO // 2
"""Log time from one chunk to the next, ns: with ``HOLD``, what a kill takes of a flight in virtual time."""
RESERVE = 4 << 20
"""Bytes kept for the end of the recording when the disk is full: the index of an hour, and more."""


def open_bag(path: Path, storage: StoragePlugin = StoragePlugin.MCAP) -> Writer:
    """Return the library's writer of a new bag, compressed if MCAP. Raises BagError if it cannot be written there."""
    try:
        # Version 8 of metadata.yaml is read by ROS 2 Humble, Iron, Jazzy and later alike.
        writer = Writer(path, version=8, storage_plugin=storage)
        if storage == StoragePlugin.MCAP:
            writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        writer.open()
    except (WriterError, OSError) as error:
        raise BagError(
            f"{path}: cannot record here ({error}); choose another path, or move the old bag away"
        ) from error
    if storage == StoragePlugin.MCAP:
        # The library leaves the CRC of a chunk empty: let zstd carry one, so that every reader notices a damaged byte.
        options = {zstd.CompressionParameter.checksum_flag: 1}
        writer.storage.compressor = functools.partial(zstd.compress, options=options)
    return writer


def close_bag(writer: Writer, entries: Mapping[str, str], counts: Mapping[str, int]) -> None:
    """Write index and metadata: the entries, and how many messages each topic must hold. Raises BagError."""
    entries = {**entries, "messages": json.dumps(dict(sorted(counts.items())))}
    for key, value in {**entries, "checksum": checksum(entries)}.items():
        writer.set_custom_data(key, value)
    try:
        writer.close()
    except OSError as error:
        raise BagError(f"{writer.path}: cannot finish the bag ({error})") from error


@contextlib.contextmanager
def _undisturbed() -> Iterator[None]:
    """Put off Ctrl-C and SIGTERM until the block is left: half a chunk is a damaged bag."""
    if threading.current_thread() is not threading.main_thread():  # where alone signals arrive
        yield
        return
    came: list[int] = []
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.signal(number, lambda number, frame: came.append(number)) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler or signal.SIG_DFL)
    for number in came[:1]:
        signal.raise_signal(number)


class BagRecorder(Recorder):
    """Writes one flight as a ROS 2 bag (a directory with one MCAP file and metadata.yaml); a context manager.

    Stamps are int nanoseconds, from 0 (or the epoch) on. Messages are written in the order of their log time: for a
    pose the time it was received, else the stamp. The same calls write the same bytes. Leaving the ``with`` block by
    an exception closes the bag properly too, with an event that says so: a flight that ended badly is worth reading.

    Every half second of log time a chunk is written that can be read without the others, and the metadata lie beside
    it until the bag is finished: a kill takes less than a second. A full disk ends the bag properly, and raises. It
    stops for as long as the disk takes: ``live.LiveRecorder`` is the one for real time.

    Args:
        path: the directory to create.
        metadata: what a bag says about itself, ready for JSON: ``origin`` (``simulated``, ``real`` or ``unknown``),
            ``scenario``, ``seed``, ``version``, ``params`` (``Params.to_dict()``), and anything else.

    Raises:
        BagError: the path exists already, cannot be written, or the metadata are not fit; later, the disk is full.
    """

    _sync = False
    _MOST = 4096  # messages that wait for a chunk

    def __init__(self, path: str | Path, metadata: Mapping[str, Any]) -> None:
        self.path = Path(path)
        if metadata.get("origin") not in ORIGINS:
            raise BagError(f"{path}: metadata must say an origin, one of {', '.join(ORIGINS)}")
        if reserved := {"messages", "checksum"} & set(metadata):
            raise BagError(f"{path}: the metadata key {min(reserved)!r} is written by the recorder itself: rename it")
        try:
            self._metadata = {key: json.dumps(value, allow_nan=False) for key, value in metadata.items()}
        except (TypeError, ValueError) as error:
            raise BagError(f"{path}: metadata do not fit into JSON ({error})") from error
        self._layouts = {
            role: Layout.of(entry.type, entry.frame, entry.names if entry.type == JOINTS else ())
            for role, entry in ROLES.items()
            if entry.type != LOG
        }
        self._connections: dict[str, Connection] = {}
        self._pending: list[tuple[int, str, bytes]] = []
        self._counts: Counter[str] = Counter()
        self._last = 0
        self._open()

    def _open(self) -> None:
        self._writer = open_bag(self.path)
        self._held: list[tuple[int, str, bytes]] = []
        self._begun: int | None = None  # log time of the chunk's first message
        self._storage: Any = self._writer.storage
        try:
            self._journal = self._storage.bio = _Journal(self._storage.bio, self._sync)
            self._journal.commit()
            # Without a name: gone with this process, however that ends.
            self._reserve = tempfile.TemporaryFile(dir=self.path)
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(self._reserve.fileno(), 0, RESERVE)
            else:
                self._reserve.write(bytes(RESERVE))
                self._reserve.flush()
            self._say_what_it_is()
            for folder in (self.path, self.path.parent):
                _sync(folder)
        except OSError as error:
            shutil.rmtree(self.path, ignore_errors=True)  # made a moment ago, and empty
            raise BagError(f"{self.path}: cannot record here ({error}); choose another path") from error

    def _say_what_it_is(self) -> None:
        part = self.path / "part.yaml"  # takes its name once it is whole
        with part.open("w", encoding="utf8") as stream:
            YAML(typ="safe").dump({**self._metadata, "checksum": checksum(self._metadata)}, stream)
            stream.flush()
            os.fsync(stream.fileno())
        part.replace(self.path / SIDECAR)

    def event(
        self, stamp: int, level: str, text: str, kind: str = "note", data: Mapping[str, Any] | None = None
    ) -> None:
        self._put("events", self._time(stamp), self._event(stamp, level, text, kind, data))

    def _event(
        self, stamp: int, level: str, text: str, kind: str = "note", data: Mapping[str, Any] | None = None
    ) -> bytes:
        """Return the message of an event."""
        if level not in LEVELS:
            raise BagError(f"{self.path}: no such level {level!r} of an event; levels are {', '.join(LEVELS)}")
        stamp = self._time(stamp)
        time = typestore().types["builtin_interfaces/msg/Time"](*divmod(stamp, NANO))
        try:
            words = json.dumps(data, separators=(",", ":"), allow_nan=False) if data else ""
        except (TypeError, ValueError) as error:
            raise BagError(f"{self.path}: the data of an event ({kind}) do not fit into JSON ({error})") from error
        message = typestore().types[LOG](time, LEVELS[level], "fip", text, words, kind, 0)
        return bytes(typestore().serialize_cdr(message, LOG))

    def _time(self, stamp: int) -> int:
        """A stamp as a plain int (NumPy's integers do not serialise), if it is one that a message can carry."""
        if not 0 <= stamp < 2**31 * NANO:
            raise BagError(f"{self.path}: the stamp {stamp} ns does not fit into a ROS time (0 to 2038)")
        return int(stamp)

    def numbers(self, role: str, stamp: int, values: Sequence[float], received: int | None = None) -> None:
        stamp = self._time(stamp)
        if received is not None and role not in ("vehicle", "pendulum"):
            raise BagError(f"{self.path}: no such body {role!r}; bodies are vehicle and pendulum")
        if role == "truth_length":  # travels as a point
            values = (*values, 0.0, 0.0)
        try:
            data = self._layouts[role].encode(stamp, values)
        except (struct.error, OverflowError, TypeError) as error:
            names = ", ".join(ROLES[role].names)
            raise BagError(f"{self.path}: cannot record {role} ({error}); it takes the numbers {names}") from error
        self._put(role, stamp if received is None else self._time(received), data)

    def _put(self, role: str, log_time: int, data: bytes) -> None:
        if self.failed:
            raise BagError(self.failed)
        self._last = max(self._last, log_time)
        self._begun = log_time if self._begun is None else self._begun
        self._pending.append((log_time, role, data))
        if abs(log_time - self._begun) < CHUNK and len(self._pending) < self._MOST:
            return
        self._begun = log_time
        try:
            with _undisturbed():
                self.commit()
        except OSError as error:
            self._stop(error.strerror or str(error))

    def _stop(self, words: str) -> None:
        """The disk takes no more: bring the bag to its end, with the reserve. Raises BagError, with ``failed``."""
        event = self._event(self._last, "error", f"recording stopped: {words}; what followed is lost")
        self._pending.append((self._last, "events", event))
        self.failed = f"{self.path}: recording stopped: {words}"
        try:
            self._finish()
            self.failed += "; the bag holds the flight up to there"
        except BagError:
            self.failed += f". The bag is not finished: fip bag recover {self.path}"
        raise BagError(self.failed)

    def commit(self, everything: bool = False) -> None:
        """Write a chunk of what has come. Raises OSError; nothing is lost by that, and it may be called again."""
        newest = max((message[0] for message in self._pending), default=0)
        ready, self._held = self._held, []
        for message in self._pending:
            # Nothing is held twice, wherever the clock has jumped to.
            (ready if everything or message[0] <= newest - HOLD else self._held).append(message)
        self._pending = []
        if ready:
            # Each chunk can be read without the others: it names its types and topics again.
            for schema in self._storage.schemas:
                write_schema(self._storage.chunk.bio, schema)
            for channel in self._storage.channels:
                write_channel(self._storage.chunk.bio, channel, self._storage.schemas)
            self._write(sorted(ready, key=itemgetter(0)))  # stable: messages of one instant keep the order of the calls
            if self._storage.chunk.bio.tell():  # it closes a chunk by itself once that holds a megabyte
                self._storage.close_chunk()
        self._journal.commit()

    def _write(self, messages: Iterable[tuple[int, str, bytes]]) -> None:
        for log_time, role, data in messages:
            if role not in self._connections:
                entry = ROLES[role]
                self._connections[role] = self._writer.add_connection(entry.topic, entry.type, typestore=typestore())
            self._writer.write(self._connections[role], log_time, data)
            self._counts[ROLES[role].topic] += 1

    def close(self) -> None:
        """Finish the bag. Raises BagError."""
        if not self.failed:
            self._finish()

    def _finish(self) -> None:
        """Write what waits, index and metadata, with the reserve where the disk is full. Raises BagError."""
        self._reserve.close()
        with _undisturbed():
            try:
                self.commit(everything=True)
            except OSError as error:
                raise BagError(f"{self.path}: cannot write any further ({error})") from error
            close_bag(self._writer, self._metadata, self._counts)
            with contextlib.suppress(OSError):
                _sync(self.path)
                (self.path / SIDECAR).unlink()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None and not self.failed:
            self.event(self._last, "fatal", f"recording ended by {kind.__name__}")
        self.close()


class _Journal:
    """Takes the place of the library's file: what is written reaches the disk by whole commits, or not at all."""

    def __init__(self, file: BinaryIO, sync: bool) -> None:
        file.flush()
        self._file, self._size, self._waiting = file, file.tell(), bytearray()
        self._syncing: Future[None] | None = None
        self._pool = ThreadPoolExecutor(1) if sync else None

    def write(self, data: bytes | memoryview) -> int:
        self._waiting += data
        return len(data)

    def tell(self) -> int:
        return self._size + len(self._waiting)

    def commit(self) -> None:
        """Write what waits, and let the disk sync beside. Raises OSError; the file then ends where it did before."""
        descriptor = self._file.fileno()
        try:
            with memoryview(self._waiting) as view:
                done = 0
                while done < len(view):
                    done += os.write(descriptor, view[done:])
        except OSError:
            os.ftruncate(descriptor, self._size)
            os.lseek(descriptor, self._size, os.SEEK_SET)
            raise
        self._size += done
        self._waiting.clear()
        # A card may take seconds to sync. What is written survives a kill at once, and a power cut once synced.
        if self._pool and (self._syncing is None or self._syncing.done()):
            last, self._syncing = self._syncing, self._pool.submit(os.fsync, descriptor)
            if last:
                last.result()

    def close(self) -> None:
        self.commit()
        if self._pool:
            self._pool.shutdown()
        os.fsync(self._file.fileno())
        self._file.close()


def _sync(folder: Path) -> None:
    """Let a folder's entries survive a power cut."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
