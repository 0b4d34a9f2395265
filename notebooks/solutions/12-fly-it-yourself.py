"""Solutions of the open exercises in 12-fly-it-yourself: one way of many."""

import functools

import control
import numpy as np

from fiplib.params import AXES, GRAVITY


@functools.cache
def gain(length):
    """LQR gain of one axis, z = (s, s', d, d', tilt).

    s'' = g tilt, d'' = 2 g d / l - g tilt, tilt' = u
    """
    a = np.zeros((5, 5))
    a[0, 1] = a[2, 3] = 1.0
    a[1, 4], a[3, 2], a[3, 4] = GRAVITY, 2 * GRAVITY / length, -GRAVITY
    return control.lqr(a, np.eye(5)[:, 4:], np.diag([20.0, 5.0, 0.0, 0.0, 1.0]), 5.0)[
        0
    ][0]


def controller(state, reference, length):
    rates = np.zeros(2)
    for axis in AXES:
        z = (
            np.asarray(state)[list(axis.states)]
            - np.asarray(reference)[0, list(axis.states)]
        )
        z[4] *= axis.sign
        rates[axis.input] = -axis.sign * gain(length) @ z
    return rates


def estimator(window):
    """d'' + g tilt = (1/l) 2 g d, integrated over 0.8 s: 1/l is a slope."""
    n, (d, d_dot, tilt) = 8, (window.states[:, i] for i in ([4, 6], [5, 7], [9, 8]))
    tilt = tilt * [1.0, -1.0]
    kernel = np.r_[0.5, np.ones(n - 1), 0.5] * window.step
    integral = [
        np.array([np.convolve(c, kernel, "valid") for c in y.T]) for y in (d, tilt)
    ]
    x, y = 2 * GRAVITY * integral[0], (d_dot[n:] - d_dot[:-n]).T + GRAVITY * integral[1]
    slope = np.sum(x * y) / np.sum(x * x)
    deviation = np.sqrt(n * np.mean((y - slope * x) ** 2) / np.sum(x * x))
    return 1 / slope, deviation / slope**2
