"""The rule of the ledger: every verdict can come out, and each where the rule says."""

import math

import numpy as np
import pytest
from scipy.stats import binom

from fiplib.reproduction.verdicts import HALF, LEAST, Kind, Verdict, middle, share, verdict


def of(agree: int, flights: int, **more) -> Verdict:
    return verdict(share([True] * agree + [False] * (flights - agree)), **more)


@pytest.mark.parametrize(
    ("agree", "expected"),
    [
        *((20, Verdict.HOLDS), (15, Verdict.HOLDS), (14, Verdict.UNDECIDED), (10, Verdict.UNDECIDED)),
        *((6, Verdict.UNDECIDED), (5, Verdict.FAILS), (0, Verdict.FAILS)),
    ],
)
def test_of_twenty_flights_fifteen_make_a_claim_hold_and_five_make_it_fail(agree, expected):
    assert of(agree, 20) is expected


def test_fewer_flights_than_twenty_decide_nothing_however_they_agree():
    assert of(LEAST - 1, LEAST - 1) is of(0, LEAST - 1) is Verdict.UNDECIDED


def test_no_flight_at_all_leaves_a_claim_open():
    assert of(0, 0) is Verdict.OPEN


@pytest.mark.parametrize("kind", [Kind.FITTED, Kind.NOT_TESTABLE])
def test_only_a_tested_claim_has_a_verdict(kind):
    assert of(40, 40, kind=kind) is of(0, 40, kind=kind) is of(0, 0, kind=kind) is Verdict.NONE


def test_a_choice_that_is_not_printed_leaves_a_claim_undecided():
    assert of(40, 40, unprinted=True) is of(0, 40, unprinted=True) is Verdict.UNDECIDED


def test_of_many_events_a_claim_may_ask_for_more_than_half():
    assert of(9_999, 10_000, needed=0.99) is Verdict.HOLDS
    assert of(9_900, 10_000, needed=0.99) is Verdict.UNDECIDED
    assert of(9_000, 10_000, needed=0.99) is Verdict.FAILS
    assert of(9_000, 10_000, needed=HALF) is Verdict.HOLDS


@pytest.mark.parametrize("true", [0.2, 0.5, 0.8])
def test_a_coin_of_half_is_decided_in_less_than_one_case_of_twenty(true):
    # exact: the probability of each outcome of 40 flights, summed over the outcomes with each verdict
    outcome = {agree: of(agree, 40) for agree in range(41)}
    chance = {one: sum(binom.pmf(k, 40, true) for k, found in outcome.items() if found is one) for one in Verdict}
    assert (chance[Verdict.HOLDS] <= 0.025) or true > 0.5
    assert (chance[Verdict.FAILS] <= 0.025) or true < 0.5
    assert chance[Verdict.HOLDS if true > 0.5 else Verdict.FAILS] > 0.98 or true == 0.5


def test_the_median_has_its_exact_interval_among_the_ordered_values():
    # of 20 values the 6th and the 15th: P(fewer than 6 of 20 below the median) = 0.0207
    assert middle(range(1, 21)) == (10.5, 6.0, 15.0)
    assert 2 * binom.cdf(5, 20, 0.5) <= 0.05 < 2 * binom.cdf(6, 20, 0.5)


def test_a_median_takes_infinite_values_and_leaves_nan_out():
    found = middle([math.nan] * 5 + [1.0] * 9 + [math.inf] * 12)
    assert found.median == math.inf and found.low == 1.0 and found.high == math.inf


def test_a_few_values_have_a_median_and_no_interval():
    found = middle([3.0, 1.0, 2.0])
    assert found.median == 2.0 and math.isnan(found.low) and math.isnan(found.high)
    assert all(np.isnan(middle([])))
