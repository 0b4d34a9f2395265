"""The common parts of all estimators: the estimate, an entry of the registry, the prior. Imports no solver."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from inspect import Parameter, signature
from pkgutil import resolve_name
from typing import Any, NamedTuple

import numpy as np

from fiplib.params import Params


@dataclass(frozen=True)
class Estimate:
    """A length in m and its standard deviation in m (nan if none is stated); ``reason`` says why it was refused.

    A refused estimate has a length of nan, so that it cannot be taken for one. ``assumed`` are sentences: what was
    taken for granted, where an estimator says so.
    """

    length: float
    standard_deviation: float
    reason: str | None = None
    assumed: tuple[str, ...] = ()


class Estimator(NamedTuple):
    """A function, as 'module:name' within this package, and the kind of window it takes: 'states' or 'raw'.

    One that ``streams`` is a class, whose objects are such functions and remember the windows of their flight.
    """

    path: str
    kind: str
    streams: bool = False

    @property
    def function(self) -> Callable[..., Estimate]:
        """A function (window, params, rng) -> Estimate, to be taken once for all windows of a flight.

        Its module is imported now. It raises ValueError for arguments of another kind, before the estimator sees them.
        """
        found = resolve_name(f"{__package__}.{self.path}")
        function = found() if self.streams else found
        needs_rng = signature(function).parameters["rng"].default is Parameter.empty

        @wraps(found, updated=())
        def checked(window: Any, params: Any, rng: Any = None) -> Estimate:
            self._check(window, params, rng, needs_rng)
            return function(window, params, rng)

        return checked

    def _check(self, window: Any, params: Any, rng: Any, needs_rng: bool) -> None:
        """Raise ValueError unless these are a window of this kind, parameters and, if needed, a generator."""
        from fiplib.estimators.windows import RawWindow  # here: this module is imported by what windows import
        from fiplib.kalman import Window

        name, kind = self.path.partition(":")[2], {"states": Window, "raw": RawWindow}[self.kind]
        for what, value, wanted in (("window", window, kind), ("params", params, Params)):
            if not isinstance(value, wanted):
                raise ValueError(
                    f"{name} takes a {what} of the type {wanted.__name__}, not {type(value).__name__} ({value!r:.60})"
                )
        if not isinstance(rng, np.random.Generator) and (needs_rng or rng is not None):
            raise ValueError(f"{name} takes an rng made by numpy.random.default_rng, not {type(rng).__name__}")

    def answer(self, window: Any, params: Params, rng: Any) -> Estimate:
        """Return what may be stated as a result: ``checks.checked`` of the function's estimate.

        In flight the function itself is used: the hand-over, not a refusal, decides there what is taken over.
        """
        checked = resolve_name(f"{__package__}.checks:checked")
        return checked(self.function(window, params, rng), window, params)


PRIOR = (1.1, 0.5)
"""Mean and standard deviation in m of the length before any data, for the estimators that need one: the middle of the
paper's interval from 0.2 to 2 m, which then is nearly +-2 deviations wide."""
