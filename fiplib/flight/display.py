"""The display of a flight in real time: a few redrawn lines on a terminal; elsewhere, a line now and then.

Drawing happens in a thread of its own, so that a stalled or lost terminal holds up nothing else.
"""

import math
import shutil
import sys
import threading
from contextlib import suppress
from types import TracebackType
from typing import NamedTuple, Self, TextIO

from fiplib.flight.sender import urgent

UP, CLEAR = "\x1b[{}A", "\x1b[J"


class Snapshot(NamedTuple):
    """The quantities shown; angles in rad, lengths in m, times in s, nan where not known."""

    time: float = math.nan
    duration: float = math.nan
    mode: str = ""
    words: str = ""
    position: tuple[float, float, float] = (math.nan, math.nan, math.nan)
    tilt: float = math.nan
    lean: float = math.nan
    length: float = math.nan
    estimate: float = math.nan
    deviation: float = math.nan
    run: float = math.nan
    solve: float = math.nan
    worst_solve: float = math.nan
    ticks: int = 0
    late_ours: int = 0
    late_machine: int = 0
    frames: int = 0
    refused: int = 0
    recording: str = ""


def lines(now: Snapshot) -> list[str]:
    """Return the snapshot as lines of text."""
    where = ", ".join(f"{value:+.2f}" for value in now.position)
    interval = "no estimate yet"
    if math.isfinite(now.estimate):
        interval = f"estimate {now.estimate:.3f} m"
        if math.isfinite(now.deviation):
            low, high = now.estimate - 2 * now.deviation, now.estimate + 2 * now.deviation
            interval += f", two deviations {low:.3f} to {high:.3f} m"
        interval += f", run took {now.run:.2f} s"
    clock = f"{now.time:5.1f} of {now.duration:g} s" if math.isfinite(now.time) else "not armed"
    return [
        f"{clock}   {now.mode.upper()}{'   ' + now.words if now.words else ''}",
        f"vehicle  ({where}) m   tilt {_degrees(now.tilt)}   rod leans {_degrees(now.lean)}",
        f"length   {now.length:.3f} m in use   {interval}",
        f"solve    {1e3 * now.solve:.2f} ms, worst {1e3 * now.worst_solve:.2f} ms",
        f"ticks    {now.ticks}, late by us {now.late_ours}, by poses or machine {now.late_machine}",
        f"poses    {now.frames}, refused {now.refused}   {now.recording}",
    ]


def line(now: Snapshot) -> str:
    """Return the snapshot as one line."""
    clock = f"{now.time:.1f} s" if math.isfinite(now.time) else "not armed"
    return (
        f"{clock} {now.mode}{': ' + now.words if now.words else ''}, tilt {_degrees(now.tilt)}, rod "
        f"{_degrees(now.lean)}, length {now.length:.3f} m, solve {1e3 * now.solve:.2f} ms, late {now.late_ours}"
    )


def _degrees(angle: float) -> str:
    return f"{math.degrees(angle):4.1f} deg"


class View:
    """Shows the newest snapshot given to ``show``; a context manager.

    Args:
        stream: where to; a terminal is redrawn ``rate`` times per s, anything else gets a line every ``pause`` s.
    """

    def __init__(self, stream: TextIO | None = None, rate: float = 8.0, pause: float = 2.0) -> None:
        self._stream = stream or sys.stderr
        self._terminal = bool(self._stream.isatty())
        self._pause = 1.0 / rate if self._terminal else pause
        self._newest: Snapshot | None = None
        self._shown: Snapshot | None = None
        self._drawn = 0
        self._said: list[str] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="fip-view", daemon=True)

    def show(self, snapshot: Snapshot) -> None:
        self._newest = snapshot

    def say(self, text: str) -> None:
        """A line that stays."""
        self._said.append(text)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join(2.0)  # a terminal that takes nothing does not keep us

    def _run(self) -> None:
        urgent(1)  # as the thread that flies: it holds the interpreter's lock while it draws, and must not wait with it
        with suppress(OSError, ValueError):  # the terminal is gone: nobody is looking
            while not self._stop.wait(self._pause):
                self._draw()
            self._draw()

    def _draw(self) -> None:
        said, self._said = self._said, []
        now = self._newest
        if not self._terminal:
            for text in said + ([line(now)] if now and now is not self._shown else []):
                print(text, file=self._stream, flush=True)
            self._shown = now
            return
        width = shutil.get_terminal_size().columns - 1
        text = UP.format(self._drawn) + "\r" + CLEAR if self._drawn else ""
        text += "".join(f"{row}\n" for row in said)
        rows = [row[:width] for row in lines(now)] if now else []
        self._stream.write(text + "".join(f"{row}\n" for row in rows))
        self._stream.flush()
        self._drawn = len(rows)
