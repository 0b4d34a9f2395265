#!/usr/bin/env python3
"""Fly a scenario through the pilot and record a ROS 2 bag.

    python scripts/fly.py --list
    python scripts/fly.py --scenario circle-0.8 --output my-flight
    python scripts/fly.py --scenario push-hover --set pendulum.length=0.8 --seed 7 --output short-rod

The vehicle is simulated, and the bag says so.
"""

import argparse
import ast
import dataclasses
import shutil
import sys
import time
from pathlib import Path
from typing import Any

from tqdm import tqdm

from fiplib import bags, simulate


def main(arguments: list[str] | None = None) -> int:
    options = parse(arguments)
    if options.list:
        width = max(map(len, simulate.SCENARIOS))
        for scenario in simulate.SCENARIOS.values():
            print(f"{scenario.name:{width}}  {scenario.duration:4.0f} s  {scenario.description}")
        return 0
    try:
        scenario = chosen(options)
        output = Path(options.output or scenario.name)
        if options.force and is_bag(output):
            shutil.rmtree(output)
        outcome, seconds = fly(scenario, output)
    except (ValueError, bags.BagError, OSError) as error:
        print(f"fly.py: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"fly.py: interrupted; what was flown until then is in {output}", file=sys.stderr)
        return 130
    end = "still balanced" if outcome.survived else "FELL"
    print(f"simulated {outcome.duration:.2f} s in {seconds:.1f} s, {end}; wrote {output}")
    return 0


def parse(arguments: list[str] | None) -> argparse.Namespace:
    description, _, examples = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        description=description, epilog=examples, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    action = parser.add_mutually_exclusive_group(required=True)
    action.add_argument("--scenario", metavar="NAME", help="which flight to fly (see --list)")
    action.add_argument("--list", action="store_true", help="list the scenarios")
    parser.add_argument("--output", metavar="BAG", help="folder of the bag to write (default: the scenario's name)")
    parser.add_argument("--force", action="store_true", help="replace BAG if it is a bag already")
    parser.add_argument("--seed", type=int, help="seed of noise and estimator (default: the scenario's)")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="GROUP.NAME=VALUE",
        help="change a parameter of fiplib/params.py, e.g. pendulum.length=0.8; may be repeated",
    )
    return parser.parse_args(arguments)


def chosen(options: argparse.Namespace) -> simulate.Scenario:
    """The scenario that the options ask for.

    Raises:
        ValueError: an unknown scenario or parameter, or a value that cannot be read.
    """
    if options.scenario not in simulate.SCENARIOS:
        raise ValueError(f"no scenario {options.scenario!r}; there are {', '.join(simulate.SCENARIOS)}")
    scenario = simulate.SCENARIOS[options.scenario]
    params = scenario.params.replace(**dict(map(assignment, options.set)))
    seed = scenario.seed if options.seed is None else options.seed
    return dataclasses.replace(scenario, params=params, seed=seed)


def assignment(text: str) -> tuple[str, Any]:
    """``group.name=value`` as a keyword of ``Params.replace``; a value that is no Python literal is a string."""
    name, equals, value = text.partition("=")
    if not equals:
        raise ValueError(f"--set {text}: write GROUP.NAME=VALUE, for example pendulum.length=0.8")
    try:
        parsed = ast.literal_eval(value)
    except (ValueError, SyntaxError):
        parsed = float(value) if value in ("inf", "-inf") else value
    return name.replace(".", "__", 1), parsed


def is_bag(path: Path) -> bool:
    """Whether --force may delete this folder: a bag that we or ROS wrote, nothing else."""
    return path.is_dir() and {entry.suffix for entry in path.iterdir()} <= {".mcap", ".yaml"}


def fly(scenario: simulate.Scenario, output: Path) -> tuple[simulate.Outcome, float]:
    """Fly and record; returns how the flight ended and how long it took in s."""
    started = time.perf_counter()
    with (
        bags.Recorder(output, scenario.metadata()) as recorder,
        tqdm(total=round(scenario.duration), unit="s", desc=scenario.name, disable=None, leave=False) as bar,
    ):
        outcome = simulate.fly(scenario, recorder, lambda seconds: bar.update(round(seconds) - bar.n))
    return outcome, time.perf_counter() - started


if __name__ == "__main__":
    sys.exit(main())
