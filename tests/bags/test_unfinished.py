"""A recording in virtual time survives kills and a full disk, as one in real time does (test_live.py)."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from fiplib import bags
from fiplib.bags.messages import SIDECAR
from fiplib.bags.writer import CHUNK, HOLD, RESERVE
from fiplib.params import NANO
from fiplib.recording import BagError
from fiplib.simulate import SCENARIOS
from tests.bags.test_bags import METADATA, Numbers

ROOT = Path(__file__).parents[2]
# A flight of simulated time that never ends, faster than the wall clock; it says how far it has come.
SCRIPT = """
import itertools, sys
from fiplib import bags
from fiplib.__main__ import guarded
from fiplib.simulate import SCENARIOS
from tests.bags.test_bags import Numbers

def record():
    numbers = Numbers(frames=240)
    with bags.BagRecorder(sys.argv[1], SCENARIOS["estimate-1.2"].metadata()) as bag:
        for index in itertools.count():
            stamp, k = 10**18 + index * 10**9 // 240, index % 240
            for body in ("vehicle", "pendulum"):
                bag.pose(body, stamp, stamp + 4_000_000, numbers.position[body][k], numbers.orientation[body][k])
            print(stamp, flush=True)

sys.exit(guarded(record))
"""


def ended(bag: Path, number: signal.Signals) -> tuple[int, int]:
    """Record for 2000 frames or more and send a signal; the exit code, and the last stamp that was handed over, ns."""
    process = subprocess.Popen(
        [sys.executable, "-c", SCRIPT, str(bag)],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert process.stdout is not None
    said = [process.stdout.readline() for _ in range(2000)]
    process.send_signal(number)
    said += process.stdout.readlines()
    return process.wait(60), int(said[-1])


def test_killed_it_loses_less_than_a_second_and_keeps_origin_and_parameters(tmp_path):
    code, last = ended(tmp_path / "bag", signal.SIGKILL)
    assert code == -signal.SIGKILL and not (tmp_path / "bag/metadata.yaml").exists()
    recovery = bags.recover(tmp_path / "bag")
    flight = bags.read(recovery.output)
    assert last - flight.vehicle.received[-1] <= CHUNK + HOLD + NANO // 100 < NANO
    # all that came before is there, and each frame once
    assert len(flight.vehicle.stamp) == len(flight.pendulum.stamp) > 1500
    np.testing.assert_allclose(np.diff(flight.vehicle.stamp), NANO / 240, atol=1)
    assert flight.simulated and flight.params == SCENARIOS["estimate-1.2"].params
    assert flight.metadata["scenario"] == "estimate-1.2" and not recovery.finished
    assert "by 1 s at most if that was killed" in recovery.describe()


def test_told_to_end_it_finishes_the_bag(tmp_path):
    code, last = ended(tmp_path / "bag", signal.SIGTERM)
    assert code == 128 + signal.SIGTERM and not (tmp_path / "bag" / SIDECAR).exists()
    flight = bags.read(tmp_path / "bag")
    # the frame under way may be lost: it was not yet handed over
    assert flight.vehicle.stamp[-1] >= last and flight.events[-1].text == "recording ended by SystemExit"


def test_a_flight_killed_while_it_is_simulated_is_recovered(tmp_path):
    bag = tmp_path / "bag"
    command = [sys.executable, str(ROOT / "scripts/fly.py"), "--scenario", "circle-0.8", "--output", str(bag)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while not (bag / "bag.mcap").exists() or (bag / "bag.mcap").stat().st_size < 150_000:
        assert process.poll() is None
        time.sleep(0.005)
    process.kill()
    process.wait()
    flight = bags.read(bags.recover(bag).output)
    assert flight.duration > 1.0 and flight.metadata["scenario"] == "circle-0.8" and flight.simulated
    assert flight.command is not None and flight.vehicle.received[-1] - flight.command.stamp[-1] < NANO // 20


@pytest.fixture
def small_disk(tmp_path):
    """A disk that has room for the reserve and half a megabyte."""
    disk = tmp_path / "disk"
    disk.mkdir()
    size = f"size={RESERVE + (1 << 19)}"
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", size, "fip", str(disk)], capture_output=True, text=True)
    if mounted.returncode:
        pytest.skip(f"no small disk can be mounted here: {mounted.stderr.strip()}")
    yield disk
    subprocess.run(["umount", str(disk)], check=True)


def fill(bag: bags.BagRecorder, numbers: Numbers, noise: np.random.Generator) -> int:
    """Frames handed over until the recorder raises."""
    for i, stamp in enumerate(numbers.stamp.tolist()):
        try:
            for body in ("vehicle", "pendulum"):
                bag.pose(body, stamp, stamp, numbers.position[body][i], numbers.orientation[body][i])
            bag.event(stamp, "info", noise.bytes(200).hex())
        except BagError:
            return i
    raise AssertionError("the disk never was full")


def test_a_full_disk_ends_the_bag_properly_and_says_so(small_disk):
    numbers, noise = Numbers(frames=20_000), np.random.default_rng(0)
    with pytest.raises(BagError, match="flight: recording stopped: No space left on device; the bag holds the flight"):
        with bags.BagRecorder(small_disk / "flight", METADATA) as bag:
            flown = fill(bag, numbers, noise)
            bag.numbers("state", 1, np.zeros(10))  # it goes on saying so
    flight = bags.read(small_disk / "flight")  # no need to recover anything
    assert flight.events[-1][1:3] == ("error", "recording stopped: No space left on device; what followed is lost")
    kept = len(flight.vehicle.stamp)
    assert kept >= flown > 1000 and not (small_disk / "flight" / SIDECAR).exists() and flight.metadata == METADATA
    np.testing.assert_array_equal(flight.vehicle.position, numbers.position["vehicle"][:kept])


def test_a_full_disk_is_noticed_before_the_flight(small_disk):
    (small_disk / "old").write_bytes(bytes(1 << 20))
    with pytest.raises(BagError, match=r"cannot record here .*No space left"):
        bags.BagRecorder(small_disk / "flight", METADATA)
    assert not (small_disk / "flight").exists()


LIMITED = """
import resource, sys
import numpy as np
from fiplib import bags
from fiplib.recording import BagError
from tests.bags.test_bags import METADATA, Numbers
from tests.bags.test_unfinished import fill

limit = int(sys.argv[2])
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
try:
    with bags.BagRecorder(sys.argv[1], METADATA) as bag:
        print(fill(bag, Numbers(frames=20_000), np.random.default_rng(0)), flush=True)
        bag.numbers("state", 1, np.zeros(10))
except BagError as error:
    print(error)
"""


def test_a_file_that_cannot_grow_leaves_whole_chunks_to_recover(tmp_path):
    """A limit on the size of files stands for a quota: the reserve cannot help, the bag stays unfinished."""
    arguments = [str(tmp_path / "bag"), str(RESERVE + 1000)]
    said = subprocess.run(
        [sys.executable, "-c", LIMITED, *arguments],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    flown, words = said.stdout.splitlines()
    assert "recording stopped: File too large" in words and not said.stderr
    recovery = bags.recover(tmp_path / "bag")
    assert not recovery.gaps and not recovery.finished
    kept = recovery.saved[0].count
    assert int(flown) - (CHUNK + HOLD) * 240 // NANO - 2 <= kept <= int(flown)
