"""What all estimators share: the estimate, the kind of window, the prior."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from fiplib.params import Params


@dataclass(frozen=True)
class Estimate:
    """A length in m and its standard deviation in m (nan if none is stated); ``reason`` says why it was refused.

    A refused estimate has a length of nan, so that it cannot be taken for one.
    """

    length: float
    standard_deviation: float
    reason: str | None = None


PRIOR = (1.1, 0.5)
"""Mean and standard deviation in m of the length before any data, for the estimators that need one: the middle of the
paper's interval from 0.2 to 2 m, which then is nearly +-2 deviations wide."""


class Estimator(NamedTuple):
    """A function (window, params, rng) -> Estimate, and the kind of window it takes: 'states' or 'raw'."""

    function: Callable[..., Estimate]
    kind: str


def _within(length: float, params: Params) -> float:
    return min(max(float(length), params.estimation.length_min), params.estimation.length_max)
