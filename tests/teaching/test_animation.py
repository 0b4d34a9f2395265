"""The animation shows what was recorded, in a page that needs nothing from outside."""

import base64
import dataclasses
import io
import json
import re

import numpy as np
import pytest
from matplotlib import rc_context
from PIL import Image
from scipy.spatial.transform import Rotation

from fiplib.params import Vehicle
from fiplib.references import Circle
from fiplib.simulate import Scenario, fly
from fiplib.teaching.animation import animation, player, vehicle_lines

# some tests look at an animation without rendering it
pytestmark = pytest.mark.filterwarnings("ignore:Animation was deleted without rendering")


@pytest.fixture(scope="module")
def flight():
    return fly(Scenario("two-seconds", "short", 2.0, Circle(radius=0.4, period=8.0)))


def pictures(page: str) -> list[Image.Image]:
    frames = json.loads(re.search(r"const frames = (\[.*?\])", page)[1])
    return [Image.open(io.BytesIO(base64.b64decode(frame))) for frame in frames]


def lines(figure) -> dict:
    """The labelled lines of the scene at this moment, each (3, n) m."""
    return {line.get_label(): np.array(line.get_data_3d()) for line in figure.axes[0].lines}


def test_at_each_time_the_rod_stands_on_the_vehicle_and_points_to_its_centre_of_mass(flight):
    made = animation(flight, frames_per_second=2)
    for time in (0.0, 1.0, 1.5):
        made._func(time)
        index = np.searchsorted(flight.time(flight.vehicle), time)
        up = Rotation.from_quat(flight.vehicle.orientation[index]).as_matrix()[:, 2]
        seat = flight.vehicle.position[index] + flight.params.piloting.seat_height * up
        com = flight.pendulum.position[index]
        drawn = lines(made._fig)
        np.testing.assert_allclose(drawn["rod"][:, 0], seat, atol=1e-8)  # quaternions in single precision
        np.testing.assert_array_equal(drawn["centre of mass"][:, 0], com)
        np.testing.assert_allclose(drawn["rod"].mean(axis=1), com, rtol=1e-12)  # the middle of two points: rounding


def test_beside_it_the_lean_of_the_rod_is_five_times_as_large(flight):
    made = animation(flight, frames_per_second=2)
    made._func(1.0)
    true = lines(made._fig)["rod"]
    drawn = next(np.array(line.get_data_3d()) for line in made._fig.axes[1].lines if line.get_linewidth() == 2.2)
    length = flight.params.pendulum.length
    lean = (true[:, 1] - true[:, 0]) / np.linalg.norm(true[:, 1] - true[:, 0])
    np.testing.assert_allclose((drawn[:, 1] - drawn[:, 0])[:2], 5.0 * length * lean[:2], atol=1e-9)
    assert np.hypot(*lean[:2]) > 1e-3


def test_what_is_past_is_coloured_and_what_comes_is_faint(flight):
    made = animation(flight, frames_per_second=2)
    made._func(1.0)
    offsets = made._fig.axes[2]
    coloured = next(line for line in offsets.lines if line.get_label() == "$a$")
    whole = max(offsets.lines, key=lambda line: len(line.get_xdata()))
    assert coloured.get_xdata()[-1] == pytest.approx(1.0, abs=0.01)
    assert whole.get_xdata()[-1] > 1.9 and whole.get_alpha() == 0.25


def test_the_player_holds_every_picture_and_asks_the_network_for_nothing(flight):
    page = player(flight, 2, dots_per_inch=40)
    shown = pictures(page)
    assert len(shown) == 4, "2 pictures a second over 2 s, less the one after the last frame of motion capture"
    assert {picture.size for picture in shown} == {(320, 128)}, "8 x 3.2 inches at 40 dots per inch"
    assert not re.search(r"https?:|//[a-z]|<link", re.sub(r"const frames = \[.*?\]", "", page))
    assert not np.array_equal(*(np.asarray(picture.convert("RGB")) for picture in shown[:2])), "time passes"


def test_the_same_flight_gives_the_same_page_whatever_the_style_of_the_notebook(flight):
    page = player(flight, 1, dots_per_inch=40)
    with rc_context({"figure.constrained_layout.use": True, "savefig.dpi": 300, "font.size": 14}):
        assert player(flight, 1, dots_per_inch=40) == page


def test_every_picture_says_that_the_flight_is_simulated(flight):
    figure = animation(flight)._fig
    assert figure.get_suptitle() == "simulated, two-seconds"


def test_a_flight_with_motion_capture_alone_is_shown_with_its_height(flight):
    bare = dataclasses.replace(flight, state=None, command=None, reference=None, length=None, truth_length=None)
    made = animation(bare, frames_per_second=1)
    assert made._fig.axes[3].get_ylabel() == "$z$ (m)"
    assert len(pictures(player(bare, 1, dots_per_inch=40))) == 2


@pytest.mark.parametrize("frames_per_second", [0, -1, float("nan"), float("inf")])
def test_a_rate_that_is_no_rate_is_refused_by_name(flight, frames_per_second):
    with pytest.raises(ValueError, match="frames_per_second"):
        animation(flight, frames_per_second)


def test_the_drawn_vehicle_has_its_wheelbase_and_turns_with_its_attitude():
    vehicle, turn = Vehicle(), Rotation.from_euler("XYZ", [0.3, -0.2, 1.0])
    arms = vehicle_lines(np.ones(3), turn.as_quat(), vehicle, scale=2.0)[:2]
    for arm in arms:
        np.testing.assert_allclose(arm.mean(axis=0), 1.0)  # the vehicle's centre
        assert np.linalg.norm(arm[1] - arm[0]) == pytest.approx(2.0 * vehicle.wheelbase)
        np.testing.assert_allclose((arm - 1.0) @ turn.as_matrix()[:, 2], 0.0, atol=1e-12)  # in the body's plane
