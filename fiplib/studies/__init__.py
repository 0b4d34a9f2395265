"""The Monte Carlo studies, one module each; ``python -m fiplib.studies.sweep NAME`` runs one over all cores, or a cluster.

A study module has

- ``KEYS: tuple[str, ...]``: the columns that identify a case,
- ``cases() -> list[dict]``: the full study in a fixed order, plain str, int and float values,
- ``run(case) -> dict``: the result columns of one case, plain values as well. It is pure: a case carries all that its
  result depends on, its seed included, so that a lost case can be run again, anywhere.

Results land in ``data/sweeps/NAME.csv``, one row per case.
"""

import importlib
from types import ModuleType

STUDIES = {
    name: f"{__name__}.{name}"
    for name in (
        "survival",
        "length_jumps",
        "weights",
        "ledger_seeds",
        "ledger_readings",
        "landscapes",
        "landscape_curves",
        "bounds",
        "estimators",
        "imperfections",
        "handover",
    )
}
"""Module of each study, by name; imported when it is asked for."""


def load(name: str) -> ModuleType:
    """The module of the study ``name``, a key of ``STUDIES``."""
    return importlib.import_module(STUDIES[name])


def run(module: str, case: dict) -> dict:
    """One case of the study in ``module``: what a worker executes, known to it by this name alone."""
    return importlib.import_module(module).run(case)
