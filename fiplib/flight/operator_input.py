"""The operator: signals and the Enter key."""

import os
import select
import signal
import sys
from contextlib import suppress
from types import FrameType
from typing import Self


class OperatorInput:
    """Listens to the operator: signals and, where asked for, the Enter key. A context manager.

    The first Ctrl-C, SIGTERM or lost terminal asks for a landing, a second one for motors off at once.

    Attributes:
        reason: why to land, ``None`` until then.
        cut: motors off at once.
        go: armed by Enter, or not asked.
    """

    def __init__(self, ask: bool = False) -> None:
        self.reason: str | None = None
        self.cut = False
        self.go = not ask
        self._keys = ask and sys.stdin is not None and sys.stdin.isatty()
        self._before: dict[int, object] = {}

    def __enter__(self) -> Self:
        for number in signal.Signals:  # SIGHUP is not everywhere
            if number.name in ("SIGINT", "SIGTERM", "SIGHUP"):
                self._before[number] = signal.signal(number, self._signalled)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)  # type: ignore[arg-type]

    def _signalled(self, number: int, frame: FrameType | None) -> None:
        # a terminal that goes may say so more than once
        self.cut = self.reason is not None and signal.Signals(number).name != "SIGHUP"
        reasons = {"SIGINT": "operator abort (Ctrl-C)", "SIGTERM": "told to end (SIGTERM)"}
        self.reason = self.reason or reasons.get(signal.Signals(number).name, "terminal lost (SIGHUP)")

    def look(self, ready: bool) -> None:
        """Look whether Enter was pressed: once to arm (not counted before the vehicle is ready), once more to land."""
        if not self._keys:
            return
        with suppress(OSError, ValueError):
            if select.select([sys.stdin], [], [], 0.0)[0]:
                if not os.read(sys.stdin.fileno(), 1024):
                    self._keys = False
                elif self.go:
                    self.reason = self.reason or "operator abort (Enter)"
                else:
                    self.go = ready
