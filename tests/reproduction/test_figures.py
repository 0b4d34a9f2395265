"""Figures and tables: complete, honest about their origin, readable, the same bytes every time."""

import csv
import hashlib
import io
import re
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.text import Text

from fiplib import bags, products
from fiplib.params import FipError
from fiplib.products import PRODUCTS
from fiplib.reproduction import bands, sources, tables
from fiplib.reproduction.style import COLUMN, STYLE
from fiplib.reproduction.tables import Table
from fiplib.studies import ablation, field, imperfections, observers, poses, seat, spread, survival

ROOT = Path(__file__).parents[2]
DATA = ROOT / "data"


@pytest.fixture(scope="module")
def made() -> dict[str, Figure | Table]:
    return {name: products.make(name, DATA) for name in PRODUCTS}


DRAWN = [name for name in PRODUCTS if name.startswith("fig")]
TABLES = [name for name in PRODUCTS if name.startswith("table")]


def test_every_figure_and_table_of_the_paper_is_there_and_the_findings_after_them():
    for names, kind in ((DRAWN, "fig"), (TABLES, "table")):
        numbers = [int(name.partition("-")[0].removeprefix(kind)) for name in names]
        assert sorted(numbers) == list(range(1, len(names) + 1))
    assert len(DRAWN) >= 22 and len(TABLES) >= 21


@pytest.mark.parametrize("name", PRODUCTS)
def test_writing_twice_gives_the_same_bytes(name, made, tmp_path):
    first = products.write(name, made[name], tmp_path / "first")
    again = products.write(name, products.make(name, DATA), tmp_path / "again")
    assert len(first) == 2
    for one, other in zip(first, again, strict=True):
        assert hashlib.sha256(one.read_bytes()).digest() == hashlib.sha256(other.read_bytes()).digest(), one.name


@pytest.mark.parametrize("name", PRODUCTS)
def test_a_caption_is_plain_text_that_says_what_is_simulated_and_how_many_flights(name):
    found, product = products.caption(name), PRODUCTS[name]
    label = name.partition("-")[0].replace("fig", "Fig. ").replace("table", "Table ")
    assert product.load().__doc__.startswith(f"{label}: ")
    assert found[0].isupper() and found.endswith(".") and "  " not in found and "\n" not in found
    assert not set(found) & set("`$\\{}") and "*" not in found
    if product.names and name != "table10-rates":  # it counts flights, and measures how long they take
        assert "simulated" in found.lower()
    if product.bags or product.studies:
        assert re.search(r"\b(\d+|[Oo]ne|Two|two) (simulated |recorded |other )*(flights?|windows?|candidates)", found)
    if name.startswith("fig"):
        assert len(found) > 150, "one sentence is no caption: seeds, parameters, and what the reader should see"


SEEDS = {
    "fig5-estimation": spread.SEEDS,
    "fig6-convergence": spread.SEEDS,
    "fig7-survival": survival.SEEDS,
    "fig10-intervals": spread.SEEDS,
    "fig16-coverage": poses.SEEDS,
    "fig17-seat": seat.SEEDS,
    "fig18-observers": observers.SEEDS,
    "fig21-field": field.seeds("mpc"),
    "fig19-ablation": ablation.SEEDS,
    "table11-imperfections": imperfections.SEEDS,
    "table13-coverage": poses.SEEDS,
    "table14-seat": seat.SEEDS,
    "table15-observers": observers.SEEDS,
}


@pytest.mark.parametrize("name", SEEDS)
def test_a_caption_counts_the_seeds_of_its_study(name):
    assert re.search(rf"\b{len(SEEDS[name])} (simulated )?flights", products.caption(name))


@pytest.mark.parametrize(
    ("name", "quantity", "words"),
    [
        ("fig5-estimation", "used", "between 0.93 and 1.04 m"),
        ("fig6-convergence", "used", "0.93 to 1.04 m"),
        ("fig10-intervals", "pose_length", "0.995 to 1.006 m"),
    ],
)
def test_a_caption_states_the_band_that_is_drawn(name, quantity, words):
    assert words in products.caption(name)
    stated = re.findall(r"\d\.\d+", words)
    for scenario in spread.STARTS:
        found = bands.band(bands.values(bands.flights(sources.read("spread", DATA), scenario), quantity))
        edges = [float(edge[found.time > 12.0].mean()) for edge in (found.low, found.high)]
        # one unit of the last digit: three starts share one sentence
        assert edges == pytest.approx([float(number) for number in stated], abs=10.0 ** (2 - len(stated[0])))


def test_the_caption_of_no_product_is_refused():
    with pytest.raises(FipError, match="no figure 'fig99-moon'; there are fig1-flight"):
        products.caption("fig99-moon")


@pytest.mark.parametrize("name", DRAWN)
def test_a_figure_is_one_column_wide_and_its_text_is_legible_and_inside(name, made):
    figure = made[name]
    assert figure.get_figwidth() == COLUMN
    with mpl.rc_context(STYLE):
        FigureCanvasAgg(figure).draw()
        bounds = figure.bbox.padded(2)  # pixels at 100 dpi: what rounding of a text's box may stick out
        for text in _words(figure):
            if text.get_text().strip():
                assert text.get_fontsize() >= 6, text.get_text()
                box = text.get_window_extent()
                inside = bounds.x0 <= box.x0 and box.x1 <= bounds.x1 and bounds.y0 <= box.y0 and box.y1 <= bounds.y1
                assert inside, f"{text.get_text()!r} leaves the figure"


def _words(figure: Figure) -> list[Text]:
    """All text but the numbers at the ticks, which matplotlib keeps beyond the limits of an axis without drawing."""
    words = list(figure.texts)
    for axes in figure.axes:
        words += [*axes.texts, axes.xaxis.label, axes.yaxis.label, axes.title]
    for legend in figure.findobj(Legend):
        words += legend.get_texts()
    return words


@pytest.mark.parametrize("name", [name for name in DRAWN if PRODUCTS[name].bags])
def test_a_figure_made_from_flights_says_that_they_are_simulated_and_which(name, made):
    words = " ".join(text.get_text() for text in made[name].findobj(Text))
    assert "simulated" in words
    for bag in PRODUCTS[name].bags:
        assert bag in words


@pytest.mark.parametrize("name", [n for n in DRAWN if PRODUCTS[n].studies or PRODUCTS[n].benchmarks])
def test_a_figure_made_from_a_study_says_that_it_is_simulated(name, made):
    assert "simulated" in " ".join(text.get_text() for text in made[name].findobj(Text))


def test_a_study_that_is_not_there_is_named_with_the_command_that_makes_it(tmp_path):
    with pytest.raises(FipError, match="survival is missing: make sweep STUDIES='survival'"):
        products.make("fig7-survival", tmp_path)


def test_other_flights_are_drawn_without_the_spread_behind_ours(made, tmp_path):
    for bag in PRODUCTS["fig6-convergence"].bags:
        (tmp_path / bag).symlink_to(DATA / bag)
    alone = products.make("fig6-convergence", tmp_path)
    assert len(alone.axes[0].collections) == 0
    # a band for each of three first lengths, nine tenths of 20 flights
    assert len(made["fig6-convergence"].axes[0].collections) == 3


def test_the_running_rms_of_the_rates_is_that_of_30_commands(made):
    flight = bags.read(DATA / "push-hover")
    rates = np.degrees(flight.command.column("omega_x"))
    drawn = made["fig3-pushes"].axes[3].lines[0]
    assert drawn.get_label() == r"$\omega_x$" and len(drawn.get_ydata()) == len(rates) - 29
    assert drawn.get_ydata()[100] == pytest.approx(np.sqrt(np.mean(rates[100:130] ** 2)), rel=1e-9)
    assert drawn.get_xdata()[100] == flight.time(flight.command)[115]


@pytest.mark.parametrize("name", [name for name in DRAWN if PRODUCTS[name].bags])
def test_every_axis_has_a_label_with_its_unit(name, made):
    axes = made[name].axes
    for one in axes:
        assert "(" in one.get_ylabel(), one.get_ylabel()
    assert "(" in axes[-1].get_xlabel()


@pytest.mark.parametrize("name", TABLES)
def test_a_table_is_the_same_in_csv_and_latex(name, made):
    table = made[name]
    header, *rows = csv.reader(io.StringIO(table.csv("make figures")))
    assert {len(row) for row in rows} == {len(table.alignment) + 1}
    assert header[-1] == "Command" and {row[-1] for row in rows} == {"make figures"}
    body = [line for line in table.latex().splitlines() if line.endswith(r"\\")]
    assert [[tables.plain(cell.strip()) for cell in line.removesuffix(r" \\").split(" & ")] for line in body] == [
        [cell.strip() for cell in row[:-1]] for row in (header, *rows)
    ]
    assert not any(mark in cell for row in (header, *rows) for cell in row for mark in "$\\{}")


def test_a_long_name_of_a_column_is_set_in_two_lines_and_no_formula_is_broken():
    assert tables.stacked("Bias (mm)", "r") == "Bias (mm)"
    assert tables.stacked(r"In 95\,\% interval (\%)", "r") == r"\shortstack[r]{In 95\,\%\\interval (\%)}"
    assert tables.stacked("Claim of the paper", "l", width=40) == "Claim of the paper"  # the cells are wider
    assert tables.stacked("$a + b + c + d + e + f + g$", "l") == "$a + b + c + d + e + f + g$"
    assert tables.columns("@{}llrrll@{}") == list("llrrll")


def test_markup_is_taken_out_of_cells():
    cells = {r"$-$0.5": "-0.5", r"5\,\%": "5 %", r"$Q$, $\dot x$": "Q, x_dot", r"$l_\mathrm{min}$": "l_min"}
    assert {cell: tables.plain(cell) for cell in cells} == cells
