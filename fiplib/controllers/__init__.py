"""Controllers, one a file behind the MPC's call, and the linear analysis of the MPC's closed loop (``margins``).

To add one, write a file with a class that takes ``Params`` and has ``Controller.solve``, and a line of ``CONTROLLERS``;
``piloting.controller`` chooses the one in flight.
"""

from importlib import import_module
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fiplib.mpc import Solution, Status
from fiplib.params import STATES, Params

CONTROLLERS = {
    "lqr": "fiplib.controllers.lqr:LQR",
    "lqr_ga": "fiplib.controllers.lqr_ga:GATunedLQR",
    "mpc": "fiplib.mpc:MPC",
}
"""The class of every controller by name, as ``module:class``."""


class Controller(Protocol):
    """From a state to the two body rates, at every control tick in order; it may remember what it answered before."""

    def solve(self, state: ArrayLike, reference: ArrayLike, length: float | None = None) -> Solution:
        """Answer as ``mpc.MPC.solve``: state (10,), reference (N+1, 10), length in use in m."""
        ...


def controller_of(params: Params) -> Controller:
    """Make the controller that the parameters name; ValueError if its name is not known."""
    name = params.piloting.controller
    if name not in CONTROLLERS:
        raise ValueError(f"piloting.controller must be one of {', '.join(CONTROLLERS)}, not {name!r}")
    module, _, kind = CONTROLLERS[name].partition(":")
    return getattr(import_module(module), kind)(params)


def answer(rates: NDArray, limit: float, status: Status = Status.OPTIMAL) -> Solution:
    """Return body rates (2,) in rad/s, cut off at ``limit``, as a solution without a plan: one input, no states."""
    inputs = np.clip(rates, -limit, limit)[None]
    bounded = bool((np.abs(rates) > limit).any())
    return Solution(inputs[0], inputs, np.empty((0, len(STATES))), status, bounded)
