"""The length of a rod from poses alone: an asynchronous Kalman filter whose likelihood is maximised.

With s the seat, q the rod's direction, e the thrust's direction, r the distance from the seat to the rod's centre of
mass, M = m + m_p, mu = m_p / M, U = (F / M) e + (1 - mu) h_c e'' and h_c the height of the seat above the vehicle's
centre of mass, the coupled plant (``dynamics.coupled_plant``, with the seat's term m h_c e'') is rearranged exactly:

    s'' + g e3 = U - mu r q'',        q'' = -|q'|^2 q - (1 / L_e) (U - q (q . U)),        L_e = r / (lambda kappa)

with kappa = 1 / (1 - mu lambda), so that lambda = r / (L_e + mu r). Per horizontal axis, with u = (F / M) e_x the
specific thrust, w = u' its rate and e_x = u / g, the derivatives of u are integrated out, so that none is needed:

    s' = nu - mu r beta + H (1 + mu r / L_e) w        q'    = beta - (H / L_e) w            H = (1 - mu) h_c / g
    nu' = u,   u' = w,   w' = (n - w) / tau           beta' = ((q . U) / L_e - |q'|^2) q - u / L_e

n is white noise of density q_n: for tau = 0 the thrust u is a random walk, for tau > 0 one behind a first-order lag.
What is of second order, q . U and |q'|^2, comes from smoothed poses. The measured rows, each at its own stamp, are

    vehicle  s - (h / g) u                  tilt       (g + z'') e_x / e_z = u + c_tilt
    rod      s + rho q + c_rod              direction  q + c_direction

h is the height of the seat above the tracked point of the vehicle, rho the distance from the seat to the tracked point
of the rod; both, and h_c and r, are kept apart. The constants c are states. Nothing pairs the rows: order of arrival,
unequal rates, jitter and losses need no treatment of their own. A cart, an arm or any prescribed base is the same
system with mu = h = h_c = 0 and without the row of the tilt.

All parameters are estimated together, by maximum a posteriori with Gaussian priors (``Knowledge``): the recursion runs
for one point and for its neighbours side by side, so that one pass gives the likelihood, its gradient and the Fisher
information, and Fisher scoring finds the maximum.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from fiplib.params import GRAVITY, Params

VEHICLE, TILT, ROD, DIRECTION = range(4)
"""Kinds of measured rows."""

PARAMETERS = (
    "log_effective_length",
    "com_distance",
    "marker_offset",
    "seat_height",
    "com_height",
    "mass_ratio",
    "log_thrust_density",
    "log_lag",
    "log_vehicle_noise",
    "log_rod_noise",
    "log_tilt_noise",
    "log_direction_noise",
    "log_force_density",
)
"""Order of the parameters: log L_e, r, rho - r, h, h_c, mu; logarithms of q_n (m^2/s^5), tau (s), noises (m, rad), and
of the density of a white force on the rod (rad^2/s^3 of its angular acceleration)."""

LE, R, OFFSET, H, HC, MU, Q, TAU, NV, NR, NT, ND, NF = range(len(PARAMETERS))
DYNAMIC, STATES = 6, 9
LONGEST_STEP = 1e-2
"""Longest step of the prediction, s: its series are right to 1e-7 up to rods of 2 cm."""

_NODES = np.array([0.5 - math.sqrt(0.15), 0.5, 0.5 + math.sqrt(0.15)])
_WEIGHTS = np.array([5.0, 8.0, 5.0]) / 18.0


class Rows(NamedTuple):
    """Measured rows sorted by time.

    ``time`` (n,) s; ``kind`` (n,); ``value`` (n, axes) m, m/s^2 or 1; ``scale`` (n,) the factor on the kind's noise;
    ``lift`` (n,) q . U in m/s^2 and ``spin`` (n,) |q'|^2 in 1/s^2, both smoothed.
    """

    time: NDArray
    kind: NDArray
    value: NDArray
    scale: NDArray
    lift: NDArray
    spin: NDArray


@numba.njit(cache=True)
def _response(t, tau, length, lever, hq, hs, w2, out):  # pragma: no cover - compiled
    """Response of (s, nu, u, w, q, beta) after the time t to a rate w = 1 at its beginning, into out (6,)."""
    e = math.exp(-t / tau)
    k1 = -tau * math.expm1(-t / tau)
    k2 = tau * (t - k1)
    k3 = tau * (t * t / 2.0 - k2)
    k4 = tau * (t * t * t / 6.0 - k3)
    integral = -k3 / length - hq * w2 * k3
    out[0] = k3 + hs * k1 - lever * integral
    out[1] = k2
    out[2] = k1
    out[3] = e
    out[4] = -hq * (k1 + w2 * k3) - k3 / length
    out[5] = -(k2 + w2 * k4) / length - hq * w2 * k2


@numba.njit(cache=True)
def _recursion(
    time, kind, value, scale, lift, spin, theta, steps, clock, x, p, total, score, fisher, blocks, block, innovation
):  # pragma: no cover - compiled
    """Run the filter of every row of ``theta`` (lanes, 13) over all rows, from the state in ``clock``, ``x``, ``p``.

    Lane 0 is the point; lane j > 0 differs from it in one parameter by ``steps[j - 1]``. Updated in place: ``clock``
    (1,) s; ``x`` (axes, 9, lanes); ``p`` (9, 9, lanes), lower half; ``total`` (lanes,) log likelihoods; and, if
    ``steps`` is not empty, ``score`` (k,), ``fisher`` (k, k) and the scores of each ``block`` s in ``blocks``
    (n, k). ``innovation`` (n, axes, 2), if not empty, takes lane 0's standardised innovations and their deviations.
    """
    rows, axes, lanes = value.shape[0], value.shape[1], theta.shape[0]
    k = steps.shape[0]
    start = time[0] if rows else 0.0
    tau, length, lever, hq, hs = np.empty(lanes), np.empty(lanes), np.empty(lanes), np.empty(lanes), np.empty(lanes)
    rho, h_over_g = np.empty(lanes), np.empty(lanes)
    noise = np.empty((4, lanes))
    density, force = np.empty(lanes), np.empty(lanes)
    for lane in range(lanes):
        length[lane] = math.exp(theta[lane, 0])
        r, mu = theta[lane, 1], theta[lane, 5]
        rho[lane] = r + theta[lane, 2]
        h_over_g[lane] = theta[lane, 3] / GRAVITY
        h = (1.0 - mu) * theta[lane, 4] / GRAVITY
        lever[lane] = mu * r
        hq[lane] = h / length[lane]
        hs[lane] = h * (1.0 + mu * r / length[lane])
        tau[lane] = math.exp(theta[lane, 7])
        density[lane] = math.exp(theta[lane, 6])
        force[lane] = math.exp(theta[lane, 12])
        for which in range(4):
            noise[which, lane] = math.exp(2.0 * theta[lane, 8 + which])
    f_sn = np.empty(lanes)
    f = np.empty((12, lanes))  # s:u w q beta | nu:w | u:w | w | q:q beta u w | beta:w   (rest follow)
    fb = np.empty((3, lanes))  # beta: q, beta, u
    ks = np.empty((4, lanes))
    noise_matrix = np.zeros((DYNAMIC, DYNAMIC, lanes))
    fp = np.empty((DYNAMIC, STATES, lanes))
    ph = np.empty((STATES, lanes))
    gain = np.empty((STATES, lanes))
    variance, inverse = np.empty(lanes), np.empty(lanes)
    nu = np.empty((axes, lanes))
    old = np.empty((DYNAMIC, lanes))
    impulse = np.empty(DYNAMIC)
    dnu, ds = np.empty((axes, k)), np.empty(k)
    cached = -1.0
    for row in range(rows):
        gap = time[row] - clock[0]
        if gap > 0.0:
            pieces = int(math.ceil(gap / LONGEST_STEP - 1e-9))
            t = gap / pieces
            if abs(t - cached) > 1e-8:
                cached = t
                for lane in range(lanes):
                    e1 = -tau[lane] * math.expm1(-t / tau[lane])
                    ks[0, lane] = e1
                    e2 = tau[lane] * (t - e1)
                    ks[1, lane] = e2
                    e3 = tau[lane] * (t * t / 2.0 - e2)
                    ks[2, lane] = e3
                    ks[3, lane] = tau[lane] * (t * t * t / 6.0 - e3)
                    f[6, lane] = math.exp(-t / tau[lane])
                    for i in range(DYNAMIC):
                        for j in range(i + 1):
                            noise_matrix[i, j, lane] = 0.0
                    for node in range(3):
                        _response(
                            t * _NODES[node],
                            tau[lane],
                            length[lane],
                            lever[lane],
                            hq[lane],
                            hs[lane],
                            GRAVITY / length[lane],
                            impulse,
                        )
                        c = density[lane] * t * _WEIGHTS[node] / (tau[lane] * tau[lane])
                        for i in range(DYNAMIC):
                            for j in range(i + 1):
                                noise_matrix[i, j, lane] += c * impulse[i] * impulse[j]
                    noise_matrix[4, 4, lane] += force[lane] * t * t * t / 3.0
                    noise_matrix[5, 4, lane] += force[lane] * t * t / 2.0
                    noise_matrix[5, 5, lane] += force[lane] * t
            for lane in range(lanes):
                w2 = lift[row] / length[lane] - spin[row]
                z = w2 * t * t
                one = z / 2.0 + z * z / 24.0
                qb = t * (1.0 + z / 6.0 + z * z / 120.0)
                qu = -(t * t / 2.0) * (1.0 + z / 12.0 + z * z / 360.0) / length[lane]
                k1, k2, k3, k4 = ks[0, lane], ks[1, lane], ks[2, lane], ks[3, lane]
                f[0, lane] = t * t / 2.0 - lever[lane] * qu
                f[1, lane] = k3 + hs[lane] * k1 + lever[lane] * (k3 / length[lane] + hq[lane] * w2 * k3)
                f[2, lane] = -lever[lane] * one
                f[3, lane] = -lever[lane] * qb
                f[4, lane] = k2
                f[5, lane] = k1
                f[7, lane] = 1.0 + one
                f[8, lane] = qb
                f[9, lane] = qu
                f[10, lane] = -hq[lane] * (k1 + w2 * k3) - k3 / length[lane]
                f[11, lane] = -(k2 + w2 * k4) / length[lane] - hq[lane] * w2 * k2
                fb[0, lane] = w2 * qb
                fb[1, lane] = 1.0 + one
                fb[2, lane] = -qb / length[lane]
                f_sn[lane] = t
            for _ in range(pieces):
                for axis in range(axes):
                    for lane in range(lanes):
                        s, n, u, w = x[axis, 0, lane], x[axis, 1, lane], x[axis, 2, lane], x[axis, 3, lane]
                        q, b = x[axis, 4, lane], x[axis, 5, lane]
                        x[axis, 0, lane] = (
                            s + t * n + f[0, lane] * u + f[1, lane] * w + f[2, lane] * q + f[3, lane] * b
                        )
                        x[axis, 1, lane] = n + t * u + f[4, lane] * w
                        x[axis, 2, lane] = u + f[5, lane] * w
                        x[axis, 3, lane] = f[6, lane] * w
                        x[axis, 4, lane] = f[7, lane] * q + f[8, lane] * b + f[9, lane] * u + f[10, lane] * w
                        x[axis, 5, lane] = fb[0, lane] * q + fb[1, lane] * b + fb[2, lane] * u + f[11, lane] * w
                for j in range(STATES):
                    for i in range(DYNAMIC):
                        if i >= j:
                            for lane in range(lanes):
                                old[i, lane] = p[i, j, lane]
                        else:
                            for lane in range(lanes):
                                old[i, lane] = p[j, i, lane]
                    for lane in range(lanes):
                        s, n, u, w = old[0, lane], old[1, lane], old[2, lane], old[3, lane]
                        q, b = old[4, lane], old[5, lane]
                        fp[0, j, lane] = s + t * n + f[0, lane] * u + f[1, lane] * w + f[2, lane] * q + f[3, lane] * b
                        fp[1, j, lane] = n + t * u + f[4, lane] * w
                        fp[2, j, lane] = u + f[5, lane] * w
                        fp[3, j, lane] = f[6, lane] * w
                        fp[4, j, lane] = f[7, lane] * q + f[8, lane] * b + f[9, lane] * u + f[10, lane] * w
                        fp[5, j, lane] = fb[0, lane] * q + fb[1, lane] * b + fb[2, lane] * u + f[11, lane] * w
                for j in range(DYNAMIC, STATES):
                    for i in range(DYNAMIC):
                        for lane in range(lanes):
                            p[j, i, lane] = fp[i, j, lane]
                for i in range(DYNAMIC):
                    for lane in range(lanes):
                        s, n, u, w = fp[i, 0, lane], fp[i, 1, lane], fp[i, 2, lane], fp[i, 3, lane]
                        q, b = fp[i, 4, lane], fp[i, 5, lane]
                        old[0, lane] = s + t * n + f[0, lane] * u + f[1, lane] * w + f[2, lane] * q + f[3, lane] * b
                        old[1, lane] = n + t * u + f[4, lane] * w
                        old[2, lane] = u + f[5, lane] * w
                        old[3, lane] = f[6, lane] * w
                        old[4, lane] = f[7, lane] * q + f[8, lane] * b + f[9, lane] * u + f[10, lane] * w
                        old[5, lane] = fb[0, lane] * q + fb[1, lane] * b + fb[2, lane] * u + f[11, lane] * w
                    for j in range(i + 1):
                        for lane in range(lanes):
                            p[i, j, lane] = old[j, lane] + noise_matrix[i, j, lane]
            clock[0] = time[row]
        which = kind[row]
        for i in range(STATES):
            for lane in range(lanes):
                if which == 0:
                    a = p[i, 0, lane]
                    c = p[i, 2, lane] if i >= 2 else p[2, i, lane]
                    ph[i, lane] = a - h_over_g[lane] * c
                elif which == 1:
                    a = p[i, 2, lane] if i >= 2 else p[2, i, lane]
                    c = p[i, 7, lane] if i >= 7 else p[7, i, lane]
                    ph[i, lane] = a + c
                elif which == 2:
                    a = p[i, 4, lane] if i >= 4 else p[4, i, lane]
                    c = p[i, 6, lane] if i >= 6 else p[6, i, lane]
                    ph[i, lane] = p[i, 0, lane] + rho[lane] * a + c
                else:
                    a = p[i, 4, lane] if i >= 4 else p[4, i, lane]
                    c = p[i, 8, lane] if i >= 8 else p[8, i, lane]
                    ph[i, lane] = a + c
        factor = scale[row] * scale[row]
        for lane in range(lanes):
            if which == 0:
                variance[lane] = ph[0, lane] - h_over_g[lane] * ph[2, lane]
            elif which == 1:
                variance[lane] = ph[2, lane] + ph[7, lane]
            elif which == 2:
                variance[lane] = ph[0, lane] + rho[lane] * ph[4, lane] + ph[6, lane]
            else:
                variance[lane] = ph[4, lane] + ph[8, lane]
            variance[lane] += factor * noise[which, lane]
            inverse[lane] = 1.0 / variance[lane]
        for axis in range(axes):
            for lane in range(lanes):
                if which == 0:
                    expected = x[axis, 0, lane] - h_over_g[lane] * x[axis, 2, lane]
                elif which == 1:
                    expected = x[axis, 2, lane] + x[axis, 7, lane]
                elif which == 2:
                    expected = x[axis, 0, lane] + rho[lane] * x[axis, 4, lane] + x[axis, 6, lane]
                else:
                    expected = x[axis, 4, lane] + x[axis, 8, lane]
                nu[axis, lane] = value[row, axis] - expected
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
            for axis in range(axes):
                innovation[row, axis, 0] = nu[axis, 0] * math.sqrt(inverse[0])
                innovation[row, axis, 1] = math.sqrt(variance[0])
        if k:
            part = min(int((time[row] - start) / block), blocks.shape[0] - 1)
            root = math.sqrt(inverse[0])
            chi = 0.0
            for axis in range(axes):
                chi += nu[axis, 0] * nu[axis, 0]
            for j in range(k):
                ds[j] = (variance[j + 1] - variance[0]) / steps[j] * inverse[0]
                g = 0.5 * ds[j] * (chi * inverse[0] - axes)
                for axis in range(axes):
                    dnu[axis, j] = (nu[axis, j + 1] - nu[axis, 0]) / steps[j] * root
                    g -= nu[axis, 0] * root * dnu[axis, j]
                score[j] += g
                blocks[part, j] += g
                for i in range(j + 1):
                    information = 0.5 * axes * ds[i] * ds[j]
                    for axis in range(axes):
                        information += dnu[axis, i] * dnu[axis, j]
                    fisher[j, i] += information


@numba.njit(cache=True)
def _parabolas(time, values, at, half):  # pragma: no cover - compiled
    """Local parabolas through (time, values) at the times ``at``, both sorted: values and two derivatives.

    Every parabola takes the samples within ``half`` s, and never fewer than the five nearest in a row.
    Returns (3, len(at), columns).
    """
    n, columns = values.shape
    out = np.zeros((3, len(at), columns))
    low = high = 0
    for index in range(len(at)):
        while low < n and time[low] < at[index] - half:
            low += 1
        while high < n and time[high] <= at[index] + half:
            high += 1
        first, last = low, high
        while last - first < min(5, n):
            if first > 0 and (last >= n or at[index] - time[first - 1] <= time[last] - at[index]):
                first -= 1
            else:
                last += 1
        width = max(time[last - 1] - at[index], at[index] - time[first]) + 1e-12
        m = np.zeros(5)
        for i in range(first, last):
            z = (time[i] - at[index]) / width
            power = 1.0
            for j in range(5):
                m[j] += power
                power *= z
        a, b, c, d, e, f = m[0], m[1], m[2], m[2], m[3], m[4]
        # inverse of the symmetric matrix [[a, b, c], [b, d, e], [c, e, f]]
        i00, i01, i02 = d * f - e * e, c * e - b * f, b * e - c * d
        i11, i12, i22 = a * f - c * c, b * c - a * e, a * d - b * b
        determinant = a * i00 + b * i01 + c * i02
        for column in range(columns):
            y0 = y1 = y2 = 0.0
            for i in range(first, last):
                z = (time[i] - at[index]) / width
                y = values[i, column]
                y0 += y
                y1 += y * z
                y2 += y * z * z
            out[0, index, column] = (i00 * y0 + i01 * y1 + i02 * y2) / determinant
            out[1, index, column] = (i01 * y0 + i11 * y1 + i12 * y2) / determinant / width
            out[2, index, column] = 2.0 * (i02 * y0 + i12 * y1 + i22 * y2) / determinant / width**2
    return out


class Body(NamedTuple):
    """One tracked body: ``time`` (n,) s, ``position`` (n, 3) m or None, ``axis`` (n, 3) its body z in the world or None.

    Rows may come in any order; rows that are not finite are left out.
    """

    time: NDArray
    position: NDArray | None = None
    axis: NDArray | None = None


class Told(NamedTuple):
    """What is known of a quantity beforehand: a Gaussian of this mean and standard deviation."""

    value: float
    tolerance: float


@dataclass(frozen=True)
class Knowledge:
    """Gaussian priors of the laboratory; the defaults are those of somebody who knows nothing but the masses.

    Args:
        inertia_factor: lambda of the rod, 1 a point mass, 3/4 a uniform rod.
        marker_offset: how far beyond the rod's centre of mass the tracked point lies, m.
        seat_height: of the seat above the vehicle's tracked point, m.
        com_height: of the vehicle's centre of mass above its tracked point, m.
        mass_ratio: rod over rod and vehicle; 0 with tolerance 0 for a prescribed base.
        noise: standard deviation of positions in m, of attitudes in rad: guesses, within a factor of e.
        lag: time constant of the vehicle's rate loop, s: a guess, within a factor of e.
        lengths: shortest and longest length to expect, m.
    """

    inertia_factor: Told = Told(0.75, 0.1)
    marker_offset: Told = Told(0.0, 1e-3)
    seat_height: Told = Told(0.04, 0.1)
    com_height: Told = Told(0.0, 0.05)
    mass_ratio: Told = Told(0.053, 0.005)
    noise: tuple[float, float] = (0.2e-3, 1e-3)
    lag: float = 15e-3
    lengths: tuple[float, float] = (0.1, 4.0)


def parabolas(time: NDArray, values: NDArray, at: NDArray, half: float) -> NDArray:
    """Values and first two derivatives (3, len(at), columns) of local parabolas within ``half`` s of each time."""
    return _parabolas(np.ascontiguousarray(time), np.ascontiguousarray(values), np.ascontiguousarray(at), half)


def _cleaned(body: Body) -> Body:
    """Sorted by time; without rows that are not finite and without a second row of one stamp."""
    time = np.asarray(body.time, dtype=float)
    parts = [np.asarray(part, dtype=float) for part in body[1:] if part is not None]
    good = np.isfinite(time)
    for part in parts:
        good &= np.isfinite(part).all(axis=1)
    order = np.flatnonzero(good)[np.argsort(time[good], kind="stable")]
    order = order[np.diff(time[order], prepend=-np.inf) > 0.0]
    return Body(time[order], *(None if part is None else np.asarray(part, dtype=float)[order] for part in body[1:]))


def rows_of(vehicle: Body, rod: Body) -> Rows:
    """The measured rows of cleaned bodies; positions count from the vehicle's first one."""
    events = np.union1d(vehicle.time, rod.time)
    origin = vehicle.position[0]
    place = parabolas(vehicle.time, vehicle.position - origin, events, 0.05)
    rise = parabolas(vehicle.time, vehicle.position[:, 2:] - origin[2], events, 0.15)[2, :, 0]
    weight = GRAVITY + rise
    if vehicle.axis is None:
        thrust = place[2, :, :2]
    else:
        tilt = parabolas(vehicle.time, vehicle.axis[:, :2] / vehicle.axis[:, 2:], events, 0.05)
        thrust = weight[:, None] * tilt[0]
    if rod.axis is not None:
        lean = parabolas(rod.time, rod.axis[:, :2], events, 0.05)
    else:
        lean = parabolas(rod.time, rod.position - origin, events, 0.05) - place
        lean = lean[:, :, :2] / np.linalg.norm(lean[0], axis=1)[:, None]
    upright = np.sqrt(np.maximum(1.0 - np.sum(lean[0] ** 2, axis=1), 0.0))
    lift = np.sum(lean[0] * thrust, axis=1) + upright * weight
    spin = np.sum(lean[1] ** 2, axis=1)

    parts = [(VEHICLE, vehicle.time, (vehicle.position - origin)[:, :2], None)]
    if vehicle.axis is not None:
        at = np.searchsorted(events, vehicle.time)
        parts.append((TILT, vehicle.time, weight[at, None] * vehicle.axis[:, :2] / vehicle.axis[:, 2:], weight[at]))
    if rod.position is not None:
        parts.append((ROD, rod.time, (rod.position - origin)[:, :2], None))
    if rod.axis is not None:
        parts.append((DIRECTION, rod.time, rod.axis[:, :2], None))
    return _sorted_rows(parts, events, lift, spin)


def _sorted_rows(parts: Sequence[tuple], events: NDArray, lift: NDArray, spin: NDArray) -> Rows:
    time = np.concatenate([part[1] for part in parts])
    kind = np.concatenate([np.full(len(part[1]), part[0]) for part in parts])
    value = np.concatenate([part[2] for part in parts])
    scale = np.concatenate([np.ones(len(part[1])) if part[3] is None else part[3] for part in parts])
    order = np.lexsort((kind, time))
    at = np.searchsorted(events, time[order])
    return Rows(
        time[order],
        kind[order].astype(np.int64),
        np.ascontiguousarray(value[order]),
        scale[order],
        lift[at],
        spin[at],
    )


@dataclass
class _State:
    """Means and covariances of all lanes, and the time they belong to."""

    clock: NDArray
    x: NDArray
    p: NDArray

    @classmethod
    def at(cls, time: float, lanes: int, axes: int) -> "_State":
        # s, nu, u, w, q, beta, c_rod, c_tilt, c_direction: wide against any flight, in m, s and rad
        deviations = np.array([1.0, 3.0, 3.0, 10.0, 0.3, 2.0, 0.02, 1.0, 0.1])
        p = np.zeros((STATES, STATES, lanes))
        p[np.arange(STATES), np.arange(STATES)] = (deviations**2)[:, None]
        return cls(np.array([time]), np.zeros((axes, STATES, lanes)), p)


@dataclass
class _Pass:
    """What one pass over rows gives."""

    total: NDArray
    score: NDArray
    fisher: NDArray
    blocks: NDArray
    innovation: NDArray


BLOCK = 0.1
"""Length in s of the blocks over which scores are summed for the robust covariance."""


def run(
    rows: Rows, theta: NDArray, steps: NDArray | None = None, innovations: bool = False, state: _State | None = None
) -> _Pass:
    """Filter all rows for every row of ``theta`` (lanes, 13); see ``_recursion``."""
    lanes, axes, n = len(theta), rows.value.shape[1], len(rows.time)
    steps = np.zeros(0) if steps is None else steps
    state = state or _State.at(rows.time[0], lanes, axes)
    k = len(steps)
    parts = int((rows.time[-1] - rows.time[0]) / BLOCK) + 1 if k else 0
    out = _Pass(
        np.zeros(lanes),
        np.zeros(k),
        np.zeros((k, k)),
        np.zeros((parts, k)),
        np.zeros((n if innovations else 0, axes, 2)),
    )
    _recursion(
        *rows, theta, steps, state.clock, state.x, state.p, out.total, out.score, out.fisher, out.blocks, BLOCK,
        out.innovation,
    )  # fmt: skip
    out.fisher = np.tril(out.fisher) + np.tril(out.fisher, -1).T
    return out


def prior_rows(knowledge: Knowledge, density: float) -> Callable[[NDArray], NDArray]:
    """Deviations of theta (..., 13) from the priors, over their tolerances (..., 12)."""
    k = knowledge
    position, attitude = (math.log(value) for value in k.noise)
    force = math.log(FORCE_FREE)

    def deviations(theta: NDArray) -> NDArray:
        t = np.moveaxis(theta, -1, 0)
        factor = inertia_factor_of(t)
        values = [
            (factor, *k.inertia_factor),
            (t[OFFSET], *k.marker_offset),
            (t[H], *k.seat_height),
            (t[H] - t[HC], *k.com_height),
            (t[MU], *k.mass_ratio),
            (t[Q], math.log(density), 3.0),
            (t[TAU], math.log(k.lag), 1.0),
            (t[NV], position, 1.0),
            (t[NR], position, 1.0),
            (t[NT], attitude, 1.0),
            (t[ND], attitude, 1.0),
            (t[NF], force, 2.0),
        ]
        return np.stack([(value - mean) / max(sd, 1e-9) for value, mean, sd in values], axis=-1)

    return deviations


FORCE_FREE = 1e-12
"""Density of the white force on the rod where none is assumed, rad^2/s^3."""


def inertia_factor_of(theta: NDArray) -> NDArray:
    """lambda = r / (L_e + mu r) of the parameters theta (13, ...)."""
    return theta[R] / (np.exp(theta[LE]) + theta[MU] * theta[R])


@dataclass
class Fit:
    """A maximum a posteriori: all parameters, the free ones' covariance, and the last pass."""

    theta: NDArray
    free: NDArray
    covariance: NDArray
    value: float
    last: _Pass
    prior: Callable[[NDArray], NDArray]
    information: NDArray
    iterations: int
    converged: bool = True


STEP = 1e-5
_LARGEST = np.array([0.3, 0.2, 0.1, 0.05, 0.05, 0.01, 1.5, 1.0, 1.0, 1.0, 1.0, 1.0, 1.5])


def maximise(rows: Rows, theta: NDArray, free: NDArray, prior: Callable, tolerance: float = 1e-3) -> Fit:
    """Fisher scoring with Levenberg's damping from theta (13,) over the ``free`` parameters."""
    k = len(free)
    steps = np.full(k, STEP)

    def evaluate(point: NDArray) -> tuple[float, NDArray, NDArray, _Pass]:
        lanes = np.tile(point, (k + 1, 1))
        lanes[1 + np.arange(k), free] += STEP
        out = run(rows, lanes, steps)
        deviations = prior(lanes)
        slopes = (deviations[1:] - deviations[0]) / STEP
        value = out.total[0] - 0.5 * deviations[0] @ deviations[0]
        return value, out.score - slopes @ deviations[0], out.fisher + slopes @ slopes.T, out

    value, score, information, out = evaluate(theta)
    damping, iterations, converged = 1e-3, 1, False
    while iterations < 40:
        scale = 1.0 / np.sqrt(np.diag(information))
        scaled = information * np.outer(scale, scale)
        step = scale * np.linalg.solve(scaled + damping * np.eye(k), scale * score)
        step *= min(1.0, float(np.min(_LARGEST[free] / np.maximum(np.abs(step), 1e-12))))
        gain = float(score @ step)
        if gain < tolerance:
            converged = True
            break
        trial = theta.copy()
        trial[free] += step
        trial[R] = max(trial[R], 1e-3)
        trial[MU] = max(trial[MU], 0.0)
        after = evaluate(trial)
        iterations += 1
        if math.isfinite(after[0]) and after[0] > value - 1e-6:
            theta = trial
            value, score, information, out = after
            damping = max(damping / 10.0, 1e-9)
        else:
            damping *= 10.0
            if damping > 1e6:
                break
    scale = 1.0 / np.sqrt(np.diag(information))
    covariance = np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)
    return Fit(theta, free, covariance, value, out, prior, information, iterations, converged)
