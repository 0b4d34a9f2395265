"""Links: how poses come in and commands go out. One file per link, each with one class that follows ``Link``.

A new link is one file with one class, and one line in ``available``. A link's module must import without the software
that the link needs (rclpy, pyserial): it is asked for its options in any case, and imports the rest on entering.
"""

import argparse
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from types import MappingProxyType
from typing import Protocol, Self

from numpy.typing import NDArray

from fiplib.flight.limits import Limits
from fiplib.flight.sender import Sender, SenderError, Sink
from fiplib.flight.setpoint import Setpoint
from fiplib.params import FipError, Params
from fiplib.recording import Event, Measurement
from fiplib.simulate import Scenario


class LinkError(FipError):
    """A link cannot be opened or has broken; the message says what is missing and what to do."""


class PoseSource(Protocol):
    """Where frames come from, a context manager: the first half of a ``Link``. Nothing to open or close by default."""

    origin: str
    """"simulated" or "real": where the poses come from, for the bag's metadata."""

    truth: NDArray | None = None
    """The true state (11,) as ``ROLES["truth_state"]`` at the newest frame; ``None`` where it is not known."""

    events: deque[Event]
    """Events of poses and vehicle (pushes of a simulated one), for the recorder; the reader removes them."""

    pids: Mapping[str, int] = MappingProxyType({})
    """The ids of the processes that belong to it, by name; empty before it is entered."""

    def __enter__(self) -> Self:
        """Open it. Raises LinkError."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close it."""

    def now(self) -> int:
        """Return the link's clock, ns; arrival times and setpoints are stamped by it."""
        ...

    def receive(self, timeout: float) -> tuple[int, Measurement] | None:
        """Return the next frame and the time at which it arrived, ns; ``None`` when none came within ``timeout`` s.

        Frames are given as they came, damaged ones too (NaN, old stamps): ``failsafe.Guard`` judges them.
        """
        ...

    def wait(self) -> None:
        """Return once frames arrive. Raises LinkError, with the reason, if none do."""

    def fault(self) -> str | None:
        """Return why the vehicle cannot be flown any more (a process has died ...); ``None`` while it can."""
        return None

    def doubt(self) -> str | None:
        """Return why the vehicle may not be armed although frames arrive; ``None`` where nothing speaks against it."""
        return None


class Link(PoseSource, Protocol):
    """A way to a vehicle, simulated or real: a context manager.

    Leaving it must send level-and-disarm frames for ``safety.leave_time``; ``sender.Sender.close`` does. What reaches a
    vehicle goes through a ``Sender``, whose process repeats the newest setpoint whatever happens here.
    """

    name: str
    """Its name on the command line and in the bag's metadata."""

    @staticmethod
    def arguments(parser: argparse._ArgumentGroup) -> None:
        """Add the options of this link to the parser; their names start with the link's: ``--crsf-port``."""

    @classmethod
    def from_options(cls, options: argparse.Namespace, scenario: Scenario, limits: Limits) -> "Link":
        """Return the link that the options ask for, not yet open. Raises ValueError for options that make no sense."""
        ...

    def send(self, setpoint: Setpoint) -> None:
        """Hand over a setpoint; never blocks, never raises."""
        ...


class RelayLink(Link):
    """Frames in from ``poses``, setpoints out through a command sender.

    Args:
        poses: not yet open.
        open_sink, params, limits: as ``sender.Sender``.
    """

    def __init__(self, poses: PoseSource, open_sink: Callable[[], Sink], params: Params, limits: Limits) -> None:
        self.poses, self.origin, self.events = poses, poses.origin, poses.events
        self._open_sink, self._params, self._limits = open_sink, params, limits

    def __enter__(self) -> Self:
        with ExitStack() as stack:  # left in reverse order: the commands end first, then the poses
            stack.enter_context(self.poses)
            try:
                self._sender = stack.enter_context(Sender(self._open_sink, self._params, self._limits))
            except SenderError as error:
                raise LinkError(f"--link {self.name}: {error}") from error
            self._wait()
            self._open = stack.pop_all()
        self.pids = {**self.poses.pids, f"{self.name} sender": self._sender.pid}
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def _wait(self) -> None:
        """Wait until frames arrive, the sender being open."""
        self.poses.wait()

    @property
    def truth(self) -> NDArray | None:
        return self.poses.truth

    def now(self) -> int:
        return self.poses.now()

    def receive(self, timeout: float) -> tuple[int, Measurement] | None:
        return self.poses.receive(timeout)

    def send(self, setpoint: Setpoint) -> None:
        self._sender.send(setpoint)

    def fault(self) -> str | None:
        return self._sender.fault() or self.poses.fault()

    def doubt(self) -> str | None:
        return self.poses.doubt()


def available() -> dict[str, type[Link]]:
    """Return the links by name."""
    from fiplib.flight.links.crsf import CrsfLink  # here, because these modules import this one
    from fiplib.flight.links.ros2 import Ros2Link
    from fiplib.flight.links.simulated import SimulatedLink

    return {link.name: link for link in (SimulatedLink, Ros2Link, CrsfLink)}
