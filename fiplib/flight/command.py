"""Fly a scenario through the pilot and record a ROS 2 bag.

    python scripts/fly.py --list
    python scripts/fly.py --scenario circle-0.8 --output my-flight
    python scripts/fly.py --scenario push-hover --set pendulum.length=0.8 --seed 7 --output short-rod
    python scripts/fly.py --scenario estimate-1.4 --real-time --output live

The vehicle is simulated unless --link says otherwise, and the bag says which. Nothing here has flown on a vehicle.
In real time, Ctrl-C lands (levels and descends; the rod is given up); a second one stops the motors.
"""

import argparse
import contextlib
import dataclasses
import math
import shutil
import sys
import time
from pathlib import Path

from tqdm import tqdm

from fiplib import bags, simulate
from fiplib.bags.live import LiveRecorder
from fiplib.flight.display import View
from fiplib.flight.estimator import EstimatorProcess
from fiplib.flight.failsafe import Guard
from fiplib.flight.links import LinkError, available
from fiplib.flight.loop import FlightLoop
from fiplib.flight.operator import Operator
from fiplib.flight.sender import urgent
from fiplib.params import Params, assignment
from fiplib.recording import Flight


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
        if options.link == "sim" and not (options.real_time or options.failsafe):
            if (scenario.params.safety, scenario.params.radio) != (Params().safety, Params().radio):
                raise ValueError("--set safety or radio: they fly with --real-time, --failsafe or --link crsf only")
            flight, seconds = fly(scenario, output)
        else:
            return fly_safely(scenario, output, options)
    except (ValueError, bags.BagError, LinkError, OSError) as error:
        print(f"fly.py: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"fly.py: interrupted; what was flown until then is in {output}", file=sys.stderr)
        return 130
    with contextlib.suppress(OSError):  # the terminal may be gone
        end = "still balanced" if flight.survived else "FELL"
        print(f"simulated {flight.duration:.2f} s in {seconds:.1f} s, {end}; wrote {output}")
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
    parser.add_argument("--duration", type=float, metavar="S", help="seconds to fly (default: the scenario's)")
    parser.add_argument(
        "--arm", action="store_true", help="arm a real vehicle once the checks pass, without waiting for Enter"
    )
    links = available()
    parser.add_argument("--link", choices=links, default="sim", help="how to reach the vehicle (default: %(default)s)")
    for name, link in links.items():
        link.arguments(parser.add_argument_group(f"--link {name}"))
    options = parser.parse_args(arguments)
    if options.duration is not None and not 0.0 < options.duration < math.inf:
        parser.error(f"--duration {options.duration:g}: give seconds > 0")
    return options


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
    duration = scenario.duration if options.duration is None else options.duration
    return dataclasses.replace(scenario, params=params, seed=seed, duration=duration)


def is_bag(path: Path) -> bool:
    """Whether --force may delete this folder: a bag that we or ROS wrote, nothing else."""
    return path.is_dir() and {entry.suffix for entry in path.iterdir()} <= {".mcap", ".yaml"}


def fly(scenario: simulate.Scenario, output: Path) -> tuple[Flight, float]:
    """Fly and record; returns the flight and how long it took in s."""
    started = time.perf_counter()
    with (
        bags.BagRecorder(output, scenario.metadata()) as recorder,
        tqdm(total=round(scenario.duration), unit="s", desc=scenario.name, disable=None, leave=False) as bar,
    ):
        flight = simulate.fly(scenario, recorder, lambda seconds: bar.update(round(seconds) - bar.n))
    return flight, time.perf_counter() - started


def fly_safely(scenario: simulate.Scenario, output: Path, options: argparse.Namespace) -> int:
    """Fly through a link behind the failsafe and record; the exit status."""
    link = available()[options.link].from_options(options, scenario)
    # on the bench the vehicle is simulated, but a radio may reach motors
    ask = (link.origin == "real" or options.link == "crsf") and not options.arm
    if ask and not sys.stdin.isatty():
        raise ValueError(f"--link {options.link}: no terminal on which to press Enter; --arm arms without")
    real_time = options.link != "sim" or options.real_time
    metadata = {**scenario.metadata(), "origin": link.origin, "link": options.link, "real_time": real_time}
    metadata["params"] = scenario.params.to_dict()  # those of the failsafe too
    outcome, unrecorded = None, ""
    try:
        # left in reverse order: the commands end first, in good order, then the rest
        with contextlib.ExitStack() as stack:
            operator = stack.enter_context(Operator(ask))
            view, estimator = None, None
            if real_time:
                recorder: bags.BagRecorder = stack.enter_context(LiveRecorder(output, metadata))
                if scenario.params.piloting.estimate:
                    estimator = stack.enter_context(EstimatorProcess(scenario.params, scenario.seed))
                view = stack.enter_context(View())
                view.say("starting; Ctrl-C lands, a second one stops the motors")
                if ask:
                    view.say("Enter arms once the vehicle is ready, Enter again lands")
            else:
                recorder = stack.enter_context(bags.BagRecorder(output, metadata))
                estimator = simulate.SimulatedEstimator(scenario.params, scenario.seed)
            guard = Guard(scenario.params, scenario.reference)
            try:
                stack.enter_context(link)
            except LinkError:
                stack.close()
                shutil.rmtree(output, ignore_errors=True)  # nothing was flown: leave no empty bag behind
                raise
            if real_time:
                urgent(1)
            flight = FlightLoop(scenario, link, guard, recorder, estimator, operator, view)
            started = time.perf_counter()
            outcome = flight.run()
            seconds = time.perf_counter() - started
    except bags.BagError as error:
        if outcome is None:
            raise
        unrecorded = str(error)
    end = "still balanced" if outcome.survived else "not balanced to the end"
    clockwork = flight.clockwork
    wrote = "" if unrecorded else f"; wrote {output}"
    with contextlib.suppress(OSError):  # the terminal may be gone
        print(f"{link.origin}: {outcome.duration:.2f} s in {seconds:.1f} s, {end} ({guard.ended}){wrote}")
        if real_time:
            print(
                f"{clockwork.ticks} ticks, {clockwork.late_ours} answered late, {clockwork.late_machine} with late "
                f"poses; worst answer after {1e3 * clockwork.worst_solve:.1f} ms"
            )
        if unrecorded:
            print(f"fly.py: {unrecorded}", file=sys.stderr)
    return 130 if operator.reason else 2 if unrecorded else 0
