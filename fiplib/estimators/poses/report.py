"""The pose estimator's words for a command line: what may be stated, and its answer in words and as plain values."""

import argparse
import json
import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from fiplib.bags.checks import Finding, passed
from fiplib.estimators.poses.knowledge import UNIFORM, Told

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
                        help="of the rod's seat above the vehicle's tracked point, m")  # fmt: skip
    parser.add_argument("--mass-ratio", type=_told(1e-3), metavar=told, help="mass of the rod over rod and vehicle")


def stated(options: argparse.Namespace) -> dict[str, Told]:
    """Return the fields of ``Knowledge`` that the options state."""
    known = {
        "inertia_factor": UNIFORM if options.uniform else options.inertia_factor,
        "marker_offset": options.rod_point,
        "seat_height": options.seat_height,
        "mass_ratio": options.mass_ratio,
    }
    return {name: told for name, told in known.items() if told}


def answer(found: "PoseEstimate", notes: tuple[str, ...] = (), findings: Sequence[Finding] = ()) -> dict:
    """Return the answer as plain values: lengths in m, null for what is not known, pairs [value, deviation].

    ``notes`` say what reading assumed, ``findings`` what ``bags.checks`` has against the flight.
    """
    names = ("effective_length", "rod_point", "seat_height", "com_height", "inertia_factor", "uniform_length")
    return {
        "length": _number(found.length),
        "standard_deviation": _number(found.standard_deviation),
        "interval": None if math.isnan(found.length) else list(found.interval),
        "refused": found.reason,
        "assumed": [*notes, *found.assumed],
        "checks": {
            "findings": [finding._asdict() for finding in findings],
            "passed": passed(findings),
            "notes": list(found.notes),
            "noise": found.noise,
            "autocorrelation_of_innovations": found.whiteness,
            "distance_of_tracked_points": _number(found.distance.value),
            "its_deviation_from_the_estimate": _number(found.distance.deviation),
        },
        **{name: [_number(part) for part in getattr(found, name)] for name in names},
    }


def in_json(found: "PoseEstimate", notes: tuple[str, ...] = (), findings: Sequence[Finding] = ()) -> str:
    """Return ``answer`` as one JSON object."""
    return json.dumps(answer(found, notes, findings), indent=2)


def sentences(found: "PoseEstimate", notes: tuple[str, ...] = (), findings: Sequence[Finding] = ()) -> str:
    """Return the answer in words."""
    if found.reason is None:
        interval = "95 %: {:.4f} to {:.4f} m".format(*found.interval)
        lines = [f"length     {found.length:.4f} m +- {found.standard_deviation:.4f} m, {interval}"]
    else:
        lines = [f"refused    {found.reason}"]
    told = {"seat": found.seat_height, "rod point": found.rod_point}
    lines += [f"{name:<10} {value:.4f} m +- {deviation:.4f} m"
              for name, (value, deviation) in told.items() if math.isfinite(value)]  # fmt: skip
    against = [finding.sentence for finding in findings if finding.sentence != found.reason]
    checked = (*against, *found.notes, f"passed: {', '.join(passed(findings)) or 'none'}")
    for word, said in (("assumed", (*notes, *found.assumed)), ("checks", checked)):
        lines += [f"{'' if index else word:<10} {sentence}" for index, sentence in enumerate(said)]
    return "\n".join(lines)


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _told(tolerance: float) -> Callable[[str], Told]:
    """Return what reads VALUE[,TOLERANCE]; without one it is ``tolerance``."""

    def value_and_tolerance(text: str) -> Told:
        value, _, stated = text.partition(",")
        return Told(float(value), float(stated or tolerance))

    return value_and_tolerance
