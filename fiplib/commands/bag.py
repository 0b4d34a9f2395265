"""``fip bag``: describe a bag, estimate its rod's length; cut, export or recover it, convert other recordings."""

import argparse
import math
from dataclasses import replace
from pathlib import Path

from tqdm import tqdm

from fiplib.bags import arguments
from fiplib.bags.convert import convert
from fiplib.bags.cutting import cut
from fiplib.bags.info import inform
from fiplib.bags.reader import read
from fiplib.bags.recovery import recover
from fiplib.bags.tables import export
from fiplib.estimators.poses import report
from fiplib.recording import BagError

PATIENCE = 2.0
"""Seconds after which progress is shown."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the subcommands info, length, cut, export, recover and convert."""
    length = arguments.add_arguments(parser)
    length.add_argument("--json", action="store_true", help="print one JSON object, lengths in m")
    length.add_argument("--plot", type=Path, metavar="FILE", help="draw the length over the flight: .png or .pdf")
    report.add_arguments(length)


def run(options: argparse.Namespace) -> int:
    """Print the answer; return the exit status: 0, or 3 if a length is refused. Raises BagError."""
    if options.command == "recover":
        print(recover(options.bag, options.output).describe())
    elif options.command == "convert":
        print(convert(options.source, options.output, arguments.stated(options)))
    elif options.command == "cut":
        topics = arguments.topics(options)
        print(cut(options.bag, options.output, options.start, options.end, topics).describe())
    else:
        return _read(options)
    return 0


def _read(options: argparse.Namespace) -> int:
    from fiplib import replay  # with its solvers it takes longer to import than a bag to recover
    from fiplib.estimators.poses.knowledge import Knowledge

    if options.command == "length":
        return _length(options)
    reading = arguments.reading(options)
    if options.command == "info":
        print(inform(options.bag, reading, {"refit": lambda flight: replay.why_not_refit(flight) or "possible"}))
        return 0
    from fiplib.estimators.poses import history

    flight = read(options.bag, **reading)
    if options.what == "states":
        flight = replace(flight, state=replay.states(flight))
    elif options.what == "estimates" and not history.estimated(flight):
        made = history.windows(flight, Knowledge.of_flight(flight))
        flight = replace(flight, length=history.series_of(flight, made))
    print(export(flight, options.file, options.what))
    if options.what == "states" and (said := replay.assumed_seat(flight)):
        print(said)
    return 0


def _length(options: argparse.Namespace) -> int:
    from fiplib.estimators.poses import planar

    if options.plot:
        from fiplib.reproduction import length_figure

        length_figure.check_name(options.plot)  # before the work
    flight = None
    if planar.is_encoders(options.bag):
        if options.plot:
            raise BagError(f"{options.bag}: there is no figure of encoders; leave out --plot")
        time, base, angle = planar.read_encoders(options.bag)
        known = replace(planar.PRIOR, **report.stated(options))
        found = planar.planar(time, base, time, angle, known, options.arm_radius)
    else:
        if math.isfinite(options.arm_radius):
            raise BagError(f"{options.bag}: no CSV file of encoders; leave out --arm-radius")
        from fiplib.estimators.poses import history
        from fiplib.estimators.poses.knowledge import Knowledge

        with tqdm(desc=options.bag.name, unit="part", delay=PATIENCE, leave=False, disable=None) as bar:

            def advance(left: int) -> None:
                bar.total = bar.n + left + 1 if left else bar.n + 1
                bar.update()

            flight = read(options.bag, **arguments.reading(options))
            knowledge = replace(Knowledge.of_flight(flight), **report.stated(options))
            points = history.POINTS if options.plot else 0
            shrunk = history.length_of_flight(flight, knowledge, points, advance)
            found = shrunk.answer
            if options.plot:
                windows = list(history.windows(flight, knowledge, advance=advance))
                length_figure.save(length_figure.length_figure(flight, windows, shrunk), options.plot)
    print((report.in_json if options.json else report.sentences)(found, flight))
    return 0 if found.reason is None else 3
