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
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from numpy.typing import NDArray

from fiplib.flight.crsf_frames import BAUDS, FRAME_BYTES, Encoder
from fiplib.flight.limits import Limits, Radio
from fiplib.flight.links import LinkError, PoseSource
from fiplib.flight.links.ros2 import Ros2Poses
from fiplib.flight.links.simulated import SimulatedLink
from fiplib.flight.sender import Sender, SenderError
from fiplib.flight.setpoint import Setpoint
from fiplib.params import NANO, Params
from fiplib.recording import Measurement
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


class CrsfLink:
    """Setpoints out through a serial port, frames in from ``poses``.

    Args:
        port: the device.
        poses: not yet open.
        params: ``vehicle`` and ``pendulum``.
        limits: ``radio`` and ``safety``.
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
        self.origin, self.events = poses.origin, poses.events
        self._port, self._poses, self._params, self._limits, self._mirror = port, poses, params, limits, mirror
        self.pids: dict[str, int] = {}

    @staticmethod
    def arguments(parser: argparse._ArgumentGroup) -> None:
        parser.add_argument(
            "--crsf-port", metavar="DEVICE", help="serial port of the radio's transmitter module, e.g. /dev/ttyUSB0"
        )
        parser.add_argument(
            "--crsf-baud",
            type=_baud,
            action="append",
            dest="set",
            default=argparse.SUPPRESS,
            metavar="N",
            help=f"its bits per second (default: the parameter radio.baud, {Radio().baud})",
        )
        parser.add_argument(
            "--poses",
            choices=("ros2", "sim"),
            default="ros2",
            help="where poses come from: ROS 2 topics, or the simulated vehicle, which is a bench test with the "
            "propellers taken off (default: %(default)s)",
        )

    @classmethod
    def from_options(cls, options: argparse.Namespace, scenario: Scenario, limits: Limits) -> Self:
        if not options.crsf_port:
            raise ValueError("--link crsf: name the serial port of the transmitter module with --crsf-port")
        Encoder(scenario.params, limits)  # whether the mapping makes sense
        if problem := _problem(Path(options.crsf_port)):
            raise LinkError(problem)  # now, before anything is recorded
        if options.poses == "sim":
            vehicle = SimulatedLink(scenario, limits)
            return cls(options.crsf_port, vehicle, scenario.params, limits, vehicle.send)
        return cls(options.crsf_port, Ros2Poses.from_options(options, scenario), scenario.params, limits)

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            stack.enter_context(self._poses)
            try:
                open_sink = functools.partial(CrsfSink, self._port, self._params, self._limits)
                self._sender = Sender(open_sink, self._params, self._limits)
            except SenderError as error:
                raise LinkError(f"--link crsf: {error}") from error
            stack.enter_context(self._sender)
            self._poses.wait()
            self._open = stack.pop_all()  # the commands end first, then the poses
        self.pids = {**self._poses.pids, "radio": self._sender.pid}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open.close()

    @property
    def truth(self) -> NDArray | None:
        return self._poses.truth

    def now(self) -> int:
        return self._poses.now()

    def receive(self, timeout: float) -> tuple[int, Measurement] | None:
        return self._poses.receive(timeout)

    def send(self, setpoint: Setpoint) -> None:
        self._sender.send(setpoint)
        if self._mirror is not None:
            self._mirror(setpoint)

    def wait(self) -> None:
        self._poses.wait()

    def fault(self) -> str | None:
        return self._sender.fault() or self._poses.fault()


class CrsfSink:
    """Setpoints as frames into a serial port, each whole or not at all.

    Args:
        port: the device.
        params: ``vehicle``, for the bounds.
        limits: ``radio``, and ``safety`` for the bounds.

    Raises:
        LinkError: the port cannot be opened; the message says why.
    """

    def __init__(self, port: str, params: Params, limits: Limits) -> None:
        self._name, self._encoder = port, Encoder(params, limits)
        self._port = _open(port, limits.radio.baud)
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


def _open(port: str, baud: int) -> Any:
    """The port, opened for us alone, 8 data bits, no parity, 1 stop bit. Raises LinkError."""
    if problem := _problem(Path(port)):
        raise LinkError(problem)
    import serial

    try:
        return serial.Serial(port, baud, timeout=0, exclusive=True)
    except (OSError, ValueError) as error:
        busy = isinstance(error, OSError) and error.errno in (errno.EAGAIN, errno.EBUSY)
        raise LinkError(f"cannot open {port}: {'another program uses it' if busy else _reason(error)}") from error


def _problem(port: Path) -> str | None:
    """Why this cannot be a serial port that we may use, and what to do; ``None`` if nothing speaks against it."""
    try:
        from serial.tools.list_ports import comports
    except ImportError:
        return '--link crsf needs pyserial: pip install -e ".[flight]"'
    if not port.exists():
        found = [one.device for one in comports()]
        return f"no serial port {port}: is the module plugged in? There {_those(found)}"
    if not port.is_char_device():
        return f"{port} is not a serial port"
    if not os.access(port, os.R_OK | os.W_OK):
        return f"no permission to use {port}: join the group that owns it, often dialout, and log in again"
    return None


def _those(ports: list[str]) -> str:
    return f"are {', '.join(ports)}" if len(ports) > 1 else f"is {ports[0] if ports else 'none'}"


def _reason(error: Exception) -> str:
    return os.strerror(error.errno) if isinstance(error, OSError) and error.errno else str(error)
