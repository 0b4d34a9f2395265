"""Exercises of notebook 07, exploring a bag."""

import numpy as np
from numpy.typing import NDArray

from fiplib.teaching.exercises.grading import Answer, Exercise


def _recording(rng: np.random.Generator) -> tuple[NDArray, NDArray]:
    """Stamps (n,) int64 in ns of a tracker that jitters, and positions (n, 3) in m."""
    steps = rng.integers(2_000_000, 9_000_000, 30)
    return 1_700_000_000_000_000_000 + np.cumsum(steps), np.cumsum(rng.normal(0.0, 1e-3, (30, 3)), axis=0)


def _velocities(stamp: NDArray, position: NDArray) -> NDArray:
    return np.diff(position, axis=0) / (np.diff(stamp)[:, None] / 1e9)


velocities = Exercise(
    _velocities,
    _recording,
    {
        "stamps are in nanoseconds: yours are a thousand million times too small": lambda t, p: _velocities(t, p) / 1e9,
        "frames do not come evenly: divide each difference by its own time, not by the mean": (
            lambda t, p: np.diff(p, axis=0) / (np.ptp(t) / 1e9 / (len(t) - 1))
        ),
        "frames do not come at exactly 240 Hz: take each one's own time": lambda t, p: np.diff(p, axis=0) * 240.0,
        "the sign is wrong: later minus earlier": lambda t, p: -_velocities(t, p),
        "positions are not differences: a velocity is a difference divided by its time": lambda t, p: (
            p[1:] / (np.diff(t)[:, None] / 1e9)
        ),
        "the time of a frame is not the time between frames: take differences of the stamps": lambda t, p: (
            np.diff(p, axis=0) / (t[1:, None] / 1e9)
        ),
    },
    "each difference of positions has its own difference of stamps; look at the unit of the stamps",
    "np.diff(position, axis=0) by np.diff(stamp) in s; stamps are subtracted as whole numbers first",
    "but the closer the frames, the noisier the velocity",
)
"""Velocities between frames at uneven stamps."""

length_from_lean = Exercise(
    lambda offset, tilt: 2 * (offset @ tilt) / (tilt @ tilt),
    lambda rng: (tilt := rng.normal(0.0, 0.03, 50), rng.uniform(0.15, 0.9) * tilt + rng.normal(0.0, 2e-3, 50))[::-1],
    {
        "that is half the length: the centre of mass lies at l/2": lambda d, tilt: (d @ tilt) / (tilt @ tilt),
        "a mean of ratios is ruled by moments of hardly any tilt: fit a slope": lambda d, tilt: 2 * np.mean(d / tilt),
        "that fits the tilt to the offset, whose noise biases the length": lambda d, tilt: 2 * (d @ d) / (d @ tilt),
        "the ratio is upside down: offset over tilt is a length": lambda d, tilt: 2 * (d @ tilt) / (d @ d),
        "a ratio of means says nothing where both are near zero: fit a slope": lambda d, tilt: (
            2 * d.mean() / tilt.mean()
        ),
        "half the length, by means: fit a slope": lambda d, tilt: d.mean() / tilt.mean(),
        "a median of ratios is ruled by moments of hardly any tilt: fit a slope": lambda d, tilt: (
            2 * np.median(d / tilt)
        ),
        "that is the sum of products: divide by the sum of the squares of the tilt": lambda d, tilt: 2 * (d @ tilt),
        "a ratio of sizes counts the noise as lean: fit a slope": lambda d, tilt: 2 * np.sqrt((d @ d) / (tilt @ tilt)),
        "the square of a sum is not the sum of squares": lambda d, tilt: 2 * (d @ tilt) / tilt.sum() ** 2,
        "your line has an intercept: it is to go through zero": lambda d, tilt: 2 * np.polyfit(tilt, d, 1)[0],
        "ratios are added up: fit a slope": lambda d, tilt: 2 * np.sum(d / tilt),
        "a ratio of the scatters counts the noise as lean: fit a slope": lambda d, tilt: 2 * d.std() / tilt.std(),
        "one sample decides, the largest: fit a slope to all": lambda d, tilt: 2 * d.max() / tilt.max(),
    },
    "fit a line through zero to the offset as a function of the tilt; how is its slope related to the length?",
    "offset = (l/2) tilt: the slope that fits best is sum(offset * tilt) / sum(tilt^2)",
    "in slow motion this ratio is the length, whatever the rod's inertia",
)
"""The length from offset and tilt in slow motion."""


def _fresh(stamp: NDArray, position: NDArray, whole: Answer = np.any) -> NDArray:
    return np.append(True, (np.diff(stamp) > 0) & whole(np.diff(position, axis=0) != 0, axis=1))


def _stuttering(rng: np.random.Generator) -> tuple[NDArray, NDArray]:
    """A recording with frames sent again, frozen poses, and coordinates that stand still by chance."""
    stamp, position = _recording(rng)
    again, frozen, still = np.sort(rng.permutation(np.arange(1, 30))[:9].reshape(3, 3))
    for k in frozen:
        position[k] = position[k - 1]
    position[still, 0] = position[still - 1, 0]
    stamp[again] = stamp[again - 1]
    return stamp, position


fresh = Exercise(
    _fresh,
    _stuttering,
    {
        "a frozen tracker sends new stamps: look at the position, too": lambda t, p: np.append(True, np.diff(t) > 0),
        "a frame sent again has an old stamp: look at the stamps, too": lambda t, p: _fresh(np.arange(len(t)), p),
        "one coordinate may stand still by chance: frozen are all three": lambda t, p: _fresh(t, p, np.all),
        "that is the other way round: True keeps a frame": lambda t, p: ~_fresh(t, p),
        "the first frame has none before it: keep it, one value for each frame": lambda t, p: _fresh(t, p)[1:],
    },
    "two things must be new in a frame that you keep: its time and its place",
    "compare each frame with the one before; keep it if its stamp is later and any coordinate differs",
    "such frames would have said that the vehicle stands still",
)
"""Fresh frames, without those sent again or frozen."""
