"""The rule of the ledger, stated before anything is judged: a verdict is a share over seeds, with its interval.

A claim is put to at least ``LEAST`` flights, each with noise of its own. Each flight agrees with the claim or does not,
by the claim's criterion. The share that agrees has the 95 % interval of Clopper and Pearson (1934), which is exact. The
claim

- *holds* if the lower limit is above 1/2: the flights agree as a rule,
- *fails* if the upper limit is below 1/2: as a rule they do not,
- is *undecided* otherwise, with fewer flights, or where the answer hangs on a choice that the paper does not print.

Where a claim speaks of each of many events (a control tick, a change below a limit), 1/2 is too little to ask; the
claim then names the share that it needs. A recorded flight illustrates a claim; it decides none.

Only claims of the kind *tested* have a verdict. A number to which one of our free choices was tuned is *fitted*: that
it agrees says nothing. What needs the vehicle is *not testable* here.
"""

import math
from collections.abc import Iterable, Sequence
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from scipy.special import bdtr

from fiplib.reproduction.measures import binomial_interval

LEAST = 20
"""Flights below which nothing is decided: of fewer than 6 even unanimity leaves the interval across 1/2, and of 20 it
takes 15."""

HALF = 0.5
"""The share that has to be exceeded, unless the claim speaks of each of many events."""

SENSITIVITY = (0.5, 1.0, 2.0)
"""Factors of a criterion's tolerance with which each verdict is shown: half, as stated, twice."""


class Kind(StrEnum):
    """Whether a claim could have failed here."""

    TESTED = "tested"
    FITTED = "fitted"
    NOT_TESTABLE = "not testable"


class Verdict(StrEnum):
    """The verdict of the flights on a claim."""

    HOLDS = "holds"
    FAILS = "fails"
    UNDECIDED = "undecided"
    NONE = "none"
    """The claim was not tested: it is fitted, or not testable without the vehicle."""
    OPEN = "open"
    """The data for a verdict are missing."""


class Share(NamedTuple):
    """``agree`` of ``flights`` agree; ``low`` and ``high`` are the limits of the share's 95 % interval."""

    agree: int
    flights: int
    low: float
    high: float


def share(agreed: Iterable[bool]) -> Share:
    """Return the share of flights that agree, from one flag for each."""
    agreed = list(agreed)
    return Share(sum(agreed), len(agreed), *binomial_interval(sum(agreed), len(agreed)))


def verdict(found: Share, kind: Kind = Kind.TESTED, needed: float = HALF, unprinted: bool = False) -> Verdict:
    """Return the verdict on a claim by the rule above.

    Args:
        found: the share of flights that agree.
        kind: only tested claims get a verdict.
        needed: the share that has to be exceeded.
        unprinted: the answer hangs on a choice that the paper does not print.
    """
    if kind is not Kind.TESTED:
        return Verdict.NONE
    if not found.flights:
        return Verdict.OPEN
    if unprinted or found.flights < LEAST or found.low <= needed <= found.high:
        return Verdict.UNDECIDED
    return Verdict.HOLDS if found.low > needed else Verdict.FAILS


class Middle(NamedTuple):
    """The median of some flights, and the limits of its 95 % interval."""

    median: float
    low: float
    high: float


def middle(values: Sequence[float]) -> Middle:
    """Return the median of independent values and its exact, distribution-free interval: two of the ordered values.

    NaN (nothing was measured) is left out; infinite values count. Of fewer than 6 values there is no such interval.
    """
    ordered = np.sort([value for value in values if not math.isnan(value)])
    if not len(ordered):
        return Middle(math.nan, math.nan, math.nan)
    rank = int(np.searchsorted(bdtr(np.arange(len(ordered)), len(ordered), 0.5), 0.025))
    low, high = (ordered[rank - 1], ordered[-rank]) if rank else (math.nan, math.nan)
    centre = ordered[(len(ordered) - 1) // 2 : len(ordered) // 2 + 1]  # of infinite ones, too
    return Middle(float(centre.mean()), float(low), float(high))
