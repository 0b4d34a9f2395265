"""``fip bag``: what a bag holds, what is left of a damaged one, and how long the rod was."""

import argparse
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from fiplib.bags.info import describe
from fiplib.bags.reader import read
from fiplib.bags.recovery import recover
from fiplib.estimators.poses.knowledge import UNIFORM, Told
from fiplib.recording import ROLES

if TYPE_CHECKING:
    from fiplib.estimators.poses.estimate import PoseEstimate

ANSWERED, REFUSED = 0, 3
"""Exit statuses of ``fip bag length``; a bag that cannot be read ends with 2, as all mistakes do."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the subcommands info, length and recover."""
    commands, roles = parser.add_subparsers(dest="command", required=True), ", ".join(ROLES)
    info = commands.add_parser("info", help="say what a bag holds, and check it")
    length = commands.add_parser("length", help="say how long the rod is, from the two tracked bodies alone")
    for command in (info, length):
        command.add_argument("bag", type=Path, help="directory of a ROS 2 bag, or a bare .mcap file")
        command.add_argument("--topic", action="append", default=[], metavar="ROLE=NAME",
                             help=f"remap a topic; roles: {roles}")  # fmt: skip
    length.add_argument("--json", action="store_true", help="print one JSON object, lengths in m")
    rod = length.add_mutually_exclusive_group()
    rod.add_argument("--uniform", action="store_true", help="the rod is uniform, wherever it is tracked")
    told = "VALUE[,TOLERANCE]"
    rod.add_argument("--inertia-factor", type=_told(UNIFORM.tolerance), metavar=told,
                     help="1 for a point mass, 0.75 for a uniform rod")  # fmt: skip
    length.add_argument("--rod-point", type=_told(1e-3), metavar=told,
                        help="how far above the rod's middle it is tracked, m; 0 if at its middle")  # fmt: skip
    length.add_argument("--seat-height", type=_told(2e-3), metavar=told,
                        help="of the rod's seat above the vehicle's tracked point, m")  # fmt: skip
    length.add_argument("--mass-ratio", type=_told(1e-3), metavar=told, help="mass of the rod over rod and vehicle")
    rescue = commands.add_parser("recover", help="write what is left of a damaged or unfinished bag into a new one")
    rescue.add_argument("bag", type=Path, help="directory of a ROS 2 bag, or a bare .mcap file; it is not changed")
    rescue.add_argument("--output", type=Path, metavar="NEW", help="folder of the new bag (default: BAG-recovered)")


def run(options: argparse.Namespace) -> int:
    """Print the answer; return the exit status. Raises BagError."""
    if options.command == "recover":
        print(recover(options.bag, options.output).describe())
        return ANSWERED
    from fiplib import replay  # with its solvers it takes longer to import than a bag to recover

    flight = read(options.bag, dict(pair.partition("=")[::2] for pair in options.topic))
    if options.command == "info":
        print(describe(flight, {"refit": lambda flight: replay.why_not_refit(flight) or "possible"}))
        return ANSWERED
    stated = {
        "inertia_factor": UNIFORM if options.uniform else options.inertia_factor,
        "marker_offset": options.rod_point,
        "seat_height": options.seat_height,
        "mass_ratio": options.mass_ratio,
    }
    found = replay.length_from_poses(flight, **{name: told for name, told in stated.items() if told})
    print(json.dumps(answer(found, flight.notes), indent=2) if options.json else sentences(found, flight.notes))
    return ANSWERED if found.reason is None else REFUSED


def answer(found: "PoseEstimate", notes: tuple[str, ...] = ()) -> dict:
    """Return the answer as plain values: lengths in m, null for what is not known, pairs [value, deviation]."""
    names = ("effective_length", "rod_point", "seat_height", "com_height", "inertia_factor", "uniform_length")
    return {
        "length": _number(found.length),
        "standard_deviation": _number(found.standard_deviation),
        "interval": None if math.isnan(found.length) else list(found.interval),
        "refused": found.reason,
        "assumed": [*notes, *found.assumed],
        "checks": {
            "notes": list(found.notes),
            "noise": found.noise,
            "autocorrelation_of_innovations": found.whiteness,
            "distance_of_tracked_points": _number(found.distance.value),
            "its_deviation_from_the_estimate": _number(found.distance.deviation),
        },
        **{name: [_number(part) for part in getattr(found, name)] for name in names},
    }


def sentences(found: "PoseEstimate", notes: tuple[str, ...] = ()) -> str:
    """Return the answer in words."""
    if found.reason is None:
        interval = "95 %: {:.4f} to {:.4f} m".format(*found.interval)
        lines = [f"length     {found.length:.4f} m +- {found.standard_deviation:.4f} m, {interval}"]
    else:
        lines = [f"refused    {found.reason}"]
    told = {"seat": found.seat_height, "rod point": found.rod_point}
    lines += [f"{name:<10} {value:.4f} m +- {deviation:.4f} m"
              for name, (value, deviation) in told.items() if math.isfinite(value)]  # fmt: skip
    for word, said in (("assumed", (*notes, *found.assumed)), ("checks", found.notes)):
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
