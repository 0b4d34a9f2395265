"""The paper's observer (section 3): positions differentiated, then low-pass filtered (first order)."""

import math

import numpy as np
from numpy.typing import NDArray

from fiplib.kernels import observing
from fiplib.observers import LinearObserver
from fiplib.params import Params


def describe(params: Params, constants: NDArray) -> None:
    """Write its constants, as ``kernels.observing`` orders them; the cut-off frequency is there already."""
    constants[observing.KIND] = observing.DIFFERENTIATE


def linear(params: Params, length: float) -> LinearObserver:
    """Return one axis: z is (s, d, s', d')."""
    rate, seat = params.piloting.mocap_rate, params.piloting.seat_height
    share = 1.0 - math.exp(-2.0 * math.pi * params.piloting.velocity_cutoff / rate)
    a, b, c, d = np.zeros((4, 4)), np.zeros((4, 3)), np.zeros((5, 4)), np.zeros((5, 3))
    b[:2] = (1.0, 0.0, seat), (-1.0, 1.0, -seat)
    a[[2, 3], [0, 1]], b[2:] = -share * rate, share * rate * b[:2]
    a[[2, 3], [2, 3]] = 1.0 - share
    c[[0, 2, 1, 3], [0, 1, 2, 3]] = 1.0
    d[4, 2] = 1.0
    return LinearObserver(a, b, c, d)
