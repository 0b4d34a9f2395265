"""A small study for the tests of sweeps: short flights, cheap and yet chaotic enough to show a single differing bit."""

import os

from fiplib.params import Params
from fiplib.references import Hover
from fiplib.simulate import Scenario, fly
from fiplib.studies import seconds_flown

KEYS = ("length", "seed")


def cases() -> list[dict]:
    return [{"length": length, "seed": seed} for seed in range(5) for length in (1.25, 0.75, 1.0)]


def run(case: dict) -> dict[str, float | str]:
    if case["seed"] < 0:
        os._exit(1)  # as a segmentation fault or the kernel short of memory end a worker
    params = Params().replace(pendulum__length=case["length"])
    scenario = Scenario("short", "", 1.0, Hover(), params=params, seed=case["seed"])
    flight = fly(scenario)
    lean = float(flight.truth_state.values[-1, 4])
    return {
        "duration": seconds_flown(flight, scenario),
        "survived": flight.survived,
        "lean": lean,
        "lean_bits": lean.hex(),
    }
