"""The page that explores a bag, without a browser: what its sliders and buttons do, and what it says of bad bags."""

import csv
import math
import re
import shutil
from dataclasses import replace
from pathlib import Path

import ipywidgets as widgets
import matplotlib as mpl
import numpy as np
import pytest
from rosbags.rosbag2 import Reader, StoragePlugin, Writer

from fiplib import bags, ga, recording, replay
from fiplib.bags.messages import typestore
from fiplib.estimators import ESTIMATORS
from fiplib.estimators.grid import grid
from fiplib.recording import TOPICS
from fiplib.teaching.explorer import CONVENTIONS, Explorer, compare, fit_window
from fiplib.teaching.explorer_plots import Picture

DATA = Path(__file__).parents[2] / "data"
POSES = {TOPICS["vehicle"]: TOPICS["vehicle"], TOPICS["pendulum"]: TOPICS["pendulum"]}


def renamed(source: Path, target: Path, names: dict[str, str]) -> Path:
    """A copy of the topics ``names`` of a bag, under other names: as another laboratory would have recorded it."""
    with Reader(source) as reader, Writer(target, version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        wanted = [old for old in reader.connections if old.topic in names]
        new = {old.id: writer.add_connection(names[old.topic], old.msgtype, typestore=typestore()) for old in wanted}
        for old, stamp, data in reader.messages(wanted):
            writer.write(new[old.id], stamp, data)
    return target


def number(page: Explorer) -> float:
    """The length that the page shows, m."""
    return float(re.search(r"l = <b>([\d.]+)", page.answer.value)[1])


@pytest.fixture(scope="module")
def flight() -> recording.Flight:
    return bags.read(DATA / "estimate-1.4")


@pytest.fixture
def page(tmp_path: Path) -> Explorer:
    return Explorer(DATA, tmp_path / "explored")


def test_a_moved_slider_and_the_button_change_the_number(page: Explorer) -> None:
    page.press.click()
    first = number(page)
    assert first == page.refits[0].found.length
    page.span.value = (3.0, 7.0)
    assert "settings have changed" in page.answer.value
    page.press.click()
    assert number(page) == page.refits[1].found.length != first
    assert len(page.refits[1].window.states) in (40, 41)  # 4 s in steps of 0.1 s, wherever the first tick falls


@pytest.mark.parametrize(
    ("setting", "value"),
    [("period", 0.05), ("reading", "paper"), ("process", 10.0), ("measurement", 10.0)],
)
def test_every_setting_reaches_the_estimate(page: Explorer, setting: str, value: object) -> None:
    page.press.click()
    getattr(page, setting).value = value
    page.press.click()
    assert page.refits[1].found.length != page.refits[0].found.length


def test_a_reading_that_is_no_likelihood_shows_no_interval(page: Explorer) -> None:
    page.press.click()
    assert "(2σ)" in page.answer.value
    page.reading.value = "paper"
    page.press.click()
    assert "(2σ)" not in page.answer.value
    assert "gives no interval" in page.answer.value


def test_a_bad_bag_is_text_in_the_page_and_the_flight_before_stays(page: Explorer, tmp_path: Path) -> None:
    half = shutil.copytree(DATA / "circle-0.8", tmp_path / "half")
    file = next(half.glob("*.mcap"))
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    (tmp_path / "notes.txt").write_text("<b>no bag</b>")
    for path, words in (
        (half, "damaged or incomplete"),
        (tmp_path / "nowhere", "no such file"),
        (tmp_path / "notes.txt", "not a bag"),
    ):
        page.path.value = str(path)
        page.load.click()
        assert words in page.message.value
        assert path.name in page.message.value
        assert "still shows estimate-1.4" in page.message.value
    page.press.click()
    assert page.refits, "the flight before can still be refitted"


def test_a_path_loads_its_bag_even_if_the_press_of_the_button_arrives_before_it(page: Explorer, tmp_path: Path) -> None:
    page.load.click()
    assert page.flight.path.name == "estimate-1.4"
    page.path.value = str(renamed(DATA / "estimate-1.2", tmp_path / "elsewhere", POSES))
    assert page.flight.path.name == "elsewhere" and page.bag.value == ""
    page.load.click()
    page.topics["vehicle"].value = "/other"
    assert "no topic /other" in page.message.value
    page.bag.value = "circle-0.8"
    assert page.flight.path.name == "circle-0.8" and not page.path.value


def test_bags_of_other_laboratories_are_read_by_convention_and_names(page: Explorer, tmp_path: Path) -> None:
    for convention, pattern in list(CONVENTIONS.items())[1:]:
        names = dict(zip(POSES, (pattern.format("drone_3"), pattern.format("stick")), strict=True))
        page.path.value = str(renamed(DATA / "estimate-1.2", tmp_path / convention, names))
        page.convention.value, page.vehicle_name.value, page.pendulum_name.value = "fip", "quad", "pendulum"
        page.load.click()
        assert page.flight.path.name == convention and page.flight.notes, "guessed from the names, and said"
        page.convention.value, page.vehicle_name.value, page.pendulum_name.value = convention, "drone_3", "stick"
        page.load.click()
        assert page.flight.path.name == convention and not page.flight.notes
        np.testing.assert_array_equal(page.flight.vehicle.position, bags.read(DATA / "estimate-1.2").vehicle.position)


def test_a_bag_without_commands_can_be_seen_and_says_why_it_cannot_be_refitted(page: Explorer, tmp_path: Path) -> None:
    page.path.value = str(renamed(DATA / "estimate-1.2", tmp_path / "poses", POSES))
    page.load.click()
    assert page.flight.command is None
    assert page.press.disabled
    assert page.rival.disabled
    for text in (page.message.value, page.answer.value):
        assert "holds no commands" in text
    before = page.over_time.widget.value
    page.span.value = (0.0, 2.0)
    assert page.over_time.widget.value != before, "its pictures follow the slider all the same"
    page.press_refit()  # by code, past the button
    assert "holds no commands" in page.answer.value


def test_without_a_path_and_without_a_choice_the_page_asks_for_one(tmp_path: Path) -> None:
    page = Explorer(tmp_path, tmp_path / "explored")  # a folder without bags
    assert "Choose a bag" in page.message.value
    for button in (page.press, page.rival, page.export):
        button.click()
    assert not page.rows
    page.path.value = str(DATA / "estimate-1.2")
    page.load.click()
    page.press.click()
    assert number(page) == page.refits[0].found.length


def test_a_window_too_long_or_too_short_is_said_so(page: Explorer) -> None:
    page.period.value = 1 / 120
    page.press.click()
    assert f"takes 2 to {replay.MOST_SAMPLES}" in page.answer.value
    page.period.value = 0.2
    page.span.value = (5.0, 5.1)
    page.press.click()
    assert "longer window" in page.answer.value
    assert not page.refits


def test_the_window_is_the_one_that_the_estimator_was_given_in_flight(flight: recording.Flight) -> None:
    given = replay.windows(flight)[30]
    end = (given.stamp - flight.start_ns) / 1e9
    tick = 1 / flight.params.piloting.control_rate
    start = end - (len(given.window.states) - 1) * given.window.step
    window, params = replay.window_between(flight, start - tick / 2, end + tick / 2, flight.params)
    assert params.estimation.window == flight.params.estimation.window
    np.testing.assert_array_equal(window.states, given.window.states)
    np.testing.assert_array_equal(window.inputs, given.window.inputs)


def test_the_rate_of_commands_is_read_from_the_bag_and_not_assumed(flight: recording.Flight) -> None:
    command = replace(flight.command, stamp=flight.command.stamp[::2], values=flight.command.values[::2])
    slow = replace(flight, command=command, metadata={"origin": "unknown"})
    window, _ = replay.window_between(slow, 5.0, 9.0, slow.params)
    assert window.step == pytest.approx(0.1, rel=1e-6)  # stamps are whole nanoseconds
    assert len(window.states) in (40, 41)  # where the first of 240 ticks falls


def test_the_fit_of_a_window_finds_what_the_estimator_finds_and_the_whole_landscape_has_the_same_minimum(
    flight: recording.Flight,
) -> None:
    window = replay.windows(flight)[30].window
    found = fit_window(window, flight.params, seed=3)
    expected = ga.estimate(window, flight.params, np.random.default_rng(3))
    assert (found.found.length, found.found.standard_deviation) == (expected.length, expected.standard_deviation)
    assert found.best == grid(window, flight.params).length


def test_all_estimators_are_compared_on_the_same_stretch(page: Explorer) -> None:
    page.press.click()
    page.rival.click()
    compared = page.rows[1:]
    assert [row["estimator"] for row in compared] == list(ESTIMATORS)
    assert compared[0]["length_m"] == page.rows[0]["length_m"], "the same algorithm, window and seed"
    for row in compared:
        assert row["estimator"] in page.compared.value
        # the rod is 1 m long; the widest scatter of them is about a third of that
        assert float(row["length_m"]) == pytest.approx(1.0, abs=0.4)


def test_an_estimator_that_cannot_take_the_stretch_says_why(flight: recording.Flight) -> None:
    window, params = replay.window_between(flight, 5.0, 5.2, flight.params)
    rows = {name: found for name, found, _ in compare(flight, window, 5.0, 5.2, params, 1)}
    assert math.isfinite(rows["ga"].length)
    assert math.isnan(rows["poses"].length) and "too few poses" in rows["poses"].reason


def test_export_writes_the_pictures_and_the_numbers_shown_and_says_where(page: Explorer, tmp_path: Path) -> None:
    page.press.click()
    page.folder.value = str(tmp_path / "mine")
    page.export.click()
    assert str(tmp_path / "mine") in page.exported.value
    names = {path.name for path in (tmp_path / "mine").iterdir()}
    assert names == {f"estimate-1.4-{what}" for what in ("flight.png", "space.png", "refit.png", "results.csv")}
    with (tmp_path / "mine" / "estimate-1.4-results.csv").open(newline="") as stream:
        (row,) = csv.DictReader(stream)
    assert float(row["length_m"]) == number(page)
    assert (row["origin"], row["bag"], row["samples"]) == ("simulated", "estimate-1.4", "55")


def test_a_folder_that_cannot_be_written_to_is_said_so(page: Explorer, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    page.folder.value = str(tmp_path / "file" / "folder")
    page.export.click()
    assert "cannot be written to" in page.exported.value


def test_a_picture_is_a_canvas_under_ipympl_and_an_image_elsewhere() -> None:
    image = Picture(2.0, 1.0)
    image.show()
    assert isinstance(image.widget, widgets.Image)
    assert bytes(image.widget.value).startswith(b"\x89PNG")
    before = mpl.get_backend()
    try:
        mpl.use("ipympl")
        assert type(Picture(2.0, 1.0).widget).__module__ == "ipympl.backend_nbagg"
    finally:
        mpl.use(before)


def test_a_panel_that_no_page_can_show_says_what_it_is(page: Explorer) -> None:
    assert repr(page.fit) == "[refit: widgets, to be used in JupyterLab]"
