"""The two short filters are SciPy's."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lfilter, savgol_filter

from fiplib.estimators.signals import first_order, local_parabola


@given(st.integers(0, 2**32), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_the_recursion_is_that_of_scipy(seed, now, before, decay):
    rng = np.random.default_rng(seed)
    source, start = rng.normal(size=(2, 3, 40)), rng.normal(size=(2, 3))
    expected, _ = lfilter([now, before], [1.0, -decay], source, axis=-1, zi=start[..., None])
    # the same operations in the same order
    np.testing.assert_allclose(first_order(source, now, decay, before, start), expected, rtol=1e-14, atol=1e-14)
    one = first_order(source[0, 0], now, decay)
    np.testing.assert_allclose(one, lfilter([now], [1.0, -decay], source[0, 0]), rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize(("samples", "span"), [(60, 25), (25, 25), (16, 5), (9, 3)])
@pytest.mark.parametrize("derivative", [0, 1])
def test_the_local_parabola_is_the_filter_of_savitzky_and_golay(samples, span, derivative):
    values = np.cumsum(np.random.default_rng(samples).normal(size=(samples, 3)), axis=0)
    expected = savgol_filter(values, span, 2, deriv=derivative, delta=0.01, axis=0)
    # rounding of sums of `span` products, over the period for a rate
    np.testing.assert_allclose(local_parabola(values, span, 0.01, derivative), expected, rtol=1e-10, atol=1e-10)
