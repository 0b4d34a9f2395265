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

from fiplib.estimators.poses.lanes import WIDTH, fma, load, room, store
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

_NODES = np.array([0.5 - math.sqrt(0.15), 0.5, 0.5 + math.sqrt(0.15)])
_WEIGHTS = np.array([5.0, 8.0, 5.0]) / 18.0
# the states that each kind of row measures, the first with coefficient one
_FIRST, _SECOND, _THIRD = np.array([0, 2, 0, 5]), np.array([2, 8, 5, 9]), np.array([8, 8, 7, 9])
# rows of one stamp that change the covariance at once; integrals of w kept of a step
_TOGETHER, _INTEGRALS = 4, 12
# what follows from the parameters, by row of an array (17, WIDTH); the last is the first of four noises
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
        """Return whether there are rows of this kind."""
        return bool(np.any(self.kind == kind))

    def part(self, keep: slice | NDArray) -> "Rows":
        """Return some of the rows."""
        return Rows(*(column[keep] for column in self))

    def sparse(self, rate: float) -> "Rows":
        """Return every so many rows of each kind that about ``rate`` of them a second are left."""
        kept = np.zeros(len(self.time), dtype=bool)
        for kind in range(len(KINDS)):
            found = np.flatnonzero(self.kind == kind)
            seconds = max(self.time[-1] - self.time[0], 1e-9)
            kept[found[:: max(1, round(len(found) / seconds / rate))]] = True
        return self.part(kept)


@dataclass
class State:
    """Means (10 axes, WIDTH) and covariances (100, WIDTH), lower half, of all lanes, and the time they belong to."""

    clock: NDArray
    x: NDArray
    p: NDArray

    @classmethod
    def at(cls, time: float, axes: int) -> "State":
        """Return the state before any row."""
        # wide for any flight, in m, s and rad
        deviations = np.array([1.0, 3.0, 3.0, 10.0, 1000.0, 0.3, 2.0, 0.02, 1.0, 0.1])
        p = room(STATES * STATES)
        p[:: STATES + 1] = (deviations**2)[:, None]
        return cls(np.array([time]), room(axes * STATES), p)


class Pass(NamedTuple):
    """The result of one pass over rows: see ``run``."""

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
        theta: parameters (lanes, 16), from ``LE`` to ``LEVER``, of at most ``WIDTH`` lanes.
        steps: (k,) if lane j + 1 differs from lane 0 in one parameter by ``steps[j]``.
        innovations: whether those of lane 0 are wanted.
        state: where to begin; it is moved on to the last row.

    Returns:
        Log likelihoods (lanes,); score (k,) and Fisher information (k, k) of lane 0, if there are steps; lane 0's
        standardised innovations (n, axes) and their deviations (n,), if wanted.
    """
    wanted, axes, n = len(theta), rows.value.shape[1], len(rows.time)
    theta = np.concatenate([theta, np.repeat(theta[-1:], WIDTH - wanted, axis=0)])
    k, kept = 0 if steps is None else len(steps), n if innovations else 0
    rates = room(1)
    if k:
        rates[0, 1 : k + 1] = 1.0 / steps
    state = state or State.at(rows.time[0], axes)
    total, score, fisher = np.zeros(WIDTH), room(1), room(WIDTH)
    innovation, deviation = np.zeros((kept, axes)), np.zeros(kept)
    moved = state.clock, state.x, state.p
    _recursion(*rows, theta, rates, k > 0, *moved, total, score, fisher, innovation, deviation)
    inner = slice(1, k + 1)
    return Pass(total[:wanted], score[0, inner], fisher[inner, inner], innovation, deviation)


@numba.njit(cache=True, error_model="numpy")
def _recursion(
    time, kind, value, scale, lift, spin, pull, turn, tilt, theta, rates, differentiate, clock, x, p, total, score,
    fisher, innovation, deviation,
):  # fmt: skip # pragma: no cover - compiled
    """Move ``clock`` (1,), ``x`` (10 axes, WIDTH) and ``p`` (100, WIDTH), lower half, over all rows.

    The inverse steps are ``rates`` (1, WIDTH).
    """
    rows, axes = value.shape
    c, fastest = _unpacked(theta)
    # steps of four lengths are kept: two bodies, each stamped on its own, take turns
    ages, slot, oldest = np.full(4, -1.0), 0, 0
    integrals, noise = room(4 * _INTEGRALS), room(4 * STATES * STATES)
    f, fp, ph, gain = room(23), room(STATES * STATES), room(_TOGETHER * STATES), room(_TOGETHER * STATES)
    nu, slopes, variances, products, chis = room(axes), room(axes + 1), room(1), room(1), room(1)
    products[:] = 1.0
    row = factors = 0
    while row < rows:
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
                _prepare(t, c, fastest, integrals, slot * _INTEGRALS, noise, slot * STATES * STATES, fp)
            _transition(t, lift[row], spin[row], turn[row], c, integrals, slot * _INTEGRALS, f)
            for _ in range(pieces):
                _predict(f, x, p, noise, slot * STATES * STATES, fp)
            clock[0] = time[row]
        # rows of the same stamp one by one; the covariance is changed once, for all of them
        count = 0
        while row < rows and count < _TOGETHER and time[row] <= clock[0]:
            which = kind[row]
            i1, i2, i3 = _FIRST[which], _SECOND[which], _THIRD[which]
            bias = load(c, _BIAS) / pull[row]
            if which == VEHICLE:
                second, third = bias - load(c, _HEIGHT) / pull[row], bias
            elif which == ROD:
                second, third = load(c, _RHO), bias * 0.0 + 1.0
            else:
                second, third = bias * 0.0 + 1.0, bias * 0.0
            for axis in range(axes):
                first = axis * STATES
                expected = fma(third, load(x, first + i3), fma(second, load(x, first + i2), load(x, first + i1)))
                store(nu, axis, fma(bias, tilt[row, axis], value[row, axis] - expected))
            now = count * STATES
            for i in range(STATES):
                found = fma(second, load(p, _at(i, i2)), load(p, _at(i, i1)))
                store(ph, now + i, fma(third, load(p, _at(i, i3)), found))
            for before in range(0, now, STATES):
                along = fma(second, load(ph, before + i2), load(ph, before + i1))
                along = fma(third, load(ph, before + i3), along)
                for i in range(STATES):
                    store(ph, now + i, load(ph, now + i) - load(gain, before + i) * along)
            variance = fma(second, load(ph, now + i2), load(ph, now + i1))
            variance = fma(third, load(ph, now + i3), variance)
            variance = fma(load(c, _NOISE + which), scale[row] * scale[row], variance)
            inverse = 1.0 / variance
            store(variances, 0, variance)
            store(products, 0, load(products, 0) * variance)
            for i in range(STATES):
                store(gain, now + i, load(ph, now + i) * inverse)
            for axis in range(axes):
                surprise, first = load(nu, axis), axis * STATES
                store(chis, 0, fma(surprise * inverse, surprise, load(chis, 0)))
                for i in range(STATES):
                    store(x, first + i, fma(load(gain, now + i), surprise, load(x, first + i)))
            if innovation.shape[0]:
                deviation[row] = math.sqrt(variances[0, 0])
                for axis in range(axes):
                    innovation[row, axis] = nu[axis, 0] / deviation[row]
            if differentiate:
                _differentiate(nu, variances, rates, slopes, score, fisher)
            row += 1
            count += 1
        for step in range(0, count * STATES, STATES):
            for i in range(STATES):
                factor = load(gain, step + i)
                for j in range(i + 1):
                    at = i * STATES + j
                    store(p, at, load(p, at) - factor * load(ph, step + j))
        factors += count
        if factors > 12 or row == rows:
            # variances above 1e-15, 16 of them, are far from the smallest double
            for lane in range(WIDTH):
                total[lane] -= 0.5 * axes * math.log(products[0, lane])
            store(products, 0, 1.0)
            factors = 0
    for lane in range(WIDTH):
        total[lane] -= 0.5 * (axes * rows * math.log(2.0 * math.pi) + chis[0, lane])


@numba.njit(cache=True, error_model="numpy", inline="always")
def _at(i, j):  # pragma: no cover - compiled
    """Return where an element of a symmetric matrix lies in its lower half."""
    return max(i, j) * STATES + min(i, j)


@numba.njit(cache=True, error_model="numpy")
def _unpacked(theta):  # pragma: no cover - compiled
    """Return what follows from the parameters; and rate and square of rate that bound those of w in all lanes."""
    c, fastest = room(17), np.zeros(2)
    for lane in range(WIDTH):
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
        fastest[0] = max(fastest[0], c[_A1, lane])
        fastest[1] = max(fastest[1], c[_A0, lane])
    return c, fastest


@numba.njit(cache=True, error_model="numpy")
def _integrals(t, c, fastest, w, v, out, first):  # pragma: no cover - compiled
    """Write w(t), w'(t) and the one- to fourfold integrals of w'' = -a1 w' - a0 w from (w, v) into rows of ``out``.

    By its power series: exact formulas lose all digits in steps of microseconds.
    """
    a0, a1 = load(c, _A0), load(c, _A1)
    zero = a0 * 0.0
    s0, s1, s2, s3, s4, s5 = zero, zero, zero, zero, zero, zero
    power = 1.0  # t^j / j!
    size, after = 1.0, 1.0 + fastest[0] * t  # bounds of the next terms of w and of w' t
    for j in range(40):
        p1 = power * t / (j + 1)
        p2 = p1 * t / (j + 2)
        p3 = p2 * t / (j + 3)
        s0, s1, s2 = fma(w, power, s0), fma(v, power, s1), fma(w, p1, s2)
        s3, s4, s5 = fma(w, p2, s3), fma(w, p3, s4), fma(w, p3 * t / (j + 4), s5)
        w, v = v, zero - fma(a1, v, a0 * w)
        power = p1
        size, after = after / (j + 1), (fastest[0] * t * after + fastest[1] * t * t * size) / (j + 1)
        if size + after < 1e-13:
            break
    store(out, first, s0)
    store(out, first + 1, s1)
    store(out, first + 2, s2)
    store(out, first + 3, s3)
    store(out, first + 4, s4)
    store(out, first + 5, s5)


@numba.njit(cache=True, error_model="numpy")
def _prepare(t, c, fastest, kept, first, noise, where, work):  # pragma: no cover - compiled
    """Write integrals of w (12, WIDTH), from (1, 0) and from (0, 1), and the process noise of a step of t s.

    They go into ``kept`` from row ``first`` on, and into ``noise`` from row ``where`` on;
    ``work`` (27, WIDTH) is room to work in.
    """
    spread = 3 * DYNAMIC
    per, arm, h = load(c, _PER), load(c, _ARM), load(c, _SEAT) / GRAVITY
    hq, w2, kick = h * per, GRAVITY * per, h * load(c, _KICK)
    zero = per * 0.0
    one = zero + 1.0
    _integrals(t, c, fastest, one, zero, kept, first)
    _integrals(t, c, fastest, zero, one, kept, first + 6)
    for node in range(3):
        first = node * DYNAMIC
        root = math.sqrt(t * _WEIGHTS[node]) * load(c, _ROOT)
        _integrals(t * _NODES[node], c, fastest, load(c, _INTO_W), load(c, _INTO_V), work, spread)
        k1, k2, k3, k4 = load(work, spread + 2), load(work, spread + 3), load(work, spread + 4), load(work, spread + 5)
        store(work, first, root * (k3 + kick * k1 + arm * (per + hq * w2) * k3))
        store(work, first + 1, root * k2)
        store(work, first + 2, root * k1)
        store(work, first + 3, root * load(work, spread))
        store(work, first + 4, root * load(work, spread + 1))
        store(work, first + 5, zero - root * (hq * (k1 + w2 * k3) + k3 * per))
        store(work, first + 6, zero - root * ((k2 + w2 * k4) * per + hq * w2 * k2))
    for i in range(DYNAMIC):
        for j in range(i + 1):
            total = load(work, i) * load(work, j)
            for node in range(DYNAMIC, 3 * DYNAMIC, DYNAMIC):
                total = fma(load(work, node + i), load(work, node + j), total)
            store(noise, where + i * STATES + j, total)
    force, lean, rate = load(c, _FORCE), where + 5 * STATES + 5, where + 6 * STATES + 5
    store(noise, lean, fma(force, t * t * t / 3.0, load(noise, lean)))
    store(noise, rate, fma(force, t * t / 2.0, load(noise, rate)))
    store(noise, rate + 1, fma(force, t, load(noise, rate + 1)))


@numba.njit(cache=True, error_model="numpy")
def _transition(t, lift, spin, turn, c, kept, where, f):  # pragma: no cover - compiled
    """Write the coefficients (23, WIDTH) of ``_move`` for a step of t s, from ``_prepare``'s integrals."""
    per, arm, h = load(c, _PER), load(c, _ARM), load(c, _SEAT) * turn
    hs, hq = h * load(c, _KICK), h * per
    w2 = lift * per - spin
    z = w2 * (t * t)
    one = z / 2.0 + z * z / 24.0
    qb = t * (1.0 + z / 6.0 + z * z / 120.0)
    qu = (-t * t / 2.0) * (1.0 + z / 12.0 + z * z / 360.0) * per
    zero = z * 0.0
    store(f, 0, t)
    store(f, 1, t * t / 2.0 - arm * qu)
    store(f, 4, zero - arm * one)
    store(f, 5, zero - arm * qb)
    store(f, 14, 1.0 + one)
    store(f, 15, qb)
    store(f, 16, qu)
    store(f, 19, w2 * qb)
    store(f, 20, zero - qb * per)
    for start in range(2):
        first = where + 6 * start
        k1, k2, k3, k4 = load(kept, first + 2), load(kept, first + 3), load(kept, first + 4), load(kept, first + 5)
        store(f, 2 + start, k3 + hs * k1 + arm * (per + hq * w2) * k3)
        store(f, 6 + start, k2)
        store(f, 8 + start, k1)
        store(f, 10 + start, load(kept, first))
        store(f, 12 + start, load(kept, first + 1))
        store(f, 17 + start, zero - hq * (k1 + w2 * k3) - k3 * per)
        store(f, 21 + start, zero - (k2 + w2 * k4) * per - hq * w2 * k2)


@numba.njit(cache=True, error_model="numpy")
def _move(f, before, first, stride, after, to):  # pragma: no cover - compiled
    """Move the dynamic states in rows first, first + stride ... of ``before`` on, into rows to, to + 1 ... ."""
    n, u, w = load(before, first + stride), load(before, first + 2 * stride), load(before, first + 3 * stride)
    v, q, b = load(before, first + 4 * stride), load(before, first + 5 * stride), load(before, first + 6 * stride)
    s = fma(load(f, 0), n, load(before, first))
    s = fma(load(f, 3), v, fma(load(f, 2), w, fma(load(f, 1), u, s)))
    store(after, to, fma(load(f, 5), b, fma(load(f, 4), q, s)))
    store(after, to + 1, fma(load(f, 7), v, fma(load(f, 6), w, fma(load(f, 0), u, n))))
    store(after, to + 2, fma(load(f, 9), v, fma(load(f, 8), w, u)))
    store(after, to + 3, fma(load(f, 11), v, load(f, 10) * w))
    store(after, to + 4, fma(load(f, 13), v, load(f, 12) * w))
    lean = fma(load(f, 16), u, fma(load(f, 15), b, load(f, 14) * q))
    store(after, to + 5, fma(load(f, 18), v, fma(load(f, 17), w, lean)))
    rate = fma(load(f, 20), u, fma(load(f, 14), b, load(f, 19) * q))
    store(after, to + 6, fma(load(f, 22), v, fma(load(f, 21), w, rate)))


@numba.njit(cache=True, error_model="numpy")
def _predict(f, x, p, noise, where, fp):  # pragma: no cover - compiled
    """Move means and the lower half of the covariances, F P F' + Q, with Q from row ``where`` of ``noise`` on.

    ``fp`` (100, WIDTH) is room to work in.
    """
    for first in range(0, len(x), STATES):
        _move(f, x, first, 1, fp, 0)
        for i in range(DYNAMIC):
            store(x, first + i, load(fp, i))
    for i in range(DYNAMIC):  # the upper half of what moves, too
        for j in range(i):
            store(p, j * STATES + i, load(p, i * STATES + j))
    for j in range(STATES):
        _move(f, p, j * STATES, 1, fp, j * STATES)
    for j in range(DYNAMIC, STATES):
        for i in range(DYNAMIC):
            store(p, j * STATES + i, load(fp, j * STATES + i))
    for i in range(DYNAMIC):
        _move(f, fp, i, STATES, p, i * STATES)
        for j in range(i + 1):
            at = i * STATES + j
            store(p, at, load(p, at) + load(noise, where + at))


@numba.njit(cache=True, error_model="numpy")
def _differentiate(nu, variances, rates, slopes, score, fisher):  # pragma: no cover - compiled
    """Add a row's share to the score (1, WIDTH) and to the Fisher information (WIDTH, WIDTH) of lane 0."""
    axes, rate = len(nu), load(rates, 0)
    inverse = 1.0 / variances[0, 0]
    root, chi = math.sqrt(inverse), 0.0
    gradient = load(score, 0)
    for axis in range(axes):
        chi += nu[axis, 0] * nu[axis, 0]
        slope = (load(nu, axis) - nu[axis, 0]) * rate * root
        gradient = gradient - slope * (nu[axis, 0] * root)
        store(slopes, axis, slope)
    slope = (load(variances, 0) - variances[0, 0]) * rate * inverse
    store(score, 0, fma(slope, 0.5 * (chi * inverse - axes), gradient))
    store(slopes, axes, slope * math.sqrt(0.5 * axes))
    for i in range(WIDTH):
        information = load(fisher, i)
        for k in range(axes + 1):
            information = fma(load(slopes, k), slopes[k, i], information)
        store(fisher, i, information)
