"""The loops that a flight and an estimate spend their time in, compiled by numba.

Each kernel has a readable definition that a test holds it equal to: ``mpc.problem``, ``kalman.filter_window``,
``dynamics.coupled_plant``. Importing this module compiles everything, for fixed types, so that nothing is compiled
within a control tick; the compilations are kept on disk, and later imports take a fraction of a second. Those who need
a kernel import it where they need it: numba itself takes 0.4 s.

Sums run in the order in which they are written (no ``fastmath``, no BLAS), so every CPU gives the same bits.
"""

import math
import sys
from collections.abc import Callable

import numba
import numpy as np
from numpy.typing import NDArray

from fiplib.params import AXES, GRAVITY, Params

_AXIS_STATES = np.array([axis.states for axis in AXES])
_AXIS_INPUTS = np.array([axis.input for axis in AXES])
_AXIS_SIGNS = np.array([axis.sign for axis in AXES])
"""With z of an axis as in ``params.Axis``: z[4] and the input carry the sign of the axis."""

_OPTIONS = {"error_model": "numpy", "cache": True}


def compiled(*signature: str) -> Callable[[Callable], Callable]:
    """Compile at once for one signature; without any, together with the kernels that call the function."""

    def decorate(function: Callable) -> Callable:
        try:
            return numba.njit(*signature, **_OPTIONS)(function)
        except RuntimeError as error:
            if not _OPTIONS["cache"] or "cannot cache" not in str(error):
                raise
        print(
            "fiplib: compiling for some seconds at every start, as no directory for compiled code can be written: "
            "set NUMBA_CACHE_DIR to one that can",
            file=sys.stderr,
        )
        _OPTIONS["cache"] = False
        return numba.njit(*signature, **_OPTIONS)(function)

    return decorate


# The prediction model


@compiled()
def discretise(length: float, step: float, order: int, f: NDArray, b: NDArray) -> None:
    """Write F (5, 5) and B (5,) of one axis of the model (``dynamics.axis_matrices``), its input held over the step.

    They are sum (A dt)^n / n! and dt sum (A dt)^n b / (n + 1)! up to ``order``: 1 is Euler's method, 4 is RK4.
    """
    stiffness = 2.0 * GRAVITY / length
    f[:] = np.eye(5)
    b[:] = 0.0
    b[4] = step
    power, product = np.eye(5), np.empty((5, 5))
    for n in range(1, order + 1):
        share = step / n
        for column in range(5):
            product[0, column] = power[1, column] * share
            product[1, column] = GRAVITY * power[4, column] * share
            product[2, column] = power[3, column] * share
            product[3, column] = (stiffness * power[2, column] - GRAVITY * power[4, column]) * share
            product[4, column] = 0.0
        power[:] = product
        for row in range(5):
            if n < order:
                b[row] += step / (n + 1) * power[row, 4]
            for column in range(5):
                f[row, column] += power[row, column]


# The optimal control problem; ``mpc`` explains the route

LIMIT = 250
"""Bounds taken up or given up in one solve at most. Where more are needed the rod is already falling (bounds exceeded
severalfold); ``EFFORT`` keeps such a tick, too, within the control period."""

EFFORT = 1_200_000
"""Sum over a solve's steps of the square of the number of active bounds, at most: some 3 ms."""

OPTIMAL, SOFTENED, FAILED = range(3)

_TOLERANCE = 1e-9
"""A bound counts as kept when it is exceeded by no more than this, in the unit of the bounded value."""


def work_shape(nodes: int) -> tuple[int, int]:
    """Shape of the scratch memory of ``solve``."""
    return LIMIT + 9, max(nodes + LIMIT, 6 * nodes)


@compiled()
def _dot(matrix: NDArray, i: int, z: tuple) -> float:
    """Row i of a matrix with at least 5 columns times z. In pairs, which is two additions faster than in a row."""
    pairs = (matrix[i, 0] * z[0] + matrix[i, 1] * z[1]) + (matrix[i, 2] * z[2] + matrix[i, 3] * z[3])
    return pairs + matrix[i, 4] * z[4]


@compiled()
def _product(matrix: NDArray, z: tuple, i: int = 0) -> tuple:
    """Rows i to i + 4 of a matrix times z (5,)."""
    z0, z1, z2 = _dot(matrix, i, z), _dot(matrix, i + 1, z), _dot(matrix, i + 2, z)
    return z0, z1, z2, _dot(matrix, i + 3, z), _dot(matrix, i + 4, z)


@compiled()
def _onward(f: NDArray, z: tuple) -> tuple:
    """F z (5,), where F or A of one axis (``discretise``) has numbers: (s, s'), (d, d') and the tilt."""
    return (
        f[0, 0] * z[0] + f[0, 1] * z[1] + f[0, 4] * z[4],
        f[1, 1] * z[1] + f[1, 4] * z[4],
        f[2, 2] * z[2] + f[2, 3] * z[3] + f[2, 4] * z[4],
        f[3, 2] * z[2] + f[3, 3] * z[3] + f[3, 4] * z[4],
        f[4, 4] * z[4],
    )


@compiled()
def _backward(f: NDArray, p: tuple) -> tuple:
    """F'p (5,) of the same F."""
    return (
        f[0, 0] * p[0],
        f[0, 1] * p[0] + f[1, 1] * p[1],
        f[2, 2] * p[2] + f[3, 2] * p[3],
        f[2, 3] * p[2] + f[3, 3] * p[3],
        (f[0, 4] * p[0] + f[1, 4] * p[1]) + (f[2, 4] * p[2] + f[3, 4] * p[3]) + f[4, 4] * p[4],
    )


@compiled()
def _plus(z: tuple, matrix: NDArray, i: int, factor: float) -> tuple:
    """z + factor * (row i of a matrix)."""
    return (
        z[0] + matrix[i, 0] * factor,
        z[1] + matrix[i, 1] * factor,
        z[2] + matrix[i, 2] * factor,
        z[3] + matrix[i, 3] * factor,
        z[4] + matrix[i, 4] * factor,
    )


@compiled()
def _row(matrix: NDArray, i: int) -> tuple:
    return matrix[i, 0], matrix[i, 1], matrix[i, 2], matrix[i, 3], matrix[i, 4]


@compiled("void(f8, f8, f8[:,:,::1], f8[::1], f8[:,:,::1], f8[:,::1], f8[:,:,::1])")
def riccati(length: float, step: float, q: NDArray, r: NDArray, p: NDArray, model: NDArray, feedback: NDArray) -> None:
    """Write the model (6, 5) of an axis, rows A and B', and the feedback (2, N, 6) of both axes, (K_k, sqrt H_k).

    Backwards from the terminal weights p (2, 5, 5) with q (2, 5, 5) and r (2,):
    H = R + B'PB, K = B'PA / H, P <- Q + A'PA - K'HK.
    """
    discretise(length, step, 4, model[:5], model[5])
    cost, half, b = np.empty((5, 5)), np.empty((5, 5)), _row(model, 5)
    for axis in range(2):
        cost[:] = p[axis]
        for k in range(feedback.shape[1] - 1, -1, -1):
            pb = _product(cost, b)
            h = r[axis] + _dot(model, 5, pb)
            gain = _backward(model, pb)  # (B'PA)', as P is symmetric
            for i in range(5):
                feedback[axis, k, i] = gain[i] / h
                half[0, i], half[1, i], half[2, i], half[3, i], half[4, i] = _backward(model, _row(cost, i))  # A'P
            feedback[axis, k, 5] = math.sqrt(h)
            for i in range(5):
                square = _backward(model, _row(half, i))  # row i of A'PA
                for j in range(i + 1):  # the lower half: a skew part, born of rounding, would grow like the fall
                    cost[i, j] = cost[j, i] = q[axis, i, j] + square[j] - feedback[axis, k, i] * gain[j]


@compiled()
def _forward(model: NDArray, feedback: NDArray, z0: tuple, w: NDArray, plan: NDArray) -> None:
    """Write the plan (N, 6), rows (u_k, z_{k+1}): u_k = -K_k z_k + w_k / sqrt H_k, z_{k+1} = A z_k + B u_k."""
    z = z0
    for k in range(len(plan)):
        u = w[k] / feedback[k, 5] - _dot(feedback, k, z)
        z = _plus(_onward(model, z), model, 5, u)
        plan[k, 0], plan[k, 1], plan[k, 2], plan[k, 3], plan[k, 4], plan[k, 5] = u, z[0], z[1], z[2], z[3], z[4]


@compiled()
def _back(model: NDArray, feedback: NDArray, k: int, adjoint: tuple) -> tuple[float, tuple]:
    """Step k of the adjoint of ``_forward``: B'p / sqrt H and (A - BK)'p."""
    bp = _dot(model, 5, adjoint)
    return bp / feedback[k, 5], _plus(_backward(model, adjoint), feedback, k, -bp)


@compiled()
def _of_axis(axis: int, x: NDArray, k: int) -> tuple:
    """z (5,) of an axis from row k of states or references (..., 10)."""
    i = _AXIS_STATES
    z0, z1, z2, z3 = x[k, i[axis, 0]], x[k, i[axis, 1]], x[k, i[axis, 2]], x[k, i[axis, 3]]
    return z0, z1, z2, z3, _AXIS_SIGNS[axis] * x[k, i[axis, 4]]


@compiled()
def _target(
    axis: int, model: NDArray, feedback: NDArray, q: NDArray, p: NDArray, reference: NDArray, w: NDArray
) -> None:
    """Write w* (N,), which leads along the reference (N + 1, 10) where no bound is active."""
    adjoint = _product(p, _of_axis(axis, reference, len(w)))
    for k in range(len(w) - 1, -1, -1):
        w[k], (a0, a1, a2, a3, a4) = _back(model, feedback, k, adjoint)
        r0, r1, r2, r3, r4 = _product(q, _of_axis(axis, reference, k))
        adjoint = (a0 + r0, a1 + r1, a2 + r2, a3 + r3, a4 + r4)


@compiled()
def _sensitivity(model: NDArray, feedback: NDArray, k: int, i: int, sign: float, row: NDArray) -> None:
    """Write sign * d plan[k, i] / d w, (N,): a row of M."""
    row[:] = 0.0
    adjoint = (sign * (i == 1), sign * (i == 2), sign * (i == 3), sign * (i == 4), sign * (i == 5))
    if i == 0:
        row[k] = sign / feedback[k, 5]
        adjoint = _plus(adjoint, feedback, k, -sign)
        k -= 1
    for j in range(k, -1, -1):
        row[j], adjoint = _back(model, feedback, j, adjoint)


@compiled()
def _give_up(i: int, n: int, factor: NDArray) -> None:
    """Remove column i of n from the upper triangular factor (rows are kept contiguous), by Givens rotations."""
    for row in range(n):
        for column in range(max(i, row - 1), n - 1):
            factor[row, column] = factor[row, column + 1]
    for row in range(i, n - 1):
        x, y = factor[row, row], factor[row + 1, row]
        hypotenuse = math.sqrt(x * x + y * y)
        if hypotenuse > 0.0:
            c, s = x / hypotenuse, y / hypotenuse
            for column in range(row, n - 1):
                x, y = factor[row, column], factor[row + 1, column]
                factor[row, column], factor[row + 1, column] = c * x + s * y, c * y - s * x


@compiled()
def _least_distance(
    model: NDArray,
    feedback: NDArray,
    z0: tuple,
    bounds: NDArray,
    soft: float,
    tolerance: float,
    target: NDArray,
    work: NDArray,
    plan: NDArray,
) -> tuple[int, bool]:
    """Write the optimal plan (N, 6); returns its status and whether some bound is active.

    min |w - target|^2 subject to |plan| <= bounds (6,), by the dual active-set method of Goldfarb and Idnani (1983):
    from the target, take up the bound that is exceeded most and raise its multiplier until it is kept; where another
    multiplier falls to zero on the way, give its bound up. ``soft`` is the inverse price of slack, 0 for hard bounds.

    With m_i the rows of the active bounds, factor'factor is their Gram matrix, plus ``soft`` on its diagonal.
    """
    nodes = len(plan)
    rows, factor, vectors = work[:LIMIT, :nodes], work[:LIMIT, nodes : nodes + LIMIT], work[LIMIT:]
    multiplier, fall, place, sign = vectors[0], vectors[1], vectors[2], vectors[3]
    w, response, column = vectors[4], vectors[5, : 6 * nodes].reshape(nodes, 6), vectors[8]
    w[:nodes] = target
    active = np.zeros((nodes, 6), np.bool_)
    n = steps = effort = 0
    while True:
        _forward(model, feedback, z0, w, plan)
        k, i, violation = -1, 0, _TOLERANCE
        for node in range(nodes):
            for j in range(6):
                over = abs(plan[node, j]) - bounds[j]
                if over > violation and not active[node, j]:
                    k, i, violation = node, j, over
        for j in range(6):
            if not math.isfinite(plan[nodes - 1, j]):
                return FAILED, True
        if k < 0:
            break
        multiplier[n], place[n], sign[n] = 0.0, 6 * k + i, 1.0 if plan[k, i] > 0.0 else -1.0
        _sensitivity(model, feedback, k, i, sign[n], rows[n])
        _forward(model, feedback, (0.0, 0.0, 0.0, 0.0, 0.0), rows[n], response)
        for j in range(n + 1):
            column[j] = sign[j] * response[int(place[j]) // 6, int(place[j]) % 6]
        square = scale = column[n] + (soft if i > 0 else 0.0)
        for j in range(n):
            column[j] /= factor[j, j]
            for m in range(j + 1, n):
                column[m] -= column[j] * factor[j, m]
            factor[j, n] = column[j]
            square -= column[j] * column[j]
        factor[n, n] = math.sqrt(square) if square > 1e-12 * scale else 0.0
        while True:
            steps, effort = steps + 1, effort + n * n
            if steps == LIMIT or effort > EFFORT:
                return FAILED, True
            slope = factor[n, n] * factor[n, n]
            step, blocking = (violation / slope if slope > 0.0 else math.inf), -1
            # the fall of the others per rise of the new multiplier solves factor fall = the factor's new column
            for j in range(n - 1, -1, -1):
                fall[j] = factor[j, n]
                for m in range(j + 1, n):
                    fall[j] -= factor[j, m] * fall[m]
                fall[j] /= factor[j, j]
                if fall[j] > 0.0 and multiplier[j] < step * fall[j]:
                    step, blocking = multiplier[j] / fall[j], j
            if step == math.inf:
                return FAILED, True  # hard bounds that contradict each other
            for j in range(n):
                multiplier[j] -= step * fall[j]
            multiplier[n] += step
            violation -= step * slope
            if blocking < 0:
                active[k, i] = True
                n += 1
                break
            active[int(place[blocking]) // 6, int(place[blocking]) % 6] = False
            for j in range(blocking, n):
                rows[j] = rows[j + 1]
                multiplier[j], place[j], sign[j] = multiplier[j + 1], place[j + 1], sign[j + 1]
            _give_up(blocking, n + 1, factor)
            n -= 1
        w[:nodes] = target
        for j in range(n):
            for m in range(nodes):
                w[m] -= multiplier[j] * rows[j, m]
    for j in range(n):  # rounding can spoil what was kept once, where the rod is past saving
        k, i = int(place[j]) // 6, int(place[j]) % 6
        if abs(sign[j] * plan[k, i] - bounds[i] - (soft * multiplier[j] if i > 0 else 0.0)) > tolerance:
            return FAILED, True
    status = OPTIMAL
    for node in range(nodes):
        plan[node, 0] = min(max(plan[node, 0], -bounds[0]), bounds[0])  # kept to the tolerance only
        for j in range(1, 6):
            if abs(plan[node, j]) > bounds[j] + tolerance:
                status = SOFTENED
    return status, steps > 0


@compiled()
def _saturated(model: NDArray, z0: tuple, bound: float, plan: NDArray) -> None:
    """Cut the inputs of a plan off at their bound, and write where the model goes with them."""
    z = z0
    for k in range(len(plan)):
        u = 0.0 if math.isnan(plan[k, 0]) else min(max(plan[k, 0], -bound), bound)
        z = _plus(_onward(model, z), model, 5, u)
        plan[k, 0], plan[k, 1], plan[k, 2], plan[k, 3], plan[k, 4], plan[k, 5] = u, z[0], z[1], z[2], z[3], z[4]


@compiled(
    "i8(f8[::1], f8[:,::1], f8[:,::1], f8[:,:,::1], f8[:,:,::1], f8[:,:,::1], f8[:,::1], f8, f8,"
    " f8[:,::1], f8[:,::1], f8[:,::1])"
)
def solve(
    state: NDArray,
    reference: NDArray,
    model: NDArray,
    feedback: NDArray,
    q: NDArray,
    p: NDArray,
    bounds: NDArray,
    soft: float,
    tolerance: float,
    work: NDArray,
    states: NDArray,
    inputs: NDArray,
) -> int:
    """Write the optimal plan of both axes, states (N + 1, 10) and inputs (N, 2).

    Args:
        state: x_0 (10,).
        reference: (N + 1, 10).
        model, feedback: as ``riccati`` writes them.
        q, p: weights per axis, (2, 5, 5) each.
        bounds: of (u, z) per axis, (2, 6).
        soft: inverse price of the slack of the state bounds, 0 if they are hard.
        tolerance: a state bound exceeded by more counts as softened.
        work: scratch memory of ``work_shape``.

    Returns:
        -1 if state or reference are not finite; else the worse status of the two axes, plus 4 if a bound is active.
    """
    nodes = len(inputs)
    for i in range(10):
        if not math.isfinite(state[i]):
            return -1
    for k in range(nodes + 1):
        for i in range(10):
            if not math.isfinite(reference[k, i]):
                return -1
    worst, bounded = OPTIMAL, False
    target, plan = work[LIMIT + 6, :nodes], work[LIMIT + 7, : 6 * nodes].reshape(nodes, 6)
    states[0] = state
    for axis in range(2):
        z0 = _of_axis(axis, states, 0)
        _target(axis, model, feedback[axis], q[axis], p[axis], reference, target)
        status, some = _least_distance(model, feedback[axis], z0, bounds[axis], soft, tolerance, target, work, plan)
        if status == FAILED:
            _forward(model, feedback[axis], z0, target, plan)
            _saturated(model, z0, bounds[axis, 0], plan)
        worst, bounded = max(worst, status), bounded or some
        sign = _AXIS_SIGNS[axis]
        for k in range(nodes):
            inputs[k, _AXIS_INPUTS[axis]] = sign * plan[k, 0]
            for i in range(5):
                states[k + 1, _AXIS_STATES[axis, i]] = (sign if i == 4 else 1.0) * plan[k, i + 1]
    return worst + 4 * bounded


# The Kalman filter over candidate lengths; ``kalman.filter_step`` is the readable one


@compiled()
def _invert(matrix: NDArray, first: int) -> float:
    """Replace the positive definite rows ``first`` to ``first`` + 4 by their inverse; returns their determinant.

    The sweep operator: an exchange step of Gauss and Jordan for each pivot leaves the negative inverse.
    """
    determinant = 1.0
    for i in range(5):
        pivot = _row(matrix, first + i)
        determinant *= pivot[i]
        inverse = 1.0 / pivot[i]
        for row in range(5):
            if row != i:
                factor = pivot[row] * inverse
                for column in range(5):
                    matrix[first + row, column] -= factor * pivot[column]
                matrix[first + row, i] = matrix[first + i, row] = factor
        matrix[first + i, i] = -inverse
    for row in range(first, first + 5):
        for column in range(5):
            matrix[row, column] = -matrix[row, column]
    return determinant


@compiled("void(f8[::1], f8[:,::1], f8[:,::1], f8, i8, i8, f8[:,::1], f8[:,::1], f8[::1])")
def fitness(
    lengths: NDArray,
    states: NDArray,
    inputs: NDArray,
    step: float,
    transition: int,
    score: int,
    q: NDArray,
    r: NDArray,
    result: NDArray,
) -> None:
    """Write the fitness (C,) of candidate lengths (C,).

    ``kalman.filter_step`` per axis, shortened as H = I and a diagonal R allow: with G = S^-1, K = I - R G,
    P+ = R - R G R and x+ = z - R G y.

    Args:
        lengths: in m, (C,).
        states, inputs, step: as in ``kalman.Window``.
        transition: 0 'printed', 1 'euler', 2 'rk4', as in ``kalman.READINGS``.
        score: 0 'posterior', 1 'prior', 2 'likelihood'.
        q, r: variances per axis, (2, 5).
        result: (C,).
    """
    same = True
    for i in range(5):
        same = same and q[0, i] == q[1, i] and r[0, i] == r[1, i]
    f, j, half, b, x = np.empty((5, 5)), np.empty((5, 5)), np.empty((5, 5)), np.empty((1, 5)), np.empty((2, 5))
    p, g = np.empty((10, 5)), np.empty((10, 5))  # one axis below the other
    for candidate in range(len(lengths)):
        discretise(lengths[candidate], step, 4 if transition == 2 else 1, f, b[0])
        j[:] = f
        if transition == 0:  # as printed: the continuous Jacobian
            for i in range(5):
                for m in range(5):
                    j[i, m] = (f[i, m] - (i == m)) / step
        total = 0.0
        p[:] = 0.0
        for axis in range(2):
            for i in range(5):
                p[5 * axis + i, i] = r[axis, i]
            x[axis, 0], x[axis, 1], x[axis, 2], x[axis, 3], x[axis, 4] = _of_axis(axis, states, 0)
        for k in range(1, len(states)):
            for axis in range(2):
                if axis == 0 or not same:  # axes of equal noise share their covariances
                    for i in range(5):
                        half[0, i], half[1, i], half[2, i], half[3, i], half[4, i] = _onward(j, _row(p, 5 * axis + i))
                    for i in range(5):
                        m = 5 * axis + i
                        g[m, 0], g[m, 1], g[m, 2], g[m, 3], g[m, 4] = _onward(j, _row(half, i))  # J P J'
                        g[m, i] += q[axis, i] + r[axis, i]
                    determinant = _invert(g, 5 * axis)
                    for row in range(5):
                        for column in range(5):
                            p[5 * axis + row, column] = -r[axis, row] * g[5 * axis + row, column] * r[axis, column]
                        p[5 * axis + row, row] += r[axis, row]
                if score == 2:
                    total += math.log(determinant)
                u = _AXIS_SIGNS[axis] * inputs[k - 1, _AXIS_INPUTS[axis]]
                z = _of_axis(axis, states, k)
                predicted = _plus(_onward(f, _row(x, axis)), b, 0, u)
                y = (
                    z[0] - predicted[0],
                    z[1] - predicted[1],
                    z[2] - predicted[2],
                    z[3] - predicted[3],
                    z[4] - predicted[4],
                )
                weighted = _product(g, y, 0 if same else 5 * axis)
                for i in range(5):
                    residual = r[axis, i] * weighted[i]
                    x[axis, i] = z[i] - residual
                    if score == 0:
                        total += residual * residual
                    elif score == 1:
                        total += y[i] * y[i]
                    else:
                        total += y[i] * weighted[i]
        result[candidate] = total if math.isfinite(total) else math.inf


# The simulated vehicle; ``dynamics.coupled_plant`` is the readable one

FALLEN = math.cos(math.radians(60.0))
"""A rod or a vehicle that leans further than 60 degrees is not coming back."""


def plant_constants(params: Params) -> NDArray:
    """Mass of vehicle and rod in kg, half the rod's length in m, its ``inertia_factor``, lags and step in s: (7,)."""
    vehicle, pendulum, simulation = params.vehicle, params.pendulum, params.simulation
    lags = simulation.rate_lag, simulation.thrust_lag
    return np.array(
        (vehicle.mass, pendulum.mass, pendulum.length / 2, pendulum.inertia_factor, *lags, 1.0 / simulation.plant_rate)
    )


@compiled()
def _across(v: tuple, q: tuple) -> tuple:
    """The part of v (3,) across the unit vector q (3,)."""
    along = q[0] * v[0] + q[1] * v[1] + q[2] * v[2]
    return v[0] - along * q[0], v[1] - along * q[1], v[2] - along * q[2]


@compiled()
def _plant_rate(x: NDArray, command: NDArray, force: NDArray, about: NDArray, rate: NDArray) -> None:
    """Write x' (20,) of the state x, laid out by ``dynamics.PLANT``; ``about`` of ``plant_constants``."""
    m, m_p, radius, factor, rate_lag, thrust_lag = about[0], about[1], about[2], about[3], about[4], about[5]
    i, j, k, w = x[6], x[7], x[8], x[9]
    q = (x[10], x[11], x[12])
    body_z = (2.0 * (i * k + w * j), 2.0 * (j * k - w * i), 1.0 - 2.0 * (i * i + j * j))
    spin = x[13] * x[13] + x[14] * x[14] + x[15] * x[15]
    outward, thrust = m_p * radius * spin, x[19]
    f = (force[0], force[1], force[2])
    f_across = _across(f, q)
    total = (
        thrust * body_z[0] + f[0] + outward * q[0] - factor * f_across[0],
        thrust * body_z[1] + f[1] + outward * q[1] - factor * f_across[1],
        thrust * body_z[2] + f[2] + outward * q[2] - factor * f_across[2],
    )
    total_across, share = _across(total, q), m_p * factor / (m + m_p * (1.0 - factor))
    alpha = (
        (total[0] + share * total_across[0]) / (m + m_p),
        (total[1] + share * total_across[1]) / (m + m_p),
        (total[2] + share * total_across[2]) / (m + m_p),
    )
    pull = _across((alpha[0] - f[0] / m_p, alpha[1] - f[1] / m_p, alpha[2] - f[2] / m_p), q)
    a, b, c = x[16], x[17], x[18]
    rate[6] = 0.5 * (w * a + j * c - k * b)
    rate[7] = 0.5 * (w * b + k * a - i * c)
    rate[8] = 0.5 * (w * c + i * b - j * a)
    rate[9] = -0.5 * (i * a + j * b + k * c)
    for n in range(3):
        rate[n] = x[3 + n]
        rate[3 + n] = alpha[n]
        rate[10 + n] = x[13 + n]
        rate[13 + n] = -spin * q[n] - factor / radius * pull[n]
        rate[16 + n] = (command[n] - x[16 + n]) / rate_lag
    rate[5] -= GRAVITY
    rate[19] = (command[3] - thrust) / thrust_lag


@compiled("void(f8[::1], f8[:,::1], f8[::1], f8[::1])")
def advance(x: NDArray, commands: NDArray, force: NDArray, about: NDArray) -> None:
    """Advance the plant's state (20,) in place: an RK4 step for each row of the commands.

    Args:
        x: laid out by ``dynamics.PLANT``; quaternion and direction are made units again after each step.
        commands: (n, 4), body rates in rad/s and thrust in N.
        force: on the rod's COM, (3,) in N.
        about: ``plant_constants``.
    """
    step = about[6]
    k1, k2, k3, k4, at = np.empty(20), np.empty(20), np.empty(20), np.empty(20), np.empty(20)
    for row in range(len(commands)):
        command = commands[row]
        _plant_rate(x, command, force, about, k1)
        for n in range(20):
            at[n] = x[n] + step / 2.0 * k1[n]
        _plant_rate(at, command, force, about, k2)
        for n in range(20):
            at[n] = x[n] + step / 2.0 * k2[n]
        _plant_rate(at, command, force, about, k3)
        for n in range(20):
            at[n] = x[n] + step * k3[n]
        _plant_rate(at, command, force, about, k4)
        for n in range(20):
            x[n] += step / 6.0 * (k1[n] + 2.0 * k2[n] + 2.0 * k3[n] + k4[n])
        norm = math.sqrt(x[6] * x[6] + x[7] * x[7] + x[8] * x[8] + x[9] * x[9])
        for n in range(6, 10):
            x[n] /= norm
        norm = math.sqrt(x[10] * x[10] + x[11] * x[11] + x[12] * x[12])
        for n in range(10, 13):
            x[n] /= norm
        x[13], x[14], x[15] = _across((x[13], x[14], x[15]), (x[10], x[11], x[12]))


@compiled("b1(f8[::1])")
def fallen(x: NDArray) -> bool:
    """Whether rod or vehicle lean further than 60 degrees, or the vehicle is on the ground: the flight is over."""
    return x[12] < FALLEN or 1.0 - 2.0 * (x[6] * x[6] + x[7] * x[7]) < FALLEN or x[2] < 0.1


@compiled()
def _single(value: float) -> float:
    return float(np.float32(value))


@compiled()
def _turned(q: tuple, noise: NDArray, first: int) -> tuple:
    """The quaternion q turned by a small rotation vector in the body frame, in single precision."""
    i, j, k = noise[first] / 2.0, noise[first + 1] / 2.0, noise[first + 2] / 2.0
    x = q[0] + q[3] * i + q[1] * k - q[2] * j
    y = q[1] + q[3] * j + q[2] * i - q[0] * k
    z = q[2] + q[3] * k + q[0] * j - q[1] * i
    w = q[3] - q[0] * i - q[1] * j - q[2] * k
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    return _single(x / norm), _single(y / norm), _single(z / norm), _single(w / norm)


@compiled("void(f8[::1], f8, f8[::1], f8[::1])")
def expose(x: NDArray, radius: float, noise: NDArray, frame: NDArray) -> None:
    """Write a frame of motion capture (14,): position and attitude of the vehicle, then of the rod.

    Args:
        x: the plant's state.
        radius: half the rod's length in m.
        noise: of both positions in m, then of both attitudes in rad, (12,).
        frame: numbers that single precision can hold.
    """
    for n in range(3):
        frame[n] = _single(x[n] + noise[n])
        frame[7 + n] = _single(x[n] + radius * x[10 + n] + noise[3 + n])
    frame[3], frame[4], frame[5], frame[6] = _turned((x[6], x[7], x[8], x[9]), noise, 6)
    # shortest rotation that takes the z axis to the rod's direction
    scale = math.sqrt(2.0 * (1.0 + x[12]))
    upright = (-x[11] / scale, x[10] / scale, 0.0, (1.0 + x[12]) / scale)
    frame[10], frame[11], frame[12], frame[13] = _turned(upright, noise, 9)


@compiled()
def _euler_angles(q: NDArray, first: int) -> tuple:
    """As ``dynamics.euler_angles``."""
    x, y, z, w = q[first], q[first + 1], q[first + 2], q[first + 3]
    phi = math.atan2(2 * (w * x - y * z), 1 - 2 * (x * x + y * y))
    theta = math.asin(max(-1.0, min(1.0, 2 * (x * z + w * y))))
    return phi, theta, math.atan2(2 * (w * z - x * y), 1 - 2 * (y * y + z * z))


@compiled("void(f8[::1], f8, f8[::1])")
def true_state(x: NDArray, radius: float, truth: NDArray) -> None:
    """Write the ten true states and the height z, (11,), of the plant's state x."""
    truth[0], truth[1], truth[2], truth[3] = x[0], x[3], x[1], x[4]
    truth[4], truth[5], truth[6], truth[7] = radius * x[10], radius * x[13], radius * x[11], radius * x[14]
    truth[8], truth[9], _ = _euler_angles(x, 6)
    truth[10] = x[2]


# The pilot around the MPC


@compiled("void(f8[::1], f8, f8, f8, f8[::1], f8[::1])")
def observe(frame: NDArray, length: float, elapsed: float, cutoff: float, memory: NDArray, observed: NDArray) -> None:
    """Write the states (10,), then height in m, climb rate in m/s and yaw in rad: ``pilot.Observer``.

    Args:
        frame: (14,), as ``expose`` writes it.
        length: of the rod, if (a, b) are to be its direction times half the length; 0 for the position of its COM.
        elapsed: since the last frame in s; at 0 and below velocities stay as they are.
        cutoff: of the low-pass filter in Hz.
        memory: last positions x, y, a, b, z and their filtered velocities, (10,); zeros at first.
        observed: (13,).
    """
    phi, theta, psi = _euler_angles(frame, 3)
    a, b = frame[7] - frame[0], frame[8] - frame[1]
    if length > 0.0:
        x, y, z, w = frame[10], frame[11], frame[12], frame[13]
        a, b = length * (x * z + w * y), length * (y * z - w * x)
    share = 1.0 - math.exp(-2.0 * math.pi * cutoff * elapsed)
    position = (frame[0], frame[1], a, b, frame[2])
    for n in range(5):
        if elapsed > 0.0:
            memory[5 + n] += share * ((position[n] - memory[n]) / elapsed - memory[5 + n])
        memory[n] = position[n]
    for n in range(4):
        observed[2 * n], observed[2 * n + 1] = memory[n], memory[5 + n]
    observed[8], observed[9] = phi, theta
    observed[10], observed[11], observed[12] = memory[4], memory[9], psi


@compiled("void(f8[::1], f8, f8, f8, f8, f8[:,::1])")
def circle(times: NDArray, radius: float, period: float, start: float, ramp: float, states: NDArray) -> None:
    """Write the states (n, 10) of ``pilot.Circle`` at times (n,) in s."""
    speed = 2.0 * math.pi / period
    states[:] = 0.0
    for n in range(len(times)):
        since = max(times[n] - start, 0.0)
        u = min(since / ramp, 1.0)
        # the angular speed rises as 3 u^2 - 2 u^3; its integral over the whole ramp is half the ramp
        angle = speed * (ramp * u * u * u * (1.0 - u / 2.0) + max(since - ramp, 0.0))
        rate = speed * u * u * (3.0 - 2.0 * u)
        cos, sin = radius * math.cos(angle), radius * math.sin(angle)
        states[n, 0], states[n, 1], states[n, 2], states[n, 3] = cos, -rate * sin, sin, rate * cos


def pilot_constants(params: Params, height: float) -> NDArray:
    """What ``answer`` needs of the parameters, and the height to hold in m: (12,)."""
    piloting, vehicle = params.piloting, params.vehicle
    loops = (*piloting.altitude_gains, piloting.altitude_integral_limit, *piloting.yaw_gains, math.inf)
    mass = vehicle.mass + params.pendulum.mass
    return np.array((height, mass, vehicle.max_thrust, vehicle.max_body_rate, *loops))


@compiled()
def _pid(error: float, error_rate: float, elapsed: float, about: NDArray, first: int, integral: float) -> tuple:
    """Answer and new integral share of a PID loop on a given error and its given derivative."""
    limit = about[first + 3]
    integral = max(-limit, min(limit, integral + about[first + 1] * error * elapsed))
    return about[first] * error + integral + about[first + 2] * error_rate, integral


@compiled("void(f8, f8, f8, f8, f8, f8, f8, f8, f8[::1], f8[::1], f8[::1])")
def answer(
    phi: float,
    theta: float,
    height: float,
    climb_rate: float,
    yaw: float,
    omega_x: float,
    omega_y: float,
    elapsed: float,
    about: NDArray,
    integrals: NDArray,
    command: NDArray,
) -> None:
    """Write the command (4,), body rates in rad/s and normalised thrust, of the MPC's rates and the loops beside it.

    Args:
        phi, theta, yaw: in rad.
        height, climb_rate: in m and m/s.
        omega_x, omega_y: the MPC's input in rad/s.
        elapsed: since the last tick in s.
        about: ``pilot_constants``.
        integrals: of altitude and yaw, (2,); zeros at first.
        command: thrust in single precision, as AttitudeTarget carries it: fly what is recorded.
    """
    climb, integrals[0] = _pid(about[0] - height, -climb_rate, elapsed, about, 4, integrals[0])
    lift = about[1] * (GRAVITY + climb) / (math.cos(phi) * math.cos(theta))
    turn, integrals[1] = _pid(-yaw, 0.0, elapsed, about, 8, integrals[1])
    command[0], command[1] = omega_x, omega_y
    command[2] = max(-about[3], min(about[3], turn))
    command[3] = _single(max(0.0, min(1.0, lift / about[2])))


# A whole flight: what ``simulate.fly`` does frame by frame


@compiled(
    "i8(i8, i8, f8[::1], f8[::1], f8[:,::1], f8[:,::1], f8[:,::1], i8[::1], i8[::1], f8[::1], f8[::1], f8[:,:,::1],"
    " f8, f8, f8[::1], f8[::1], f8[::1],"
    " f8[:,::1], f8[:,:,::1], f8[:,:,::1], f8[:,:,::1], f8[:,::1], f8, f8, f8[:,::1],"
    " f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1], i8[::1])"
)
def fly(
    first: int,
    last: int,
    x: NDArray,
    about: NDArray,
    schedule: NDArray,
    noise: NDArray,
    forces: NDArray,
    ticks: NDArray,
    acts: NDArray,
    elapsed: NDArray,
    tick_elapsed: NDArray,
    references: NDArray,
    length: float,
    cutoff: float,
    memory: NDArray,
    pilot: NDArray,
    integrals: NDArray,
    model: NDArray,
    feedback: NDArray,
    q: NDArray,
    p: NDArray,
    bounds: NDArray,
    soft: float,
    tolerance: float,
    work: NDArray,
    frames: NDArray,
    truths: NDArray,
    states: NDArray,
    commands: NDArray,
    statuses: NDArray,
) -> int:
    """Fly the frames ``first`` to ``last`` - 1 of a flight of F frames and T control ticks; ``batch`` has them.

    Args:
        x, about: state and constants of the plant, as in ``advance``.
        schedule: (substeps, 4), scratch; its last row holds the command in force.
        noise, forces: for each frame, as in ``expose`` and ``advance``.
        ticks: number of the control tick of each frame, -1 where there is none, (F,).
        acts: substep at which the command of each tick begins to act, (T,).
        elapsed: since the frame before, in s, (F,); ``tick_elapsed``: since the tick before, (T,).
        references: (T, N + 1, 10).
        length, cutoff, memory: as in ``observe``.
        pilot, integrals: as in ``answer``.
        model to work: as in ``solve``.
        frames, truths, states, commands, statuses: what is written: (F, 14), (F, 11), (T, 10), (T, 4), (T,).

    Returns:
        The frame after which rod or vehicle had fallen, or ``last``.
    """
    substeps, nodes = len(schedule), feedback.shape[1]
    observed, plan, inputs = np.empty(13), np.empty((nodes + 1, 10)), np.empty((nodes, 2))
    given = 0
    for index in range(first):
        given = max(given, ticks[index] + 1)
    acting = 0
    while acting < given and acts[acting] < first * substeps:
        acting += 1
    for index in range(first, last):
        expose(x, about[2], noise[index], frames[index])
        true_state(x, about[2], truths[index])
        observe(frames[index], length, elapsed[index], cutoff, memory, observed)
        tick = ticks[index]
        if tick >= 0:
            states[tick] = observed[:10]
            statuses[tick] = solve(
                states[tick], references[tick], model, feedback, q, p, bounds, soft, tolerance, work, plan, inputs
            )
            answer(
                observed[8],
                observed[9],
                observed[10],
                observed[11],
                observed[12],
                inputs[0, 0],
                inputs[0, 1],
                tick_elapsed[tick],
                pilot,
                integrals,
                commands[tick],
            )
            given = tick + 1
        for row in range(substeps):
            schedule[row] = schedule[row - 1 if row > 0 else substeps - 1]
            while acting < given and acts[acting] <= index * substeps + row:
                schedule[row, :3] = commands[acting, :3]
                schedule[row, 3] = commands[acting, 3] * pilot[2]
                acting += 1
        advance(x, schedule, forces[index], about)
        if fallen(x):
            return index
    return last
