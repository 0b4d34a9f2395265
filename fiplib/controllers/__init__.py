"""Controllers, one a file behind the MPC's call, and the linear analysis of the MPC's closed loop (``margins``).

To add one, write a file with a class that takes ``Params`` and has ``Controller.solve``, and a line of ``CONTROLLERS``;
``piloting.controller`` chooses the one in flight.
"""

from importlib import import_module
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fiplib.mpc import Solution, Status
from fiplib.params import AXES, STATES, Params

CONTROLLERS = {
    "lqr": "fiplib.controllers.lqr:LQR",
    "lqr_ga": "fiplib.controllers.lqr_ga:GATunedLQR",
    "mpc": "fiplib.mpc:MPC",
    "nonlinear_mpc": "fiplib.controllers.nmpc:NonlinearMPC",
    "mpc_l1": "fiplib.controllers.l1:L1AugmentedMPC",
    "offset_free_mpc": "fiplib.controllers.offset_free:OffsetFreeMPC",
    "geometric": "fiplib.controllers.geometric:GeometricControl",
    "lqr_circle": "fiplib.controllers.lqr_circle:CircleLQR",
}
"""The class of every controller by name, as ``module:class``."""


ESTIMATION_SHARES = (0.25, 0.05, 0.25)
"""Bandwidths of what estimates a force on the vehicle, a force on the rod and an error of the body rate, as shares of
sqrt(2 g / l), the rate at which a rod of length l falls: the same for every controller that estimates these.

Another length or inertia than the model's, lag and delay look like forces that follow the rod's own motion. So they are
estimated more slowly than the rod moves; that on the rod most slowly, for it acts on the unstable part of the loop.
Chosen on flights of seed 1: with 0.1 for the rod, pushes are not survived with 1.3 m in use for a rod of 1 m. The
price is time: with a rod of 1 m a force on it is known with a time constant of 4.5 s.
"""


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
    """Return body rates (2,) in rad/s, cut off at ``limit``, as a solution without a plan: one input, no states.

    Raises ValueError: they are not finite.
    """
    if not np.isfinite(rates).all():
        raise ValueError(f"no finite body rates, but {rates}: state, reference and length must be finite")
    inputs = np.clip(rates, -limit, limit)[None]
    bounded = bool((np.abs(rates) > limit).any())
    return Solution(inputs[0], inputs, np.empty((0, len(STATES))), status, bounded)


def by_axis(state: NDArray) -> NDArray:
    """Return z = (s, s', d, d', tilt) of both axes, (2, 5), in the common sign of ``params.Axis``, of a state (10,)."""
    return np.array([[*state[list(axis.states[:4])], axis.sign * state[axis.states[4]]] for axis in AXES])


def rates_by_axis(rates: NDArray) -> NDArray:
    """Return the rate of both axes, (2,), in the common sign, of body rates (2,)."""
    return np.array([axis.sign * rates[axis.input] for axis in AXES])


def rates_of(values: NDArray) -> NDArray:
    """Return body rates (2,) of the rate of both axes, (2,) in the common sign."""
    rates = np.empty(2)
    for axis, value in zip(AXES, values, strict=True):
        rates[axis.input] = axis.sign * value
    return rates
