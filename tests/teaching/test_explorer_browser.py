"""The notebook that explores a bag, used as its reader uses it: JupyterLab in a real browser, mouse and keys."""

import os
import re
import shutil
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from rosbags.rosbag2 import StoragePlugin
from scipy.spatial.transform import Rotation

from fiplib.recording import TOPICS
from tests.bags import strangers
from tests.bags.strangers import Recording
from tests.teaching.test_explorer import renamed

ROOT = Path(__file__).parents[2]
NOTEBOOK = "07-explore-a-bag.ipynb"
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
PATIENCE = 300_000
"""ms within which anything must have happened: the longest step takes some 15 s on an idle machine."""

pytestmark = [
    pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine: the page was not tried in one"),
    pytest.mark.xdist_group("lab"),  # one JupyterLab for all of them
]


@contextmanager
def jupyterlab(folder: Path) -> Iterator[str]:
    """JupyterLab on a free port of the loopback, with its own settings; gives its address."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    own = {f"JUPYTER_{kind}_DIR": str(folder / kind.lower()) for kind in ("CONFIG", "DATA", "RUNTIME")}
    own |= {"JUPYTERLAB_SETTINGS_DIR": str(folder / "settings"), "JUPYTERLAB_WORKSPACES_DIR": str(folder / "spaces")}
    own |= {"IPYTHONDIR": str(folder / "ipython"), "JUPYTER_PLATFORM_DIRS": "1"}
    arguments = [
        "--no-browser", "--ip=127.0.0.1", f"--port={port}", "--ServerApp.port_retries=0", "--IdentityProvider.token=",
        "--ServerApp.password=", f"--ServerApp.root_dir={folder / 'notebooks'}", 
        "--LabApp.check_for_updates_class=jupyterlab.NeverCheckForUpdate", "--LabApp.extension_manager=readonly",
    ]  # fmt: skip
    if hasattr(os, "geteuid") and os.geteuid() == 0:
        arguments.append("--allow-root")
    with (folder / "server.log").open("w") as log:
        server = subprocess.Popen(
            [sys.executable, "-m", "jupyterlab", *arguments], env=os.environ | own, stdout=log, stderr=log
        )
        try:
            address = f"http://127.0.0.1:{port}"
            _await_server(server, f"{address}/api/status", folder / "server.log")
            yield address
        finally:
            server.terminate()  # it shuts its kernels down
            server.wait(30)


def _await_server(server: subprocess.Popen, address: str, log: Path) -> None:
    for _ in range(PATIENCE // 250):
        try:
            urllib.request.urlopen(address, timeout=5).close()
            return
        except (urllib.error.URLError, OSError):
            assert server.poll() is None, f"JupyterLab did not start:\n{log.read_text()[-2000:]}"
            time.sleep(0.25)
    pytest.fail(f"JupyterLab does not answer:\n{log.read_text()[-2000:]}")


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator:
    """The notebook, a copy, opened in JupyterLab and run to its end."""
    from playwright.sync_api import sync_playwright

    folder = tmp_path_factory.mktemp("lab")
    (folder / "notebooks").mkdir()
    shutil.copy(ROOT / "notebooks" / NOTEBOOK, folder / "notebooks")
    quiet = folder / "settings" / "@jupyterlab" / "apputils-extension" / "notification.jupyterlab-settings"
    quiet.parent.mkdir(parents=True)
    quiet.write_text('{"fetchNews": "false"}')  # else a box asks about news, over the page
    with jupyterlab(folder) as address, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        page.set_default_timeout(PATIENCE)
        page.goto(f"{address}/lab/tree/{NOTEBOOK}?reset")
        page.get_by_text("| Idle").wait_for()  # before that, a run would be lost
        page.get_by_role("menuitem", name="Run", exact=True).click()
        page.get_by_role("menuitem", name="Run All Cells", exact=True).click()
        page.get_by_text(re.compile(r"Wrote .*results\.csv")).wait_for(state="attached")
        page.locator(".jp-OutputArea-output img[src^='data:image/png']").last.wait_for(state="attached")
        yield page
        browser.close()


def answer(page: object) -> str:
    """What the page says about the last refit."""
    return page.locator(".fip-answer").text_content()


def headline(page: object) -> str:
    return page.locator(".fip-length").text_content()


class Actions:
    """What a reader does with the page, counted."""

    def __init__(self, page: object) -> None:
        self.page, self.count = page, 0

    def type_path(self, path: Path) -> None:
        """Type a path and press Enter."""
        self.count += 1
        field = self.page.get_by_label("path", exact=True)
        field.fill(str(path))
        field.press("Enter")

    def press(self, name: str) -> None:
        """Press a button once it is there."""
        self.count += 1
        self.page.get_by_role("button", name=name, exact=True).click()

    def read_length(self, name: str) -> tuple[float, float, float]:
        """Read length and interval of the flight of this name once they are there, m."""
        self.count += 1
        self.page.locator(".fip-length", has_text=re.compile(rf"95 % interval.*flight {name};")).wait_for()
        found = re.search(r"l = ([\d.]+) m, 95 % interval ([\d.]+) to ([\d.]+) m", headline(self.page))
        return tuple(float(text) for text in found.groups())


def number(text: str) -> float:
    return float(re.search(r"l = ([\d.]+)", text)[1])


def test_the_notebook_runs_without_an_error_and_shows_its_canvases(page) -> None:
    assert page.locator(".jp-RenderedText[data-mime-type='application/vnd.jupyter.stderr']").count() == 0
    assert page.locator(".jupyter-matplotlib").count() == 3
    assert "95 % interval" in headline(page)


def test_a_moved_slider_and_the_button_change_the_number(page) -> None:
    before = answer(page)
    handle = page.locator(".noUi-handle-lower").last
    handle.scroll_into_view_if_needed()
    handle.focus()
    for _ in range(20):
        page.keyboard.press("ArrowRight")
    page.get_by_text("The settings have changed since").wait_for()
    page.get_by_role("button", name="Refit", exact=True).click()
    page.get_by_text(re.compile("refit 5 took")).wait_for()
    after = answer(page)
    assert number(after) != number(before), (before, after)


def test_the_view_in_space_turns_with_the_mouse(page) -> None:
    canvas = page.locator(".jupyter-matplotlib").nth(1)
    canvas.scroll_into_view_if_needed()
    before, box = canvas.screenshot(), canvas.bounding_box()
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(*middle)
    page.mouse.down()
    page.mouse.move(middle[0] + 80, middle[1], steps=8)
    page.mouse.up()
    page.mouse.move(0, 0)  # the buttons of the canvas fade
    for _ in range(PATIENCE // 500):
        page.wait_for_timeout(500)
        if canvas.screenshot() != before:
            break
    assert canvas.screenshot() != before


STRANGERS: dict[str, tuple[Callable[[Path, Recording], Path], str, list[str]]] = {
    "y up, in millimetres, without commands": (
        lambda path, flight: strangers.write(path / "turned", strangers.rows(turned(flight), with_commands=False)),
        "turned", ["Apply all"],
    ),
    "bodies swapped, in sqlite3": (
        lambda path, flight: strangers.write(
            path / "swapped", strangers.rows(flight._replace(vehicle=flight.rod, rod=flight.vehicle)),
            StoragePlugin.SQLITE3,
        ),
        "swapped", ["Apply"],
    ),
    "rigid bodies in one topic": (
        lambda path, flight: strangers.write(path / "bodies", strangers.rigid_bodies(flight)), "bodies", [],
    ),
    "a table of another program": (
        lambda path, flight: strangers.motive(path / "take.csv", flight), r"take-converted(-\d+)?", ["Convert"],
    ),
}  # fmt: skip
"""Recordings of strangers with a rod of 1.00 m, the names they get, and the buttons that they need."""


def turned(flight: Recording) -> Recording:
    return flight.both(lambda body: body.seen_from(Rotation.from_euler("x", -90, degrees=True)).scaled(1000.0))


@pytest.mark.parametrize("kind", STRANGERS)
def test_from_the_page_to_the_length_of_a_stranger_s_recording_in_three_actions(page, kind: str, tmp_path) -> None:
    make, name, buttons = STRANGERS[kind]
    actions = Actions(page)
    path = make(tmp_path, strangers.recorded())
    actions.type_path(path)
    page.locator(".fip-message", has_text=path.name).wait_for()
    for button in buttons:
        actions.press(button)
    length, low, high = actions.read_length(name)
    assert actions.count <= 3
    assert low < 1.0 < high and high - low < 0.06, (length, low, high)
    assert page.get_by_text("Traceback").count() == 0


def test_a_corrupt_file_is_a_sentence_in_the_page_and_recovered_by_a_button(page, tmp_path: Path) -> None:
    bag = shutil.copytree(ROOT / "data" / "circle-0.8", tmp_path / "half-a-flight")
    file = next(bag.glob("*.mcap"))
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    actions = Actions(page)
    actions.type_path(bag)
    page.get_by_text(re.compile("half-a-flight.*damaged or incomplete")).wait_for()
    page.get_by_text(re.compile("The page still shows")).wait_for()
    assert page.get_by_text("Traceback").count() == 0
    actions.press("Recover")
    low, high = actions.read_length(r"half-a-flight-recovered(-\d+)?")[1:]
    assert low < 1.0 < high and actions.count <= 3


def test_the_topics_of_another_laboratory_are_in_the_menus(page, tmp_path: Path) -> None:
    names = {
        TOPICS["vehicle"]: "/vrpn_mocap/cinewhoop/pose",
        TOPICS["pendulum"]: "/vrpn_mocap/rod/pose",
        TOPICS["command"]: "/mavros/setpoint_raw/attitude",
    }
    Actions(page).type_path(renamed(ROOT / "data" / "estimate-1.2", tmp_path / "elsewhere", names))
    page.get_by_text(re.compile(r"elsewhere: of unknown origin.* [1-9]\d* commands")).wait_for()
    page.locator(".jupyter-widget-Collapse-header", has_text="Topics").click()
    menu = page.get_by_label("vehicle", exact=True)
    assert menu.input_value() == names[TOPICS["vehicle"]]
    menu.select_option(names[TOPICS["pendulum"]])
    page.get_by_text(re.compile("one body stands for both")).first.wait_for()
    menu.select_option(names[TOPICS["vehicle"]])
    low, high = Actions(page).read_length("elsewhere")[1:]
    assert low < 1.0 < high
    page.get_by_text(re.compile("the bag does not state the rod's length; refit 1 took")).wait_for()
