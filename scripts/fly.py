#!/usr/bin/env python3
"""Fly a scenario through the pilot and record a ROS 2 bag; ``--help`` lists what can be asked for."""

import sys

from fiplib import console
from fiplib.flight.command import main

if __name__ == "__main__":
    sys.exit(console.run(main))
