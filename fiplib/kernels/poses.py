"""Frames of motion capture, simulated from the plant's state."""

import math

import numpy as np
from numpy.typing import NDArray

from fiplib.kernels.compiling import compiled


@compiled()
def single(value: float) -> float:
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
    return single(x / norm), single(y / norm), single(z / norm), single(w / norm)


@compiled()
def along_z(q: NDArray, first: int, height: float) -> tuple:
    """``height`` times the body's z axis of the quaternion at ``first``."""
    x, y, z, w = q[first], q[first + 1], q[first + 2], q[first + 3]
    return (
        height * (2.0 * (x * z + w * y)),
        height * (2.0 * (y * z - w * x)),
        height * (1.0 - 2.0 * (x * x + y * y)),
    )


@compiled("void(f8[::1], f8, f8, f8[::1], f8[::1])")
def expose(x: NDArray, radius: float, seat: float, noise: NDArray, frame: NDArray) -> None:
    """Write a frame of motion capture (14,): position and attitude of the vehicle, then of the rod.

    Args:
        x: the plant's state.
        radius: half the rod's length in m.
        seat: its height above the vehicle's tracked point in m.
        noise: of both positions in m, then of both attitudes in rad, (12,).
        frame: numbers that single precision can hold.
    """
    below = along_z(x, 6, seat)
    for n in range(3):
        tracked = x[n] - below[n] if seat > 0.0 else x[n]
        frame[n] = single(tracked + noise[n])
        frame[7 + n] = single(x[n] + radius * x[10 + n] + noise[3 + n])
    frame[3], frame[4], frame[5], frame[6] = _turned((x[6], x[7], x[8], x[9]), noise, 6)
    # shortest rotation that takes the z axis to the rod's direction
    scale = math.sqrt(2.0 * (1.0 + x[12]))
    upright = (-x[11] / scale, x[10] / scale, 0.0, (1.0 + x[12]) / scale)
    frame[10], frame[11], frame[12], frame[13] = _turned(upright, noise, 9)


@compiled()
def euler_angles(q: NDArray, first: int) -> tuple:
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
    truth[8], truth[9], _ = euler_angles(x, 6)
    truth[10] = x[2]
