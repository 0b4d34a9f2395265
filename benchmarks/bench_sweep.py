"""How many flights a second a sweep flies: ``python benchmarks/bench_sweep.py``.

Runs a study of hover flights of 10 s, without estimator, through ``fiplib.studies.sweep`` as ``make sweep`` does:
Dask, journal and all. Counted from the moment the workers have flown one flight each, so without their start of some
seconds. ``--save`` keeps the numbers in ``benchmarks/sweep_rates.csv``.
"""

import argparse
import csv
import os
import platform
import tempfile
import time
from pathlib import Path

from fiplib import studies
from fiplib.references import Hover
from fiplib.simulate import Scenario, fly
from fiplib.studies import cluster, sweep
from fiplib.studies.journal import Journal

KEYS = ("seed",)
DURATION = 10.0
"""Simulated seconds of a flight."""

STUDY = Path(__file__).stem
"""Address of this file as a study."""

TABLE = Path(__file__).with_name("sweep_rates.csv")
MANY, CORES = 1_000_000, 100


def run(case: dict) -> dict[str, float]:
    """One hover flight; makes this file a study."""
    return {"survived": fly(Scenario("hover", "", DURATION, Hover(), seed=case["seed"])).survived}


def rate(workers: int, flights: int) -> float:
    """Flights a second on a local cluster of so many workers."""
    cases = [{"seed": seed} for seed in range(flights)]
    with tempfile.TemporaryDirectory() as folder, cluster.connect(workers=workers) as client:
        client.wait_for_workers(workers)
        # the first flight on each worker pays for its imports
        client.run(studies.run, STUDY, cases[0])
        journal = Journal(Path(folder) / "bench.csv", KEYS)
        start = time.perf_counter()
        failed = sweep.sweep("bench", STUDY, journal, cases, client)
        duration = time.perf_counter() - start
    if failed:
        raise SystemExit(f"{failed} flights failed: no rate to tell")
    return flights / duration


def main(flights: int, save: bool) -> None:
    """Print the table; with ``save`` write it as well."""
    rates = {workers: rate(workers, flights) for workers in (1, 2)}
    hours = MANY / (CORES * rates[1]) / 3600
    rows = {
        "flight_duration_s": DURATION,
        "flights_per_worker_count": flights,
        "cores": os.cpu_count(),
        "rate_1_worker_per_s": rates[1],
        "rate_2_workers_per_s": rates[2],
        "speed_up": rates[2] / rates[1],
        "extrapolated_flights": MANY,
        "extrapolated_cores": CORES,
        "extrapolated_hours": hours,
    }
    print(f"hover flights of {DURATION:g} s, {os.cpu_count()} cores, {platform.machine()}")
    print(f"{'workers':>7}{'flights/s':>12}{'speed-up':>10}{'simulated s/s':>15}")
    for workers, value in rates.items():
        print(f"{workers:7}{value:12.2f}{value / rates[1]:10.2f}{DURATION * value:15.1f}")
    print(
        f"{MANY:.0e} flights on {CORES} cores: {hours:.1f} h. Extrapolated, not measured: {CORES} times the rate "
        "of 1 worker,\nas if every core were like this one and none waited for memory, network or scheduler."
    )
    if save:
        with open(TABLE, "w", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerows([("quantity", "value"), *((name, f"{value:.4g}") for name, value in rows.items())])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--flights", type=int, default=40, help="flights per row of the table")
    parser.add_argument("--save", action="store_true", help=f"write {TABLE.name}")
    options = parser.parse_args()
    main(options.flights, options.save)
