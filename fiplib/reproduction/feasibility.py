"""The cost of a terminal constraint in feasibility: the MPC's constraints as linear programmes (claim M3).

The paper omits "a terminal cost constraint" since it limits the feasible region. Taken as x_N = x_ref: for states of a
flight, the hard-bounded problem (paper, eq. mpc_main, no slack) is solved for the smallest terminal error. No solution:
infeasible whether or not there is a terminal constraint. Smallest error above zero: the constraint costs feasibility.
"""

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from fiplib.params import AXES, Params
from fiplib.recording import Flight
from fiplib.reproduction.measures import push_times, states

LENGTHS = (0.4, 1.0, 1.6)
"""Lengths in m that the model uses: the rod's, and two that fluctuations of an estimate may bring."""

DELAYS = tuple(0.1 * step for step in range(1, 11))
"""When after a push the problem is posed, s."""

REACHED = 1e-6
"""Terminal error, in units of the state bounds, up to which the constraint is kept: the programme's own tolerance."""


def terminal_loss(flight: Flight) -> float:
    """Share of the problems, after all pushes of a hover flight, that a terminal constraint makes infeasible.

    Of those that have a solution without it: each axis, ``DELAYS``, ``LENGTHS``. NaN if none has one.
    """
    time, known = flight.time(flight.state), states(flight)
    reference = flight.reference.values
    errors = []
    for push in push_times(flight):
        for delay in DELAYS:
            at = min(int(np.searchsorted(time, push + delay)), len(time) - 1)
            for axis in AXES:
                signs = np.array([1, 1, 1, 1, axis.sign])
                start, goal = (signs * values[at][list(axis.states)] for values in (known, reference))
                errors += [terminal_error(start, goal, length, flight.params) for length in LENGTHS]
    feasible = [error for error in errors if math.isfinite(error)]
    return float(np.mean([error > REACHED for error in feasible])) if feasible else math.nan


def terminal_error(start: NDArray, goal: NDArray, length: float, params: Params) -> float:
    """Smallest max |z_N - goal| / bound that keeps every hard bound; inf if none can be kept.

    Args:
        start, goal: z of one axis, (5,), see ``params.Axis``.
        length: of the prediction model, m.
    """
    from scipy import sparse
    from scipy.optimize import linprog

    nodes, bound = params.control.nodes, np.array(params.control.state_bounds)[list(AXES[0].states)]
    transition, inputs = _model(length, params.control.step)
    # unknowns: z_1 .. z_N in units of their bounds, u_0 .. u_{N-1} in units of theirs, and the terminal error
    scaled, per_input = transition / bound[:, None] * bound, inputs / bound * params.vehicle.max_body_rate
    steps = sparse.eye(5 * nodes) - sparse.kron(sparse.eye(nodes, k=-1), scaled)
    driven = sparse.kron(sparse.eye(nodes), per_input[:, None])
    dynamics = sparse.hstack([steps, -driven, sparse.csr_matrix((5 * nodes, 1))], format="csc")
    begins = np.zeros(5 * nodes)
    begins[:5] = scaled @ (start / bound)
    last = sparse.hstack([sparse.csr_matrix((5, 5 * (nodes - 1))), sparse.eye(5), sparse.csr_matrix((5, nodes))])
    ends = sparse.vstack([sparse.hstack([sign * last, -np.ones((5, 1))]) for sign in (1, -1)], format="csc")
    cost = np.zeros(6 * nodes + 1)
    cost[-1] = 1.0
    found = linprog(
        cost,
        A_ub=ends,
        b_ub=np.concatenate([goal / bound, -goal / bound]),
        A_eq=dynamics,
        b_eq=begins,
        bounds=[(-1.0, 1.0)] * (6 * nodes) + [(0.0, None)],
        method="highs",
    )
    return float(found.fun) if found.status == 0 else math.inf


@lru_cache(maxsize=16)
def _model(length: float, step: float) -> tuple[NDArray, NDArray]:
    """Return the transition (5, 5) and input (5,) of one axis of the prediction model."""
    from fiplib.mpc import MPC

    control = Params().control
    problem = MPC(Params().replace(control__horizon=step * control.nodes)).prepare(length)[0]
    return problem.transition, problem.input
