"""The command sender: whatever becomes of the process that flies, the commands end level and disarmed."""

import functools
import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fiplib.flight.limits import Limits
from fiplib.flight.sender import DeadMan, Sender, SenderError, decode, encode
from fiplib.flight.setpoint import Mode, Setpoint, disarmed
from fiplib.params import NANO, Params

PARAMS = Params()
LIMITS = Limits()
SAFETY = LIMITS.safety
PERIOD = round(NANO / SAFETY.send_rate)


class FileSink:
    """Writes what is sent as lines of JSON; fails while a file beside it exists."""

    def __init__(self, path: str) -> None:
        self._path = Path(path)
        if self._path.with_suffix(".absent").exists():
            raise OSError("no such port")
        self._file = open(path, "a", buffering=1)

    def send(self, setpoint: Setpoint) -> None:
        if self._path.with_suffix(".broken").exists():
            raise OSError("unplugged")
        row = (os.getpid(), time.monotonic_ns(), setpoint.armed, setpoint.mode.value, list(setpoint.body_rate))
        self._file.write(json.dumps((*row, setpoint.thrust)) + "\n")

    def close(self) -> None:
        self._file.close()


def flown(stamp: int = 0, rate: float = 0.5, thrust: float = 0.2, tilt: float = 0.1) -> Setpoint:
    return Setpoint(stamp, True, Mode.FLYING, np.array((rate, 0.0, 0.0)), thrust, None, (tilt, 0.0))


def rows(path: Path) -> list[Any]:
    return [json.loads(line) for line in path.read_text().splitlines() if line.endswith("]")]


def until(condition: Any, patience: float = 60.0) -> None:
    """Wait for something that must happen; the patience is for a busy machine."""
    end = time.monotonic() + patience
    while not condition():
        assert time.monotonic() < end, "it never happened"
        time.sleep(0.01)


def check_rows(found: list[Any]) -> None:
    for _, _, armed, _, rates, thrust in found:
        assert all(map(math.isfinite, (*rates, thrust)))
        assert max(map(abs, rates)) <= PARAMS.vehicle.max_body_rate and 0.0 <= thrust <= SAFETY.max_thrust
        assert armed or (not any(rates) and thrust == 0.0)


def assert_left_in_order(found: list[Any]) -> None:
    """The last frames are level and disarmed, for at least half a second, at a tick's pace or near it."""
    check_rows(found)
    last_armed = max((index for index, row in enumerate(found) if row[2]), default=-1)
    tail = found[last_armed + 1 :]
    assert (tail[-1][1] - tail[0][1]) / NANO >= 0.5
    assert len(tail) >= 20  # 60 to 72 on a machine that is not busy


# --- the dead-man, in virtual time


def test_a_fresh_setpoint_is_repeated_then_levelled_then_disarmed_for_good():
    dead_man = DeadMan(PARAMS, LIMITS)
    assert dead_man.due(0) == disarmed(0)._replace(body_rate=pytest.approx(np.zeros(3)))
    dead_man.hear(0, flown())
    sent = [dead_man.due(now) for now in range(0, NANO, PERIOD)]
    modes = [setpoint.mode for setpoint in sent]
    assert modes == sorted(modes, key=[Mode.FLYING, Mode.LEVEL, Mode.DISARMED].index)
    # to one tick: the period is rounded to ns
    assert modes.count(Mode.FLYING) == pytest.approx(SAFETY.pose_level * 120, abs=1)
    assert modes.count(Mode.LEVEL) == pytest.approx((SAFETY.pose_disarm - SAFETY.pose_level) * 120, abs=1)
    assert dead_man.fault == "no setpoint for 500 ms: disarmed"
    dead_man.hear(NANO, flown())
    assert not dead_man.due(NANO).armed


def test_levelling_takes_out_the_tilt_that_was_expected():
    dead_man = DeadMan(PARAMS, LIMITS)
    dead_man.hear(0, flown(tilt=0.1))
    sent = [dead_man.due(now) for now in range(0, NANO // 2, PERIOD)]
    levelling = [setpoint for setpoint in sent if setpoint.mode is Mode.LEVEL]
    turned = sum(setpoint.body_rate[0] for setpoint in levelling) / 120
    # 0.4 s at a gain of 4/s leave exp(-1.6) of the tilt
    assert turned == pytest.approx(-0.1 * (1.0 - math.exp(-1.6)), rel=0.05)
    assert all(0.0 < setpoint.thrust < 0.2 for setpoint in levelling)


def test_a_pause_shorter_than_the_limit_is_forgiven():
    dead_man = DeadMan(PARAMS, LIMITS)
    for now in (0, 300_000_000, 700_000_000):
        dead_man.hear(now, flown())
        assert dead_man.due(now).mode is Mode.FLYING
        assert dead_man.due(now + 200_000_000).mode is Mode.LEVEL


numbers = st.floats() | st.floats(-3.0, 3.0)


@given(
    st.lists(
        st.tuples(st.integers(0, 10**9), st.booleans(), st.lists(numbers, min_size=3, max_size=3), numbers, numbers)
    )
)
def test_nothing_that_is_heard_makes_it_send_what_is_not_finite_or_out_of_bounds(heard):
    dead_man, now = DeadMan(PARAMS, LIMITS), 0
    for elapsed, armed, rates, thrust, tilt in heard:
        now += elapsed
        dead_man.hear(
            now, decode(encode(Setpoint(now, armed, Mode.FLYING, np.array(rates), thrust, None, (tilt, 0.0))))
        )
        for later in (0, PERIOD, 20 * PERIOD):
            sent = dead_man.due(now + later)
            check_rows([(0, 0, sent.armed, "", list(sent.body_rate), sent.thrust)])


finite = st.floats(allow_nan=False)


@given(st.integers(0, 2**62), st.booleans(), st.sampled_from(Mode), st.tuples(*[finite] * 6))
def test_a_setpoint_survives_the_way_to_the_sender(stamp, armed, mode, values):
    setpoint = Setpoint(stamp, armed, mode, np.array(values[:3]), values[3], None, values[4:])
    again = decode(encode(setpoint))
    assert tuple(again.body_rate) == values[:3]
    assert again._replace(body_rate=None) == setpoint._replace(body_rate=None)


# --- the process


@pytest.fixture
def output(tmp_path: Path) -> Path:
    return tmp_path / "sent.txt"


def sender(output: Path) -> Sender:
    return Sender(functools.partial(FileSink, str(output)), PARAMS, LIMITS)


def keep_sending(one: Sender, output: Path, count: int) -> None:
    """Setpoints at the control rate until so many armed ones have come out."""

    def sent() -> bool:
        one.send(flown())
        return output.exists() and sum(row[2] for row in rows(output)) >= count

    until(sent)


def test_closing_sends_level_and_disarm_for_half_a_second_and_then_nothing(output):
    with sender(output) as one:
        keep_sending(one, output, 20)
        assert one.fault() is None
        pid = one.pid
    found = rows(output)
    assert found[0][2] is False  # before the first setpoint the motors are off
    assert_left_in_order(found)
    assert {row[0] for row in found} == {pid} and one.fault() is None
    assert one.counts.sent == len(found) and one.counts.failed == 0
    time.sleep(0.1)
    assert len(rows(output)) == len(found)
    one.close()  # again does nothing
    one.send(flown())


PILOT = """
import ctypes, functools, sys, time
from pathlib import Path
sys.path.insert(0, {root!r})
from tests.flight.test_sender import LIMITS, PARAMS, FileSink, flown
from fiplib.flight.sender import Sender

if __name__ == "__main__":
    sender = Sender(functools.partial(FileSink, {output!r}), PARAMS, LIMITS)
    print(sender.pid, flush=True)
    end = time.monotonic() + 1.0
    while time.monotonic() < end:
        sender.send(flown())
        time.sleep(1 / 120)
    print("flying", flush=True)
    {then}
"""


def pilot(output: Path, then: str) -> tuple[subprocess.Popen[str], int]:
    """A process that flies for a second, and then does something; it and its sender's process id."""
    script = output.with_name("pilot.py")
    script.write_text(PILOT.format(root=str(Path(__file__).parents[2]), output=str(output), then=then))
    process = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    sender_id = int(process.stdout.readline())
    assert process.stdout.readline() == "flying\n"
    return process, sender_id


def gone(pid: int) -> bool:
    """Whether a process has ended (a zombie that nobody has waited for has)."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
    except OSError:
        return True


pytestmark = [
    pytest.mark.realtime,
    pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks processes up in /proc"),
]


def test_when_the_pilot_is_killed_level_and_disarm_frames_follow(output):
    process, sender_id = pilot(output, "time.sleep(600)")
    # flying on, so that the kill comes in the middle of it
    process.kill()
    process.wait()
    until(lambda: gone(sender_id))
    assert any(row[2] for row in rows(output))
    assert_left_in_order(rows(output))


@pytest.mark.parametrize("then", ["raise RuntimeError('bug')", "sys.exit(0)", "import os; os._exit(1)"])
def test_however_the_pilot_ends_level_and_disarm_frames_follow(output, then):
    process, sender_id = pilot(output, then)
    process.wait(60.0)
    until(lambda: gone(sender_id))
    assert_left_in_order(rows(output))


def test_while_the_solver_hangs_with_the_interpreters_lock_commands_go_on_and_end_level_and_disarmed(output):
    hang = (
        "ctypes.PyDLL(None).usleep(2_500_000)\n    sender.send(flown())\n    print('back', flush=True); time.sleep(600)"
    )
    process, sender_id = pilot(output, hang)
    before = time.monotonic_ns()
    assert process.stdout is not None and process.stdout.readline() == "back\n"
    hung = [row for row in rows(output) if row[1] > before]
    process.kill()
    process.wait()
    until(lambda: gone(sender_id))
    modes = [row[3] for row in hung]
    assert {"level", "disarmed"} <= set(modes) and modes == sorted(modes, key=["flying", "level", "disarmed"].index)
    assert modes.count("level") >= 10 and modes.count("disarmed") >= 50  # 48 and 240 on a machine that is not busy
    check_rows(rows(output))
    assert not rows(output)[-1][2]  # the setpoint after the hang does not start the motors again


def test_signals_meant_for_the_pilot_do_not_reach_the_sender(output):
    with sender(output) as one:
        keep_sending(one, output, 5)
        for number in (signal.SIGINT, signal.SIGHUP):
            os.kill(one.pid, number)
        keep_sending(one, output, 30)
        assert one.fault() is None
    assert_left_in_order(rows(output))


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGSTOP])
def test_a_sender_that_is_killed_or_stopped_is_noticed_and_replaced_for_the_disarm(output, number):
    with sender(output) as one:
        keep_sending(one, output, 20)
        os.kill(one.pid, number)

        def noticed() -> bool:
            one.send(flown())
            return one.fault() is not None

        until(noticed)
        assert "the command sender" in one.fault() and "disarmed without it" in one.fault()
    found = rows(output)
    rescue = [row for row in found if row[0] == os.getpid()]
    assert rescue and not any(row[2] for row in rescue)
    assert_left_in_order(rescue)


def test_a_sink_that_breaks_is_reported_and_opened_again(output):
    broken = output.with_suffix(".broken")
    with sender(output) as one:
        keep_sending(one, output, 5)
        broken.touch()
        until(lambda: one.send(flown()) or one.fault() is not None)
        assert one.fault() == "commands cannot be sent (unplugged)"
        broken.unlink()
        until(lambda: one.send(flown()) or one.fault() is None)
        keep_sending(one, output, 10)
    assert one.counts.failed > 0
    assert_left_in_order(rows(output))


def test_a_sink_that_does_not_open_is_an_error_with_its_words(output):
    output.with_suffix(".absent").touch()
    with pytest.raises(SenderError, match="no such port"):
        sender(output)


def test_what_is_not_finite_or_out_of_bounds_is_not_sent_and_counted(output):
    with sender(output) as one:
        keep_sending(one, output, 5)
        one.send(flown(rate=math.nan))
        one.send(flown(thrust=math.inf))
        one.send(flown(rate=50.0))
        one.send(flown(thrust=-0.2))
        one.send("nonsense")
        keep_sending(one, output, 10)
    assert (one.counts.rejected, one.counts.clamped, one.dropped) == (2, 2, 1)
    assert_left_in_order(rows(output))
