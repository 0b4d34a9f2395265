"""The registry: every figure and table, the page of the paper's figures, the ledger, each with what it is made from.

A new figure or table is one function, sources in and ``Figure`` or ``Table`` out, and one line in ``PRODUCTS``; the
function's docstring is its caption. The Makefile derives its lists from here. Modules are imported when something of
theirs is made.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fiplib import studies
from fiplib.params import FipError
from fiplib.reproduction import gallery, making
from fiplib.reproduction.sources import Product
from fiplib.studies import STUDIES

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from fiplib.reproduction.tables import Table


_ESTIMATES = ("estimate-0.8", "estimate-1.2", "estimate-1.4")
_SPREAD = ("spread",)

PRODUCTS = {
    "fig1-flight": Product("fiplib.reproduction.figures:fig1_flight", bags=("circle-0.8",)),
    "fig2-vehicle": Product("fiplib.reproduction.figures:fig2_vehicle"),
    "fig3-pushes": Product("fiplib.reproduction.figures:fig3_pushes", bags=("push-hover",)),
    "fig4-circle": Product("fiplib.reproduction.figures:fig4_circle", bags=("circle-0.8",)),
    "fig5-estimation": Product(
        "fiplib.reproduction.figures:fig5_estimation", bags=("estimate-1.4",), studies=_SPREAD, behind=_SPREAD
    ),
    "fig6-convergence": Product(
        "fiplib.reproduction.figures:fig6_convergence", bags=_ESTIMATES, studies=_SPREAD, behind=_SPREAD
    ),
    "fig7-survival": Product("fiplib.studies.survival:fig7_survival", studies=("survival",)),
    "fig8-landscapes": Product("fiplib.studies.landscapes:fig8_landscapes", studies=("landscape_curves",)),
    "fig9-estimators": Product("fiplib.studies.estimators:fig9_estimators", studies=("estimators",)),
    "fig10-intervals": Product(
        "fiplib.studies.estimators:fig10_intervals", bags=("estimate-1.4",), studies=_SPREAD, behind=_SPREAD
    ),
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
    "fig21-field": Product("fiplib.studies.field:fig21_field", studies=("field",)),
    "fig22-excitation": Product("fiplib.studies.excitation:fig22_excitation", studies=("excitation",)),
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
    "table18-field": Product(
        "fiplib.studies.field:table18_field", studies=("field",), benchmarks=("controller_ticks",)
    ),
    "table19-flying-pendulum": Product(
        "fiplib.studies.flying_pendulum:table19_flying_pendulum", studies=("flying_pendulum",)
    ),
    "table20-excitation": Product("fiplib.studies.excitation:table20_excitation", studies=("excitation",)),
    "table21-sensitivity": Product(
        "fiplib.reproduction.ledger:table21_sensitivity",
        bags=("push-hover", "circle-0.8", *_ESTIMATES, "length-jump"),
        studies=("ledger_seeds", "length_jumps"),
        benchmarks=("solve_times", "deadlines"),
    ),
    "table17-choices": Product("fiplib.studies.choices:table17_choices", studies=("choices",)),
}
"""Every figure (``fig...``) and table (``table...``) by name."""

LEDGER = "claims"
"""The name of the ledger among the products."""


GALLERY = "gallery"
"""The name of the page that shows the paper's figures."""


def page() -> Product:
    """Return the page of the paper's figures: made from what these are made from."""
    shown = [PRODUCTS[name] for name in gallery.NAMES]
    return Product(
        "fiplib.reproduction.gallery:page",
        bags=_united(product.bags for product in shown),
        studies=_united(product.studies for product in shown),
        parts=("fiplib.reproduction.gallery:write", *(product.address for product in shown)),
        behind=_SPREAD,
    )


def ledger() -> Product:
    """Return the ledger: made from what its claims and the report's facts are read from."""
    from fiplib.reproduction.claims import JUDGED

    return Product(
        "fiplib.reproduction.ledger:evaluate",
        bags=JUDGED.bags,
        studies=_united((JUDGED.studies, studies.FACTS)),
        benchmarks=JUDGED.benchmarks,
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


def caption(name: str) -> str:
    """Return the caption of a figure or table, plain text without its number: the docstring of its function.

    Raises FipError: no such name.
    """
    if name not in PRODUCTS:
        raise FipError(f"no figure {name!r}; there are {', '.join(PRODUCTS)}")
    return making.caption(PRODUCTS[name])


def write(name: str, made: "Figure | Table", folder: Path) -> list[Path]:
    """Write a figure as PDF and PNG, a table as CSV and LaTeX; the same input gives the same bytes."""
    return making.write(name, PRODUCTS[name], made, folder)


def write_gallery(data: Path, folder: Path) -> list[Path]:
    """Write the page of the paper's figures and its small images; the same input gives the same bytes."""
    figures: dict[str, Any] = {name: make(name, data) for name in gallery.NAMES}
    return gallery.write(figures, gallery.page(PRODUCTS, {name: caption(name) for name in figures}), folder)


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
