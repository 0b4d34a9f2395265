"""Pins what the bytes of a result depend on, before NumPy loads: replaying a bag must agree to the last bit."""

import os
import sys

from hypothesis import settings

# As the Makefile exports it (test_frame compares the two): one thread, and the kernels of a 2013 CPU on any newer one.
NUMERIC_ENVIRONMENT = {
    "OPENBLAS_CORETYPE": "Haswell",
    "OPENBLAS_NUM_THREADS": "1",
    "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR",
}

if any(os.environ.get(name) != value for name, value in NUMERIC_ENVIRONMENT.items()):
    if "numpy" in sys.modules:
        raise RuntimeError("NumPy was loaded before tests/conftest.py could pin its kernels; run 'make test' instead")
    os.environ.update(NUMERIC_ENVIRONMENT)

# Derandomised: whether the tests pass depends on the code alone. No deadline: the machine may be shared.
settings.register_profile("fip", derandomize=True, deadline=None)
settings.load_profile("fip")
