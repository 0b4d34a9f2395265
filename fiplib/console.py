"""What the command lines share."""

import os
import sys
from collections.abc import Callable

READER_GONE = 141
"""Exit status when whoever read the output has closed it: 128 + SIGPIPE, as other programs end then."""


def run(main: Callable[[], int]) -> int:
    """The exit status of a command line; a reader that has seen enough (``| head``) ends it without a traceback."""
    try:
        status = main()
        sys.stdout.flush()
    except BrokenPipeError:
        # what is still in the buffer has nowhere to go, and Python would complain about it when it exits
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return READER_GONE
    return status
