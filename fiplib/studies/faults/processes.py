"""Faults of processes: flights in real time whose processes are killed or stopped, with a witness outside.

A flight runs in a process of its own, as ``fip fly --real-time`` does, and starts those of the sender, the recorder,
the estimator and the simulated vehicle. Of these flights the table keeps what does not depend on timing.
"""

import argparse
import contextlib
import functools
import json
import math
import os
import re
import select
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from fiplib.bags.writer import RESERVE
from fiplib.flight import command
from fiplib.flight.failsafe import Guard
from fiplib.flight.limits import Limits
from fiplib.flight.links.simulated import LoopbackSink, SimulatedLink
from fiplib.flight.loop import FlightLoop
from fiplib.flight.sender import decode, encode
from fiplib.flight.session import Session
from fiplib.flight.setpoint import Mode, Setpoint
from fiplib.params import NANO, FipError, Params
from fiplib.pilot import Pilot
from fiplib.recording import Measurement
from fiplib.studies.faults import judging
from fiplib.studies.faults.judging import Commands, Fault

HIT = 2.0
"""Processes are hit at this time after take-off, s; push-hover pushes at 5.3 s."""
ENDED = 2.5
"""A flight is over when nothing is heard of it for so long, s."""
WITNESS = struct.Struct("<cq")
"""Header of a message to the witness: its kind and the monotonic time, ns; a setpoint, a true state or JSON follow."""
TRUTH = struct.Struct("<11d")
HOVER = ("--scenario", "push-hover", "--duration", "7")
ESTIMATED = ("--scenario", "estimate-1.2", "--duration", "16", "--set", "safety.estimator_timeout=1.0")


@dataclass(frozen=True)
class ProcessFault(Fault):
    """A fault that is done to the processes of a flight in real time: by ``hit``, ``HIT`` s after take-off.

    ``arguments`` are those of the flight, which is recorded on a disk of ``disk`` bytes; 0: on the usual one.
    """

    hit: Callable[["Witness"], None] = field(kw_only=True)
    arguments: tuple[str, ...] = HOVER
    disk: int = 0

    def fly(self, phase: str) -> dict[str, Any]:
        with tempfile.TemporaryDirectory() as folder, Witness() as witness, contextlib.ExitStack() as stack:
            place = Path(folder) / "disk"
            place.mkdir()
            if self.disk:
                small_disk(place, self.disk)
                stack.callback(subprocess.run, ["umount", "--lazy", str(place)], check=False)
            arguments = ["--real-time", "--output", str(place / "bag"), *self.arguments]
            flight = [sys.executable, "-m", __name__, str(witness.port), *arguments]
            with open(Path(folder) / "words", "w+") as words:
                # a session of its own: signals of the terminal are not meant for it
                process = subprocess.Popen(flight, stdout=words, stderr=words, start_new_session=True)
                try:
                    began = took_off(witness, process)
                    while (time.monotonic_ns() - began) / NANO < HIT:
                        witness.hear(0.05)
                    clock = time.time_ns()
                    self.hit(witness)
                    until = time.monotonic() + 60.0
                    while (witness.hear(ENDED) or process.poll() is None) and time.monotonic() < until:
                        pass
                finally:
                    killed = end_all(process, witness)
                words.seek(0)
                said = words.read()
            bag = bag_after(place / "bag", clock, bool(witness.recording))
        return self._judged(witness, began, said, process.returncode, killed, bag)

    def _judged(self, witness: "Witness", began: int, said: str, code: int, killed: bool, bag: str) -> dict[str, Any]:
        """Return the row: what does not depend on the flight's timing."""
        sent = [(at, setpoint) for at, setpoint in witness.commands if at >= began]
        commands = Commands.of(sent, Params(), Limits())
        up = max(at for at, setpoint in sent if setpoint.armed and setpoint.mode is not Mode.LEVEL)
        duration = float(self.arguments[self.arguments.index("--duration") + 1])
        upright = all(math.hypot(*truth[[4, 6]]) < 0.4 for at, truth in witness.truths if at <= up)
        # the flight ends with the first frame after its duration
        balanced = (up - began) / NANO > duration - 0.1 and upright
        off = commands.disarming[0] if len(commands.disarming) else commands.last_armed
        stopped = next((truth for at, truth in witness.truths if at > off), None)
        level = stopped is None or judging.tilt_of(stopped) < judging.LEVEL
        vehicle = "gone" if stopped is None else judging.given_up(stopped)
        error = "did not end" if killed else "yes" if "Traceback" in said else "no"
        safe = error == "no" and commands.safe and "LOST" not in bag.upper()
        held, perfect = commands.disarm_seconds, self.demanded != judging.DEAD
        words = f"longest gap {commands.longest_gap:.0f} ms, {held:.2f} s disarmed, exit {code}: {said.strip()[-300:]}"
        tqdm.write(f"{self.what}: {words}", sys.stderr)
        return self.row(
            vehicle=judging.BALANCED if balanced else vehicle,
            ended=re.sub(r"\d+ ms old", "too old", witness.ended),
            not_finite=commands.not_finite,
            out_of_bounds=commands.out_of_bounds,
            disarm_s=f">={judging.DISARM_SECONDS:g}" if held >= judging.DISARM_SECONDS else f"{held:.2f}",
            uncaught_exception=error,
            bag=bag,
            perfect_information=judging.BALANCED if perfect else "rod lost",
            verdict=judging.judge(safe, balanced, level, perfect, None, self.demanded),
        )


class Witness(socket.socket):
    """A socket that hears every command on its way to the vehicle and every true state of it, whatever dies.

    ``commands`` and ``truths`` are (time in ns, setpoint or true state (11,)), ``pids`` those of the flight's
    processes, by name; ``ended`` and ``recording`` say why the flight did not balance to its end and its recording
    stopped, if it says so.
    """

    def __init__(self) -> None:
        super().__init__(socket.AF_INET, socket.SOCK_DGRAM)
        self.bind(("127.0.0.1", 0))
        self.port: int = self.getsockname()[1]
        self.commands: list[tuple[int, Setpoint]] = []
        self.truths: list[tuple[int, NDArray]] = []
        self.pids: dict[str, int] = {}
        self.ended = self.recording = ""

    def hear(self, seconds: float) -> bool:
        """Take what comes within so many seconds; return whether anything did."""
        end, heard = time.monotonic() + seconds, False
        while (left := end - time.monotonic()) > 0 and select.select([self], [], [], left)[0]:
            data = self.recv(65536)
            kind, at = WITNESS.unpack_from(data)
            rest, heard = data[WITNESS.size :], True
            if kind == b"C":
                self.commands.append((at, decode(rest)))
            elif kind == b"T":
                self.truths.append((at, np.array(TRUTH.unpack(rest))))
            elif kind == b"P":
                self.pids = json.loads(rest)
            else:
                self.ended, self.recording = json.loads(rest)
        return heard


def tell(port: int, kind: bytes, data: bytes) -> None:
    """Report to the witness, if it is still there."""
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        out.sendto(WITNESS.pack(kind, time.monotonic_ns()) + data, ("127.0.0.1", port))


class TappedSink(LoopbackSink):
    """The way to the simulated vehicle, with a copy for the witness."""

    def __init__(self, port: int, address: tuple[str, int]) -> None:
        super().__init__(address)
        self._port = port

    def send(self, setpoint: Setpoint) -> None:
        super().send(setpoint)
        tell(self._port, b"C", encode(setpoint))


def tell_truth(port: int, frame: Measurement, truth: NDArray) -> None:
    """Report a true state to the witness, from the vehicle's process."""
    tell(port, b"T", TRUTH.pack(*truth))


def fly_tapped(port: int, arguments: list[str]) -> int:
    """Fly as ``fip fly`` does with these arguments; every command and every true state is reported to the witness."""
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    options = parser.parse_args(arguments)
    scenario, limits = command.chosen(options)
    link = SimulatedLink(scenario, limits, functools.partial(TappedSink, port), functools.partial(tell_truth, port))
    ended = stopped = ""

    def report(loop: FlightLoop, session: Session) -> None:
        nonlocal ended
        if loop.clockwork.ticks % 30 == 1:
            tell(port, b"P", json.dumps(session.pids).encode())
        ended = "" if loop.balanced else loop.guard.ended or ""

    session = Session(scenario, limits, link, Path(options.output), real_time=True)
    try:
        status = command.fly(session, Guard(Pilot(scenario.params, scenario.reference), limits), report)
    except FipError as error:
        print(error, file=sys.stderr)
        stopped, status = str(error), 2
    tell(port, b"E", json.dumps([ended, stopped]).encode())
    return status


def stop(process: str, seconds: float = math.inf) -> Callable[[Witness], None]:
    """Return what stops a process, and lets it go on after so many seconds."""

    def hit(witness: Witness) -> None:
        pid = witness.pids[process]
        os.kill(pid, signal.SIGSTOP)
        if seconds < math.inf:
            witness.hear(seconds)
            os.kill(pid, signal.SIGCONT)

    return hit


def send(process: str, *names: str, times: int = 1) -> Callable[[Witness], None]:
    """Return what sends signals to a process, or to those that are started in its place."""

    def hit(witness: Witness) -> None:
        for _ in range(times):
            for name in names:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(witness.pids[process], getattr(signal, name))
                witness.hear(0.2)
            if times > 1:
                witness.hear(3.0)

    return hit


def both(witness: Witness) -> None:
    """Kill recorder and pilot at once."""
    for name in ("recorder", "pilot"):
        os.kill(witness.pids[name], signal.SIGKILL)


def took_off(witness: Witness, process: subprocess.Popen) -> int:
    """Wait for the first armed command; return when it was sent, ns."""
    end = time.monotonic() + 120.0
    while time.monotonic() < end and process.poll() is None:
        witness.hear(0.1)
        armed = [at for at, setpoint in witness.commands if setpoint.armed]
        if armed and witness.pids:
            return armed[0]
    raise RuntimeError(f"the flight has not begun (exit code {process.poll()})")


def end_all(process: subprocess.Popen, witness: Witness) -> bool:
    """End what is left of a flight; return whether its own process had to be killed."""
    left = process.poll() is None
    process.kill()
    process.wait()
    time.sleep(0.3)
    for name, pid in witness.pids.items():
        if name != "pilot" and pid:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(pid, signal.SIGKILL)
    return left


def small_disk(place: Path, size: int) -> None:
    """Mount a disk with so many bytes. Raises OSError where none can be mounted."""
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "fip", str(place)]
    mounted = subprocess.run(mount, capture_output=True, text=True, check=False)
    if mounted.returncode:
        raise OSError(f"no small disk can be mounted here: {mounted.stderr.strip()}")


def bag_after(bag: Path, struck: int, stopped: bool) -> str:
    """Return the state of a recording, ``stopped`` in flight or not, and what it misses up to ``struck``, ns."""
    state, flight = judging.read_back(bag)
    if flight is None:
        return state
    missing = (struck - int(flight.command.stamp[-1])) / NANO
    if missing > 1.0:
        return f"{state}, MORE THAN 1 s LOST"
    state += ", up to the fault" if stopped or state == "recovered" else ""
    return state if missing <= 0.0 or state == "valid" else f"{state} but for 1 s at most"


def _process(what: str, hit: Callable[[Witness], None], *arguments: str, **more: Any) -> ProcessFault:
    phase = "circle" if arguments else "hover"
    return ProcessFault("process", what, (phase,), hit=hit, arguments=arguments or HOVER, **more)


def _sender(what: str, seconds: float = math.inf, **more: Any) -> ProcessFault:
    return ProcessFault("link", what, hit=stop("sender", seconds), **more)


def _operator(what: str, *signals: str) -> ProcessFault:
    return ProcessFault("operator", what, hit=send("pilot", *signals), demanded=judging.OPERATOR)


PROCESS_FAULTS = {
    "kill-pilot": _process("kill -9 of the pilot", send("pilot", "SIGKILL"), demanded=judging.DEAD),
    "kill-sender": _process("kill -9 of the command sender", send("sender", "SIGKILL"), demanded=judging.DEAD),
    "kill-vehicle": _process("kill -9 of the simulated vehicle", send("vehicle", "SIGKILL"), demanded=judging.DEAD),
    "kill-estimator": _process("kill -9 of the estimator", send("estimator", "SIGKILL"), *ESTIMATED),
    "kill-estimators": _process("kill -9 of each estimator started", send("estimator", "SIGKILL", times=4), *ESTIMATED),
    "kill-recorder": _process("kill -9 of the recorder", send("recorder", "SIGKILL")),
    "kill-pilot-and-recorder": _process("kill -9 of pilot and recorder", both, demanded=judging.DEAD),
    "hang-estimator": _process("estimator hangs from then on", stop("estimator"), *ESTIMATED),
    "hang-recorder": _process("recorder hangs for 2 s, as on a stalled disk", stop("recorder", 2.0)),
    "hang-sender-50ms": _sender("sender blocked for 50 ms", 0.05),
    "hang-sender-150ms": _sender("sender blocked for 150 ms", 0.15),
    "hang-sender": _sender("sender blocked from then on", demanded=judging.DEAD),
    "hang-pilot-50ms": _process("pilot hangs for 50 ms", stop("pilot", 0.05)),
    "hang-pilot-150ms": _process("pilot hangs for 150 ms", stop("pilot", 0.15)),
    "hang-pilot-2s": _process("pilot hangs for 2 s", stop("pilot", 2.0), demanded=judging.PULSE),
    "disk-full": ProcessFault("recording", "disk full in flight", hit=lambda witness: None, disk=RESERVE + (150 << 10)),
    "ctrl-c": _operator("Ctrl-C", "SIGINT"),
    "ctrl-c-twice": _operator("Ctrl-C twice: motors off", "SIGINT", "SIGINT"),
    "terminal-lost": _operator("terminal lost (SIGHUP)", "SIGHUP"),
    "told-to-end": _operator("told to end (SIGTERM)", "SIGTERM"),
}
"""The faults of processes, by name."""


if __name__ == "__main__":
    sys.exit(fly_tapped(int(sys.argv[1]), sys.argv[2:]))
