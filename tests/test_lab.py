"""JupyterLab as ``make lab`` starts it: also as root, which one is in a container, and without its pop-up of news."""

import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
BROWSER = shutil.which("chromium") or shutil.which("chromium-browser")

pytestmark = [
    pytest.mark.skipif(BROWSER is None, reason="no chromium on this machine: the page was not tried in one"),
    pytest.mark.xdist_group("lab"),
]


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    """Start what ``make lab`` starts, as make prints it, on a free port of the loopback; yields its address."""
    shown = subprocess.run(
        ["make", "--no-print-directory", "--dry-run", "--old-file", ".venv/installed", "lab"],
        cwd=ROOT,
        text=True,
        capture_output=True,
        check=True,
    ).stdout
    command = shown[shown.index("-m jupyterlab") :].replace("\\\n", " ").split()
    lab = subprocess.Popen(
        [sys.executable, *command, "--no-browser", "--ip=127.0.0.1", "--port=0"],
        cwd=ROOT,
        text=True,
        stderr=subprocess.PIPE,
        env=os.environ | {"JUPYTERLAB_SETTINGS_DIR": str(tmp_path_factory.mktemp("settings"))},
    )
    try:
        found = None
        for line in lab.stderr:
            if found := re.search(r"http://127\.0\.0\.1:\d+/\S+", line):
                break
        assert found, "it ended without an address"
        yield found[0]
    finally:
        lab.send_signal(signal.SIGTERM)
        lab.communicate(timeout=60)


def test_lab_opens_the_first_notebook_without_a_dialogue(address):
    from playwright.sync_api import sync_playwright

    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=BROWSER, args=["--no-sandbox"])
        try:
            page = browser.new_page()
            page.goto(address)
            page.get_by_role("tab", name="00-start-here.ipynb").first.wait_for(timeout=90_000)
            page.wait_for_timeout(3_000)  # the pop-up of news came two seconds after the page
            assert page.get_by_text("Jupyter news").count() == 0
        finally:
            browser.close()
