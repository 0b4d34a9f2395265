"""The trajectories: what a bag keeps of them, that they begin at rest, and one that ends once the length is known."""

import math
from dataclasses import asdict, replace

import numpy as np
import pytest

from fiplib import replay
from fiplib.params import X_DOT, Y_DOT, A, Params, X, Y
from fiplib.pilot import Pilot
from fiplib.references import REFERENCES, Circle, Hover, Multisine, Reference
from fiplib.simulate import Scenario, fly
from fiplib.studies.batch import fly_many

SINES = Multisine(0.25, (0.1, 0.05, -0.02, 0.03), (0.0, 0.2, 0.01, 0.0), ramp=0.8, wanted=0.02, fade=1.2)
ESTIMATING = Params().replace(
    piloting__estimate=True, piloting__handover="trusted", estimation__estimator="poses", estimation__raw_window=0.8
)


@pytest.mark.parametrize("reference", [Hover(0.1, -0.2), Circle(0.4, 8.0), SINES])
def test_a_bag_can_name_every_trajectory(reference):
    entry = {**asdict(reference)}
    # as JSON gives them back
    entry = {key: list(value) if isinstance(value, tuple) else value for key, value in entry.items()}
    assert REFERENCES[type(reference).__name__](**entry) == reference
    assert set(REFERENCES) == {"Hover", "Circle", "Multisine"}


@pytest.mark.parametrize("reference", [Hover(0.1, -0.2), Circle(0.4, 8.0, start=0.2), SINES, replace(SINES, known=1.7)])
def test_a_trajectory_begins_at_rest_and_its_velocities_are_those_of_its_positions(reference):
    times = np.arange(0.0, 6.0, 1e-3)
    states = reference.at(times)
    assert states.shape == (len(times), 10) and not states[0, [X_DOT, Y_DOT]].any() and not states[:, A:].any()
    for place, velocity in ((X, X_DOT), (Y, Y_DOT)):
        # central differences over 2 ms: their error is the third derivative, some 30 m/s^3, times 1e-6 / 6
        slope = (states[2:, place] - states[:-2, place]) / 2e-3
        assert np.abs(slope - states[1:-1, velocity]).max() < 2e-5


def test_a_multisine_is_the_sum_of_its_harmonics_once_it_has_come():
    times = np.linspace(0.8, 5.0, 50)
    angle = 2 * math.pi * 0.25 * times
    x = 0.1 * np.cos(angle) + 0.05 * np.sin(angle) - 0.02 * np.cos(2 * angle) + 0.03 * np.sin(2 * angle)
    assert SINES.at(times)[:, X] == pytest.approx(x, abs=1e-12)
    assert SINES.at(np.zeros(1))[0, [X, Y]] == pytest.approx([0.0, 0.0])


def test_it_fades_to_hover_once_the_length_is_known_well_enough_and_only_once():
    assert SINES.informed(1.0, 0.021) is SINES and SINES.informed(1.0, math.nan) is SINES
    known = SINES.informed(1.5, 0.019)
    assert known.known == 1.5 and known.informed(2.0, 0.001) is known
    before, after = np.linspace(0.0, 1.5, 40), np.linspace(1.5 + 1.2, 9.0, 40)
    assert np.array_equal(known.at(before), SINES.at(before)) and not known.at(after).any()
    endless = replace(SINES, wanted=0.0)
    assert endless.informed(1.0, 1e-9) is endless
    for other in (Hover(), Circle(0.4, 8.0)):
        assert other.informed(1.0, 1e-9) is other


@pytest.mark.parametrize(("x", "y"), [((0.1, 0.2), (0.1,)), ((0.1,), (0.1,)), ((0.1, 0.0, 0.0), (0.1, 0.0, 0.0))])
def test_amplitudes_come_in_pairs(x, y):
    with pytest.raises(ValueError, match="as many pairs"):
        Multisine(0.2, x, y)


def test_the_pilot_takes_only_what_is_a_trajectory():
    class Still:
        height = 1.0

        def at(self, times):
            return np.zeros((len(times), 10))

    class Standing(Still, Reference):
        pass

    assert Pilot(Params(), Standing()).reference.informed(1.0, 0.01).height == 1.0
    with pytest.raises(ValueError, match="no reference to follow: Still"):
        Pilot(Params(), Still())


def test_a_flight_that_ends_its_excitation_is_the_same_compiled_and_replayed():
    scenario = Scenario("until-known", "", 3.0, SINES, params=ESTIMATING, seed=3)
    flight, [compiled] = fly(scenario), fly_many([scenario])
    known = flight.time(flight.length)[flight.length.values[:, 2] <= SINES.wanted][0]
    assert 0.4 < known < 1.6, "it must fade within the flight"
    for role in ("command", "state", "reference", "length"):
        one, other = getattr(flight, role), getattr(compiled, role)
        assert np.array_equal(one.stamp, other.stamp) and np.array_equal(one.values, other.values, equal_nan=True)
    # the bag names the trajectory as it was at the start; the recorded estimates say when it fades
    assert replay.reference(flight) == SINES
    assert np.array_equal(replay.commands(flight).values, flight.command.values)
    # it followed the endless trajectory up to then, and hovers after the fade
    time, endless = flight.time(flight.reference), replace(SINES, wanted=0.0)
    follows = (flight.reference.values == endless.at((flight.reference.stamp - flight.reference.stamp[0]) / 1e9)).all(
        axis=1
    )
    assert follows[time < known].all() and not follows[time > known + 0.1].any()
    assert not flight.reference.values[time > known + SINES.fade + 0.05].any()
