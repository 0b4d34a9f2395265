"""The one command, ``fip``; also ``python -m fiplib``.

A subcommand is a module with two functions: ``add_arguments(parser)`` and ``run(options)``, which returns the exit
status. Only the module of the subcommand that was asked for is imported. Errors, interruptions and streams that are
gone are handled here, once for all of them.
"""

import argparse
import errno
import importlib
import os
import re
import signal
import sys
from collections.abc import Callable, Sequence
from typing import NoReturn

from fiplib import __version__
from fiplib.params import FipError

MISTAKE, READER_GONE = 2, 128 + 13
"""Exit statuses beside those of a subcommand: a user's mistake; the reader of the output has closed it (SIGPIPE)."""
OUTPUT_LOST = (errno.ENOSPC, errno.EIO, errno.EBADF)
"""Errors of writing to a stream, without a file name: a full disk, a lost terminal, a closed stream."""

EXTRAS = {"dask": "sweep", "distributed": "sweep", "serial": "flight", "ipywidgets": "notebooks", "PIL": "notebooks"}
EXTRAS |= {"pandas": "tables", "pyarrow": "tables", "viser": "notebooks"}
"""Packages that only some installations have, and the extra that brings each."""

COMMANDS = {
    "figures": ("fiplib.commands.figures", "make figures, tables and the claims ledger from recorded flights"),
    "claims": ("fiplib.reproduction.ledger", "print every claim of the paper beside our number and the verdict"),
    "bag": ("fiplib.commands.bag", "describe a recording, estimate its rod's length; cut, export, recover, convert"),
    "fly": ("fiplib.flight.command", "fly a scenario, simulated or on a vehicle, and record it"),
    "sweep": ("fiplib.studies.sweep", "run studies on all cores, or on a cluster"),
    "faults": ("fiplib.studies.faults.campaign", "inject faults into flights and judge the failsafe"),
    "view": ("fiplib.teaching.viewer", "fly the simulated vehicle in a browser, or write a page that replays a flight"),
    "firmware": ("fiplib.studies.betaflight", "fly with unmodified Betaflight firmware as the inner loop"),
}
"""Module of each subcommand, and its line in ``fip --help``."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    return guarded(lambda: _run(sys.argv[1:] if arguments is None else list(arguments)))


def guarded(task: Callable[[], int]) -> int:
    """Run a task; return its exit status, or that of what ended it, after one line on stderr.

    A mistake of the user (``FipError``, ``ValueError``, ``OSError``) gives 2, Ctrl-C 130, SIGTERM 143 and a closed pipe
    141 in silence. To be called in the main thread.
    """
    _usable_streams()
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))  # leaves ``with`` blocks in good order
    try:
        status = task()
        sys.stdout.flush()
        return status
    except BrokenPipeError:
        _discard_output()
        return READER_GONE
    except KeyboardInterrupt:
        return _said("interrupted", 128 + signal.SIGINT)
    except ModuleNotFoundError as error:
        extra = EXTRAS.get((error.name or "").partition(".")[0])
        if extra is None:
            raise
        return _said(f"this needs the package {error.name}: pip install 'fip[{extra}]'", MISTAKE)
    except (FipError, ValueError, OSError) as error:
        if isinstance(error, OSError) and error.filename is None and error.errno in OUTPUT_LOST:
            _discard_output()
            return _said(f"the output cannot be written: {error.strerror}", MISTAKE)
        return _said(_one_line(str(error)) or type(error).__name__, MISTAKE)


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        super().error(_one_line(message))


def _one_line(text: str) -> str:
    """Return the text without line breaks and other control characters, which names of files may hold."""
    return re.sub(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]+", " ", text)


def _run(arguments: list[str]) -> int:
    description, more = "The flying inverted pendulum of unknown length.", "fip COMMAND --help describes a command."
    parser = _Parser(prog="fip", description=description, epilog=more)
    parser.add_argument("--version", action="version", version=f"fip {__version__}")
    commands = parser.add_subparsers(dest="subcommand", metavar="COMMAND", required=True)
    asked = next((word for word in arguments if not word.startswith("-")), None)
    for name, (module, summary) in COMMANDS.items():
        subparser = commands.add_parser(name, help=summary, description=f"{summary[0].upper()}{summary[1:]}.")
        if name == asked:
            importlib.import_module(module).add_arguments(subparser)
    options = parser.parse_args(arguments)
    return importlib.import_module(COMMANDS[options.subcommand][0]).run(options)


def _said(text: str, status: int) -> int:
    try:
        print(f"fip: {text}", file=sys.stderr, flush=True)
    except OSError:  # nobody to tell
        _discard_output()
    return status


def _usable_streams() -> None:
    """Replace streams that were closed before the start; write names that are not UTF-8 as escapes."""
    for name in ("stdin", "stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "r" if name == "stdin" else "w"))
        elif name != "stdin" and hasattr(stream, "reconfigure"):  # not where a test has put its own
            stream.reconfigure(errors="backslashreplace")


def _discard_output() -> None:
    """Send what is still in the buffers nowhere: Python would complain about it when it exits."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


if __name__ == "__main__":
    sys.exit(main())
