"""The files of a recording, and the kind of a file that is not one."""

import re
import shlex
from codecs import getincrementaldecoder
from collections import defaultdict
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory
from typing import Any

from fiplib.bags import guards
from fiplib.bags.mcap import profile
from fiplib.bags.messages import ZSTD, zstd
from fiplib.recording import BagError

_KINDS = {
    b"\x89MCAP0\r\n": "mcap",
    b"SQLite format 3\0": "sqlite3",
    b"#ROSBAG": "ros1",
    ZSTD: "zstd",
    b"PK\x03\x04": "zip",
    b"\x1f\x8b": "gzip",
    b"\x89HDF": "hdf5",
    b"MATLAB 5.0": "matlab",
    b"ULog": "ulog",
}
_NAMES = {
    "zip": "a ZIP archive: unpack it first",
    "gzip": "compressed by gzip: unpack it first",
    "hdf5": "an HDF5 file, not a bag",
    "matlab": "a MATLAB file, not a bag",
    "ulog": "a PX4 log (ULog), not a bag",
}
_SUFFIXES = (".mcap", ".db3", ".zst", ".zstd")


def information_of(path: Path) -> Mapping[str, Any]:
    """Return what metadata.yaml says; empty if there is none."""
    guards.recording(path)
    file = path / "metadata.yaml"
    if path.is_file() or not file.exists():
        return {}
    return dict(guards.words(file)["rosbag2_bagfile_information"])


def named_files(information: Mapping[str, Any]) -> list[str]:
    """Return the names of the files that metadata.yaml names, without folders: no name leads out of the bag."""
    return [PurePath(name).name for name in information.get("relative_file_paths") or ()]


def files_of(path: Path, information: Mapping[str, Any], missing: list[str] | None = None) -> list[Path]:
    """Return the files of a recording, and none of another one in the same folder.

    They are those that metadata.yaml names. Where it is lost, or its names are no longer those of the files, they are
    the files of one name, numbered or not.

    Args:
        path: the bag's directory, or one file.
        information: what metadata.yaml says.
        missing: takes the names of files that are gone; without it they are an error.

    Raises:
        BagError: there is no such file, or several recordings are in the folder, or some files are gone.
    """
    if path.is_file():
        if path.suffix not in _SUFFIXES or magic(path) == "ros1":
            name_what_it_is(path)
        return [path]
    present = sorted(file for file in path.iterdir() if file.suffix in _SUFFIXES and file.is_file())
    names = named_files(information)
    named = [next((file for file in present if _plain(file.name) == _plain(name)), None) for name in names]
    if files := [guards.inside(path, file.name) for file in named if file]:
        if gone := [name for name, file in zip(names, named, strict=True) if file is None]:
            if missing is None:
                raise BagError(
                    f"{path}: {', '.join(gone)} of its files is not there: bring it back, or make a bag of the others "
                    f"with: fip bag recover {shlex.quote(str(path))}"
                )
            missing += gone
        return files
    if not present:
        raise _no_bag(path)
    if names and len(present) == len(names):  # all of them renamed
        return present
    recordings = defaultdict(list)
    for file in present:
        recordings[_recording(file.name)].append(file)
    chosen = recordings.get(path.resolve().name) or (present if len(recordings) == 1 else None)
    if chosen is None:
        raise BagError(
            f"{path}: holds files of {len(recordings)} recordings ({', '.join(sorted(recordings))}) and no "
            f"metadata.yaml that says which: give one of the files, for example {shlex.quote(str(present[0]))}"
        )
    return chosen


def _plain(name: str) -> str:
    """Return the name of a file before it was compressed as a whole."""
    return re.sub(r"\.zstd?$", "", name)


def _recording(name: str) -> str:
    """Return the name of a recording by that of one of its files: ``lab`` for ``lab_3.mcap.zstd``."""
    return re.sub(r"(_\d+)?(\.(mcap|db3))?(\.zstd?)?$", "", name)


def _no_bag(path: Path) -> BagError:
    others = sorted(file for file in path.glob("*.bag") if file.is_file())
    if others:
        return BagError(f"{path}: holds a bag of ROS 1; convert it into a ROS 2 bag with: {suggestion(others[0])}")
    return BagError(f"{path}: not a bag: no .mcap and no .db3 file is in it")


def is_ros1(path: Path) -> bool:
    """Return whether a file is a bag of ROS 1, by its first bytes or its name."""
    return path.suffix == ".bag" or magic(path) == "ros1"


def suggestion(path: Path) -> str:
    """Return the command that converts a recording of another kind."""
    return f"fip bag convert {shlex.quote(str(path))}"


def magic(file: Path) -> str:
    """Return the kind of a file by its first bytes; empty if they are no known one's."""
    with file.open("rb") as stream:
        head = stream.read(16)
    return next((kind for start, kind in _KINDS.items() if head.startswith(start)), "")


def name_what_it_is(file: Path) -> None:
    """Raise BagError if a file is a sound one of another kind: damaged is said only of what is a bag."""
    kind = magic(file)
    if kind == "mcap":
        try:
            word = profile(file)
        except (ValueError, OSError):
            return
        if word != "ros2":
            raise BagError(
                f"{file}: an MCAP file of {f'the profile {word!r}' if word else 'no profile'}, not of ROS 2. What it "
                f"holds of ROS 2, if anything, into a new bag: fip bag recover {shlex.quote(str(file))}"
            )
    elif is_ros1(file) or file.suffix.lower() in (".csv", ".tsv"):
        words = "a bag of ROS 1" if is_ros1(file) else "a CSV file"
        raise BagError(f"{file}: {words}; convert it into a ROS 2 bag with: {suggestion(file)}")
    elif kind in _NAMES:
        raise BagError(f"{file}: {_NAMES[kind]}")
    elif words := _text(file):
        raise BagError(f"{file}: {words}, not a bag; give the bag's directory or its .mcap file")
    elif not kind and file.suffix not in _SUFFIXES:
        raise BagError(f"{file}: not a bag; give the bag's directory or its .mcap file")


def _text(file: Path) -> str:
    """Return the kind of text that a file holds; empty if it is not text."""
    with file.open("rb") as stream:
        head = stream.read(512)
    if not head:
        return "an empty file"
    try:
        words = getincrementaldecoder("utf-8-sig")().decode(head).strip()
    except UnicodeDecodeError:
        return ""
    if not words or not all(letter.isprintable() or letter in "\t\r\n" for letter in words):
        return ""
    return "a JSON file" if words[0] in "{[" else "an XML file" if words[0] == "<" else "a text file"


def plain(file: Path, stack: ExitStack, damaged: bool = False) -> Path:
    """Return the file, or its content in a temporary one if it was compressed as a whole.

    ``damaged`` says that what comes before a damaged byte is enough.
    """
    if magic(file) != "zstd":
        return file
    target = Path(stack.enter_context(TemporaryDirectory())) / file.stem
    with zstd.open(file, "rb") as packed, target.open("wb") as content:
        try:
            guards.copied(packed, content, file)
        except (zstd.ZstdError, EOFError):
            if not damaged:
                raise
    return target
