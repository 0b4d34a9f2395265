"""The live view and the page of a recorded flight, as their reader uses them: in a real browser, by mouse and keys."""

import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from fiplib import bags
from fiplib.teaching.recorded import write_page
from fiplib.teaching.viewer import Viewer

ROOT = Path(__file__).parents[2]
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
PATIENCE = 60_000
"""ms within which anything must have happened: the scene is drawn in software here."""

pytestmark = [
    pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine: the view was not tried in one"),
    pytest.mark.xdist_group("viewer"),
]


@pytest.fixture(scope="module")
def browser() -> Iterator:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        opened = playwright.chromium.launch(
            executable_path=CHROMIUM, args=["--no-sandbox", "--enable-unsafe-swiftshader", "--use-gl=angle"]
        )
        yield opened
        opened.close()


@pytest.fixture
def page(browser) -> Iterator:
    """An empty page, with what it asks of the network and what goes wrong in it."""
    page = browser.new_page(viewport={"width": 900, "height": 640})
    page.set_default_timeout(PATIENCE)
    page.asked, page.errors = [], []
    page.on("request", lambda request: page.asked.append(request.url))
    page.on("pageerror", lambda error: page.errors.append(str(error)))
    yield page
    page.close()


def test_keys_buttons_and_sliders_reach_the_flight_and_nothing_comes_from_the_network(page) -> None:
    with Viewer() as view:
        page.goto(view.address)
        page.get_by_text(re.compile(r"length in use 1\.000 m")).wait_for()
        page.get_by_role("button", name="+y", exact=True).click()
        page.mouse.click(60, 600)
        page.keyboard.press("l")
        page.keyboard.press("t")
        page.keyboard.press("t")

        def arrived() -> bool:
            pushes = [event for event in view.do(lambda flight: flight.flight()).events if event.kind == "push"]
            return len(pushes) == 2 and view.do(lambda flight: flight.target.place) == pytest.approx((0.0, 0.2))

        wait_until(page, arrived)
        page.keyboard.press("p")
        page.get_by_text(re.compile("^paused")).wait_for()
        page.keyboard.press("r")
        wait_until(page, lambda: view.do(lambda flight: flight.seconds) == 0.0)
        page.keyboard.press("p")
        used = page.get_by_role("slider").nth(3)  # after impulse, x and y
        assert float(used.get_attribute("aria-valuemin")) == 0.2 and float(used.get_attribute("aria-valuenow")) == 1.0
        used.focus()
        for _ in range(3):
            page.keyboard.press("ArrowLeft")
        page.get_by_text(re.compile(r"length in use 0\.970 m")).wait_for()
        assert page.errors == []
        assert {url.partition("://")[2].partition("/")[0] for url in page.asked if "127.0.0.1" not in url} == set()


def wait_until(page, condition) -> None:
    for _ in range(PATIENCE // 100):
        if condition():
            return
        page.wait_for_timeout(100)
    assert condition()


def test_the_frame_of_a_notebook_shows_the_view(page) -> None:
    with Viewer() as view:
        page.set_content(f"<p>a cell</p>{view.show(500)._repr_html_()}")
        page.frame_locator("iframe").get_by_text(re.compile(r"length in use 1\.000 m")).wait_for()
        assert page.locator("iframe").bounding_box()["height"] == pytest.approx(500, abs=5)


def test_a_recorded_flight_plays_from_one_file_without_a_server_and_without_the_network(page, tmp_path) -> None:
    path = tmp_path / "flight.html"
    write_page(bags.read(ROOT / "data/estimate-1.4"), path)
    assert path.stat().st_size < 2e6
    page.context.set_offline(True)
    page.goto(path.as_uri())
    assert page.title() == "estimate-1.4, simulated"
    clock = page.locator("input[type=text]").first
    clock.wait_for()
    seen = {float(clock.input_value())}
    wait_until(page, lambda: len(seen | {float(clock.input_value())}) > 1)
    assert page.locator("canvas").last.bounding_box()["width"] > 800  # the scene fills the page
    assert page.asked == [path.as_uri()] and page.errors == []
