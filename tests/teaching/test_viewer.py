"""The live view flies in real time, on the loopback interface only, says what happens, and ends without a trace."""

import re
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from fiplib.params import FipError
from fiplib.teaching.exercises.open_controller import OwnController
from fiplib.teaching.viewer import Viewer

ROOT = Path(__file__).parents[2]
SOON = 20.0
"""Seconds within which anything must have happened, on a busy machine."""


@pytest.fixture
def view() -> Iterator[Viewer]:
    with Viewer() as opened:
        yield opened


def await_true(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + SOON
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.02)


def test_it_is_served_to_this_machine_only(view):
    port = int(view.address.rpartition(":")[2])
    socket.create_connection(("127.0.0.1", port), 5).close()
    with pytest.raises(OSError):  # another address of this machine
        socket.create_connection(("127.0.0.2", port), 5).close()
    frame = view.show(300)
    assert frame.src == view.address and frame.height == 300


@pytest.mark.realtime
def test_it_flies_as_fast_as_the_clock_and_sleeps_between_the_pictures(view):
    await_true(lambda: view.do(lambda flight: flight.seconds) > 0.5)  # compiled code is loaded by then
    begun, worked, flown = time.monotonic(), time.process_time(), view.do(lambda flight: flight.seconds)
    time.sleep(2.0)
    flown = view.do(lambda flight: flight.seconds) - flown
    passed, worked = time.monotonic() - begun, time.process_time() - worked
    assert flown < passed + 0.2  # never faster than the clock, but for the picture under way
    assert flown > 0.5 * passed  # a busy machine may slow it down
    assert worked < 0.5 * passed  # 6 % on an idle machine


def test_a_paused_flight_stands_still_and_a_reset_begins_a_new_one(view):
    await_true(lambda: view.do(lambda flight: flight.seconds) > 0.2)
    view.pause()
    at = view.do(lambda flight: flight.seconds)
    time.sleep(0.2)
    assert view.do(lambda flight: flight.seconds) == at
    await_true(lambda: "paused" in view.status)
    first = view.flight_by_hand
    view.reset()
    assert view.flight_by_hand is not first and view.do(lambda flight: flight.seconds) == 0.0
    view.pause(False)
    await_true(lambda: "standing" in view.status and "length in use 1.000 m" in view.status)


def test_a_fall_is_said(view):
    view.push(0.5, 0.0)
    await_true(lambda: "fallen" in view.status)


def test_the_estimate_is_shown_with_its_interval(view):
    view.choose(estimator="poses", rod_length=0.8)
    await_true(lambda: "95 % interval" in view.status)
    assert float(re.search(r"estimate ([\d.]+) m", view.status)[1]) == pytest.approx(0.8, abs=0.05)


def test_what_a_task_raises_is_raised_and_the_flight_goes_on(view):
    with pytest.raises(KeyError):
        view.do(lambda flight: flight.use_weights("nonsense"))
    at = view.do(lambda flight: flight.seconds)
    await_true(lambda: view.do(lambda flight: flight.seconds) > at)


def test_a_controller_of_the_user_flies_and_its_mistake_is_a_sentence():
    def broken(state, reference, length):
        return 1 / 0

    with Viewer(own=lambda params: OwnController(broken, params)) as view:
        await_true(lambda: "stopped" in view.status)
        assert "your controller stops with ZeroDivisionError" in view.status

    def tumbling(state, reference, length):
        return np.array([0.5, 0.0])

    with Viewer(own=lambda params: OwnController(tumbling, params)) as view:
        await_true(lambda: "fallen" in view.status)


def test_closing_ends_every_thread_and_a_second_time_does_nothing():
    before = set(threading.enumerate())
    view = Viewer()
    assert set(threading.enumerate()) > before
    view.close()
    view.close()
    await_true(lambda: set(threading.enumerate()) <= before)
    with pytest.raises(FipError, match="make a new Viewer"):
        view.push(0.001, 0.0)


def test_it_never_opens_a_tunnel(view, monkeypatch):
    def connect(*arguments, **options):
        raise AssertionError("a tunnel was opened")

    monkeypatch.setattr("viser._viser.ViserTunnel", connect)
    assert view.server.request_share_url() is None


def test_the_command_serves_until_it_is_interrupted():
    process = subprocess.Popen(
        [sys.executable, "-m", "fiplib", "view"], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("http://127.0.0.1:")
    finally:
        process.send_signal(2)
    output, errors = process.communicate(timeout=SOON)
    assert process.returncode == 130 and "Traceback" not in output + errors, errors


@pytest.mark.parametrize(
    "wrong",
    [{"rod_length": -1.0}, {"used_length": 50.0}, {"estimator": "none"}, {"weights": "mine"}, {"controller": "x"}],
)
def test_what_is_no_choice_is_refused_and_does_not_stay_chosen(view, wrong):
    with pytest.raises((FipError, ValueError), match=r"must be|is none of"):
        view.choose(**wrong)
    view.reset()
    at = view.do(lambda flight: flight.seconds)
    await_true(lambda: view.do(lambda flight: flight.seconds) > at)
    assert "stopped" not in view.status


def test_a_view_whose_controller_cannot_be_made_leaves_no_server_behind():
    before = set(threading.enumerate())
    with pytest.raises(ZeroDivisionError):
        Viewer(own=lambda params: 1 / 0)
    await_true(lambda: set(threading.enumerate()) <= before)
