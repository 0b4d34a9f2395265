"""A stretch of a bag keeps every topic and every byte of its messages, in either storage, and costs no memory."""

import subprocess
import sys
from operator import itemgetter
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import CompressionMode, Reader, StoragePlugin

from fiplib.bags import copying, cut, read, recover
from fiplib.bags import messages as layouts
from fiplib.recording import BagError
from tests.bags.test_bags import PERIOD, Numbers, foreign, mcap, poses, write

ROOT = Path(__file__).parents[2]
BLOB = "std_msgs/msg/ByteMultiArray"
TYPES = layouts.typestore().types


def blobs(count: int, size: int) -> list[tuple[str, str, int, bytes]]:
    """Pictures, as a camera sends them: every tenth frame, of bytes that nothing compresses."""
    picture = np.random.default_rng(0).integers(0, 256, size, np.uint8)
    message = TYPES[BLOB](TYPES["std_msgs/msg/MultiArrayLayout"]([], 0), picture)
    data = bytes(layouts.typestore().serialize_cdr(message, BLOB))
    return [("/camera", BLOB, 10**18 + index * 10 * PERIOD, data) for index in range(count)]


def found(bag: Path) -> list[tuple[str, str, int, bytes]]:
    """All messages of a bag as the library finds them."""
    with Reader(bag) as reader:
        messages = [(link.topic, link.msgtype, time, bytes(data)) for link, time, data in reader.messages()]
    return sorted(messages)


@pytest.mark.parametrize(
    ("storage", "mode"),
    [
        (StoragePlugin.MCAP, None),
        (StoragePlugin.MCAP, CompressionMode.MESSAGE),
        (StoragePlugin.MCAP, CompressionMode.FILE),
        (StoragePlugin.SQLITE3, None),
    ],
)
def test_a_stretch_holds_the_messages_of_its_time_with_their_bytes(tmp_path, storage, mode):
    recorded = poses("/mocap/quad/pose", count=480) + poses("/mocap/pendulum/pose", count=480) + blobs(48, 3000)
    recorded.sort(key=itemgetter(2))
    source = foreign(tmp_path / "lab", recorded, storage, {"operator": "somebody"}, mode)
    before = {file.name: file.read_bytes() for file in source.iterdir()}
    cutting = cut(source, start=0.5, end=1.5)
    zero = 10**18 + 10  # when the first pose was logged
    wanted = sorted(one for one in recorded if zero + 5 * 10**8 <= one[2] <= zero + 15 * 10**8)
    assert cutting.output == tmp_path / "lab-cut" and cutting.zero == "the first pose"
    if mode == CompressionMode.MESSAGE:  # unpacked: the new bag is compressed in chunks
        assert not any(data.startswith(layouts.ZSTD) for *_, data in found(cutting.output))
    assert found(cutting.output) == wanted and sum(cutting.counts.values()) == len(wanted) > 400
    assert [file.suffix for file in sorted(cutting.output.iterdir())] == [
        ".db3" if storage == StoragePlugin.SQLITE3 else ".mcap",
        ".yaml",
    ]
    assert {file.name: file.read_bytes() for file in source.iterdir()} == before
    flight = read(cutting.output)
    assert flight.metadata["operator"] == "somebody" and flight.duration == pytest.approx(1.0, abs=2 / 240)
    assert flight.metadata["cut"]["from"] == "lab" and flight.metadata["cut"]["start"] == 0.5


def test_a_recorded_flight_is_cut_twice_and_stays_genuine(tmp_path):
    source = write(tmp_path / "flight", Numbers(frames=480))
    once = cut(source, tmp_path / "once", 0.5).output
    twice = read(cut(once, tmp_path / "twice", end=0.5).output)
    assert twice.simulated and twice.metadata["cut"]["before"]["from"] == "flight"
    whole = read(source)
    first = int(np.argmax(whole.vehicle.received >= whole.vehicle.received[0] + 5 * 10**8))
    np.testing.assert_array_equal(twice.vehicle.position, whole.vehicle.position[first : first + 121])


def test_a_bag_that_is_no_flight_is_cut_from_its_first_message(tmp_path):
    source = foreign(tmp_path / "lab", blobs(24, 100))
    cutting = cut(source, start=0.25, end=0.5)
    assert cutting.counts == {"/camera": 6} and cutting.zero == "the first message"
    assert "/camera" in cutting.describe() and f"from       {source} (unchanged)" in cutting.describe()


def test_what_cannot_be_cut_says_so_and_leaves_nothing_behind(tmp_path):
    source = foreign(tmp_path / "lab", poses("/mocap/quad/pose", count=240) + poses("/mocap/pendulum/pose", count=240))
    for arguments, words in (
        ({"start": 2.0}, r"no message in that stretch: it ends 0\.996 s"),
        ({"start": 0.5, "end": 0.5}, "--to must be larger"),
        ({"end": -1.0}, "--to must be larger"),
        ({"start": -3.0, "end": -2.0}, "no message in that stretch"),
        ({"output": source / "new"}, "lies inside"),
        ({"topics": {"vehicle": "/nowhere"}}, "no topic /nowhere"),
    ):
        with pytest.raises(BagError, match=words):
            cut(source, **arguments)
    assert [path.name for path in tmp_path.iterdir()] == ["lab"]
    content = mcap(source).read_bytes()
    mcap(source).write_bytes(content[:-100])
    with pytest.raises(BagError, match=r"damaged or incomplete.*fip bag recover"):
        cut(source)


@pytest.mark.parametrize("what", [cut, recover])
def test_a_bag_that_does_not_read_back_as_it_was_written_is_no_success(tmp_path, monkeypatch, what):
    source = foreign(tmp_path / "lab", poses("/mocap/quad/pose", count=240) + poses("/mocap/pendulum/pose", count=240))
    close = copying.close_bag

    def on_a_failing_disk(writer, entries, counts):
        close(writer, entries, counts)
        file = writer.path / f"{writer.path.name}.mcap"
        content = bytearray(file.read_bytes())
        content[1000] ^= 1
        file.write_bytes(content)

    monkeypatch.setattr(copying, "close_bag", on_a_failing_disk)
    with pytest.raises(BagError, match="does not read back as it was written"):
        what(source, tmp_path / "new")
    assert not (tmp_path / "new").exists()


MEMORY = """
import resource, sys
from fiplib.__main__ import main
from fiplib.bags import read
kilobytes = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
read(sys.argv.pop(1))  # code and definitions, which every bag needs
before, status = kilobytes(), main(sys.argv[1:])
print(status, kilobytes() - before)
"""


@pytest.mark.parametrize(
    ("storage", "mode"),
    [(StoragePlugin.MCAP, CompressionMode.STORAGE), (StoragePlugin.MCAP, CompressionMode.MESSAGE),
     (StoragePlugin.SQLITE3, None)],
)  # fmt: skip
def test_a_camera_beside_the_poses_costs_no_memory(tmp_path, storage, mode):
    """128 MB of pictures; measured with 2.5 GB of them, no command took more than 0.2 GB in all."""
    small = foreign(tmp_path / "small", poses("/mocap/quad/pose") + poses("/mocap/pendulum/pose"))
    recorded = poses("/mocap/quad/pose", count=2400) + poses("/mocap/pendulum/pose", count=2400) + blobs(240, 1 << 19)
    source = foreign(tmp_path / "lab", sorted(recorded, key=itemgetter(2)), storage, compression=mode)
    commands = [("cut", source, "--from", 0.5, "--output", tmp_path / "cut"), ("info", source),
                ("export", source, "--what", "poses", "--to", tmp_path / "poses.csv")]  # fmt: skip
    if storage == StoragePlugin.MCAP:
        commands.append(("recover", source))
    for arguments in commands:
        command = [sys.executable, "-c", MEMORY, str(small), "bag", *map(str, arguments)]
        done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
        status, kilobytes = map(int, done.stdout.splitlines()[-1].split())
        # the solvers that info and export import take most of it
        assert status == 0 and kilobytes < 3 * 2**15, (arguments[0], done.stderr)
