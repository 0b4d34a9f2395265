"""Leans, laps, settling, convergence and changes of the length, on made-up flights."""

import math

import numpy as np
import pytest

from fiplib.params import A, B, X, Y
from fiplib.recording import BagError
from fiplib.references import Circle
from fiplib.reproduction import measures
from tests.reproduction.made_up import RATE, TICK, flight, moments


def test_settling_is_counted_from_the_last_sample_outside():
    time = np.arange(5.0)
    assert measures.settling_time(time, np.array([True, False, True, False, False])) == 3.0
    assert measures.settling_time(time, np.zeros(5, bool)) == 0.0
    assert measures.settling_time(time, time >= 4) == math.inf


def test_an_offset_becomes_an_angle_by_the_arc_sine_as_in_the_paper():
    # the paper prints 5.8 cm as 6.67 deg and 2.5 cm as 2.87 deg; its centimetres are rounded to 0.05 cm, 0.06 deg
    assert measures.angle(0.058, flight(1)) == pytest.approx(6.67, abs=0.06)
    assert measures.angle(0.025, flight(1)) == pytest.approx(2.87, abs=0.06)
    assert measures.angle(9.0, flight(1)) == 90.0


def test_a_rod_that_leans_beyond_thirty_degrees_has_fallen_then():
    lean = 0.1 * moments(4)  # m; the COM of a 1 m rod is 0.25 m off at 30 deg, reached at 2.5 s
    assert measures.fall_time(flight(4, {A: lean})) == pytest.approx(2.5, abs=TICK)
    assert measures.fall_time(flight(2, {A: 0.1 * moments(2)})) == math.inf
    # a and b of 0.2 m each lean by 34 deg together
    assert measures.fall_time(flight(1, {A: np.full(RATE, 0.2), B: np.full(RATE, 0.2)})) == 0.0


@pytest.mark.parametrize("clockwise", [1.0, -1.0])
def test_a_circle_is_read_off_the_reference_whichever_way_it_turns(clockwise):
    reference = Circle(radius=0.4, period=8.0).at(moments(25))
    reference[:, Y] *= clockwise
    lap = measures.laps(flight(25, reference=reference))
    assert lap.period == pytest.approx(8.0, abs=1e-6)
    assert lap.radius == pytest.approx(0.4)
    assert lap.mask.sum() == pytest.approx(2 * 8 * RATE, abs=1)  # at speed from 5 s to 25 s: two whole laps
    assert lap.phase[-1] == pytest.approx(2 * math.pi * (25 - 1 - 2 - 1 / RATE) / 8.0, abs=1e-6)


@pytest.mark.parametrize("clockwise", [1.0, -1.0])
def test_amplitude_and_delay_of_x_are_found(clockwise):
    circle = Circle(radius=0.8, period=9.0)
    reference, late = circle.at(moments(26)), circle.at(moments(26) - 0.12)
    reference[:, Y] *= clockwise
    gain, delay = measures.x_response(flight(26, {X: 0.93 * late[:, X] + 0.05}, reference=reference))
    assert gain == pytest.approx(0.93, abs=1e-6)  # a constant offset is no part of the amplitude
    assert delay == pytest.approx(0.12, abs=1e-6)


def test_a_hover_or_half_a_circle_is_refused_as_a_circle():
    with pytest.raises(BagError, match="no whole circle"):
        measures.laps(flight(5))
    with pytest.raises(BagError, match="no whole circle"):
        measures.laps(flight(10, reference=Circle(radius=0.4, period=8.0).at(moments(10))))


def test_convergence_is_the_last_median_its_error_and_the_time_it_was_first_kept():
    lengths = [(0.0, 1.4), (5.5, 1.2), (8.0, 1.06), (12.0, 1.03), (17.0, 1.01), (19.0, 1.02)]
    found = measures.convergence(flight(20, lengths=lengths))
    assert found == measures.Convergence(pytest.approx(1.015), pytest.approx(0.015), 8.0)


def test_a_length_that_was_never_updated_late_converges_to_its_last_value():
    assert measures.convergence(flight(20, lengths=[(0.0, 0.8), (6.0, 1.0)])) == (1.0, 0.0, 6.0)


def test_jumps_end_at_the_next_one_or_in_a_fall():
    lean = np.where(moments(20) > 18, 0.3, 0.0)
    lengths = [(0.0, 1.0), (6.0, 0.4), (11.0, 1.0), (16.0, 1.85)]
    first, second, third = measures.jumps(flight(20, {A: lean}, lengths=lengths))
    assert first == (pytest.approx(0.6), 6.0, 11.0, False)
    assert second == (pytest.approx(0.6), 11.0, 16.0, False)
    assert third == (pytest.approx(0.85), 16.0, pytest.approx(18.0, abs=TICK), True)


def test_what_a_flight_lacks_is_named():
    bare = flight(5)
    with pytest.raises(BagError, match="push"):
        measures.push_times(bare)
    with pytest.raises(BagError, match="/fip/length"):
        measures.convergence(bare)
    with pytest.raises(BagError, match="never changes"):
        measures.jumps(flight(5, lengths=[(0.0, 1.0)]))
    object.__setattr__(bare, "reference", None)
    with pytest.raises(BagError, match="/fip/reference"):
        measures.lean(bare)


def test_the_interval_of_a_quantile_is_given_by_two_of_the_values():
    assert measures.quantile_interval(range(5)) == pytest.approx((math.nan, math.nan), nan_ok=True)
    # ranks 6 and 15 of 20 hold the median with 95.9 %, 7 and 14 only with 88 %
    assert measures.quantile_interval(range(20, 0, -1)) == (6.0, 15.0)
    low, high = measures.quantile_interval(range(71), 0.95)
    # nine or more of 71 above it: 1 %; eight or more: 2.52 %
    assert low == 62.0 and math.isnan(high), "0.95^71 = 2.6 %: the quantile may be above all values"
    assert measures.quantile_interval(range(72), 0.95)[1] == 71.0


def test_the_interval_of_a_quantile_holds_it_in_95_of_100_samples_or_more():
    samples = np.random.default_rng(1).exponential(size=(2000, 30))
    held = [low <= math.log(2.0) <= high for low, high in map(measures.quantile_interval, samples)]
    assert 0.95 <= np.mean(held) <= 0.99
