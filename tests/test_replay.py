"""A recorded bag holds enough to fly the pilot, and to run the estimator, again."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from fiplib import bags, replay
from fiplib.estimators.poses.knowledge import Told
from fiplib.params import A_DOT, STATE_NAMES, X_DOT, A, X
from fiplib.recording import BagError, Flight
from fiplib.references import Hover
from fiplib.simulate import SCENARIOS, fly

DATA = Path(__file__).parent.parent / "data"
BAGS = sorted(path.parent.name for path in DATA.glob("*/metadata.yaml"))


@pytest.fixture(scope="module")
def estimated() -> Flight:
    return bags.read(DATA / "estimate-1.4")


@pytest.mark.parametrize("name", BAGS)
def test_replaying_a_bag_gives_the_recorded_commands_bit_for_bit(name):
    flight = bags.read(DATA / name)
    again = replay.commands(flight)
    np.testing.assert_array_equal(again.stamp, flight.command.stamp)
    np.testing.assert_array_equal(again.values, flight.command.values)


def test_other_parameters_give_other_commands(estimated):
    weaker = estimated.params.replace(control__input_weights=(5.0, 5.0))
    again = replay.commands(estimated, weaker)
    assert np.abs(again.values[:, :2]).mean() < 0.8 * np.abs(estimated.command.values[:, :2]).mean()


def test_a_refit_gives_the_recorded_lengths_bit_for_bit(estimated):
    recorded, found = estimated.length, replay.refit(estimated).length
    count = len(recorded.values)
    assert len(found.values) in (count, count + 1)  # the last run may still be under way at the end
    np.testing.assert_array_equal(found.stamp[:count], recorded.stamp)
    np.testing.assert_array_equal(found.values[:count], recorded.values)


def test_a_refit_takes_another_estimator_and_another_hand_over(estimated):
    changed = estimated.params.replace(
        estimation__estimator="poses", piloting__handover="trusted", estimation__run_period=2.0
    )
    used, found, deviation = replay.refit(estimated, changed).length.values.T
    assert used[0] == changed.piloting.rod_lengths[0], "the trusted hand-over starts from the shortest rod to expect"
    assert found[-1] == pytest.approx(1.0, abs=3 * deviation[-1]) and 0.9 < used[-1] < found[-1]
    # a stream forgets nothing: what was 6 mm after 2.5 s is half of that after 20 s
    assert deviation[-1] < 0.6 * deviation[2] < 0.01


def test_commands_recorded_at_another_rate_make_windows_of_the_same_sampling(estimated):
    params, half = (
        estimated.params,
        dataclasses.replace(
            estimated.command, stamp=estimated.command.stamp[::2], values=estimated.command.values[::2]
        ),
    )
    assert replay.at_recorded_rate(params, estimated.command) is params
    assert replay.at_recorded_rate(params, half).piloting.control_rate == pytest.approx(60.0, rel=1e-6)  # ns stamps
    window = replay.windows(dataclasses.replace(estimated, command=half))[0].window
    assert window.step == pytest.approx(0.1, rel=1e-6)


def test_a_bag_of_poses_alone_gives_the_states_the_controller_used(estimated):
    poses_alone = dataclasses.replace(estimated, state=None, command=None, reference=None, length=None, metadata={})
    derived = replay.states(poses_alone)
    assert derived.names == STATE_NAMES
    at = np.searchsorted(derived.stamp, estimated.state.stamp)
    np.testing.assert_array_equal(derived.values[at], estimated.state.values)


def test_derived_velocities_are_near_the_true_ones(estimated):
    at = np.searchsorted(estimated.truth_state.stamp, replay.states(estimated).stamp - 4_166_667)
    error = replay.states(estimated).values - estimated.truth_state.values[at, :10]
    # 0.2 mm of noise a body and 0.08 mm of the attitude's at the seat, differentiated at 240 Hz and filtered at 20 Hz:
    # 0.024 m/s; a and b join two bodies: 0.032
    assert error[:, X].std() == pytest.approx(0.2e-3, rel=0.1) and error[:, A].std() == pytest.approx(0.28e-3, rel=0.1)
    assert error[:, X_DOT].std() < 0.027 and error[:, A_DOT].std() < 0.036


def test_what_cannot_be_replayed_says_why(estimated):
    without_commands = dataclasses.replace(estimated, command=None)
    with pytest.raises(BagError, match=r"estimate-1.4.*holds no commands"):
        replay.windows(without_commands)
    nameless = dataclasses.replace(estimated, metadata={**estimated.metadata, "reference": {}})
    with pytest.raises(BagError, match=r"estimate-1.4.*name no reference"):
        replay.commands(nameless)
    for odd in ("Hover", {"kind": ["Hover"]}, {"kind": "Hover", "z": 1}, {"kind": "Circle", "radius": 1, "period": 0}):
        with pytest.raises(BagError, match=r"estimate-1.4.*no reference"):
            replay.reference(dataclasses.replace(estimated, metadata={**estimated.metadata, "reference": odd}))
    assert len(replay.commands(nameless, follow=Hover()).values) == len(estimated.command.values)


@pytest.mark.parametrize("name", [name for name in BAGS if name.startswith(("circle", "estimate"))])
def test_the_length_estimated_from_a_whole_flight_lies_within_its_interval(name):
    found = replay.estimate(bags.read(DATA / name))
    # that the rod is uniform and tracked at its middle is assumed within 2 mm
    assert found.reason is None and found.standard_deviation < 0.0025
    assert abs(found.length - 1.0) < 1.96 * found.standard_deviation


def test_two_halves_that_contradict_each_other_give_no_length(estimated):
    rod = dataclasses.replace(estimated.pendulum, position=estimated.pendulum.position.copy())
    half = len(rod.position) // 2
    rod.position[half:] += 0.05 * (rod.position[half:] - estimated.vehicle.position[half:])
    found = replay.estimate(dataclasses.replace(estimated, pendulum=rod))
    assert np.isnan(found.length) and np.isnan(found.standard_deviation)
    assert "contradict each other beyond chance" in found.reason


def test_bodies_that_are_exchanged_give_no_length_by_any_estimator(estimated):
    exchanged = dataclasses.replace(estimated, vehicle=estimated.pendulum, pendulum=estimated.vehicle)
    assert "the rod is below the vehicle" in replay.estimate(exchanged).reason
    with pytest.raises(BagError, match="the rod is below the vehicle"):
        replay.refit(exchanged)


def test_commands_do_not_change_the_estimate(estimated):
    found, without = replay.estimate(estimated), replay.estimate(dataclasses.replace(estimated, command=None))
    assert (found.length, found.standard_deviation) == (without.length, without.standard_deviation)
    assert any("seat" in sentence for sentence in found.assumed)


def test_a_flight_of_a_stranger_is_estimated_with_weaker_assumptions(estimated):
    stranger = dataclasses.replace(estimated, metadata={"origin": "unknown"})
    found, own = replay.estimate(stranger), replay.estimate(estimated)
    # where the rod is tracked is in no bag of a stranger: it may be off the middle, or not uniform
    assert found.standard_deviation > 1.5 * own.standard_deviation
    assert abs(found.length - 1.0) < 1.96 * found.standard_deviation
    assert replay.estimate(stranger, marker_offset=Told(0.0, 1e-3)).length == pytest.approx(own.length, abs=1e-3)


def test_raw_windows_of_a_stretch_hold_its_poses_alone(estimated):
    window = replay.raw_window_between(estimated, 6.0, 9.0)
    assert window.seconds == pytest.approx(3.0, abs=1 / 240)
    for body, recorded in zip(window, (estimated.vehicle, estimated.pendulum), strict=True):
        inside = (estimated.time(recorded) >= 6.0) & (estimated.time(recorded) <= 9.0)
        np.testing.assert_array_equal(body.stamp, recorded.stamp[inside])
        np.testing.assert_array_equal(body.position, recorded.position[inside])
    with pytest.raises(ValueError, match="needs poses of both bodies"):
        replay.raw_window_between(estimated, 600.0, 603.0)


def test_bodies_that_are_logged_apart_keep_their_own_stamps(estimated):
    rod = dataclasses.replace(
        estimated.pendulum,
        **{name: getattr(estimated.pendulum, name)[::2] for name in ("received", "position", "orientation")},
        stamp=estimated.pendulum.stamp[::2] + 70_000,
    )
    windows = replay.raw_windows(dataclasses.replace(estimated, pendulum=rod), 2.5, 2.5)
    assert len(windows) == 9  # of 10 without the 70 us, which the last one lacks at the end
    assert {len(window.rod.stamp) for _, window in windows} == {300}
    assert all(np.isin(window.rod.stamp, rod.stamp).all() for _, window in windows)


def test_a_flight_kept_in_memory_is_the_one_in_its_bag():
    kept, recorded = fly(SCENARIOS["length-jump"]), bags.read(DATA / "length-jump")
    assert kept.metadata == recorded.metadata and kept.events == recorded.events and kept.start_ns == recorded.start_ns
    for role in ("vehicle", "pendulum"):
        for field in ("stamp", "received", "position", "orientation"):
            np.testing.assert_array_equal(getattr(getattr(kept, role), field), getattr(getattr(recorded, role), field))
    for role in ("state", "command", "reference", "length", "truth_state", "truth_length"):
        one, other = getattr(kept, role), getattr(recorded, role)
        np.testing.assert_array_equal(one.stamp, other.stamp)
        np.testing.assert_array_equal(one.values, other.values)
        assert (one.names, one.units) == (other.names, other.units)


def test_what_derived_states_take_for_granted_is_said(estimated):
    stranger = dataclasses.replace(estimated, metadata={"origin": "unknown", "seed": 1}, state=None)
    assert replay.assumed_seat(estimated) is None
    assert replay.assumed_seat(stranger).startswith("states were derived with the seat 8 cm above the tracked point")
    slow = estimated.params.replace(estimation__run_period=10.0)
    assert replay.assumed_seat(stranger) in replay.refit(stranger, slow).notes
    assert replay.refit(estimated, slow).notes == estimated.notes
