"""Solutions of the exercises in 07-explore-a-bag."""

import numpy as np


def velocities(stamp, position):
    seconds = np.diff(stamp) / 1e9
    return np.diff(position, axis=0) / seconds[:, None]


def length_from_lean(offset, tilt):
    return 2 * np.sum(offset * tilt) / np.sum(tilt**2)


def fresh(stamp, position):
    keep = np.full(len(stamp), True)
    keep[1:] = (np.diff(stamp) > 0) & (np.diff(position, axis=0) != 0).any(axis=1)
    return keep
