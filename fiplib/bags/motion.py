"""Relations between the motions of two tracked bodies: tilt and acceleration, axis and arm, one clock and the other."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fiplib.bags.conventions import body_z
from fiplib.params import GRAVITY
from fiplib.recording import Poses, Series

STEP = 0.01  # s, of the grid on which signals are compared
_WIDTH = 0.08  # s, of the Gaussian that smooths both sides of a comparison alike: what is faster than 2 Hz is left out
_LONGEST = 7200.0  # s in which commands are looked for
_MOST = 1_000_000  # points of a grid: nearly three hours
_LEAST = 10.0  # independent samples, for a comparison to say anything


class Relation(NamedTuple):
    """A linear relation of two horizontal vectors."""

    matrix: NDArray
    """(2, 2)"""
    deviation: float
    """Largest standard deviation of its entries."""
    explained: float
    """Share of the effect that it explains."""
    late: tuple[float, float] = (0.0, 0.0)
    """By how many s the effect's stamps are late, and the deviation of that; 0 where it is not fitted."""

    @property
    def scale(self) -> float:
        """Effect over cause, along the cause."""
        return float(np.trace(self.matrix)) / 2.0

    @property
    def turn(self) -> float:
        """Angle from the cause to the effect, rad."""
        return math.atan2(self.matrix[1, 0] - self.matrix[0, 1], float(np.trace(self.matrix)))

    @property
    def mirrored(self) -> bool:
        """Return whether the effect is mirrored."""
        return bool(np.linalg.det(self.matrix) < 0.0)

    @property
    def proven(self) -> bool:
        """Return whether the relation explains the effect and is known well, whatever it is."""
        size = float(np.linalg.norm(self.matrix)) / math.sqrt(2.0)
        return self.explained > 0.5 and self.deviation < 0.2 * size


def thrust(vehicle: Poses) -> Relation | None:
    """Return the horizontal acceleration of the vehicle over g times the slope of its z axis: one, for a vehicle that
    tilts to accelerate; the inverse of the unit, if positions are not in m. None if it moves too little to say.
    """
    axis = body_z(vehicle)
    upward = np.where(axis[:, 2:] < 0.0, np.minimum(axis[:, 2:], -0.3), np.maximum(axis[:, 2:], 0.3))
    columns = gridded(vehicle.stamp, np.column_stack([axis[:, :2] / upward, vehicle.position]), even(vehicle.stamp))
    if len(columns) < 3:
        return None
    acceleration = np.gradient(np.gradient(columns[:, 2:4], STEP, axis=0), STEP, axis=0)
    return relation(GRAVITY * columns[:, :2], acceleration)


def arm(vehicle: Poses, rod: Poses) -> NDArray:
    """Return the vector from the vehicle to the rod at the rod's stamps, (n, 3); nan where no vehicle is near."""
    return rod.position - gridded(vehicle.stamp, vehicle.position, rod.stamp)


def distance_of(reach: NDArray) -> float:
    """Return the median length of vectors (n, 3), of those that are finite; nan if none is."""
    lengths = np.linalg.norm(reach, axis=1)
    lengths = lengths[np.isfinite(lengths)]
    return float(np.median(lengths)) if len(lengths) else float("nan")


def leaning(vehicle: Poses, rod: Poses) -> Relation | None:
    """Return the direction from the vehicle to the rod over the rod's own z axis: one, if the rod's z axis is its own.

    If the rod's stamps are late, the vehicle is elsewhere by then: by how much is fitted, too.
    """
    grid = even(rod.stamp)
    place = gridded(vehicle.stamp, vehicle.position, grid)
    columns = gridded(rod.stamp, np.column_stack([body_z(rod)[:, :2], rod.position]), grid)
    if len(columns) < 3:
        return None
    reach = columns[:, 2:] - place
    distance = distance_of(reach)
    rate = np.gradient(place, STEP, axis=0)[:, :2] / distance
    found = relation(np.column_stack([columns[:, :2], rate]), reach[:, :2] / distance)
    if found is None:
        return None
    late = -float(np.trace(found.matrix[:, 2:])) / 2.0, found.late[1]
    return found._replace(matrix=found.matrix[:, :2], late=late)


def relation(cause: NDArray, effect: NDArray) -> Relation | None:
    """Fit effect = matrix cause + constant below 2 Hz; columns (n, k) and (n, 2) on a grid, nan where not known.

    Further columns of the cause than two are fitted, too. None if there are too few samples, or the cause moves too
    little.
    """
    columns = np.column_stack([cause, effect])
    good = np.isfinite(columns).all(axis=1)
    columns = smooth(np.where(good[:, None], columns, 0.0))
    x, y = columns[:, :-2], columns[:, -2:]
    # nothing within reach of a gap, or of an end
    good = smooth(good.astype(float)[:, None], 2.0)[:, 0] > 0.999
    weight = good.astype(float)
    number = good.sum() * STEP / (3.5 * _WIDTH)
    if number < _LEAST:
        return None
    for _ in range(4):  # pushes, falls and mistracked poses count less
        total = weight.sum()
        cx, cy = x - weight @ x / total, y - weight @ y / total
        normal = cx.T @ (weight[:, None] * cx) / total
        size = np.sqrt(np.diag(normal))
        if not np.all(size > 1e-9) or np.linalg.cond(normal / np.outer(size, size)) > 1e4:
            return None
        matrix = np.linalg.solve(normal, cx.T @ (weight[:, None] * cy) / total).T
        rest = np.linalg.norm(cy - cx @ matrix.T, axis=1)
        scale = 1.5 * float(np.median(rest[good])) + 1e-12
        weight = good / np.maximum(1.0, rest / (2.0 * scale))
    total = weight.sum()
    variance = float(weight @ rest**2 / total) / 2.0
    deviations = np.sqrt(variance * np.diag(np.linalg.inv(normal)) / number)
    power = float(weight @ np.sum((cy - weight @ cy / total) ** 2, axis=1) / total)
    explained = 1.0 - 2.0 * variance / power if power > 0.0 else 0.0
    late = (0.0, float(np.max(deviations[2:], initial=0.0)))
    return Relation(matrix, float(np.max(deviations[:2])), explained, late)


def rates(vehicle: Poses) -> tuple[NDArray, NDArray]:
    """Return the body rates of the vehicle, (n, 3), rad/s, at stamps in ns on a grid; nan where poses are missing."""
    signs = np.sign(np.sum(vehicle.orientation[1:] * vehicle.orientation[:-1], axis=1))
    steady = vehicle.orientation * np.cumprod(np.concatenate([[1.0], np.where(signs == 0.0, 1.0, signs)]))[:, None]
    grid = even(vehicle.stamp)
    q = gridded(vehicle.stamp, steady, grid)
    if len(grid) < 3:
        return grid, np.full((len(grid), 3), np.nan)
    change = np.gradient(q, STEP, axis=0)
    vector, w = q[:, :3], q[:, 3:]
    return grid, 2.0 * (w * change[:, :3] - change[:, 3:] * vector - np.cross(vector, change[:, :3]))


def followed(vehicle: Poses, command: Series) -> tuple[float, float, float] | None:
    """Return how the vehicle's roll and pitch rates follow the commanded ones: the delay in s, the commanded over the
    flown rate, and their correlation at that delay. None if they hardly overlap, or nothing turns.
    """
    grid, flown = rates(vehicle)
    span = max(int(command.stamp[-1]), int(vehicle.stamp[-1])) - min(int(command.stamp[0]), int(vehicle.stamp[0]))
    if span > _LONGEST * 1e9 or len(command.stamp) < 2:
        return None
    first = min(int(command.stamp[0]), int(vehicle.stamp[0]))
    count = int(span / (STEP * 1e9)) + 1
    both = np.zeros((2, count, 2))
    both[0] = gridded(command.stamp, command.values[:, :2], first + np.arange(count) * round(STEP * 1e9))
    start = round((int(grid[0]) - first) / (STEP * 1e9))
    both[1, start : start + len(grid)] = flown[: count - start, :2]
    both = np.nan_to_num(both)
    both -= both.mean(axis=1, keepdims=True) * (both != 0.0)
    sent, turned = np.fft.rfft(both, 2 * count, axis=1)
    matched = np.fft.irfft(np.sum(np.conj(sent) * turned, axis=1), 2 * count)
    power = np.sum(both**2, axis=(1, 2))
    if min(power) <= 0.0:
        return None
    at = int(np.argmax(np.abs(matched)))
    late = (at if at < count else at - 2 * count) * STEP
    return late, float(power[0] / matched[at]), float(matched[at] / np.sqrt(power[0] * power[1]))


def even(stamp: NDArray) -> NDArray:
    """Return stamps in ns every ``STEP``, over the same time, ``_MOST`` at most."""
    step = round(STEP * 1e9)
    return int(stamp[0]) + step * np.arange(min(int(stamp[-1] - stamp[0]) // step + 1, _MOST))


def gridded(stamp: NDArray, columns: NDArray, grid: NDArray) -> NDArray:
    """Return columns (n, k) at other stamps, (m, k); nan where no sample is near."""
    if len(stamp) < 2:
        return np.full((len(grid), columns.shape[1]), np.nan)
    time, at = (stamp - stamp[0]) / 1e9, (grid - stamp[0]) / 1e9
    values = np.column_stack([np.interp(at, time, column) for column in columns.T])
    after = np.clip(np.searchsorted(time, at), 1, len(time) - 1)
    reach = max(0.1, 3.0 * float(np.median(np.diff(time))))
    values[(time[after] - time[after - 1] > reach) | (at > time[-1] + reach) | (at < -reach)] = np.nan
    return values


def smooth(columns: NDArray, wider: float = 1.0) -> NDArray:
    """Return columns (n, k) convolved with a Gaussian; zeros count beyond the ends."""
    half = round(4.0 * wider * _WIDTH / STEP)
    kernel = np.exp(-0.5 * (np.arange(-half, half + 1) * STEP / (wider * _WIDTH)) ** 2)
    kernel /= kernel.sum()
    if len(columns) <= len(kernel):
        return np.zeros_like(columns)
    return np.column_stack([np.convolve(column, kernel, mode="same") for column in columns.T])
