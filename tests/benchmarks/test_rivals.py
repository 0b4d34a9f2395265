"""Rivals solve the same problem as we do, on small sizes; those that are not installed are skipped by name."""

import math
from pathlib import Path

import numpy as np
import pytest

from benchmarks import bags as bag_rivals
from benchmarks import estimation, flights, growth, mpc
from benchmarks.harness import Absent, Contender
from fiplib import bags, ga, kalman
from fiplib.mpc import MPC
from fiplib.params import Params
from fiplib.products import make
from fiplib.reproduction.sources import RESULTS, measured
from fiplib.simulate import Plant
from fiplib.studies.benchmarks import exponent, fig14_growth, table12_speed

ROOT = Path(__file__).parents[2]
SMALL = growth.at_nodes(20)


def made(make: object) -> Contender:
    """A contender, or a test skipped with the reason for which it cannot run."""
    try:
        return make()
    except Absent as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def ticks() -> list[mpc.Tick]:
    """Near hover, an input at its bound, and a rod that leans so far that state bounds are softened."""
    states = np.zeros((3, 10))
    states[:, 4], states[:, 6], states[:, 0] = (0.002, 0.05, 0.12), (0.001, -0.01, 0.02), 0.1
    reference = np.zeros((SMALL.control.nodes + 1, 10))
    reference[:, 0] = 0.2
    found = [mpc.Tick(state, reference) for state in states]
    assert [MPC(SMALL).solve(*tick).bounded for tick in found] == [False, True, True]
    return found


@pytest.mark.parametrize("name", [name for name in mpc.rivals(SMALL) if name != "HPIPM (CasADi), hard bounds"])
def test_a_rival_of_the_mpc_plans_the_same_inputs(name, ticks):
    rival, ours = made(mpc.rivals(SMALL)[name]), mpc.ours(SMALL)
    for tick in ticks:
        plan = rival.answer(rival.call(tick))
        assert plan == pytest.approx(ours.answer(ours.call(tick)), abs=rival.tolerance)


def test_the_quadratic_program_is_the_problem_as_it_is_written(ticks):
    qp, tick = mpc.quadratic_program(SMALL), ticks[1]
    plan = MPC(SMALL).solve(*tick)
    slack = np.maximum(np.abs(plan.states[1:]) - SMALL.control.state_bounds, 0.0) * np.sign(plan.states[1:])
    z = np.concatenate([plan.states.ravel(), plan.inputs.ravel(), slack.ravel()])
    _, lower, upper = qp.vectors(tick)
    rows = qp.rows @ z
    assert (rows >= lower - 1e-6).all() and (rows <= upper + 1e-6).all()
    assert qp.inputs(z) == pytest.approx(plan.inputs, abs=0.0)


def test_bounded_ticks_only_are_all_bounded():
    found = mpc.ticks(mpc.HARD)
    assert found[0].reference.shape == (Params().control.nodes + 1, 10)
    assert any(MPC(Params()).solve(*tick).bounded for tick in found[240:480])


def test_filterpy_gives_our_fitness():
    params = estimation.parameters()
    window, lengths = estimation.steady_circle(params, 12), np.array([0.7, 1.0, 1.3])
    rival = estimation.filterpy_fitness(lengths, window, params.estimation)
    # a sum of a hundred terms of two different orders of summation
    assert rival == pytest.approx(kalman.fitness(lengths, window, params.estimation), rel=1e-9)


@pytest.mark.parametrize("search", [estimation.pygad, estimation.differential_evolution, estimation.pymoo])
def test_other_searches_find_the_length_that_the_landscape_has(search):
    params = estimation.parameters()
    window = estimation.steady_circle(params)
    rival = made(lambda: search(params, window))
    assert rival.answer(rival.call(1)) == pytest.approx(ga.landscape(window, params).best, abs=rival.tolerance)


def test_the_search_with_a_textbook_filter_draws_what_ours_draws():
    params = estimation.parameters().replace(estimation__generations=3, estimation__population=6)
    window = estimation.steady_circle(params, 12)
    rival, ours = estimation.genetic(params, window, estimation.filterpy_fitness), estimation.genetic(params, window)
    assert rival.answer(rival.call(3)) == ours.answer(ours.call(3))


@pytest.mark.parametrize("reader", ["any_reader", "mcap_ros2", "pandas"])
def test_another_reader_of_a_bag_finds_the_same_numbers(reader, tmp_path):
    bag = ROOT / "data" / "push-hover"
    flight = bags.read(bag)
    makers = {
        "any_reader": lambda: bag_rivals.any_reader(bag),
        "mcap_ros2": lambda: bag_rivals.mcap_ros2(bag),
        "pandas": lambda: bag_rivals.pandas(flight, tmp_path),
    }
    rival = made(makers[reader])
    assert np.array_equal(rival.answer(rival.call(None)), bag_rivals.tables(flight))


@pytest.mark.parametrize("name", ["MuJoCo", "SciPy", "CasADi", "C"])
def test_another_plant_is_the_same_plant(name, tmp_path):
    params = Params()

    def plant() -> Contender:
        if name == "MuJoCo":
            flights.needs("mujoco")
        makers = {"MuJoCo": flights.MuJoCoPlant, "SciPy": flights.ScipyPlant, "CasADi": flights.CasadiPlant}
        return flights.advanced(params, makers[name] if name in makers else flights.generated(tmp_path, params))

    rival, ours = made(plant), flights.advanced(params, Plant)
    # one second of a falling rod: errors of two integrators of order h^4, h = 1/960 s
    assert rival.call(0.02) == pytest.approx(ours.call(0.02), abs=rival.tolerance)


# --- what is made of the results


def test_the_committed_results_are_read_and_every_flight_sequence_is_among_them():
    rows = {name: measured(name, ROOT / "data") for name in RESULTS}
    assert {row["topic"] for row in rows["results"]} == {"machine", "mpc", "estimation", "bags", "flights", "growth"}
    works = {row["work"] for row in rows["results"] if row["topic"] == "mpc"}
    assert {*mpc.FLIGHTS, "bounded ticks only", "cold caches", "new length"} <= works
    assert {"floor", "fip"} <= {row["contender"] for row in rows["growth"]}
    assert make("table12-speed").rows and make("fig14-growth").axes


def test_the_table_names_the_fastest_rival_that_agrees_and_says_who_differs_or_is_missing():
    def row(contender: str, ratio: float, agrees: int = 1, calls: int = 9, remark: str = "") -> dict:
        numbers = {"ratio": ratio, "p50_us": 10.0 * ratio, "p99_us": 12.0 * ratio, "calls": calls, "agrees": agrees}
        return {"topic": "mpc", "work": "circle", "contender": contender, "remark": remark, **numbers}

    rows = [
        row("fip", 1.0), row("slow", 90.0), row("wrong", 20.0, agrees=0), row("good", 80.0),
        row("far", 300.0, remark="extrapolated from 9"), row("gone", math.nan, 0, 0, "not installed: gone"),
    ]  # fmt: skip
    [line] = table12_speed(rows).rows
    others = "wrong (differs) 20, slow 90, far, extrapolated 300, gone not installed"
    assert line == ("circle", "0.01", "0.012", "good", "0.8", "80", others)


def test_the_exponent_is_the_slope_of_the_large_sizes():
    sizes = np.array([1.0, 2.0, 4.0, 8.0, 16.0, 32.0])
    assert exponent(sizes, 3e-3 * sizes**1.2) == pytest.approx(1.2)
    assert exponent(sizes, np.array([5.0, 5.0, 5.0, 8.0, 16.0, 32.0])) == pytest.approx(1.0)


def test_the_figure_of_growth_has_a_panel_for_each_work_with_its_floor():
    rows = [
        {"work": work, "contender": contender, "size": float(size), "p50_us": scale * size}
        for work in ("MPC, nodes", "filter, samples", "bag, seconds")
        for contender, scale in (("fip", 2.0), ("rival", 90.0), ("floor", 0.1))
        for size in (4, 8, 16, 32)
    ]
    panels = fig14_growth(rows).axes
    assert [axes.get_title() for axes in panels] == ["MPC", "filter", "bag"]
    labels = [text.get_text() for text in panels[0].get_legend().get_texts()]
    assert labels == ["fip 1.00", "rival 1.00", "floor"]
