"""What the notebooks share: the fast switch, where the repository is, and the table of expected beside measured."""

import os
from collections.abc import Mapping
from pathlib import Path

import matplotlib.pyplot as plt

from fiplib.reproduction.style import STYLE

FAST = bool(os.environ.get("FIP_FAST"))
"""Whether notebooks take their small settings: set ``FIP_FAST=1`` in the environment, as ``make test`` does."""

ROOT = Path(__file__).parents[1]
"""The repository, wherever the notebook runs."""

DATA, FIGURES = ROOT / "data", ROOT / "figures"
"""The recorded flights, and what ``make figures`` made."""

PLOT_STYLE = STYLE | {"figure.figsize": (5.6, 2.6), "figure.dpi": 130, "figure.constrained_layout.use": True}
"""The look of the printed figures, at the width of a notebook."""


class Mismatch(AssertionError):
    """A measured value of a notebook is not the expected one; the message names it."""


def begin() -> None:
    """The plot style of the notebooks."""
    plt.rcParams.update(PLOT_STYLE)


def beside(rows: Mapping[str, tuple[float, float, float]], unit: str = "") -> None:
    """Print expected beside measured, and insist on their agreement.

    Args:
        rows: by name, (expected, measured, tolerance): absolute, in the unit of the values.
        unit: of all values.

    Raises:
        Mismatch: a measured value is further from the expected one than the tolerance, or not a number.
    """
    width = max(map(len, rows))
    print(f"{'':{width}}  {'expected':>12}  {'measured':>12}  {unit}")
    for name, (expected, measured, _) in rows.items():
        print(f"{name:{width}}  {expected:12.6g}  {measured:12.6g}")
    for name, (expected, measured, tolerance) in rows.items():
        if not abs(measured - expected) <= tolerance:
            raise Mismatch(f"{name}: expected {expected:.6g} {unit} within {tolerance:.2g}, measured {measured:.6g}")
