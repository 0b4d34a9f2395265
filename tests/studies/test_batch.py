"""Flights in compiled calls are the flights of ``simulate.fly``, to the bit."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from fiplib.params import Params
from fiplib.references import Circle, Hover
from fiplib.simulate import SCENARIOS, Push, Scenario, fly
from fiplib.studies import batch

SHORT = Params().replace(piloting__estimate=True, estimation__window=20, estimation__generations=3)
TRUSTED = SHORT.replace(piloting__handover="trusted", estimation__estimator="poses", pendulum__gyration_ratio=1 / 12)
KALMAN = Params().replace(piloting__observer="kalman")
DISTURBED = Params().replace(
    simulation__wind=(0.5, -0.3),
    simulation__gusts=0.3,
    simulation__rotor_loss=0.2,
    simulation__rotor_loss_start=1.0,
    simulation__battery_sag=0.005,
)
CIRCLE = Circle(radius=0.4, period=8.0, start=0.0, ramp=2.0)

FLIGHTS = {
    "pushes": Scenario("", "", 3.0, Hover(), pushes=(Push(0.5, (0.012, 0.0)), Push(1.2, (0.0, 0.007), 0.02))),
    "told": Scenario("", "", 3.0, CIRCLE, told_lengths=((0.0, 0.9), (0.0, 1.1), (1.5, 0.8)), seed=7),
    "estimated": Scenario("", "", 4.0, CIRCLE, params=SHORT, told_lengths=((3.0, 1.0),)),
    "estimated without latency": Scenario(
        "", "", 4.0, CIRCLE, params=SHORT.replace(simulation__estimation_latency=0.0)
    ),
    "runs slower than their period": Scenario(
        "", "", 4.0, CIRCLE, params=SHORT.replace(simulation__estimation_latency=0.77, estimation__run_period=0.3)
    ),
    "raw estimates": Scenario("", "", 2.0, CIRCLE, params=TRUSTED),
    "the rod falls": Scenario("", "", 3.0, Hover(), pushes=(Push(0.5, (0.1, 0.0)), Push(2.5, (0.1, 0.0)))),
    "the rod's direction": Scenario(
        "", "", 2.0, CIRCLE, params=Params().replace(piloting__pendulum_measurement="direction")
    ),
    "Kalman observer": Scenario(
        "", "", 4.0, CIRCLE, params=KALMAN, pushes=(Push(0.5, (0.012, 0.0)),), told_lengths=((1.5, 0.8),)
    ),
    "Kalman observer of the rod's direction": Scenario(
        "", "", 2.0, CIRCLE, params=KALMAN.replace(piloting__pendulum_measurement="direction")
    ),
    "wind, gusts, a hindered rotor, a battery that sags": Scenario(
        "", "", 2.0, CIRCLE, params=DISTURBED, pushes=(Push(0.5, (0.012, 0.0)),), told_lengths=((1.1, 0.8),)
    ),
    "a battery is empty, and the vehicle sinks to the ground upright": Scenario(
        "", "", 2.5, Hover(), params=Params().replace(simulation__battery_sag=1.0)
    ),
    "other rates": Scenario(
        "", "", 2.0, CIRCLE, params=Params().replace(piloting__control_rate=80.0, simulation__mocap_latency=0.0)
    ),
    "a recorded scenario": dataclasses.replace(SCENARIOS["length-jump"], duration=8.0),
}


@pytest.mark.parametrize("name", FLIGHTS)
def test_a_compiled_flight_is_the_flight_frame_by_frame_to_the_bit(name):
    assert_same(next(batch.fly_many([FLIGHTS[name]])), fly(FLIGHTS[name]))


def assert_same(flight: Any, expected: Any) -> None:
    """Equal in every field, arrays to the bit."""
    if isinstance(expected, np.ndarray):
        assert flight.dtype == expected.dtype
        np.testing.assert_array_equal(flight, expected)
    elif dataclasses.is_dataclass(expected):
        assert type(flight) is type(expected)
        for field in dataclasses.fields(expected):
            assert_same(getattr(flight, field.name), getattr(expected, field.name))
    else:
        assert flight == expected


def test_the_flights_above_are_of_every_kind():
    flights = dict(zip(FLIGHTS, batch.fly_many(FLIGHTS.values()), strict=True))
    kinds = {name: {event.kind for event in flight.events} for name, flight in flights.items()}
    assert not flights["the rod falls"].survived
    assert not flights["a battery is empty, and the vehicle sinks to the ground upright"].survived
    assert {"push", "status"} <= kinds["pushes"] and "length" in kinds["told"] and "fall" in kinds["the rod falls"]
    for name in ("estimated", "estimated without latency", "raw estimates", "runs slower than their period"):
        assert len(flights[name].length.values) > 2, name
