"""Dask for sweeps: a local cluster of this machine's cores, or the client of one that runs elsewhere."""

import contextlib
import logging
import os
import signal
import threading
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from fiplib.params import FipError

if TYPE_CHECKING:
    from distributed import Client

CONNECT_TIMEOUT = 10.0
"""Seconds within which a scheduler must answer."""

PATIENCE = 60.0
"""Seconds without any worker after which a sweep gives up; Dask does not restart one that dies as it starts."""

DASK = {
    "distributed.worker.profile.enabled": False,  # samples every thread's stack each 10 ms: time taken from flights
    "distributed.admin.system-monitor.gil.enabled": False,
    "distributed.diagnostics.nvml": False,
    "distributed.worker.preload": [__spec__.name],  # calls dask_setup below
}
"""Diagnostics that a sweep has no use for, off; the dashboard is off too. Nothing listens beyond this machine."""


class ClusterError(FipError):
    """A cluster that is not there, or no longer."""


def dask_setup(worker: object) -> None:
    """Called by Dask in each process of the local cluster: Ctrl-C is for the sweep alone, which then ends them."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextlib.contextmanager
def _postponed() -> Iterator[None]:
    """Let Ctrl-C and SIGTERM wait for the end of a block: what is half made cannot be ended in good order."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    waiting: list[int] = []
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.signal(number, lambda number, frame: waiting.append(number)) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if waiting:
        signal.raise_signal(waiting[0])


@contextlib.contextmanager
def connect(scheduler: str | None = None, workers: int | None = None) -> Iterator["Client"]:
    """A client of the scheduler at an address, or of a local cluster of single-threaded processes, one to a core.

    Raises:
        ClusterError: Dask is not installed, nothing answers at the address, or no worker is there.
    """
    try:
        import dask
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise ClusterError(f"a sweep needs Dask ({error}); install it with: pip install 'fip[sweep]'") from error
    for logger in ("distributed", "tornado", "asyncio"):
        logging.getLogger(logger).setLevel(logging.CRITICAL)  # deaths and retries are its business, not the user's
    with contextlib.ExitStack() as stack:
        stack.enter_context(dask.config.set(DASK))
        address: Any = scheduler
        if not scheduler:
            with _postponed():
                cluster = LocalCluster(
                    n_workers=workers or os.cpu_count(),
                    threads_per_worker=1,
                    host="127.0.0.1",
                    scheduler_kwargs={"dashboard": False, "dashboard_address": "127.0.0.1:0"},
                    silence_logs=logging.CRITICAL,
                )
                address = stack.enter_context(cluster)
        try:
            client = stack.enter_context(Client(address, timeout=CONNECT_TIMEOUT, set_as_default=False))
        except (OSError, ValueError, KeyError) as error:
            raise ClusterError(f"no Dask scheduler answers at {scheduler}") from error
        try:
            client.wait_for_workers(1, timeout=PATIENCE / 2)
        except TimeoutError as error:
            raise ClusterError(f"{scheduler} has no worker; start one with: dask worker {scheduler}") from error
        yield client
