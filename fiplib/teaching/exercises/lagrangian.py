"""Exercises of notebook 01, the Lagrangian."""

import numpy as np
from numpy.typing import NDArray

from fiplib.dynamics import exact_pendulum
from fiplib.params import GRAVITY
from fiplib.teaching.exercises.grading import Exercise


def _leaning(rng: np.random.Generator) -> tuple[float, float, float]:
    """Offsets in m of a rod that leans by up to 60 degrees, and its length in m."""
    length, sine, heading = rng.uniform(0.3, 2.0), rng.uniform(0.2, 0.85), rng.uniform(0.0, 2 * np.pi)
    return length / 2 * sine * np.cos(heading), length / 2 * sine * np.sin(heading), length


def _height(a: float, b: float, l: float) -> float:
    return np.sqrt((l / 2) ** 2 - a**2 - b**2)


def _moving(rng: np.random.Generator) -> tuple[float, float, float, float, float]:
    a, b, length = _leaning(rng)
    return a, b, *rng.normal(size=2), length


height_rate = Exercise(
    lambda a, b, va, vb, l: -(a * va + b * vb) / _height(a, b, l),
    _moving,
    {
        "the sign is wrong: the height falls as the offsets grow": lambda a, b, va, vb, l: (
            (a * va + b * vb) / _height(a, b, l)
        ),
        "the radius is l/2, not l: the centre of mass lies in the middle": lambda a, b, va, vb, l: (
            -(a * va + b * vb) / _height(a, b, 2 * l)
        ),
        "the inner derivative is missing: a^2 has the derivative 2 a a'": lambda a, b, va, vb, l: (
            -(va + vb) / (2 * _height(a, b, l))
        ),
        "the 1/2 of the root and the 2 of the square cancel": lambda a, b, va, vb, l: (
            -2 * (a * va + b * vb) / _height(a, b, l)
        ),
        "that is divided by the radius: divide by the height": lambda a, b, va, vb, l: -(a * va + b * vb) / (l / 2),
        "that is zeta times its rate: divide by the height": lambda a, b, va, vb, l: -(a * va + b * vb),
        "that is the height itself: its rate is asked for": lambda a, b, va, vb, l: _height(a, b, l),
    },
    "the sum of the three squares is constant: what is its derivative?",
    "a a' + b b' + zeta zeta' = 0, solved for zeta'",
    "this rate carries the whole coupling of a and b",
)
"""Rate of the height of the centre of mass."""


def _mass(a: float, b: float, l: float, sign: float = 1.0) -> NDArray:
    n = np.array([a, b])
    return np.eye(2) + sign * np.outer(n, n) / _height(a, b, l) ** 2


mass_matrix = Exercise(
    _mass,
    _leaning,
    {
        "that is the upright rod: leaning, a small change of a needs a change of the height, too": lambda a, b, l: (
            np.eye(2)
        ),
        "that is the inverse: M grows as the rod leans": lambda a, b, l: np.linalg.inv(_mass(a, b, l)),
        "the sign is wrong: moving the height costs energy as well": lambda a, b, l: _mass(a, b, l, -1.0),
        "the radius is l/2, not l: the centre of mass lies in the middle": lambda a, b, l: _mass(a, b, 2 * l),
        "the identity is missing: a and b move as well, not the height alone": lambda a, b, l: (
            _mass(a, b, l) - np.eye(2)
        ),
        "the product a b is missing: both offsets move the one height": lambda a, b, l: np.diag(
            np.diag(_mass(a, b, l))
        ),
        "the height is to be squared": lambda a, b, l: np.eye(2) + (_mass(a, b, l) - np.eye(2)) * _height(a, b, l),
        "that is divided by r^2: divide by zeta^2": lambda a, b, l: np.eye(2) + np.outer([a, b], [a, b]) / (l / 2) ** 2,
    },
    "write the velocity with both tangents, square it, and read off what multiplies which rates",
    "M = I + n n' / zeta^2 with n = (a, b)",
    "at the horizontal it grows without bound: there a and b are no coordinates any more",
)
"""Mass matrix of the paper's point mass, per kg."""

_EXACT = exact_pendulum()


def _accelerations(a: float, b: float, va: float, vb: float, p: NDArray, l: float) -> NDArray:
    return _EXACT([a, b, va, vb], p, l).full().ravel()


def _by_parts(a: float, b: float, va: float, vb: float, p: NDArray, l: float, **changes: float) -> NDArray:
    """The first two rows of r q'', with each of its terms multiplied by a number."""
    r, height = l / 2, _height(a, b, l)
    q = np.array([a, b, height]) / r
    q_rate = np.array([va, vb, changes.get("height_rate", 1.0) * -(a * va + b * vb) / height]) / r
    alpha = changes.get("seat", 1.0) * p + np.array([0.0, 0.0, changes.get("gravity", 1.0) * GRAVITY])
    along = changes.get("projection", 1.0) * q * (q @ alpha)
    return (-changes.get("sphere", 1.0) * r * (q_rate @ q_rate) * q - (alpha - along))[:2]


accelerations = Exercise(
    _accelerations,
    lambda rng: (*(drawn := _moving(rng))[:4], rng.normal(0.0, 3.0, 3), drawn[4]),
    {
        "the sphere's term is missing: a rod in motion is bent onto it by |q'|^2 q": lambda *of: _by_parts(
            *of, sphere=0.0
        ),
        "the sign of the sphere's term is wrong: it points inwards": lambda *of: _by_parts(*of, sphere=-1.0),
        "q' has a third component: the height moves as well": lambda *of: _by_parts(*of, height_rate=0.0),
        "gravity is missing: alpha is the acceleration of the seat plus g e_3": lambda *of: _by_parts(*of, gravity=0.0),
        "gravity has the wrong sign: a seat at rest feels like one that accelerates upwards": lambda *of: _by_parts(
            *of, gravity=-1.0
        ),
        "the acceleration of the seat is missing": lambda *of: _by_parts(*of, seat=0.0),
        "the seat has the wrong sign: a seat that moves to +x leaves the rod behind": lambda *of: _by_parts(
            *of, seat=-1.0
        ),
        "alpha is used whole: only its part across the rod matters": lambda *of: _by_parts(*of, projection=0.0),
        "that is q'': multiply by r = l/2": lambda *of: _by_parts(*of) / (of[5] / 2),
        "the radius is l/2, not l: the centre of mass lies in the middle": lambda *of: _by_parts(*of[:5], 2 * of[5]),
    },
    "build q, its rate and alpha as vectors of three, then write the short form, and keep two rows",
    "r q'' = -r |q'|^2 q - (alpha - q (q . alpha)), with q = (a, b, zeta) / r and alpha = p'' + g e_3",
    "two lines of vectors instead of two pages: these are the equations that the simulator flies",
)
"""Both equations of the paper's point mass on a moving seat."""


def _tip(ratio: float) -> float:
    return (0.5 + ratio) ** 2 / ((1 + ratio) * (1 / 3 + ratio))


inertia_factor = Exercise(
    _tip,
    lambda rng: (rng.uniform(0.05, 2.0),),
    {
        "that is the uniform rod: the tip mass moves the centre of mass and adds inertia": lambda ratio: 0.75,
        "the tip mass counts as a part of the rod: with it the whole mass is 1 + ratio": lambda ratio: (
            (0.5 + ratio) ** 2 / (1 / 3 + ratio)
        ),
        "the centre of mass does not stay at l/2": lambda ratio: 0.25 * (1 + ratio) / (1 / 3 + ratio),
        "1/12 is the rod about its own middle: about the seat it is 1/3": lambda ratio: (
            (0.5 + ratio) ** 2 / ((1 + ratio) * (1 / 12 + ratio))
        ),
        "lambda is upside down: it is at most one": lambda ratio: 1 / _tip(ratio),
        "that is k^2 / (r^2 + k^2): lambda has r^2 above": lambda ratio: 1 - _tip(ratio),
        "the tip mass lies at the end of the rod, not in its middle": lambda ratio: (
            0.25 / ((1 / 3 + 0.25 * ratio) / (1 + ratio))
        ),
    },
    "two sums, over rod and tip mass: of mass times height, and of mass times height squared",
    "r = (1/2 + ratio) / (1 + ratio), r^2 + k^2 = (1/3 + ratio) / (1 + ratio), for l = 1",
    "3/4 without a tip mass, nearly one with a heavy one: an end cap makes the rod more like the paper's point mass",
)
"""Inertia factor of a rod with a mass at its tip."""
