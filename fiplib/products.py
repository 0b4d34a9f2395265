"""The registry: every figure, every table and the ledger, each with what it is made from; ``fip figures`` makes them.

A new figure or table is one function, sources in and ``Figure`` or ``Table`` out, and one line in ``PRODUCTS``. The
Makefile derives its lists from here. Modules are imported when something of theirs is made.
"""

import argparse
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from fiplib import studies
from fiplib.params import FipError
from fiplib.reproduction import making
from fiplib.reproduction.sources import Product
from fiplib.studies import STUDIES

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from fiplib.reproduction.tables import Table


_ESTIMATES = ("estimate-0.8", "estimate-1.2", "estimate-1.4")

PRODUCTS = {
    "fig1-flight": Product("fiplib.reproduction.figures:fig1_flight", bags=("circle-0.8",)),
    "fig2-vehicle": Product("fiplib.reproduction.figures:fig2_vehicle"),
    "fig3-pushes": Product("fiplib.reproduction.figures:fig3_pushes", bags=("push-hover",)),
    "fig4-circle": Product("fiplib.reproduction.figures:fig4_circle", bags=("circle-0.8",)),
    "fig5-estimation": Product("fiplib.reproduction.figures:fig5_estimation", bags=("estimate-1.4",)),
    "fig6-convergence": Product("fiplib.reproduction.figures:fig6_convergence", bags=_ESTIMATES),
    "fig7-survival": Product("fiplib.studies.survival:fig7_survival", studies=("survival",)),
    "fig8-landscapes": Product("fiplib.studies.landscapes:fig8_landscapes", studies=("landscape_curves",)),
    "fig9-estimators": Product("fiplib.studies.estimators:fig9_estimators", studies=("estimators",)),
    "fig10-intervals": Product("fiplib.studies.estimators:fig10_intervals", bags=("estimate-1.4",)),
    "fig11-handover": Product("fiplib.studies.handover:fig11_handover", studies=("handover",)),
    "fig12-bound": Product("fiplib.studies.bounds:fig12_bound", studies=("bounds",)),
    "fig13-deadlines": Product("fiplib.studies.benchmarks:fig13_deadlines", benchmarks=("deadlines",)),
    "fig14-growth": Product("fiplib.studies.benchmarks:fig14_growth", benchmarks=("growth",)),
    "fig15-identifiability": Product(
        "fiplib.studies.identifiability:fig15_identifiability", bags=("push-hover", "circle-0.8")
    ),
    "fig16-coverage": Product("fiplib.studies.poses:fig16_coverage", studies=("poses",)),
    "fig17-seat": Product("fiplib.studies.seat:fig17_seat", studies=("seat",)),
    "fig18-observers": Product("fiplib.studies.observers:fig18_observers", studies=("observers",)),
    "fig19-ablation": Product("fiplib.studies.ablation:fig19_ablation", studies=("ablation",)),
    "fig20-choices": Product(
        "fiplib.studies.choices:fig20_choices", studies=("choices", "choices_flown", "choices_exploring")
    ),
    "table1-parameters": Product("fiplib.reproduction.tables:table1_parameters"),
    "table2-software": Product("fiplib.reproduction.tables:table2_software"),
    "table3-convergence": Product("fiplib.reproduction.tables:table3_convergence", bags=_ESTIMATES),
    "table4-estimators": Product("fiplib.studies.estimators:table4_estimators", studies=("estimators",)),
    "table5-seeds": Product("fiplib.studies.ledger_seeds:table5_seeds", studies=("ledger_seeds",)),
    "table6-readings": Product(
        "fiplib.studies.ledger_seeds:table6_readings", studies=("ledger_seeds", "ledger_readings")
    ),
    "table7-weights": Product("fiplib.studies.weights:table7_weights", studies=("weights",)),
    "table8-handover": Product("fiplib.studies.handover:table8_handover", studies=("handover",)),
    "table9-landscapes": Product("fiplib.studies.landscapes:table9_landscapes", studies=("landscapes",)),
    "table10-rates": Product("fiplib.studies.benchmarks:table10_rates", benchmarks=("sweep_rates",)),
    "table11-imperfections": Product("fiplib.studies.imperfections:table11_imperfections", studies=("imperfections",)),
    "table12-speed": Product("fiplib.studies.benchmarks:table12_speed", benchmarks=("results",)),
    "table13-coverage": Product("fiplib.studies.poses:table13_coverage", studies=("poses",)),
    "table14-seat": Product("fiplib.studies.seat:table14_seat", studies=("seat",)),
    "table15-observers": Product("fiplib.studies.observers:table15_observers", studies=("observers",)),
    "table16-ablation": Product("fiplib.studies.ablation:table16_ablation", studies=("ablation",)),
    "table17-choices": Product("fiplib.studies.choices:table17_choices", studies=("choices",)),
}
"""Every figure (``fig...``) and table (``table...``) by name."""

LEDGER = "claims"
"""The name of the ledger among the products."""


def ledger() -> Product:
    """The ledger: made from what its claims and the report's facts are read from."""
    from fiplib.reproduction.claims import CLAIMS

    return Product(
        "fiplib.reproduction.ledger:evaluate",
        bags=_united(claim.bags for claim in CLAIMS),
        studies=_united([*(claim.studies for claim in CLAIMS), studies.FACTS]),
        benchmarks=_united(claim.benchmarks for claim in CLAIMS),
        parts=("fiplib.reproduction.ledger:write", *(f"{STUDIES[study]}:facts" for study in studies.FACTS)),
    )


def _united(groups: Iterable[tuple[str, ...]]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(name for group in groups for name in group))


def make(name: str, data: Path = Path("data")) -> "Figure | Table":
    """Make one figure or table from the bags and tables in ``data`` and, beside it, ``benchmarks``.

    Raises:
        FipError: no such name, or what it is made from is missing or damaged.
    """
    if name not in PRODUCTS:
        raise FipError(f"no figure {name!r}; there are {', '.join(PRODUCTS)}")
    return making.make(PRODUCTS[name], data, studies.check)


def write(name: str, made: "Figure | Table", folder: Path) -> list[Path]:
    """Write a figure as PDF and PNG, a table as CSV and LaTeX; the same input gives the same bytes."""
    return making.write(name, PRODUCTS[name], made, folder)


def write_ledger(data: Path, folder: Path, generated: Path) -> list[Path]:
    """Judge every claim and write the ledger, its LaTeX files into the folder ``generated``.

    Raises FipError once all is written, if claims could not be judged from a bag.
    """
    from fiplib.reproduction import ledger

    failures: list[str] = []
    paths = ledger.write(ledger.evaluate(data, studies.check, failures), folder, generated, studies.facts(data))
    if failures:
        raise FipError(f"written, with claims that cannot be judged: {'; '.join(failures)}")
    return paths


# --- fip figures


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``fip figures``."""
    parser.add_argument("names", nargs="*", metavar="NAME", help="which to make (default: all)")
    parser.add_argument("--list", action="store_true", help="list them with what they are made from")
    parser.add_argument("--make", action="store_true", help="print the same for the Makefile")
    parser.add_argument("--data", type=Path, default=Path("data"), help="folder of the bags (default: data)")
    parser.add_argument("--output", type=Path, default=Path("figures"), help="folder to write to (default: figures)")
    parser.add_argument(
        "--generated", type=Path, default=Path("paper/generated"), help=f"folder for the LaTeX files of {LEDGER}"
    )


def run(options: argparse.Namespace) -> int:
    """Make figures, tables and the ledger; return the exit status: 1 if some of several could not be made.

    Raises FipError: no such product, or the only one cannot be made.
    """
    if options.make:
        print(making.makefile(PRODUCTS, {LEDGER: ledger()}), end="")
        return 0
    everything = PRODUCTS | {LEDGER: ledger()}
    if options.list:
        for name, product in everything.items():
            print(f"{name:22} {' '.join(product.names) or '(parameters only)'}")
        return 0
    if unknown := [name for name in options.names if name not in everything]:
        raise FipError(f"no figure {unknown[0]!r}; there are {', '.join(everything)}")
    failed = 0
    for name in (names := options.names or list(everything)):
        try:
            if name == LEDGER:
                paths = write_ledger(options.data, options.output, options.generated)
            else:
                paths = write(name, make(name, options.data), options.output)
            print("wrote", *paths, flush=True)
        except FipError as error:  # the others are made all the same
            if len(names) == 1:
                raise
            failed += 1
            print(f"fip: {name}: {error}", file=sys.stderr)
    return int(failed > 0)
