"""``fip bag``: what a bag holds, how long its rod was; cut, export or recover it, convert recordings of other kinds."""

import argparse
from dataclasses import replace
from pathlib import Path

from fiplib.bags import arguments
from fiplib.bags.checks import findings
from fiplib.bags.convert import convert
from fiplib.bags.cutting import cut
from fiplib.bags.info import inform
from fiplib.bags.reader import read
from fiplib.bags.recovery import recover
from fiplib.bags.tables import export
from fiplib.estimators.poses import report


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

    if options.command == "length" and options.plot:
        from fiplib.reproduction import length_figure

        length_figure.check_name(options.plot)  # before the work
    reading = arguments.reading(options)
    if options.command == "info":
        print(inform(options.bag, reading, {"refit": lambda flight: replay.why_not_refit(flight) or "possible"}))
        return 0
    from fiplib.estimators.poses import history

    flight = read(options.bag, **reading)
    if options.command == "export":
        if options.what == "states":
            flight = replace(flight, state=replay.states(flight))
        elif options.what == "estimates" and not history.estimated(flight):
            made = history.windows(flight, Knowledge.of_flight(flight))
            flight = replace(flight, length=history.series_of(flight, made))
        print(export(flight, options.file, options.what))
        return 0
    knowledge = replace(Knowledge.of_flight(flight), **report.stated(options))
    growing = list(history.growing(flight, knowledge)) if options.plot else []
    found = growing[-1].found if growing else replay.estimate(flight, knowledge)
    if growing:
        windows = list(history.windows(flight, knowledge))
        length_figure.save(length_figure.length_figure(flight, windows, growing), options.plot)
    say = report.in_json if options.json else report.sentences
    print(say(found, flight.notes, findings(flight)))
    return 0 if found.reason is None else 3
