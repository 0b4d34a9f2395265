"""Does the loop survive its own estimator? Random rods, random first lengths, and four ways to the used length.

A flight is drawn by its index: l0 uniform in [0.4, 1.6] m, the rod's true length uniform in [0.5, 1.5] m, a uniform
rod. It follows the 0.4 m circle, which starts at once. A row is one flight under one policy:

- ``told``: the controller is told the true length from the start. What falls here, no estimator could save.
- ``printed``: the paper's genetic algorithm and hand-over from l0 on, with the likelihood as its fitness (our default
  reading); ``literal``, for the first ``LITERAL`` indices only: with the fitness that the paper prints.
- ``trusted``: maximum likelihood on raw motion capture, and the hand-over that trusts it as far as it is sure.

All policies fly the same rod with the same noise. As printed, 58 of 500 fall, all with a first length of 1.5 times the
true one or more: 51 before the GA's first window is full, the others within 2 s of it. Told and trusted, none falls
(table 8, figure 11). 1600 rows, about an hour of one core.
"""

import math

import numpy as np

from fiplib.params import A, B, Params
from fiplib.pilot import Circle
from fiplib.simulate import Scenario, fly

KEYS = ("policy", "index")
"""In this order: the gains that the genetic algorithm keeps between windows are those of one fitness."""

FLIGHTS = 500
LITERAL = 100

POLICIES: dict[str, dict] = {
    "told": {},
    "printed": {"piloting__estimate": True},
    "literal": {"piloting__estimate": True, "estimation__fitness": "paper"},
    "trusted": {
        "piloting__estimate": True,
        "piloting__handover": "trusted",
        "estimation__estimator": "maximum_likelihood",
    },
}
"""Parameters of each policy; all but ``told`` start from l0."""

SECONDS = 12.0
CIRCLE = Circle(radius=0.4, period=8.0, start=0.0, ramp=2.0)

SETTLED = 0.05
"""The used length counts as brought in when it is within this share of the true one for good."""


def cases() -> list[dict]:
    """Every flight under every policy; lengths in m, ``gyration`` is k^2/l^2 of the rod."""
    found = []
    for index in range(FLIGHTS):
        rng = np.random.default_rng(index)
        flight = {
            "initial_length": round(rng.uniform(0.4, 1.6), 4),
            "true_length": round(rng.uniform(0.5, 1.5), 4),
            "gyration": 1 / 12,
            "seed": index,
        }
        found += [
            {"index": index, "policy": policy, **flight}
            for policy in POLICIES
            if policy != "literal" or index < LITERAL
        ]
    return found


def run(case: dict) -> dict[str, float | int | str]:
    """Fly one case.

    Returns:
        initial_length and true_length (m) of the case; survived (1 or 0) and seconds flown; settled, the time in s from
        which on the used length was within ``SETTLED`` of the true one, nan if at the end it was not; used_length at
        the end (m); longest_used, the largest used over true length; largest_lean, of |a| and |b| (m).
    """
    true, told = case["true_length"], case["policy"] == "told"
    params = Params().replace(
        pendulum__length=true,
        pendulum__gyration_ratio=case["gyration"],
        piloting__initial_length=true if told else case["initial_length"],
        **POLICIES[case["policy"]],
    )
    flight = fly(Scenario("handover", "", SECONDS, CIRCLE, params=params, seed=case["seed"]))
    times, used = flight.time(flight.length), flight.length.column("used")
    return {
        "initial_length": case["initial_length"],
        "true_length": true,
        "survived": int(flight.survived),
        "seconds": SECONDS if flight.survived else flight.duration,
        "settled": settled(times, used / true),
        "used_length": float(used[-1]),
        "longest_used": float((used / true).max()),
        "largest_lean": float(np.abs(flight.truth_state.values[:, [A, B]]).max()),
    }


def settled(times: np.ndarray, ratios: np.ndarray) -> float:
    """The time from which on the ratios (n,), each held from ``times`` (n,) on, stay near 1; nan if the last is not."""
    outside = np.flatnonzero(np.abs(ratios - 1) >= SETTLED)
    if not outside.size:
        return float(times[0])
    return float(times[outside[-1] + 1]) if outside[-1] + 1 < len(times) else math.nan
