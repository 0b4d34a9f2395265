"""fip: the flying inverted pendulum of unknown length, reproducible from recorded (simulated) flights."""

import os

__version__ = "0.1.0"

# One thread, if NumPy is not loaded yet, and in the processes started from here. Matrices here are small, and on a busy
# machine OpenBLAS's threads wait for each other: beside two busy cores a refit then takes half a minute.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
