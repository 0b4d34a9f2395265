"""``fip fly``: fly a scenario through the pilot and record a ROS 2 bag.

The vehicle is simulated unless --link says otherwise, and the bag says which. Nothing here has flown on a vehicle.
In real time, Ctrl-C lands (levels and descends; the rod is given up); a second one stops the motors.
"""

import argparse
import contextlib
import dataclasses
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path

from tqdm import tqdm

from fiplib import bags, simulate
from fiplib.bags.replacing import NewBag
from fiplib.flight.failsafe import Guard
from fiplib.flight.limits import Limits, changed
from fiplib.flight.links import available
from fiplib.flight.loop import FlightLoop
from fiplib.flight.session import Session
from fiplib.params import assignment
from fiplib.pilot import Pilot
from fiplib.simulate import Scenario


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``fip fly``, those of every link among them."""
    action = parser.add_mutually_exclusive_group(required=True)
    action.add_argument("--scenario", metavar="NAME", help="which flight to fly (see --list)")
    action.add_argument("--list", action="store_true", help="list the scenarios")
    parser.add_argument("--output", metavar="BAG", help="folder of the bag to write (default: the scenario's name)")
    parser.add_argument("--force", action="store_true", help="replace BAG, if it is a bag, once the new one is whole")
    parser.add_argument("--seed", type=int, help="seed of noise and estimator (default: the scenario's)")
    change = "change a parameter of fiplib/params.py or flight/limits.py, e.g. pendulum.length=0.8; may be repeated"
    parser.add_argument("--set", action="append", default=[], metavar="GROUP.NAME=VALUE", help=change)
    parser.add_argument("--duration", type=float, metavar="S", help="seconds to fly (default: the scenario's)")
    parser.add_argument("--arm", action="store_true", help="arm a real vehicle without waiting for Enter")
    untested = (
        "fly a real vehicle although the machine fails the self-test of its deadlines, a second before the flight"
    )
    parser.add_argument("--ignore-self-test", action="store_true", help=untested)
    links = available()
    parser.add_argument("--link", choices=links, default="sim", help="how to reach the vehicle (default: %(default)s)")
    for name, link in links.items():
        link.arguments(parser.add_argument_group(f"--link {name}"))


def run(options: argparse.Namespace) -> int:
    """Fly as the options ask; returns the exit status, see ``fly``."""
    if options.list:
        return list_scenarios()
    scenario, limits = chosen(options)
    output = Path(options.output or scenario.name)
    if not behind_failsafe(options, limits):
        return fly_simulated(scenario, output, options.force)
    session = session_of(options, scenario, limits, output)
    return fly(session, Guard(Pilot(scenario.params, scenario.reference), limits))


def list_scenarios() -> int:
    """Print the scenarios."""
    width = max(map(len, simulate.SCENARIOS))
    for scenario in simulate.SCENARIOS.values():
        print(f"{scenario.name:{width}}  {scenario.duration:4.0f} s  {scenario.description}")
    return 0


def chosen(options: argparse.Namespace) -> tuple[Scenario, Limits]:
    """Return the scenario and the limits that the options ask for. Raises ValueError for options that make no sense."""
    if options.duration is not None and not 0.0 < options.duration < math.inf:
        raise ValueError(f"--duration {options.duration:g}: give seconds > 0")
    if options.scenario not in simulate.SCENARIOS:
        raise ValueError(f"no scenario {options.scenario!r}; there are {', '.join(simulate.SCENARIOS)}")
    scenario = simulate.SCENARIOS[options.scenario]
    params, limits = changed(scenario.params, Limits(), map(assignment, options.set))
    seed = scenario.seed if options.seed is None else options.seed
    if seed < 0:
        raise ValueError(f"--seed {seed}: give a whole number, 0 or more")
    duration = scenario.duration if options.duration is None else options.duration
    if duration * params.piloting.mocap_rate < 1.0:
        raise ValueError(f"--duration {duration:g}: shorter than one frame of motion capture; give more seconds")
    return dataclasses.replace(scenario, params=params, seed=seed, duration=duration), limits


def behind_failsafe(options: argparse.Namespace, limits: Limits) -> bool:
    """Return whether the flight has a failsafe around the pilot. Raises ValueError for limits without one."""
    if options.link != "sim" or options.real_time or options.failsafe:
        return True
    if limits != Limits():
        raise ValueError("--set safety or radio: they fly with --real-time, --failsafe or --link crsf only")
    return False


def session_of(options: argparse.Namespace, scenario: Scenario, limits: Limits, output: Path) -> Session:
    """Return the surroundings of the flight that the options ask for, not yet entered. Raises ValueError, LinkError."""
    link = available()[options.link].from_options(options, scenario, limits)
    # on the bench the vehicle is simulated, but a radio may reach motors
    ask = (link.origin == "real" or options.link == "crsf") and not options.arm
    if ask and not sys.stdin.isatty():
        raise ValueError(f"--link {options.link}: no terminal on which to press Enter; --arm arms without")
    real_time = options.link != "sim" or options.real_time
    tested = None if link.origin != "real" else not options.ignore_self_test
    return Session(scenario, limits, link, output, real_time, ask, options.force, tested)


def fly_simulated(scenario: Scenario, output: Path, force: bool) -> int:
    """Fly in the simulator, without failsafe, and record; returns the exit status 0. Raises BagError."""
    started, bag = time.perf_counter(), NewBag(output, force)
    try:
        with (
            bag,
            bags.BagRecorder(bag.path, scenario.metadata()) as recorder,
            tqdm(total=round(scenario.duration), unit="s", desc=scenario.name, disable=None, leave=False) as bar,
        ):

            def progress(
                seconds: float,
            ) -> None:  # called when the first step is done: what can be refused is so before
                bag.begun = bag.flown = True
                bar.update(round(seconds) - bar.n)

            flight = simulate.fly(scenario, recorder, progress)
    finally:
        said(bag.left)
    seconds, end = time.perf_counter() - started, "still balanced" if flight.survived else "FELL"
    print(f"simulated {flight.duration:.2f} s in {seconds:.1f} s, {end}; wrote {output}")
    return 0


def fly(session: Session, guard: Guard, observer: Callable[[FlightLoop, Session], None] | None = None) -> int:
    """Fly behind the failsafe and record.

    Args:
        session: not yet entered; its errors are raised.
        observer: called after each step of the loop.

    Returns:
        The exit status: 0 of a flight that ended on the ground, 130 after an operator's abort, else 1: the vehicle was
        not armed, or was disarmed in the air.
    """
    started = ended = 0.0
    try:
        with session:
            beside = session.recorder, session.estimator, session.operator, session.view
            watch = None if observer is None else lambda loop: observer(loop, session)
            loop = FlightLoop(session.scenario, session.link, guard, *beside, watch)
            started = time.perf_counter()
            try:
                loop.run()
                ended = time.perf_counter()
            finally:
                session.bag.flown = loop.flown
    finally:  # whatever becomes of the recording
        if ended:
            said(summary(session, loop, ended - started))
        said(session.bag.left)
    if not session.bag.left:
        said(f"wrote {session.output}")
    return 130 if session.operator.reason else 0 if guard.landed else 1


def said(words: str) -> None:
    """Print a line, if there is one; a terminal that is gone ends no flight."""
    if words:
        with contextlib.suppress(OSError):
            print(words, flush=True)


def summary(session: Session, loop: FlightLoop, seconds: float) -> str:
    """Return how a flight that took so many seconds ended, in words."""
    end = "still balanced" if loop.balanced else "not balanced to the end"
    words = f"{session.link.origin}: {loop.duration:.2f} s in {seconds:.1f} s, {end} ({loop.guard.ended})"
    if not session.real_time:
        return words
    clockwork = loop.clockwork
    return (
        f"{words}\n{clockwork.ticks} ticks, {clockwork.late_ours} answered late, {clockwork.late_machine} with late "
        f"poses; worst answer after {1e3 * clockwork.worst_solve:.1f} ms"
    )
