"""What a bag holds, in words."""

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path

from fiplib import console
from fiplib.bags.reader import read
from fiplib.bags.recovery import recover
from fiplib.params import Params
from fiplib.recording import ROLES, BagError, Flight


def describe(flight: Flight) -> str:
    """What ``info`` prints: origin, scenario, duration, topics, parameters that differ from the default."""
    origin = {"simulated": "SIMULATED, not a real vehicle", "real": "real", "unknown": "unknown (the bag does not say)"}
    words = {key: flight.metadata.get(key, "-") for key in ("scenario", "version", "seed")}
    lines = [f"{'bag':<10} {flight.path}", f"{'origin':<10} {origin[flight.metadata['origin']]}"]
    lines += [f"{key:<10} {value}" for key, value in words.items()]
    if isinstance(recovered := flight.metadata.get("recovered"), dict):
        lines.append(f"{'recovered':<10} from {recovered.get('from')}, {recovered.get('damaged_bytes')} bytes damaged")
        lines[-1] += "" if recovered.get("finished") else ", without the end of the recording"
    lines += [f"{'duration':<10} {flight.duration:.2f} s", f"{'events':<10} {len(flight.events)}"]
    lines += [f"{'refit':<10} {flight.why_not_refit() or 'possible'}", ""]
    width = max(len(info.topic) for info in flight.topics)
    kind = max(len(info.type) for info in flight.topics)
    lines.append(f"{'topic':<{width}}  {'type':<{kind}}  {'messages':>8}  {'Hz':>6}  role")
    for info in flight.topics:
        rate = f"{(info.count - 1) / flight.duration:.1f}" if info.count > 1 and flight.duration > 0 else "-"
        lines.append(f"{info.topic:<{width}}  {info.type:<{kind}}  {info.count:>8}  {rate:>6}  {info.role}".rstrip())
    lines += ["", "parameters that differ from the default"]
    params, default = flight.params.to_dict(), Params().to_dict()
    changed = [
        f"  {group}.{name} = {value} {field.metadata['unit']} (default {default[group][name]})"
        for group, values in params.items()
        for (name, value), field in zip(values.items(), dataclasses.fields(getattr(Params(), group)), strict=True)
        if value != default[group][name]
    ]
    return "\n".join(lines + (changed or ["  none"]))


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line: ``info BAG``, ``recover BAG``. Returns the exit code: 0, or 2 with one line on stderr."""
    parser = argparse.ArgumentParser(prog="python -m fiplib.bags.reader", description="Look into recorded flights.")
    commands = parser.add_subparsers(dest="command", required=True)
    info = commands.add_parser("info", help="say what a bag holds, and check it")
    info.add_argument("bag", type=Path, help="directory of a ROS 2 bag, or a bare .mcap file")
    info.add_argument(
        "--topic", action="append", default=[], metavar="ROLE=NAME", help=f"remap a topic; roles: {', '.join(ROLES)}"
    )
    rescue = commands.add_parser("recover", help="write what is left of a damaged or unfinished bag into a new one")
    rescue.add_argument("bag", type=Path, help="directory of a ROS 2 bag, or a bare .mcap file; it is not changed")
    rescue.add_argument("--output", type=Path, metavar="NEW", help="folder of the new bag (default: BAG-recovered)")
    options = parser.parse_args(arguments)
    try:
        if options.command == "info":
            print(describe(read(options.bag, dict(pair.partition("=")[::2] for pair in options.topic))))
        else:
            print(recover(options.bag, options.output).describe())
    except BagError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(console.run(main))
