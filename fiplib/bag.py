"""``fip bag``: what a bag holds, how long its rod was; recover a damaged one, convert recordings of other kinds."""

import argparse

from fiplib.bags import arguments
from fiplib.bags.checks import findings
from fiplib.bags.convert import convert
from fiplib.bags.info import describe
from fiplib.bags.reader import read
from fiplib.bags.recovery import recover
from fiplib.estimators.poses import report


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the subcommands info, length, recover and convert."""
    length = arguments.add_arguments(parser)
    length.add_argument("--json", action="store_true", help="print one JSON object, lengths in m")
    report.add_arguments(length)


def run(options: argparse.Namespace) -> int:
    """Print the answer; return the exit status: 0, or 3 if a length is refused. Raises BagError."""
    if options.command == "recover":
        print(recover(options.bag, options.output).describe())
        return 0
    if options.command == "convert":
        print(convert(options.source, options.output, arguments.stated(options)))
        return 0
    from fiplib import replay  # with its solvers it takes longer to import than a bag to recover

    flight = read(options.bag, **arguments.reading(options))
    if options.command == "info":
        print(describe(flight, {"refit": lambda flight: replay.why_not_refit(flight) or "possible"}))
        return 0
    found = replay.length_from_poses(flight, **report.stated(options))
    say = report.in_json if options.json else report.sentences
    print(say(found, flight.notes, findings(flight)))
    return 0 if found.reason is None else 3
