"""Links: how poses come in and commands go out. One file per link, each with the few methods of ``Link``.

A new link is one file with one class, and one line in ``LINKS``. A link's module must import without the software that
the link needs (rclpy, pyserial): it is asked for its options in any case, and imports the rest on entering.
"""

import argparse
import importlib
import importlib.util
from types import TracebackType
from typing import Protocol, Self, cast

from fiplib.flight.setpoint import Setpoint
from fiplib.recording import Measurement
from fiplib.simulate import Scenario


class LinkError(Exception):
    """A link cannot be opened or has broken; the message says what is missing and what to do."""


class Link(Protocol):
    """A way to a vehicle, simulated or real: a context manager, open between ``__enter__`` and ``__exit__``.

    Leaving it must send level-and-disarm frames for ``safety.leave_time``; ``fiplib.flight.sender.Sender.close`` does. What
    reaches a vehicle goes through a ``Sender``, whose process repeats the newest setpoint whatever happens here.
    """

    origin: str
    """"simulated" or "real": where the poses come from, for the bag's metadata."""

    @staticmethod
    def arguments(parser: argparse.ArgumentParser) -> None:
        """Add the options of this link to the parser; their names start with the link's: ``--crsf-port``."""
        ...

    @classmethod
    def from_options(cls, options: argparse.Namespace, scenario: Scenario) -> Self:
        """The link that the options ask for, not yet open. Raises ValueError for options that make no sense."""
        ...

    def __enter__(self) -> Self:
        """Open it. Raises LinkError."""
        ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def now(self) -> int:
        """The link's clock, ns; arrival times and setpoints are told by it."""
        ...

    def receive(self, timeout: float) -> tuple[int, Measurement] | None:
        """The next frame and the time at which it arrived, ns; ``None`` when none came within ``timeout`` s.

        Frames are given as they came, damaged ones too (NaN, old stamps): ``failsafe.Guard`` judges them.
        """
        ...

    def send(self, setpoint: Setpoint) -> None:
        """Hand over a setpoint; never blocks, never raises."""
        ...

    def fault(self) -> str | None:
        """Why commands do not reach the vehicle any more (the sender has died ...); ``None`` while they do."""
        ...


LINKS = {"sim": "links.sim:SimLink", "ros2": "links.ros2:Ros2Link", "crsf": "links.crsf:CrsfLink"}
"""Module and class of each link, imported when it is asked for."""


def available() -> dict[str, type[Link]]:
    """The links whose files are there, by name."""
    found = {}
    for name, place in LINKS.items():
        module, _, attribute = place.partition(":")
        if importlib.util.find_spec(module) is not None:
            found[name] = cast(type[Link], getattr(importlib.import_module(module), attribute))
    return found
