"""How kernels are compiled, and where the result is kept."""

import hashlib
import os
import shutil
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numba

from fiplib.params import AXES, GRAVITY

OPTIONS = {"error_model": "numpy"}

HERE = Path(__file__).parent
BUILT_IN = (AXES, GRAVITY)
"""Values from outside this room that become part of the compiled code."""


def compiled(*signature: str) -> Callable[[Callable], Callable]:
    """Compile at once for one signature; without any, together with the kernels that call the function."""

    def decorate(function: Callable) -> Callable:
        before, numba.config.CACHE_DIR = numba.config.CACHE_DIR, str(DIRECTORY or "")
        try:
            return numba.njit(*signature, cache=DIRECTORY is not None, **OPTIONS)(function)
        finally:
            numba.config.CACHE_DIR = before

    return decorate


def version() -> str:
    """A digest of all that the compiled code is made from, numba's version and the CPU aside.

    Numba compiles a function again when its own file has changed, but not when one it calls in another file has.
    """
    sources = b"".join(path.read_bytes() for path in sorted(HERE.glob("*.py")))
    return hashlib.sha256(sources + repr(BUILT_IN).encode()).hexdigest()[:16]


def directory() -> Path | None:
    """Where the compiled code of this version is kept; ``None``, and a line that says so, if nothing can be written."""
    name = f"fiplib-{version()}"
    beside = HERE / "__pycache__"
    users = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    for place in (Path(numba.config.CACHE_DIR),) if numba.config.CACHE_DIR else (beside, users):
        found = place / name
        try:
            found.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=found).close()
        except OSError:
            continue
        for old in beside.glob("fiplib-*"):
            if old.name != name:
                shutil.rmtree(old, ignore_errors=True)
        return found
    print(
        "fiplib: compiling for some seconds at every start, as no directory for compiled code can be written: "
        "set NUMBA_CACHE_DIR to one that can",
        file=sys.stderr,
    )
    return None


DIRECTORY = directory()
