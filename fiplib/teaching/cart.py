"""A simulated cart that balances a rod, seen by two encoders: what an estimator on a cart or a rotary arm is given."""

import math

import numpy as np
from numpy.typing import NDArray

from fiplib.params import GRAVITY

STEP, PERIOD = 1e-3, 10
"""Integration step in s, and steps between two samples."""

GAINS = (40.0, 8.0, 2.0, 3.0)
"""Of the controller: angle, its rate, position, speed."""

SHAKING = 4.0
"""Standard deviation of the controller's noise, m/s^2: without it nothing moves."""


def simulated_cart(
    rng: np.random.Generator,
    effective_length: float = 0.4,
    seconds: float = 20.0,
    angle_step: float = 2 * math.pi / 4096,
    position_step: float = 1e-4,
) -> tuple[NDArray, NDArray, NDArray]:
    """Return times in s, the position of the rod's pivot in m and the rod's angle in rad, 100 samples a second.

    The angle is positive towards positive positions; both are rounded to the steps of their encoders. No friction.
    """
    base = speed = angle = rate = push = 0.0
    rows = []
    for index in range(round(seconds / STEP)):
        if index % PERIOD == 0:
            rows.append((index * STEP, base, angle))
            push = float(np.dot(GAINS, (angle, rate, base, speed))) + SHAKING * rng.normal()
        rate += STEP * (GRAVITY * math.sin(angle) - push * math.cos(angle)) / effective_length
        angle += STEP * rate
        speed += STEP * push
        base += STEP * speed
    time, base_position, angles = np.array(rows).T
    return time, np.round(base_position / position_step) * position_step, np.round(angles / angle_step) * angle_step
