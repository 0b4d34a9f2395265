"""What the notebooks share: a fast switch, folders of the repository, the table of expected and measured values."""

import os
from collections.abc import Mapping
from pathlib import Path

import matplotlib.pyplot as plt

from fiplib.reproduction.style import STYLE

FAST = bool(os.environ.get("FIP_FAST"))
"""Whether the notebooks use their small settings: ``FIP_FAST=1`` in the environment, as ``make test`` sets it."""

FOLDERS = (*Path(__file__).parents, Path.cwd(), *Path.cwd().parents)
ROOT = next((folder for folder in FOLDERS if (folder / "data/SHA256SUMS").is_file()), Path.cwd())
"""The repository: the folder with our recorded flights above this file, or above the working directory."""

DATA, FIGURES = ROOT / "data", ROOT / "figures"
"""The recorded flights, and the products of ``make figures``."""

PLOT_STYLE = STYLE | {"figure.figsize": (5.6, 2.6), "figure.dpi": 130, "figure.constrained_layout.use": True}
"""The style of the printed figures, at the width of a notebook."""


def begin() -> None:
    """Apply the plot style of the notebooks."""
    plt.rcParams.update(PLOT_STYLE)


def beside(rows: Mapping[str, tuple[float, float, float]], unit: str = "") -> None:
    """Print the expected values beside the measured ones, and require that they agree.

    ``rows`` are (expected, measured, tolerance) by name; the tolerance is absolute, in the ``unit`` of all values.
    Raises AssertionError: a measured value differs from the expected one by more than that, or is not a number.
    """
    width = max(map(len, rows))
    print(f"{'':{width}}  {'expected':>12}  {'measured':>12}  {unit}")
    for name, (expected, measured, _) in rows.items():
        print(f"{name:{width}}  {expected:12.6g}  {measured:12.6g}")
    for name, (expected, measured, tolerance) in rows.items():
        if not abs(measured - expected) <= tolerance:
            raise AssertionError(
                f"{name}: expected {expected:.6g} {unit} within {tolerance:.2g}, measured {measured:.6g}"
            )
