"""The radio link: every byte judged by others' encoder and decoder, over real pseudo-terminals. No radio was used."""

import argparse
import dataclasses
import fcntl
import functools
import math
import os
import re
import signal
import struct
import subprocess
import sys
import termios
import threading
import time
import tty
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from crsf_parser.frames import crsf_frame
from crsf_parser.handling import crsf_frame_crc
from elrs.rc import build_rc_frame
from hypothesis import given
from hypothesis import strategies as st

from fiplib.flight.crsf_frames import (
    BAUDS,
    FRAME_BYTES,
    US_OFFSET,
    US_PER_COUNT,
    Encoder,
    betaflight_settings,
    count,
    pack,
    throttle,
)
from fiplib.flight.failsafe import Guard
from fiplib.flight.limits import Limits, Radio
from fiplib.flight.links import LinkError
from fiplib.flight.links.crsf import CrsfLink, CrsfSink
from fiplib.flight.links.simulated import VirtualLink
from fiplib.flight.loop import FlightLoop
from fiplib.flight.sender import Sender, SenderError
from fiplib.flight.setpoint import Mode, Setpoint, disarmed
from fiplib.params import NANO, PHI, THETA, Params, Vehicle
from fiplib.pilot import Pilot
from fiplib.recording import Event, MemoryRecorder
from fiplib.simulate import SCENARIOS, Scenario

ROOT = Path(__file__).parents[2]


PARAMS, LIMITS = Params(), Limits()
LIMIT = PARAMS.vehicle.max_body_rate
ROLL, PITCH, THROTTLE, YAW, ARM = range(5)
HALF_COUNT = 0.5 * US_PER_COUNT
"""The most by which a channel can miss, us."""


def flown(rates: Any = (0.5, 0.0, 0.0), thrust: float = 0.2) -> Setpoint:
    return Setpoint(0, True, Mode.FLYING, np.array(rates, dtype=float), thrust)


def decoded(frame: bytes) -> list[int]:
    """The channels of a frame as the foreign decoder reads them (it gives the last one first)."""
    read = crsf_frame.parse(bytes(frame))
    assert len(frame) == FRAME_BYTES and read.header.frame_length == FRAME_BYTES - 2 and read.header.type == 0x16
    assert read.CRC == crsf_frame_crc(bytes(frame))
    return list(read.payload.channels)[::-1]


def microseconds(channel: int) -> float:
    """What Betaflight 4.6.0 makes of a channel (crsfReadRawRC in rx/crsf.c)."""
    return 0.62477120195241 * channel + 881


def rates(frame: bytes) -> list[float]:
    """Body rates in rad/s about forward, left, up that Betaflight is asked for, its rates being ACTUAL and linear."""
    channels = decoded(frame)
    roll, pitch, yaw = ((microseconds(channels[axis]) - 1500) / 500 * LIMIT for axis in (ROLL, PITCH, YAW))
    return [roll, pitch, -yaw]


# --- bytes


def test_the_example_of_the_protocols_own_wiki_comes_out():
    wiki = "c81816e0031ff8c0073ef0810f7ce0031ff8c0073ef0810f7cad"
    assert pack([992] * 16).hex() == wiki


@given(st.lists(st.integers(0, 2047), min_size=16, max_size=16))
def test_any_channels_are_packed_as_others_pack_them_and_read_back_by_others(channels):
    frame = pack(channels)
    assert frame == build_rc_frame(channels)
    assert decoded(frame) == channels


@pytest.mark.parametrize("channels", [[992] * 15, [992] * 17, [-1] + [992] * 15, [992] * 15 + [2048]])
def test_what_does_not_fit_into_a_frame_is_refused(channels):
    with pytest.raises(ValueError, match="16 channels of 0 to 2047"):
        pack(channels)


numbers = st.floats(-4.0, 4.0) | st.floats(allow_nan=False, allow_infinity=False)


@given(st.booleans(), st.tuples(numbers, numbers, numbers), numbers, st.sampled_from(Mode))
def test_every_setpoint_becomes_a_frame_that_others_build_and_read_within_bounds(armed, body_rate, thrust, mode):
    setpoint = Setpoint(0, armed, mode, np.array(body_rate), thrust)
    channels = Encoder(PARAMS, LIMITS).channels(0, setpoint)
    frame = Encoder(PARAMS, LIMITS).frame(0, setpoint)
    assert frame == build_rc_frame(channels) and decoded(frame) == channels
    assert (microseconds(channels[ARM]) > 1700) == armed
    highest = LIMITS.radio.throttle_low + LIMITS.safety.max_thrust * (2000 - LIMITS.radio.throttle_low)
    assert 999 < microseconds(channels[THROTTLE]) < highest + HALF_COUNT
    assert all(999 < microseconds(channel) < 2001 for channel in channels)
    assert max(map(abs, rates(frame))) <= LIMIT * (1 + HALF_COUNT / 500)
    if not armed:
        assert channels == Encoder(PARAMS, LIMITS).channels(0, disarmed(0))


@given(st.tuples(*[st.floats(-LIMIT, LIMIT)] * 3))
def test_betaflight_reads_the_rates_that_were_meant_to_half_a_step(body_rate):
    # half a step of a channel: 0.06 deg/s
    assert rates(Encoder(PARAMS, LIMITS).frame(0, flown(body_rate))) == pytest.approx(
        body_rate, abs=HALF_COUNT / 500 * LIMIT
    )


def test_no_rate_is_991_and_not_the_992_that_the_protocol_calls_the_centre():
    channels = Encoder(PARAMS, LIMITS).channels(0, flown((0.0, 0.0, 0.0)))
    assert [channels[axis] for axis in (ROLL, PITCH, YAW)] == [991] * 3
    biases = [(microseconds(channel) - 1500) / 500 * 100.0 for channel in (991, 992)]
    assert biases == pytest.approx([0.030, 0.155], abs=5e-4)  # deg/s: to the digits given


def test_roll_is_right_pitch_is_nose_down_and_yaw_is_turned_round():
    level = Encoder(PARAMS, LIMITS).channels(0, flown((0.0, 0.0, 0.0)))
    for axis, channel, sign in ((0, ROLL, 1), (1, PITCH, 1), (2, YAW, -1)):
        moved = Encoder(PARAMS, LIMITS).channels(0, flown(np.eye(3)[axis]))
        changes = {place: new - old for place, (new, old) in enumerate(zip(moved, level, strict=True)) if new != old}
        assert list(changes) == [channel] and math.copysign(1, changes[channel]) == sign


@given(st.floats(0.0, 0.6), st.floats(0.0, 1.0), st.floats(0.0, 0.2))
def test_the_motors_pull_the_thrust_that_was_meant_or_idle(thrust, curve, idle):
    radio = Radio(thrust_curve=curve, motor_idle=idle)
    drive = idle + (1 - idle) * throttle(radio, thrust)
    idling = curve * idle**2 + (1 - curve) * idle
    # to rounding: the square root is of numbers of order one
    assert curve * drive**2 + (1 - curve) * drive == pytest.approx(max(thrust, idling), abs=1e-12)


def test_with_the_default_parameters_thrust_is_the_share_of_the_motors_range():
    channel = Encoder(PARAMS, LIMITS).channels(0, flown(thrust=0.2))[THROTTLE]
    drive = 0.055 + 0.945 * (microseconds(channel) - 1050) / 950
    assert drive == pytest.approx(0.2, abs=HALF_COUNT / 950)


def test_once_armed_the_throttle_stays_lowest_for_a_moment_because_betaflight_arms_only_then():
    encoder, hold = Encoder(PARAMS, LIMITS), round(LIMITS.radio.arm_time * NANO)
    start = 10 * NANO
    off, idle = encoder.channels(start - 1, disarmed(0)), encoder.channels(start, flown())
    assert microseconds(off[ARM]) < 1000 and microseconds(idle[ARM]) > 1999
    assert [*idle[:ARM], *idle[ARM + 1 :]] == [*off[:ARM], *off[ARM + 1 :]]
    assert encoder.channels(start + hold - 1, flown()) == idle
    assert encoder.channels(start + hold, flown()) == Encoder(PARAMS, LIMITS).channels(0, flown())
    encoder.channels(start + 2 * hold, disarmed(0))
    assert encoder.channels(start + 3 * hold, flown()) == idle


def test_channels_can_be_ordered_otherwise_and_the_arm_switch_put_elsewhere():
    limits = LIMITS.replace(radio__channels="TAER", radio__arm_channel=7)
    ours, usual = Encoder(PARAMS, limits).channels(0, flown()), Encoder(PARAMS, LIMITS).channels(0, flown())
    assert [ours[1], ours[2], ours[0], ours[3]] == usual[:4] and ours[6] == usual[ARM]
    assert "map TAER1234" in betaflight_settings(
        PARAMS.vehicle, limits.radio
    ) and "aux 0 0 2 1700 2100 0 0" in betaflight_settings(PARAMS.vehicle, limits.radio)


@pytest.mark.parametrize("setpoint", [flown((math.nan, 0, 0)), flown((0, math.inf, 0)), flown(thrust=math.nan)])
def test_a_setpoint_that_is_not_finite_is_refused_unless_it_disarms(setpoint):
    with pytest.raises(ValueError, match="not finite"):
        Encoder(PARAMS, LIMITS).frame(0, setpoint)
    assert Encoder(PARAMS, LIMITS).frame(0, setpoint._replace(armed=False)) == Encoder(PARAMS, LIMITS).frame(
        0, disarmed(0)
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"radio__baud": 420000}, "radio.baud must be one of 115200, 400000, .* not 420000"),
        ({"radio__channels": "AETA"}, "radio.channels must order the letters A, E, T, R, not 'AETA'"),
        ({"radio__arm_channel": 4}, "radio.arm_channel must be a whole number from 5 to 16"),
        ({"radio__throttle_low": 900.0}, "radio.throttle_low must lie between 1000 and 2000 us"),
        ({"radio__thrust_curve": 1.5}, "radio.thrust_curve must be a number from 0 to 1"),
    ],
)
def test_parameters_that_make_no_sense_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        Encoder(PARAMS, LIMITS.replace(**change))


def test_a_flight_that_uses_no_radio_records_none_of_its_parameters():
    assert not {"safety", "radio"} & set(SCENARIOS["push-hover"].metadata()["params"])


def test_the_page_gives_the_settings_that_belong_to_the_parameters_and_a_reason_for_each():
    page = (ROOT / "docs" / "radio.md").read_text(encoding="utf-8")
    block = page.split("```text\n")[1].split("```")[0]
    assert block.splitlines() == betaflight_settings(PARAMS.vehicle, LIMITS.radio)
    words = {line.split()[1].lstrip("-") for line in block.splitlines() if line.startswith(("set", "feature"))}
    kinds = {re.sub("^(roll|pitch|yaw)_(rc_rate|srate|expo)$", r"\2", word) for word in words}
    prose = page.replace(block, "")
    assert not {kind for kind in kinds if f"`{kind}`" not in prose}


def test_the_page_tells_the_times_and_guesses_that_the_parameters_hold():
    page = " ".join((ROOT / "docs" / "radio.md").read_text(encoding="utf-8").split())
    safety, radio, model = LIMITS.safety, LIMITS.radio, PARAMS.simulation
    for words in (
        f"inputs from {1e3 * safety.pose_flag:g} ms, level and descend from {1e3 * safety.pose_level:g} ms, "
        f"disarmed from {1e3 * safety.pose_disarm:g} ms",
        f"level-and-disarm frames for {safety.leave_time:g} s",
        f"at least {safety.send_rate:g} per second",
        f"for the first {radio.arm_time:g} s after arming",
        f"{radio.baud} is the default",
        f"`vehicle.max_thrust` ({PARAMS.vehicle.max_thrust:g} N)",
        f"`radio.thrust_curve` ({radio.thrust_curve:g}, linear)",
        f"within {PARAMS.piloting.altitude_integral_limit:g} m/s²",
        f"{1e3 * model.rate_delay:g} ms of delay and {1e3 * model.rate_lag:g} ms of lag",
    ):
        assert words in page
    assert all(str(baud) in page for baud in BAUDS)


def test_settings_for_a_rate_that_betaflight_cannot_take_are_refused():
    with pytest.raises(ValueError, match=r"95 deg/s: Betaflight takes 10, 20"):
        betaflight_settings(Vehicle(max_body_rate=math.radians(95.0)), LIMITS.radio)


def through_the_air(channel: int) -> int:
    """A stick's channel as ExpressLRS (Hybrid, Wide) delivers it: 172 to 1811 in 10 bits, rounded by its ``fmap``."""

    def fmap(value: int, low: int, high: int, to_low: int, to_high: int) -> int:
        return ((value - low) * (to_high - to_low) * 2 // (high - low) + to_low * 2 + 1) // 2

    return fmap(fmap(channel, 172, 1811, 0, 1023), 0, 1023, 172, 1811)


def test_through_the_air_a_rate_misses_by_less_than_a_fifth_of_a_degree_per_second():
    degrees = np.linspace(-100.0, 100.0, 4001)
    received = [microseconds(through_the_air(count(1500 + 5 * rate))) for rate in degrees]
    assert np.abs((np.array(received) - 1500) / 5 - degrees).max() < 0.2
    assert through_the_air(991) == 991  # level stays level


class Received(VirtualLink):
    """The simulated vehicle, flown on what its receiver makes of the frames: decoded by others, rounded by radio.

    Not ``rounded``, it waits for the end of the pause after arming all the same, but takes setpoints as they were made.
    """

    def __init__(self, scenario: Scenario, rounded: bool) -> None:
        super().__init__(scenario)
        self._encoder, self._rounded = Encoder(scenario.params, LIMITS), rounded

    def send(self, setpoint: Setpoint) -> None:
        *sticks, arm = decoded(self._encoder.frame(self.now(), setpoint))[: ARM + 1]
        roll, pitch, stick, yaw = (microseconds(through_the_air(channel)) for channel in sticks)
        setpoint = setpoint._replace(armed=microseconds(arm) > 1700 and stick > 1050)
        if self._rounded:
            body_rate = np.array((roll - 1500, pitch - 1500, 1500 - yaw)) / 500 * LIMIT
            # as Betaflight gives it to motors that pull in proportion
            setpoint = setpoint._replace(body_rate=body_rate, thrust=0.055 + 0.945 * max(0.0, (stick - 1050) / 950))
        super().send(setpoint)


def test_the_rod_stays_up_on_what_is_left_of_the_setpoints_after_rounding_and_radio():
    scenario = dataclasses.replace(SCENARIOS["push-hover"], duration=10.0)
    tilts = []
    for rounded in (False, True):
        tape, guard = MemoryRecorder(), Guard(Pilot(scenario.params, scenario.reference))
        loop = FlightLoop(scenario, Received(scenario, rounded), guard, tape)
        loop.run()
        assert loop.balanced and [entry.after for entry in guard.transitions][:2] == [Mode.READY, Mode.FLYING]
        flown = tape.flight(scenario.name, scenario.metadata())
        times = flown.time(flown.state)
        states = flown.state.values[(times > 1.0) & (times < 10.0)]
        tilts.append(np.sqrt((states[:, [PHI, THETA]] ** 2).mean(axis=0)))
    # with the push at 5.3 s; rounding changes the rms tilt by 0.2 %
    assert tilts[1] == pytest.approx(tilts[0], rel=0.01)


def test_microseconds_are_betaflights_own():
    assert (US_PER_COUNT, US_OFFSET) == (pytest.approx(0.62477120195241, rel=1e-12), 881)


# --- over a pseudo-terminal


class Module:
    """The far end of a serial port: a pseudo-terminal that somebody reads, or not."""

    def __init__(self) -> None:
        self._master, slave = os.openpty()
        tty.setraw(slave)
        self.name = os.ttyname(slave)
        self._slave: int | None = slave
        self._chunks: deque[tuple[float, bytes]] = deque()
        self._frames: list[tuple[float, list[int]]] = []
        self._rest = b""
        self._stop = threading.Event()
        self._reader: threading.Thread | None = None

    def listen(self) -> "Module":
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        return self

    def _read(self) -> None:
        os.set_blocking(self._master, False)
        while not self._stop.is_set():
            try:
                data = os.read(self._master, 65536)
                self._chunks.append((time.monotonic(), data))
            except BlockingIOError:
                time.sleep(0.001)
            except OSError:
                return

    def telemetry(self, data: bytes) -> None:
        os.write(self._master, data)

    def unplug(self) -> None:
        """Pull the cable out: whoever has the port open gets errors from now on."""
        self._stop.set()
        if self._reader is not None:
            self._reader.join()
        for handle in (self._slave, self._master):
            if handle is not None:
                with suppress(OSError):
                    os.close(handle)
        self._slave = None
        self._master = -1

    def frames(self) -> list[tuple[float, list[int]]]:
        """When frames came, and their channels; every byte must belong to one that the foreign decoder accepts."""
        while self._chunks:
            moment, chunk = self._chunks.popleft()
            self._rest += chunk
            while len(self._rest) >= FRAME_BYTES:
                self._frames.append((moment, decoded(self._rest[:FRAME_BYTES])))
                self._rest = self._rest[FRAME_BYTES:]
        return self._frames

    def torn(self) -> int:
        """Bytes after the last whole frame."""
        self.frames()
        return len(self._rest)


@pytest.fixture
def module() -> Iterator[Module]:
    one = Module()
    yield one
    if one._master >= 0:
        one.unplug()


def until(condition: Callable[[], Any], patience: float = 90.0) -> None:
    """Wait for something that must happen; the patience is for a busy machine."""
    end = time.monotonic() + patience
    while not condition():
        assert time.monotonic() < end, "it never happened"
        time.sleep(0.01)


def armed(frame: tuple[float, list[int]]) -> bool:
    return microseconds(frame[1][ARM]) > 1700


def assert_left_in_order(frames: list[tuple[float, list[int]]]) -> None:
    """The last frames are level and disarmed, for at least half a second."""
    last = max((index for index, frame in enumerate(frames) if armed(frame)), default=-1)
    tail = frames[last + 1 :]
    level = Encoder(PARAMS, LIMITS).channels(0, disarmed(0))
    assert tail and all(channels == level for _, channels in tail)
    assert tail[-1][0] - tail[0][0] >= 0.5
    assert len(tail) >= 20  # 60 to 72 on a machine that is not busy


def sender(module: Module) -> Sender:
    return Sender(functools.partial(CrsfSink, module.name, PARAMS, LIMITS), PARAMS, LIMITS)


@pytest.mark.realtime
@pytest.mark.parametrize("baud", sorted(BAUDS))
def test_the_port_is_opened_raw_and_at_the_rate_that_was_asked_for(module, baud):
    sink = CrsfSink(module.name, PARAMS, LIMITS.replace(radio__baud=baud))
    settings = fcntl.ioctl(module._slave, 0x802C542A, bytes(44))  # TCGETS2: the rate as a number, standard or not
    assert struct.unpack_from("<I", settings, 40) == (baud,)
    flags = termios.tcgetattr(module._slave)
    assert not flags[1] & termios.OPOST and not flags[3] & (termios.ICANON | termios.ECHO)
    assert flags[2] & termios.CSIZE == termios.CS8 and not flags[2] & (termios.PARENB | termios.CSTOPB)
    sink.close()


@pytest.mark.realtime
def test_frames_come_at_the_rate_whole_and_end_level_and_disarmed(module):
    module.listen()
    with sender(module) as one:
        until(lambda: one.send(flown()) or sum(map(armed, module.frames())) > 60)
        assert one.fault() is None
        newest = Encoder(PARAMS, LIMITS).channels(0, flown())
        assert module.frames()[-1][1] == newest  # the pause after arming is over
    frames = module.frames()
    assert module.torn() == 0 and one.counts.sent == len(frames) and one.counts.failed == 0
    assert not armed(frames[0])
    assert_left_in_order(frames)
    quiet = [moment for moment, channels in frames if channels == frames[0][1]][:-1]
    # never faster than the rate: a busy machine may make frames late but not early (2 for those at the ends)
    assert len(quiet) <= (frames[-1][0] - frames[0][0]) * LIMITS.safety.send_rate + 2


@pytest.mark.realtime
def test_telemetry_that_nobody_reads_does_no_harm(module):
    module.listen()
    with sender(module) as one:
        for _ in range(50):
            module.telemetry(b"\xea\x0c\x14" + bytes(200))
            one.send(flown())
            time.sleep(0.01)
        assert one.fault() is None
    assert module.torn() == 0
    assert_left_in_order(module.frames())


@pytest.mark.realtime
def test_when_the_process_that_owns_the_port_is_killed_another_takes_it_and_disarms(module):
    module.listen()
    with sender(module) as one:
        until(lambda: one.send(flown()) or sum(map(armed, module.frames())) > 20)
        os.kill(one.pid, signal.SIGKILL)
        until(lambda: one.send(flown()) or one.fault() is not None)
        assert "the command sender died" in one.fault() and "cannot be replaced" not in one.fault()
    assert module.torn() == 0
    assert_left_in_order(module.frames())


@pytest.mark.realtime
def test_whichever_call_first_meets_a_port_that_is_gone_it_is_told_in_plain_words(module, monkeypatch):
    sink = CrsfSink(module.name, PARAMS, LIMITS)
    sink.send(flown())
    module.unplug()
    gone = rf"{module.name} is gone \(Input/output error\): is the module still plugged in\?"
    with pytest.raises(OSError, match=gone):  # emptying the input: a termios.error, which is no OSError
        sink.send(flown())
    monkeypatch.setattr(sink._port, "reset_input_buffer", lambda: None)
    with pytest.raises(OSError, match=gone):  # asking how much waits
        sink.send(flown())
    sink.close()


@pytest.mark.realtime
def test_an_unplugged_port_is_a_fault_in_plain_words_and_a_missing_one_stays_it(module):
    module.listen()
    with sender(module) as one:
        until(lambda: one.send(flown()) or len(module.frames()) > 10)
        module.unplug()
        until(lambda: one.send(flown()) or one.fault() is not None)
        # the first words may be overtaken by those of the try to open it again
        assert re.fullmatch(rf"commands cannot be sent \(.*{module.name}.*plugged in\?.*\)", one.fault())
        until(lambda: one.send(flown()) or f"no serial port {module.name}" in (one.fault() or ""))
    assert one.counts.failed > 0


@pytest.mark.realtime
def test_a_port_that_takes_nothing_is_left_out_then_reported_and_no_frame_is_torn(module):
    sink = CrsfSink(module.name, PARAMS, LIMITS)
    sent = 0

    def stuck() -> bool:
        nonlocal sent
        try:
            sink.send(flown())
        except OSError as error:
            assert str(error) == f"{module.name} takes no bytes: check module and adapter"
            return True
        sent += 1
        return False

    until(stuck)
    assert sent > 10
    module.listen()
    before = sent
    until(lambda: not stuck())
    until(lambda: not stuck() and sent > before + 50)
    sink.close()
    until(lambda: module.torn() == 0)
    assert 50 < len(module.frames()) < sent  # some were left out, and what came were frames


@pytest.mark.realtime
def test_one_port_belongs_to_one_program(module):
    sink = CrsfSink(module.name, PARAMS, LIMITS)
    with pytest.raises(LinkError, match="another program uses it"):
        CrsfSink(module.name, PARAMS, LIMITS)
    sink.close()
    CrsfSink(module.name, PARAMS, LIMITS).close()


def test_a_port_that_does_not_open_is_an_error_of_the_sender_in_its_words(tmp_path):
    with pytest.raises(SenderError, match="no serial port"):
        Sender(functools.partial(CrsfSink, str(tmp_path / "port"), PARAMS, LIMITS), PARAMS, LIMITS)


@pytest.mark.realtime
def test_without_pyserial_the_message_says_how_to_get_it(module, monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == "serial"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "serial", None)
    with pytest.raises(LinkError, match="needs pyserial"):
        CrsfSink(module.name, PARAMS, LIMITS)


class Still:
    """Poses from somewhere: a frame at every turn."""

    origin = "real"
    truth = None

    def __init__(self) -> None:
        self.calls: list[str] = []
        self.events: deque[Event] = deque()
        self.pids: dict[str, int] = {}

    def __enter__(self) -> "Still":
        self.calls.append("enter")
        return self

    def __exit__(self, *reason: object) -> None:
        self.calls.append("exit")

    def wait(self) -> None:
        self.calls.append("wait")

    def now(self) -> int:
        return 7

    def receive(self, timeout: float) -> Any:
        return 7, "frame"

    def fault(self) -> str | None:
        return "poses lost" if "lost" in self.calls else None


@pytest.mark.realtime
def test_poses_come_from_elsewhere_and_only_setpoints_go_out_of_the_port(module):
    poses = Still()
    with CrsfLink(module.listen().name, poses, PARAMS, LIMITS) as link:
        assert link.origin == "real" and link.now() == 7 and link.receive(0.1) == (7, "frame") and link.truth is None
        until(lambda: link.send(flown()) or any(map(armed, module.frames())))
        assert link.fault() is None
        poses.calls.append("lost")
        assert link.fault() == "poses lost"
    assert poses.calls == ["enter", "wait", "lost", "exit"]
    assert_left_in_order(module.frames())
    absent = CrsfLink("/dev/absent", poses, PARAMS, LIMITS)
    with pytest.raises(LinkError, match="--link crsf: no serial port /dev/absent"):
        absent.__enter__()
    assert poses.calls[-2:] == ["enter", "exit"]


def test_the_baud_option_sets_the_parameter_so_that_the_bag_tells_it():
    parser = argparse.ArgumentParser()
    parser.add_argument("--set", action="append", default=[])
    CrsfLink.arguments(parser)
    options = parser.parse_args(["--set", "pendulum.length=0.8", "--crsf-baud", "400000"])
    assert options.set == ["pendulum.length=0.8", "radio.baud=400000"]
    assert parser.parse_args([]).set == []


# --- the flight script: the bench test, the rod simulated and the frames going out of the port


def command(module: Module | None, output: Path, *arguments: object) -> list[str]:
    port = ["--crsf-port", module.name] if module else []
    script = [sys.executable, str(ROOT / "scripts" / "fly.py"), "--scenario", "push-hover", "--link", "crsf"]
    return [*script, *port, "--output", str(output), *map(str, arguments)]


def start(module: Module, output: Path, *arguments: object) -> subprocess.Popen[str]:
    """A bench test that has begun to fly."""
    process = subprocess.Popen(
        command(module.listen(), output, "--poses", "sim", "--arm", *arguments),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    until(lambda: process.poll() is not None or sum(map(armed, module.frames())) > 60)
    assert process.poll() is None, process.communicate()[1]
    return process


@pytest.mark.realtime
def test_the_bench_test_balances_the_rod_on_the_setpoints_that_leave_the_port(module, tmp_path):
    process = start(module, tmp_path / "bag", "--duration", 2, "--crsf-baud", 400000)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 0 and "simulated" in out and "still balanced" in out, err
    frames = module.frames()
    assert module.torn() == 0 and not armed(frames[0])
    assert_left_in_order(frames)
    from fiplib import bags

    flight = bags.read(tmp_path / "bag")
    assert (
        flight.simulated
        and flight.metadata["link"] == "crsf"
        and Limits.from_dict(flight.metadata["params"]).radio.baud == 400000
    )
    # what the bag says was commanded is what left the port: each recorded command, to half a step of a channel
    sent = np.array([channels[:4] for moment, channels in frames if armed((moment, channels))])
    wanted = np.array(
        [Encoder(PARAMS, LIMITS).channels(0, flown(row[:3], row[3]))[:4] for row in flight.command.values]
    )
    known = {tuple(row) for row in sent}
    flying = [tuple(row) for row in wanted[round(LIMITS.radio.arm_time * 120) + 2 :]]
    # a frame may be superseded before it is due (a busy machine), and the bag has thrust in single precision
    assert sum(row in known for row in flying) > 0.9 * len(flying)


@pytest.mark.realtime
def test_ctrl_c_lands_and_leaves_in_order(module, tmp_path):
    process = start(module, tmp_path / "bag")
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 130 and "operator abort (Ctrl-C)" in out + err and "Traceback" not in err
    assert module.torn() == 0
    assert_left_in_order(module.frames())


@pytest.mark.realtime
def test_when_the_flying_process_is_killed_the_port_still_gets_level_and_disarm(module, tmp_path):
    process = start(module, tmp_path / "bag")
    process.kill()
    process.communicate(timeout=120)

    def left() -> bool:
        with suppress(AssertionError):
            assert_left_in_order(module.frames())
            return True
        return False

    until(left)
    assert module.torn() == 0


@pytest.mark.realtime
def test_pulling_the_cable_in_flight_ends_it_with_the_reason_and_no_traceback(module, tmp_path):
    process = start(module, tmp_path / "bag")
    module.unplug()
    out, err = process.communicate(timeout=120)
    assert "commands cannot be sent" in out + err and "plugged in?" in out + err
    assert "Traceback" not in err and "disarmed" in out + err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--poses", "sim"], "name the serial port of the transmitter module with --crsf-port"),
        (
            ["--poses", "sim", "--crsf-port", "/dev/no-such-port"],
            "no serial port /dev/no-such-port: is the module plugged in?",
        ),
        (["--poses", "sim", "--crsf-port", __file__], "is not a serial port"),
        (["--crsf-port", "/dev/ptmx"], "--ros2-origin: say whether"),
        (["--poses", "sim", "--crsf-port", "/dev/no-such-port", "--set", "radio.baud=9600"], "radio.baud must be one"),
    ],
)
def test_a_mistake_is_answered_in_one_line_before_anything_is_recorded(arguments, message, tmp_path):
    answer = subprocess.run(command(None, tmp_path / "bag", *arguments), capture_output=True, text=True)
    assert answer.returncode == 2 and message in answer.stderr
    assert answer.stderr.count("\n") == 1, answer.stderr
    assert not (tmp_path / "bag").exists()


@pytest.mark.realtime
def test_a_baud_that_no_module_listens_at_is_refused_with_those_that_it_does(module, tmp_path):
    answer = subprocess.run(command(module, tmp_path / "bag", "--crsf-baud", 420000), capture_output=True, text=True)
    assert answer.returncode == 2 and "choose from" in answer.stderr and "921600" in answer.stderr
