"""The estimate of a flight that goes on."""

import math

import numpy as np
from numpy.typing import NDArray

from fiplib.estimators.poses.checks import largest_jump
from fiplib.estimators.poses.estimate import solved
from fiplib.estimators.poses.filter import MU, R, Rows, State, run
from fiplib.estimators.poses.fit import STEP, Fit, Value, inverse, maximise, neighbours
from fiplib.estimators.poses.knowledge import Knowledge
from fiplib.estimators.poses.rows import RISE_HALF, Body, cleaned, rows_of

RECENT = 0.3
"""How far back in s innovations are looked at for a jump."""


class Running:
    """Score and Fisher information at one maximum, gathered row by row, at a constant cost each.

    One Newton step from that maximum gives the maximum for all rows so far. ``fit`` is the maximum it began from.
    """

    def __init__(self, fit: Fit, time: float, axes: int) -> None:
        self.fit, self._lanes = fit, neighbours(fit.theta, fit.free)
        deviations, slopes = fit.prior.at(self._lanes)
        self._score, self._information = -slopes @ deviations, slopes @ slopes.T
        self._state = State.at(time, axes)
        self._recent = np.zeros(0), np.zeros((0, axes))

    def add(self, rows: Rows) -> None:
        """Filter more rows, later than all before."""
        out = run(rows, self._lanes, np.full(len(self.fit.free), STEP), innovations=True, state=self._state)
        self._score += out.score
        self._information += out.fisher
        time, innovation = (np.concatenate(two) for two in zip(self._recent, (rows.time, out.innovation), strict=True))
        late = time > time[-1] - RECENT
        self._recent = time[late], innovation[late]

    @property
    def step(self) -> tuple[NDArray, NDArray]:
        """From the first maximum to that for all rows so far, in the free parameters; their standard deviations."""
        covariance = inverse(self._information)
        return covariance @ self._score, np.sqrt(np.diag(covariance))

    @property
    def length(self) -> Value:
        """Return the length in m for all rows so far, and its standard deviation."""
        step, deviations = self.step
        at = int(np.flatnonzero(self.fit.free == R)[0])
        return Value(2.0 * float(self.fit.theta[R] + step[at]), 2.0 * float(deviations[at]))

    @property
    def jump(self) -> float:
        """Return the largest mean squared innovation of late, see ``checks.largest_jump``."""
        return largest_jump(*self._recent)


class Stream:
    """The estimate of a flight that goes on: poses are added as they arrive.

    The filter of a first window's maximum and of its neighbours runs on, see ``Running``. When a parameter has moved by
    more than its standard deviation, about once each time that the flight has become twice as long, the maximum is
    sought anew on all rows, from where it is then: the cost of a flight is linear in its duration. Of the checks that
    ``estimate`` makes only one is repeated, ``jump``.

    Args:
        vehicle, rod: the first window, 2.5 s or more; see ``estimate``.
        knowledge: priors. The rod is taken to be tracked at its middle unless ``marker_offset`` says otherwise.

    Raises:
        ValueError: the first window does not give an estimate; the message says why.
    """

    def __init__(self, vehicle: Body, rod: Body, knowledge: Knowledge | None = None) -> None:
        answer, problem, fit = solved(vehicle, rod, knowledge)
        if answer.reason is not None:
            raise ValueError(answer.reason)
        self._bodies = [cleaned(vehicle), cleaned(rod)]
        self._origin = self._bodies[0].position[0]
        self._running, self._rows = Running(fit, problem.rows.time[0], 2), list[Rows]()
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
            self._running.add(self._rows[-1])
            self._done = until
            self._follow()
        # what smoothing needs of the past
        self._bodies = [body.part(body.time > self._done - 2.0 * RISE_HALF) for body in self._bodies]

    def _follow(self) -> None:
        """Seek the maximum anew if it has moved."""
        fit, (step, deviations) = self._running.fit, self._running.step
        if np.any(np.abs(step) > deviations):
            theta = fit.theta.copy()
            theta[fit.free] += step
            theta[R], theta[MU] = max(theta[R], 1e-3), max(theta[MU], 0.0)
            rows = Rows(*(np.concatenate(columns) for columns in zip(*self._rows, strict=True)))
            self._running, self._rows = Running(maximise(rows, theta, fit.free, fit.prior), rows.time[0], 2), [rows]
            self._running.add(rows)

    @property
    def length(self) -> Value:
        """Return the length in m for all poses so far, and its standard deviation."""
        return self._running.length

    @property
    def jump(self) -> float:
        """Return the largest mean squared innovation of late, see ``checks.largest_jump``."""
        return self._running.jump
