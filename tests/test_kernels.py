"""Compiled loops: compiled once and for fixed types, on disk where that is possible."""

import numba
import numpy as np
from numba.core import caching

from fiplib import kernels


def test_every_kernel_that_python_calls_is_compiled_at_import_and_for_one_signature_only():
    for kernel in (kernels.riccati, kernels.solve, kernels.fitness):
        assert len(kernel.signatures) == 1
        # else an argument of another type would be compiled for within a control tick; here it is refused
        assert not kernel._can_compile
        assert kernel.targetoptions["error_model"] == "numpy" and "fastmath" not in kernel.targetoptions


def test_where_no_compilation_can_be_kept_one_line_says_so(monkeypatch, capsys):
    monkeypatch.setattr(caching.CacheImpl, "_locator_classes", [])
    monkeypatch.setitem(kernels._OPTIONS, "cache", True)

    @kernels.compiled("f8(f8)")
    def twice(x):
        return 2 * x

    @kernels.compiled("f8(f8)")
    def thrice(x):
        return 3 * x

    assert (twice(2.0), thrice(2.0)) == (4.0, 6.0)
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "NUMBA_CACHE_DIR" in said


def test_sums_are_neither_reordered_nor_fused():
    # each of these would give another number: ((1e16 + 1) - 1e16) in real arithmetic is 1; a fused a * a - b is not 0
    @numba.njit("f8(f8[::1])", **kernels._OPTIONS | {"cache": False})
    def total(values):
        result = 0.0
        for value in values:
            result += value
        return result

    @numba.njit("f8(f8, f8)", **kernels._OPTIONS | {"cache": False})
    def square_minus(a, b):
        return a * a - b

    assert total(np.array([1e16] + [1.0] * 64 + [-1e16])) == 0.0
    assert square_minus(1.0 + 2.0**-30, (1.0 + 2.0**-30) ** 2) == 0.0
