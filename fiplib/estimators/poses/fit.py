"""The maximum a posteriori: priors, a coarse grid to start from, and Fisher scoring.

The recursion runs for one point and for its neighbours side by side, so that one pass over the rows gives the
likelihood, its gradient and the Fisher information. The search begins on a few poses a second and ends on all of them.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fiplib.estimators.poses import filter as kf
from fiplib.estimators.poses.filter import LE, MU, OFFSET, H, Q, R, Rows, run
from fiplib.estimators.poses.knowledge import ANY_INERTIA, ANY_OFFSET, MIDDLE, ORIGIN, UNIFORM, Knowledge, Told
from fiplib.estimators.poses.smoothing import parabolas

TOLD = ("inertia factor", "tracked point of the rod", "seat height", "height of the vehicle's centre of mass",
        "mass ratio", "distance of the two tracked points")  # fmt: skip
"""Names of the first quantities of a ``Prior``."""

STEP = 1e-5
"""Distance of the neighbours."""

SPARSE, LEAD = 60.0, 20.0
"""Poses of each body a second, and s from the first one, on which the search starts."""

CLOSE = 3.0
"""Squared distance in standard deviations from the maximum over few poses at which the search goes on with more."""

FORCE_FREE = 1e-12
"""Density of the white force on the rod where none is assumed, rad^2/s^3."""

_LARGEST = np.array([0.3, 0.2, 0.1, 0.05, 0.05, 0.01, 1.5, 0.5, 0.5, 0.5, 1.0, 1.0, 1.0, 1.0, 1.5, 0.1])


class Value(NamedTuple):
    """A number and its standard deviation."""

    value: float
    deviation: float


def inertia_factor_of(theta: NDArray) -> NDArray:
    """Return lambda = r / (L_e + mu r) of the parameters theta (16, ...)."""
    return theta[R] / (np.exp(theta[LE]) + theta[MU] * theta[R])


class Prior(NamedTuple):
    """Independent Gaussians: ``means`` and ``tolerances`` (15,) of what ``quantities`` returns."""

    means: NDArray
    tolerances: NDArray

    @staticmethod
    def quantities(theta: NDArray) -> NDArray:
        """Return what the priors are about, (..., 16) -> (..., 15)."""
        t = np.moveaxis(theta, -1, 0)
        distance = t[R] + t[OFFSET] + t[H]
        told = [inertia_factor_of(t), t[OFFSET], t[H], t[H] - t[kf.HC], t[MU], distance]
        return np.stack([*told, *t[Q : kf.ND + 1], t[kf.LEVER]], axis=-1)

    def deviations(self, theta: NDArray) -> NDArray:
        """Return how far theta (..., 16) lies from the priors, over their tolerances (..., 15)."""
        return (self.quantities(theta) - self.means) / self.tolerances

    def at(self, lanes: NDArray) -> tuple[NDArray, NDArray]:
        """Return the deviations (15,) of a point, and their slopes (k, 15) from its neighbours (k + 1, 16)."""
        deviations = self.deviations(lanes)
        return deviations[0], (deviations[1:] - deviations[0]) / STEP


@dataclass(frozen=True)
class Fit:
    """A maximum a posteriori: all parameters, which of them are free, the covariance of those, the log posterior.

    ``innovation`` (n, axes) are the standardised innovations.
    """

    theta: NDArray
    free: NDArray
    covariance: NDArray
    value: float
    prior: Prior
    converged: bool
    innovation: NDArray

    def of(self, function: Callable[[NDArray], NDArray]) -> Value:
        """Return a function of the parameters at the maximum, and its standard deviation to first order."""
        values = function(neighbours(self.theta, self.free).T)
        slope = (values[1:] - values[0]) / STEP
        return Value(float(values[0]), math.sqrt(max(float(slope @ self.covariance @ slope), 0.0)))

    @property
    def length(self) -> Value:
        """Twice the distance from the seat to the rod's centre of mass, m."""
        return self.of(lambda t: 2.0 * t[R])

    def conflicts(self) -> NDArray:
        """Return how far the posterior lies from each prior, over what is expected if the prior is right (15,).

        With prior variance V0 and posterior variance V, the posterior mean deviates from the prior's by V0 - V.
        """
        deviations, slopes = self.prior.at(neighbours(self.theta, self.free))
        posterior = np.einsum("ji,jk,ki->i", slopes, self.covariance, slopes)
        free = np.any(slopes != 0.0, axis=0) & np.isfinite(self.prior.tolerances)
        # where the prior is far tighter than the data determine, 1 - V / V0 is lost to rounding
        return np.where(free, deviations / np.sqrt(np.maximum(1.0 - posterior, 1e-6)), 0.0)


def neighbours(theta: NDArray, free: NDArray) -> NDArray:
    """Return theta (16,) and its neighbours (k + 1, 16): each has one free parameter larger by ``STEP``."""
    lanes = np.tile(theta, (len(free) + 1, 1))
    lanes[1 + np.arange(len(free)), free] += STEP
    return lanes


def inverse(information: NDArray) -> NDArray:
    """Return the inverse of a positive definite matrix whose rows have very different scales."""
    scale = 1.0 / np.sqrt(np.diag(information))
    return np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)


def maximise(rows: Rows, theta: NDArray, free: NDArray, prior: Prior, tolerance: float = 0.1) -> Fit:
    """Fisher scoring from theta (16,) over the ``free`` parameters, with shorter steps where full ones go too far."""
    steps = np.full(len(free), STEP)

    def evaluate(point: NDArray) -> tuple[float, NDArray, NDArray, NDArray]:
        lanes = neighbours(point, free)
        out = run(rows, lanes, steps, innovations=True)
        deviations, slopes = prior.at(lanes)
        value = float(out.total[0] - 0.5 * deviations @ deviations)
        return value, out.score - slopes @ deviations, out.fisher + slopes @ slopes.T, out.innovation

    value, score, information, innovation = evaluate(theta)
    relaxation, passes, converged = 1.0, 1, False
    while passes < 40 and relaxation > 1e-3:
        full = inverse(information) @ score
        step = full * min(relaxation, float(np.min(_LARGEST[free] / np.maximum(np.abs(full), 1e-12))))
        trial = theta.copy()
        trial[free] += step
        trial[R], trial[MU] = max(trial[R], 1e-3), max(trial[MU], 0.0)
        if converged := bool(0.0 <= score @ full < tolerance):
            theta = trial  # so close that the likelihood is a parabola: the step ends at its top
            break
        after = evaluate(trial)
        passes += 1
        better = math.isfinite(after[0]) and after[0] > value
        # the expected information can fall short of the curvature: the step then goes too far, and every time
        if not better or after[1] @ step < -0.3 * (score @ step):
            relaxation /= 2.0
        if better:
            theta, (value, score, information, innovation) = trial, after
    return Fit(theta, free, inverse(information), value, prior, converged, innovation)


class Problem:
    """The rows of a flight and what is known beforehand; ``fit`` finds the maximum under two assumptions.

    Args:
        rows: the measured rows.
        knowledge: the priors.
        distance: of the two tracked points, m; nan if it is not known.
    """

    def __init__(self, rows: Rows, knowledge: Knowledge, distance: float = math.nan) -> None:
        self.rows, self.knowledge, self.distance = rows, knowledge, distance
        self.flies, self.tracked = rows.has(kf.TILT), rows.has(kf.ROD)
        self._few = rows.part(rows.time < rows.time[0] + LEAD).sparse(SPARSE)
        self._start = self._grid()

    @property
    def inertia(self) -> Told:
        """Return the prior of the inertia factor: as stated, else vague where the tracked point replaces it."""
        return self.knowledge.inertia_factor or (ANY_INERTIA if self.tracked else UNIFORM)

    @property
    def offset(self) -> Told:
        """The prior of the rod's tracked point: as stated, else the middle, unless the inertia factor replaces it."""
        middle = self.tracked and not self.knowledge.inertia_factor
        return self.knowledge.marker_offset or (MIDDLE if middle else ANY_OFFSET)

    def fit(self, inertia: Told, offset: Told, force: bool = False) -> Fit:
        """Return the maximum; ``force``: an unknown white force acts on the rod, too."""
        first = self.start(inertia, offset, force)
        return maximise(self.rows, first.theta, first.free, first.prior)

    def start(self, inertia: Told, offset: Told, force: bool = False) -> Fit:
        """Return about the maximum over few poses, where the search over all of them begins."""
        theta = self._start.copy()
        if self.tracked and offset.tolerance < 0.1:
            theta[R], theta[OFFSET] = theta[R] + theta[OFFSET] - offset.value, offset.value
        if not self.tracked:
            theta[OFFSET] = 0.0
        theta[R] = max(theta[R], 0.02)
        free = [LE, R, Q, kf.OMEGA, kf.ZETA, kf.ZERO, kf.NV]
        free += [OFFSET, kf.NR] if self.tracked else []
        free += [H, kf.HC, MU, kf.NT, kf.LEVER] if self.flies else []
        free += [kf.ND] if self.rows.has(kf.DIRECTION) else []
        if force:
            free.append(kf.NF)
            theta[kf.NF] = math.log(0.1)
        free, prior = np.array(sorted(free)), self._prior(inertia, offset)
        return maximise(self._few, theta, free, prior, CLOSE)

    def _prior(self, inertia: Told, offset: Told) -> Prior:
        k, unused = self.knowledge, Told(0.0, 1.0)
        use = self.flies and self.tracked and math.isfinite(self.distance)
        geometry = [k.seat_height, k.com_height, k.mass_ratio] if self.flies else [unused] * 3
        priors = [inertia, offset if self.tracked else ANY_OFFSET, *geometry]
        priors += [Told(self.distance, k.distance_tolerance) if use else Told(0.0, math.inf)]
        priors += [Told(self._start[Q], 3.0)]
        priors += [Told(value, tolerance) for value, tolerance in zip(k.shape, (1.0, 0.7, 1.0), strict=True)]
        priors += [Told(math.log(noise), 1.0) for noise in k.noise] * 2
        means, tolerances = np.array([*priors, ORIGIN]).T
        return Prior(means, np.maximum(tolerances, 1e-6))

    def _grid(self) -> NDArray:
        """Return the best of a coarse grid over L_e, on the first 2.5 s."""
        rows, knowledge = self._few, self.knowledge
        lengths = np.geomspace(knowledge.lengths[0] / 3.0, knowledge.lengths[1], 16)
        seat = knowledge.seat_height.value if self.flies else 0.0
        lanes = np.zeros((16, kf.LEVER + 1))
        lanes[:, LE], lanes[:, R] = np.log(lengths), 0.75 * lengths
        if math.isfinite(self.distance):
            lanes[:, OFFSET] = self.distance - seat - lanes[:, R]
        lanes[:, H] = lanes[:, kf.HC] = seat
        lanes[:, MU] = knowledge.mass_ratio.value if self.flies else 0.0
        lanes[:, Q] = math.log(self._thrust_density())
        lanes[:, [kf.OMEGA, kf.ZETA, kf.ZERO]] = knowledge.shape
        lanes[:, [kf.NV, kf.NT, kf.NR, kf.ND]] = np.log(knowledge.noise * 2)
        lanes[:, kf.NF] = math.log(FORCE_FREE)
        first = int(np.searchsorted(rows.time, rows.time[0] + 2.5))
        return lanes[int(np.nanargmax(run(rows.part(slice(first)), lanes).total))]

    def _thrust_density(self) -> float:
        """Return how fast the specific thrust spreads, m^2/s^5: half of its mean square change in 0.2 s."""
        kind = self.rows.kind == (kf.TILT if self.flies else kf.VEHICLE)
        time, force = self.rows.time[kind], self.rows.value[kind]
        if not self.flies:
            force = parabolas(time, force, time, 0.05)[2]
        smooth = parabolas(time, force, time, 0.05)[0]
        later = np.minimum(np.searchsorted(time, time + 0.2), len(time) - 1)
        return max(float(np.mean((smooth[later] - smooth) ** 2)) / 0.1, 1e-6)
