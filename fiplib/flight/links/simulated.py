"""``--link sim``: the simulated vehicle, in virtual time (the same flight every time) or against the wall clock.

``SimulatedLink`` gives the vehicle a process of its own that runs in real time and exchanges datagrams on the loopback
interface, in place of a radio: commands come from the sender's process, frames go to the pilot's.
"""

import argparse
import functools
import gc
import multiprocessing
import select
import socket
import struct
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Self

import numpy as np
from numpy.typing import NDArray

from fiplib.flight.limits import Limits
from fiplib.flight.links import Link, LinkError
from fiplib.flight.sender import (
    SPAWN,
    START_TIME,
    Sender,
    SenderError,
    Sink,
    decode,
    encode,
    ignore_the_terminal,
    urgent,
)
from fiplib.flight.setpoint import Setpoint
from fiplib.params import NANO
from fiplib.recording import EPOCH, Event, Measurement
from fiplib.simulate import Push, Scenario, SimulatedVehicle

FRAME = struct.Struct("<q25d3d")
"""A frame on its way to the pilot: stamp, the 14 numbers of two poses, the 11 of the true state; of a push that has
begun since the frame before, impulse (2) and duration, else zeros."""

FrameTap = Callable[[Measurement, NDArray], None]
"""Called in the vehicle's process with each frame and the true state (11,) at its exposure; must pickle."""


class HeldVehicle(SimulatedVehicle):
    """The simulated vehicle, held in place until it is first commanded with armed motors."""

    def command(self, command: Setpoint, at: int | None = None) -> None:
        if command.armed or self.flown is not None:
            super().command(command, at)


class VirtualLink(Link):
    """The simulated vehicle, or another ``vehicle``, in virtual time: a frame per ``receive``, one period further."""

    name, origin = "sim", "simulated"

    def __init__(self, scenario: Scenario, vehicle: HeldVehicle | None = None) -> None:
        self.vehicle = vehicle or HeldVehicle(scenario)
        self.events: deque[Event] = deque()
        self._rate = scenario.params.piloting.mocap_rate
        self._latency = round(scenario.params.simulation.mocap_latency * NANO)
        self._index = -1
        self._now = EPOCH

    def now(self) -> int:
        return self._now

    def receive(self, timeout: float) -> tuple[int, Measurement] | None:
        if self._index >= 0 and (push := self.vehicle.advance()):
            self.events.append(push.event(self._now))
        self._index += 1
        stamp = EPOCH + round(self._index * NANO / self._rate)
        self._now = stamp + self._latency
        self.truth = self.vehicle.plant.truth()
        return self._now, self.vehicle.measure(stamp)

    def send(self, setpoint: Setpoint) -> None:
        self.vehicle.command(setpoint)


class SimulatedLink(Link):
    """The simulated vehicle in real time, in its own process.

    Args:
        limits: those of the command sender.
        sink: makes the sender's way out to the vehicle's address, in the sender's process; must pickle.
        tap: called in the vehicle's process with each frame.

    Attributes:
        frames: the socket on which frames arrive, once entered.
        offset: what the link's clock is ahead of ``time.monotonic_ns``, ns.
    """

    name, origin = "sim", "simulated"

    def __init__(
        self,
        scenario: Scenario,
        limits: Limits,
        sink: "Callable[[tuple[str, int]], Sink] | None" = None,
        tap: FrameTap | None = None,
    ) -> None:
        self.scenario, self._limits = scenario, limits
        self._open_sink, self._tap = sink or LoopbackSink, tap
        self.events: deque[Event] = deque()
        self.offset = time.time_ns() - time.monotonic_ns()

    @staticmethod
    def arguments(parser: argparse._ArgumentGroup) -> None:
        real_time = "against the wall clock, with failsafe, estimator and command sender in processes of their own"
        parser.add_argument("--real-time", action="store_true", help=real_time)
        failsafe = "as fast as possible, but with the failsafe around the pilot"
        parser.add_argument("--failsafe", action="store_true", help=failsafe)

    @classmethod
    def from_options(cls, options: argparse.Namespace, scenario: Scenario, limits: Limits) -> Link:
        return cls(scenario, limits) if options.real_time else VirtualLink(scenario)

    def __enter__(self) -> Self:
        self.frames, commands = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
        for one in (self.frames, commands):
            one.bind(("127.0.0.1", 0))
        self.frames.setblocking(False)
        ready, tell = SPAWN.Pipe(duplex=False)
        task = (self.scenario, commands, self.frames.getsockname(), self.offset, tell, self._tap)
        self._process = SPAWN.Process(target=fly_vehicle, args=task, name="fip-vehicle", daemon=True)
        self._process.start()
        tell.close()
        address = commands.getsockname()
        commands.close()
        try:
            # both processes start at once
            self._sender = Sender(functools.partial(self._open_sink, address), self.scenario.params, self._limits)
            if not ready.poll(START_TIME):
                raise LinkError(f"the simulated vehicle has not started within {START_TIME:g} s")
            ready.recv()
        except (EOFError, OSError, SenderError, LinkError) as error:
            self._process.kill()
            raise LinkError(f"--link sim: {error or 'the simulated vehicle ended while starting'}") from error
        assert self._process.pid is not None
        self.pids = {"vehicle": self._process.pid, "sender": self._sender.pid}
        return self

    def __exit__(self, *_: object) -> None:
        self._sender.close()
        self._process.kill()
        self._process.join()
        self.frames.close()

    def now(self) -> int:
        return time.monotonic_ns() + self.offset

    def receive(self, timeout: float) -> tuple[int, Measurement] | None:
        if not select.select([self.frames], [], [], max(0.0, timeout))[0]:
            return None
        try:
            stamp, *numbers = FRAME.unpack(self.frames.recv(65536))
        except (OSError, struct.error):
            return None
        now, values = self.now(), np.array(numbers)
        self.truth = values[14:25]
        if values[27]:
            self.events.append(Push(0.0, (numbers[25], numbers[26]), numbers[27]).event(now))
        return now, Measurement(stamp, values[:3], values[3:7], values[7:10], values[10:14])

    def send(self, setpoint: Setpoint) -> None:
        self._sender.send(setpoint)

    def fault(self) -> str | None:
        if not self._process.is_alive():
            return f"the simulated vehicle's process died (exit code {self._process.exitcode})"
        return self._sender.fault()


class LoopbackSink:
    """Setpoints as datagrams to the simulated vehicle's process."""

    def __init__(self, address: tuple[str, int]) -> None:
        self._address = address
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)

    def send(self, setpoint: Setpoint) -> None:
        self._socket.sendto(encode(setpoint), self._address)

    def close(self) -> None:
        self._socket.close()


def fly_vehicle(
    scenario: Scenario,
    commands: socket.socket,
    frames: tuple[str, int],
    offset: int,
    tell: Connection,
    tap: FrameTap | None,
) -> None:
    """The vehicle's process: a frame is exposed at every period, and delivered after motion capture's latency."""
    ignore_the_terminal()
    urgent(2)
    commands.setblocking(False)
    parent = multiprocessing.parent_process()
    vehicle = HeldVehicle(scenario)
    rate, simulation = scenario.params.piloting.mocap_rate, scenario.params.simulation
    latency = round(simulation.mocap_latency * NANO)
    gc.freeze()
    gc.disable()  # a collection takes longer than a tick; nothing here makes cycles
    tell.send("ready")
    start, held, index = time.monotonic_ns(), 0, 0
    push: Push | None = None
    with suppress(BrokenPipeError):
        while parent is None or index % 240 or parent.is_alive():
            exposure = start + round(index * NANO / rate)
            while (left := exposure + latency - time.monotonic_ns()) > 0:
                if not select.select([commands], [], [], left / NANO)[0]:
                    continue
                with suppress(OSError, struct.error):
                    setpoint = decode(commands.recv(65536))
                    if vehicle.flown is None:
                        held = exposure
                    # the plant's clock started when the vehicle was let go
                    since = (time.monotonic_ns() - held) / NANO + simulation.rate_delay
                    vehicle.command(setpoint, round(since * simulation.plant_rate))
            truth, frame = vehicle.plant.truth(), vehicle.measure(exposure + offset)
            pushed = (*push.impulse, push.duration) if push else (0.0, 0.0, 0.0)
            packet = FRAME.pack(frame.stamp, *np.concatenate(frame[1:]), *truth, *pushed)
            with suppress(OSError):
                commands.sendto(packet, frames)
            if tap is not None:
                tap(frame, truth)
            push = vehicle.advance()
            index += 1
