"""The likelihood of a window of poses as a function of the length alone: a fitness that any search can minimise."""

import math

import numpy as np
from numpy.typing import NDArray

from fiplib.estimators.poses.filter import LE, R, run
from fiplib.estimators.poses.fit import Problem, maximise
from fiplib.estimators.poses.lanes import WIDTH

KNOTS, NEAR = 12, 0.2
"""Lengths, evenly spread in their logarithm, at which all other parameters are fitted; and how close to the maximum, in
the logarithm, they are fitted well. Further off the fitness is larger by thousands, and a few more do not matter."""


class Profile:
    """-2 log posterior over the length, every other parameter at its conditional maximum: a profile likelihood.

    The conditional maximum is found at ``KNOTS`` lengths and at three about the overall maximum, and interpolated by
    cubic splines; an error of the interpolated parameters counts in second order only, as they are at a maximum.
    ``profile(lengths)`` is then one pass of the filter for every 16 lengths.

    Args:
        problem: rows and priors (``estimate.problem_of``).
        lengths: the interval of lengths, m, each twice the distance from the seat to the centre of mass.
    """

    def __init__(self, problem: Problem, lengths: tuple[float, float]) -> None:
        from scipy.interpolate import CubicSpline  # with its optimisers it takes a second to import

        self._rows = problem.rows
        fit = problem.fit(problem.inertia, problem.offset)
        self._prior, self._theta = fit.prior, fit.theta
        self._free = fit.free[fit.free != R]
        best = 2.0 * fit.theta[R]
        knots = np.geomspace(*lengths, KNOTS)
        knots = np.sort([*knots[np.abs(np.log(knots / best)) > 0.04], 0.98 * best, best, 1.02 * best])
        middle = int(np.searchsorted(knots, best))
        found = np.empty((len(knots), len(fit.theta)))
        found[middle] = fit.theta
        for way in (range(middle + 1, len(knots)), range(middle - 1, -1, -1)):
            for knot in way:
                before = found[knot - way.step]
                start = before.copy()
                start[R] = knots[knot] / 2.0
                start[LE] += math.log(start[R] / before[R])  # the same rod, longer
                tolerance = 0.1 if abs(math.log(knots[knot] / best)) < NEAR else 30.0
                found[knot] = maximise(self._rows, start, self._free, self._prior, tolerance).theta
        self._nuisances = CubicSpline(np.log(knots), found[:, self._free])

    def __call__(self, lengths: NDArray) -> NDArray:
        """Return -2 log posterior (C,) of lengths (C,) in m, up to a constant."""
        lengths = np.asarray(lengths, dtype=float)
        lanes = np.tile(self._theta, (len(lengths), 1))
        lanes[:, self._free] = self._nuisances(np.log(lengths))
        lanes[:, R] = lengths / 2.0
        totals = [run(self._rows, lanes[first : first + WIDTH]).total for first in range(0, len(lanes), WIDTH)]
        value = np.concatenate(totals) - 0.5 * np.sum(self._prior.deviations(lanes) ** 2, axis=1)
        return np.where(np.isfinite(value), -2.0 * value, np.inf)
