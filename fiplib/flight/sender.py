"""The command sender: a separate process, so that it keeps sending when the solver hangs or the pilot is killed.

It alone holds the way out (a ``Sink``). A fresh setpoint goes out at once; when none comes, the newest is repeated at
``safety.send_rate``; when none comes for longer, a dead-man levels and then disarms. Whatever goes wrong with the
process that flies (it hangs with the interpreter's lock held, raises, is killed), the commands stay those of a
controlled end. Not tried on a vehicle; the vehicle's own failsafe and an independent kill switch are still needed.
"""

import gc
import multiprocessing
import os
import signal
import struct
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from multiprocessing.connection import Connection
from types import FrameType
from typing import NamedTuple, Protocol

import numpy as np

from fiplib.flight.limits import Limits
from fiplib.flight.setpoint import Mode, Setpoint, disarmed, levelling
from fiplib.params import NANO, FipError, Params

WIRE = struct.Struct("<q?B6d")
"""A setpoint on its way to the sender: stamp, armed, mode, three body rates, thrust, two tilts."""
assert WIRE.size < 512  # what POSIX promises of PIPE_BUF
MODES = list(Mode)
LEAVE = b"leave"
SPAWN = multiprocessing.get_context("spawn")
START_TIME = 60.0
"""A process on a busy machine may take that long to import NumPy and CasADi, s."""
HEARTBEAT = 0.05
"""The sender reports that often, s."""
HUNG = 0.3
"""A sender that has not reported for this time is assumed to hang, s: the vehicle keeps the last command meanwhile."""
REOPEN = 0.25
"""A broken sink is opened again that often, s."""
PATIENCE = 1.25
"""Periods to wait for a fresh setpoint before the newest is repeated: a fresh one may come a little late."""


class Sink(Protocol):
    """Where setpoints go: a serial port, a topic, a simulated vehicle. Opened and used in the sender's process only."""

    def send(self, setpoint: Setpoint) -> None:
        """Put one setpoint out now. May raise OSError; must return within a few ms."""
        ...

    def close(self) -> None: ...


class SenderError(FipError):
    """The sender cannot be started; the message says why."""


class DeadMan:
    """Chooses what to send: the newest setpoint while it is fresh, then level and descend, then disarm. Pure.

    ``fault`` says why it has disarmed, ``None`` before; ``rejected`` counts setpoints that were not finite, and never
    sent, ``clamped`` those that were out of bounds, and sent at the bounds.
    """

    def __init__(self, params: Params, limits: Limits) -> None:
        self._params, self._limits = params, limits
        self._newest: Setpoint | None = None
        self._heard = self._asked = 0
        self._tilt = np.zeros(2)
        self.fault: str | None = None
        self.rejected = self.clamped = 0

    def hear(self, now: int, setpoint: Setpoint) -> None:
        """Take a setpoint that came at ``now`` ns."""
        numbers = np.array((*setpoint.body_rate, setpoint.thrust, *setpoint.tilt), dtype=float)
        if numbers.shape != (6,) or not np.isfinite(numbers).all():
            self.rejected += 1
            return
        limit, most = self._params.vehicle.max_body_rate, self._limits.safety.max_thrust
        bound = np.array((limit, limit, limit, most, 1.0, 1.0)) if setpoint.armed else np.zeros(6)
        bounded = np.clip(numbers, -bound, bound)
        bounded[3] = max(bounded[3], 0.0)
        if (bounded[:4] != numbers[:4]).any():
            self.clamped += 1
        setpoint = setpoint._replace(body_rate=bounded[:3], thrust=float(bounded[3]), command=None)
        self._newest, self._heard, self._tilt = setpoint, now, bounded[4:]

    def due(self, now: int) -> Setpoint:
        """Return what to send at ``now`` ns."""
        elapsed, self._asked = (now - self._asked) / NANO, now
        if self.fault is not None or self._newest is None or not self._newest.armed:
            return disarmed(now)
        safety, age = self._limits.safety, (now - self._heard) / NANO
        if age >= safety.pose_disarm:
            self.fault = f"no setpoint for {1e3 * safety.pose_disarm:.0f} ms: disarmed"
            return disarmed(now)
        if age < safety.pose_level:
            return self._newest
        setpoint = levelling(self._params, self._limits, now, (float(self._tilt[0]), float(self._tilt[1])))
        self._tilt = self._tilt + setpoint.body_rate[:2] * min(elapsed, 0.1)
        return setpoint


class Counts(NamedTuple):
    """Numbers of setpoints sent, repeated among these, rejected, clamped to the bounds, and of failed sends."""

    sent: int = 0
    repeated: int = 0
    rejected: int = 0
    clamped: int = 0
    failed: int = 0


def encode(setpoint: Setpoint) -> bytes:
    numbers = (*setpoint.body_rate, setpoint.thrust, *setpoint.tilt)
    return WIRE.pack(setpoint.stamp, setpoint.armed, MODES.index(setpoint.mode), *numbers)


def decode(data: bytes) -> Setpoint:
    stamp, armed, mode, *rates, thrust, roll, pitch = WIRE.unpack(data)
    return Setpoint(stamp, armed, MODES[mode], np.array(rates), thrust, None, (roll, pitch))


class Sender(AbstractContextManager):
    """Sends setpoints from its own process ``pid``; a context manager. ``open_sink`` makes the sink there; must pickle.

    Raises SenderError: the process does not start, or the sink cannot be opened.
    """

    def __init__(self, open_sink: Callable[[], Sink], params: Params, limits: Limits) -> None:
        self._open_sink, self._safety = open_sink, limits.safety
        self._fault: str | None = None
        self._closed, self.counts, self.dropped = False, Counts(), 0
        self._rescue: threading.Thread | None = None
        receiver, self._setpoints = SPAWN.Pipe(duplex=False)
        self._status, status = SPAWN.Pipe(duplex=False)
        task = (open_sink, params, limits, receiver, status)
        # a daemon is terminated and waited for when this process exits, and leaves in good order then
        self._process = SPAWN.Process(target=_serve, args=task, name="fip-sender", daemon=True)
        self._process.start()
        self.pid: int = self._process.pid or 0  # never 0: it is started
        receiver.close()
        status.close()
        os.set_blocking(self._setpoints.fileno(), False)  # a message is shorter than PIPE_BUF: whole or not at all
        try:
            if not self._status.poll(START_TIME):
                self._process.kill()
                raise SenderError(f"the command sender has not started within {START_TIME:g} s")
            fault, self.counts = self._status.recv()
        except (EOFError, OSError) as error:
            code = self._process.exitcode
            raise SenderError(f"the command sender ended while starting (exit code {code})") from error
        if fault is not None:
            self._process.join(1.0)
            raise SenderError(fault)
        self._reported = time.monotonic()

    def send(self, setpoint: Setpoint) -> None:
        """Hand over a setpoint; never blocks, never raises."""
        if self._closed or self._rescue is not None:
            return
        try:
            self._setpoints.send_bytes(encode(setpoint))
        except (BlockingIOError, struct.error, AttributeError, TypeError, ValueError):
            self.dropped += 1  # the pipe is full, or this is no setpoint; the dead-man sees to what follows
        except OSError:
            self._lost()
        if not self._process.is_alive():
            self._lost()

    def fault(self) -> str | None:
        """Return why setpoints do not reach the vehicle any more, ``None`` while they do."""
        if self._closed or self._rescue is not None:
            return self._fault
        try:
            self._listen()
        except (EOFError, OSError):
            self._lost()
        if time.monotonic() - self._reported > HUNG:
            self._lost("hung")
        return self._fault

    def _listen(self) -> None:
        """Take the sender's reports. Raises EOFError or OSError when it is gone."""
        while self._status.poll():
            self._fault, self.counts = self._status.recv()
            self._reported = time.monotonic()

    def close(self) -> None:
        """Level-and-disarm frames for ``safety.leave_time``, then the end of the process."""
        if self._closed:
            return
        if self._rescue is None:
            with suppress(OSError):
                self._setpoints.send_bytes(LEAVE)
            self._setpoints.close()
            self._process.join(self._safety.leave_time + 5.0)
            if self._process.exitcode != 0:
                self._lost()
            else:
                with suppress(EOFError, OSError):
                    self._listen()
        if self._rescue is not None:
            self._rescue.join(self._safety.leave_time + 5.0)
        self._closed = True
        self._setpoints.close()
        self._status.close()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _lost(self, how: str = "died") -> None:
        """The sender is gone, or must be: level and disarm from here, through a sink of our own."""
        if self._rescue is None:
            self._process.kill()
            self._process.join(1.0)
            self._fault = f"the command sender {how} (exit code {self._process.exitcode}): disarmed without it"
            self._rescue = threading.Thread(target=self._disarm, name="fip-rescue")
            self._rescue.start()

    def _disarm(self) -> None:
        safety = self._safety
        try:
            sink = self._open_sink()
        except Exception as error:  # whatever a device raises
            self._fault = f"{self._fault}; and it cannot be replaced ({error})"
            return
        end = time.monotonic() + safety.leave_time
        while time.monotonic() < end:
            with suppress(Exception):
                sink.send(disarmed(time.monotonic_ns()))
            time.sleep(1.0 / safety.send_rate)
        with suppress(Exception):
            sink.close()


def _terminate(number: int, frame: FrameType | None) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    raise SystemExit  # no ``except Exception`` keeps it


def urgent(level: int, thread: int = 0) -> bool:
    """Ask for real-time scheduling at a level from 1, for this or another thread, not inherited; was it allowed?"""
    with suppress(OSError, AttributeError):
        os.sched_setscheduler(thread, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(level))
        return True
    return False


def ignore_the_terminal() -> None:
    """Ignore Ctrl-C and a lost terminal: the process that flies handles them, and ends the others."""
    for number in signal.Signals:  # SIGHUP is not everywhere
        if number.name in ("SIGINT", "SIGHUP"):
            signal.signal(number, signal.SIG_IGN)


def _serve(
    open_sink: Callable[[], Sink], params: Params, limits: Limits, receiver: Connection, status: Connection
) -> None:
    """The sender's process."""
    ignore_the_terminal()
    signal.signal(signal.SIGTERM, _terminate)
    urgent(3)
    server = _Server(open_sink, DeadMan(params, limits), limits, status)
    if not server.open():
        return
    try:
        gc.freeze()
        gc.disable()
        server.run(receiver)
    except (SystemExit, EOFError, OSError):
        pass  # the other side is gone, or wants us gone
    finally:
        server.leave()


class _Server:
    def __init__(self, open_sink: Callable[[], Sink], dead_man: DeadMan, limits: Limits, status: Connection) -> None:
        self._open_sink, self._dead_man, self._status = open_sink, dead_man, status
        self._sink: Sink | None = None
        self._period, self._leave_time = round(NANO / limits.safety.send_rate), limits.safety.leave_time
        self._counts = Counts()
        self._trouble: str | None = None
        self._tried = self._reported = 0
        os.set_blocking(status.fileno(), False)  # nobody may be reading any more

    def open(self) -> bool:
        try:
            self._sink = self._open_sink()
        except Exception as error:  # whatever a device raises
            self._trouble = str(error) or type(error).__name__
        self._report()
        return self._sink is not None

    def run(self, receiver: Connection) -> None:
        due = time.monotonic_ns()
        while True:
            receiver.poll(max(0.0, (due - time.monotonic_ns()) / NANO))
            fresh = False
            while receiver.poll():
                data = receiver.recv_bytes()
                if data == LEAVE:
                    return
                self._dead_man.hear(time.monotonic_ns(), decode(data))
                fresh = True
            now = time.monotonic_ns()
            if fresh or now >= due:
                self._send(self._dead_man.due(now), not fresh)
                due = now + round(PATIENCE * self._period) if fresh else max(due + self._period, now)
            if now - self._reported > HEARTBEAT * NANO:
                self._report()

    def leave(self) -> None:
        end = time.monotonic() + self._leave_time
        while time.monotonic() < end:
            self._send(disarmed(time.monotonic_ns()), True)
            time.sleep(self._period / NANO)
        self._report()
        if self._sink is not None:
            with suppress(Exception):
                self._sink.close()

    def _send(self, setpoint: Setpoint, repeated: bool) -> None:
        counts = self._counts
        try:
            if self._sink is None and time.monotonic_ns() - self._tried > REOPEN * NANO:
                self._tried = time.monotonic_ns()
                self._sink = self._open_sink()
            if self._sink is not None:
                self._sink.send(setpoint)
                self._trouble = None
                self._counts = counts._replace(sent=counts.sent + 1, repeated=counts.repeated + repeated)
        except Exception as error:  # whatever a device raises
            self._counts = counts._replace(failed=counts.failed + 1)
            self._trouble = f"commands cannot be sent ({error or type(error).__name__})"
            if self._sink is not None:
                with suppress(Exception):
                    self._sink.close()
            self._sink = None

    def _report(self) -> None:
        self._reported = time.monotonic_ns()
        self._counts = self._counts._replace(rejected=self._dead_man.rejected, clamped=self._dead_man.clamped)
        with suppress(OSError):  # full, or nobody there
            self._status.send((self._trouble or self._dead_man.fault, self._counts))
