"""The checks of a flight: none speaks against a plausible one, and what they state mends what they find."""

import dataclasses
import json

import numpy as np
import pytest

from fiplib.__main__ import main
from fiplib.bags import read
from fiplib.bags.checks import findings, passed
from fiplib.bags.conventions import QUATERNIONS, UPWARDS, body_z, restated
from fiplib.bags.explanations import EXPLANATIONS
from fiplib.bags.motion import arm, followed, leaning, thrust
from fiplib.bags.tracking import lost, tracked
from fiplib.params import Params
from fiplib.recording import BagError, Flight
from fiplib.references import Circle, Hover
from fiplib.simulate import Push, Scenario, fly
from tests.bags import strangers


@pytest.fixture(scope="module")
def flight() -> Flight:
    return read(strangers.FLIGHT)


@pytest.mark.parametrize(
    ("length", "noise", "told", "reference", "pushes", "falls"),
    [
        (0.3, 1.0, 0.3, Circle(0.4, 8.0), (), False),
        (0.5, 3.0, 0.5, Hover(), (Push(2.0, (0.02, 0.01)),), True),
        (1.0, 0.0, 1.6, Hover(), (), False),
        (2.0, 3.0, 2.0, Circle(0.4, 8.0), (Push(2.0, (0.02, 0.01)),), False),
    ],
)
def test_nothing_speaks_against_a_flight_of_any_rod(length, noise, told, reference, pushes, falls):
    """Short and long rods, without noise and with thrice of it, wrong lengths, pushes, and a fall."""
    params = Params()
    params = params.replace(
        pendulum__length=length,
        piloting__initial_length=told,
        simulation__position_noise=noise * params.simulation.position_noise,
    )
    flown = fly(Scenario("any", "any", 6.0, reference, pushes, ((0.0, told),), params, seed=3))
    assert flown.survived != falls
    assert findings(flown) == []
    assert passed(flown, []) == list(EXPLANATIONS)
    without = dataclasses.replace(flown, command=None)
    assert passed(without, []) == [name for name in EXPLANATIONS if name != "commands"]


def test_tilt_and_acceleration_axis_and_arm_agree(flight):
    """The rod's reaction on the vehicle is 1 %. The line between the tracked points follows the vehicle's axis from the
    lower one to the seat, 8 cm of the 58 cm, and only then the rod's."""
    for found, off in ((thrust(flight.vehicle), 0.02), (leaning(flight.vehicle, flight.pendulum), 0.08 / 0.58)):
        np.testing.assert_allclose(found.matrix, np.eye(2), atol=off)
        assert found.proven and found.deviation < 0.02
    assert leaning(flight.vehicle, flight.pendulum).late[0] == pytest.approx(0.0, abs=3e-4)
    late, ratio, correlation = followed(flight.vehicle, flight.command)
    assert 0.0 < late < 0.1 and correlation > 0.5 and 0.5 < ratio < 5.0


@pytest.mark.parametrize("up", UPWARDS)
def test_a_frame_is_turned_so_that_the_named_axis_is_up(flight, up):
    """Against what the axis of the letter becomes, and the arm, whose length no rotation changes."""
    turned = restated(flight, up=up)
    axis, sign = "xyz".index(up[-1]), -1.0 if up.startswith("-") else 1.0
    np.testing.assert_allclose(turned.vehicle.position[:, 2], sign * flight.vehicle.position[:, axis], atol=1e-12)
    reach, before = arm(turned.vehicle, turned.pendulum), arm(flight.vehicle, flight.pendulum)
    np.testing.assert_allclose(np.linalg.norm(reach, axis=1), np.linalg.norm(before, axis=1), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(turned.vehicle.orientation, axis=1), 1.0, atol=1e-6)
    assert up == "z" or f"{up} points up, as stated: the frame is turned" in turned.notes


@pytest.mark.parametrize("order", QUATERNIONS)
def test_an_order_of_quaternions_is_read_as_stated(flight, order):
    """What was put into that order comes out as it was."""
    places, signs = QUATERNIONS[order]
    given = np.empty_like(flight.vehicle.orientation)
    given[:, list(places)] = flight.vehicle.orientation * np.array(signs)
    other = dataclasses.replace(flight, vehicle=dataclasses.replace(flight.vehicle, orientation=given))
    read_again = restated(other, quaternion={"vehicle": order})
    np.testing.assert_array_equal(read_again.vehicle.orientation, flight.vehicle.orientation)
    assert np.median(body_z(read_again.vehicle)[:, 2]) > 0.9


def test_what_is_stated_must_exist(flight):
    for wrong in (
        {"up": "w"},
        {"unit": "mile"},
        {"quaternion": "zyx"},
        {"quaternion": {"rod": "wxyz"}},
        {"stamps": "a"},
    ):
        with pytest.raises(BagError, match="no such"):
            restated(flight, **wrong)


def test_a_flight_that_is_tracked_all_along_stays_the_same_object(flight):
    assert tracked(flight) is flight
    assert not any(part.any() for out in lost(flight) for part in out)


@pytest.mark.parametrize("count", [0, 1, 2, 3, 70])
def test_a_few_poses_are_no_error(flight, count):
    """A stretch of a longer flight may hold none of one body."""
    few = dataclasses.replace(flight, pendulum=dataclasses.replace(
        flight.pendulum,
        **{name: getattr(flight.pendulum, name)[:count] for name in ("stamp", "received", "position", "orientation")},
    ))  # fmt: skip
    assert not any(one.refuses and one.cure for one in findings(few))
    assert len(tracked(few).pendulum.stamp) == count


def test_a_gap_of_one_body_leaves_the_longest_stretch(flight):
    rod = flight.pendulum
    keep = (flight.time(rod) < 5.0) | (flight.time(rod) > 7.0)
    cut = dataclasses.replace(flight, pendulum=dataclasses.replace(
        rod, **{name: getattr(rod, name)[keep] for name in ("stamp", "received", "position", "orientation")}
    ))  # fmt: skip
    left = tracked(cut)
    assert cut.time(left.vehicle)[0] == pytest.approx(7.0, abs=0.01)
    assert cut.time(left.pendulum)[-1] == cut.time(rod)[-1]
    (found,) = findings(cut)
    assert "the longest stretch without such a gap, from 7.0 to 25.0 s, is used alone" in found.sentence


def test_what_follows_a_refusal_without_a_cure_has_not_passed(flight):
    mirrored = dataclasses.replace(
        flight,
        **{
            name: dataclasses.replace(body, position=body.position * [1.0, -1.0, 1.0])
            for name, body in (("vehicle", flight.vehicle), ("pendulum", flight.pendulum))
        },
    )
    against = findings(mirrored)
    assert [one.name for one in against] == ["attitude"] and against[0].refuses and not against[0].cure
    assert "unit" not in passed(mirrored, against) and "up axis" in passed(mirrored, against)


def test_json_holds_findings_cures_and_what_passed(tmp_path, capsys):
    flight = strangers.recorded(5.0, 9.0).both(lambda body: body.scaled(1000))
    path = strangers.write(tmp_path / "bag", strangers.rows(flight))
    assert main(["bag", "length", str(path), "--json"]) == 3
    answer = json.loads(capsys.readouterr().out)
    (finding,) = answer["checks"]["findings"]
    assert (finding["name"], finding["cure"], finding["refuses"]) == ("unit", {"unit": "mm"}, True)
    assert answer["refused"] == finding["sentence"] and answer["length"] is None
    assert "up axis" in answer["checks"]["passed"] and "unit" not in answer["checks"]["passed"]
