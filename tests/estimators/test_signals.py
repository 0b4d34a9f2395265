"""The first-order filter is SciPy's."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lfilter

from fiplib.estimators.signals import first_order


@given(st.integers(0, 2**32), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_the_recursion_is_that_of_scipy(seed, now, before, decay):
    rng = np.random.default_rng(seed)
    source, start = rng.normal(size=(2, 3, 40)), rng.normal(size=(2, 3))
    expected, _ = lfilter([now, before], [1.0, -decay], source, axis=-1, zi=start[..., None])
    # the same operations in the same order
    np.testing.assert_allclose(first_order(source, now, decay, before, start), expected, rtol=1e-14, atol=1e-14)
    one = first_order(source[0, 0], now, decay)
    np.testing.assert_allclose(one, lfilter([now], [1.0, -decay], source[0, 0]), rtol=1e-14, atol=1e-14)
