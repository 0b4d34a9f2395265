"""``--link sim``: the simulated vehicle, in virtual time or against the wall clock.

``VirtualLink`` moves the vehicle by one frame whenever a frame is asked for: as fast as possible, and the same every
time. ``SimLink`` gives the vehicle a process of its own that runs in real time and talks datagrams on the loopback
interface, as a real one talks radio: commands come from the sender's process, frames go to the pilot's. In both the
vehicle is held in place until it is first commanded with armed motors.
"""

import argparse
import functools
import gc
import multiprocessing
import select
import socket
import struct
import time
from contextlib import suppress
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from fiplib.flight.links import Link, LinkError
from fiplib.flight.sender import Sender, SenderError, decode, encode, ignore_the_terminal, urgent
from fiplib.flight.setpoint import Setpoint
from fiplib.params import NANO
from fiplib.recording import EPOCH, Measurement
from fiplib.simulate import Scenario, SimulatedVehicle

FRAME = struct.Struct("<q25d")
"""A frame on its way to the pilot: stamp, the 14 numbers of two poses, the 11 of the true state."""
START_TIME = 60.0
"""A process on a busy machine may take that long to import NumPy and CasADi, s."""


class HeldVehicle(SimulatedVehicle):
    """The simulated vehicle, held in place until first commanded with armed motors."""

    def command(self, command: Setpoint, at: int | None = None) -> None:
        if command.armed or self.flown is not None:
            super().command(command, at)


class VirtualLink:
    """The simulated vehicle in virtual time: a frame per ``receive``, each a frame's period after the last."""

    origin = "simulated"

    def __init__(self, scenario: Scenario) -> None:
        self.vehicle = HeldVehicle(scenario)
        self.truth: NDArray | None = None
        self._rate = scenario.params.piloting.mocap_rate
        self._latency = round(scenario.params.simulation.mocap_latency * NANO)
        self._index = -1
        self._now = EPOCH

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        pass

    def now(self) -> int:
        return self._now

    def receive(self, timeout: float) -> tuple[int, Measurement] | None:
        if self._index >= 0:
            self.vehicle.advance()
        self._index += 1
        stamp = EPOCH + round(self._index * NANO / self._rate)
        self._now = stamp + self._latency
        self.truth = self.vehicle.plant.truth()
        return self._now, self.vehicle.measure(stamp)

    def send(self, setpoint: Setpoint) -> None:
        self.vehicle.command(setpoint)

    def fault(self) -> str | None:
        return None


class SimLink:
    """The simulated vehicle in real time, in its own process."""

    origin = "simulated"

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self.truth: NDArray | None = None
        self._offset = time.time_ns() - time.monotonic_ns()

    @staticmethod
    def arguments(parser: argparse.ArgumentParser) -> None:
        parser.add_argument(
            "--real-time",
            action="store_true",
            help="against the wall clock, with failsafe, estimator and command sender in processes of their own",
        )
        parser.add_argument(
            "--failsafe", action="store_true", help="as fast as possible, but with the failsafe around the pilot"
        )

    @classmethod
    def from_options(cls, options: argparse.Namespace, scenario: Scenario) -> Link:
        return cls(scenario) if options.real_time else VirtualLink(scenario)

    def __enter__(self) -> Self:
        self._frames, commands = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
        for one in (self._frames, commands):
            one.bind(("127.0.0.1", 0))
        self._frames.setblocking(False)
        context = multiprocessing.get_context("spawn")
        ready, tell = context.Pipe(duplex=False)
        self._process = context.Process(
            target=_fly_vehicle,
            args=(self.scenario, commands, self._frames.getsockname(), self._offset, tell),
            name="fip-vehicle",
            daemon=True,
        )
        self._process.start()
        tell.close()
        address = commands.getsockname()
        commands.close()
        try:
            # both processes start at once
            self._sender = Sender(functools.partial(LoopbackSink, address), self.scenario.params)
            if not ready.poll(START_TIME):
                raise LinkError(f"the simulated vehicle has not started within {START_TIME:g} s")
            ready.recv()
        except (EOFError, OSError, SenderError, LinkError) as error:
            self._process.kill()
            raise LinkError(f"--link sim: {error or 'the simulated vehicle ended while starting'}") from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._sender.close()
        self._process.kill()
        self._process.join()
        self._frames.close()

    @property
    def pids(self) -> dict[str, int | None]:
        """Process ids of ``vehicle`` and ``sender``."""
        return {"vehicle": self._process.pid, "sender": self._sender.pid}

    def now(self) -> int:
        return time.monotonic_ns() + self._offset

    def receive(self, timeout: float) -> tuple[int, Measurement] | None:
        if not select.select([self._frames], [], [], max(0.0, timeout))[0]:
            return None
        try:
            data = self._frames.recv(65536)
            stamp, *numbers = FRAME.unpack(data)
        except (OSError, struct.error):
            return None
        values = np.array(numbers)
        self.truth = values[14:]
        return self.now(), Measurement(stamp, values[:3], values[3:7], values[7:10], values[10:14])

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


def _fly_vehicle(
    scenario: Scenario,
    commands: socket.socket,
    frames: tuple[str, int],
    offset: int,
    tell: "multiprocessing.connection.Connection",
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
            packet = FRAME.pack(frame.stamp, *np.concatenate(frame[1:]), *truth)
            with suppress(OSError):
                commands.sendto(packet, frames)
            vehicle.advance()
            index += 1
