"""The estimate of a flight that goes on."""

import math

import numpy as np

from fiplib.estimators.poses.estimate import estimate, problem_of
from fiplib.estimators.poses.filter import R, State, run
from fiplib.estimators.poses.fit import STEP, Value, inverse, neighbours
from fiplib.estimators.poses.knowledge import Knowledge
from fiplib.estimators.poses.rows import RISE_HALF, Body, cleaned, rows_of


class Stream:
    """The estimate of a flight that goes on: poses are added as they arrive, at a constant cost each.

    The filter of a first window's maximum and of its neighbours runs on, and so do the score and the Fisher
    information; one Newton step from that maximum then gives the maximum for all poses so far. The checks that
    ``estimate`` makes are not repeated here.

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
        self._fit = problem.fit(problem.inertia, problem.offset)
        self._bodies = [cleaned(vehicle), cleaned(rod)]
        self._origin = self._bodies[0].position[0]
        self._lanes = neighbours(self._fit.theta, self._fit.free)
        deviations, slopes = self._fit.prior.at(self._lanes)
        self._score, self._information = -slopes @ deviations, slopes @ slopes.T
        self._state = State.at(problem.rows.time[0], 2)
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
            steps = np.full(len(self._fit.free), STEP)
            out = run(rows.part(fresh), self._lanes, steps, state=self._state)
            self._score += out.score
            self._information += out.fisher
            self._done = until
        # what smoothing needs of the past
        self._bodies = [body.part(body.time > self._done - 2.0 * RISE_HALF) for body in self._bodies]

    @property
    def length(self) -> Value:
        """The length in m for all poses so far, and its standard deviation."""
        covariance = inverse(self._information)
        step = covariance @ self._score
        at = int(np.flatnonzero(self._fit.free == R)[0])
        return Value(2.0 * float(self._fit.theta[R] + step[at]), 2.0 * math.sqrt(covariance[at, at]))
