"""A stretch of a bag as a new bag: every topic, every message with the bytes and the log time that it has."""

import json
import math
import shlex
from collections.abc import Mapping
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2.storage_mcap import McapReader

from fiplib.bags.copying import Copy
from fiplib.bags.messages import genuine
from fiplib.bags.roles import BODIES, places_of
from fiplib.bags.sources import Source, opened
from fiplib.params import NANO
from fiplib.recording import BagError

__all__ = ["Cutting", "cut"]


class Cutting(NamedTuple):
    """The result of ``cut``."""

    source: Path
    output: Path
    counts: Mapping[str, int]
    """Messages by topic."""
    start: float
    """First and last log time of what was written, in s after ``zero``."""
    end: float
    zero: str
    """The event at which the time is zero."""

    def describe(self) -> str:
        """Return a summary of the bag that was written, as lines of text."""
        width = max(len(topic) for topic in self.counts)
        return "\n".join([
            f"{'bag':<10} {self.output}",
            f"{'from':<10} {self.source} (unchanged)",
            f"{'cut':<10} {sum(self.counts.values())} messages, {self.start:.3f} to {self.end:.3f} s after {self.zero}",
            "",
            *(f"{topic:<{width}}  {count:>8}" for topic, count in sorted(self.counts.items())),
        ])  # fmt: skip


def cut(
    source: str | Path,
    output: str | Path | None = None,
    start: float = 0.0,
    end: float | None = None,
    topics: Mapping[str, str] | None = None,
) -> Cutting:
    """Write a stretch of a bag into a new one of the same storage (MCAP or sqlite3); the original is only read.

    Args:
        source: a bag's directory, or one of its files.
        output: the directory to create; by default beside the source, with ``-cut`` added to its name.
        start, end: in s of log time, counted from the first pose of vehicle and rod, as the times of a ``Flight`` are;
            where the bag does not hold them, from its first message. The last moment is part of the stretch, and None
            is the end of the bag.
        topics: names of topics that differ from the default, by role.

    Raises:
        BagError: the bag cannot be read, the stretch is empty, or the new bag cannot be written.
    """
    source = Path(source)
    name = source.stem if source.is_file() else source.resolve().name
    output = Path(output) if output else source.parent / f"{name}-cut"
    if source.is_dir() and output.resolve().is_relative_to(source.resolve()):
        raise BagError(f"{output}: lies inside {source}, which is to stay as it is: choose another --output")
    if not (math.isfinite(start) and math.isfinite(end or 0.0)):
        raise BagError(f"{source}: a stretch begins and ends at finite times, in s; without --to it goes to the end")
    if end is not None and not start < end:
        raise BagError(f"{source}: a stretch from {start:g} to {end:g} s is empty: --to must be larger than --from")
    try:
        with opened(source) as bag:
            return _written(source, bag, output, start, end, dict(topics or {}))
    except BagError:
        raise
    except OSError as error:
        raise BagError(f"{source}: cannot be cut ({error.strerror or error})") from error
    except Exception as error:  # the library raises a dozen kinds on damage
        words = " ".join(str(error).split())[:300] or type(error).__name__
        raise BagError(
            f"{source}: damaged or incomplete ({words}); what is left of it into a new bag, which can be cut: "
            f"fip bag recover {shlex.quote(str(source))}"
        ) from error


def _written(path: Path, bag: Source, output: Path, start: float, end: float | None, topics: dict[str, str]) -> Cutting:
    if not any(stored.count for stored in bag.topics.values()):
        raise BagError(f"{path}: holds no messages")
    zero, words = _zero(path, bag, topics)
    last = max(storage.metadata.end_time for storage in bag.storages)
    begin = zero + round(start * NANO)
    stop = last if end is None else zero + round(end * NANO) + 1
    if begin >= last or stop <= min(storage.metadata.start_time for storage in bag.storages):
        raise BagError(
            f"{path}: there is no message in that stretch: it ends {(last - 1 - zero) / NANO:.3f} s after {words}"
        )
    entries = {key: value for key, value in bag.custom.items() if key not in ("messages", "checksum")}
    if not genuine(bag.custom):
        raise BagError(f"{path}: the metadata were damaged or edited since the recording: restore the original")
    history: dict[str, Any] = {"from": path.resolve().name, "start": (begin - zero) / NANO, "end": (stop - zero) / NANO}
    if "cut" in entries:
        history["before"] = json.loads(entries["cut"])
    entries["cut"] = json.dumps(history)
    mcap = all(isinstance(storage, McapReader) for storage in bag.storages)
    times: list[int] = []
    with Copy(output, StoragePlugin.MCAP if mcap else StoragePlugin.SQLITE3) as copy:
        numbers = {
            id(storage): {
                link.id: copy.topic(
                    link.topic,
                    link.msgtype,
                    link.msgdef.data,
                    link.ext.offered_qos_profiles,
                    link.ext.serialization_format,
                )
                for link in storage.connections
            }
            for storage in bag.storages
        }
        for storage, piece in bag.pieces(begin, stop):
            copy.put(piece, numbers[id(storage)])
            times = [min([*times[:1], int(piece.time.min())]), max([*times[1:], int(piece.time.max())])]
        if not times:
            raise BagError(f"{path}: there is no message in that stretch")
        copy.finish(entries)
    first, latest = ((time - zero) / NANO for time in times)
    return Cutting(path, output, dict(copy.counts), first, latest, words)


def _zero(path: Path, bag: Source, topics: dict[str, str]) -> tuple[int, str]:
    """Return the log time in ns that times are counted from, and what it is."""
    with suppress(Exception):  # no bag of a flight, or one whose bodies must be named first
        places, _ = places_of(bag, path, topics)
        firsts = [next(iter(islice(bag.blocks([places[body].topic]), 1))).received.min() for body in BODIES]
        return int(min(firsts)), "the first pose"
    if topics:
        places_of(bag, path, topics)  # what is named must be there
    return min(storage.metadata.start_time for storage in bag.storages), "the first message"
