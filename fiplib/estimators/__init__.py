"""Estimators of the pendulum's length, behind one call: the paper's genetic algorithm, its rivals, the recommended one.

``ESTIMATORS[name].function(window, params, rng) -> Estimate``. An estimator of kind 'states' takes the paper's window
(``kalman.Window``: 55 derived states in steps of 0.1 s) and uses the paper's model; one of kind 'raw' takes motion
capture as measured (``windows.RawWindow``). To add one, write such a function and add a line to ``ESTIMATORS``.

What they do with the same window:

- ``ga``, ``ga_improved``, ``grid``, ``scalar`` search the same fitness (``estimation.fitness``) by different means.
- ``ekf``, ``ukf`` estimate the states and the length together, forwards in time, the length being one more state.
- ``moving_horizon`` fits all states of the window and the length together, by nonlinear programming.
- ``recursive_least_squares``, ``concurrent_learning`` regress d'' + g tilt = (1/l) 2 g d, with d'' from differences of
  d' over a step. Differencing throws most of the information away: what d' owes to noise is as large as what it owes to
  the length. The price of their simplicity.
- ``maximum_likelihood`` is ours (``fiplib.estimators.likelihood``); ``maximum_likelihood_calibrated`` takes the calibration of
  motion capture for exact, ``maximum_likelihood_free`` is told neither the rod's inertia nor the lag of the inner loop.
"""

import math
from dataclasses import replace
from functools import lru_cache, partial

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from fiplib import ga as genetic
from fiplib import kalman
from fiplib.dynamics import prediction_model, rk4
from fiplib.estimators.base import PRIOR, Estimate, Estimator, _within
from fiplib.estimators.likelihood import NUISANCES, maximum_likelihood
from fiplib.kalman import Window
from fiplib.params import AXES, GRAVITY, STATES, Params

IMPROVED = {"elite_fraction": 1 / 30, "mutation_rate": 0.2}
"""The paper's own remedies (its conclusion): fewer elites, more mutation. Two elites of sixty keep the population
diverse, and three flipped bits of fifteen keep it searching."""


def ga(window: Window, params: Params, rng: np.random.Generator) -> Estimate:
    """The paper's genetic algorithm with its printed settings (``ga.estimate``)."""
    found = genetic.estimate(window, params, rng)
    return Estimate(found.length, found.standard_deviation)


def ga_improved(window: Window, params: Params, rng: np.random.Generator) -> Estimate:
    """The same with fewer elites and more mutation, at the same number of evaluations (``IMPROVED``)."""
    return ga(window, replace(params, estimation=replace(params.estimation, **IMPROVED)), rng)


def grid(window: Window, params: Params, rng: np.random.Generator | None = None) -> Estimate:
    """The best of all lengths that the chromosome can express: what a perfect search of the fitness finds."""
    landscape = genetic.landscape(window, params)
    best, codes = int(landscape.fitness.argmin()), genetic.CURVATURE_CODES
    if not codes <= best < len(landscape.lengths) - codes:
        return Estimate(landscape.best, math.nan)
    values = landscape.fitness[[best - codes, best, best + codes]]
    return Estimate(landscape.best, _deviation(values, codes * params.estimation.resolution, params))


def scalar(window: Window, params: Params, rng: np.random.Generator | None = None) -> Estimate:
    """Brent's method (SciPy) on the fitness, within the best bracket of a coarse grid."""
    estimation = params.estimation
    lengths = np.geomspace(estimation.length_min, estimation.length_max, 25)

    def fitness(length: float) -> float:
        return float(kalman.fitness([length], window, estimation)[0])

    best = int(kalman.fitness(lengths, window, estimation).argmin())
    bracket = lengths[max(best - 1, 0)], lengths[min(best + 1, len(lengths) - 1)]
    length = float(minimize_scalar(fitness, bounds=bracket, method="bounded", options={"xatol": 1e-5}).x)
    step = 1e-3  # small beside any deviation a window can reach, large beside rounding
    values = kalman.fitness([length - step, length, length + step], window, estimation)
    inside = estimation.length_min + 2 * step < length < estimation.length_max - 2 * step
    return Estimate(length, _deviation(values, step, params) if inside else math.nan)


def ekf(window: Window, params: Params, rng: np.random.Generator | None = None) -> Estimate:
    """Extended Kalman filter (filterpy) of the ten states and the length, a constant that starts at ``PRIOR``."""
    from filterpy.kalman import ExtendedKalmanFilter

    step, jacobian, _ = _augmented(window.step)
    estimator = ExtendedKalmanFilter(dim_x=11, dim_z=10)
    _prepare(estimator, window, params)
    for state, applied in zip(window.states[1:], window.inputs[:-1], strict=True):
        estimator.F = np.array(jacobian(estimator.x, applied))
        estimator.P = estimator.F @ estimator.P @ estimator.F.T + estimator.Q
        estimator.x = np.array(step(estimator.x, applied)).ravel()
        estimator.update(state, lambda x: np.eye(10, 11), lambda x: x[:10])
        estimator.x[10] = _within(estimator.x[10], params)
    return Estimate(float(estimator.x[10]), math.sqrt(estimator.P[10, 10]))


def ukf(window: Window, params: Params, rng: np.random.Generator | None = None) -> Estimate:
    """Unscented Kalman filter (filterpy) of the same eleven states."""
    from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

    _, _, spread = _augmented(window.step)
    # kappa = 3 - n and alpha = 0.3: sigma points at 0.5 standard deviations, so that no length turns negative
    points = MerweScaledSigmaPoints(11, alpha=0.3, beta=2.0, kappa=3.0 - 11)
    estimator = UnscentedKalmanFilter(11, 10, window.step, hx=lambda x: x[:10], fx=None, points=points)
    _prepare(estimator, window, params)
    for state, applied in zip(window.states[1:], window.inputs[:-1], strict=True):
        sigmas = points.sigma_points(estimator.x, estimator.P)
        sigmas[:, 10] = np.maximum(sigmas[:, 10], params.estimation.length_min / 2)
        moved = iter(np.array(spread(sigmas.T, np.repeat(applied[:, None], len(sigmas), axis=1))).T)
        estimator.predict(fx=lambda x, dt, moved=moved: next(moved))  # all points in one call of CasADi
        estimator.update(state)
        estimator.x[10] = _within(estimator.x[10], params)
        estimator.P = (estimator.P + estimator.P.T) / 2
    return Estimate(float(estimator.x[10]), math.sqrt(max(estimator.P[10, 10], 0.0)))


def recursive_least_squares(window: Window, params: Params, rng: np.random.Generator | None = None) -> Estimate:
    """Recursive least squares of 1/l: the Kalman filter (filterpy) of a constant, one regression per step and axis."""
    from filterpy.kalman import KalmanFilter

    regressor, response = _regression(window)
    estimator = KalmanFilter(dim_x=1, dim_z=1)
    estimator.x[:] = 1 / PRIOR[0]
    estimator.P[:] = 1 / params.estimation.length_min**2  # knows next to nothing
    estimator.Q[:] = 0.0
    # the response errs by the noise of two velocities over a step
    velocity = params.estimation.measurement_noise[AXES[0].states[3]]
    estimator.R[:] = 2 * velocity / window.step**2
    for row, value in zip(regressor, response, strict=True):
        estimator.predict()
        estimator.update(value, H=np.array([[row]]))
    inverse = float(estimator.x[0, 0])
    return _inverted(inverse, math.sqrt(estimator.P[0, 0]), params)


def concurrent_learning(window: Window, params: Params, rng: np.random.Generator | None = None) -> Estimate:
    """Concurrent learning: an adaptive law that is driven by recorded data beside the current error.

    p = 1/l follows p' = gamma (e phi + sum_j e_j phi_j), with the error e = response - p phi now and e_j at the points
    of a history stack, which keeps the points of largest |phi| (for one parameter this maximises the least singular
    value that governs convergence). Steps are normalised, so that the law is stable at any excitation.
    """
    regressor, response = _regression(window)
    value, stack = 1 / PRIOR[0], np.zeros(0, dtype=int)
    for now in range(len(regressor)):
        stack = np.append(stack, now)
        stack = stack[np.argsort(-np.abs(regressor[stack]), kind="stable")[:20]]
        used = np.append(stack, now)
        phi, error = regressor[used], response[used] - value * regressor[used]
        value += 0.5 * float(phi @ error) / float(phi @ phi + 1e-6)
    return _inverted(value, math.nan, params)


def moving_horizon(window: Window, params: Params, rng: np.random.Generator | None = None) -> Estimate:
    """Moving-horizon estimation (CasADi, IPOPT): states of the whole window and length under both noises at once.

    min over x_0..x_n, l of sum |y_k - x_k|^2 in R_e^-1 + sum |x_k+1 - F(x_k, u_k, l)|^2 in Q_e^-1; the standard
    deviation is the length's share of the inverse Hessian at the optimum.

    Raises:
        ValueError: a variance of the process noise is zero.
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
    unit = np.zeros(window.states.size + 1)
    unit[-1] = 1.0
    variance = float(ca.solve(hessian(best, data), ca.DM(unit), "csparse")[-1])
    return Estimate(float(best[-1]), math.sqrt(variance) if variance > 0 else math.nan)


ESTIMATORS = {
    "ga": Estimator(ga, "states"),
    "ga_improved": Estimator(ga_improved, "states"),
    "grid": Estimator(grid, "states"),
    "scalar": Estimator(scalar, "states"),
    "ekf": Estimator(ekf, "states"),
    "ukf": Estimator(ukf, "states"),
    "recursive_least_squares": Estimator(recursive_least_squares, "states"),
    "concurrent_learning": Estimator(concurrent_learning, "states"),
    "moving_horizon": Estimator(moving_horizon, "states"),
    "maximum_likelihood": Estimator(maximum_likelihood, "raw"),
    "maximum_likelihood_calibrated": Estimator(partial(maximum_likelihood, nuisances=()), "raw"),
    "maximum_likelihood_free": Estimator(partial(maximum_likelihood, nuisances=NUISANCES), "raw"),
}
"""Every estimator by name, ``estimation.estimator`` chooses the one in flight."""


def _deviation(values: NDArray, step: float, params: Params) -> float:
    """sqrt(2 / f'') from three values of f = -2 log L; nan for readings that are no likelihood or not convex."""
    curvature = (values[0] - 2 * values[1] + values[2]) / step**2
    good = kalman.reading(params.estimation).score == "likelihood" and 0 < curvature < math.inf
    return math.sqrt(2 / curvature) if good else math.nan


def _inverted(inverse: float, deviation: float, params: Params) -> Estimate:
    """From 1/l and its standard deviation to l, to first order."""
    if not params.estimation.length_min < 1 / max(inverse, 1e-9) < params.estimation.length_max:
        return Estimate(math.nan, math.nan, f"the regression gives 1/l = {inverse:.2g} 1/m, not a rod in question")
    return Estimate(1 / inverse, deviation / inverse**2)


def _prepare(estimator: object, window: Window, params: Params) -> None:
    """Noise, first state and covariance of a joint filter; as in ``kalman``, the first measurement is a posterior."""
    estimation = params.estimation
    estimator.x = np.append(window.states[0], PRIOR[0])
    estimator.P = np.diag([*estimation.measurement_noise, PRIOR[1] ** 2])
    estimator.Q = np.diag([*estimation.process_noise, 0.0])
    estimator.R = np.diag(estimation.measurement_noise)


def _regression(window: Window) -> tuple[NDArray, NDArray]:
    """Regressor 2 g d and response d'' + g tilt, (2 (n - 1),), in time order, both as means over a step."""
    rows = []
    for axis in AXES:
        _, _, offset, offset_rate, tilt = axis.states
        mean = (window.states[1:] + window.states[:-1]) / 2
        second = np.diff(window.states[:, offset_rate]) / window.step
        rows.append((2 * GRAVITY * mean[:, offset], second + GRAVITY * axis.sign * mean[:, tilt]))
    regressor, response = np.array(rows).transpose(1, 2, 0).reshape(2, -1)
    return regressor, response


@lru_cache(maxsize=4)
def _augmented(step: float) -> tuple[ca.Function, ca.Function, ca.Function]:
    """(x (11,), u) -> x after a step with the length as eleventh state; its Jacobian; the same for 23 columns."""
    x, u = ca.SX.sym("x", 11), ca.SX.sym("u", 2)
    after = ca.vertcat(rk4(prediction_model(), step)(x[:10], u, x[10]), x[10])
    move = ca.Function("move", [x, u], [after])
    return move, ca.Function("jacobian", [x, u], [ca.jacobian(after, x)]), move.map(23)


@lru_cache(maxsize=4)
def _horizon(samples: int, step: float) -> tuple[ca.Function, ca.Function]:
    """The nonlinear programme of ``moving_horizon``, and the Hessian of its cost, for a size of window."""
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
