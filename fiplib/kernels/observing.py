"""From frames of motion capture to the states of the controller: the two observers of ``fiplib.observers``."""

import math

import numpy as np
from numpy.typing import NDArray

from fiplib.kernels.compiling import compiled
from fiplib.kernels.poses import along_z, euler_angles
from fiplib.params import GRAVITY

DIFFERENTIATE, KALMAN = 0.0, 1.0

KIND, DIRECTION, SEAT, CUTOFF, POSITION_NOISE, ATTITUDE_NOISE, THRUST, FORCE = range(8)
"""Order of an observer's constants: which observer; whether (a, b) are the rod's direction times half the length; the
seat's height above the vehicle's tracked point in m; the low-pass filter's cut-off in Hz; standard deviations of
positions in m and attitudes in rad; the densities of the specific thrust's random walk in m^2/s^5 and of specific
forces in m^2/s^3."""

STATES = 6
"""States of the Kalman filter for an axis: p, p', u, u', o, o' (``model``)."""

MEMORY = 3 + 2 * STATES + STATES * STATES
"""Numbers that an observer remembers: whether there was a frame, height, climb rate; two axes' states; a covariance."""

RATE_LAG = 0.02
"""s; body rates follow commands with a lag of 9 to 15 ms. Half or twice of it changes rate commands by 2 %."""

LONGEST_STEP = 1e-2
"""Longest step of the prediction, s: its series is right to 1e-8 of the fastest term."""

LONGEST_GAP = 1.0
"""After so many seconds without a frame, what was predicted says nothing any more: the filter begins anew."""


@compiled()
def _differentiate(position: tuple, elapsed: float, share: float, memory: NDArray, observed: NDArray) -> None:
    for n in range(4):
        if elapsed > 0.0:
            memory[7 + n] += share * ((position[n] - memory[3 + n]) / elapsed - memory[7 + n])
        memory[3 + n] = position[n]
        observed[2 * n], observed[2 * n + 1] = memory[3 + n], memory[7 + n]


@compiled("void(f8, f8, f8[::1], f8[:,::1], f8[:,::1])")
def model(length: float, step: float, about: NDArray, transition: NDArray, noise: NDArray) -> None:
    """Write transition (6, 6) and process noise (6, 6) of the Kalman filter for a step in s.

    It is the MPC's prediction model: a point mass on a vehicle that does not feel it. With p the vehicle, u its
    specific thrust, o from vehicle to rod, h the seat's height and n white noises,

        p'' = u + n_1,    u'' = (n_2 - u') / RATE_LAG,    o'' = (2 g / l) (o - (h / g) u) - u + n_3.

    Noise comes as one impulse in the middle of the step.
    """
    pull, lever, t = 2.0 * GRAVITY / length, about[SEAT] / GRAVITY, step / 2.0
    half = np.eye(STATES)
    for column in range(STATES):
        p, v, u = half[0, column], half[1, column], half[2, column]
        w, o, b = half[3, column], half[4, column], half[5, column]
        for order in range(1, 9):
            share = t / order
            p, v, u, w, o, b = (
                share * v,
                share * u,
                share * w,
                -share * w / RATE_LAG,
                share * b,
                share * (pull * (o - lever * u) - u),
            )
            half[0, column] += p
            half[1, column] += v
            half[2, column] += u
            half[3, column] += w
            half[4, column] += o
            half[5, column] += b
    thrust = about[THRUST] / (RATE_LAG * RATE_LAG)
    for i in range(STATES):
        for j in range(STATES):
            total = 0.0
            for k in range(STATES):
                total += half[i, k] * half[k, j]
            transition[i, j] = total
            forces = half[i, 1] * half[j, 1] + half[i, 5] * half[j, 5]
            noise[i, j] = step * (about[FORCE] * forces + thrust * half[i, 3] * half[j, 3])


@compiled()
def _predict(length: float, elapsed: float, about: NDArray, x: NDArray, p: NDArray) -> None:
    """Move the states of both axes (2, 6) and their covariance (6, 6)."""
    transition, noise, half = np.empty((STATES, STATES)), np.empty((STATES, STATES)), np.empty((STATES, STATES))
    moved = np.empty(STATES)
    steps = math.ceil(elapsed / LONGEST_STEP)
    model(length, elapsed / steps, about, transition, noise)
    for _ in range(steps):
        for axis in range(2):
            for i in range(STATES):
                moved[i] = 0.0
                for k in range(STATES):
                    moved[i] += transition[i, k] * x[axis, k]
            x[axis] = moved
        for i in range(STATES):
            for j in range(STATES):
                half[i, j] = 0.0
                for k in range(STATES):
                    half[i, j] += transition[i, k] * p[k, j]
        for i in range(STATES):
            for j in range(i + 1):
                total = noise[i, j]
                for k in range(STATES):
                    total += half[i, k] * transition[j, k]
                p[i, j] = p[j, i] = total


@compiled()
def _update(row: tuple, values: tuple, variance: float, x: NDArray, p: NDArray) -> None:
    """Take one measured row for both axes: its coefficients of (p, u, o), its values, its noise's variance."""
    ph = np.empty(STATES)
    for i in range(STATES):
        ph[i] = row[0] * p[i, 0] + row[1] * p[i, 2] + row[2] * p[i, 4]
    total = row[0] * ph[0] + row[1] * ph[2] + row[2] * ph[4] + variance
    for axis in range(2):
        expected = row[0] * x[axis, 0] + row[1] * x[axis, 2] + row[2] * x[axis, 4]
        innovation = (values[axis] - expected) / total
        for i in range(STATES):
            x[axis, i] += ph[i] * innovation
    for i in range(STATES):
        for j in range(i + 1):
            p[i, j] -= ph[i] * ph[j] / total
            p[j, i] = p[i, j]


@compiled()
def _filter(
    frame: NDArray,
    offset: tuple,
    place: tuple,
    phi: float,
    theta: float,
    length: float,
    elapsed: float,
    about: NDArray,
    memory: NDArray,
    observed: NDArray,
) -> None:
    x = memory[3 : 3 + 2 * STATES].reshape((2, STATES))
    p = memory[3 + 2 * STATES :].reshape((STATES, STATES))
    lever = about[SEAT] / GRAVITY
    # of the direction in which the thrust acts, e_x / e_z and e_y / e_z; thrust carries the weight
    thrust = GRAVITY * math.tan(theta) / math.cos(phi), -GRAVITY * math.tan(phi)
    across, turned = about[POSITION_NOISE] ** 2, (GRAVITY * about[ATTITUDE_NOISE]) ** 2
    if memory[0] == 0.0 or elapsed > LONGEST_GAP:
        x[:], p[:] = 0.0, 0.0
        for axis in range(2):
            x[axis, 0], x[axis, 2] = frame[axis], thrust[axis]
            x[axis, 4] = offset[axis] + (place[axis] - frame[axis])
        # what a vehicle may do when it is first seen: 1 m/s, 0.3 rad/s, its rod 0.5 m/s
        p[0, 0], p[1, 1], p[2, 2] = across, 1.0, turned
        p[3, 3], p[4, 4], p[5, 5] = (0.3 * GRAVITY) ** 2, 2.0 * across + lever * lever * turned, 0.25
    elif elapsed > 0.0:
        _predict(length, elapsed, about, x, p)
        _update((1.0, 0.0, 0.0), (frame[0], frame[1]), across, x, p)
        _update((0.0, 1.0, 0.0), thrust, turned, x, p)
        if about[DIRECTION] > 0.0:
            _update((0.0, -lever, 1.0), offset, (length / 2.0 * about[ATTITUDE_NOISE]) ** 2, x, p)
        else:
            _update((1.0, 0.0, 1.0), (frame[7], frame[8]), across, x, p)
    along = about[SEAT] / math.sqrt(GRAVITY * GRAVITY + x[0, 2] * x[0, 2] + x[1, 2] * x[1, 2])
    for axis in range(2):
        tilt, turning = along * x[axis, 2], lever * x[axis, 3]
        observed[2 * axis], observed[2 * axis + 1] = x[axis, 0] + tilt, x[axis, 1] + turning
        observed[4 + 2 * axis], observed[5 + 2 * axis] = x[axis, 4] - tilt, x[axis, 5] - turning
    observed[8] = math.atan(-x[1, 2] / GRAVITY)
    observed[9] = math.atan(x[0, 2] / GRAVITY * math.cos(observed[8]))


@compiled("void(f8[::1], f8, f8, f8[::1], f8[::1], f8[::1])")
def observe(frame: NDArray, length: float, elapsed: float, about: NDArray, memory: NDArray, observed: NDArray) -> None:
    """Write the states (10,), then height in m, climb rate in m/s and yaw in rad; positions are those of the seat.

    Args:
        frame: (14,), as ``poses.expose`` writes it.
        length: the one in use, m.
        elapsed: since the last frame in s; at 0 and below velocities stay as they are.
        about: constants (8,), from ``KIND`` to ``FORCE``.
        memory: (``MEMORY``,); zeros at first.
        observed: (13,).
    """
    phi, theta, psi = euler_angles(frame, 3)
    place = (frame[0], frame[1], frame[2])
    if about[SEAT] > 0.0:
        above = along_z(frame, 3, about[SEAT])
        place = (frame[0] + above[0], frame[1] + above[1], frame[2] + above[2])
    a, b = frame[7] - place[0], frame[8] - place[1]
    if about[DIRECTION] > 0.0:
        x, y, z, w = frame[10], frame[11], frame[12], frame[13]
        a, b = length * (x * z + w * y), length * (y * z - w * x)
    share = 1.0 - math.exp(-2.0 * math.pi * about[CUTOFF] * elapsed)
    if elapsed > 0.0:
        memory[2] += share * ((place[2] - memory[1]) / elapsed - memory[2])
    memory[1] = place[2]
    observed[10], observed[11], observed[12] = memory[1], memory[2], psi
    if about[KIND] == KALMAN:
        _filter(frame, (a, b), place, phi, theta, length, elapsed, about, memory, observed)
    else:
        _differentiate((place[0], place[1], a, b), elapsed, share, memory, observed)
        observed[8], observed[9] = phi, theta
    memory[0] = 1.0
