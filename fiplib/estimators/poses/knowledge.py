"""The prior knowledge of a laboratory, and the priors that follow from it. Imports no compiled code."""

import math
from dataclasses import dataclass
from typing import NamedTuple

from fiplib.params import Params
from fiplib.recording import Flight


class Told(NamedTuple):
    """The prior of a quantity: a Gaussian with this mean and standard deviation."""

    value: float
    tolerance: float


UNIFORM, MIDDLE = Told(0.75, 0.003), Told(0.0, 1e-3)
"""Assumed where nothing else is known: lambda of a uniform rod, or the tracked point at the middle within 1 mm."""

ANY_INERTIA, ANY_OFFSET = Told(0.8, 0.15), Told(0.0, 0.4)
"""Prior of the other one of the two: from tip-heavy rods to point masses, from the foot to the tip."""

ORIGIN = Told(0.0, 0.05)
"""How far the vehicle's tracked point lies below the middle of its markers, m."""

_SEAT, _COM, _MASS = Told(0.04, 0.1), Told(0.0, 0.05), Told(0.053, 0.001)


@dataclass(frozen=True)
class Knowledge:
    """The prior knowledge of a laboratory. The defaults are for a user who knows only the masses.

    Args:
        inertia_factor: lambda of the rod: 1 for a point mass, 3/4 for a uniform rod. None if it is not known.
        marker_offset: how far beyond the rod's centre of mass its tracked point lies, m. None if it is not known:
            the point is then assumed to be at the middle, unless the flight contradicts that.
        seat_height: height of the seat above the vehicle's tracked point, m.
        com_height: height of the vehicle's centre of mass above its tracked point, m.
        mass_ratio: rod over rod and vehicle.
        distance_tolerance: deviation, in m, of the measured distance of the two tracked points from rho + h, because
            neither lies exactly on its axis. Infinite: the distance is not used.
        noise: standard deviation of positions in m, and of attitudes in rad; guesses, right within a factor of e.
        lag: time constant of the vehicle's rate loop in s; a guess, right within a factor of e.
        lengths: shortest and longest rod to expect, m.
    """

    inertia_factor: Told | None = None
    marker_offset: Told | None = None
    seat_height: Told = _SEAT
    com_height: Told = _COM
    mass_ratio: Told = _MASS
    distance_tolerance: float = 1e-3
    noise: tuple[float, float] = (0.2e-3, 1e-3)
    lag: float = 15e-3
    lengths: tuple[float, float] = (0.1, 4.0)

    @classmethod
    def of(cls, params: Params) -> "Knowledge":
        """Return what ``params`` say, with the pilot's seat; the rod is tracked at its middle as in our own bags."""
        rod, vehicle, simulation = params.pendulum, params.vehicle, params.simulation
        ratio = rod.mass / (rod.mass + vehicle.mass)
        return cls(
            marker_offset=MIDDLE,
            seat_height=Told(params.piloting.seat_height, max(params.piloting.seat_tolerance, 1e-6)),
            mass_ratio=Told(ratio, 0.02 * ratio),
            noise=(max(simulation.position_noise, 1e-6), max(simulation.attitude_noise, 1e-6)),
            lag=simulation.rate_lag,
            lengths=(params.estimation.length_min, params.estimation.length_max),
        )

    @classmethod
    def of_flight(cls, flight: Flight) -> "Knowledge":
        """Return what the flight's own parameters say; a stranger's flight has none and says nothing."""
        return cls.of(flight.params) if "params" in flight.metadata else cls()

    @property
    def shape(self) -> tuple[float, float, float]:
        """Guesses of log omega, log zeta and log omega T: the corner of the rate loop, well damped."""
        return -math.log(self.lag), math.log(0.6), math.log(0.7)


def assumptions(
    variant: str, inertia: Told, offset: Told, knowledge: Knowledge, flies: bool, distance: float
) -> tuple[str, ...]:
    """Return what is taken for granted and with which tolerance, one sentence each.

    ``variant`` says on what the length rests: "told" inertia, a "uniform" rod, or a point at its "middle"; ``distance``
    in m is of the two tracked points, nan if it is not used.
    """
    factor = f"{inertia.value:.3f} +- {inertia.tolerance:.3f}"
    said = {"told": [f"the rod's inertia factor is {factor}"], "middle": []}
    sentences = said.get(variant, [f"the rod is uniform: its inertia factor is {factor}"])
    if offset.tolerance < ANY_OFFSET.tolerance:
        sentences.append(f"the rod's tracked point is {_mm(offset)} from its middle")
    if not flies:
        return *sentences, "the base moves as it is driven, whatever the rod does"
    mass = knowledge.mass_ratio
    sentences += [
        f"the seat is {_mm(knowledge.seat_height)} above the vehicle's tracked point",
        f"the vehicle's centre of mass is {_mm(knowledge.com_height)} above that point",
        f"the rod has {mass.value:.3f} +- {mass.tolerance:.3f} of the mass of rod and vehicle",
    ]
    if math.isfinite(distance) and math.isfinite(knowledge.distance_tolerance):
        apart = f"{distance:.3f} +- {knowledge.distance_tolerance:.3f} m"
        sentences.append(f"both tracked points lie on their axes: their distance is {apart}")
    return tuple(sentences)


def _mm(told: Told) -> str:
    return f"{1e3 * told.value:.0f} +- {1e3 * told.tolerance:.0f} mm"
