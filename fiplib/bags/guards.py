"""Guards of everything that reads a recording: regular files only, none outside the bag, and bounded memory and time.

A file may be hostile as well as damaged: a pipe never ends, a device has no size, a few bytes of YAML or of compressed
data may stand for terabytes. What a guard refuses is a ``BagError`` or a ValueError that says what it met.
"""

import io
import os
import stat
from collections.abc import Iterator
from pathlib import Path, PurePath
from typing import Any, TextIO

from ruamel.yaml import YAML
from ruamel.yaml.events import AliasEvent, CollectionEndEvent, CollectionStartEvent, ScalarEvent

from fiplib.recording import BagError

WORDS = 1 << 22
"""Bytes of YAML that a bag may say about itself: some thousand topics take a tenth of it."""
DEEPEST, MOST = 64, 1_000_000
"""Levels of YAML, and values in it once its aliases are written out."""
LINE = 1 << 20
"""Characters in a line of a table."""
UNPACKED = 1 << 29
"""Bytes of a message or a chunk."""
RATIO, ROOM = 100, 1 << 30
"""A file that was compressed as a whole may grow by so much: a factor, or so many bytes. Poses shrink to a half."""


def regular(file: Path) -> Path:
    """Return the path of a regular file, links followed. Raises BagError: a device, pipe or socket may never end."""
    try:
        mode = file.stat().st_mode
    except OSError as error:
        raise BagError(f"{file}: {_reason(error)}") from error
    if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
        raise BagError(f"{file}: a device, pipe or socket, not a file: copy what it gives into a file first")
    return file


def recording(path: Path) -> None:
    """Raise BagError unless a path leads to a regular file, or to a folder in which everything read is one."""
    if not os.path.lexists(path):
        raise BagError(f"{path}: no such file or directory")
    regular(path)
    if path.is_dir():
        for file in path.iterdir():
            if file.suffix in (".yaml", ".mcap", ".db3", ".zst", ".zstd") and not file.is_dir():
                regular(file)


def inside(folder: Path, name: str) -> Path:
    """Return the file in a bag that its metadata name; only the last part of the name counts.

    Raises BagError: the file is a link that leads out of the bag.
    """
    file = folder / PurePath(str(name)).name
    if file.is_symlink() and not file.resolve().is_relative_to(folder.resolve()):
        raise BagError(
            f"{file}: a link that leads out of the bag, which is not followed: give the file itself, {file.resolve()}"
        )
    return file


def words(source: Path | str) -> Any:
    """Return the content of YAML, a file or text. Raises ValueError: it is too large, too deep, or explodes."""
    if isinstance(source, Path):
        with regular(source).open("rb") as stream:
            text = stream.read(WORDS + 1).decode()
    else:
        text = source
    if len(text) > WORDS:
        raise ValueError(f"more than {WORDS >> 20} MB of YAML")
    sizes, anchors, opened = [0], {}, []  # values below each open level; below each anchor, written out
    for event in YAML(typ="safe").parse(text):
        if isinstance(event, CollectionStartEvent):
            opened.append(event.anchor)
            sizes.append(1)
        elif isinstance(event, CollectionEndEvent):
            size, anchor = sizes.pop(), opened.pop()
            anchors[anchor] = size
            sizes[-1] += size
        elif isinstance(event, AliasEvent):
            if event.anchor not in anchors:
                raise ValueError("YAML with an alias of nothing, or of itself")
            sizes[-1] += anchors[event.anchor]
        elif isinstance(event, ScalarEvent):
            anchors[event.anchor] = 1
            sizes[-1] += 1
        if len(sizes) > DEEPEST or max(sizes) > MOST:
            raise ValueError("YAML that is nested too deep, or that its aliases make explode")
    return YAML(typ="safe").load(text)


def lines(stream: TextIO) -> Iterator[str]:
    """Yield the lines of a text. Raises ValueError for one that is longer than ``LINE``."""
    while line := stream.readline(LINE):
        if len(line) == LINE:
            raise ValueError(f"a line of more than {LINE >> 20} MB")
        yield line


def copied(packed: io.BufferedIOBase, target: io.BufferedIOBase, source: Path) -> None:
    """Unpack a stream, that of the file ``source``, into another. Raises BagError if that makes it too large."""
    most = left = max(RATIO * source.stat().st_size, ROOM)
    while block := packed.read1(1 << 20):
        left -= len(block)
        if left < 0:
            raise BagError(f"{source}: compressed data that unpack to more than {most >> 20} MB: no recording")
        target.write(block)


def _reason(error: OSError) -> str:
    return (error.strerror or str(error)).lower()
