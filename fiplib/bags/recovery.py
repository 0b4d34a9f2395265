"""A new bag of what a damaged or unfinished recording still holds. Originals are only ever read."""

import functools
import json
import shlex
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, NamedTuple

from rosbags.rosbag2.storage_mcap import get_qos

from fiplib.bags import guards
from fiplib.bags.copying import Copy
from fiplib.bags.files import files_of, information_of, magic, name_what_it_is, plain
from fiplib.bags.mcap import Gap, Remains
from fiplib.bags.messages import SIDECAR, genuine
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
    """The result of ``recover``: what was saved and what was lost."""

    source: Path
    output: Path
    metadata: dict[str, str]
    """The metadata entries of the new bag."""
    saved: tuple[Saved, ...]
    gaps: tuple[Gap, ...]
    nameless: int
    """Messages of topics that a damaged chunk described, or that are not ROS 2: they are left out."""
    repeated: int
    """Messages that the recording holds once more: each is saved once."""
    unreadable: int
    """Messages that were compressed one by one and are damaged: they are left out."""
    missing: tuple[str, ...]
    """Files that metadata.yaml names and that are not there."""
    finished: bool
    """Whether the recording had been brought to its end."""
    start_ns: int
    """Log time of the first message saved."""
    end_ns: int

    @property
    def seconds(self) -> float:
        """From the first message saved to the last, in s."""
        return (self.end_ns - self.start_ns) / NANO

    @property
    def undamaged(self) -> bool:
        """Return whether there was nothing to recover: the new bag is a copy."""
        lost = self.gaps or self.nameless or self.repeated or self.unreadable or self.missing
        return self.finished and not lost and not any(topic.lost for topic in self.saved)

    def describe(self) -> str:
        """Return what was saved and what was lost, as lines of text."""
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
        if self.repeated:
            losses.append(f"nothing of {self.repeated} messages that were there twice: one of each is saved")
        if self.unreadable:
            losses.append(f"{self.unreadable} messages that were compressed one by one and are damaged")
        if self.missing:
            losses.append(f"the files {', '.join(self.missing)}, which are not there")
        if not self.finished:
            losses.append("what came after: the file ends before its recording did (by 1 s at most if that was killed)")
        if self.undamaged:
            return ["nothing: the recording is undamaged, and can be read as it is"]
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
    missing: list[str] = []
    files = _files(source, missing)
    name = source.stem if source.is_file() else source.resolve().name
    output = Path(output) if output else source.parent / f"{name}-recovered"
    if source.is_dir() and output.resolve().is_relative_to(source.resolve()):
        raise BagError(f"{output}: lies inside {source}, which is to stay as it is: choose another --output")
    with ExitStack() as stack:
        remains = _remains(files, stack)
        if not any(rest.counts for rest in remains):
            raise BagError(f"{source}: nothing to recover: {_nothing(files, remains)}")
        return _rewritten(source, output, sorted(remains, key=lambda rest: rest.start_ns), tuple(missing))


def intact_messages(source: Path) -> int:
    """Return how many messages ``recover`` would save."""
    with ExitStack() as stack:
        return sum(sum(rest.counts.values()) for rest in _remains(_files(source, []), stack))


def _files(source: Path, missing: list[str]) -> list[Path]:
    """The files of the recording that can be recovered. Raises BagError, which names what they are, if none can."""
    guards.recording(source)
    information: Mapping[str, Any] = {}
    with suppress(Exception):  # whatever YAML raises where it is damaged
        information = information_of(source)
    files = files_of(source, information, missing)
    for file in files:
        try:
            kind = magic(file)
        except OSError as error:
            raise BagError(f"{file}: cannot be opened ({error.strerror})") from error
        if kind == "sqlite3" or (file.suffix == ".db3" and kind != "mcap"):
            raise BagError(
                f"{file}: a sqlite3 bag, and recover mends MCAP alone. If it is sound, fip bag info "
                f"{shlex.quote(str(source))} reads it as it is; if not, SQLite's own tool saves what is left: "
                f"sqlite3 {shlex.quote(str(file))} .recover | sqlite3 new.db3"
            )
        if kind != "mcap":
            name_what_it_is(file)
    return files


def _remains(files: Sequence[Path], stack: ExitStack) -> list[Remains]:
    remains, seen = [], set()
    for file in files:
        try:
            remains.append(Remains(plain(file, stack, damaged=True), seen))
        except OSError as error:
            raise BagError(f"{file}: cannot be opened ({error.strerror})") from error
    return remains


def _nothing(files: Sequence[Path], remains: Sequence[Remains]) -> str:
    """Why nothing can be recovered."""
    if foreign := sorted({word for rest in remains for word in rest.foreign}):
        return f"its messages are {', '.join(foreign)}, not ROS 2"
    return "no complete message is left in it" if any(rest.magic for rest in remains) else "it is no MCAP recording"


def _qos(metadata: bytes) -> Sequence[Any]:
    """Return the quality of service that a channel was offered with; none where a damaged byte makes it unreadable."""
    try:
        return get_qos(metadata)
    except Exception:  # a length, a letter, a key, a number: whatever the damage hit
        return ()


def _rewritten(source: Path, output: Path, remains: Sequence[Remains], missing: tuple[str, ...]) -> Recovery:
    entries = _entries(source, remains)
    expected = json.loads(entries.pop("messages", "{}"))
    gaps = tuple(gap for rest in remains for gap in rest.gaps)
    finished = all(rest.finished for rest in remains)
    history = {"from": source.resolve().name, "finished": finished, "damaged_bytes": sum(gap.size for gap in gaps)}
    if "recovered" in entries:
        history["before"] = json.loads(entries["recovered"])
    entries["recovered"] = json.dumps(history)
    with Copy(output) as copy:
        for rest in remains:
            numbers = {
                channel: copy.topic(topic.name, topic.type, topic.definition, _qos(topic.metadata))
                for channel, topic in rest.topics.items()
            }
            for piece in rest.pieces():
                copy.put(piece, numbers)
        copy.finish(entries)
    counts, kinds = copy.counts, dict.fromkeys(expected, "unknown") | copy.topics
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
        sum(rest.repeated for rest in remains),
        copy.unreadable,
        missing,
        finished,
        min(rest.start_ns for rest in known),
        max(rest.end_ns for rest in known),
    )


def _entries(source: Path, remains: Sequence[Remains]) -> dict[str, str]:
    """Return the metadata of the recording, from the first place where they are undamaged."""
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
