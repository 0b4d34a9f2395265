"""``fip bag``: what a bag holds, how long its rod was, and what is left of a damaged one."""

import argparse
from pathlib import Path

from fiplib.bags.info import describe
from fiplib.bags.reader import read
from fiplib.bags.recovery import recover
from fiplib.estimators.poses import report
from fiplib.recording import ROLES


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
    report.add_arguments(length)
    rescue = commands.add_parser("recover", help="write what is left of a damaged or unfinished bag into a new one")
    rescue.add_argument("bag", type=Path, help="directory of a ROS 2 bag, or a bare .mcap file; it is not changed")
    rescue.add_argument("--output", type=Path, metavar="NEW", help="folder of the new bag (default: BAG-recovered)")


def run(options: argparse.Namespace) -> int:
    """Print the answer; return the exit status: 0, or 3 if a length is refused. Raises BagError."""
    if options.command == "recover":
        print(recover(options.bag, options.output).describe())
        return 0
    from fiplib import replay  # with its solvers it takes longer to import than a bag to recover

    flight = read(options.bag, dict(pair.partition("=")[::2] for pair in options.topic))
    if options.command == "info":
        print(describe(flight, {"refit": lambda flight: replay.why_not_refit(flight) or "possible"}))
        return 0
    found = replay.length_from_poses(flight, **report.stated(options))
    say = report.in_json if options.json else report.sentences
    print(say(found, flight.notes))
    return 0 if found.reason is None else 3
