"""How two tracked bodies move, for checks: tilt against acceleration, axis against arm, one clock against the other."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fiplib.bags.conventions import body_z
from fiplib.params import GRAVITY
from fiplib.recording import Poses

STEP = 0.01  # s, of the grid on which signals are compared
_WIDTH = 0.08  # s, of the Gaussian that smooths both sides of a comparison alike: what is faster than 2 Hz is left out
_LEAST = 10.0  # independent samples, for a comparison to say anything


class Relation(NamedTuple):
    """A linear relation of two horizontal vectors."""

    matrix: NDArray
    """(2, 2)"""
    deviation: float
    """Largest standard deviation of its entries."""

    def is_near(self, other: NDArray, within: float) -> bool:
        """Whether no entry differs from another matrix by more than ``within``."""
        return bool(np.max(np.abs(self.matrix - other)) < within)


def thrust(vehicle: Poses) -> Relation | None:
    """Return the horizontal acceleration of the vehicle over g times the slope of its z axis: one, for a vehicle that
    tilts to accelerate; the inverse of the unit, if positions are not in m. None if it moves too little to say.
    """
    axis = body_z(vehicle)
    slope = axis[:, :2] / np.maximum(axis[:, 2:], 0.3)
    return relation(vehicle.stamp, GRAVITY * slope, vehicle.position[:, :2], derivative=2)


def arm(vehicle: Poses, rod: Poses) -> NDArray:
    """Return the vector from the vehicle to the rod at the rod's stamps, (n, 3)."""
    at = (rod.stamp - vehicle.stamp[0]) / 1e9
    time = (vehicle.stamp - vehicle.stamp[0]) / 1e9
    return rod.position - np.column_stack([np.interp(at, time, column) for column in vehicle.position.T])


def leaning(vehicle: Poses, rod: Poses) -> Relation | None:
    """Return the direction from the vehicle to the rod over the rod's own axis: one, if the rod's axis is its z."""
    reach = arm(vehicle, rod)
    length = np.linalg.norm(reach, axis=1, keepdims=True)
    return relation(rod.stamp, body_z(rod)[:, :2], reach[:, :2] / np.maximum(length, 1e-9))


def delay(vehicle: Poses, rod: Poses) -> tuple[float, float] | None:
    """Return by how many s the rod's stamps are late against the vehicle's, and its deviation; None if unknown.

    The rod's foot, as its own pose has it, goes where the vehicle goes.
    """
    reach = arm(vehicle, rod)
    distance = float(np.median(np.linalg.norm(reach, axis=1)))
    foot = rod.position - distance * body_z(rod)
    stamp, columns = gridded(rod.stamp, foot - (rod.position - reach))
    _, place = gridded(vehicle.stamp, vehicle.position, stamp)
    good = np.isfinite(columns).all(axis=1) & np.isfinite(place).all(axis=1)
    rate = np.gradient(smooth(np.where(good[:, None], place, 0.0)), STEP, axis=0)
    good &= smooth(good.astype(float)[:, None])[:, 0] > 0.999
    if good.sum() * STEP < _LEAST * 3 * _WIDTH:
        return None
    here = smooth(np.where(np.isfinite(columns), columns, 0.0))[good]
    x, y = rate[good] - rate[good].mean(axis=0), here - here.mean(axis=0)
    power = float(np.sum(x**2))
    late = -float(np.sum(x * y)) / power if power > 0 else 0.0
    rest = y + late * x
    number = good.sum() * STEP / (3.5 * _WIDTH)
    spread = float(np.sqrt(np.mean(rest**2) / max(np.mean(x**2), 1e-12) / number))
    return late, spread


def relation(stamp: NDArray, cause: NDArray, effect: NDArray, derivative: int = 0) -> Relation | None:
    """Fit effect = matrix cause + constant, (n, 2) each, below 2 Hz; ``derivative`` of the effect is taken first.

    None if there are too few samples, or the cause moves too little.
    """
    _, columns = gridded(stamp, np.column_stack([cause, effect]))
    good = np.isfinite(columns).all(axis=1)
    columns = smooth(np.where(good[:, None], columns, 0.0))
    x, y = columns[:, :2], columns[:, 2:]
    for _ in range(derivative):
        y = np.gradient(y, STEP, axis=0)
    # nothing within reach of a gap, or of an end
    good = smooth(good.astype(float)[:, None], 2.0)[:, 0] > 0.999
    weight = good.astype(float)
    number = good.sum() * STEP / (3.5 * _WIDTH)
    if number < _LEAST:
        return None
    for _ in range(4):  # pushes, falls and mistracked poses count less
        total = weight.sum()
        cx, cy = x - weight @ x / total, y - weight @ y / total
        normal = cx.T @ (weight[:, None] * cx)
        if np.linalg.cond(normal) > 1e6:
            return None
        matrix = np.linalg.solve(normal, cx.T @ (weight[:, None] * cy)).T
        rest = np.linalg.norm(cy - cx @ matrix.T, axis=1)
        scale = 1.5 * float(np.median(rest[good])) + 1e-12
        weight = good / np.maximum(1.0, rest / (2.0 * scale))
    variance = float(weight @ rest**2 / weight.sum()) / 2.0
    inverse = np.linalg.inv(normal / weight.sum())
    return Relation(matrix, float(np.sqrt(variance * np.max(np.diag(inverse)) / number)))


def gridded(stamp: NDArray, columns: NDArray, grid: NDArray | None = None) -> tuple[NDArray, NDArray]:
    """Return columns (n, k) on a grid of ``STEP``, nan where no sample is near; the grid in ns."""
    if grid is None:
        grid = np.arange(stamp[0], stamp[-1], round(STEP * 1e9))
    time, at = (stamp - stamp[0]) / 1e9, (grid - stamp[0]) / 1e9
    values = np.column_stack([np.interp(at, time, column) for column in columns.T])
    after = np.minimum(np.searchsorted(time, at), len(time) - 1)
    before = np.maximum(after - 1, 0)
    reach = max(0.1, 3.0 * float(np.median(np.diff(time)))) if len(time) > 1 else 0.1
    values[(time[after] - time[before] > reach) | (at > time[-1]) | (at < time[0])] = np.nan
    return grid, values


def smooth(columns: NDArray, wider: float = 1.0) -> NDArray:
    """Return columns (n, k) convolved with a Gaussian; zeros count beyond the ends."""
    half = round(4.0 * wider * _WIDTH / STEP)
    kernel = np.exp(-0.5 * (np.arange(-half, half + 1) * STEP / (wider * _WIDTH)) ** 2)
    kernel /= kernel.sum()
    if len(columns) <= len(kernel):
        return np.zeros_like(columns)
    return np.column_stack([np.convolve(column, kernel, mode="same") for column in columns.T])
