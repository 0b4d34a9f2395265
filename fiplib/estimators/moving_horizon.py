"""Moving-horizon estimation: states of the whole window and length in one nonlinear programme."""

import math
from functools import lru_cache

import casadi as ca
import numpy as np

from fiplib.dynamics import prediction_model, rk4
from fiplib.estimators.base import PRIOR, Estimate
from fiplib.kalman import Window
from fiplib.params import STATES, Params


def moving_horizon(window: Window, params: Params, rng: np.random.Generator | None = None) -> Estimate:
    """Moving-horizon estimation (CasADi, IPOPT): states of the whole window and length under both noises at once.

    min over x_0..x_n, l of sum |y_k - x_k|^2 in R_e^-1 + sum |x_k+1 - F(x_k, u_k, l)|^2 in Q_e^-1; the standard
    deviation is the length's share of the inverse Hessian at the optimum. Raises ValueError: no process noise.
    """
    estimation = params.estimation
    if min(estimation.process_noise) <= 0:
        raise ValueError("moving_horizon needs process noise in every state")
    solver, hessian = _horizon(len(window.states), window.step)
    data = np.concatenate(
        [window.states.ravel(), window.inputs.ravel(), estimation.measurement_noise, estimation.process_noise]
    )
    low, high = np.full(window.states.size + 1, -np.inf), np.full(window.states.size + 1, np.inf)
    low[-1], high[-1] = estimation.length_min, estimation.length_max
    solution = solver(x0=np.append(window.states.ravel(), PRIOR[0]), p=data, lbx=low, ubx=high)
    if not solver.stats()["success"]:
        return Estimate(math.nan, math.nan, f"IPOPT gave up: {solver.stats()['return_status']}")
    best = solution["x"]
    unit = ca.DM(np.eye(window.states.size + 1)[-1])
    try:
        variance = float(ca.solve(hessian(best, data), unit, "csparse")[-1])
    except RuntimeError:  # of CasADi: singular
        return Estimate(math.nan, math.nan, "nothing in the window depends on the length")
    return Estimate(float(best[-1]), math.sqrt(variance) if variance > 0 else math.nan)


@lru_cache(maxsize=4)
def _horizon(samples: int, step: float) -> tuple[ca.Function, ca.Function]:
    """Return the nonlinear programme of ``moving_horizon``, and the Hessian of its cost, for a size of window."""
    width = len(STATES)
    x, length = ca.MX.sym("x", width, samples), ca.MX.sym("l")
    y, u = ca.MX.sym("y", width, samples), ca.MX.sym("u", 2, samples)
    r, q = ca.MX.sym("r", width), ca.MX.sym("q", width)
    move = rk4(prediction_model(), step).map(samples - 1)
    seen = (y - x) / ca.repmat(ca.sqrt(r), 1, samples)
    drift = x[:, 1:] - move(x[:, :-1], u[:, :-1], ca.repmat(length, 1, samples - 1))
    cost = (ca.sumsqr(seen) + ca.sumsqr(drift / ca.repmat(ca.sqrt(q), 1, samples - 1))) / 2
    z, p = ca.veccat(x, length), ca.veccat(y, u, r, q)
    options = {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes", "max_iter": 100}}
    problem = {"x": z, "p": p, "f": cost}
    return ca.nlpsol("horizon", "ipopt", problem, options), ca.Function("hessian", [z, p], [ca.hessian(cost, z)[0]])
