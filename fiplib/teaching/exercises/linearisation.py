"""Exercises of notebook 02, linearisation."""

import math

import numpy as np
from numpy.typing import NDArray

from fiplib.dynamics import axis_matrices
from fiplib.params import GRAVITY, Pendulum
from fiplib.teaching.exercises.grading import Exercise


def _rate(l: float, k2: float) -> float:
    return np.linalg.eigvals(axis_matrices(l, Pendulum(gyration_ratio=k2).inertia_factor)[0]).real.max()


growth_rate = Exercise(
    _rate,
    lambda rng: (rng.uniform(0.2, 2.0), rng.uniform(0.02, 0.2)),
    {
        "that is a point mass: the rod's inertia is missing, it falls more slowly": lambda l, k2: _rate(l, 0.0),
        "the centre of mass lies at l/2, not at l: 2 g / l": lambda l, k2: _rate(2 * l, k2),
        "that is the square of the rate, its unit 1/s^2: take the root": lambda l, k2: _rate(l, k2) ** 2,
        "that is the root that decays: a rod let go leaves along the other one": lambda l, k2: -_rate(l, k2),
        "the sign of g/l is wrong: a rod that leans falls further, yours swings": lambda l, k2: np.sqrt(-l),
        "lambda is upside down: a rod with inertia falls more slowly than a point mass": lambda l, k2: (
            _rate(l, 0.0) ** 2 / _rate(l, k2)
        ),
        "lambda stands under the root as well: it multiplies g / l": lambda l, k2: _rate(l, k2) ** 2 / _rate(l, 0.0),
    },
    "a rod that leans grows exponentially: put that into its equation of motion, and keep the root that grows",
    "start from d'' = lambda 2 g d / l, try d = exp(s t), and keep the positive s",
    "the longer the rod, and the more of its mass at its ends, the slower it falls",
)
"""Growth rate of a leaning rod with inertia."""


def _axis(l: float, f: float, *entry: int, by: float = 1.0) -> NDArray:
    a, _ = axis_matrices(l, f)
    a[entry] *= by
    return a


axis_matrix = Exercise(
    _axis,
    lambda rng: (rng.uniform(0.2, 2.0), rng.uniform(0.6, 0.95)),
    {
        "the matrix is still empty: five of its entries are not zero": lambda l, f: np.zeros((5, 5)),
        "the sign of g/l is wrong: a rod that leans falls further": lambda l, f: _axis(l, f, 3, 2, by=-1),
        "the tilt in d'' has the wrong sign: the seat moves from under the rod": lambda l, f: _axis(l, f, 3, 4, by=-1),
        "the centre of mass lies at l/2, not at l: 2 g / l": lambda l, f: _axis(l, f, 3, 2, by=0.5),
        "lambda multiplies both terms of d'', also that of the tilt": lambda l, f: _axis(l, f, 3, 4, by=1 / f),
        "that is the paper's point mass: lambda is missing": lambda l, f: _axis(l, 1.0),
        "it is transposed: row i is the i-th equation": lambda l, f: _axis(l, f).T,
    },
    "row i holds the i-th equation: two rows only name a velocity, one is the input's and stays empty",
    "row by row: s' = s', s'' = g tilt, d' = d', d'' = lambda (2 g d / l - g tilt), tilt' = rate",
    "this is the rod that flies; with lambda = 1 it is the paper's",
)
"""Matrix of one axis with the rod's inertia."""


def _lean(radius: float, period: float, l: float) -> float:
    w2 = (2 * math.pi / period) ** 2
    return -radius * w2 / (w2 + 2 * GRAVITY / l)


steady_lean = Exercise(
    _lean,
    lambda rng: (rng.uniform(0.2, 1.0), rng.uniform(3.0, 10.0), rng.uniform(0.3, 2.0)),
    {
        "the size is right, the side is not: the rod leans inwards, as a cyclist does": lambda r, t, l: -_lean(r, t, l),
        "the angular speed is 2 pi / period, not 1 / period": lambda r, t, l: _lean(r, 2 * math.pi * t, l),
        "the sign of g/l is wrong: a rod that leans falls further, yours hangs": lambda r, t, l: _lean(r, t, -l),
        "that is the slow limit: the offset goes round as well, and w^2 a counts": lambda r, t, l: (
            -r * (2 * math.pi / t) ** 2 * l / (2 * GRAVITY)
        ),
        "the centre of mass lies at l/2, not at l: 2 g / l": lambda r, t, l: _lean(r, t, 2 * l),
        "that is the angular speed, not its square: an acceleration on a circle goes with w^2": lambda r, t, l: (
            -r * 2 * math.pi / t / (2 * math.pi / t + 2 * GRAVITY / l)
        ),
        "that is the lean at rest on a slope: the offset goes round as well, and w^2 a counts": lambda r, t, l: (
            -l / 2 * math.sin(math.atan(r * (2 * math.pi / t) ** 2 / GRAVITY))
        ),
        "numerator and denominator are from different terms: the circle drives, with w^2 R": lambda r, t, l: (
            -r - _lean(r, t, l)
        ),
    },
    "vehicle and offset go round together: put both circles into the rod's equation and compare amplitudes",
    "put x = R cos(w t) and a = c cos(w t) into a'' = 2 g a / l - x'' and solve for c",
    "as the lean depends on the length, a steady circle tells the length",
)
"""Lean on a steady circle."""

controllable_states = Exercise(
    lambda first, second: 5 if first == second else 7,
    lambda rng: (first := rng.uniform(0.3, 1.0), first + rng.choice([0.0, 0.06, rng.uniform(0.3, 0.9)])),
    {
        "rods of equal length answer every tilt alike: nothing moves one against the other": lambda first, second: 7,
        "rods of different length fall at different rates, enough to steer them apart": lambda first, second: 5,
        "the rank of [B, A B] alone is 2: go on to A^6 B": lambda first, second: 2,
        "** acts on single entries: take powers of the matrix with @ or matrix_power": lambda first, second: 3,
        "it is the other way round: twins are the harder ones to control": lambda a, b: 7 if a == b else 5,
    },
    "build the seven equations first, then look at the rank of the controllability matrix",
    "the rank of [B, A B, ..., A^6 B]; powers of matrices with @ or matrix_power, as ** acts on single entries",
    "a vehicle can balance two rods at once, unless they are twins",
    kind=lambda first, second: "rods of equal length" if first == second else "rods of different length",
    draws=16,  # there are two results only
)
"""Controllable states with two rods on one vehicle."""
