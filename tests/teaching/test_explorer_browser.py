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
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from fiplib.recording import TOPICS
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


def load(page: object, path: Path) -> None:
    field = page.get_by_label("path", exact=True)
    field.fill(str(path))
    field.press("Enter")
    page.get_by_role("button", name="Load", exact=True).click()


def number(text: str) -> float:
    return float(re.search(r"l = ([\d.]+)", text)[1])


def test_the_notebook_runs_without_an_error_and_shows_its_canvases(page) -> None:
    assert page.locator(".jp-RenderedText[data-mime-type='application/vnd.jupyter.stderr']").count() == 0
    assert page.locator(".jupyter-matplotlib").count() == 3


def test_a_moved_slider_and_the_button_change_the_number(page) -> None:
    before = answer(page)
    handle = page.locator(".noUi-handle-lower").last
    handle.scroll_into_view_if_needed()
    handle.focus()
    for _ in range(20):
        page.keyboard.press("ArrowRight")
    page.get_by_text("The settings have changed since").wait_for()
    page.get_by_role("button", name="Refit", exact=True).click()
    page.get_by_text(re.compile("refit 4 took")).wait_for()
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


def test_a_corrupt_file_is_a_sentence_in_the_page(page, tmp_path: Path) -> None:
    bag = shutil.copytree(ROOT / "data" / "circle-0.8", tmp_path / "half-a-flight")
    file = next(bag.glob("*.mcap"))
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    load(page, bag)
    page.get_by_text(re.compile("half-a-flight.*damaged or incomplete")).wait_for()
    page.get_by_text("The page still shows estimate-1.4").wait_for()
    assert page.get_by_text("Traceback").count() == 0


def test_a_bag_of_another_laboratory_is_read_by_its_driver_s_names(page, tmp_path: Path) -> None:
    names = {
        TOPICS["vehicle"]: "/vrpn_mocap/cinewhoop/pose",
        TOPICS["pendulum"]: "/vrpn_mocap/rod/pose",
        TOPICS["command"]: "/mavros/setpoint_raw/attitude",
    }
    bag = renamed(ROOT / "data" / "estimate-1.2", tmp_path / "elsewhere", names)
    load(page, bag)
    page.get_by_text(re.compile("elsewhere: of unknown origin")).wait_for()  # guessed; then said by hand
    page.locator(".jupyter-widget-Collapse-header", has_text="Topics").click()
    page.get_by_label("convention").select_option("vrpn_mocap")
    for label, text in (
        ("vehicle is", "cinewhoop"),
        ("rod is", "rod"),
        ("command topic", names[TOPICS["command"]]),
    ):
        page.get_by_label(label).fill(text)
        page.get_by_label(label).press("Enter")
    page.get_by_text(re.compile(r"elsewhere: of unknown origin.* [1-9]\d* commands")).wait_for()
    page.get_by_role("button", name="Refit", exact=True).click()
    page.get_by_text(re.compile("the bag does not state the rod's length; refit 1 took")).wait_for()
    # the rod of that flight is 1 m long; one window of it is good for about a fifth of that
    assert number(answer(page)) == pytest.approx(1.0, abs=0.2)
