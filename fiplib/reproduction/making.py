"""Make a product and write its files; the registry as the Makefile reads it."""

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from fiplib.params import FipError
from fiplib.reproduction import dependencies, gallery
from fiplib.reproduction.sources import Product, Rows, Sources

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from fiplib.reproduction.tables import Table


def make(product: Product, data: Path, check: Callable[[str, Rows], object]) -> "Figure | Table":
    """Make a figure or table from what it names in ``data``; ``check`` as for ``Sources.read``.

    Raises:
        FipError: what it is made from is missing or damaged, or lacks something.
    """
    sources = product.read(data, check)
    for source, what in zip(sources, product.names, strict=True):
        if not source and what.removeprefix("sweeps/") not in product.behind:
            again = Sources(studies=product.studies, benchmarks=product.benchmarks).command
            raise FipError(f"{what} is missing: {again}")
    from fiplib.reproduction.style import styled

    with styled():
        return product.load()(*sources)


def caption(product: Product) -> str:
    """The docstring of a product's function as one paragraph, without "Fig. 7: " or "Table 7: " at its beginning."""
    text = re.sub(r"^(Fig\.|Table) \d+: ", "", " ".join((product.load().__doc__ or "").split()))
    return text[:1].upper() + text[1:]


def suffixes(name: str) -> tuple[str, str]:
    """The formats in which a product is written."""
    return (".pdf", ".png") if name.startswith("fig") else (".csv", ".tex")


def write(name: str, product: Product, made: "Figure | Table", folder: Path) -> list[Path]:
    """Write a figure as PDF and PNG, a table as CSV and LaTeX; the same input gives the same bytes."""
    folder.mkdir(parents=True, exist_ok=True)
    first, second = paths = [folder / f"{name}{suffix}" for suffix in suffixes(name)]
    if name.startswith("fig"):
        from fiplib.reproduction import style

        style.save(made, first, second)
    else:
        first.write_text(made.csv(product.command), encoding="utf-8")
        second.write_text(made.latex(), encoding="utf-8")
    return paths


def makefile(products: Mapping[str, Product], others: Mapping[str, Product]) -> str:
    """The registry as the Makefile includes it: names, files, and the sources of each product and of the others."""
    everything = {**products, **others}
    bags = sorted({bag for product in everything.values() for bag in product.bags})
    lines = [
        f"PRODUCTS := {' '.join(products)}",
        f"BAGS := {' '.join(bags)}",
        f"GALLERY_FILES := figures/README.md {' '.join(f'figures/small/{name}.png' for name in gallery.NAMES)}",
        *(f"files_{name} := {' '.join(f'figures/{name}{suffix}' for suffix in suffixes(name))}" for name in products),
    ]
    return "\n".join([*lines, *dependencies.rules(everything), ""])
