"""fip: the flying inverted pendulum of unknown length, reproducible from recorded (simulated) flights.

>>> import fiplib as fip
>>> flight = fip.fly(fip.SCENARIOS["estimate-1.4"])
>>> fip.estimate(flight).length
"""

import importlib
import os
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fiplib.bags import read
    from fiplib.mpc import MPC
    from fiplib.params import Params
    from fiplib.pilot import Pilot
    from fiplib.replay import estimate, refit
    from fiplib.simulate import SCENARIOS, fly

__version__ = "0.1.0"
__all__ = ["MPC", "SCENARIOS", "Params", "Pilot", "estimate", "fly", "read", "refit"]

_HOMES = {
    "MPC": "fiplib.mpc",
    "Params": "fiplib.params",
    "Pilot": "fiplib.pilot",
    "SCENARIOS": "fiplib.simulate",
    "estimate": "fiplib.replay",
    "fly": "fiplib.simulate",
    "read": "fiplib.bags",
    "refit": "fiplib.replay",
}

# One thread, if NumPy is not loaded yet, and in the processes started from here. The matrices
# here are small, and on a busy machine OpenBLAS's threads wait for each other: beside two busy cores that takes most of
# the time. Sums of matrix products may differ in their last bit with the number of threads.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def __getattr__(name: str) -> Any:
    """Import a name of ``__all__`` when it is first asked for: ``import fiplib`` alone loads no numerical library."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
