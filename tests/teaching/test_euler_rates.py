"""The map from body rates to Euler rates, against SciPy's rotations."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fiplib.teaching.euler_rates import euler_rate_map, printed_euler_rate_map


def full(value) -> np.ndarray:
    return np.asarray(value, dtype=float).squeeze()


def test_the_consistent_euler_rate_map_belongs_to_the_stated_rotation_and_the_printed_one_does_not():
    rng = np.random.default_rng(4)
    angles, body_rate, step = np.array([0.4, -0.5, 0.3]), rng.normal(size=3), 1e-6

    def moved(sign: float) -> np.ndarray:
        turned = Rotation.from_euler("XYZ", angles) * Rotation.from_rotvec(sign * step * body_rate)
        return turned.as_euler("XYZ")

    measured = (moved(1) - moved(-1)) / (2 * step)
    assert full(euler_rate_map()(angles, body_rate)) == pytest.approx(measured, abs=1e-9)
    assert np.abs(full(printed_euler_rate_map()(angles, body_rate)) - measured).max() > 0.1
    small = 1e-4 * angles  # both agree to first order: the difference falls with the angle
    difference = full(printed_euler_rate_map()(small, body_rate) - euler_rate_map()(small, body_rate))
    assert np.abs(difference).max() < 10 * np.abs(small).max()
