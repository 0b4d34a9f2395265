"""What all estimators share: the estimate, an entry of the registry, the prior. Imports no solver."""

from collections.abc import Callable
from dataclasses import dataclass
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
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

        Its module is imported now.
        """
        found = resolve_name(f"{__package__}.{self.path}")
        return found() if self.streams else found

    def answer(self, window: Any, params: "Params", rng: Any) -> Estimate:
        """Return what may be stated as a result: ``checks.checked`` of the function's estimate.

        In flight the function itself is used: the hand-over, not a refusal, decides there what is taken over.
        """
        checked = resolve_name(f"{__package__}.checks:checked")
        return checked(self.function(window, params, rng), window, params)


PRIOR = (1.1, 0.5)
"""Mean and standard deviation in m of the length before any data, for the estimators that need one: the middle of the
paper's interval from 0.2 to 2 m, which then is nearly +-2 deviations wide."""
