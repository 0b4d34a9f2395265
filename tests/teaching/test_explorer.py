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
from scipy.spatial.transform import Rotation

from fiplib import bags, ga, recording, replay
from fiplib.bags.messages import typestore
from fiplib.estimators import ESTIMATORS
from fiplib.estimators.grid import grid
from fiplib.recording import TOPICS
from fiplib.teaching.explorer import Explorer, step_for
from fiplib.teaching.explorer_fits import compare, fit_window
from fiplib.teaching.explorer_plots import Picture, thinned
from tests.bags import strangers

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
    """The genetic algorithm's length that the page shows, m."""
    return float(re.search(r"l = <b>([\d.]+)", page.answer.value)[1])


def shown(page: Explorer) -> float:
    """The length of the headline, m."""
    return float(re.search(r"l = <b>([\d.]+)", page.length.value)[1])


@pytest.fixture(scope="module")
def flight() -> recording.Flight:
    return bags.read(DATA / "estimate-1.4")


@pytest.fixture
def page(tmp_path: Path) -> Explorer:
    return Explorer(DATA, tmp_path / "explored")


def test_a_moved_slider_and_the_button_change_the_number(page: Explorer) -> None:
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
    getattr(page, setting).value = value
    page.press.click()
    assert page.refits[1].found.length != page.refits[0].found.length


def test_a_reading_that_is_no_likelihood_shows_no_interval(page: Explorer) -> None:
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
        page.chooser.path.value = str(path)
        page.chooser.load.click()
        assert words in page.message.value
        assert path.name in page.message.value
        assert "still shows estimate-1.4" in page.message.value
    page.press.click()
    assert len(page.refits) == 2, "the flight before can still be refitted"


def test_a_path_loads_its_bag_once_whether_the_press_of_the_button_arrives_before_it_or_after(
    page: Explorer, tmp_path: Path
) -> None:
    page.chooser.load.click()
    first = page.flight
    assert first.path.name == "estimate-1.4"
    page.chooser.path.value = str(renamed(DATA / "estimate-1.2", tmp_path / "elsewhere", POSES))
    assert page.flight.path.name == "elsewhere"
    shown = page.flight
    page.chooser.load.click()
    assert page.flight is shown, "nothing has changed since"


def test_the_browser_lists_folders_and_bags_and_opens_what_is_chosen(page: Explorer) -> None:
    names = [name for name, _ in page.chooser.browser.options]
    assert names[0].startswith("↑") and "circle-0.8" in names and "sweeps/" in names
    page.chooser.browser.value = DATA / "sweeps"
    assert page.chooser.browser.options[0][1] == DATA
    page.chooser.browser.value = DATA
    page.chooser.browser.value = DATA / "circle-0.8"
    assert page.flight.path.name == "circle-0.8" and page.chooser.path.value == str(DATA / "circle-0.8")
    page.chooser.path.value = str(DATA.parent)
    assert "without a bag" in page.message.value
    assert ("data/", DATA) in page.chooser.browser.options


@pytest.mark.parametrize("pattern", ["/vrpn_mocap/{}/pose", "/natnet_ros/{}/pose", "/{}/pose"])
def test_topics_of_other_laboratories_are_guessed_shown_in_menus_and_can_be_chosen(
    pattern: str, page: Explorer, tmp_path: Path
) -> None:
    names = {TOPICS["vehicle"]: pattern.format("cinewhoop"), TOPICS["pendulum"]: pattern.format("rod")}
    page.chooser.path.value = str(renamed(DATA / "estimate-1.2", tmp_path / "elsewhere", names))
    menus, right = page.chooser.topics, page.length.value
    assert [menus[role].value for role in ("vehicle", "pendulum", "command")] == [*names.values(), ""]
    assert [value for _, value in menus["vehicle"].options] == ["", *names.values()]
    assert "is taken for the pendulum, by its name" in page.message.value
    np.testing.assert_array_equal(page.flight.vehicle.position, bags.read(DATA / "estimate-1.2").vehicle.position)
    menus["vehicle"].value = names[TOPICS["pendulum"]]
    assert "one body stands for both" in page.chooser.found.children[0].value
    assert "listed below" in page.length.value
    menus["vehicle"].value = names[TOPICS["vehicle"]]
    assert page.length.value == right


def test_bodies_in_one_topic_are_entries_of_the_menus(page: Explorer, tmp_path: Path) -> None:
    flight = strangers.recorded()
    page.chooser.open(strangers.write(tmp_path / "bodies", strangers.rigid_bodies(flight)))
    menus = page.chooser.topics
    assert [menus[role].value for role in ("vehicle", "pendulum")] == ["/rigid_bodies:quad", "/rigid_bodies:pendulum"]
    low, high = page.whole.interval
    assert low < 1.0 < high


def test_what_speaks_against_a_bag_is_listed_and_its_cures_are_applied_and_taken_back(
    page: Explorer, tmp_path: Path
) -> None:
    turned = strangers.recorded().both(
        lambda body: body.seen_from(Rotation.from_euler("x", -90, degrees=True)).scaled(1000.0)
    )
    page.chooser.open(strangers.write(tmp_path / "y-up-mm", strangers.rows(turned)))
    assert page.whole.reason is not None and "y-up-mm: no length" in page.length.value
    up, unit, every = page.chooser.found.children
    assert "--up y" in up.children[0].value and "--unit mm" in unit.children[0].value
    up.children[1].click()
    assert page.chooser.reading == {"up": "y"} and page.whole.reason is not None
    every.click()
    assert page.chooser.reading == {"up": "y", "unit": "mm"} and page.chooser.against == []
    assert shown(page) == pytest.approx(1.0, abs=0.03), "its interval is 0.023 m wide"
    (line,) = page.chooser.found.children
    assert "up y; unit mm" in line.children[0].value
    line.children[1].click()
    assert page.chooser.reading == {} and len(page.chooser.against) == 2


def test_a_damaged_bag_is_recovered_into_a_new_one_and_loaded(page: Explorer, tmp_path: Path) -> None:
    half = shutil.copytree(DATA / "circle-0.8", tmp_path / "half")
    file = next(half.glob("*.mcap"))
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    page.chooser.path.value = str(half)
    assert "damaged or incomplete" in page.message.value
    page.chooser.recover.click()
    assert page.flight.path == tmp_path / "explored" / "half-recovered"
    assert "unchanged" in page.chooser.written.value and page.whole.reason is None
    page.chooser.path.value = str(DATA / "estimate-1.2")
    assert page.chooser.written.value == ""
    page.chooser.recover.click()
    assert "nothing: the recording is undamaged" in page.chooser.written.value


def test_a_table_of_another_program_is_converted_and_loaded(page: Explorer, tmp_path: Path) -> None:
    page.chooser.path.value = str(strangers.motive(tmp_path / "take.csv", strangers.recorded()))
    assert "a CSV file" in page.message.value
    page.chooser.convert.click()
    assert page.flight.path.name == "take-converted"
    low, high = page.whole.interval
    assert low < 1.0 < high


def test_the_window_is_cut_into_a_new_bag(page: Explorer, tmp_path: Path) -> None:
    page.span.value = (5.0, 9.0)
    page.press_cutting.click()
    assert "estimate-1.4-cut" in page.chooser.written.value
    assert bags.read(tmp_path / "explored" / "estimate-1.4-cut").duration == pytest.approx(4.0, abs=0.02)
    page.press_cutting.click()
    assert (tmp_path / "explored" / "estimate-1.4-cut-2").is_dir(), "nothing is overwritten"


def test_the_headline_is_the_recommended_estimate_with_the_genetic_algorithm_beside_it(page: Explorer) -> None:
    expected = replay.estimate(bags.read(DATA / "estimate-1.4"))
    assert shown(page) == round(expected.length, 4)
    low, high = expected.interval
    assert f"95 % interval {low:.4f} to {high:.4f} m" in page.length.value
    assert f"as set for Refit: {page.refits[-1].found.length:.4f} ±" in page.length.value
    assert "Do not use it" not in page.length.value
    assert [row["estimator"] for row in page.rows] == ["poses", "poses", "ga"]
    assert page.rows[0]["window_end_s"] == "25.00" and page.rows[0]["seed"] is None


def test_an_interval_of_the_genetic_algorithm_that_contradicts_the_headline_is_said(page: Explorer) -> None:
    page.span.value = (0.0, 12.0)  # with the take-off, which its model explains worst
    page.press.click()
    theirs, ours = page.refits[-1].found, page.whole
    assert abs(theirs.length - ours.length) > 2.0 * math.hypot(theirs.standard_deviation, ours.standard_deviation)
    assert "Do not use it: its interval contradicts the length above" in page.length.value


def test_the_length_over_time_is_drawn_and_listed(page: Explorer) -> None:
    assert page.over_windows.layout.display == "none"
    page.follow.click()
    assert len(page.windows) == 9 and bytes(page.over_windows.value).startswith(b"\x89PNG")
    for one in page.windows:
        assert one.found.reason is None and f"{one.found.length:.4f}" in page.parts.value
        assert one.found.length == pytest.approx(1.0, abs=4 * one.found.standard_deviation)
    assert page.progress.layout.display == "none"


def test_a_refused_estimate_is_a_sentence_and_no_number(page: Explorer, tmp_path: Path) -> None:
    short = strangers.recorded().both(lambda body: body.part(slice(0, 72)))
    page.chooser.open(strangers.write(tmp_path / "short", strangers.rows(short)))
    assert "too little excitation" in page.length.value
    assert "<b>" not in page.length.value


def test_a_quarter_of_an_hour_is_drawn_by_few_points_and_shows_every_peak() -> None:
    time = np.arange(216_000) / 240.0
    values = np.random.default_rng(1).normal(size=len(time))
    values[100_000], values[150_000] = 50.0, -50.0
    at, drawn = thinned(time, values, (0.0, 900.0))
    assert len(at) <= 4000 and np.all(np.diff(at) > 0)
    assert (drawn.max(), drawn.min()) == (50.0, -50.0) and (at[0], at[-1]) == (time[0], time[-1])
    at, drawn = thinned(time, values, (400.0, 410.0))
    np.testing.assert_array_equal(drawn, values[96_000 - 1 : 98_400 + 1]), "few enough: all of them"


@pytest.mark.parametrize(("seconds", "step"), [(25.0, 0.05), (150.0, 0.2), (900.0, 1.0), (7200.0, 5.0)])
def test_the_slider_has_sensible_steps(seconds: float, step: float) -> None:
    assert step_for(seconds) == step


def test_a_bag_without_commands_gives_its_length_and_says_why_the_genetic_algorithm_does_not(
    page: Explorer, tmp_path: Path
) -> None:
    page.chooser.path.value = str(renamed(DATA / "estimate-1.2", tmp_path / "poses", POSES))
    assert page.flight.command is None
    low, high = page.whole.interval
    assert low < 1.0 < high and "it needs commands" in page.length.value
    assert "holds no commands" in page.answer.value and "from the poses alone: <b>" in page.answer.value
    before = page.over_time.widget.value
    page.span.value = (0.0, 2.0)
    assert page.over_time.widget.value != before, "its pictures follow the slider all the same"
    page.rival.click()
    assert "holds no commands" in page.compared.value


def test_without_a_path_and_without_a_choice_the_page_asks_for_one(tmp_path: Path) -> None:
    page = Explorer(tmp_path, tmp_path / "explored")  # a folder without bags
    assert "Give the path of a bag" in page.message.value
    for press in (page.press, page.rival, page.export, page.follow, page.press_cutting, page.chooser.recover):
        press.click()
    assert not page.rows
    page.chooser.path.value = str(DATA / "estimate-1.2")
    assert number(page) == page.refits[0].found.length


def test_a_window_too_long_or_too_short_is_said_so(page: Explorer) -> None:
    page.period.value = 1 / 120
    page.press.click()
    assert f"takes 2 to {replay.MOST_SAMPLES}" in page.answer.value
    page.period.value = 0.2
    page.span.value = (5.0, 5.1)
    page.press.click()
    assert "longer window" in page.answer.value
    assert len(page.refits) == 1, "that of the window with which the page opened"


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
    page.rival.click()
    compared = page.rows[3:]
    assert [row["estimator"] for row in compared] == list(ESTIMATORS)
    assert compared[0]["length_m"] == page.rows[2]["length_m"], "the same algorithm, window and seed"
    for row in compared:
        assert row["estimator"] in page.compared.value
        # the rod is 1 m long; the widest scatter of them is about a third of that
        assert float(row["length_m"]) == pytest.approx(1.0, abs=0.4)


def test_an_estimator_without_an_answer_says_why_and_the_others_go_on(flight: recording.Flight) -> None:
    window, params = replay.window_between(flight, 5.0, 5.5, flight.params)
    rows = {name: found for name, found, _ in compare(flight, window, 5.0, 5.5, params, 1)}
    assert math.isfinite(rows["ga"].length) and math.isfinite(rows["poses"].length)
    refused = rows["recursive_least_squares"]
    assert math.isnan(refused.length) and "at the end of the interval" in refused.reason


@pytest.mark.parametrize("arrays", [".npz", ".csv"])
def test_export_writes_pictures_arrays_and_the_numbers_shown_and_says_where(
    arrays: str, page: Explorer, tmp_path: Path
) -> None:
    page.follow.click()
    page.folder.value, page.arrays.value = str(tmp_path / "mine"), arrays
    for _ in range(2):  # the second time in place of the first
        page.export.click()
        assert str(tmp_path / "mine") in page.exported.value
    names = {path.name for path in (tmp_path / "mine").iterdir()}
    pictures = {f"{what}.{end}" for what in ("flight", "space", "refit", "length") for end in ("png", "pdf")}
    tables = {f"{what}{arrays}" for what in ("poses", "states", "commands", "estimates")}
    assert names == {f"estimate-1.4-{what}" for what in pictures | tables | {"results.csv"}}
    assert set(page.written) == pictures | tables | {"results.csv"}
    assert page.written["refit.pdf"].read_bytes().startswith(b"%PDF")
    with page.written["results.csv"].open(newline="") as stream:
        whole, _, row, *windows = csv.DictReader(stream)
    assert float(whole["length_m"]) == pytest.approx(shown(page), abs=5e-5)
    assert float(row["length_m"]) == pytest.approx(number(page), abs=5e-5)
    assert len(windows) == len(page.windows)
    assert (row["origin"], row["bag"], row["samples"]) == ("simulated", "estimate-1.4", "55")


def test_the_arrays_of_a_stranger_s_bag_hold_the_estimates_of_its_windows(page: Explorer, tmp_path: Path) -> None:
    page.chooser.path.value = str(renamed(DATA / "estimate-1.2", tmp_path / "poses", POSES))
    page.export.click()
    assert "estimates.npz" not in page.written and "commands.npz" not in page.written
    page.follow.click()
    page.export.click()
    lengths = np.load(page.written["estimates.npz"])["estimate [m]"]
    np.testing.assert_array_equal(lengths, [one.found.length for one in page.windows])


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
