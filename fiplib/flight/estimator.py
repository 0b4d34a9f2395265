"""The estimator beside a flight in real time: a process of its own that may crash or hang without harm."""

import importlib
import math
import os
import threading
import time
from collections import deque
from contextlib import suppress
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Self

import numpy as np

from fiplib.estimators.base import Estimate
from fiplib.estimators.windows import RawWindow
from fiplib.flight.limits import Limits
from fiplib.flight.sender import SPAWN, START_TIME, ignore_the_terminal
from fiplib.kalman import Window
from fiplib.params import Params
from fiplib.pilot import estimator_of


class EstimatorProcess:
    """A ``simulate.ParallelEstimator`` that runs the flight's estimator in a process; a context manager.

    One window at a time; those that come meanwhile are left out. A process that dies, or works on a window for longer
    than ``safety.estimator_timeout``, is replaced, ``safety.estimator_restarts`` times at most.

    Args:
        seed: seeds the estimator's generator, together with the number of the run: as in ``simulate.fly``.
    """

    def __init__(self, params: Params, seed: int, limits: Limits) -> None:
        estimator_of(params)  # an unknown name is refused here, and not in another process
        self._params, self._seed, self._safety = params, seed, limits.safety
        self._runs = self._starts = 0
        self._process: BaseProcess | None = None
        self._connection: Connection | None = None
        self._starting: threading.Thread | None = None
        self.remarks: deque[tuple[str, str]] = deque()
        self.seconds = math.nan

    @property
    def pid(self) -> int | None:
        """Its process id; ``None`` while none runs."""
        return self._process.pid if self._process is not None else None

    def __enter__(self) -> Self:
        self._start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._starting is not None:
            self._starting.join()
        self._end()

    def deliver(self, now: int, window: Window | RawWindow | None) -> Estimate | None:
        """Hand over a window if one is due, and take the answer to an earlier one if it is there; never blocks."""
        if self._starting is not None:
            if self._starting.is_alive():
                return None
            self._starting = None
        if self._process is None or self._connection is None:
            return None
        answer = None
        try:
            if self._connection.poll():
                answer = self._connection.recv()
                if self._ready:
                    self._busy, self.seconds = False, time.monotonic() - self._since
                self._ready = True
            elif not self._process.is_alive():
                self._replace()
                return None
            elif time.monotonic() - self._since > self._allowed():
                self._replace(f"hung for {self._allowed():g} s")
                return None
            if window is not None and self._ready and not self._busy:
                # a generator of its own for each run: a run can be repeated from the bag alone
                self._connection.send((self._runs, window))
                self._runs += 1
                self._busy, self._since = True, time.monotonic()
        except (EOFError, OSError):
            self._replace()
        return answer

    def _allowed(self) -> float:
        if not self._ready:
            return START_TIME
        return self._safety.estimator_timeout if self._busy else math.inf

    def _replace(self, what: str = "") -> None:
        # ending a process and starting another both take longer than a control tick
        self._starting = threading.Thread(target=self._end_and_start, args=(what,), name="fip-estimator-start")
        self._starting.start()

    def _end_and_start(self, what: str) -> None:
        process = self._process
        self._end()
        if process is not None and not what:  # its connection may break before its exit code is known
            what = f"died (exit code {process.exitcode})"
        if self._starts > self._safety.estimator_restarts:
            self.remarks.append(("error", f"estimator {what}: given up after {self._starts - 1} restarts"))
            return
        self.remarks.append(("warn", f"estimator {what}: started again"))
        self._start()

    def _start(self) -> None:
        self._connection, theirs = SPAWN.Pipe()
        task = (self._params, self._seed, theirs)
        process = SPAWN.Process(target=_estimate, args=task, name="fip-estimator", daemon=True)
        self._ready = self._busy = False
        self._since = time.monotonic()
        self._starts += 1
        process.start()
        theirs.close()
        self._process = process

    def _end(self) -> None:
        if self._process is not None:
            self._process.kill()  # it holds nothing worth saving
            self._process.join(1.0)
        if self._connection is not None:
            self._connection.close()
        self._process = self._connection = None


def _estimate(params: Params, seed: int, connection: Connection) -> None:
    """The estimator's process."""
    ignore_the_terminal()
    with suppress(OSError, AttributeError):
        os.nice(10)  # the controller comes first
    function = estimator_of(params).function
    # estimators import these when first used: a second, not in flight
    for part in ("scipy.optimize", "fiplib.kernels.filtering"):
        importlib.import_module(part)
    with suppress(EOFError, OSError):
        connection.send(None)
        while True:
            run, window = connection.recv()
            try:
                answer = function(window, params, np.random.default_rng([seed, run]))
            except Exception as error:  # the flight goes on
                answer = Estimate(math.nan, math.nan, f"{type(error).__name__}: {error}")
            connection.send(answer)
