"""What estimators share: the estimate, an entry of the registry, the prior, the regression. Imports no solver."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pkgutil import resolve_name
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fiplib.params import AXES, GRAVITY, Params

if TYPE_CHECKING:
    from fiplib.kalman import Window


@dataclass(frozen=True)
class Estimate:
    """A length in m and its standard deviation in m (nan if none is stated); ``reason`` says why it was refused.

    A refused estimate has a length of nan, so that it cannot be taken for one.
    """

    length: float
    standard_deviation: float
    reason: str | None = None


class Estimator(NamedTuple):
    """A function, as 'module:name' within this package, and the kind of window it takes: 'states' or 'raw'."""

    path: str
    kind: str

    @property
    def function(self) -> Callable[..., Estimate]:
        """The function (window, params, rng) -> Estimate; its module is imported now."""
        return resolve_name(f"{__package__}.{self.path}")


PRIOR = (1.1, 0.5)
"""Mean and standard deviation in m of the length before any data, for the estimators that need one: the middle of the
paper's interval from 0.2 to 2 m, which then is nearly +-2 deviations wide."""


def regression(window: "Window") -> tuple[NDArray, NDArray]:
    """Regressor 2 g d and response d'' + g tilt, (2 (n - 1),), in time order, both as means over a step."""
    rows = []
    for axis in AXES:
        _, _, offset, offset_rate, tilt = axis.states
        mean = (window.states[1:] + window.states[:-1]) / 2
        second = np.diff(window.states[:, offset_rate]) / window.step
        rows.append((2 * GRAVITY * mean[:, offset], second + GRAVITY * axis.sign * mean[:, tilt]))
    regressor, response = np.array(rows).transpose(1, 2, 0).reshape(2, -1)
    return regressor, response


def inverted(inverse: float, deviation: float, params: Params) -> Estimate:
    """From 1/l and its standard deviation to l, to first order; refused outside the interval of lengths."""
    if not params.estimation.length_min < 1 / max(inverse, 1e-9) < params.estimation.length_max:
        return Estimate(math.nan, math.nan, f"the regression gives 1/l = {inverse:.2g} 1/m, not a rod in question")
    return Estimate(1 / inverse, deviation / inverse**2)
