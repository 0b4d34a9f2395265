"""Exercises of notebook 06, the closed loop."""

import math

import numpy as np
from numpy.typing import NDArray

from fiplib.teaching.exercises.grading import Exercise


def _settled(time: NDArray, offset: NDArray, band: float) -> float:
    inside = np.append(np.abs(offset) <= band, True)
    after = np.flatnonzero(~inside)[-1] + 1 if not inside.all() else 0
    return [*time, math.inf][after]


def _swing(rng: np.random.Generator) -> tuple[NDArray, NDArray, float]:
    """A swing that dies out, never does, or was never large."""
    since = np.arange(400) * 0.01
    size, decay = ((6.0, 1.2), (6.0, 1.2), (6.0, 0.0), (0.3, 0.0))[rng.integers(4)]
    swing = size * np.exp(-decay * since) * np.cos(rng.uniform(3.0, 5.0) * since + rng.uniform(0.0, 6.0))
    return since + rng.uniform(0.0, 5.0), swing, rng.uniform(0.4, 1.0)


def _kind(time: NDArray, offset: NDArray, band: float) -> str:
    if np.abs(offset[-1]) > band:
        return "a rod that is still outside at the end"
    return "a rod that settles" if np.abs(offset).max() > band else "a rod that never leaves the band"


settling_time = Exercise(
    _settled,
    _swing,
    {
        "that is the first time inside the band: the rod swings through and leaves it again": (
            lambda t, d, band: t[np.argmax(np.abs(d) <= band)]
        ),
        "the other side counts, too: take the absolute value": lambda t, d, band: _settled(t, np.maximum(d, 0.0), band),
        "that is the last sample outside the band: settled is the next one, and inf if there is none": (
            lambda t, d, band: t[max(np.flatnonzero(np.append(True, np.abs(d) > band))[-1] - 1, 0)]
        ),
    },
    "look for the last sample outside the band, on either side; three kinds of record need care",
    "the time of the sample after the last one outside: inf if there is none, time[0] if all are inside",
    "a settling time says nothing without its band, and the paper names none",
    kind=_kind,
)
"""Settling time."""


def _fused(l1: float, s1: float, l2: float, s2: float, share: float, power: int = 2) -> tuple[float, float]:
    old, new = (1 - share) / s1**power, share / s2**power
    return (old * l1 + new * l2) / (old + new), (old + new) ** (-1 / power)


fuse = Exercise(
    _fused,
    lambda rng: tuple(rng.uniform([0.6, 0.02, 0.6, 0.02, 0.1], [1.4, 0.1, 1.4, 0.1, 0.4]).tolist()),
    {
        "precisions are added in full: these estimates share data, which is counted twice now": (
            lambda l1, s1, l2, s2, w: _fused(l1, s1 / math.sqrt(2), l2, s2 / math.sqrt(2), 0.5)
        ),
        "the second value is a variance: take the root": lambda *of: (_fused(*of)[0], _fused(*of)[1] ** 2),
        "a precision is 1 / deviation^2, not 1 / deviation": lambda *of: _fused(*of, power=1),
        "the shares are exchanged: the new estimate has `share`": lambda *of: _fused(*of[:4], 1 - of[4]),
        "the weights are not normalised: divide by their sum": lambda l1, s1, l2, s2, w: (
            (1 - w) * l1 / s1**2 + w * l2 / s2**2,
            _fused(l1, s1, l2, s2, w)[1],
        ),
        "the lengths are weighed by the shares alone: the better estimate counts more": lambda l1, s1, l2, s2, w: (
            (1 - w) * l1 + w * l2,
            _fused(l1, s1, l2, s2, w)[1],
        ),
        "variances are averaged: average precisions": lambda l1, s1, l2, s2, w: (
            (1 - w) * l1 + w * l2,
            math.sqrt((1 - w) * s1**2 + w * s2**2),
        ),
        "deviations are averaged: average precisions": lambda l1, s1, l2, s2, w: (
            (1 - w) * l1 + w * l2,
            (1 - w) * s1 + w * s2,
        ),
    },
    "weigh the lengths by precisions, each precision by its share, and go back to a deviation at the end",
    "old = (1 - share) / s1^2, new = share / s2^2; these weigh the lengths, and their sum is the new precision",
    "consistent whatever the two estimates have in common: this is covariance intersection",
)
"""Fusing two estimates that share data."""

cautious_length = Exercise(
    lambda l, s, c: 1 / (1 / l + c * s / l**2),
    lambda rng: (rng.uniform(0.5, 1.5), rng.uniform(0.1, 0.4), rng.uniform(1.0, 3.0)),
    {
        "that is the wrong side: too long a length lets the rod fall, choose a shorter one": lambda l, s, c: l + c * s,
        "that may fall below zero: the belief is Gaussian in 1/l, so take the step in 1/l": lambda l, s, c: l - c * s,
        "the deviation of 1/l is not that of l: it is deviation / length^2": lambda l, s, c: 1 / (1 / l + c * s),
        "the short side of l is the large side of 1/l: add": lambda l, s, c: 1 / (1 / l - c * s / l**2),
        "that is still 1/l: invert it": lambda l, s, c: 1 / l + c * s / l**2,
        "the deviation of 1/l has the square of the length below it": lambda l, s, c: 1 / (1 / l + c * s / l),
        "the deviation multiplies: a wide belief goes further": lambda l, s, c: 1 / (1 / l + c / s),
        "the belief is Gaussian in 1/l, not in log l": lambda l, s, c: l * math.exp(-c * s / l),
        "a step in 1/l is taken from l: invert first, go up, invert again": lambda l, s, c: l - c * s / l**2,
    },
    "do it in 1/l: where is its mean, what is its deviation, which way is short?",
    "1/l has the mean 1 / length and the deviation deviation / length^2: go up from there, then invert",
    "positive however vague the belief, and short when in doubt",
)
"""A cautious length."""
