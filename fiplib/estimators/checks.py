"""Checks that refuse a meaningless estimate: implausible flights before the fit, its residuals after it."""

import math
from dataclasses import replace

import numpy as np

from fiplib.estimators.base import Estimate
from fiplib.kalman import Window, filter_window
from fiplib.params import STATES, Params
from fiplib.recording import Flight

LARGEST_SAMPLE = 6.0
"""Refused above this normalised innovation squared of one sample, per state: one in 10^9 by chance."""

LARGEST_STATE = 2.5
"""Refused above this mean square of the standardised innovations of one state: 1.2 to 1.5 in flights of ours."""

NEAR_END = 1e-3
"""A length this close to an end of the search interval, in parts of it, is that end; or within its own deviation: the
filters that are kept within the interval leave its end by less."""


def why_no_length(flight: Flight, commands: bool = False) -> str | None:
    """Return why no length of this flight would mean anything, in one sentence; None if nothing speaks against it.

    With ``commands``, for estimators that need them, the commands are checked, too.
    """
    from fiplib.bags.checks import findings

    names = ("commands",) if commands else ()
    against = (finding.sentence for finding in findings(flight) if finding.refuses or finding.name in names)
    return next(against, None)


def tracked(flight: Flight) -> Flight:
    """Return the flight without the poses of bodies that were not tracked, as ``bags.tracking`` finds them."""
    from fiplib.bags import tracking

    return tracking.tracked(flight)


def checked(found: Estimate, window: object, params: Params) -> Estimate:
    """Return an estimate as it may be stated: refused at an end of its search interval, or by its residuals.

    The residuals are the innovations of the paper's filter at the estimated length, on a window of states; estimators
    that take anything else test their own.
    """
    reason = found.reason or _at_an_end(found, params)
    if reason is None and isinstance(window, Window) and math.isfinite(found.standard_deviation):
        reason = _unexplained(found.length, window, params)
    return replace(found, length=math.nan, standard_deviation=math.nan, reason=reason) if reason else found


def _at_an_end(found: Estimate, params: Params) -> str | None:
    low, high = params.estimation.length_min, params.estimation.length_max
    margin = NEAR_END * (high - low)
    if math.isfinite(found.standard_deviation):
        margin = max(margin, found.standard_deviation)
    if low + margin < found.length < high - margin:
        return None
    return (
        f"the best length is at the end of the interval from {low:g} to {high:g} m that was searched: the window does "
        "not determine the length, or the rod's length is outside; take a longer window, or widen the interval"
    )


def _unexplained(length: float, window: Window, params: Params) -> str | None:
    estimation = replace(params.estimation, fitness="rk4_likelihood")
    filtered = filter_window([length], window, estimation)
    sample = float(filtered.nis.max()) / len(STATES)
    spread = np.sqrt(np.einsum("nkii->nki", filtered.covariances))
    states = np.mean((filtered.innovations / spread) ** 2, axis=(0, 1))
    worst = int(states.argmax())
    if sample > LARGEST_SAMPLE:
        when = (int(filtered.nis.argmax()) + 1) * window.step
        return (
            f"the model does not explain the window {when:.1f} s from its start (squared innovations {sample:.0f} "
            "times as large as expected): the rod was pushed or mistracked; leave that stretch out"
        )
    if states[worst] > LARGEST_STATE:
        return (
            f"the model does not explain {STATES[worst].name} (squared innovations {states[worst]:.1f} times as large "
            "as expected): check the frames, the commands and the stamps, or state more noise"
        )
    return None
