"""Flight -> ROS 2 bag."""

import contextlib
import functools
import json
import signal
import struct
import threading
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from rosbags.interfaces import Connection
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer, WriterError

from fiplib.bags.messages import Layout, checksum, typestore, zstd
from fiplib.params import NANO
from fiplib.recording import JOINTS, LEVELS, LOG, ORIGINS, ROLES, BagError, Recorder


def open_bag(path: Path, storage: StoragePlugin = StoragePlugin.MCAP) -> Writer:
    """The library's writer of a new bag, compressed if MCAP. Raises BagError if it cannot be written there."""
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
    It stops for as long as the disk takes: ``live.LiveRecorder`` is the one for real time.

    Args:
        path: the directory to create.
        metadata: what a bag says about itself, ready for JSON: ``origin`` (``simulated``, ``real`` or ``unknown``),
            ``scenario``, ``seed``, ``version``, ``params`` (``Params.to_dict()``), and anything else.

    Raises:
        BagError: the path exists already, cannot be written, or the metadata are not fit.
    """

    _REORDER = 2048  # messages held back to be sorted, about 2 s of flight: more than any latency between two topics

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

    def event(
        self, stamp: int, level: str, text: str, kind: str = "note", data: Mapping[str, Any] | None = None
    ) -> None:
        if level not in LEVELS:
            raise BagError(f"{self.path}: no such level {level!r} of an event; levels are {', '.join(LEVELS)}")
        stamp = self._time(stamp)
        time = typestore().types["builtin_interfaces/msg/Time"](*divmod(stamp, NANO))
        try:
            words = json.dumps(data, separators=(",", ":"), allow_nan=False) if data else ""
        except (TypeError, ValueError) as error:
            raise BagError(f"{self.path}: the data of an event ({kind}) do not fit into JSON ({error})") from error
        message = typestore().types[LOG](time, LEVELS[level], "fip", text, words, kind, 0)
        self._put("events", stamp, bytes(typestore().serialize_cdr(message, LOG)))

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
        self._last = max(self._last, log_time)
        self._pending.append((log_time, role, data))
        if len(self._pending) >= 2 * self._REORDER:
            self._flush(self._REORDER)

    def _flush(self, keep: int) -> None:
        self._pending.sort(key=itemgetter(0))  # stable: messages of one instant keep the order of the calls
        ready = self._pending[: len(self._pending) - keep]
        del self._pending[: len(ready)]
        try:
            with _undisturbed():
                self._write(ready)
        except OSError as error:
            raise BagError(f"{self.path}: cannot write any further ({error})") from error

    def _write(self, messages: Iterable[tuple[int, str, bytes]]) -> None:
        for log_time, role, data in messages:
            if role not in self._connections:
                entry = ROLES[role]
                self._connections[role] = self._writer.add_connection(entry.topic, entry.type, typestore=typestore())
            self._writer.write(self._connections[role], log_time, data)
            self._counts[ROLES[role].topic] += 1

    def close(self) -> None:
        """Write what is pending, the index and the metadata."""
        with _undisturbed():
            self._flush(0)
            close_bag(self._writer, self._metadata, self._counts)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            self.event(self._last, "fatal", f"recording ended by {kind.__name__}")
        self.close()
