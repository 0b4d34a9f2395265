"""Judges estimates of the length before the pilot uses them, and notices a silent estimator."""

import math
from numbers import Real

from fiplib.flight.limits import Limits
from fiplib.params import NANO, Params

BELIEVED = 3
"""An estimate far from the length in use is accepted when it is the third such in a row."""


class LengthGate:
    """Refuses absurd estimates, approaches far ones in steps, and notices when none come."""

    def __init__(self, params: Params, limits: Limits) -> None:
        self._estimation, self._expected, self._safety = params.estimation, params.piloting.estimate, limits.safety
        self._far = self._heard = 0
        self._silent = False

    def judge(self, length: float, deviation: float, used: float) -> tuple[float | None, str | None]:
        """Judge an estimate.

        Args:
            length: m; not finite or outside [l_min, l_max] it is refused. One that is further than ``estimate_jump``
                from the length in use is refused too, unless it is the third such in a row: then it is approached.
            deviation: its standard deviation, m; nan if it has none.
            used: the length in use, m.

        Returns:
            The length to use, m, ``None`` if the estimate is refused; and a remark if it was refused or changed.
        """
        if not all(isinstance(value, Real) and not isinstance(value, bool) for value in (length, deviation)):
            return None, f"absurd estimate refused: {type(length).__name__} +- {type(deviation).__name__}"
        estimation, jump, slack = self._estimation, self._safety.estimate_jump, self._estimation.resolution
        if not (estimation.length_min - slack <= length <= estimation.length_max + slack) or deviation < 0.0:
            return None, f"absurd estimate refused: {length:g} m +- {deviation:g} m"
        remark = None
        if abs(length - used) > jump + slack:
            self._far += 1
            if self._far < BELIEVED:
                return None, f"estimate refused: {length:.3g} m after {used:.3g} m is a jump"
            length = used + math.copysign(jump, length - used)
            remark = f"three estimates far away: length approached, {length:.3g} m"
        self._far = 0
        return float(length), remark

    def heard(self, now: int) -> None:
        """Take note that the estimator has answered, or may begin to, at ``now`` ns."""
        self._heard, self._silent = now, False

    def falls_silent(self, now: int) -> bool:
        """Return whether no estimate has come for ``estimate_silence``; true once until the next one."""
        silent = self._expected and (now - self._heard) / NANO > self._safety.estimate_silence
        news, self._silent = silent and not self._silent, silent or self._silent
        return news
