"""A new bag of what a damaged or unfinished recording still holds. Originals are only ever read."""

import functools
import json
import shutil
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from rosbags.interfaces import Connection
from rosbags.rosbag2.storage_mcap import get_qos

from fiplib.bags import guards
from fiplib.bags.mcap import Gap, Remains
from fiplib.bags.messages import SIDECAR, definitions, genuine, unpacked
from fiplib.bags.writer import close_bag, open_bag
from fiplib.params import NANO
from fiplib.recording import BagError

__all__ = ["Recovery", "Saved", "intact_messages", "recover"]


class Saved(NamedTuple):
    """One topic of a recovered bag."""

    topic: str
    type: str
    count: int
    lost: int | None
    """How many messages are missing; None if what is left does not say how many there were."""


class Recovery(NamedTuple):
    """What ``recover`` saved, and what it could not."""

    source: Path
    output: Path
    metadata: dict[str, str]
    """The metadata entries of the new bag."""
    saved: tuple[Saved, ...]
    gaps: tuple[Gap, ...]
    nameless: int
    """Messages of topics that a damaged chunk described, or that are not ROS 2: they are left out."""
    finished: bool
    """Whether the recording had been brought to its end."""
    start_ns: int
    """Log time of the first message saved."""
    end_ns: int

    @property
    def seconds(self) -> float:
        """From the first message saved to the last, in s."""
        return (self.end_ns - self.start_ns) / NANO

    def describe(self) -> str:
        """What was saved and what was lost, in lines."""
        origin = self.metadata.get("origin", "unknown (nothing that is left says it)").strip('"')
        lines = [
            f"{'recovered':<10} {self.output}",
            f"{'from':<10} {self.source} (unchanged)",
            f"{'origin':<10} {origin}",
            f"{'saved':<10} {sum(topic.count for topic in self.saved)} messages, {self.seconds:.2f} s",
        ]
        lines += [f"{'lost' if not i else '':<10} {words}" for i, words in enumerate(self._losses())]
        width, kind = (max(len(topic[i]) for topic in self.saved) for i in (0, 1))
        lines += ["", f"{'topic':<{width}}  {'type':<{kind}}  {'messages':>8}  {'lost':>8}"]
        for topic in self.saved:
            lost = "?" if topic.lost is None else topic.lost
            lines.append(f"{topic.topic:<{width}}  {topic.type:<{kind}}  {topic.count:>8}  {lost:>8}")
        return "\n".join(lines)

    def _losses(self) -> Sequence[str]:
        losses = []
        for gap in self.gaps:
            if gap.index:
                where = "of the index at the end, which holds no messages"
            elif gap.start is None:
                where = "at the beginning"
            elif gap.end is None:
                where = f"after {(gap.start - self.start_ns) / NANO:.3f} s, to the end of the file"
            else:
                start, end = ((stamp - self.start_ns) / NANO for stamp in (gap.start, gap.end))
                where = f"between {start:.3f} and {end:.3f} s"
            losses.append(f"{gap.size} damaged bytes {where}")
        if self.nameless:
            losses.append(f"{self.nameless} messages of topics whose description was damaged, or that are not ROS 2")
        if not self.finished:
            losses.append("what came after: the file ends before its recording did (by 1 s at most if that was killed)")
        return losses or ["nothing"]


def recover(source: str | Path, output: str | Path | None = None) -> Recovery:
    """Write what is left of a recording into a new bag, whose metadata say under ``recovered`` what it was made from.

    Args:
        source: a bag's directory, or a bare .mcap file; it is not changed.
        output: the directory to create; by default beside the source, with ``-recovered`` added to its name.

    Raises:
        BagError: there is nothing to recover, or the new bag cannot be written.
    """
    source = Path(source)
    files = _files(source)
    name = source.stem if source.is_file() else source.resolve().name
    output = Path(output) if output else source.parent / f"{name}-recovered"
    if source.is_dir() and output.resolve().is_relative_to(source.resolve()):
        raise BagError(f"{output}: lies inside {source}, which is to stay as it is: choose another --output")
    remains = [_remains(file) for file in files]
    if not any(rest.counts for rest in remains):
        kind = "no complete message is left in it" if any(rest.magic for rest in remains) else "it is no MCAP recording"
        raise BagError(f"{source}: nothing to recover: {kind}")
    return _rewritten(source, output, sorted(remains, key=lambda rest: rest.start_ns))


def intact_messages(source: Path) -> int:
    """How many messages ``recover`` would save."""
    return sum(sum(_remains(file).counts.values()) for file in _files(source))


def _files(source: Path) -> list[Path]:
    guards.recording(source)
    files = [source] if source.is_file() else sorted(source.glob("*.mcap"))
    if not files:
        raise BagError(f"{source}: nothing to recover: there is no .mcap file in it")
    return files


def _remains(file: Path) -> Remains:
    try:
        return Remains(file)
    except OSError as error:
        raise BagError(f"{file}: cannot be opened ({error.strerror})") from error


def _qos(metadata: bytes) -> Sequence[Any]:
    """The quality of service that a channel was offered with; none where a damaged byte makes it unreadable."""
    try:
        return get_qos(metadata)
    except Exception:  # a length, a letter, a key, a number: whatever the damage hit
        return ()


def _rewritten(source: Path, output: Path, remains: Sequence[Remains]) -> Recovery:
    entries = _entries(source, remains)
    expected = json.loads(entries.pop("messages", "{}"))
    gaps = tuple(gap for rest in remains for gap in rest.gaps)
    finished = all(rest.finished for rest in remains)
    history = {"from": source.resolve().name, "finished": finished, "damaged_bytes": sum(gap.size for gap in gaps)}
    if "recovered" in entries:
        history["before"] = json.loads(entries["recovered"])
    entries["recovered"] = json.dumps(history)
    writer = open_bag(output)
    connections: dict[tuple[str, str], Connection] = {}
    counts: Counter[str] = Counter()
    try:
        for rest in remains:
            for topic in rest.topics.values():
                if topic[:2] not in connections:
                    connections[topic[:2]] = writer.add_connection(
                        topic.name,
                        topic.type,
                        msgdef=topic.definition,
                        rihs01=_type_hash(topic.type, topic.definition),
                        offered_qos_profiles=_qos(topic.metadata),
                    )
            for topic, log_time, data in rest.messages():
                writer.write(connections[topic[:2]], log_time, unpacked(data))
                counts[topic.name] += 1
        close_bag(writer, entries, counts)
    except BaseException as error:
        shutil.rmtree(output, ignore_errors=True)  # half a bag helps nobody
        if isinstance(error, OSError):
            raise BagError(f"{output}: cannot write the recovered bag ({error.strerror or error})") from error
        raise
    kinds = dict.fromkeys(expected, "unknown") | dict(connections.keys())
    saved = tuple(
        Saved(name, kinds[name], counts[name], expected[name] - counts[name] if name in expected else None)
        for name in sorted(kinds)
    )
    known = [rest for rest in remains if rest.counts]
    return Recovery(
        source,
        output,
        entries,
        saved,
        gaps,
        sum(rest.nameless for rest in remains),
        finished,
        min(rest.start_ns for rest in known),
        max(rest.end_ns for rest in known),
    )


@functools.cache
def _type_hash(kind: str, definition: str) -> str:
    """The hash by which ROS 2 names a message definition."""
    with suppress(Exception):  # a definition that the library cannot parse: no reader of bags needs the hash
        return definitions(kind, definition).hash_rihs01(kind)
    return f"RIHS01_{0:064}"


def _entries(source: Path, remains: Sequence[Remains]) -> dict[str, str]:
    """What the recording says about itself, from the first place where it is undamaged."""
    folder = source if source.is_dir() else source.parent
    places: list[Callable[[], Any]] = [functools.partial(getattr, rest, "entries") for rest in remains]
    if source.is_dir() or source.stem == folder.name:
        known = "rosbag2_bagfile_information"
        places.insert(0, lambda: guards.words(folder / "metadata.yaml")[known]["custom_data"])
        places.append(lambda: guards.words(folder / SIDECAR))
    for place in places:
        with suppress(Exception):  # whatever YAML and JSON raise where the file is absent or damaged
            if (entries := place()) and genuine(entries):
                words = {key: value if isinstance(value, str) else json.dumps(value) for key, value in entries.items()}
                return {key: value for key, value in words.items() if key != "checksum"}
    return {}
