"""Counts the solver's late and failed solves, and keeps its last plan to go on with."""

import numpy as np
from numpy.typing import NDArray

from fiplib.flight.limits import Limits
from fiplib.params import NANO, STATES, Params, X, Y


class SolverWatch:
    """Counts solves that failed or came late. Times in ns.

    Attributes:
        failure: what the solver failed with last, ``None`` if it never did.
        hovering_since: since when fixed gains stand in for the solver, ``None`` while they do not.
    """

    def __init__(self, params: Params, limits: Limits) -> None:
        self._safety, self._step = limits.safety, params.control.step
        self.failure: str | None = None
        self.hovering_since: int | None = None
        self._place: NDArray | None = None
        self._failures = self._late = 0
        self._retry = 0
        self._tried = False
        self._plan: tuple[int, NDArray] | None = None

    @property
    def troubled(self) -> bool:
        """Return whether the last solve failed or was late."""
        return self._failures > 0 or self._late > 0

    def waits(self, now: int) -> bool:
        """Return whether it is too early to try a solver again that has failed."""
        return self.hovering_since is not None and now < self._retry

    def tries(self) -> None:
        """Take note that a solve begins."""
        self._tried = True

    def solved(self, now: int, inputs: NDArray) -> None:
        """Take the inputs (n, 2) of a plan that begins now."""
        self._failures, self.hovering_since, self._plan = 0, None, (now, inputs)

    def failed(self, now: int, failure: str) -> str | None:
        """Take a failure; returns the reason to give the solver up, or ``None`` while the plan bridges it."""
        self.failure = failure
        self._failures += 1
        self._retry = now + round(self._safety.solver_retry * NANO)
        if self._failures <= self._safety.coast_ticks and self._plan:
            return None
        return f"solve failed {self._failures} times in a row ({failure})"

    def took(self, seconds: float) -> int:
        """Take how long the last solve took, s; returns how many were late in a row, 0 if there was no solve."""
        tried, self._tried = self._tried, False
        if tried:
            self._late = 0 if seconds <= self._safety.solve_limit else self._late + 1
        return self._late if tried else 0

    def hover(self, now: int, reason: str) -> None:
        """Let fixed gains stand in from now on."""
        self.hovering_since, self._place, self.failure = now, None, reason
        self._retry = now + round(self._safety.solver_retry * NANO)

    def hovered(self, now: int) -> float:
        """Return for how long fixed gains have stood in, s; 0 while they do not."""
        return (now - self.hovering_since) / NANO if self.hovering_since is not None else 0.0

    def place(self, state: NDArray) -> NDArray:
        """Return the state (10,) that fixed gains hold: at rest, where the vehicle was at the first such ``state``."""
        if self._place is None:
            self._place = np.zeros(len(STATES))
            self._place[[X, Y]] = state[[X, Y]]
        return self._place

    def planned(self, now: int) -> NDArray:
        """Return the plan's input (2,) for now; zeros (the tilt is held) once the plan is too old."""
        since, inputs = self._plan or (0, np.zeros((1, 2)))
        if (now - since) / NANO > 2.0 * self._safety.pose_level:
            return np.zeros(2)
        node = int((now - since) / NANO / self._step)
        return inputs[max(0, min(len(inputs) - 1, node))]
