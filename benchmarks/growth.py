"""How time grows with the size of the work, and the physical floor: ``python -m benchmarks.growth``.

Sizes double; times are medians. ``--save`` writes ``growth.csv``, from which figure 14 fits the exponents. The floor is
what the arithmetic or the memory of this machine would allow: the operations of a Riccati sweep (or of the filter) at
the measured rate of a large matrix product on one core, or the bytes of a bag at the measured rate of a copy.
"""

import csv
import dataclasses
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import bags as bag_rivals
from benchmarks import estimation, mpc
from benchmarks.harness import FOLDER, Contender, Row, compare, main
from fiplib import bags, kalman
from fiplib.mpc import MPC
from fiplib.params import Params
from fiplib.simulate import SCENARIOS, fly

TOPIC = "growth"
SAVED = FOLDER / "growth.csv"
RICCATI_FLOPS = 710
"""A node of one axis: [A B]'P [A B] by two products, 2 (5*5*6 + 6*5*6), and the update by an outer product, 2*25."""

FILTER_FLOPS = 2 * 800
"""A sample of both axes of five states: F P F' (4*125), S factorised (125/3), gain and posterior (2*125)."""

COLUMNS = ("work", "contender", "size", "p50_us")
Made = Callable[[], Contender]


def at_nodes(nodes: int) -> Params:
    """The paper's problem over another number of nodes, a node every 0.1 s as ever."""
    return Params().replace(control__nodes=nodes, control__horizon=Params().control.step * nodes)


def solves(nodes: int, lean: float) -> tuple[Contender, dict[str, Made], list[Any], float]:
    """MPC solves around a lean of the rod in m."""
    params = at_nodes(nodes)
    rng = np.random.default_rng(0)
    states = np.zeros((24, 10))
    states[:, [4, 6]] = lean * (1 + 0.1 * rng.uniform(-1, 1, (24, 2)))
    ticks = [mpc.Tick(state, np.zeros((nodes + 1, 10))) for state in states]
    rivals: dict[str, Made] = {"PIQP": lambda: mpc.piqp(mpc.quadratic_program(params))}
    return mpc.ours(params), rivals, ticks, nodes * RICCATI_FLOPS


def new_length(nodes: int) -> tuple[Contender, dict[str, Made], list[Any], float]:
    """Set-up for a length."""
    prepare = MPC(at_nodes(nodes)).prepare
    lengths = np.random.default_rng(nodes).uniform(0.3, 2.0, 24)
    return Contender(prepare, lambda _: np.zeros(1)), {}, list(lengths), nodes * RICCATI_FLOPS


def filtering(candidates: int, samples: int, rival: bool) -> tuple[Contender, dict[str, Made], list[Any], float]:
    """Candidate lengths filtered over a window."""
    params = estimation.parameters()
    window, lengths = estimation.steady_circle(params, samples), np.linspace(0.3, 2.0, candidates)
    near = 1e-6 * samples
    own = Contender(lambda _: kalman.fitness(lengths, window, params.estimation), tolerance=near)
    others: dict[str, Made] = {
        "filterpy": lambda: Contender(
            lambda _: estimation.filterpy_fitness(lengths, window, params.estimation), tolerance=near
        )
    }
    return own, others if rival else {}, [None] * 8, candidates * samples * FILTER_FLOPS


def reading(bag: Path) -> tuple[Contender, dict[str, Made], list[Any], float]:
    """A bag into arrays; the floor is in bytes of its files."""
    own = Contender(lambda _: bags.read(bag), bag_rivals.tables)
    rivals: dict[str, Made] = {"rosbags AnyReader": lambda: bag_rivals.any_reader(bag)}
    return own, rivals, [None] * 4, sum(file.stat().st_size for file in bag.glob("*.mcap"))


def rates() -> tuple[float, float]:
    """Operations a second of a matrix product, and bytes a second of a copy (read and written), on one core."""
    a, wide = np.random.default_rng(0).random((768, 768)), np.zeros(32 << 20)
    target = np.empty_like(wide)
    product = Contender(lambda _: a @ a)
    copy = Contender(lambda _: target.__setitem__(slice(None), wide), lambda _: np.zeros(1))
    multiply = compare(TOPIC, "matrix product, 768", product, {}, [None] * 9, checks=1, block=3)[0].p50_us
    move = compare(TOPIC, "copy, 256 MiB", copy, {}, [None] * 9, checks=1, block=3)[0].p50_us
    return 2 * 768**3 / multiply * 1e6, 2 * wide.nbytes / move * 1e6


def measure(quick: bool) -> list[Row]:
    """All works at all sizes; ``Row.work`` ends in the size."""
    flops, bandwidth = rates()
    rows: list[Row] = []

    def grow(work: str, sizes: Iterable[int], at: Callable[[int], tuple], per_second: float = flops) -> None:
        for size in list(sizes)[:2] if quick else sizes:
            own, rivals, arguments, amount = at(size)
            rows.extend(
                compare(
                    TOPIC, f"{work}: {size}", own, rivals, arguments, budget=3.0, checks=2, block=min(8, len(arguments))
                )
            )
            own_p50 = next(row.p50_us for row in reversed(rows) if row.contender == "fip")
            floor = 1e6 * amount / per_second
            remark = (
                "operations at the rate of a matrix product" if per_second == flops else "bytes at the rate of a copy"
            )
            rows.append(Row(TOPIC, f"{work}: {size}", "floor", floor / own_p50, floor, np.nan, 1, np.nan, 1, remark))

    nodes = (15, 30, 60, 120, 240)
    grow("MPC, no active bound, nodes", nodes, lambda size: solves(size, 0.005))
    grow("MPC, active bounds, nodes", nodes, lambda size: solves(size, 0.06))
    grow("new length, nodes", nodes, new_length)
    grow("filter, candidates", (8, 32, 128, 512, 2048, 8192), lambda size: filtering(size, 55, size <= 128))
    grow("filter, samples", (14, 28, 55, 110, 220, 440), lambda size: filtering(200, size, False))
    with tempfile.TemporaryDirectory() as folder:

        def bag(duration: int) -> tuple:
            scenario = dataclasses.replace(SCENARIOS["circle-0.8"], duration=float(duration))
            path = Path(folder) / str(duration)
            with bags.BagRecorder(path, scenario.metadata()) as recorder:
                fly(scenario, recorder)
            return reading(path)

        grow("bag to arrays, seconds", (4, 8, 16, 32, 64), bag, bandwidth)
    return rows


def keep(rows: list[Row], path: Path = SAVED) -> None:
    """Write medians by work, contender and size."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for row in rows:
            work, colon, size = row.work.partition(": ")
            if colon and row.calls:
                writer.writerow([work, row.contender, size, f"{row.p50_us:.4g}"])
    print(f"wrote {path}")


if __name__ == "__main__":
    main(TOPIC, measure, __doc__, keep)
