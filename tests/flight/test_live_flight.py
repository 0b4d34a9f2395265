"""Flights in real time with their processes: what happens when one of them is killed. Simulated vehicle."""

import dataclasses
import os
import signal

import pytest

from fiplib.flight.failsafe import Guard
from fiplib.flight.links.simulated import SimLink
from fiplib.flight.loop import FlightLoop
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
    patient = {"safety__pose_flag": 60.0, "safety__pose_level": 61.0, "safety__pose_disarm": 62.0}
    scenario = SCENARIOS["push-hover"]
    scenario = dataclasses.replace(scenario, params=scenario.params.replace(**patient))
    tape, guard = MemoryRecorder(), Guard(scenario.params, scenario.reference)
    with SimLink(scenario) as link:
        flight = FlightLoop(scenario, link, guard, tape)
        until_in_the_air(flight, tape)
        os.kill(link.pids[process], signal.SIGKILL)
        outcome = flight.run()
        last = [row[2] for row in tape.values["truth_state"]]
    assert guard.ended == reason and not outcome.survived and len(last) > 1
    assert tape.events[-1][2].endswith(f"-> disarmed: {reason}")
    assert tape.values["command"][-1] == (0.0, 0.0, 0.0, 0.0)


def until_in_the_air(flight: FlightLoop, tape: MemoryRecorder) -> None:
    while len(tape.values.get("command", ())) <= 60:
        assert flight.guard.ended is None
        flight.step()


def test_the_motors_of_the_vehicle_stop_when_its_sender_is_killed():
    scenario = SCENARIOS["push-hover"]
    tape, guard = MemoryRecorder(), Guard(scenario.params, scenario.reference)
    with SimLink(scenario) as link:
        flight = FlightLoop(scenario, link, guard, tape)
        until_in_the_air(flight, tape)
        os.kill(link.pids["sender"], signal.SIGKILL)
        flight.run()
        # from 1.3 m it falls to the ground in half a second
        for _ in range(240 * 20):
            link.receive(0.1)
            if link.truth[10] < 0.1:
                break
        assert link.truth[10] < 0.1
