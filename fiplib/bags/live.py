"""A recorder for flights in real time: a second behind at most, and never in the way of the control.

``LiveRecorder`` takes the same calls as ``BagRecorder`` and hands the bytes to a process of its own, through a pipe and
without ever waiting. That process sorts, compresses and writes them, four times a second, in chunks of which each can
be read without the others: whatever is killed in flight leaves a file that ``fip bag recover`` reads. If only the
script dies, the process finishes the bag properly.

Runs on POSIX systems.
"""

import fcntl
import json
import os
import select
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

from fiplib.bags.writer import BagRecorder
from fiplib.recording import ROLES, BagError

__all__ = ["LiveRecorder"]

PERIOD = 0.25
"""s from one chunk to the next. A kill takes these and ``writer.HOLD``; the rest of a second is for a busy machine."""
_NAP = 0.02  # s of messages taken at once: to wake for each would take the control's time on a small computer
_BACKLOG = 32 << 20  # bytes kept in memory when the disk stalls: two minutes of flight
_PATIENCE = 30.0  # s that start and end of a recording may take

_FRAME = struct.Struct("<BqI")  # role, log time in ns, size of the message that follows
_NAMES = tuple(ROLES)
_END = 255  # in place of a role: the flight was recorded to its end


class LiveRecorder(BagRecorder):
    """Records a flight in real time; calls, metadata and bag are those of ``BagRecorder``.

    In flight no method raises and none waits: what cannot be recorded is dropped. If the recording stops (a full disk,
    a killed process), ``failed`` says why in one sentence, which ``close`` raises as a BagError when the flight is over
    and nothing worse is on its way. To be called from one thread.

    Raises:
        BagError: the recording cannot begin: the path exists already, cannot be written, or the metadata are not fit.
    """

    dropped: int = 0
    """Messages that were not recorded, for whatever reason."""
    refused: str | None = None
    """The first message that does not fit the bag contract, in words; the recording goes on without it."""

    def _open(self) -> None:
        package = str(Path(__file__).parents[1])
        path = os.pathsep.join(filter(None, (package, os.environ.get("PYTHONPATH"))))
        self._backlog = bytearray()
        self._process = subprocess.Popen(
            [sys.executable, "-m", "fiplib.bags.live"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=0,
            env={**os.environ, "PYTHONPATH": path},
            start_new_session=True,  # neither Ctrl-C nor a closing terminal is meant for it: it ends when the pipe does
        )
        assert self._process.stdin and self._process.stdout
        self._pipe, self._answer = self._process.stdin.fileno(), self._process.stdout.fileno()
        if hasattr(fcntl, "F_SETPIPE_SZ"):
            with suppress(OSError):  # a wish: what is in the pipe survives the script
                fcntl.fcntl(self._pipe, fcntl.F_SETPIPE_SZ, 1 << 20)
        os.set_blocking(self._pipe, False)
        self._backlog += json.dumps([str(self.path), self._metadata]).encode() + b"\n"
        self._drain()
        if select.select([self._answer], [], [], _PATIENCE)[0]:
            words = self._heard() or "its process died"
        else:
            words = "its process does not start"
            self._process.kill()
        os.set_blocking(self._answer, False)
        if words != "ready":
            self._process.wait()
            self._release()
            raise BagError(words if words.startswith(f"{self.path}:") else f"{self.path}: cannot record here ({words})")

    @property
    def pid(self) -> int:
        """Return the id of the process that writes."""
        return self._process.pid

    def pose(
        self, body: str, stamp: int, received: int, position: Sequence[float], orientation: Sequence[float]
    ) -> None:
        try:
            super().pose(body, stamp, received, position, orientation)
        except Exception as error:  # whatever it is: a flight is not ended by its recording
            self._refuse(error)

    def event(
        self, stamp: int, level: str, text: str, kind: str = "note", data: Mapping[str, Any] | None = None
    ) -> None:
        try:
            super().event(stamp, level, text, kind, data)
        except Exception as error:
            self._refuse(error)

    def numbers(self, role: str, stamp: int, values: Sequence[float], received: int | None = None) -> None:
        try:
            super().numbers(role, stamp, values, received)
        except Exception as error:
            self._refuse(error)

    def _refuse(self, error: Exception) -> None:
        self.dropped += 1
        self.refused = self.refused or str(error)

    def _put(self, role: str, log_time: int, data: bytes) -> None:
        self._last = max(self._last, log_time)
        if self.failed:
            self.dropped += 1
            return
        self._backlog += _FRAME.pack(_NAMES.index(role), log_time, len(data)) + data
        self._push()
        if len(self._backlog) > _BACKLOG:
            self._fail(f"the disk has taken nothing for long, {_BACKLOG >> 20} MiB wait for it")

    def _push(self) -> None:
        """Give the pipe what it takes at once."""
        try:
            del self._backlog[: os.write(self._pipe, self._backlog)]
        except BlockingIOError:
            pass
        except OSError:
            self._fail("its process was killed")

    def _drain(self) -> None:
        """Give the pipe all there is; waits, but not for ever."""
        until = time.monotonic() + _PATIENCE
        while self._backlog and not self.failed and (left := until - time.monotonic()) > 0:
            if select.select([], [self._pipe], [], left)[1]:
                self._push()

    def _fail(self, otherwise: str) -> None:
        self.failed = f"{self.path}: recording stopped: {self._heard() or otherwise}"
        self._backlog.clear()

    def _heard(self) -> str:
        """Return the last message of the process; empty if there is none."""
        try:
            return os.read(self._answer, 1 << 16).decode().partition("\n")[0]
        except BlockingIOError:
            return ""

    def close(self) -> None:
        """Finish the bag. Raises BagError, with what ``failed`` says, if it does not hold the whole flight."""
        if self.refused:
            self.event(
                self._last, "warn", f"{self.dropped} messages were not fit to be recorded, first: {self.refused}"
            )
        self._backlog += _FRAME.pack(_END, 0, 0)
        self._drain()
        self._release()
        try:
            self._process.wait(_PATIENCE)
        except subprocess.TimeoutExpired:
            self.failed = self.failed or f"{self.path}: the disk does not take the end of the recording"
        if (words := self._heard()) or self._process.returncode:
            self.failed = self.failed or words or f"{self.path}: its process was killed"
        assert self._process.stdout
        self._process.stdout.close()
        if self.failed:
            if not (self.path / "metadata.yaml").exists():
                self.failed += f". The bag is not finished: fip bag recover {self.path}"
            missing = f" (at least {self.dropped} messages of the flight are missing)" if self.dropped else ""
            raise BagError(self.failed + missing)

    def _release(self) -> None:
        assert self._process.stdin
        with suppress(OSError):
            self._process.stdin.close()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            super().__exit__(kind, error, trace)
        except BagError:
            if kind is None:
                raise  # else what ended the flight matters more; ``failed`` is still there to be shown


# --- the process that writes ---------------------------------------------------------------------------------------


class _Bag(BagRecorder):
    """The bag as the process writes it: a chunk whenever ``commit`` is called, synced to the disk beside."""

    _sync = True

    def _put(self, role: str, log_time: int, data: bytes) -> None:
        self._last = max(self._last, log_time)
        self._pending.append((log_time, role, data))

    def end(self, level: str, words: str) -> None:
        """Finish the bag with an event that says why. Raises BagError."""
        self.event(self._last, level, words)
        self.close()


def _arrivals(pipe: int) -> Iterator[bytes]:
    """Yield the bytes that arrive through the pipe until it is closed, and b"" whenever a chunk is due."""
    due = time.monotonic() + PERIOD
    while True:
        if (left := due - time.monotonic()) <= 0:
            yield b""
            due = time.monotonic() + PERIOD
        elif select.select([pipe], [], [], left)[0]:
            time.sleep(_NAP)
            if not (data := os.read(pipe, 1 << 20)):
                return
            yield data


def _record(bag: _Bag, pipe: int, data: bytes) -> bool:
    """Record what comes through the pipe, after ``data``. Returns whether the script said that the flight is over."""
    waiting = bytearray(data)
    for data in _arrivals(pipe):
        if not data:
            bag.commit()
        waiting += data
        at = 0
        while at + _FRAME.size <= len(waiting):
            role, log_time, size = _FRAME.unpack_from(waiting, at)
            if role == _END:
                return True
            if (end := at + _FRAME.size + size) > len(waiting):
                break
            bag._put(_NAMES[role], log_time, bytes(waiting[at + _FRAME.size : end]))
            at = end
        del waiting[:at]
    return False


def _say(words: str) -> None:
    with suppress(OSError):  # the script may be gone
        os.write(sys.stdout.fileno(), words.encode() + b"\n")


def main() -> int:
    """The process: a line of JSON with path and metadata comes first, then frames; answers with words. Exit code."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    pipe = sys.stdin.fileno()
    header = b""
    while b"\n" not in header:
        if not (data := os.read(pipe, 1 << 20)):
            return 2
        header += data
    header, _, data = header.partition(b"\n")
    path, entries = json.loads(header)
    try:
        bag = _Bag(path, {key: json.loads(value) for key, value in entries.items()})
        _say("ready")
        try:
            if _record(bag, pipe, data):
                bag.close()
            else:
                bag.end("fatal", "the flight script ended without a word: the recording ends here")
        except BagError:
            raise
        except Exception as error:  # a full disk, or a fault in here: either way the bag is brought to its end
            words = (isinstance(error, OSError) and error.strerror) or f"{type(error).__name__} ({error})"
            _say(words)
            os.close(pipe)  # which tells the script
            bag.end("error", f"recording stopped: {words}; what followed is lost")
    except BagError as error:
        _say(str(error))
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
