"""The pose estimator on a command line: options that state prior knowledge, and its answer in words or as values."""

import argparse
import json
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from fiplib.bags.checks import Finding, findings, passed
from fiplib.estimators.poses.knowledge import UNIFORM, Told
from fiplib.recording import Flight

if TYPE_CHECKING:  # with its compiled code it takes half a second to import
    from fiplib.estimators.poses.estimate import PoseEstimate


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options that state what is known of rod and vehicle."""
    rod, told = parser.add_mutually_exclusive_group(), "VALUE[,TOLERANCE]"
    rod.add_argument("--uniform", action="store_true", help="the rod is uniform")
    rod.add_argument("--inertia-factor", type=_told(UNIFORM.tolerance), metavar=told,
                     help="1 for a point mass, 0.75 for a uniform rod")  # fmt: skip
    parser.add_argument("--rod-point", type=_told(1e-3), metavar=told,
                        help="how far above the rod's middle it is tracked, m; 0 if at its middle")  # fmt: skip
    parser.add_argument("--seat-height", type=_told(2e-3), metavar=told,
                        help="height of the seat above the vehicle's tracked point, m")  # fmt: skip
    parser.add_argument("--mass-ratio", type=_told(1e-3), metavar=told, help="mass of the rod over rod and vehicle")
    parser.add_argument("--noise", type=_noise, metavar="METRES,RADIANS",
                        help="standard deviations of positions and attitudes, within a factor of 3")  # fmt: skip
    parser.add_argument("--arm-radius", type=_radius, default=math.inf, metavar="METRES",
                        help="radius of the rotary arm, for a CSV file of encoders (default: a cart)")  # fmt: skip


def stated(options: argparse.Namespace) -> dict[str, Any]:
    """Return the fields of ``Knowledge`` that the options state."""
    known = {
        "inertia_factor": UNIFORM if options.uniform else options.inertia_factor,
        "marker_offset": options.rod_point,
        "seat_height": options.seat_height,
        "mass_ratio": options.mass_ratio,
        "noise": options.noise,
    }
    return {name: told for name, told in known.items() if told}


def answer(found: "PoseEstimate", flight: Flight | None = None) -> dict:
    """Return the answer as plain values: lengths in m, null for what is not known, pairs [value, deviation].

    With the flight it adds the reader's assumptions and the findings of the checks; encoders have none.
    """
    notes, against, good = _checked(flight)
    names = ("effective_length", "rod_point", "seat_height", "com_height", "inertia_factor", "uniform_length")
    return {
        "length": _number(found.length),
        "standard_deviation": _number(found.standard_deviation),
        "interval": None if math.isnan(found.length) else list(found.interval),
        "refused": found.reason,
        "assumed": [*notes, *found.assumed],
        "checks": {
            "findings": [finding._asdict() for finding in against],
            "passed": good,
            "notes": list(found.notes),
            "noise": found.noise,
            "autocorrelation_of_innovations": found.whiteness,
            "distance_of_tracked_points": _number(found.distance.value),
            "its_deviation_from_the_estimate": _number(found.distance.deviation),
        },
        **{name: [_number(part) for part in getattr(found, name)] for name in names},
    }


def in_json(found: "PoseEstimate", flight: Flight | None = None) -> str:
    """Return ``answer`` as one JSON object."""
    return json.dumps(answer(found, flight), indent=2)


def sentences(found: "PoseEstimate", flight: Flight | None = None) -> str:
    """Return the answer in words; see ``answer``."""
    notes, against, good = _checked(flight)
    if found.reason is None:
        interval = "95 %: {:.4f} to {:.4f} m".format(*found.interval)
        lines = [f"length     {found.length:.4f} m +- {found.standard_deviation:.4f} m, {interval}"]
    else:
        lines = [f"refused    {found.reason}"]
    told = {"seat": found.seat_height, "rod point": found.rod_point}
    if flight is None:  # two encoders determine this one best
        told["L_e"] = found.effective_length
    lines += [f"{name:<10} {value:.4f} m +- {deviation:.4f} m"
              for name, (value, deviation) in told.items() if math.isfinite(value)]  # fmt: skip
    checked = [finding.sentence for finding in against if finding.sentence != found.reason] + list(found.notes)
    if flight is not None:
        checked.append(f"passed: {', '.join(good) or 'none'}")
    for word, said in (("assumed", (*notes, *found.assumed)), ("checks", checked)):
        lines += [f"{'' if index else word:<10} {sentence}" for index, sentence in enumerate(said)]
    return "\n".join(lines)


def _checked(flight: Flight | None) -> tuple[tuple[str, ...], list[Finding], list[str]]:
    """Return the reader's assumptions, the findings against the flight, and the checks that it passed."""
    if flight is None:
        return (), [], []
    against = findings(flight)
    return flight.notes, against, passed(flight, against)


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _told(tolerance: float) -> Callable[[str], Told]:
    """Return what reads VALUE[,TOLERANCE]; without one it is ``tolerance``."""

    def value_and_tolerance(text: str) -> Told:
        value, _, stated = text.partition(",")
        return Told(float(value), float(stated or tolerance))

    return value_and_tolerance


def _noise(text: str) -> tuple[float, float]:
    """Read METRES,RADIANS."""
    metres, _, radians = text.partition(",")
    noise = float(metres), float(radians)
    if not all(math.isfinite(one) and one > 0.0 for one in noise):
        raise argparse.ArgumentTypeError(f"{text} is not two positive numbers, METRES,RADIANS, as in 0.002,0.01")
    return noise


def _radius(text: str) -> float:
    """Read a radius in m."""
    if not (radius := float(text)) > 0.0:
        raise argparse.ArgumentTypeError(f"{text} is not a positive number of metres")
    return radius
