"""The display of a flight, drawn in a thread of its own: a stalled or lost terminal holds up nothing else."""

import shutil
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from typing import Self

from fiplib.flight.sender import urgent

UP, CLEAR = "\x1b[{}A", "\x1b[J"


class View:
    """Shows the newest state on stderr: redrawn on a terminal, else as a line every 2 s. A context manager."""

    def __init__(self) -> None:
        self._stream = sys.stderr
        self._terminal = self._stream.isatty()
        self._pause = 0.125 if self._terminal else 2.0
        self._newest: tuple[Sequence[str], str] | None = None
        self._drawn = 0
        self._said: list[str] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="fip-view", daemon=True)

    def show(self, lines: Sequence[str], line: str) -> None:
        """Show the state of the flight: ``lines`` on a terminal, elsewhere one ``line``."""
        self._newest = lines, line

    def say(self, text: str) -> None:
        """A line that stays."""
        self._said.append(text)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
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
        if not self._terminal:
            newest, self._newest = self._newest, None
            for text in said + ([newest[1]] if newest else []):
                print(text, file=self._stream, flush=True)
            return
        width = shutil.get_terminal_size().columns - 1
        text = UP.format(self._drawn) + "\r" + CLEAR if self._drawn else ""
        text += "".join(f"{row}\n" for row in said)
        rows = [row[:width] for row in self._newest[0]] if self._newest else []
        self._stream.write(text + "".join(f"{row}\n" for row in rows))
        self._stream.flush()
        self._drawn = len(rows)
