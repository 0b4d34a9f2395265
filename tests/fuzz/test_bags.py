"""Damaged bags, at random: read, described, measured or recovered, or refused in one sentence; nothing else."""

import random
import shutil
import struct
import warnings
from pathlib import Path

import numpy as np
import pytest

from fiplib import bags
from fiplib.bags import guards
from fiplib.bags.info import describe
from fiplib.bags.messages import zstd
from fiplib.estimators.poses.estimate import length_of
from fiplib.estimators.poses.knowledge import Knowledge
from fiplib.params import NANO
from fiplib.recording import BagError
from tests.fuzz.budget import tried

EPOCH = 1_767_225_600 * NANO


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """A small bag of several chunks, with our metadata, events and lengths."""
    path = tmp_path_factory.mktemp("whole") / "small"
    rng = np.random.default_rng(0)
    with bags.BagRecorder(
        path, {"origin": "simulated", "seed": 3, "params": {"pendulum": {"length": 0.8}}}
    ) as recorder:
        for frame in range(700):
            stamp = EPOCH + frame * NANO // 240
            lean = 0.02 * np.sin(frame / 40)
            recorder.pose("vehicle", stamp, stamp, (lean, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0))
            recorder.pose("pendulum", stamp, stamp, (2 * lean + 1e-4 * rng.normal(), 0.0, 1.5), (0.0, 0.0, 0.0, 1.0))
            if frame % 2 == 0:
                recorder.numbers("state", stamp, [lean] * 10)
                recorder.command(stamp, (lean, 0.0, 0.0), 0.2)
            if frame % 100 == 0:
                recorder.event(stamp, "info", "a push", "push", {"impulse": [0.01, 0.0], "duration": 0.1})
                recorder.length(stamp, 1.0, 0.9, 0.1)
    return path


def damaged(content: bytes, rng: random.Random) -> tuple[bytes, str]:
    """A file with one kind of damage, and its name."""
    size = len(content)
    at, length = rng.randrange(size), rng.choice((1, 8, 100, 4096))
    other = rng.randrange(size)
    kind = rng.choice(("cut", "head lost", "bits", "zeros", "noise", "swap", "repeat", "remove", "length", "insert"))
    if kind == "cut":
        content = content[:at]
    elif kind == "head lost":
        content = content[at:]
    elif kind == "bits":
        flipped = bytearray(content)
        for _ in range(rng.choice((1, 1, 1, 10, 1000))):
            flipped[rng.randrange(size)] ^= 1 << rng.randrange(8)
        content = bytes(flipped)
    elif kind == "zeros":
        content = content[:at] + bytes(min(length, size - at)) + content[at + length :]
    elif kind == "noise":
        content = content[:at] + rng.randbytes(min(length, size - at)) + content[at + length :]
    elif kind == "swap":
        first, second = sorted((at, other))
        length = min(length, second - first, size - second)
        one, two = content[first : first + length], content[second : second + length]
        content = content[:first] + two + content[first + length : second] + one + content[second + length :]
    elif kind == "repeat":
        content = content[: at + length] + content[at:]
    elif kind == "remove":
        content = content[:at] + content[at + length :]
    elif kind == "insert":
        content = content[:at] + rng.randbytes(length) + content[at:]
    else:  # what looks like a length becomes another one
        value = rng.choice((0, 1, 255, 2**16, 2**31 - 1, 2**32 - 1, 2**40, 2**63, 2**64 - 1))
        content = content[:at] + struct.pack("<Q", value)[: rng.choice((4, 8))] + content[at + 8 :]
    return content, f"{kind} at {at}"


def records(content: bytes) -> list[bytes]:
    """The records of an undamaged MCAP file, between its magic bytes."""
    found, at = [], 8
    while at < len(content) - 8:
        (length,) = struct.unpack_from("<Q", content, at + 1)
        found.append(content[at : at + 9 + length])
        at += 9 + length
    return found


def reordered(content: bytes, rng: random.Random) -> tuple[bytes, str]:
    """The same with whole records lost, twice, or in another order; or with a chunk of hostile content."""
    parts = records(content)
    one, two = rng.randrange(len(parts)), rng.randrange(len(parts))
    kind = rng.choice(("records swapped", "record lost", "record twice", "other opcode", "hostile chunk"))
    if kind == "records swapped":
        parts[one], parts[two] = parts[two], parts[one]
    elif kind == "record lost":
        del parts[one]
    elif kind == "record twice":
        parts.insert(two, parts[one])
    elif kind == "other opcode":
        parts[one] = bytes([rng.randrange(256)]) + parts[one][1:]
    else:
        inner = rng.choice((b"", rng.randbytes(200), bytes(10_000), b"".join(parts[:3])))
        packed = zstd.compress(inner)
        claimed = rng.choice((len(inner), 0, 1, 2**40, 2**63))
        body = struct.pack("<QQQI", 0, 2**63 - 1, claimed, 0) + struct.pack("<I", 4) + b"zstd"
        body += struct.pack("<Q", len(packed)) + packed
        parts.insert(one, b"\x06" + struct.pack("<Q", len(body)) + body)
    return content[:8] + b"".join(parts) + content[-8:], f"{kind}: {one}, {two}"


def treated(path: Path, output: Path) -> str:
    """Do with a bag all that one can; each step answers, or refuses in one sentence."""
    said = []
    try:
        flight = bags.read(path)
        assert np.isfinite(flight.vehicle.position).all() and (np.diff(flight.vehicle.stamp) > 0).all()
        describe(flight)
        said.append("read")
        length_of(flight, Knowledge.of_flight(flight))
    except BagError as error:
        refused(error, path)
        said.append("refused")
    try:
        bags.recover(path, output)
        said.append("recovered")
        try:
            bags.read(output)
        except BagError as error:  # what is left may be no flight
            refused(error, output)
    except BagError as error:
        refused(error, path)
    return " ".join(said)


def refused(error: BagError, path: Path) -> None:
    words = str(error)
    assert str(path) in words and "\n" not in words and len(words) < 2000, words


@pytest.mark.fuzz
@pytest.mark.filterwarnings("error")
def test_a_damaged_bag_is_read_recovered_or_refused(whole, tmp_path):
    seen: set[str] = set()

    def check(rng: random.Random) -> str:
        folder = tmp_path / "bag" / "small"
        shutil.rmtree(tmp_path / "bag", ignore_errors=True)
        shutil.rmtree(tmp_path / "out", ignore_errors=True)
        shutil.copytree(whole, folder)
        done = []
        for _ in range(rng.choice((1, 1, 1, 2, 5))):
            file = folder / rng.choice(("small.mcap",) * 4 + ("metadata.yaml",))
            content = file.read_bytes()
            change = reordered if file.suffix == ".mcap" and not done and rng.random() < 0.3 else damaged
            content, what = change(content, rng) if content else (b"", "nothing")
            file.write_bytes(content)
            done.append(f"{file.name}: {what}")
        if rng.random() < 0.2:
            (folder / "metadata.yaml").unlink()
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            seen.add(treated(folder if rng.random() < 0.8 else folder / "small.mcap", tmp_path / "out"))
        return "; ".join(done)

    tried(check, "tests/fuzz/test_bags.py")
    assert guards.UNPACKED == 1 << 29  # no test before has left it changed
    assert seen
