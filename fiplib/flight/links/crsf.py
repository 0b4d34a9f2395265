"""``--link crsf``: commands as CRSF frames to a radio's transmitter module on a serial port; poses come from elsewhere.

``--poses ros2`` takes them from ROS 2 topics. ``--poses sim`` is the bench test: the simulated vehicle flies on the
same setpoints as the frames carry, so that radio, receiver and motors (without propellers) can be watched meanwhile.
The port belongs to the command sender's process. Tried over pseudo-terminals only, never with a radio; docs/radio.md.
"""

import argparse
import errno
import functools
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Self

from fiplib.flight.crsf_frames import BAUDS, FRAME_BYTES, Encoder
from fiplib.flight.limits import Limits, Radio
from fiplib.flight.links import LinkError, PoseSource, RelayLink
from fiplib.flight.links.ros2 import Ros2Poses
from fiplib.flight.links.simulated import SimulatedLink
from fiplib.flight.setpoint import Setpoint
from fiplib.params import NANO, Params
from fiplib.simulate import Scenario

QUEUE = 4 * FRAME_BYTES
"""Bytes that may wait in a port before a frame is left out rather than delayed."""
STUCK = 0.1
"""A port that takes no frame for so long is broken, s; as ``safety.pose_level``."""
DRAIN = 0.05
"""Longest wait for the last frames to leave the port, s; 26 bytes take 2.3 ms at the lowest rate."""


def _baud(text: str) -> str:
    """Return ``--crsf-baud N`` as ``--set`` takes it: a bag carries the rate among its parameters either way."""
    if text not in map(str, BAUDS):
        raise argparse.ArgumentTypeError(f"choose from {', '.join(map(str, sorted(BAUDS)))}")
    return f"radio.baud={text}"


class CrsfLink(RelayLink):
    """Setpoints out through a serial port, frames in from ``poses``.

    Args:
        port: the device.
        poses: not yet open.
        mirror: is given each setpoint, too: a simulated vehicle that flies along.
    """

    name = "crsf"

    def __init__(
        self,
        port: str,
        poses: PoseSource,
        params: Params,
        limits: Limits,
        mirror: Callable[[Setpoint], None] | None = None,
    ) -> None:
        super().__init__(poses, functools.partial(CrsfSink, port, params, limits), params, limits)
        self._mirror = mirror

    @staticmethod
    def arguments(parser: argparse._ArgumentGroup) -> None:
        port = "serial port of the radio's transmitter module, e.g. /dev/ttyUSB0"
        parser.add_argument("--crsf-port", metavar="DEVICE", help=port)
        parser.add_argument(
            "--crsf-baud",
            type=_baud,
            action="append",
            dest="set",
            default=argparse.SUPPRESS,
            metavar="N",
            help=f"its bits per second (default: the parameter radio.baud, {Radio().baud})",
        )
        poses = (
            "poses of ROS 2 topics, or of the simulated vehicle: a bench test without propellers (default: %(default)s)"
        )
        parser.add_argument("--poses", choices=("ros2", "sim"), default="ros2", help=poses)

    @classmethod
    def from_options(cls, options: argparse.Namespace, scenario: Scenario, limits: Limits) -> Self:
        if not options.crsf_port:
            raise ValueError("--link crsf: name the serial port of the transmitter module with --crsf-port")
        Encoder(scenario.params, limits)  # whether the mapping makes sense
        check(Path(options.crsf_port))  # now, before anything is recorded
        if options.poses == "sim":
            vehicle = SimulatedLink(scenario, limits)
            return cls(options.crsf_port, vehicle, scenario.params, limits, vehicle.send)
        return cls(options.crsf_port, Ros2Poses.from_options(options, scenario), scenario.params, limits)

    def send(self, setpoint: Setpoint) -> None:
        super().send(setpoint)
        if self._mirror is not None:
            self._mirror(setpoint)


class CrsfSink:
    """Setpoints as frames into a serial port, each whole or not at all. Raises LinkError if it cannot be opened."""

    def __init__(self, port: str, params: Params, limits: Limits) -> None:
        self._name, self._encoder = port, Encoder(params, limits)
        check(Path(port))
        import serial

        try:  # for us alone, 8 data bits, no parity, 1 stop bit
            self._port = serial.Serial(port, limits.radio.baud, timeout=0, exclusive=True)
        except (OSError, ValueError) as error:
            busy = isinstance(error, OSError) and error.errno in (errno.EAGAIN, errno.EBUSY)
            raise LinkError(f"cannot open {port}: {'another program uses it' if busy else _reason(error)}") from error
        self._rest = b""
        self._taken = time.monotonic_ns()

    def send(self, setpoint: Setpoint) -> None:
        """Put one frame out. Raises OSError when the port is gone or stuck; never waits."""
        now = time.monotonic_ns()
        frame = self._encoder.frame(now, setpoint)
        try:
            with _plain_errors():
                self._port.reset_input_buffer()  # telemetry, or the echo on a single wire
                if self._port.out_waiting <= QUEUE and self._write(frame):
                    self._taken = now
        except OSError as error:
            raise OSError(f"{self._name} is gone ({_reason(error)}): is the module still plugged in?") from error
        if now - self._taken > STUCK * NANO:
            raise OSError(f"{self._name} takes no bytes: check module and adapter")

    def _write(self, frame: bytes) -> bool:
        """Whether any of the frame was taken; what is left of one that has begun goes out before the next one."""
        data = self._rest + frame
        try:
            taken = os.write(self._port.fileno(), data)
        except BlockingIOError:
            return False
        begun = taken > len(self._rest) or not self._rest
        self._rest = data[taken:] if begun else self._rest[taken:]
        return begun

    def close(self) -> None:
        end = time.monotonic() + DRAIN
        with suppress(OSError), _plain_errors():
            while self._port.out_waiting and time.monotonic() < end:
                time.sleep(0.001)
            if self._port.out_waiting:
                self._port.reset_output_buffer()  # else the system waits for a stuck port, up to half a minute
        self._port.close()


@contextmanager
def _plain_errors() -> Iterator[None]:
    """A terminal's errors as ``OSError``: when a cable is pulled, pyserial lets some through as ``termios.error``."""
    try:
        import termios
    except ImportError:  # not on Windows
        yield
        return
    try:
        yield
    except termios.error as error:
        raise OSError(*error.args) from error


def check(port: Path) -> None:
    """Raise LinkError, with what to do, if this cannot be a serial port that we may use."""
    try:
        from serial.tools.list_ports import comports
    except ImportError as error:
        raise LinkError('--link crsf needs pyserial: pip install -e ".[flight]"') from error
    if not port.exists():
        found = ", ".join(one.device for one in comports()) or "none"
        raise LinkError(f"no serial port {port}: is the module plugged in? Ports here: {found}")
    if not port.is_char_device():
        raise LinkError(f"{port} is not a serial port")
    if not os.access(port, os.R_OK | os.W_OK):
        raise LinkError(f"no permission to use {port}: join the group that owns it, often dialout, and log in again")


def _reason(error: Exception) -> str:
    return os.strerror(error.errno) if isinstance(error, OSError) and error.errno else str(error)
