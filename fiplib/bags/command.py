"""``fip bag info BAG`` says what a bag holds; ``fip bag recover BAG`` saves what is left of a damaged one."""

import argparse
from pathlib import Path

from fiplib.bags.info import Remarks, describe
from fiplib.bags.reader import read
from fiplib.bags.recovery import recover
from fiplib.recording import ROLES


def add_arguments(parser: argparse.ArgumentParser, remarks: Remarks | None = None) -> None:
    """Add the subcommands; ``remarks`` are further lines of ``info``."""
    commands = parser.add_subparsers(dest="command", required=True)
    info = commands.add_parser("info", help="say what a bag holds, and check it")
    info.add_argument("bag", type=Path, help="directory of a ROS 2 bag, or a bare .mcap file")
    info.add_argument(
        "--topic", action="append", default=[], metavar="ROLE=NAME", help=f"remap a topic; roles: {', '.join(ROLES)}"
    )
    info.set_defaults(remarks=remarks)
    rescue = commands.add_parser("recover", help="write what is left of a damaged or unfinished bag into a new one")
    rescue.add_argument("bag", type=Path, help="directory of a ROS 2 bag, or a bare .mcap file; it is not changed")
    rescue.add_argument("--output", type=Path, metavar="NEW", help="folder of the new bag (default: BAG-recovered)")


def run(options: argparse.Namespace) -> int:
    """Print the answer; the exit status. Raises BagError."""
    if options.command == "info":
        flight = read(options.bag, dict(pair.partition("=")[::2] for pair in options.topic))
        print(describe(flight, options.remarks))
    else:
        print(recover(options.bag, options.output).describe())
    return 0
