"""A recording in real time survives kills, full and stalled disks, and never disturbs the flight that it records."""

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from fiplib.bags import live, writer
from fiplib.bags.live import LiveRecorder
from fiplib.bags.messages import SIDECAR
from fiplib.bags.reader import read
from fiplib.bags.recovery import recover
from fiplib.recording import BagError
from tests.bags.test_bags import FRAMES, METADATA, PERIOD, Numbers, mcap, same, write

pytestmark = pytest.mark.realtime

ROOT = Path(__file__).parents[2]

# A flight script that records in real time for two minutes at most: poses of both bodies at 240 Hz and what belongs to
# them, stamped by the wall clock. It writes down what it has handed over, message by message.
SCRIPT = """
import resource, sys, time
from pathlib import Path
import numpy as np
from tests.bags.test_bags import METADATA, Numbers
from fiplib.bags import BagError
from fiplib.bags.live import LiveRecorder

folder, limit = Path(sys.argv[1]), int(sys.argv[2])
numbers = Numbers(frames=240)
noise = np.random.default_rng(0).bytes(1 << 16).hex()
if limit:
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
with open(folder / "handed", "w", buffering=1) as handed:
    try:
        with LiveRecorder(folder / "flight", METADATA) as bag:
            print(bag._process.pid, flush=True)
            index = 0
            while not (folder / "land").exists():
                now, k = time.time_ns(), index % 240
                for body in ("vehicle", "pendulum"):
                    bag.pose(body, now - 4_000_000, now, numbers.position[body][k], numbers.orientation[body][k])
                    handed.write(f"{body} {now}\\n")
                if index % 2 == 0:
                    bag.numbers("state", now, numbers.state[k // 2])
                    handed.write(f"state {now}\\n")
                if limit:
                    bag.event(now, "info", noise)
                if bag.failed and not index % 24:
                    print(bag.failed, flush=True)
                index += 1
                if index > 240 * 120:
                    break
                time.sleep(1 / 240)
    except BagError as error:
        print(f"landed: {error}", flush=True)
    else:
        print("landed", flush=True)
"""


class Script:
    """The script above as a process of its own, and the process that writes its bag."""

    def __init__(self, folder: Path, limit: int = 0) -> None:
        self.folder = folder
        path = str(ROOT)
        self.process = subprocess.Popen(
            [sys.executable, "-c", SCRIPT, str(folder), str(limit)],
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": path},
        )
        self.writer = int(self.process.stdout.readline())

    def handed(self) -> list[tuple[str, int]]:
        """Role and log time of all that was handed over."""
        lines = (self.folder / "handed").read_text().splitlines(keepends=True)
        return [(role, int(time)) for role, time in (line.split() for line in lines if line.endswith("\n"))]

    def fly(self, seconds: float) -> None:
        """Wait until so much was handed over."""
        while len(times := [time for _, time in self.handed()]) < 2 or times[-1] - times[0] < seconds * 1e9:
            assert self.process.poll() is None
            threading.Event().wait(0.05)


@pytest.fixture
def script(tmp_path: Path) -> Iterator[Script]:
    running = Script(tmp_path)
    yield running
    for pid in (running.process.pid, running.writer):
        try:
            os.kill(pid, signal.SIGKILL)
        except ProcessLookupError:
            pass
    running.process.wait()


def recorded(bag: Path) -> list[tuple[str, int]]:
    """Role and log time of every pose and state, as the independent reader finds and decodes them."""
    roles = {"/mocap/quad/pose": "vehicle", "/mocap/pendulum/pose": "pendulum", "/fip/state": "state"}
    with mcap(bag).open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        return [
            (roles[channel.topic], message.log_time)
            for _, channel, message, _ in reader.iter_decoded_messages()
            if channel.topic in roles
        ]


def loses_a_second_at_most(kept: list[tuple[str, int]], handed: list[tuple[str, int]]) -> bool:
    """Whether all that was handed over is there, but for what came in the last second before the end."""
    assert len(kept) > 100 and len(set(kept)) == len(kept)
    last = handed[-1][1]
    return set(handed) - set(kept) <= {(role, time) for role, time in handed if time > last - 1_000_000_000}


# --- killed --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seconds", [1.5, 2.1, 2.8])
def test_a_flight_killed_with_all_its_processes_loses_one_second_at_most(tmp_path: Path, seconds: float) -> None:
    running = Script(tmp_path)
    running.fly(seconds)
    os.kill(running.writer, signal.SIGKILL)
    running.process.kill()
    running.process.wait()
    bag = tmp_path / "flight"
    before = {file.name: file.read_bytes() for file in bag.iterdir()}
    assert set(before) == {"flight.mcap", SIDECAR}
    with pytest.raises(BagError, match=r"not finished.* intact.*fip bag recover"):
        read(bag)

    recovery = recover(bag)
    assert {file.name: file.read_bytes() for file in bag.iterdir()} == before
    assert recovery.output == tmp_path / "flight-recovered" and not recovery.finished
    flight, kept = read(recovery.output), recorded(recovery.output)
    assert loses_a_second_at_most(kept, running.handed())
    # rosbags, the independent reader and the report count the same
    counts = {"vehicle": flight.vehicle, "pendulum": flight.pendulum, "state": flight.state}
    assert {role: len(data.stamp) for role, data in counts.items()} == {
        role: sum(1 for one, _ in kept if one == role) for role in counts
    }
    assert sum(topic.count for topic in recovery.saved) == len(kept)
    # it still says what it is, and that it was recovered
    words = dict(flight.metadata)
    assert words.pop("recovered")["from"] == "flight"
    assert words == METADATA and flight.simulated and flight.params.pendulum.length == 0.8


def test_a_flight_whose_script_alone_is_killed_has_a_whole_bag(script: Script) -> None:
    script.fly(1.0)
    script.process.kill()
    script.process.wait()
    bag = script.folder / "flight"
    while not (bag / "metadata.yaml").exists() or (bag / SIDECAR).exists():
        threading.Event().wait(0.05)
    flight = read(bag)
    assert flight.events[-1].level == "fatal" and "script ended without a word" in flight.events[-1].text
    assert loses_a_second_at_most(recorded(bag), script.handed())
    assert "recovered" not in flight.metadata


def test_a_flight_goes_on_when_its_recording_is_killed(script: Script) -> None:
    script.fly(1.0)
    os.kill(script.writer, signal.SIGKILL)
    killed = script.handed()[-1][1]
    said = script.process.stdout.readline()
    assert "recording stopped: its process was killed" in said
    script.fly((killed - script.handed()[0][1]) / 1e9 + 0.3)
    (script.folder / "land").touch()
    landed = script.process.stdout.read().splitlines()[-1]
    assert "recover" in landed and "messages of the flight are missing" in landed
    assert script.process.wait() == 0
    recover(script.folder / "flight")
    kept = recorded(script.folder / "flight-recovered")
    assert loses_a_second_at_most(kept, [one for one in script.handed() if one[1] <= killed])


# --- full and stalled disks ----------------------------------------------------------------------------------------


def test_a_file_that_cannot_grow_stops_the_recording_and_not_the_flight(tmp_path: Path) -> None:
    """A limit on the size of files stands for a quota: the reserve cannot help, the bag stays unfinished."""
    running = Script(tmp_path, writer.RESERVE + 1000)
    said = running.process.stdout.readline()
    assert said.startswith(f"{tmp_path / 'flight'}: recording stopped: File too large")
    (tmp_path / "land").touch()
    landed = running.process.stdout.read().splitlines()[-1]
    assert landed.startswith("landed: ") and f"fip bag recover {tmp_path / 'flight'}" in landed
    assert running.process.wait() == 0
    recovery = recover(tmp_path / "flight")
    assert not recovery.gaps  # the file ends with its last whole chunk: nothing in it is damaged
    kept, handed = recorded(recovery.output), running.handed()
    assert kept and set(kept) <= set(handed)
    assert [one for one in handed if one[1] <= max(time for _, time in kept) - writer.HOLD] == [
        one for one in handed if one in set(kept) and one[1] <= max(time for _, time in kept) - writer.HOLD
    ]


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk that has room for the reserve and 1 MB."""
    disk = tmp_path / "disk"
    disk.mkdir()
    size = f"size={writer.RESERVE + (1 << 20)}"
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", size, "fip", str(disk)], capture_output=True, text=True)
    if mounted.returncode:
        pytest.skip(f"no small disk can be mounted here: {mounted.stderr.strip()}")
    yield disk
    subprocess.run(["umount", str(disk)], check=True)


def test_a_full_disk_ends_the_bag_properly_and_says_so(small_disk: Path) -> None:
    numbers, noise = Numbers(frames=20_000), np.random.default_rng(0)
    bag = LiveRecorder(small_disk / "flight", METADATA)
    flown = 0
    for i, stamp in enumerate(numbers.stamp.tolist()):
        for body in ("vehicle", "pendulum"):
            bag.pose(body, stamp, stamp, numbers.position[body][i], numbers.orientation[body][i])
        bag.event(stamp, "info", noise.bytes(1000).hex())
        flown += 1
        if bag.failed and bag.dropped > 1000:
            break
        threading.Event().wait(0.0002)
    assert bag.failed == f"{small_disk / 'flight'}: recording stopped: No space left on device"
    with pytest.raises(BagError, match=r"No space left on device \(at least \d+ messages of the flight are missing"):
        bag.close()
    flight = read(small_disk / "flight")  # no need to recover anything
    assert flight.events[-1][1:3] == ("error", "recording stopped: No space left on device; what followed is lost")
    kept = len(flight.vehicle.stamp)
    assert 100 < kept < flown and not (small_disk / "flight" / SIDECAR).exists()
    np.testing.assert_array_equal(flight.vehicle.position, numbers.position["vehicle"][:kept])
    assert flight.metadata == METADATA


def test_a_full_disk_is_noticed_before_the_flight(small_disk: Path) -> None:
    (small_disk / "old").write_bytes(bytes(2 << 20))
    with pytest.raises(BagError, match=r"cannot record here .*No space left"):
        LiveRecorder(small_disk / "flight", METADATA)
    assert not (small_disk / "flight").exists()


def test_a_stalled_disk_delays_nobody_and_loses_nothing(tmp_path: Path) -> None:
    """A stopped process takes nothing, like one that waits for its disk: two pipes' worth stay in memory."""
    numbers = Numbers()
    with LiveRecorder(tmp_path / "flight", METADATA) as bag:
        os.kill(bag._process.pid, signal.SIGSTOP)
        rescue = threading.Timer(60.0, os.kill, (bag._process.pid, signal.SIGCONT))  # else a failure would hang
        rescue.start()
        for i in range(20_000):
            bag.pose("vehicle", i, i, numbers.position["vehicle"][i % FRAMES], (0.0, 0.0, 0.0, 1.0))
            bag.pose("pendulum", i, i, numbers.position["pendulum"][i % FRAMES], (0.0, 0.0, 0.0, 1.0))
        assert len(bag._backlog) > 1 << 20 and bag.failed is None
        rescue.cancel()
        os.kill(bag._process.pid, signal.SIGCONT)
    assert len(read(tmp_path / "flight").vehicle.stamp) == 20_000


def test_a_disk_that_never_comes_back_stops_the_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "_BACKLOG", 1 << 16)
    bag = LiveRecorder(tmp_path / "flight", METADATA)
    monkeypatch.setattr(live, "_PATIENCE", 0.1)
    os.kill(bag._process.pid, signal.SIGSTOP)
    for i in range(30_000):
        bag.numbers("truth_length", i, [1.0])
    assert "the disk has taken nothing for long" in bag.failed and bag.dropped > 0
    with pytest.raises(BagError, match="not finished"):
        bag.close()
    os.kill(bag._process.pid, signal.SIGKILL)
    bag._process.wait()


# --- the bag -------------------------------------------------------------------------------------------------------


def test_a_live_bag_holds_what_an_ordinary_one_does(tmp_path: Path) -> None:
    numbers = Numbers(frames=1200)
    ordinary = read(write(tmp_path / "ordinary", numbers))
    live_bag = write(tmp_path / "live", numbers, recorder=LiveRecorder)
    assert sorted(os.listdir(live_bag)) == ["live.mcap", "metadata.yaml"]
    assert same(ordinary, read(live_bag))
    assert {info.topic for info in ordinary.topics} == {info.topic for info in read(live_bag).topics}


def test_messages_of_megabytes_make_a_sound_bag_too(tmp_path: Path) -> None:
    """The library closes a chunk by itself once it holds a megabyte, be it just before ours is due."""
    with LiveRecorder(tmp_path / "flight", METADATA) as bag:
        for i in range(5):
            bag.event(i, "info", "x" * (2 << 20))
    assert recover(tmp_path / "flight").gaps == ()
    with mcap(tmp_path / "flight").open("rb") as stream:
        assert all(chunk.message_index_length for chunk in make_reader(stream).get_summary().chunk_indexes)


def test_poses_that_arrive_late_are_sorted_in(tmp_path: Path) -> None:
    with LiveRecorder(tmp_path / "flight", METADATA) as bag:
        for i in range(0, 2000, 2):
            for k in (i + 1, i):  # every second one is a millisecond late
                bag.pose("vehicle", k * 10**6, k * 10**6, (k, 0, 0), (0, 0, 0, 1))
                bag.pose("pendulum", k * 10**6, k * 10**6, (k, 0, 0), (0, 0, 0, 1))
    np.testing.assert_array_equal(read(tmp_path / "flight").vehicle.position[:, 0], np.arange(2000.0))


def test_a_clock_that_jumps_holds_nothing_back(tmp_path: Path) -> None:
    """A log time far ahead is not waited for: the recording after it reaches the disk like that before."""
    bag = live._Bag(tmp_path / "flight", METADATA)
    times = [10**9, 2 * 10**9, 10**18, 3 * 10**9, 4 * 10**9]
    for time in times:
        bag.numbers("truth_length", time, [1.0])
        bag.commit()
    bag.commit()
    bag._reserve.close()
    bag._journal._pool.shutdown()
    assert sum(topic.count for topic in recover(tmp_path / "flight").saved) == len(times)


def test_what_does_not_fit_is_dropped_counted_and_named_in_the_bag(tmp_path: Path) -> None:
    with LiveRecorder(tmp_path / "flight", METADATA) as bag:
        for i in range(5):
            for body in ("vehicle", "pendulum"):
                bag.pose(body, i, i, (float(i), 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
        bag.numbers("state", 4, np.zeros(9))
        bag.pose("vehicle", 4, 4, None, (0.0, 0.0, 0.0, 1.0))
        bag.pose("quad", 4, 4, (0.0,) * 3, (0.0,) * 4)
        bag.length(-1, 1.0, 1.0, 0.1)
        bag.event(4, "loud", "bang")
        assert bag.dropped == 5 and "cannot record state" in bag.refused and bag.failed is None
    flight = read(tmp_path / "flight")
    assert len(flight.vehicle.stamp) == 5
    [event] = flight.events
    assert event.level == "warn" and event.text.startswith("5 messages were not fit to be recorded, first: ")


def test_a_garbled_message_ends_the_recording_in_good_order(tmp_path: Path) -> None:
    bag = LiveRecorder(tmp_path / "flight", METADATA)
    for body in ("vehicle", "pendulum"):
        bag.pose(body, 0, 5, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    bag._backlog += live._FRAME.pack(200, 0, 0)
    bag.numbers("truth_length", 0, [1.0])
    with pytest.raises(BagError, match="IndexError"):
        bag.close()
    [event] = read(tmp_path / "flight").events
    assert event.level == "error" and "recording stopped: IndexError" in event.text


def test_a_bag_without_a_message_yet_says_so(tmp_path: Path) -> None:
    with pytest.raises(BagError), LiveRecorder(tmp_path / "flight", METADATA) as bag:
        os.kill(bag._process.pid, signal.SIGKILL)
        bag._process.wait()
    with pytest.raises(BagError, match=r"not finished.* holds no message yet"):
        read(tmp_path / "flight")
    with pytest.raises(BagError, match="no complete message is left"):
        recover(tmp_path / "flight")


def test_a_flight_that_ends_by_an_exception_is_recorded_up_to_there(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), LiveRecorder(tmp_path / "flight", METADATA) as bag:
        for body in ("vehicle", "pendulum"):
            bag.pose(body, 0, 5, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
        raise KeyboardInterrupt
    assert read(tmp_path / "flight").events == ((5, "fatal", "recording ended by KeyboardInterrupt", "note", {}),)


def test_what_ended_the_flight_is_not_hidden_by_its_recording(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), LiveRecorder(tmp_path / "flight", METADATA) as bag:
        os.kill(bag._process.pid, signal.SIGKILL)
        bag._process.wait()
        bag.numbers("truth_length", 0, [1.0])
        raise ZeroDivisionError
    assert "recording stopped" in bag.failed


def test_a_recording_that_cannot_begin_says_so_before_the_flight(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "old").mkdir()
    for path, words in (("file/flight", "Not a directory"), ("old", "exists already")):
        with pytest.raises(BagError, match=words) as caught:
            LiveRecorder(tmp_path / path, METADATA)
        assert str(caught.value).count(str(tmp_path / path)) >= 1 and "\n" not in str(caught.value)
    with pytest.raises(BagError, match="origin"):
        LiveRecorder(tmp_path / "flight", {})


def test_the_metadata_lie_beside_the_recording_from_its_start(tmp_path: Path) -> None:
    with LiveRecorder(tmp_path / "flight", METADATA) as bag:
        text = (tmp_path / "flight" / SIDECAR).read_text()
        assert json.dumps(METADATA["seed"]) in text and "simulated" in text
        for body in ("vehicle", "pendulum"):
            bag.pose(body, 0, PERIOD, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    assert not (tmp_path / "flight" / SIDECAR).exists()
