"""The length of a rod from poses alone: an asynchronous Kalman filter whose likelihood is maximised.

With s the seat, q the rod's direction, e the thrust's direction, r the distance from the seat to the rod's centre of
mass, M = m + m_p, mu = m_p / M, U = (F / M) e + (1 - mu) h_c e'' and h_c the height of the seat above the vehicle's
centre of mass, the coupled plant (``dynamics.coupled_plant``, with the seat's term m h_c e'') is rearranged exactly:

    s'' + g e3 = U - mu r q'',        q'' = -|q'|^2 q - (1 / L_e) (U - q (q . U)),        L_e = r / (lambda kappa)

with kappa = 1 / (1 - mu lambda), so that lambda = r / (L_e + mu r). Per horizontal axis, with u = (F / M) e_x the
specific thrust, w = u' its rate and e_x = u / g, the derivatives of u are integrated out, so that none is needed:

    s' = nu - mu r beta + H (1 + mu r / L_e) w        q'    = beta - (H / L_e) w            H = (1 - mu) h_c / g
    nu' = u,   u' = w                                beta' = ((q . U) / L_e - |q'|^2) q - u / L_e

u is close to a random walk. Not quite: controller and rate loop colour its rate, w'' + 2 zeta omega w' + omega^2 w =
omega^2 (n + T n'), n white noise of density q_n, and all four of these numbers are estimated too.

What is of second order, q . U and |q'|^2, comes from smoothed poses. The measured rows, each at its own stamp, are

    vehicle  s - (h / g) u                  tilt       (g + z'') e_x / e_z = u + c_tilt
    rod      s + rho q + c_rod              direction  q + c_direction

The vehicle's position is of a point b below the middle of its markers, so it holds -b times the error of the tilt;
the row that is used is the one without it, vehicle + (b / g) tilt. h is the height of the seat above the tracked
point of the vehicle, rho the distance from the seat to the tracked point of the rod; both, and h_c and r, are kept
apart. The constants c are states. Nothing pairs the rows: order of arrival, unequal rates, jitter and losses need no
treatment of their own. A cart, an arm or any prescribed base is the same system with mu = h = h_c = 0 and without the
row of the tilt.

All parameters are estimated together, by maximum a posteriori with Gaussian priors (``Knowledge``): the recursion runs
for one point and for its neighbours side by side, so that one pass gives the likelihood, its gradient and the Fisher
information, and Fisher scoring finds the maximum.
"""

import dataclasses
import math
from collections.abc import Sequence
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
    "log_frequency",
    "log_damping",
    "log_zero",
    "log_vehicle_noise",
    "log_tilt_noise",
    "log_rod_noise",
    "log_direction_noise",
    "log_force_density",
    "origin_lever",
)
"""Order of the parameters: log L_e, r, rho - r, h, h_c, mu; logarithms of q_n (m^2/s^5), omega (rad/s), zeta, omega T,
noises (m, rad), and of the density of a white force on the rod (rad^2/s^3 of its angular acceleration); and b."""

LE, R, OFFSET, H, HC, MU, Q, OMEGA, ZETA, ZERO, NV, NT, NR, ND, NF, LEVER = range(len(PARAMETERS))
DYNAMIC, STATES = 7, 10
LONGEST_STEP = 1e-2
"""Longest step of the prediction, s: its series are right to 1e-7 up to rods of 2 cm."""

_NODES = np.array([0.5 - math.sqrt(0.15), 0.5, 0.5 + math.sqrt(0.15)])
_FIRST, _SECOND = np.array([0, 2, 5, 5]), np.array([2, 8, 7, 9])  # the states in the rows of each kind
_WEIGHTS = np.array([5.0, 8.0, 5.0]) / 18.0


class Rows(NamedTuple):
    """Measured rows sorted by time.

    ``time`` (n,) s; ``kind`` (n,); ``value`` (n, axes) m, m/s^2 or 1; ``scale`` (n,) the factor on the kind's noise;
    ``lift`` (n,) q . U in m/s^2, ``spin`` (n,) |q'|^2 in 1/s^2 and ``pull`` (n,) F / M in m/s^2, all smoothed;
    ``tilt`` (n, axes) the value of the tilt's row of the same pose, m/s^2, or 0.
    """

    time: NDArray
    kind: NDArray
    value: NDArray
    scale: NDArray
    lift: NDArray
    spin: NDArray
    pull: NDArray
    tilt: NDArray


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
def _moved(f, lane, s, n, u, w, v, q, b):  # pragma: no cover - compiled
    """The dynamic states after a step, by the transition's coefficients f (24, lanes)."""
    t = f[0, lane]
    return (
        s + t * n + f[1, lane] * u + f[2, lane] * w + f[3, lane] * v + f[4, lane] * q + f[5, lane] * b,
        n + t * u + f[6, lane] * w + f[7, lane] * v,
        u + f[8, lane] * w + f[9, lane] * v,
        f[10, lane] * w + f[11, lane] * v,
        f[12, lane] * w + f[13, lane] * v,
        f[14, lane] * q + f[15, lane] * b + f[16, lane] * u + f[17, lane] * w + f[18, lane] * v,
        f[19, lane] * q + f[14, lane] * b + f[20, lane] * u + f[21, lane] * w + f[22, lane] * v,
    )


@numba.njit(cache=True, error_model="numpy")
def _recursion(
    time, kind, value, scale, lift, spin, pull, tilt, theta, steps, clock, x, p, total, score, fisher, innovation,
    sized,
):  # fmt: skip # pragma: no cover - compiled
    """Run the filter of every row of ``theta`` (lanes, 16) over all rows, from the state in ``x`` and ``p``.

    Lane 0 is the point; lane j > 0 differs from it in one parameter by ``steps[j - 1]``. Updated in place: ``clock``
    (1,) s; ``x`` (axes, 10, lanes); ``p`` (10, 10, lanes), lower half; ``total`` (lanes,) log likelihoods; and, if
    ``steps`` is not empty, ``score`` (k,) and ``fisher`` (k, k). ``innovation`` (n, axes, 2), if not
    empty, takes lane 0's standardised innovations and their deviations. ``sized`` is any tuple of as many items as
    there are lanes: the compiler then knows their number.
    """
    rows, axes, lanes = value.shape[0], value.shape[1], len(sized)
    k = steps.shape[0]
    length, lever, seat, kick = np.empty(lanes), np.empty(lanes), np.empty(lanes), np.empty(lanes)
    rho, height, lean_of, bias_of = np.empty(lanes), np.empty(lanes), np.empty(lanes), np.empty(lanes)
    a0, a1, into_w, into_v = np.empty(lanes), np.empty(lanes), np.empty(lanes), np.empty(lanes)
    noise = np.empty((4, lanes))
    density, force = np.empty(lanes), np.empty(lanes)
    for lane in range(lanes):
        length[lane] = math.exp(theta[lane, 0])
        r, mu = theta[lane, 1], theta[lane, 5]
        rho[lane] = r + theta[lane, 2]
        height[lane] = theta[lane, 3]
        lever[lane] = mu * r
        seat[lane] = (1.0 - mu) * theta[lane, 4]
        kick[lane] = 1.0 + mu * r / length[lane]
        density[lane] = math.exp(theta[lane, 6])
        omega = math.exp(theta[lane, 7])
        a0[lane] = omega * omega
        a1[lane] = 2.0 * math.exp(theta[lane, 8]) * omega
        into_w[lane] = omega * math.exp(theta[lane, 9])
        into_v[lane] = a0[lane] - a1[lane] * into_w[lane]
        force[lane] = math.exp(theta[lane, 14])
        for which in range(4):
            noise[which, lane] = math.exp(2.0 * theta[lane, 10 + which])
    # lanes that differ in other parameters share the integrals of w
    same = np.empty(lanes, np.int64)
    for lane in range(lanes):
        same[lane] = lane
        for other in range(lane - 1, -1, -1):
            if (
                a0[other] == a0[lane]
                and a1[other] == a1[lane]
                and into_w[other] == into_w[lane]
                and into_v[other] == into_v[lane]
            ):
                same[lane] = other
    f = np.empty((23, lanes))
    # steps of four lengths are kept: two bodies, each stamped on its own, take turns
    ages, slot, oldest = np.full(4, -1.0), 0, 0
    kept = np.empty((4, 2, 6, lanes))
    kept_noise = np.zeros((4, DYNAMIC, DYNAMIC, lanes))
    fp = np.empty((DYNAMIC, STATES, lanes))
    old = np.empty((DYNAMIC, lanes))
    ph = np.empty((STATES, lanes))
    gain = np.empty((STATES, lanes))
    variance, inverse = np.empty(lanes), np.empty(lanes)
    nu = np.empty((axes, lanes))
    impulse, integrals = np.empty((DYNAMIC, lanes)), np.empty(6)
    spread = np.empty((6, lanes))
    dnu, ds = np.empty((axes, k)), np.empty(k)
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
                for one_of in range(2):
                    for lane in range(lanes):
                        if same[lane] == lane:
                            _integrals(t, a0[lane], a1[lane], 1.0 - one_of, 1.0 * one_of, integrals)
                            for i in range(6):
                                kept[slot, one_of, i, lane] = integrals[i]
                        else:
                            for i in range(6):
                                kept[slot, one_of, i, lane] = kept[slot, one_of, i, same[lane]]
                for i in range(DYNAMIC):
                    for j in range(i + 1):
                        for lane in range(lanes):
                            kept_noise[slot, i, j, lane] = 0.0
                for node in range(3):
                    for lane in range(lanes):
                        if same[lane] == lane:
                            _integrals(t * _NODES[node], a0[lane], a1[lane], into_w[lane], into_v[lane], integrals)
                            for i in range(6):
                                spread[i, lane] = integrals[i]
                        else:
                            for i in range(6):
                                spread[i, lane] = spread[i, same[lane]]
                    weight = t * _WEIGHTS[node]
                    for lane in range(lanes):
                        root = math.sqrt(density[lane] * weight)
                        per = 1.0 / length[lane]
                        h = seat[lane] / GRAVITY
                        hq = h * per
                        w2 = GRAVITY * per
                        e, e_dot, k1 = root * spread[0, lane], root * spread[1, lane], root * spread[2, lane]
                        k2, k3, k4 = root * spread[3, lane], root * spread[4, lane], root * spread[5, lane]
                        impulse[0, lane] = k3 + h * kick[lane] * k1 + lever[lane] * (per + hq * w2) * k3
                        impulse[1, lane] = k2
                        impulse[2, lane] = k1
                        impulse[3, lane] = e
                        impulse[4, lane] = e_dot
                        impulse[5, lane] = -hq * (k1 + w2 * k3) - k3 * per
                        impulse[6, lane] = -(k2 + w2 * k4) * per - hq * w2 * k2
                    for i in range(DYNAMIC):
                        for j in range(i + 1):
                            for lane in range(lanes):
                                kept_noise[slot, i, j, lane] += impulse[i, lane] * impulse[j, lane]
                for lane in range(lanes):
                    kept_noise[slot, 5, 5, lane] += force[lane] * t * t * t / 3.0
                    kept_noise[slot, 6, 5, lane] += force[lane] * t * t / 2.0
                    kept_noise[slot, 6, 6, lane] += force[lane] * t
            ks, noise_matrix = kept[slot], kept_noise[slot]
            for lane in range(lanes):
                per = 1.0 / length[lane]
                h = seat[lane] / pull[row]
                hs, hq = h * kick[lane], h * per
                w2 = lift[row] * per - spin[row]
                z = w2 * t * t
                one = z / 2.0 + z * z / 24.0
                qb = t * (1.0 + z / 6.0 + z * z / 120.0)
                qu = -(t * t / 2.0) * (1.0 + z / 12.0 + z * z / 360.0) * per
                f[0, lane] = t
                f[1, lane] = t * t / 2.0 - lever[lane] * qu
                f[4, lane] = -lever[lane] * one
                f[5, lane] = -lever[lane] * qb
                f[14, lane] = 1.0 + one
                f[15, lane] = qb
                f[16, lane] = qu
                f[19, lane] = w2 * qb
                f[20, lane] = -qb * per
                for one_of in range(2):
                    e, e_dot, k1 = ks[one_of, 0, lane], ks[one_of, 1, lane], ks[one_of, 2, lane]
                    k2, k3, k4 = ks[one_of, 3, lane], ks[one_of, 4, lane], ks[one_of, 5, lane]
                    f[2 + one_of, lane] = k3 + hs * k1 + lever[lane] * (per + hq * w2) * k3
                    f[6 + one_of, lane] = k2
                    f[8 + one_of, lane] = k1
                    f[10 + one_of, lane] = e
                    f[12 + one_of, lane] = e_dot
                    f[17 + one_of, lane] = -hq * (k1 + w2 * k3) - k3 * per
                    f[21 + one_of, lane] = -(k2 + w2 * k4) * per - hq * w2 * k2
            for _ in range(pieces):
                for axis in range(axes):
                    for lane in range(lanes):
                        moved = _moved(
                            f,
                            lane,
                            x[axis, 0, lane],
                            x[axis, 1, lane],
                            x[axis, 2, lane],
                            x[axis, 3, lane],
                            x[axis, 4, lane],
                            x[axis, 5, lane],
                            x[axis, 6, lane],
                        )
                        for i in range(DYNAMIC):
                            x[axis, i, lane] = moved[i]
                for j in range(STATES):
                    for i in range(DYNAMIC):
                        high, low = max(i, j), min(i, j)
                        for lane in range(lanes):
                            old[i, lane] = p[high, low, lane]
                    for lane in range(lanes):
                        moved = _moved(
                            f, lane, old[0, lane], old[1, lane], old[2, lane], old[3, lane], old[4, lane],
                            old[5, lane], old[6, lane],
                        )  # fmt: skip
                        for i in range(DYNAMIC):
                            fp[i, j, lane] = moved[i]
                for j in range(DYNAMIC, STATES):
                    for i in range(DYNAMIC):
                        for lane in range(lanes):
                            p[j, i, lane] = fp[i, j, lane]
                for i in range(DYNAMIC):
                    for lane in range(lanes):
                        moved = _moved(
                            f, lane, fp[i, 0, lane], fp[i, 1, lane], fp[i, 2, lane], fp[i, 3, lane], fp[i, 4, lane],
                            fp[i, 5, lane], fp[i, 6, lane],
                        )  # fmt: skip
                        for j in range(DYNAMIC):
                            old[j, lane] = moved[j]
                    for j in range(i + 1):
                        for lane in range(lanes):
                            p[i, j, lane] = old[j, lane] + noise_matrix[i, j, lane]
            clock[0] = time[row]
        which = kind[row]
        for lane in range(lanes):
            bias_of[lane] = theta[lane, 15] / pull[row]
            lean_of[lane] = bias_of[lane] - height[lane] / pull[row]
        first, second = _FIRST[which], _SECOND[which]
        for i in range(STATES):
            a_row, a_column = max(i, first), min(i, first)
            c_row, c_column = max(i, second), min(i, second)
            if which == 0:
                for lane in range(lanes):
                    ph[i, lane] = (
                        p[i, 0, lane]
                        + lean_of[lane] * p[c_row, c_column, lane]
                        + bias_of[lane] * p[max(i, 8), min(i, 8), lane]
                    )
            elif which == 2:
                for lane in range(lanes):
                    ph[i, lane] = p[i, 0, lane] + rho[lane] * p[a_row, a_column, lane] + p[c_row, c_column, lane]
            else:
                for lane in range(lanes):
                    ph[i, lane] = p[a_row, a_column, lane] + p[c_row, c_column, lane]
        factor = scale[row] * scale[row]
        if which == 0:
            for lane in range(lanes):
                variance[lane] = ph[0, lane] + lean_of[lane] * ph[2, lane] + bias_of[lane] * ph[8, lane]
            for axis in range(axes):
                for lane in range(lanes):
                    expected = x[axis, 0, lane] + lean_of[lane] * x[axis, 2, lane] + bias_of[lane] * x[axis, 8, lane]
                    nu[axis, lane] = value[row, axis] + bias_of[lane] * tilt[row, axis] - expected
        elif which == 2:
            for lane in range(lanes):
                variance[lane] = ph[0, lane] + rho[lane] * ph[5, lane] + ph[7, lane]
            for axis in range(axes):
                for lane in range(lanes):
                    expected = x[axis, 0, lane] + rho[lane] * x[axis, 5, lane] + x[axis, 7, lane]
                    nu[axis, lane] = value[row, axis] - expected
        else:
            for lane in range(lanes):
                variance[lane] = ph[first, lane] + ph[second, lane]
            for axis in range(axes):
                for lane in range(lanes):
                    nu[axis, lane] = value[row, axis] - x[axis, first, lane] - x[axis, second, lane]
        for lane in range(lanes):
            variance[lane] += factor * noise[which, lane]
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
            for axis in range(axes):
                innovation[row, axis, 0] = nu[axis, 0] * math.sqrt(inverse[0])
                innovation[row, axis, 1] = math.sqrt(variance[0])
        if k:
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
                for i in range(j + 1):
                    information = 0.5 * axes * ds[i] * ds[j]
                    for axis in range(axes):
                        information += dnu[axis, i] * dnu[axis, j]
                    fisher[j, i] += information


@numba.njit(cache=True, error_model="numpy")
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
    """One tracked body: ``time`` (n,) s; ``position`` (n, 3) m, ``axis`` (n, 3) its body z in the world, or None.

    Rows may come in any order; rows that are not finite are left out.
    """

    time: NDArray
    position: NDArray | None = None
    axis: NDArray | None = None


class Told(NamedTuple):
    """What is known of a quantity beforehand: a Gaussian of this mean and standard deviation."""

    value: float
    tolerance: float


_SEAT, _COM, _MASS = Told(0.04, 0.1), Told(0.0, 0.05), Told(0.053, 0.001)


@dataclass(frozen=True)
class Knowledge:
    """What is known of the laboratory beforehand. The defaults suit somebody who knows nothing but the masses.

    Args:
        inertia_factor: lambda of the rod: 1 for a point mass, 3/4 for a uniform rod. None if it is not known.
        marker_offset: how far beyond the rod's centre of mass its tracked point lies, m. None if it is not known:
            the point is then assumed to be at the middle, unless the flight contradicts that.
        seat_height: of the seat above the vehicle's tracked point, m.
        com_height: of the vehicle's centre of mass above its tracked point, m.
        mass_ratio: rod over rod and vehicle.
        distance_tolerance: deviation, in m, of the measured distance of the two tracked points from rho + h, because
            neither lies exactly on its axis. Infinite: the distance is not used.
        noise: standard deviation of positions in m, and of attitudes in rad; guesses, right within a factor of e.
        lag: time constant of the vehicle's rate loop in s; a guess, right within a factor of e.
        lengths: shortest and longest rod to expect, m.
    """

    inertia_factor: Told | None = None
    marker_offset: Told | None = None
    seat_height: Told = _SEAT
    com_height: Told = _COM
    mass_ratio: Told = _MASS
    distance_tolerance: float = 1e-3
    noise: tuple[float, float] = (0.2e-3, 1e-3)
    lag: float = 15e-3
    lengths: tuple[float, float] = (0.1, 4.0)

    @classmethod
    def of(cls, params: Params) -> "Knowledge":
        """The masses, the noise of motion capture, the lag and the interval of lengths of ``params``."""
        rod, vehicle, simulation = params.pendulum, params.vehicle, params.simulation
        ratio = rod.mass / (rod.mass + vehicle.mass)
        return cls(
            mass_ratio=Told(ratio, 0.02 * ratio),
            noise=(max(simulation.position_noise, 1e-6), max(simulation.attitude_noise, 1e-6)),
            lag=simulation.rate_lag,
            lengths=(params.estimation.length_min, params.estimation.length_max),
        )


UNIFORM, MIDDLE = Told(0.75, 0.003), Told(0.0, 1e-3)
"""Assumed where nothing is told: lambda of a uniform rod, or the tracked point at the middle within 1 mm."""

ORIGIN = Told(0.0, 0.05)
"""How far the vehicle's tracked point lies below the middle of its markers, m."""

ANY_INERTIA, ANY_OFFSET = Told(0.8, 0.15), Told(0.0, 0.4)
"""What the other one of the two is left to be: from tip-heavy rods to point masses, from the foot to the tip."""


def parabolas(time: NDArray, values: NDArray, at: NDArray, half: float) -> NDArray:
    """Values and first two derivatives (3, len(at), columns) of local parabolas within ``half`` s of each time."""
    return _parabolas(np.ascontiguousarray(time), np.ascontiguousarray(values), np.ascontiguousarray(at), half)


def _cleaned(body: Body, name: str = "", notes: list[str] | None = None) -> Body:
    """Sorted by time; without rows that are not finite and without a second row of one stamp; ``notes`` say so."""
    time = np.asarray(body.time, dtype=float)
    parts = [np.asarray(part, dtype=float) for part in body[1:] if part is not None]
    good = np.isfinite(time)
    for part in parts:
        good &= np.isfinite(part).all(axis=1)
    order = np.flatnonzero(good)[np.argsort(time[good], kind="stable")]
    fresh = np.diff(time[order], prepend=-np.inf) > 0.0
    if notes is not None:
        found = {
            "are not finite and were left out": int(np.sum(~good)),
            "were out of order and were sorted": int(np.sum(np.diff(time[good]) < 0.0)),
            "repeat the stamp of another one and were left out": int(np.sum(~fresh)),
        }
        notes += [f"{count} poses of the {name} {what}" for what, count in found.items() if count]
    order = order[fresh]
    return Body(time[order], *(None if part is None else np.asarray(part, dtype=float)[order] for part in body[1:]))


def rows_of(vehicle: Body, rod: Body, origin: NDArray | None = None) -> Rows:
    """The measured rows of cleaned bodies; positions count from ``origin`` (3,), by default the vehicle's first one."""
    events = np.union1d(vehicle.time, rod.time)
    origin = vehicle.position[0] if origin is None else origin
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
    # no parabola reaches across a gap: what is of second order is interpolated there
    for body, values in ((rod, lean), (vehicle, lean), (vehicle, thrust[None])):
        near = _near(body.time, events)
        for block in values:
            for column in block.T:
                column[~near] = np.interp(events[~near], events[near], column[near])
    upright = np.sqrt(np.maximum(1.0 - np.sum(lean[0] ** 2, axis=1), 0.0))
    lift = np.sum(lean[0] * thrust, axis=1) + upright * weight
    spin = np.sum(lean[1] ** 2, axis=1)
    pull = np.sqrt(np.sum(thrust**2, axis=1) + weight**2)

    parts = [(VEHICLE, vehicle.time, (vehicle.position - origin)[:, :2], None)]
    if vehicle.axis is not None:
        at = np.searchsorted(events, vehicle.time)
        parts.append((TILT, vehicle.time, weight[at, None] * vehicle.axis[:, :2] / vehicle.axis[:, 2:], weight[at]))
    if rod.position is not None:
        parts.append((ROD, rod.time, (rod.position - origin)[:, :2], None))
    if rod.axis is not None:
        parts.append((DIRECTION, rod.time, rod.axis[:, :2], None))
    return _sorted_rows(parts, events, lift, spin, pull)


def _near(time: NDArray, events: NDArray) -> NDArray:
    """Which events have a sample within 0.05 s, or two and a half periods, before and after, or lie on one."""
    gap = max(0.05, 2.5 * float(np.median(np.diff(time))))
    after = np.searchsorted(time, events)
    before = np.maximum(np.searchsorted(time, events, side="right") - 1, 0)
    after = np.minimum(after, len(time) - 1)
    return (np.abs(time[after] - events) <= gap) & (np.abs(events - time[before]) <= gap)


def _sorted_rows(parts: Sequence[tuple], events: NDArray, lift: NDArray, spin: NDArray, pull: NDArray) -> Rows:
    time = np.concatenate([part[1] for part in parts])
    tilts = [part[2] for part in parts if part[0] == TILT]
    tilt = np.concatenate([tilts[0] if tilts and part[0] == VEHICLE else np.zeros_like(part[2]) for part in parts])
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
        pull[at],
        np.ascontiguousarray(tilt[order]),
    )


@dataclass
class _State:
    """Means and covariances of all lanes, and the time they belong to."""

    clock: NDArray
    x: NDArray
    p: NDArray

    @classmethod
    def at(cls, time: float, lanes: int, axes: int) -> "_State":
        # s, nu, u, w, w', q, beta, c_rod, c_tilt, c_direction: wide against any flight, in m, s and rad
        deviations = np.array([1.0, 3.0, 3.0, 10.0, 1000.0, 0.3, 2.0, 0.02, 1.0, 0.1])
        p = np.zeros((STATES, STATES, lanes))
        p[np.arange(STATES), np.arange(STATES)] = (deviations**2)[:, None]
        return cls(np.array([time]), np.zeros((axes, STATES, lanes)), p)


@dataclass
class _Pass:
    """What one pass over rows gives."""

    total: NDArray
    score: NDArray
    fisher: NDArray
    innovation: NDArray


def run(
    rows: Rows, theta: NDArray, steps: NDArray | None = None, innovations: bool = False, state: _State | None = None
) -> _Pass:
    """Filter all rows for every row of ``theta`` (lanes, 16); see ``_recursion``."""
    wanted, axes, n = len(theta), rows.value.shape[1], len(rows.time)
    # a whole number of vectors: without a remainder the compiler keeps all lanes in step, twice as fast
    lanes = 1 if wanted == 1 else -(-wanted // 16) * 16
    theta = np.concatenate([theta, np.repeat(theta[-1:], lanes - wanted, axis=0)])
    steps = np.zeros(0) if steps is None else steps
    state = state or _State.at(rows.time[0], lanes, axes)
    k = len(steps)
    out = _Pass(
        np.zeros(lanes),
        np.zeros(k),
        np.zeros((k, k)),
        np.zeros((n if innovations else 0, axes, 2)),
    )
    _recursion(
        *rows, theta, steps, state.clock, state.x, state.p, out.total, out.score, out.fisher, out.innovation,
        (0,) * lanes,
    )  # fmt: skip
    out.total = out.total[:wanted]
    out.fisher = np.tril(out.fisher) + np.tril(out.fisher, -1).T
    return out


FORCE_FREE = 1e-12
"""Density of the white force on the rod where none is assumed, rad^2/s^3."""


class Prior(NamedTuple):
    """Independent Gaussians: ``means`` and ``tolerances`` (15,) of what ``quantities`` returns."""

    means: NDArray
    tolerances: NDArray

    @staticmethod
    def quantities(theta: NDArray) -> NDArray:
        """What the priors are about, (..., 16) -> (..., 15)."""
        t = np.moveaxis(theta, -1, 0)
        distance = t[R] + t[OFFSET] + t[H]
        told = [inertia_factor_of(t), t[OFFSET], t[H], t[H] - t[HC], t[MU], distance]
        return np.stack([*told, *t[Q : ND + 1], t[LEVER]], axis=-1)

    def deviations(self, theta: NDArray) -> NDArray:
        """Of theta (..., 16) from the priors, over their tolerances (..., 15)."""
        return (self.quantities(theta) - self.means) / self.tolerances


TOLD = ("inertia factor", "tracked point of the rod", "seat height", "height of the vehicle's centre of mass",
        "mass ratio", "distance of the two tracked points")  # fmt: skip
"""Names of the first quantities of a ``Prior``."""


def inertia_factor_of(theta: NDArray) -> NDArray:
    """lambda = r / (L_e + mu r) of the parameters theta (16, ...)."""
    return theta[R] / (np.exp(theta[LE]) + theta[MU] * theta[R])


@dataclass
class Fit:
    """A maximum a posteriori: all parameters, the free ones' covariance, and the last pass."""

    theta: NDArray
    free: NDArray
    covariance: NDArray
    value: float
    last: _Pass
    prior: Prior
    information: NDArray
    iterations: int
    converged: bool = True


STEP = 1e-5
_LARGEST = np.array([0.3, 0.2, 0.1, 0.05, 0.05, 0.01, 1.5, 0.5, 0.5, 0.5, 1.0, 1.0, 1.0, 1.0, 1.5, 0.1])


def maximise(rows: Rows, theta: NDArray, free: NDArray, prior: Prior, tolerance: float = 0.1) -> Fit:
    """Fisher scoring from theta (16,) over the ``free`` parameters, with shorter steps where full ones go too far."""
    k = len(free)
    steps = np.full(k, STEP)

    def evaluate(point: NDArray) -> tuple[float, NDArray, NDArray, _Pass]:
        lanes = np.tile(point, (k + 1, 1))
        lanes[1 + np.arange(k), free] += STEP
        out = run(rows, lanes, steps)
        deviations = prior.deviations(lanes)
        slopes = (deviations[1:] - deviations[0]) / STEP
        value = out.total[0] - 0.5 * deviations[0] @ deviations[0]
        return value, out.score - slopes @ deviations[0], out.fisher + slopes @ slopes.T, out

    value, score, information, out = evaluate(theta)
    relaxation, iterations, converged = 1.0, 1, False
    while iterations < 40 and relaxation > 1e-3:
        scale = 1.0 / np.sqrt(np.diag(information))
        full = scale * np.linalg.solve(information * np.outer(scale, scale), scale * score)
        step = full * min(relaxation, float(np.min(_LARGEST[free] / np.maximum(np.abs(full), 1e-12))))
        if 0.0 <= score @ full < tolerance:
            # so close that the likelihood is a parabola: the step ends at its top
            theta = theta.copy()
            theta[free] += step
            converged = True
            break
        trial = theta.copy()
        trial[free] += step
        trial[R] = max(trial[R], 1e-3)
        trial[MU] = max(trial[MU], 0.0)
        after = evaluate(trial)
        iterations += 1
        better = math.isfinite(after[0]) and after[0] > value
        # the expected information can fall short of the curvature: the step then goes too far, and every time
        if not better or after[1] @ step < -0.3 * (score @ step):
            relaxation /= 2.0
        if better:
            theta = trial
            value, score, information, out = after
    scale = 1.0 / np.sqrt(np.diag(information))
    covariance = np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)
    return Fit(theta, free, covariance, value, out, prior, information, iterations, converged)


class Value(NamedTuple):
    """A number and its standard deviation."""

    value: float
    deviation: float


UNKNOWN = Value(math.nan, math.nan)


@dataclass(frozen=True)
class PoseEstimate:
    """What two tracked bodies say about the rod.

    Attributes:
        length: twice the distance from the seat to the rod's centre of mass, m; nan if refused.
        standard_deviation, interval: of the length, m; the interval holds 95 %.
        effective_length: L_e, m, the length of the point pendulum that falls as fast on a base as heavy.
        rod_point: rho, distance from the seat to the rod's tracked point, m.
        seat_height: of the seat above the vehicle's tracked point, m.
        com_height: of the seat above the vehicle's centre of mass, m.
        inertia_factor: lambda; 1 for a point mass, 3/4 for a uniform rod.
        uniform_length, middle_length: the two readings of the length, m: of a uniform rod wherever it is tracked, and
            twice ``rod_point``, which is the length if the rod is tracked at its middle.
        distance: measured distance of the two tracked points, m, and its deviation from rho + h over the standard
            deviation of that: it agrees within +-3.
        noise: fitted standard deviations of the vehicle's and the rod's position, m, of tilt and direction, rad.
        whiteness: largest autocorrelation of the innovations at lags of 1 to 10 rows, by kind of row.
        assumed: what was taken for granted and with which tolerance, one sentence each.
        notes: what was left out of the data, and what else is worth knowing, one sentence each.
        reason: None, or one sentence why there is no length and what to do about it.
    """

    length: float = math.nan
    standard_deviation: float = math.nan
    interval: tuple[float, float] = (math.nan, math.nan)
    effective_length: Value = UNKNOWN
    rod_point: Value = UNKNOWN
    seat_height: Value = UNKNOWN
    com_height: Value = UNKNOWN
    inertia_factor: Value = UNKNOWN
    uniform_length: Value = UNKNOWN
    middle_length: Value = UNKNOWN
    distance: Value = UNKNOWN
    noise: dict[str, float] = field(default_factory=dict)
    whiteness: dict[str, float] = field(default_factory=dict)
    assumed: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    reason: str | None = None


KINDS = ("vehicle", "tilt", "rod", "direction")
"""Names of the kinds of rows."""

LEAST_ROWS = 64
"""Fewest poses of each body: a quarter of a second at 240 Hz, and never enough to be sure of anything."""

LARGEST_SPREAD = 0.05
"""Refused above this relative standard deviation: the priors alone, with no motion at all, end at 10 % for 1 m."""

LARGEST_PLANAR_SPREAD = 0.1
"""The same for carts and arms, which know the base exactly: what friction leaves in doubt is then most of it."""

LARGEST_CONFLICT = 4.0
"""Refused above this many standard deviations between a told value and the flight: one in 16 000 by chance."""

LARGEST_JUMP = 3.0
"""Refused above this mean squared innovation over ``JUMP_SPAN`` s; noise alone reaches 2 in a flight of minutes."""

JUMP_SPAN = 0.1

LARGEST_CORRELATION = 0.3
"""Refused above this autocorrelation of innovations."""

LARGEST_NOISE = 5.0
"""Refused above this ratio of fitted to stated noise."""


def estimate(vehicle: Body, rod: Body, knowledge: Knowledge | None = None) -> PoseEstimate:
    """Estimate the length of a balanced rod from the poses of two bodies.

    Args:
        vehicle: positions, and the body's z axis if it is a vehicle that tilts to accelerate. Without axes it is a
            prescribed base: a cart, an arm, a hand.
        rod: positions of one point of the rod, its axis, or both.
        knowledge: priors of the laboratory.

    Raises:
        ValueError: the vehicle has no positions, or the rod neither positions nor axes.
    """
    if vehicle.position is None or (rod.position is None and rod.axis is None):
        raise ValueError("an estimate needs the vehicle's positions, and the rod's positions or axes")
    knowledge = knowledge or Knowledge()
    notes: list[str] = []
    vehicle, rod = _cleaned(vehicle, "vehicle", notes), _cleaned(rod, "rod", notes)
    if min(len(vehicle.time), len(rod.time)) < LEAST_ROWS:
        return PoseEstimate(
            notes=tuple(notes),
            reason=f"too few poses: {len(vehicle.time)} of the vehicle and {len(rod.time)} of the rod, "
                            f"at least {LEAST_ROWS} of each are needed; record longer")  # fmt: skip
    distance = math.nan
    if rod.position is not None:
        rod, distance, dropped = _without_jumps(vehicle, rod)
        if dropped:
            notes.append(f"{dropped} poses of the rod were left out: they lie elsewhere than the rod can be")
        if len(rod.time) < LEAST_ROWS:
            return PoseEstimate(reason="the distance of the two bodies is not constant: they do not belong together")
    if (reason := _frames(vehicle, rod, distance)) is not None:
        return PoseEstimate(notes=tuple(notes), reason=reason)
    if rod.position is not None and distance < SHORTEST_ARM:
        if rod.axis is None:
            return PoseEstimate(
                reason=f"the rod is tracked {100 * distance:.0f} cm from the vehicle, at its foot, where it does not "
                "move: track its middle, or record its orientation too"
            )
        rod = Body(rod.time, None, rod.axis)
        notes.append("the rod is tracked at its foot: its orientation alone was used")
    rows = rows_of(vehicle, rod)
    leaned = _largest_lean(vehicle, rod)
    if leaned > LARGEST_LEAN:
        return PoseEstimate(notes=tuple(notes), reason=f"rod or vehicle leans by {math.degrees(leaned):.0f} deg, "
                            f"too far for the model; leave out the stretch where it falls")  # fmt: skip
    return _answer(rows, knowledge, distance, vehicle.axis is not None, notes)


LARGEST_LEAN = 0.3
"""Refused above this angle, rad: terms of second order are taken from smoothed poses, which is then too coarse."""


def _largest_lean(vehicle: Body, rod: Body) -> float:
    """The largest angle of rod or vehicle from upright, rad, single noisy poses aside."""
    leans = []
    if rod.position is not None:
        place = np.column_stack([np.interp(rod.time, vehicle.time, column) for column in vehicle.position.T])
        arm = rod.position - place
        leans.append(np.arctan2(np.linalg.norm(arm[:, :2], axis=1), arm[:, 2]))
    leans += [np.arccos(np.clip(body.axis[:, 2], -1.0, 1.0)) for body in (vehicle, rod) if body.axis is not None]
    return max(float(np.quantile(lean, 0.995)) for lean in leans)


SHORTEST_ARM = 0.1
"""Tracked points closer than this, m, are taken for the rod's foot."""


def planar(
    base_time: ArrayLike,
    base: ArrayLike,
    angle_time: ArrayLike,
    angle: ArrayLike,
    knowledge: Knowledge | None = None,
    arm_radius: float = math.inf,
) -> PoseEstimate:
    """Estimate the effective length of a rod balanced in one plane on a cart or an arm, by two encoders.

    Real encoders, joints and belts are no motion capture. Where innovations show that the model leaves something out,
    a second fit gives the rod an unknown white force too; the difference between both lengths is then taken for one
    more standard deviation.

    Args:
        base_time, base: s, and position of the rod's pivot along its path, m.
        angle_time, angle: s, and angle of the rod from upright, rad, positive towards positive positions.
        knowledge: priors; masses and seat have no meaning here.
        arm_radius: radius of the circle on which an arm moves the pivot, m; infinite for a cart.
    """
    knowledge = knowledge or Knowledge()
    sensors = ((base_time, base), (angle_time, angle))
    cleaned = [_cleaned(Body(np.asarray(t, dtype=float), np.asarray(v, dtype=float)[:, None])) for t, v in sensors]
    if min(len(body.time) for body in cleaned) < LEAST_ROWS:
        return PoseEstimate(reason=f"too few samples: at least {LEAST_ROWS} of each sensor are needed; record longer")
    (base_time, base, _), (angle_time, angle, _) = cleaned
    base = base - base[0]
    quanta = [_quantum(base[:, 0]), _quantum(angle[:, 0])]
    moved = float(np.std(angle))
    if moved < LEAST_QUANTA * quanta[1]:
        return PoseEstimate(reason=f"quantisation: the rod moves by {moved / quanta[1]:.1f} steps of its encoder, not "
                            f"by {LEAST_QUANTA:g}; excite it more, or use a finer encoder")  # fmt: skip
    events = np.union1d(base_time, angle_time)
    speed, force = parabolas(base_time, base, events, 0.05)[1:, :, 0]
    sine = parabolas(angle_time, np.sin(angle), events, 0.05)[:2, :, 0]
    upright = np.maximum(1.0 - sine[0] ** 2, 0.1)
    lift = sine[0] * force + np.sqrt(upright) * GRAVITY
    # |q'|^2, and the centrifugal force of the arm
    spin = sine[1] ** 2 / upright - (speed / arm_radius) ** 2 * upright
    parts = [(VEHICLE, base_time, base, None), (DIRECTION, angle_time, np.sin(angle), None)]
    rows = _sorted_rows(parts, events, lift, spin, np.full(len(events), GRAVITY))
    floor = [max(quantum / math.sqrt(12.0), noise) for quantum, noise in zip(quanta, knowledge.noise, strict=True)]
    known = dataclasses.replace(knowledge, noise=(floor[0], floor[1]))
    start = _start(rows, known, math.nan, False)
    told = known.inertia_factor or UNIFORM
    fit = _fit(rows, known, math.nan, False, start, told, ANY_OFFSET)
    innovation = run(rows, fit.theta[None], innovations=True).innovation[:, :, 0]
    whiteness = {KINDS[kind]: _correlation(innovation[rows.kind == kind]) for kind in (VEHICLE, DIRECTION)}
    assumed = _assumptions(fit, "told" if known.inertia_factor else "uniform", known, False, False, math.nan)
    notes, extra = [], 0.0
    if max(whiteness.values()) > LARGEST_CORRELATION or _largest_jump(rows.time, innovation)[0] > LARGEST_JUMP:
        pushed = _fit(rows, known, math.nan, False, start, told, ANY_OFFSET, force=True)
        extra = abs(pushed.theta[LE] - fit.theta[LE])
        notes.append(
            f"the innovations are not white (correlation {max(whiteness.values()):.2f}): something moves the rod that "
            f"the model leaves out, friction or backlash; an unknown force on the rod changes L_e by "
            f"{100 * extra:.1f} %, which is taken for a standard deviation"
        )
    common = _common(fit, math.nan, False, False)
    value, deviation = common["effective_length"]
    relative = math.hypot(deviation / value, extra)
    reason = None
    if not fit.converged:
        reason = "the likelihood has no maximum: the angle does not follow the base; check signs, units and stamps"
    elif relative > LARGEST_PLANAR_SPREAD:
        reason = (
            f"L_e is known to {100 * relative:.0f} % only, not to {100 * LARGEST_PLANAR_SPREAD:.0f} %: "
            "record longer, move more, or find what else moves the rod"
        )
    elif not known.lengths[0] < 2.0 * fit.theta[R] < known.lengths[1]:
        reason = (
            f"the best length, {2.0 * fit.theta[R]:.3g} m, lies outside the interval from {known.lengths[0]:g} to "
            f"{known.lengths[1]:g} m: widen it, or check the sign of the angle"
        )
    if reason is not None:
        return PoseEstimate(
            noise=common["noise"], whiteness=whiteness, assumed=assumed, notes=tuple(notes), reason=reason
        )
    common["effective_length"] = Value(value, relative * value)
    common["uniform_length"] = Value(common["uniform_length"].value, relative * common["uniform_length"].value)
    length, deviation = _value(fit, lambda t: 2.0 * t[R])
    deviation = math.hypot(deviation, extra * length)
    half = 1.959964 * deviation
    return PoseEstimate(length, deviation, (length - half, length + half), **common, whiteness=whiteness,
                        assumed=assumed, notes=tuple(notes))  # fmt: skip


LEAST_QUANTA = 4.0
"""Refused where the rod's angle moves by fewer steps of its encoder than this (standard deviation)."""


def _quantum(values: NDArray) -> float:
    """Step of a quantised signal, 0 if it does not look quantised."""
    distinct = np.unique(np.round(values, 12))
    if len(distinct) > len(values) / 3:
        return 0.0
    return float(np.median(np.diff(distinct))) if len(distinct) > 1 else math.inf


def _without_jumps(vehicle: Body, rod: Body) -> tuple[Body, float, int]:
    """The rod without poses that lie elsewhere than the rod can be, the distance of both bodies, and how many."""
    place = np.column_stack([np.interp(rod.time, vehicle.time, column) for column in vehicle.position.T])
    distances = np.linalg.norm(rod.position - place, axis=1)
    distance = float(np.median(distances))
    # the rod turns against the vehicle, so the distance changes a little; a lost body is far away
    good = np.abs(distances - distance) < 0.1 * distance + 0.02
    kept = Body(rod.time[good], rod.position[good], None if rod.axis is None else rod.axis[good])
    return kept, float(np.median(distances[good])), int(np.sum(~good))


def _frames(vehicle: Body, rod: Body, distance: float) -> str | None:
    """Why the frames cannot be right, or None."""
    if distance > 20.0:
        return f"the two bodies are {distance:.0f} m apart: positions are in millimetres, it seems; divide them by 1000"
    if rod.position is not None and distance > 1e-3:
        place = np.column_stack([np.interp(rod.time, vehicle.time, column) for column in vehicle.position.T])
        along = np.median(rod.position - place, axis=0) / distance
        if along[2] < -0.7 and distance > SHORTEST_ARM:
            return "the rod is below the vehicle: the bodies are swapped, or z points down; swap them or turn the frame"
        if abs(along[2]) < 0.7 and distance > SHORTEST_ARM:
            axis = "xy"[int(np.argmax(np.abs(along[:2])))]
            return f"the rod stands along {axis}, not along z: turn the world's frame so that z points up"
    for body, name in ((vehicle, "vehicle"), (rod, "rod")):
        if body.axis is not None and float(np.median(body.axis[:, 2])) < 0.7:
            return (
                f"the {name}'s body z axis does not point up: check the order of its quaternion (x, y, z, w) and the "
                "frame of its body"
            )
    return None


def _answer(rows: Rows, knowledge: Knowledge, distance: float, flies: bool, notes: list[str]) -> PoseEstimate:
    """Fit the rows under what is assumed, check it, and put the answer together."""
    told = [k is not None for k in (knowledge.inertia_factor, knowledge.marker_offset)]
    tracked = bool(np.any(rows.kind == ROD))
    start = _start(rows, knowledge, distance, flies)

    def fit(inertia: Told, offset: Told) -> Fit:
        return _fit(rows, knowledge, distance, flies, start, inertia, offset)

    if told[0] or not tracked:
        best = fit(knowledge.inertia_factor or UNIFORM, knowledge.marker_offset or ANY_OFFSET)
        reading = "told" if told[0] else "uniform"
    else:
        best, reading = fit(knowledge.inertia_factor or ANY_INERTIA, knowledge.marker_offset or MIDDLE), "middle"
        factor, deviation = _value(best, inertia_factor_of)
        if not told[1] and abs(factor - UNIFORM.value) > LARGEST_DOUBT * math.hypot(deviation, UNIFORM.tolerance):
            uniform = fit(UNIFORM, ANY_OFFSET)
            if min(np.max(np.abs(_conflicts(one)[2:6])) for one in (best, uniform)) > LARGEST_CONFLICT:
                return _checked(best, reading, rows, knowledge, distance, flies, notes)
            gain = uniform.value - best.value
            if gain > LEAST_EVIDENCE:
                best, reading = uniform, "uniform"
            elif gain > -LEAST_EVIDENCE:
                return _ambiguous(best, uniform, rows, distance, flies, knowledge, notes)
            notes.append(f"the rod's {'middle' if reading == 'uniform' else 'inertia'} is not where a uniform rod "
                         "tracked at its middle has it; its reaction on the vehicle tells which")  # fmt: skip
    return _checked(best, reading, rows, knowledge, distance, flies, notes)


LARGEST_DOUBT = 2.6
"""Standard deviations between the two readings of the length from which on they disagree; 1 % by chance."""

LEAST_EVIDENCE = 4.5
"""Difference in log posterior from which one of two readings is believed: 3 standard deviations."""


def _start(rows: Rows, knowledge: Knowledge, distance: float, flies: bool) -> NDArray:
    """The best of a coarse grid over L_e, on the first 2.5 s."""
    first = int(np.searchsorted(rows.time, rows.time[0] + 2.5))
    part = Rows(*(column[:first] for column in rows))
    force = rows.value[rows.kind == TILT] if flies else None
    if force is not None:
        time = rows.time[rows.kind == TILT]
    else:
        time = rows.time[rows.kind == VEHICLE]
        force = parabolas(time, rows.value[rows.kind == VEHICLE], time, 0.05)[2]
    smooth = parabolas(time, force, time, 0.05)[0]
    later = np.minimum(np.searchsorted(time, time + 0.2), len(time) - 1)
    moved = np.mean((smooth[later] - smooth) ** 2)
    density = max(float(moved) / 0.1, 1e-6)
    lengths = np.geomspace(knowledge.lengths[0] / 3.0, knowledge.lengths[1], 16)
    lanes = np.zeros((16, len(PARAMETERS)))
    seat = knowledge.seat_height.value if flies else 0.0
    lanes[..., LE] = np.log(lengths)
    lanes[..., R] = 0.75 * lengths
    if math.isfinite(distance):
        lanes[..., OFFSET] = distance - seat - lanes[..., R]
    lanes[..., H] = lanes[..., HC] = seat
    lanes[..., MU] = knowledge.mass_ratio.value if flies else 0.0
    lanes[..., Q] = math.log(density)
    lanes[..., OMEGA], lanes[..., ZETA], lanes[..., ZERO] = _shape(knowledge)
    lanes[..., NV], lanes[..., NR] = (math.log(knowledge.noise[0]),) * 2
    lanes[..., NT], lanes[..., ND] = (math.log(knowledge.noise[1]),) * 2
    lanes[..., NF] = math.log(FORCE_FREE)
    return lanes[int(np.nanargmax(run(part, lanes).total))]


def _fit(
    rows: Rows,
    knowledge: Knowledge,
    distance: float,
    flies: bool,
    start: NDArray,
    inertia: Told,
    offset: Told,
    force: bool = False,
) -> Fit:
    tracked, seen = (bool(np.any(rows.kind == kind)) for kind in (ROD, DIRECTION))
    theta = start.copy()
    if tracked and offset.tolerance < 0.1:
        theta[R], theta[OFFSET] = max(theta[R] + theta[OFFSET] - offset.value, 0.02), offset.value
    if not tracked:
        theta[OFFSET] = 0.0
    theta[R] = max(theta[R], 0.02)
    free = [LE, R, Q, OMEGA, ZETA, ZERO, NV]
    free += [OFFSET, NR] if tracked else []
    free += [H, HC, MU, NT, LEVER] if flies else []
    free += [ND] if seen else []
    if force:
        free.append(NF)
        theta[NF] = math.log(0.1)
    free = np.array(sorted(free))
    k = knowledge
    position, attitude = (math.log(value) for value in k.noise)
    use = flies and tracked and math.isfinite(distance)
    priors = [inertia, offset if tracked else ANY_OFFSET, k.seat_height, k.com_height, k.mass_ratio]
    if not flies:
        priors[2:] = [Told(0.0, 1.0), Told(0.0, 1.0), Told(0.0, 1.0)]
    priors += [Told(distance, k.distance_tolerance) if use else Told(0.0, math.inf)]
    frequency, damping, zero = _shape(k)
    priors += [Told(start[Q], 3.0), Told(frequency, 1.0), Told(damping, 0.7), Told(zero, 1.0)]
    priors += [Told(position, 1.0), Told(attitude, 1.0)] * 2
    priors += [ORIGIN]
    means, tolerances = np.array(priors).T
    prior = Prior(means, np.maximum(tolerances, 1e-6))
    first = int(np.searchsorted(rows.time, rows.time[0] + LEAD))
    if first < len(rows.time) // 2:
        # a long flight: its first part brings the search close, two passes over all of it finish
        theta = maximise(Rows(*(column[:first] for column in rows)), theta, free, prior).theta
    return maximise(rows, theta, free, prior)


LEAD = 20.0
"""Length in s of the first part of a long flight, on which the search starts."""


def _shape(knowledge: Knowledge) -> tuple[float, float, float]:
    """Guesses of log omega, log zeta and log omega T: the corner of the rate loop, well damped."""
    return -math.log(knowledge.lag), math.log(0.6), math.log(0.7)


def _value(fit: Fit, function) -> Value:
    """A function of the parameters at the maximum, and its standard deviation to first order."""
    k = len(fit.free)
    lanes = np.tile(fit.theta, (k + 1, 1))
    lanes[1 + np.arange(k), fit.free] += STEP
    values = function(lanes.T)
    slope = (values[1:] - values[0]) / STEP
    return Value(float(values[0]), math.sqrt(max(float(slope @ fit.covariance @ slope), 0.0)))


def _common(fit: Fit, distance: float, flies: bool, tracked: bool) -> dict:
    """What both answers and refusals say of the rod."""
    values: dict = {
        "effective_length": _value(fit, lambda t: np.exp(t[LE])),
        "inertia_factor": _value(fit, inertia_factor_of),
        # 2 lambda kappa L_e with lambda = 3/4
        "uniform_length": _value(fit, lambda t: 1.5 * np.exp(t[LE]) / (1.0 - 0.75 * t[MU])),
    }
    if tracked:
        values["rod_point"] = _value(fit, lambda t: t[R] + t[OFFSET])
        values["middle_length"] = _value(fit, lambda t: 2.0 * (t[R] + t[OFFSET]))
    if flies:
        values["seat_height"] = _value(fit, lambda t: t[H])
        values["com_height"] = _value(fit, lambda t: t[HC])
    names = {"vehicle": NV, "rod": NR, "tilt": NT, "direction": ND}
    values["noise"] = {name: float(np.exp(fit.theta[i])) for name, i in names.items() if i in fit.free}
    if math.isfinite(distance):
        values["distance"] = Value(distance, _conflicts(fit)[5] if tracked and flies else math.nan)
    return values


def _conflicts(fit: Fit) -> NDArray:
    """Deviation of the posterior from each prior, over what it should be if the prior were right (15,).

    With prior variance V0 and posterior variance V, the posterior mean deviates from the prior's by V0 - V.
    """
    k = len(fit.free)
    lanes = np.tile(fit.theta, (k + 1, 1))
    lanes[1 + np.arange(k), fit.free] += STEP
    deviations = fit.prior.deviations(lanes)
    slopes = (deviations[1:] - deviations[0]) / STEP
    posterior = np.einsum("ji,jk,ki->i", slopes, fit.covariance, slopes)
    free = np.any(slopes != 0.0, axis=0) & np.isfinite(fit.prior.tolerances)
    # told far more tightly than the flight can tell: 1 - V / V0 is then lost to rounding
    return np.where(free, deviations[0] / np.sqrt(np.maximum(1.0 - posterior, 1e-6)), 0.0)


def _ambiguous(
    middle: Fit, uniform: Fit, rows: Rows, distance: float, flies: bool, knowledge: Knowledge, notes: list[str]
) -> PoseEstimate:
    common = _common(middle, distance, flies, True)
    a, b = 2.0 * middle.theta[R], 2.0 * uniform.theta[R]
    reason = (
        f"the rod's tracked point is not at its middle, or the rod is not uniform: it is {b:.3f} m long if it is "
        f"uniform, {a:.3f} m if it is tracked at its middle; say which by the inertia factor or the marker's offset"
    )
    return PoseEstimate(**common, notes=tuple(notes), reason=reason)


def _checked(
    fit: Fit, reading: str, rows: Rows, knowledge: Knowledge, distance: float, flies: bool, notes: list[str]
) -> PoseEstimate:
    """The answer, or the refusal that the first failed check gives."""
    tracked = bool(np.any(rows.kind == ROD))
    common = _common(fit, distance, flies, tracked)
    innovation = run(rows, fit.theta[None], innovations=True).innovation[:, :, 0]
    whiteness = {
        name: _correlation(innovation[rows.kind == kind])
        for kind, name in enumerate(KINDS)
        if np.any(rows.kind == kind)
    }
    length, deviation = _value(fit, lambda t: 2.0 * t[R])
    conflicts = _conflicts(fit)[: len(TOLD)]
    worst = int(np.argmax(np.abs(conflicts)))
    jump, when = _largest_jump(rows.time, innovation)
    noise = {"vehicle": 0, "rod": 0, "tilt": 1, "direction": 1}
    loud = max(common["noise"], key=lambda name: common["noise"][name] / knowledge.noise[noise[name]])
    least, most = knowledge.lengths
    reason = None
    if not (fit.converged and math.isfinite(length) and np.all(np.isfinite(fit.covariance))):
        reason = "the likelihood has no maximum: the two bodies do not move as a vehicle and its rod; check the frames"
    elif jump > LARGEST_JUMP:
        reason = (
            f"the rod or the vehicle moves at {when:.1f} s as nothing in the model does (squared innovations "
            f"{jump:.1f} times as large as expected): it was pushed or mistracked; leave that stretch out"
        )
    elif (
        abs(conflicts[worst]) > LARGEST_CONFLICT
        and (knowledge.inertia_factor, knowledge.marker_offset, 1)[min(worst, 2)] is None
    ):
        reason = (
            f"the rod's tracked point is not at its middle, or the rod is not uniform: the flight contradicts both by "
            f"{abs(conflicts[worst]):.0f} standard deviations; say which by the inertia factor or the marker's offset"
        )
    elif abs(conflicts[worst]) > LARGEST_CONFLICT:
        means, tolerances = fit.prior.means[worst], fit.prior.tolerances[worst]
        reason = (
            f"the flight contradicts the {TOLD[worst]} {means:.3f} +- {tolerances:.3f} by {abs(conflicts[worst]):.0f} "
            "standard deviations: measure it again, or state a wider tolerance"
        )
    elif common["noise"][loud] > LARGEST_NOISE * knowledge.noise[noise[loud]]:
        reason = (
            f"the {loud}'s noise comes out {common['noise'][loud] / knowledge.noise[noise[loud]]:.0f} times as large "
            "as stated: the model does not explain the motion; check the frames and the stamps, or state the noise"
        )
    elif max(whiteness.values()) > LARGEST_CORRELATION:
        name = max(whiteness, key=whiteness.__getitem__)
        reason = (
            f"the innovations of the {name} are not white (correlation {whiteness[name]:.2f}): the model does not "
            "explain the motion; check the frames, the stamps and whether the rod stands freely in its seat"
        )
    elif not least < length < most:
        reason = f"the best length, {length:.2f} m, lies outside the interval from {least:g} to {most:g} m: widen it"
    elif deviation > LARGEST_SPREAD * length:
        reason = (
            f"too little excitation: the standard deviation is {100 * deviation / length:.0f} % of the length, not "
            f"below {100 * LARGEST_SPREAD:.0f} %; record longer, or move more"
        )
    assumed = _assumptions(fit, reading, knowledge, flies, tracked, distance)
    if reason is not None:
        return PoseEstimate(
            whiteness=whiteness, noise=common["noise"], assumed=assumed, notes=tuple(notes), reason=reason
        )
    half = 1.959964 * deviation
    return PoseEstimate(
        length, deviation, (length - half, length + half), **common, whiteness=whiteness, assumed=assumed,
        notes=tuple(notes),
    )  # fmt: skip


def _correlation(innovation: NDArray, lags: int = 10) -> float:
    """Largest autocorrelation in absolute value of standardised innovations (n, axes) at lags of 1 to 10 rows."""
    skip = min(len(innovation) // 8, 30)  # the first rows only find the state
    values = innovation[skip:]
    power = float(np.mean(values**2))
    return max(abs(float(np.mean(values[lag:] * values[:-lag]))) / power for lag in range(1, lags + 1))


def _largest_jump(time: NDArray, innovation: NDArray) -> tuple[float, float]:
    """The largest mean squared innovation over ``JUMP_SPAN`` s, after the first tenth of a second, and its time."""
    power = np.mean(innovation**2, axis=1)
    total = np.concatenate([[0.0], np.cumsum(power)])
    ends = np.searchsorted(time, time + JUMP_SPAN)
    counts = ends - np.arange(len(time))
    fair = (counts >= max(8, int(np.median(counts)) // 2)) & (time > time[0] + 0.1)
    if not np.any(fair):
        return 0.0, 0.0
    means = np.where(fair, (total[ends] - total[:-1]) / np.maximum(counts, 1), 0.0)
    at = int(np.argmax(means))
    return float(means[at]), float(time[at] - time[0])


def _assumptions(
    fit: Fit, reading: str, knowledge: Knowledge, flies: bool, tracked: bool, distance: float
) -> tuple[str, ...]:
    means, tolerances = fit.prior.means, fit.prior.tolerances
    said = {
        "told": f"the rod's inertia factor is {means[0]:.3f} +- {tolerances[0]:.3f}",
        "uniform": f"the rod is uniform: its inertia factor is {means[0]:.3f} +- {tolerances[0]:.3f}",
        "middle": f"the rod's tracked point is {1e3 * means[1]:.0f} +- {1e3 * tolerances[1]:.0f} mm from its middle",
    }
    sentences = [said[reading]]
    if flies:
        sentences += [
            f"the seat is {1e3 * means[2]:.0f} +- {1e3 * tolerances[2]:.0f} mm above the vehicle's tracked point",
            f"the vehicle's centre of mass is {1e3 * means[3]:.0f} +- {1e3 * tolerances[3]:.0f} mm above that point",
            f"the rod has {means[4]:.3f} +- {tolerances[4]:.3f} of the mass of rod and vehicle",
        ]
        if tracked and math.isfinite(tolerances[5]):
            sentences.append(
                f"both tracked points lie on their axes: their distance is {distance:.3f} +- {tolerances[5]:.3f} m"
            )
    else:
        sentences.append("the base moves as it is driven, whatever the rod does")
    return tuple(sentences)


class Stream:
    """The estimate of a flight that goes on: poses are added as they arrive, at a constant cost each.

    The filter of a first window's maximum and of its neighbours runs on, and so do the score and the Fisher
    information; one Newton step from that maximum then gives the maximum for all poses so far. The checks that
    ``estimate`` makes are not repeated here.

    Args:
        vehicle, rod: the first window, 2.5 s or more; see ``estimate``.
        knowledge: priors. The rod is taken to be tracked at its middle unless ``marker_offset`` says otherwise.

    Raises:
        ValueError: the first window does not give an estimate; the message says why.
    """

    def __init__(self, vehicle: Body, rod: Body, knowledge: Knowledge | None = None) -> None:
        knowledge = knowledge or Knowledge()
        first = estimate(vehicle, rod, knowledge)
        if first.reason is not None:
            raise ValueError(first.reason)
        flies = vehicle.axis is not None
        self._bodies = [_cleaned(vehicle), _cleaned(rod)]
        self._origin = self._bodies[0].position[0]
        rows = rows_of(*self._bodies, self._origin)
        start = _start(rows, knowledge, first.distance.value, flies)
        inertia = knowledge.inertia_factor or (ANY_INERTIA if rod.position is not None else UNIFORM)
        offset = knowledge.marker_offset or (MIDDLE if rod.position is not None else ANY_OFFSET)
        self._fit = _fit(rows, knowledge, first.distance.value, flies, start, inertia, offset)
        k = len(self._fit.free)
        self._lanes = np.tile(self._fit.theta, (k + 1, 1))
        self._lanes[1 + np.arange(k), self._fit.free] += STEP
        deviations = self._fit.prior.deviations(self._lanes)
        slopes = (deviations[1:] - deviations[0]) / STEP
        self._score = -slopes @ deviations[0]
        self._information = slopes @ slopes.T
        self._state = _State.at(rows.time[0], -(-(k + 1) // 16) * 16, 2)
        self._done = -math.inf
        self.push(Body(np.zeros(0)), Body(np.zeros(0)))

    def push(self, vehicle: Body, rod: Body) -> None:
        """Add poses, later than all before. They count once 0.15 s more have come, which smoothing needs."""
        for which, body in enumerate((vehicle, rod)):
            if len(body.time):
                columns = zip(self._bodies[which], body, strict=True)
                self._bodies[which] = Body(*(None if a is None else np.concatenate([a, b]) for a, b in columns))
        until = min(body.time[-1] for body in self._bodies) - SMOOTHED
        rows = rows_of(*self._bodies, self._origin)
        fresh = (rows.time > self._done) & (rows.time <= until)
        if np.any(fresh):
            out = run(Rows(*(column[fresh] for column in rows)), self._lanes, np.full(len(self._fit.free), STEP),
                      state=self._state)  # fmt: skip
            self._score += out.score
            self._information += out.fisher
            self._done = until
        # what smoothing needs of the past
        kept = [body.time > self._done - 2.0 * SMOOTHED for body in self._bodies]
        self._bodies = [
            Body(*(None if column is None else column[keep] for column in body))
            for body, keep in zip(self._bodies, kept, strict=True)
        ]

    @property
    def length(self) -> Value:
        """The length in m for all poses so far, and its standard deviation."""
        scale = 1.0 / np.sqrt(np.diag(self._information))
        covariance = np.linalg.inv(self._information * np.outer(scale, scale)) * np.outer(scale, scale)
        step = covariance @ self._score
        at = int(np.flatnonzero(self._fit.free == R)[0])
        return Value(2.0 * float(self._fit.theta[R] + step[at]), 2.0 * math.sqrt(covariance[at, at]))


SMOOTHED = 0.15
"""Half of the longest span of smoothing, s."""
