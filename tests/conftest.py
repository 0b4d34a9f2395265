"""Set-up of every test: one thread for OpenBLAS, and hypothesis without chance."""

import os

from hypothesis import settings

# As the Makefile exports it (test_frame compares the two); read when NumPy is first imported.
os.environ["OPENBLAS_NUM_THREADS"] = "1"

# Derandomised: whether the tests pass depends on the code alone. No deadline: the machine may be shared.
settings.register_profile("fip", derandomize=True, deadline=None)
settings.load_profile("fip")
