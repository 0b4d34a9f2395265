"""How long a tick of the MPC takes: ``python benchmarks/bench_mpc.py``.

Times one call of ``MPC.solve`` with and without active bounds, the set-up for a new length, and a general solver
(ipopt) on the same problem as it is written in ``fiplib.mpc.problem``. States are drawn at random around hover, seeded.
"""

import argparse
import csv
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from fiplib.mpc import MPC, Status, problem
from fiplib.params import Params

SPREAD = np.array([0.8, 0.5, 0.8, 0.5, 0.03, 0.12, 0.03, 0.12, 0.1, 0.1])
"""Half width of the box the states are drawn from: about what a push of the paper's kind does to a 1 m rod."""


def timed(call: Callable, arguments: Iterable) -> np.ndarray:
    """Wall time of ``call(argument)`` for each argument in us; the first call is not counted."""
    durations = []
    for argument in arguments:
        start = time.perf_counter_ns()
        call(argument)
        durations.append(time.perf_counter_ns() - start)
    return np.array(durations[1:]) / 1e3


def ipopt(params: Params) -> Callable:
    """The general solver, set up once: (state, reference, length) -> inputs."""
    ocp = problem(params)
    options = {"expand": True, "detect_simple_bounds": True, "print_time": False}
    ocp.opti.solver("ipopt", options, {"print_level": 0, "sb": "yes", "tol": 1e-8, "mehrotra_algorithm": "yes"})
    return ocp.opti.to_function("ocp", [ocp.state, ocp.reference, ocp.length], [ocp.inputs])


SAVED = Path(__file__).parent / "solve_times.csv"
"""What the ledger's row R1 reads. Committed, since times differ from run to run and ledgers should not."""


def save(rows: dict[str, np.ndarray]) -> None:
    """Write the quantities that the ledger uses, in us."""
    free, bound = rows["solve, within all bounds"], rows["solve, bounds active"]
    quantities = {
        "mpc_p50": np.percentile(np.concatenate([free, bound]), 50),
        "mpc_p99": max(np.percentile(free, 99), np.percentile(bound, 99)),
        "new_length_p99": np.percentile(rows["set-up for a new length"], 99),
    }
    with SAVED.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["quantity", "value_us"])
        writer.writerows([name, f"{value:.0f}"] for name, value in quantities.items())
    print(f"wrote {SAVED}")


def main(solves: int, keep: bool) -> None:
    """Print the table; ``solves`` calls per row (a hundredth of it for ipopt)."""
    params, rng = Params(), np.random.default_rng(0)
    length, deadline = params.pendulum.length, 1e6 / params.piloting.control_rate
    mpc, reference = MPC(params), np.zeros((params.control.nodes + 1, 10))
    weights = np.array(params.control.state_weights)
    weights[2:4] *= 2.0
    unlike = MPC(params, state_weights=weights)

    candidates = [scale * SPREAD * rng.uniform(-1, 1, 10) for scale in np.resize([0.1, 1.0], 4 * solves)]
    solutions = [mpc.solve(state, reference) for state in candidates]
    pairs = list(zip(candidates, solutions, strict=True))
    free = [state for state, solution in pairs if not solution.bounded][:solves]
    bound = [state for state, solution in pairs if solution.bounded and solution.status is not Status.FAILED][:solves]
    lengths = rng.uniform(params.estimation.length_min, params.estimation.length_max, 1 + solves // 10)

    rows = {
        "solve, within all bounds": timed(lambda state: mpc.solve(state, reference), free),
        "solve, bounds active": timed(lambda state: mpc.solve(state, reference), bound),
        "solve, within all bounds, axes weighted unlike": timed(lambda state: unlike.solve(state, reference), free),
        "set-up for a new length": timed(mpc.prepare, lengths),
        "set-up for a new length, axes weighted unlike": timed(unlike.prepare, lengths),
    }
    general = ipopt(params)
    rows["ipopt, within all bounds"] = timed(lambda x: general(x, reference.T, length), free[: 1 + solves // 100])
    rows["ipopt, bounds active"] = timed(lambda x: general(x, reference.T, length), bound[: 1 + solves // 100])

    print(f"{'':48}{'calls':>7}{'p50 us':>10}{'p99 us':>10}{'p99 / tick':>12}")
    for name, durations in rows.items():
        median, tail = np.percentile(durations, [50, 99])
        print(f"{name:48}{len(durations):7}{median:10.0f}{tail:10.0f}{tail / deadline:12.1%}")
    for case in ("within all bounds", "bounds active"):
        ratio = np.median(rows[f"ipopt, {case}"]) / np.median(rows[f"solve, {case}"])
        print(f"{case}: {ratio:.0f} times faster than ipopt (median)")
    print(f"a tick is {deadline:.0f} us")
    if keep:
        save(rows)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--solves", type=int, default=2000, help="calls per row")
    parser.add_argument("--save", action="store_true", help="write solve_times.csv for the ledger")
    options = parser.parse_args()
    main(options.solves, options.save)
