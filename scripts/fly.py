#!/usr/bin/env python3
"""Fly a scenario through the pilot and record a ROS 2 bag.

    python scripts/fly.py --list
    python scripts/fly.py --scenario circle-0.8 --output my-flight
    python scripts/fly.py --scenario push-hover --set pendulum.length=0.8 --seed 7 --output short-rod
    python scripts/fly.py --scenario estimate-1.4 --real-time --output live

The vehicle is simulated unless --link says otherwise, and the bag says which. Nothing here has flown on a vehicle.
In real time, Ctrl-C lands (levels and descends; the rod is given up); a second one stops the motors.
"""

import argparse
import sys
from pathlib import Path

from fiplib.__main__ import guarded
from fiplib.flight import command
from fiplib.flight.failsafe import Guard
from fiplib.pilot import Pilot


def fly(options: argparse.Namespace) -> int:
    """Fly as the options ask; returns the exit status."""
    if options.list:
        return command.list_scenarios()

    # The scenario: trajectory, pushes, parameters, seed. The limits: when the failsafe takes over.
    scenario, limits = command.chosen(options)
    output = Path(options.output or scenario.name)

    # The simulator alone: plant, motion capture and pilot, as fast as possible; so the bags in data/ are made.
    if not command.behind_failsafe(options, limits):
        return command.fly_simulated(scenario, output, options.force)

    # The pilot (poses to states, MPC, the length in use), and around it the guard: it judges every frame and answer.
    guard = Guard(Pilot(scenario.params, scenario.reference), limits)

    # The link, by which poses come in and commands go out: the simulated vehicle, ROS 2, or a radio. The recorder, and
    # what else runs beside the flight: the estimator of the length, the operator's keys, a display.
    session = command.session_of(options, scenario, limits, output)

    # Run: frames from the link to the guard, setpoints back, everything to the recorder.
    return command.fly(session, guard)


def main() -> int:
    description, _, rest = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        description=description, epilog=rest, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    command.add_arguments(parser)
    return fly(parser.parse_args())


if __name__ == "__main__":
    sys.exit(guarded(main))
