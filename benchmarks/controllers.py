"""CPU time of a control tick of every controller: ``python -m benchmarks.controllers [--save]``.

Each controller of ``studies.field`` answers the ticks of one flight of its own, in hover with pushes, and is timed
within it; the adaptive MPC is given a length that changes by 1 mm every 0.2 s, as its estimator runs beside it. Times
are CPU time of the thread in us; the first half second, in which things are compiled and cached, is left out.
"""

import argparse
import csv
import itertools
import time
from pathlib import Path

import numpy as np

from fiplib.params import NANO, Params
from fiplib.pilot import Pilot
from fiplib.recording import EPOCH
from fiplib.references import Hover
from fiplib.simulate import Push, Scenario, SimulatedVehicle
from fiplib.studies.field import FIELD

SAVED = Path(__file__).with_name("controller_ticks.csv")
"""What the table table18-field reads. Committed, since times differ from run to run and tables should not."""
SECONDS, WARM, NEW_LENGTH = 10.0, 0.5, 0.2


def ticks(controller: str) -> list[float]:
    """Return the CPU times of one flight's ticks, us, after the first ``WARM`` s."""
    params = Params().replace(**FIELD[controller][1])
    pushes = (Push(2.0, (0.008, 0.0)), Push(5.0, (0.0, 0.008)), Push(8.0, (-0.006, 0.006)))
    vehicle = SimulatedVehicle(Scenario("ticks", "", SECONDS, Hover(), pushes=pushes, params=params))
    pilot, times, rate = Pilot(params, Hover()), [], params.piloting.mocap_rate
    for index in range(round(SECONDS * rate)):
        stamp = EPOCH + round(index * NANO / rate)
        tick = pilot.observe(stamp, vehicle.measure(stamp))
        if tick is not None:
            if params.piloting.estimate and index % round(NEW_LENGTH * rate) == 0:
                pilot.receive_estimate(1.0 + 1e-3 * (index // round(NEW_LENGTH * rate) % 2), 1e-3)
            before = time.thread_time_ns()
            solution = pilot.solve(tick)
            times.append((time.thread_time_ns() - before) / 1e3)
            vehicle.command(pilot.answer(tick, solution.input, solution.status))
        vehicle.advance()
    return times[round(WARM * params.piloting.control_rate) :]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--save", action="store_true", help=f"write {SAVED.name}")
    save = parser.parse_args().save
    lines = []
    for controller in FIELD:
        p50, p99 = np.percentile(ticks(controller), [50, 99])
        print(f"{FIELD[controller][0]:22} p50 {p50:9.1f} us   p99 {p99:9.1f} us", flush=True)
        lines += [(f"{controller}_p50_us", f"{p50:.3g}"), (f"{controller}_p99_us", f"{p99:.3g}")]
    if save:
        with SAVED.open("w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows(itertools.chain([("quantity", "value")], lines))


if __name__ == "__main__":
    main()
