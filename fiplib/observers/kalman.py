"""A Kalman filter of the MPC's prediction model, each axis by itself.

The specific thrust u is a random walk that the tilt measures; white forces act on vehicle and rod besides. No position
is differentiated: the rod's acceleration follows from the rod's offset and the vehicle's tilt, so that little of the
noise that differentiation amplifies remains.

The forces do two things. The rod's: a length that is not the rod's own shows as a force, and the less of it the filter
expects, the more it trusts its model; with a hundredth of ours commands are half as large, and 1.3 m in use for a
rod of 1 m ends in a fall, which 1.4 m does not with ours (the study ``observers``). The vehicle's: a body frame that is
turned against the thrust shows as a force; with half a degree and none expected, the vehicle hovers three times as far
from its place.

The covariance is that of the frames that have arrived, at the stamps that they have, with the length in use: frames
lost or late, a new length and the start need no treatment of their own, and its sums, which run in one order, give the
same bits on every computer. After a second of frames at one rate the gain is the steady one (``linear``).
"""

import numpy as np
from numpy.typing import NDArray

from fiplib.kernels import observing
from fiplib.observers import LinearObserver, Observer
from fiplib.params import GRAVITY, Params


def describe(params: Params, constants: NDArray) -> None:
    """Write its constants, as ``kernels.observing`` orders them."""
    piloting = params.piloting
    constants[observing.KIND] = observing.KALMAN
    constants[[observing.POSITION_NOISE, observing.ATTITUDE_NOISE]] = piloting.measurement_deviations
    constants[observing.THRUST], constants[observing.FORCE] = piloting.thrust_density, piloting.force_density


def linear(params: Params, length: float) -> LinearObserver:
    """Return one axis with the gain in which the filter settles; z is (p, p', u, u', o, o') of ``observing.model``."""
    from scipy.linalg import solve_discrete_are  # longer to import than all of ours

    constants = Observer(params).constants
    transition, noise = np.empty((2, observing.STATES, observing.STATES))
    observing.model(length, 1.0 / params.piloting.mocap_rate, constants, transition, noise)
    lever = constants[observing.SEAT] / GRAVITY
    measured = np.zeros((3, observing.STATES))  # rows of vehicle, rod and tilt
    measured[[0, 1, 1], [0, 0, 4]], measured[2, 2] = 1.0, 1.0 / GRAVITY
    position, attitude = constants[[observing.POSITION_NOISE, observing.ATTITUDE_NOISE]]
    variances = np.diag(np.square([position, position, attitude]))
    covariance = solve_discrete_are(transition.T, measured.T, noise, variances)
    gain = np.linalg.solve(measured @ covariance @ measured.T + variances, measured @ covariance).T
    seen = np.zeros((5, observing.STATES))
    seen[range(4), [0, 1, 4, 5]] = 1.0
    seen[[0, 2], 2] = seen[[1, 3], 3] = lever, -lever
    seen[4, 2] = 1.0 / GRAVITY
    kept = (np.eye(observing.STATES) - gain @ measured) @ transition
    return LinearObserver(kept, gain, seen, np.zeros((5, 3)))
