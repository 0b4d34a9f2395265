"""The optimal control problem; ``mpc.problem`` is the readable one, and ``mpc`` explains the route."""

import math

import numpy as np
from numpy.typing import NDArray

from fiplib.kernels.compiling import compiled
from fiplib.kernels.model import (
    AXIS_INPUTS,
    AXIS_SIGNS,
    AXIS_STATES,
    backward,
    discretise,
    dot,
    of_axis,
    onward,
    plus,
    product,
    row_of,
)

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


@compiled("void(f8, f8, f8[:,:,::1], f8[::1], f8[:,:,::1], f8[:,::1], f8[:,:,::1])")
def riccati(length: float, step: float, q: NDArray, r: NDArray, p: NDArray, model: NDArray, feedback: NDArray) -> None:
    """Write the model (6, 5) of an axis, rows A and B', and the feedback (2, N, 6) of both axes, (K_k, sqrt H_k).

    Backwards from the terminal weights p (2, 5, 5) with q (2, 5, 5) and r (2,):
    H = R + B'PB, K = B'PA / H, P <- Q + A'PA - K'HK.
    """
    discretise(length, step, 4, model[:5], model[5])
    cost, half, b = np.empty((5, 5)), np.empty((5, 5)), row_of(model, 5)
    for axis in range(2):
        cost[:] = p[axis]
        for k in range(feedback.shape[1] - 1, -1, -1):
            pb = product(cost, b)
            h = r[axis] + dot(model, 5, pb)
            gain = backward(model, pb)  # (B'PA)', as P is symmetric
            for i in range(5):
                feedback[axis, k, i] = gain[i] / h
                half[0, i], half[1, i], half[2, i], half[3, i], half[4, i] = backward(model, row_of(cost, i))  # A'P
            feedback[axis, k, 5] = math.sqrt(h)
            for i in range(5):
                square = backward(model, row_of(half, i))  # row i of A'PA
                for j in range(i + 1):  # the lower half: a skew part, born of rounding, would grow like the fall
                    cost[i, j] = cost[j, i] = q[axis, i, j] + square[j] - feedback[axis, k, i] * gain[j]


@compiled()
def _forward(model: NDArray, feedback: NDArray, z0: tuple, w: NDArray, plan: NDArray) -> None:
    """Write the plan (N, 6), rows (u_k, z_{k+1}): u_k = -K_k z_k + w_k / sqrt H_k, z_{k+1} = A z_k + B u_k."""
    z = z0
    for k in range(len(plan)):
        u = w[k] / feedback[k, 5] - dot(feedback, k, z)
        z = plus(onward(model, z), model, 5, u)
        plan[k, 0], plan[k, 1], plan[k, 2], plan[k, 3], plan[k, 4], plan[k, 5] = u, z[0], z[1], z[2], z[3], z[4]


@compiled()
def _back(model: NDArray, feedback: NDArray, k: int, adjoint: tuple) -> tuple[float, tuple]:
    """Step k of the adjoint of ``_forward``: B'p / sqrt H and (A - BK)'p."""
    bp = dot(model, 5, adjoint)
    return bp / feedback[k, 5], plus(backward(model, adjoint), feedback, k, -bp)


@compiled()
def _target(
    axis: int, model: NDArray, feedback: NDArray, q: NDArray, p: NDArray, reference: NDArray, w: NDArray
) -> None:
    """Write w* (N,), which leads along the reference (N + 1, 10) where no bound is active."""
    adjoint = product(p, of_axis(axis, reference, len(w)))
    for k in range(len(w) - 1, -1, -1):
        w[k], (a0, a1, a2, a3, a4) = _back(model, feedback, k, adjoint)
        r0, r1, r2, r3, r4 = product(q, of_axis(axis, reference, k))
        adjoint = (a0 + r0, a1 + r1, a2 + r2, a3 + r3, a4 + r4)


@compiled()
def _sensitivity(model: NDArray, feedback: NDArray, k: int, i: int, sign: float, row: NDArray) -> None:
    """Write sign * d plan[k, i] / d w, (N,): a row of M."""
    row[:] = 0.0
    adjoint = (sign * (i == 1), sign * (i == 2), sign * (i == 3), sign * (i == 4), sign * (i == 5))
    if i == 0:
        row[k] = sign / feedback[k, 5]
        adjoint = plus(adjoint, feedback, k, -sign)
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
        z = plus(onward(model, z), model, 5, u)
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
        z0 = of_axis(axis, states, 0)
        _target(axis, model, feedback[axis], q[axis], p[axis], reference, target)
        status, some = _least_distance(model, feedback[axis], z0, bounds[axis], soft, tolerance, target, work, plan)
        if status == FAILED:
            _forward(model, feedback[axis], z0, target, plan)
            _saturated(model, z0, bounds[axis, 0], plan)
        worst, bounded = max(worst, status), bounded or some
        sign = AXIS_SIGNS[axis]
        for k in range(nodes):
            inputs[k, AXIS_INPUTS[axis]] = sign * plan[k, 0]
            for i in range(5):
                states[k + 1, AXIS_STATES[axis, i]] = (sign if i == 4 else 1.0) * plan[k, i + 1]
    return worst + 4 * bounded
