"""The limit: the Cramer-Rao bound of the length over window, excitation, noise, inertia and what else is known.

A case is one flight with the true length in use; its row has the bound for windows of ``WINDOWS`` seconds, root mean
square over windows that begin at ``STARTS``. The length is read from how offset and tilt go together as the vehicle
moves. In windows of 2.5 s (figure 12): a circle flown in 5 s instead of 8 s tells 1.5 times as much; hover, where only
noise moves the vehicle, five times less than the circle; positions measured five times worse cost five times the
bound, attitudes next to nothing, as they also follow from the commands; not to know inertia and lag costs an eighth of
it, and in half a second, where both show as the length does, almost half. Not to know the calibration costs most: the
bound is 2.4 times as large, and in a second, in which a rod hardly moves beside a constant, nearly 20 times; a circle
flown in 5 s takes it back. In windows of 10 s it costs nothing any more. ``knowledge``:

- ``plant known``: all but the state and the length;
- ``calibration unknown``: four constants, where markers and body frame sit, as well (``bound.OFFSETS``);
- ``inertia and lag unknown``: these two as well;
- ``height measured``: motion capture reports the height of the pendulum's centre of mass too, which is half the length:
  hundredths of a millimetre, from the first frames on. No estimator here uses it.

120 rows, about 4 minutes of one core.
"""

import itertools
import math
from functools import cache

import numpy as np

from fiplib.estimators.cramer_rao import cramer_rao, motion
from fiplib.estimators.likelihood import CALIBRATION
from fiplib.params import NANO, Params
from fiplib.recording import Flight
from fiplib.simulate import Scenario, fly
from fiplib.studies.landscapes import EXCITATIONS, RODS

KEYS = ("excitation", "rod", "noise", "knowledge")

NOISES = {"default": (1.0, 1.0), "positions x 5": (5.0, 1.0), "attitude x 5": (1.0, 5.0)}
"""Factors on the noise of motion capture: of positions, of attitude."""

KNOWLEDGE = {
    "plant known": ((), False),
    "calibration unknown": ((CALIBRATION,), False),
    "inertia and lag unknown": (("inertia_factor", "rate_lag"), False),
    "height measured": ((), True),
}
"""Arguments of ``bound.cramer_rao``: nuisances, and whether the height is measured."""

WINDOWS = (0.25, 0.5, 1.0, 2.5, 5.5, 10.0)
STARTS = (6.0, 8.0, 10.0)
"""s of the flight at which windows begin: at full speed, in three phases of the circle."""


def cases() -> list[dict]:
    """Every excitation and rod, with every noise and state of knowledge."""
    return [dict(zip(KEYS, values, strict=True)) for values in itertools.product(EXCITATIONS, RODS, NOISES, KNOWLEDGE)]


def run(case: dict) -> dict[str, float]:
    """The bounds of one case.

    Returns:
        ``bound_SECONDS``: the bound in m for a window of so many seconds.
    """
    flight = flown(case["excitation"], case["rod"])
    position, attitude = NOISES[case["noise"]]
    params = flight.params.replace(
        simulation__position_noise=position * flight.params.simulation.position_noise,
        simulation__attitude_noise=attitude * flight.params.simulation.attitude_noise,
    )
    bounds = []
    for start in STARTS:
        begin = flight.start_ns + round(start * NANO)
        path = motion(flight, begin, begin + round(max(WINDOWS) * NANO))
        found = cramer_rao(path, params, *KNOWLEDGE[case["knowledge"]])
        bounds.append([found[min(round(seconds / path.period), len(found) - 1)] for seconds in WINDOWS])
    means = np.sqrt(np.mean(np.square(bounds), axis=0))
    return {f"bound_{seconds:g}": float(mean) for seconds, mean in zip(WINDOWS, means, strict=True)}


@cache
def flown(excitation: str, rod: str) -> Flight:
    """A simulated flight with the true length; the same whatever is measured of it. Raises RuntimeError if it falls."""
    params = Params().replace(pendulum__gyration_ratio=RODS[rod])
    seconds = math.ceil(max(STARTS) + max(WINDOWS)) + 1.0
    scenario = Scenario(excitation, "", seconds, EXCITATIONS[excitation], params=params, seed=1)
    flight = fly(scenario)
    if not flight.survived:
        raise RuntimeError(f"the rod fell on {excitation}")
    return flight
