"""The estimate of a flight that goes on."""

import math

import numpy as np
from numpy.typing import NDArray

from fiplib.estimators.poses.checks import largest_jump
from fiplib.estimators.poses.estimate import estimate, problem_of
from fiplib.estimators.poses.filter import LANES, MU, R, Rows, State, run
from fiplib.estimators.poses.fit import STEP, Fit, Value, inverse, maximise, neighbours
from fiplib.estimators.poses.knowledge import Knowledge
from fiplib.estimators.poses.rows import RISE_HALF, Body, cleaned, rows_of

RECENT = 0.3
"""How far back in s innovations are looked at for a jump."""


class Stream:
    """The estimate of a flight that goes on: poses are added as they arrive.

    The filter of a first maximum and of its neighbours runs on, and so do the score and the Fisher information; one
    Newton step from that maximum then gives the maximum for all poses so far. When a parameter has moved by more than
    its standard deviation, which happens about once each time that the flight has become twice as long, the maximum is
    sought anew from there on all poses: the cost of a flight is linear in its duration. Of the checks that ``estimate``
    makes only one is repeated, see ``jump``.

    Args:
        vehicle, rod: the first window, 2.5 s or more; see ``estimate``.
        knowledge: priors. The rod is taken to be tracked at its middle unless ``marker_offset`` says otherwise.

    Raises:
        ValueError: the first window does not give an estimate; the message says why.
    """

    def __init__(self, vehicle: Body, rod: Body, knowledge: Knowledge | None = None) -> None:
        knowledge = knowledge or Knowledge()
        if (reason := estimate(vehicle, rod, knowledge).reason) is not None:
            raise ValueError(reason)
        problem = problem_of(vehicle, rod, knowledge, [])
        self._bodies = [cleaned(vehicle), cleaned(rod)]
        self._origin = self._bodies[0].position[0]
        self._rows: list[Rows] = []
        self._begin(problem.fit(problem.inertia, problem.offset), float(problem.rows.time[0]))
        self._done = -math.inf
        self.push(Body(np.zeros(0)), Body(np.zeros(0)))

    def push(self, vehicle: Body, rod: Body) -> None:
        """Add poses, later than all before. They count once 0.15 s more have come, which smoothing needs."""
        for which, body in enumerate((vehicle, rod)):
            if len(body.time):
                columns = zip(self._bodies[which], body, strict=True)
                self._bodies[which] = Body(*(None if a is None else np.concatenate([a, b]) for a, b in columns))
        until = min(body.time[-1] for body in self._bodies) - RISE_HALF
        rows = rows_of(*self._bodies, self._origin)
        fresh = (rows.time > self._done) & (rows.time <= until)
        if np.any(fresh):
            self._rows.append(rows.part(fresh))
            self._add(self._rows[-1])
            self._done = until
            step, deviations = self._newton()
            if np.any(np.abs(step) > deviations):
                theta = self._fit.theta.copy()
                theta[self._fit.free] += step
                theta[R], theta[MU] = max(theta[R], 1e-3), max(theta[MU], 0.0)
                self._rows = [Rows(*(np.concatenate(columns) for columns in zip(*self._rows, strict=True)))]
                self._begin(maximise(self._rows[0], theta, self._fit.free, self._fit.prior), self._rows[0].time[0])
                self._add(self._rows[0])
        # what smoothing needs of the past
        self._bodies = [body.part(body.time > self._done - 2.0 * RISE_HALF) for body in self._bodies]

    @property
    def length(self) -> Value:
        """The length in m for all poses so far, and its standard deviation."""
        step, deviations = self._newton()
        at = int(np.flatnonzero(self._fit.free == R)[0])
        return Value(2.0 * float(self._fit.theta[R] + step[at]), 2.0 * float(deviations[at]))

    @property
    def jump(self) -> tuple[float, float]:
        """The largest mean squared innovation of late (``checks.largest_jump``), and its time in the bodies' clock."""
        size, when = largest_jump(*self._recent)
        return size, when + float(self._recent[0][0])

    def _begin(self, fit: Fit, time: float) -> None:
        self._fit = fit
        self._lanes = neighbours(fit.theta, fit.free)
        deviations, slopes = fit.prior.at(self._lanes)
        self._score, self._information = -slopes @ deviations, slopes @ slopes.T
        self._state = State.at(time, -(-len(self._lanes) // LANES) * LANES, 2)
        self._recent = np.zeros(0), np.zeros((0, 2))

    def _add(self, rows: Rows) -> None:
        steps = np.full(len(self._fit.free), STEP)
        out = run(rows, self._lanes, steps, innovations=True, state=self._state)
        self._score += out.score
        self._information += out.fisher
        time, innovation = (
            np.concatenate(pair) for pair in zip(self._recent, (rows.time, out.innovation), strict=True)
        )
        late = time > rows.time[-1] - RECENT
        self._recent = time[late], innovation[late]

    def _newton(self) -> tuple[NDArray, NDArray]:
        """The step to the maximum of the quadratic, and the standard deviations."""
        covariance = inverse(self._information)
        return covariance @ self._score, np.sqrt(np.diag(covariance))
