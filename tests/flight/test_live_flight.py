"""Flights in real time with their processes: what happens when one of them is killed. Simulated vehicle."""

import os
import signal

import numpy as np
import pytest

from fiplib.flight.failsafe import Guard
from fiplib.flight.limits import Limits
from fiplib.flight.links.simulated import SimulatedLink
from fiplib.flight.loop import FlightLoop
from fiplib.pilot import Pilot
from fiplib.recording import MemoryRecorder
from fiplib.simulate import SCENARIOS

pytestmark = pytest.mark.realtime


@pytest.mark.parametrize(
    ("process", "reason"),
    [
        ("sender", "the command sender died (exit code -9): disarmed without it"),
        ("vehicle", "the simulated vehicle's process died (exit code -9)"),
    ],
)
def test_a_flight_whose_process_is_killed_ends_disarmed_with_the_reason(process, reason):
    # patient with poses: a machine that stalls for seconds must not be what ends this flight
    limits = Limits().replace(safety__pose_flag=60.0, safety__pose_level=61.0, safety__pose_disarm=62.0)
    scenario = SCENARIOS["push-hover"]
    tape, guard = MemoryRecorder(), Guard(Pilot(scenario.params, scenario.reference), limits)
    with SimulatedLink(scenario, limits) as link:
        loop = FlightLoop(scenario, link, guard, tape)
        until_in_the_air(loop)
        os.kill(link.pids[process], signal.SIGKILL)
        loop.run()
    flight = tape.flight("killed", scenario.metadata())
    assert guard.ended == reason and not loop.balanced and len(flight.truth_state.values) > 1
    assert flight.events[-1].text.endswith(f"-> disarmed: {reason}")
    np.testing.assert_array_equal(flight.command.values[-1], np.zeros(4))


def until_in_the_air(loop: FlightLoop) -> None:
    while loop.clockwork.ticks <= 60:
        assert loop.guard.ended is None
        loop.step()


def test_the_motors_of_the_vehicle_stop_when_its_sender_is_killed():
    scenario = SCENARIOS["push-hover"]
    with SimulatedLink(scenario, Limits()) as link:
        guard = Guard(Pilot(scenario.params, scenario.reference))
        loop = FlightLoop(scenario, link, guard, MemoryRecorder())
        until_in_the_air(loop)
        os.kill(link.pids["sender"], signal.SIGKILL)
        loop.run()
        # from 1.3 m it falls to the ground in half a second
        for _ in range(240 * 20):
            link.receive(0.1)
            if link.truth[10] - scenario.params.seat_above_tracked < 0.1:
                break
        assert link.truth[10] - scenario.params.seat_above_tracked < 0.1
