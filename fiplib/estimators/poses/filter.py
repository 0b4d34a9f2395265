"""The model of vehicle and rod as poses show it, and the compiled recursion of its Kalman filter.

With s the seat, q the rod's direction, e the thrust's direction, r the distance from the seat to the rod's centre of
mass, M = m + m_p, mu = m_p / M, U = (F / M) e + (1 - mu) h_c e'' and h_c the height of the seat above the vehicle's
centre of mass, the coupled plant (``dynamics.coupled_plant``, with the seat's term m h_c e'') is rearranged exactly:

    s'' + g e3 = U - mu r q'',        q'' = -|q'|^2 q - (1 / L_e) (U - q (q . U)),        L_e = r / (lambda kappa)

with kappa = 1 / (1 - mu lambda), so that lambda = r / (L_e + mu r). Per horizontal axis, with u = (F / M) e_x the
specific thrust, w = u' its rate and e_x = u / g, the derivatives of u are integrated out, so that none is needed:

    s' = nu - mu r beta + H (1 + mu r / L_e) w        q'    = beta - (H / L_e) w            H = (1 - mu) h_c / g
    nu' = u,   u' = w                                beta' = ((q . U) / L_e - |q'|^2) q - u / L_e

The specific thrust u is close to a random walk. Not quite: controller and rate loop colour its rate, w'' + 2 zeta
omega w' + omega^2 w = omega^2 (n + T n'), n white noise of density q_n, and all four of these numbers are estimated.

What is of second order comes from smoothed poses: q . U, |q'|^2, and what g stands for in e = u / g: F / M, and for
changes of e, (F / M) / (1 - |e_xy|^2): a large tilt is an oscillation and changes mostly along itself. The
measured rows, each at its own stamp, are

    vehicle  s - (h / g) u                  tilt       (g + z'') e_x / e_z = u + c_tilt
    rod      s + rho q + c_rod              direction  q + c_direction

The vehicle's position is of a point b below the middle of its markers, so it holds -b times the error of the tilt;
the row that is used is the one without it, vehicle + (b / g) tilt. h is the height of the seat above the tracked
point of the vehicle, rho the distance from the seat to the tracked point of the rod; both, and h_c and r, are kept
apart. The constants c are states. Nothing pairs the rows: order of arrival, unequal rates, jitter and losses need no
treatment of their own. A cart, an arm or any prescribed base is the same system with mu = h = h_c = 0 and without the
row of the tilt.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from fiplib.params import GRAVITY

KINDS = ("vehicle", "tilt", "rod", "direction")
"""Kinds of measured rows."""

VEHICLE, TILT, ROD, DIRECTION = range(4)

LE, R, OFFSET, H, HC, MU, Q, OMEGA, ZETA, ZERO, NV, NT, NR, ND, NF, LEVER = range(16)
"""Order of the parameters: log L_e, r, rho - r, h, h_c, mu; logarithms of q_n (m^2/s^5), omega (rad/s), zeta, omega T,
noises (m, rad), and of the density of a white force on the rod (rad^2/s^3 of its angular acceleration); and b."""

DYNAMIC, STATES = 7, 10
"""How many states move (s, nu, u, w, w', q, beta), and how many there are with c_rod, c_tilt, c_direction."""

LONGEST_STEP = 1e-2
"""Longest step of the prediction, s: its series are right to 1e-7 up to rods of 2 cm."""

LANES = 16
"""The number of points that are filtered side by side is one or a multiple of this: a whole number of vectors, without
a remainder, keeps the compiled code twice as fast."""

_NODES = np.array([0.5 - math.sqrt(0.15), 0.5, 0.5 + math.sqrt(0.15)])
_WEIGHTS = np.array([5.0, 8.0, 5.0]) / 18.0
# the states that each kind of row measures, the first with coefficient one
_FIRST, _SECOND, _THIRD = np.array([0, 2, 0, 5]), np.array([2, 8, 5, 9]), np.array([8, 8, 7, 9])
# what follows from the parameters, by row of an array (17, lanes); the last is the first of four noises
_PER, _ARM, _SEAT, _KICK, _RHO, _HEIGHT, _BIAS, _A0, _A1, _INTO_W, _INTO_V, _ROOT, _FORCE, _NOISE = range(14)


class Rows(NamedTuple):
    """Measured rows sorted by time.

    ``time`` (n,) s; ``kind`` (n,); ``value`` (n, axes) m, m/s^2 or 1; ``scale`` (n,) the factor on the kind's noise;
    ``lift`` (n,) q . U in m/s^2, ``spin`` (n,) |q'|^2 in 1/s^2, ``pull`` (n,) F / M in m/s^2 and ``turn`` (n,) de/du in
    s^2/m, all smoothed; ``tilt`` (n, axes) the value of the tilt's row of the same pose, m/s^2, or 0.
    """

    time: NDArray
    kind: NDArray
    value: NDArray
    scale: NDArray
    lift: NDArray
    spin: NDArray
    pull: NDArray
    turn: NDArray
    tilt: NDArray

    def has(self, kind: int) -> bool:
        """Whether there are rows of this kind."""
        return bool(np.any(self.kind == kind))

    def part(self, keep: slice | NDArray) -> "Rows":
        """Return some of the rows."""
        return Rows(*(column[keep] for column in self))


@dataclass
class State:
    """Means and covariances of all lanes, and the time they belong to."""

    clock: NDArray
    x: NDArray
    p: NDArray

    @classmethod
    def at(cls, time: float, lanes: int, axes: int) -> "State":
        """Return the state before any row."""
        # wide for any flight, in m, s and rad
        deviations = np.array([1.0, 3.0, 3.0, 10.0, 1000.0, 0.3, 2.0, 0.02, 1.0, 0.1])
        p = np.zeros((STATES, STATES, lanes))
        p[np.arange(STATES), np.arange(STATES)] = (deviations**2)[:, None]
        return cls(np.array([time]), np.zeros((axes, STATES, lanes)), p)


class Pass(NamedTuple):
    """What one pass over rows gives: see ``run``."""

    total: NDArray
    score: NDArray
    fisher: NDArray
    innovation: NDArray
    deviation: NDArray


def run(
    rows: Rows, theta: NDArray, steps: NDArray | None = None, innovations: bool = False, state: State | None = None
) -> Pass:
    """Filter all rows for every row of parameters.

    Args:
        rows: the measured rows.
        theta: parameters (lanes, 16), from ``LE`` to ``LEVER``.
        steps: (k,) if lane j + 1 differs from lane 0 in one parameter by ``steps[j]``.
        innovations: whether those of lane 0 are wanted.
        state: where to begin; it is moved on to the last row. It has a multiple of ``LANES`` lanes, or one.

    Returns:
        Log likelihoods (lanes,); score (k,) and Fisher information (k, k) of lane 0, if there are steps; lane 0's
        standardised innovations (n, axes) and their deviations (n,), if wanted.
    """
    wanted, axes, n = len(theta), rows.value.shape[1], len(rows.time)
    lanes = 1 if wanted == 1 else -(-wanted // LANES) * LANES
    theta = np.concatenate([theta, np.repeat(theta[-1:], lanes - wanted, axis=0)])
    steps = np.zeros(0) if steps is None else steps
    state = state or State.at(rows.time[0], lanes, axes)
    k, kept = len(steps), n if innovations else 0
    out = Pass(np.zeros(lanes), np.zeros(k), np.zeros((k, k)), np.zeros((kept, axes)), np.zeros(kept))
    _recursion(*rows, theta, steps, state.clock, state.x, state.p, *out, (0,) * lanes)
    return out._replace(total=out.total[:wanted], fisher=np.tril(out.fisher) + np.tril(out.fisher, -1).T)


@numba.njit(cache=True, error_model="numpy")
def _recursion(
    time, kind, value, scale, lift, spin, pull, turn, tilt, theta, steps, clock, x, p, total, score, fisher, innovation,
    deviation, sized,
):  # fmt: skip # pragma: no cover - compiled
    """Move ``clock`` (1,), ``x`` (axes, 10, lanes) and ``p`` (10, 10, lanes), lower half, over all rows.

    ``sized`` is any tuple of as many items as there are lanes: the compiler then knows their number.
    """
    rows, axes, lanes = value.shape[0], value.shape[1], len(sized)
    c, same = _unpacked(theta, sized)
    # steps of four lengths are kept: two bodies, each stamped on its own, take turns
    ages, slot, oldest = np.full(4, -1.0), 0, 0
    integrals, noise = np.empty((4, 2, 6, lanes)), np.zeros((4, DYNAMIC, DYNAMIC, lanes))
    f, fp = np.empty((23, lanes)), np.empty((STATES, DYNAMIC, lanes))
    old, new = np.empty((DYNAMIC, lanes)), np.empty((DYNAMIC, lanes))
    ph, gain, nu = np.empty((STATES, lanes)), np.empty((STATES, lanes)), np.empty((axes, lanes))
    second, third, variance, inverse = np.empty(lanes), np.empty(lanes), np.empty(lanes), np.empty(lanes)
    for row in range(rows):
        gap = time[row] - clock[0]
        if gap > 0.0:
            pieces = math.ceil(gap / LONGEST_STEP - 1e-9)
            t = gap / pieces
            slot = -1
            for i in range(4):
                if abs(t - ages[i]) < 1e-8:
                    slot = i
            if slot < 0:
                slot, oldest = oldest, (oldest + 1) % 4
                ages[slot] = t
                _prepare(t, c, same, integrals[slot], noise[slot], sized)
            _transition(t, lift[row], spin[row], turn[row], c, integrals[slot], f, sized)
            for _ in range(pieces):
                _predict(f, x, p, noise[slot], old, new, fp, sized)
            clock[0] = time[row]

        which = kind[row]
        i1, i2, i3 = _FIRST[which], _SECOND[which], _THIRD[which]
        for lane in range(lanes):
            bias = c[_BIAS, lane] / pull[row]
            if which == VEHICLE:
                second[lane], third[lane] = bias - c[_HEIGHT, lane] / pull[row], bias
            elif which == ROD:
                second[lane], third[lane] = c[_RHO, lane], 1.0
            else:
                second[lane], third[lane] = 1.0, 0.0
            for axis in range(axes):
                expected = x[axis, i1, lane] + second[lane] * x[axis, i2, lane] + third[lane] * x[axis, i3, lane]
                nu[axis, lane] = value[row, axis] + bias * tilt[row, axis] - expected
        for i in range(STATES):
            a1, b1, a2, b2, a3, b3 = max(i, i1), min(i, i1), max(i, i2), min(i, i2), max(i, i3), min(i, i3)
            for lane in range(lanes):
                ph[i, lane] = p[a1, b1, lane] + second[lane] * p[a2, b2, lane] + third[lane] * p[a3, b3, lane]
        factor = scale[row] * scale[row]
        for lane in range(lanes):
            variance[lane] = ph[i1, lane] + second[lane] * ph[i2, lane] + third[lane] * ph[i3, lane]
            variance[lane] += factor * c[_NOISE + which, lane]
            inverse[lane] = 1.0 / variance[lane]
        for i in range(STATES):
            for lane in range(lanes):
                gain[i, lane] = ph[i, lane] * inverse[lane]
            for axis in range(axes):
                for lane in range(lanes):
                    x[axis, i, lane] += gain[i, lane] * nu[axis, lane]
            for j in range(i + 1):
                for lane in range(lanes):
                    p[i, j, lane] -= gain[i, lane] * ph[j, lane]
        for lane in range(lanes):
            chi = 0.0
            for axis in range(axes):
                chi += nu[axis, lane] * nu[axis, lane]
            total[lane] -= 0.5 * (axes * math.log(6.283185307179586 * variance[lane]) + chi * inverse[lane])
        if innovation.shape[0]:
            deviation[row] = math.sqrt(variance[0])
            for axis in range(axes):
                innovation[row, axis] = nu[axis, 0] * math.sqrt(inverse[0])
        if steps.shape[0]:
            _differentiate(nu, variance, inverse[0], steps, score, fisher)


@numba.njit(cache=True, error_model="numpy")
def _unpacked(theta, sized):  # pragma: no cover - compiled
    """What follows from the parameters; and the lane whose integrals of w a lane shares, often its own."""
    lanes = len(sized)
    c, same = np.empty((17, lanes)), np.empty(lanes, np.int64)
    for lane in range(lanes):
        r, mu, omega = theta[lane, R], theta[lane, MU], math.exp(theta[lane, OMEGA])
        c[_PER, lane] = math.exp(-theta[lane, LE])
        c[_ARM, lane] = mu * r
        c[_SEAT, lane] = (1.0 - mu) * theta[lane, HC]
        c[_KICK, lane] = 1.0 + mu * r * c[_PER, lane]
        c[_RHO, lane] = r + theta[lane, OFFSET]
        c[_HEIGHT, lane], c[_BIAS, lane] = theta[lane, H], theta[lane, LEVER]
        c[_A0, lane] = omega * omega
        c[_A1, lane] = 2.0 * math.exp(theta[lane, ZETA]) * omega
        c[_INTO_W, lane] = omega * math.exp(theta[lane, ZERO])
        c[_INTO_V, lane] = c[_A0, lane] - c[_A1, lane] * c[_INTO_W, lane]
        c[_ROOT, lane] = math.exp(0.5 * theta[lane, Q])
        c[_FORCE, lane] = math.exp(theta[lane, NF])
        for which in range(4):
            c[_NOISE + which, lane] = math.exp(2.0 * theta[lane, NV + which])
        same[lane] = lane
        for other in range(lane - 1, -1, -1):
            shared = True
            for i in range(OMEGA, ZERO + 1):
                shared &= theta[other, i] == theta[lane, i]
            if shared:
                same[lane] = other
    return c, same


@numba.njit(cache=True, error_model="numpy")
def _integrals(t, a0, a1, w, v, out):  # pragma: no cover - compiled
    """w(t), w'(t) and the one- to fourfold integrals of w'' = -a1 w' - a0 w from (w, v), into out (6,).

    By its power series: exact formulas lose all digits in steps of microseconds.
    """
    for i in range(6):
        out[i] = 0.0
    now, after = w, v
    power = 1.0  # t^j / j!
    for j in range(24):
        out[0] += now * power
        out[1] += after * power
        p1 = power * t / (j + 1)
        p2 = p1 * t / (j + 2)
        p3 = p2 * t / (j + 3)
        out[2] += now * p1
        out[3] += now * p2
        out[4] += now * p3
        out[5] += now * p3 * t / (j + 4)
        now, after = after, -a1 * after - a0 * now
        power = p1
        if abs(now * p1) + abs(after * p1) < 1e-15 * (abs(out[0]) + abs(out[1])):
            break


@numba.njit(cache=True, error_model="numpy")
def _prepare(t, c, same, kept, noise, sized):  # pragma: no cover - compiled
    """Write integrals of w (2, 6, lanes), from (1, 0) and from (0, 1), and the process noise of a step of t s."""
    lanes = len(sized)
    one, spread, impulse = np.empty(6), np.empty((6, lanes)), np.empty((DYNAMIC, lanes))
    for start in range(2):
        for lane in range(lanes):
            if same[lane] == lane:
                _integrals(t, c[_A0, lane], c[_A1, lane], 1.0 - start, 1.0 * start, one)
            for i in range(6):
                kept[start, i, lane] = one[i] if same[lane] == lane else kept[start, i, same[lane]]
    noise[:] = 0.0
    for node in range(3):
        weight = math.sqrt(t * _WEIGHTS[node])
        for lane in range(lanes):
            if same[lane] == lane:
                _integrals(t * _NODES[node], c[_A0, lane], c[_A1, lane], c[_INTO_W, lane], c[_INTO_V, lane], one)
            for i in range(6):
                spread[i, lane] = one[i] if same[lane] == lane else spread[i, same[lane]]
        for lane in range(lanes):
            root, per, h = weight * c[_ROOT, lane], c[_PER, lane], c[_SEAT, lane] / GRAVITY
            hq, w2 = h * per, GRAVITY * per
            k1, k2, k3, k4 = spread[2, lane], spread[3, lane], spread[4, lane], spread[5, lane]
            impulse[0, lane] = root * (k3 + h * c[_KICK, lane] * k1 + c[_ARM, lane] * (per + hq * w2) * k3)
            impulse[1, lane] = root * k2
            impulse[2, lane] = root * k1
            impulse[3, lane] = root * spread[0, lane]
            impulse[4, lane] = root * spread[1, lane]
            impulse[5, lane] = -root * (hq * (k1 + w2 * k3) + k3 * per)
            impulse[6, lane] = -root * ((k2 + w2 * k4) * per + hq * w2 * k2)
        for i in range(DYNAMIC):
            for j in range(i + 1):
                for lane in range(lanes):
                    noise[i, j, lane] += impulse[i, lane] * impulse[j, lane]
    for lane in range(lanes):
        noise[5, 5, lane] += c[_FORCE, lane] * t * t * t / 3.0
        noise[6, 5, lane] += c[_FORCE, lane] * t * t / 2.0
        noise[6, 6, lane] += c[_FORCE, lane] * t


@numba.njit(cache=True, error_model="numpy", inline="always")
def _transition(t, lift, spin, turn, c, kept, f, sized):  # pragma: no cover - compiled
    """Write the coefficients (23, lanes) of ``_move`` for a step of t s."""
    for lane in range(len(sized)):
        per, arm, h = c[_PER, lane], c[_ARM, lane], c[_SEAT, lane] * turn
        hs, hq = h * c[_KICK, lane], h * per
        w2 = lift * per - spin
        z = w2 * t * t
        one = z / 2.0 + z * z / 24.0
        qb = t * (1.0 + z / 6.0 + z * z / 120.0)
        qu = -(t * t / 2.0) * (1.0 + z / 12.0 + z * z / 360.0) * per
        f[0, lane] = t
        f[1, lane] = t * t / 2.0 - arm * qu
        f[4, lane] = -arm * one
        f[5, lane] = -arm * qb
        f[14, lane] = 1.0 + one
        f[15, lane] = qb
        f[16, lane] = qu
        f[19, lane] = w2 * qb
        f[20, lane] = -qb * per
        for start in range(2):
            k1, k2, k3, k4 = kept[start, 2, lane], kept[start, 3, lane], kept[start, 4, lane], kept[start, 5, lane]
            f[2 + start, lane] = k3 + hs * k1 + arm * (per + hq * w2) * k3
            f[6 + start, lane] = k2
            f[8 + start, lane] = k1
            f[10 + start, lane] = kept[start, 0, lane]
            f[12 + start, lane] = kept[start, 1, lane]
            f[17 + start, lane] = -hq * (k1 + w2 * k3) - k3 * per
            f[21 + start, lane] = -(k2 + w2 * k4) * per - hq * w2 * k2


@numba.njit(cache=True, error_model="numpy", inline="always")
def _move(f, before, after, sized):  # pragma: no cover - compiled
    """Write the dynamic states (7, lanes) after a step."""
    for lane in range(len(sized)):
        t = f[0, lane]
        n, u, w, v = before[1, lane], before[2, lane], before[3, lane], before[4, lane]
        q, b = before[5, lane], before[6, lane]
        after[0, lane] = (
            before[0, lane] + t * n + f[1, lane] * u + f[2, lane] * w + f[3, lane] * v + f[4, lane] * q + f[5, lane] * b
        )
        after[1, lane] = n + t * u + f[6, lane] * w + f[7, lane] * v
        after[2, lane] = u + f[8, lane] * w + f[9, lane] * v
        after[3, lane] = f[10, lane] * w + f[11, lane] * v
        after[4, lane] = f[12, lane] * w + f[13, lane] * v
        after[5, lane] = f[14, lane] * q + f[15, lane] * b + f[16, lane] * u + f[17, lane] * w + f[18, lane] * v
        after[6, lane] = f[19, lane] * q + f[14, lane] * b + f[20, lane] * u + f[21, lane] * w + f[22, lane] * v


@numba.njit(cache=True, error_model="numpy", inline="always")
def _predict(f, x, p, noise, old, new, fp, sized):  # pragma: no cover - compiled
    """Move means and the lower half of the covariances, F P F' + Q; ``old``, ``new`` and ``fp`` are room to work in."""
    lanes = len(sized)
    for axis in range(x.shape[0]):
        _move(f, x[axis], new, sized)
        for i in range(DYNAMIC):
            for lane in range(lanes):
                x[axis, i, lane] = new[i, lane]
    for j in range(STATES):
        for i in range(DYNAMIC):
            high, low = max(i, j), min(i, j)
            for lane in range(lanes):
                old[i, lane] = p[high, low, lane]
        _move(f, old, fp[j], sized)
    for j in range(DYNAMIC, STATES):
        for i in range(DYNAMIC):
            for lane in range(lanes):
                p[j, i, lane] = fp[j, i, lane]
    for i in range(DYNAMIC):
        for j in range(DYNAMIC):
            for lane in range(lanes):
                old[j, lane] = fp[j, i, lane]
        _move(f, old, new, sized)
        for j in range(i + 1):
            for lane in range(lanes):
                p[i, j, lane] = new[j, lane] + noise[i, j, lane]


@numba.njit(cache=True, error_model="numpy", inline="always")
def _differentiate(nu, variance, inverse, steps, score, fisher):  # pragma: no cover - compiled
    """Add a row's share to the score and to the lower half of the Fisher information."""
    axes, k = nu.shape[0], steps.shape[0]
    root, chi = math.sqrt(inverse), 0.0
    dnu, ds = np.empty((axes, k)), np.empty(k)
    for axis in range(axes):
        chi += nu[axis, 0] * nu[axis, 0]
    for j in range(k):
        ds[j] = (variance[j + 1] - variance[0]) / steps[j] * inverse
        g = 0.5 * ds[j] * (chi * inverse - axes)
        for axis in range(axes):
            dnu[axis, j] = (nu[axis, j + 1] - nu[axis, 0]) / steps[j] * root
            g -= nu[axis, 0] * root * dnu[axis, j]
        score[j] += g
        for i in range(j + 1):
            information = 0.5 * axes * ds[i] * ds[j]
            for axis in range(axes):
                information += dnu[axis, i] * dnu[axis, j]
            fisher[j, i] += information
