"""The subcommands of ``fip bag`` and their arguments."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fiplib.bags.conventions import QUATERNIONS, UNITS, UPWARDS
from fiplib.bags.csv_files import POSE, Stated
from fiplib.bags.explanations import words
from fiplib.bags.roles import BODIES
from fiplib.bags.tables import FORMATS, TABLES
from fiplib.recording import ROLES


def add_arguments(parser: argparse.ArgumentParser) -> argparse.ArgumentParser:
    """Add info, length, cut, export, recover and convert; return the parser of length, which takes more."""
    commands: Any = parser.add_subparsers(dest="command", required=True)
    info = commands.add_parser("info", help="describe the contents of a bag, and check it")
    info.add_argument("--explain", action=_Explain, help="print advice on recording, explain each check, and exit")
    length = commands.add_parser("length", help="estimate the length of the rod from the two tracked bodies alone")
    cut = commands.add_parser("cut", help="write a stretch of a bag into a new one")
    export = commands.add_parser("export", help="write states, poses or estimates into a CSV, Parquet or NPZ file")
    for command in (info, length, cut, export):
        what = "; or a CSV file of the encoders of a cart or an arm" if command is length else ""
        command.add_argument("bag", type=Path, help=f"directory of a ROS 2 bag, or a bare .mcap file{what}")
        command.add_argument("--topic", action="append", default=[], metavar="ROLE=NAME",
                             help=f"remap a topic; roles: {', '.join(ROLES)}")  # fmt: skip
        if command is cut:
            continue
        poses = command.add_argument_group("conventions of the poses", "If not z up, metres, x y z w.")
        poses.add_argument("--up", choices=UPWARDS, help="axis that points up; a minus as in --up=-z, which is NED")
        poses.add_argument("--unit", choices=UNITS, help="unit of positions")
        poses.add_argument("--swap", action="store_true", help="exchange the vehicle and the rod")
        poses.add_argument("--stamps", choices=("log",), help="use the times of logging as stamps of the poses")
        poses.add_argument("--quaternion", action="append", default=[], metavar="[BODY=]ORDER", type=_orders,
                           help=f"{', '.join(QUATERNIONS)}; for one body with vehicle= or pendulum=")  # fmt: skip
    cut.add_argument("--from", dest="start", type=float, default=0.0, metavar="S",
                     help="s after the first pose (default: 0)")  # fmt: skip
    cut.add_argument("--to", dest="end", type=float, metavar="S", help="s after the first pose (default: the end)")
    cut.add_argument("--output", type=Path, metavar="NEW", help="folder of the new bag (default: BAG-cut)")
    export.add_argument("--to", dest="file", type=Path, required=True, metavar="FILE",
                        help=f"file to create; its name ends in {', '.join(FORMATS)}")  # fmt: skip
    export.add_argument("--what", choices=tuple(TABLES), default="states", help="table to export (default: states)")
    rescue = commands.add_parser("recover", help="write what is left of a damaged or unfinished bag into a new one")
    rescue.add_argument("bag", type=Path, help="directory of a ROS 2 bag, or a bare .mcap file; it is not changed")
    rescue.add_argument("--output", type=Path, metavar="NEW", help="folder of the new bag (default: BAG-recovered)")
    convert = commands.add_parser("convert", help="write a CSV file of motion capture, or a ROS 1 bag, into a new bag")
    convert.add_argument("source", type=Path, help="the CSV file or the .bag file; it is not changed")
    convert.add_argument(
        "--output", type=Path, metavar="BAG", help="folder of the new bag (default: SOURCE, no suffix)"
    )
    table = convert.add_argument_group("CSV files", "Conventions that the file does not state itself.")
    table.add_argument("--columns", metavar="MAPPING",
                       help="which column is what, by names in the header or numbers from 1: time=, vehicle= and "
                            f"pendulum=, each body with its {', '.join(POSE)}, all between commas; frame= in place of "
                            "time= takes frame numbers, with --rate")  # fmt: skip
    table.add_argument("--unit", choices=sorted(UNITS), help="unit of positions (default: the header's, else m)")
    table.add_argument("--up", choices=("y", "z"), help="axis that points up (default: y for Motive, else z)")
    table.add_argument("--rate", type=float, metavar="HZ", help="frame rate, in place of a column of times")
    table.add_argument("--vehicle", metavar="NAME", help="body that is the vehicle (default: by its name)")
    table.add_argument("--pendulum", metavar="NAME", help="body that is the rod (default: by its name)")
    return length


def stated(options: argparse.Namespace) -> Stated:
    """Return the conventions of a CSV file that the options of convert state."""
    return Stated(*(getattr(options, name) for name in Stated._fields))


def reading(options: argparse.Namespace) -> dict[str, Any]:
    """Return the conventions that the options of info, length and export state: keyword arguments of ``bags.read``."""
    orders: dict[str, str] = {}
    for told in options.quaternion:
        orders |= told
    same = {name: getattr(options, name) for name in ("up", "unit", "swap", "stamps")}
    return {"topics": topics(options), "quaternion": orders, **same}


def topics(options: argparse.Namespace) -> dict[str, str]:
    """Return the names of topics that the options state, by role."""
    return dict(pair.partition("=")[::2] for pair in options.topic)


def _orders(text: str) -> dict[str, str]:
    """[BODY=]ORDER -> the order of quaternions by body."""
    body, _, order = text.rpartition("=")
    for given, known in ((order, QUATERNIONS), (body or BODIES[0], BODIES)):
        if given not in known:
            raise argparse.ArgumentTypeError(f"{given} is none of {', '.join(known)}")
    return {body: order} if body else dict.fromkeys(BODIES, order)


class _Explain(argparse.Action):
    """Prints the explanations and ends, as --help does."""

    def __init__(self, option_strings: Sequence[str], dest: str, **options: Any) -> None:
        super().__init__(option_strings, dest, nargs=0, **options)

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        print(words())
        parser.exit()
