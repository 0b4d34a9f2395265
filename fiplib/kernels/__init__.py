"""The loops that a flight and an estimate spend their time in, compiled by numba.

Each kernel has a readable definition that a test holds it equal to: ``mpc.problem``, ``kalman.filter_window``,
``dynamics.coupled_plant``. Importing a module of this room compiles it, for fixed types, so that nothing is compiled
within a control tick; the compilations are kept on disk, and later imports take a fraction of a second. Those who need
a kernel import it where they need it: numba itself takes 0.4 s.

Sums run in the order in which they are written (no ``fastmath``, no BLAS), so every CPU gives the same bits, as far as
the system's mathematical library does: glibc rounds some sines and exponentials otherwise on a CPU without FMA.
"""

import importlib

MODULES = ("control", "evolving", "filtering", "flight", "observing", "piloting", "poses", "recursion", "vehicle")
"""The modules that hold kernels."""


def load() -> None:
    """Compile every kernel, or load what an earlier call has compiled: some 30 s, then a second."""
    for name in MODULES:
        importlib.import_module(f"{__name__}.{name}")
