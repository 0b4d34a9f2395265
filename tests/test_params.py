"""The parameters: the paper's tables as printed, sources everywhere, changes checked."""

import dataclasses
import json
import math
import re

import pytest

from fiplib.flight.limits import Limits
from fiplib.params import AXES, INPUTS, STATES, Params
from fiplib.simulate import SCENARIOS, fly


def test_tables_1_and_2_are_as_printed():
    params = Params()
    vehicle, rod, control, estimation = params.vehicle, params.pendulum, params.control, params.estimation
    assert (vehicle.mass, rod.mass, rod.length, math.degrees(vehicle.max_body_rate)) == (0.569, 0.032, 1.0, 100.0)
    assert (control.nodes, control.horizon, estimation.window) == (60, 6.0, 55)
    assert (estimation.length_min, estimation.length_max) == (0.2, 2.0)
    assert (estimation.elite_fraction, estimation.mutation_rate) == (0.167, 0.1)


def test_every_parameter_has_a_unit_and_a_source():
    for group in dataclasses.fields(Params):
        for entry in dataclasses.fields(group.type):
            assert entry.metadata["unit"] and entry.metadata["source"], f"{group.name}.{entry.name}"


def test_a_point_mass_has_inertia_factor_one_and_a_uniform_rod_three_quarters():
    assert Params().replace(pendulum__gyration_ratio=0.0).pendulum.inertia_factor == 1.0
    assert Params().pendulum.inertia_factor == pytest.approx(0.75)


def test_the_two_axes_share_all_states_and_inputs_between_them():
    assert sorted(index for axis in AXES for index in axis.states) == list(range(len(STATES)))
    assert sorted(axis.input for axis in AXES) == list(range(len(INPUTS)))


def test_parameters_survive_the_way_through_json():
    params = Params().replace(pendulum__length=0.7, piloting__length_step=0.05, estimation__fitness="paper")
    for one in (params, Params()):
        assert Params.from_dict(json.loads(json.dumps(one.to_dict(), allow_nan=False))) == one


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pendulum__lenght": 1.0}, "unknown parameter 'pendulum__lenght'; parameters are .*pendulum__length"),
        ({"length": 1.0}, "unknown parameter 'length'"),
        ({"pendulum__length": "long"}, r"pendulum.length must be a number from 0.05 to 20 \(m\), not 'long'"),
        ({"pendulum__length": -1.0}, r"pendulum.length must be a number from 0.05 to 20 \(m\), not -1.0"),
        ({"pendulum__length": math.nan}, "pendulum.length must be a number"),
        (
            {"simulation__rate_delay": -0.01},
            r"simulation.rate_delay must be a number from 1e-06 to 3600 \(s\), or 0, not -0.01",
        ),
        ({"control__nodes": 60.5}, "control.nodes must be a whole number"),
        ({"control__input_weights": (1.0,)}, "control.input_weights must be 2 numbers"),
        ({"piloting__estimate": 1}, "piloting.estimate must be true or false"),
        ({"estimation__fitness": 3}, "estimation.fitness must be a word"),
        ({"piloting__initial_length": 100}, r"piloting.initial_length must be a number from 0.05 to 20 \(m\), not 100"),
        ({"control__nodes": 100_000}, "control.nodes must be a whole number from 2 to 500"),
        ({"estimation__length_min": 3.0}, "estimation.length_max must be above estimation.length_min, not 2 and 3"),
        ({"estimation__first_raw_window": 3.0}, "raw_window must be above estimation.first_raw_window, not 2.5 and 3"),
    ],
)
def test_a_change_that_makes_no_sense_is_refused_with_what_would(changes, message):
    with pytest.raises(ValueError, match=message):
        Params().replace(**changes)


def entries():
    """Every parameter of the paper's system and of a flight behind the failsafe, with a number as its value."""
    for groups in (Params(), Limits()):
        for group in dataclasses.fields(groups):
            for entry in dataclasses.fields(group.type):
                if not isinstance(entry.default, str | bool):
                    yield pytest.param(groups, f"{group.name}.{entry.name}", entry, id=f"{group.name}.{entry.name}")


@pytest.mark.parametrize(("groups", "name", "entry"), list(entries()))
def test_every_number_has_a_range_that_holds_its_default_and_is_named_when_it_is_left(groups, name, entry):
    low, high = entry.metadata["within"]
    several = entry.default if isinstance(entry.default, tuple) else (entry.default,)
    assert all(low <= number <= high or (number == 0 and entry.metadata["zero"]) for number in several)
    kind = int if isinstance(several[0], int) else float
    bad = [-1, kind(1), 10**30] if kind is int else [1e-300, -1e-300, 1e300, math.inf, -math.inf, math.nan]
    for number in bad:
        if low <= number <= high:
            continue
        value = type(entry.default)([number] * len(several)) if isinstance(entry.default, tuple) else number
        with pytest.raises(ValueError, match=f"^{name} must be .* from {re.escape(f'{low:g} to {high:g}')}"):
            groups.replace(**{name.replace(".", "__"): value})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"piloting__mocap_rate": 500.0},
            "plant_rate must be a whole multiple of piloting.mocap_rate, not 960 and 500",
        ),
        (
            {"simulation__plant_rate": 24.0},
            "plant_rate must be a whole multiple of piloting.mocap_rate, not 24 and 240",
        ),
        (
            {"piloting__control_rate": 100.0},
            "mocap_rate must be a whole multiple of piloting.control_rate, not 240 and 100 Hz",
        ),
        (
            {"piloting__control_rate": 500.0},
            "mocap_rate must be a whole multiple of piloting.control_rate, not 240 and 500 Hz",
        ),
        ({"simulation__thrust_lag": 1e-4}, r"thrust_lag must be at least 0.4 / simulation.plant_rate = 0.000417 s"),
        ({"simulation__initial_lean": 0.1}, r"initial_lean must be at most pendulum.length / 12 = 0.0833 m, not 0.1 m"),
    ],
)
def test_parameters_that_contradict_each_other_do_not_fly(changes, message):
    scenario = dataclasses.replace(SCENARIOS["push-hover"], params=Params().replace(**changes))
    with pytest.raises(ValueError, match=message):
        fly(scenario)


def test_zero_is_accepted_where_it_means_something():
    params = Params().replace(simulation__position_noise=0, pendulum__gyration_ratio=0, control__state_weights=[0] * 10)
    assert params.simulation.position_noise == 0.0 and params.control.state_weights == (0.0,) * 10
