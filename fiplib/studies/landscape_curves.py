"""The landscapes themselves, for a figure: every reading on one window, with calibrated and with unit noise."""

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fiplib import kalman
from fiplib.studies.landscapes import DEFAULT, READINGS, params_of, windows_of

KEYS = ("reading", "noise", "length")

NOISES = ("default", "identity")
"""Names in ``landscapes.NOISES``."""

LENGTHS = tuple(centimetres / 100 for centimetres in range(20, 201))
"""m: the interval of the paper's Table 2 in steps of 1 cm."""


def cases() -> list[dict[str, Any]]:
    """Each reading, each noise, each length."""
    return [{"reading": r, "noise": n, "length": l} for r in READINGS for n in NOISES for l in LENGTHS]


def run(case: dict[str, Any]) -> dict[str, float]:
    """``fitness`` of one length, and ``normalised``: its rise above the best of ``LENGTHS``.

    The unit of the rise is that of the median length, so that half the interval lies below 1 in every reading.
    """
    fitness, normalised = _curve(case["reading"], case["noise"])
    index = int(np.abs(np.array(LENGTHS) - case["length"]).argmin())
    return {"fitness": float(fitness[index]), "normalised": float(normalised[index])}


@cache
def _curve(reading: str, noise: str) -> tuple[NDArray, NDArray]:
    params = params_of({**DEFAULT, "noise": noise, "reading": reading})
    window = windows_of(DEFAULT["excitation"], params)[0]
    fitness = kalman.fitness(LENGTHS, window, params.estimation)
    rise = fitness - fitness.min()
    return fitness, rise / np.median(rise)
