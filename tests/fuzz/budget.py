"""Seed and budget of the fuzzers: FIP_FUZZ_SEED, FIP_FUZZ_SECONDS; and how a failure is repeated."""

import os
import random
import time
from collections.abc import Callable, Iterator

SECONDS = float(os.environ.get("FIP_FUZZ_SECONDS", "20"))
"""Of each fuzzer."""
SEED = int(os.environ.get("FIP_FUZZ_SEED", "14"))
"""Of the first case; case n has the seed SEED + n."""
LEAST = 5
"""Cases that run whatever the time, on however slow a machine."""


def cases(seconds: float = SECONDS, seed: int = SEED) -> Iterator[tuple[int, random.Random]]:
    """The seeds of the cases that the budget allows, each with its generator."""
    end, number = time.monotonic() + seconds, 0
    while number < LEAST or time.monotonic() < end:
        yield seed + number, random.Random(seed + number)
        number += 1


def tried(check: Callable[[random.Random], str], test: str) -> int:
    """Run a check on every case; return their number. ``check`` returns what it did, in words.

    Raises AssertionError from whatever it raised, saying which case it was and how to run it alone.
    """
    count = 0
    for seed, rng in cases():
        try:
            check(rng)
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt):
                raise
            again = f"FIP_FUZZ_SEED={seed} FIP_FUZZ_SECONDS=0 python -m pytest -x {test}"
            raise AssertionError(f"case {seed}: {type(error).__name__}: {error}\nAgain: {again}") from error
        count += 1
    return count
