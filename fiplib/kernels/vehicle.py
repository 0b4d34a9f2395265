"""The simulated vehicle; ``dynamics.coupled_plant`` is the readable one."""

import math

import numpy as np
from numpy.typing import NDArray

from fiplib.kernels.compiling import compiled
from fiplib.params import GRAVITY, Params

FALLEN = math.cos(math.radians(60.0))
"""A rod or a vehicle that leans further than 60 degrees is not coming back."""


def plant_constants(params: Params) -> NDArray:
    """Return the constants of plant and motion capture, (11,).

    They are the masses of vehicle and rod in kg, half the rod's length in m, its ``inertia_factor``, the lags of rates
    and thrust and the plant's step in s, and the height of the seat above the vehicle's centre of mass and above the
    point that motion capture tracks, m; the drag of vehicle and rod in N s/m.

    Raises:
        ValueError: parameters that contradict each other: the plant cannot be integrated, or its rod does not stand.
    """
    vehicle, pendulum, simulation = params.vehicle, params.pendulum, params.simulation
    masses, lags = (vehicle.mass, pendulum.mass), (simulation.rate_lag, simulation.thrust_lag)
    rod, seats = (pendulum.length / 2, pendulum.inertia_factor), (vehicle.seat_height, params.seat_above_tracked)
    frames = simulation.plant_rate / params.piloting.mocap_rate
    if not math.isclose(frames, max(1, round(frames)), rel_tol=1e-9):
        raise ValueError(
            "simulation.plant_rate must be a whole multiple of piloting.mocap_rate, not "
            f"{simulation.plant_rate:g} and {params.piloting.mocap_rate:g} Hz"
        )
    if min(lags) * simulation.plant_rate < 0.4:  # RK4 is stable for steps up to 2.78 lags
        raise ValueError(
            "simulation.rate_lag and thrust_lag must be at least 0.4 / simulation.plant_rate = "
            f"{0.4 / simulation.plant_rate:.3g} s, not {lags[0]:g} and {lags[1]:g} s"
        )
    if simulation.initial_lean > pendulum.length / 12:  # six standard deviations are half the rod
        raise ValueError(
            "simulation.initial_lean must be at most pendulum.length / 12 = "
            f"{pendulum.length / 12:.3g} m, not {simulation.initial_lean:g} m"
        )
    return np.array((*masses, *rod, *lags, 1.0 / simulation.plant_rate, *seats, *simulation.drag))


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
    blown = len(force) > 3 and force[3] == force[3]
    if blown:  # the rod's drag at its COM
        f = (
            f[0] + about[10] * (force[3] - x[3] - radius * x[13]),
            f[1] + about[10] * (force[4] - x[4] - radius * x[14]),
            f[2] - about[10] * (x[5] + radius * x[15]),
        )
    f_across = _across(f, q)
    a, b, c = x[16], x[17], x[18]
    total = (
        thrust * body_z[0] + f[0] + outward * q[0] - factor * f_across[0],
        thrust * body_z[1] + f[1] + outward * q[1] - factor * f_across[1],
        thrust * body_z[2] + f[2] + outward * q[2] - factor * f_across[2],
    )
    if blown:
        total = (
            total[0] + about[9] * (force[3] - x[3]),
            total[1] + about[9] * (force[4] - x[4]),
            total[2] - about[9] * x[5],
        )
    if about[7] > 0.0:  # the seat's share, m h e''; without it not an operation changes
        push = m * about[7]
        u, v, z = a * c + (command[1] - b) / rate_lag, b * c - (command[0] - a) / rate_lag, -(a * a + b * b)
        t = (2.0 * (j * z - k * v), 2.0 * (k * u - i * z), 2.0 * (i * v - j * u))
        total = (
            total[0] + push * (u + w * t[0] + (j * t[2] - k * t[1])),
            total[1] + push * (v + w * t[1] + (k * t[0] - i * t[2])),
            total[2] + push * (z + w * t[2] + (i * t[1] - j * t[0])),
        )
    total_across, share = _across(total, q), m_p * factor / (m + m_p * (1.0 - factor))
    alpha = (
        (total[0] + share * total_across[0]) / (m + m_p),
        (total[1] + share * total_across[1]) / (m + m_p),
        (total[2] + share * total_across[2]) / (m + m_p),
    )
    pull = _across((alpha[0] - f[0] / m_p, alpha[1] - f[1] / m_p, alpha[2] - f[2] / m_p), q)
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
        force: on the rod's COM, (3,) in N; or a load, ``disturbance.SIZE`` numbers, without wind if that is nan.
        about: ``plant_constants``.
    """
    step = about[6]
    k1, k2, k3, k4, at = np.empty(20), np.empty(20), np.empty(20), np.empty(20), np.empty(20)
    given = np.empty(4)
    for row in range(len(commands)):
        command = commands[row]
        if len(force) > 3:  # before the loop's lag: the same as an offset of the rate itself
            for n in range(4):
                given[n] = command[n]
            given[0] += force[5]
            given[1] += force[6]
            given[3] *= force[7]
            command = given
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
