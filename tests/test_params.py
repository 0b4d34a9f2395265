"""The parameters: the paper's tables as printed, sources everywhere, changes checked."""

import dataclasses
import json
import math

import pytest

from fiplib.params import AXES, INPUTS, STATES, Params


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
        ({"pendulum__length": "long"}, r"pendulum.length must be a number > 0 \(m\), not 'long'"),
        ({"pendulum__length": -1.0}, r"pendulum.length must be a number > 0 \(m\), not -1.0"),
        ({"pendulum__length": math.nan}, "pendulum.length must be a number"),
        ({"simulation__rate_delay": -0.01}, r"simulation.rate_delay must be a number >= 0 \(s\)"),
        ({"control__nodes": 60.5}, "control.nodes must be a whole number"),
        ({"control__input_weights": (1.0,)}, "control.input_weights must be 2 numbers"),
        ({"piloting__estimate": 1}, "piloting.estimate must be true or false"),
        ({"estimation__fitness": 3}, "estimation.fitness must be a word"),
    ],
)
def test_a_change_that_makes_no_sense_is_refused_with_what_would(changes, message):
    with pytest.raises(ValueError, match=message):
        Params().replace(**changes)


def test_zero_is_accepted_where_it_means_something():
    params = Params().replace(simulation__position_noise=0, pendulum__gyration_ratio=0, control__state_weights=[0] * 10)
    assert params.simulation.position_noise == 0.0 and params.control.state_weights == (0.0,) * 10
