"""The estimator beside a flight: the same estimates as in the simulator, and no harm when its process dies or hangs."""

import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from fiplib import bags, recording, replay
from fiplib.estimators import ESTIMATORS
from fiplib.estimators.base import Estimate
from fiplib.flight.estimator import EstimatorProcess
from fiplib.flight.limits import Limits
from fiplib.kalman import Window

pytestmark = pytest.mark.realtime

DATA = Path(__file__).parents[2] / "data"


@pytest.fixture(scope="module")
def flight() -> recording.Flight:
    return bags.read(DATA / "estimate-1.4")


@pytest.fixture(scope="module")
def windows(flight: recording.Flight) -> list[Window]:
    return [found.window for found in replay.windows(flight)[:4]]


def answer(process: EstimatorProcess, window: Window, patience: float = 60.0) -> Estimate | None:
    """Hand a window over until an answer comes, or a remark; the patience is for a busy machine."""
    end = time.monotonic() + patience
    while time.monotonic() < end:
        if estimate := process.deliver(0, window):
            return estimate
        if process.remarks:
            return None
        time.sleep(0.005)
    raise AssertionError("neither an answer nor a remark")


def test_its_estimates_are_those_of_the_simulated_flight(flight, windows):
    with EstimatorProcess(flight.params, flight.metadata["seed"], Limits()) as process:
        for run in (0, 1):
            assert answer(process, windows[run]).length == flight.length.values[1 + run, 1]
            # the answer to the last call was followed by the next window at once: it is left to the next run
            while process.deliver(0, None) is None and process._busy:
                time.sleep(0.005)
            process._runs = run + 1
        assert process.seconds > 0.0 and not process.remarks


@pytest.mark.parametrize(
    ("number", "words"), [(signal.SIGKILL, "died (exit code -9)"), (signal.SIGSTOP, "hung for 5 s")]
)
def test_one_that_dies_or_hangs_is_started_again_and_given_up_in_the_end(flight, number, words):
    # a run takes a twentieth of a second, far from the timeout
    params = flight.params.replace(estimation__estimator="poses")
    limits = Limits().replace(safety__estimator_timeout=5.0, safety__estimator_restarts=1)
    windows = [found.window for found in replay.windows(flight, params)[:1]]
    with EstimatorProcess(params, 1, limits) as process:
        for remark in (f"estimator {words}: started again", f"estimator {words}: given up after 1 restarts"):
            assert np.isfinite(answer(process, windows[0]).length)
            os.kill(process.pid, number)
            while answer(process, windows[0]) is not None:
                pass
            assert [text for _, text in process.remarks] == [remark]
            process.remarks.clear()
        assert process.pid is None and process.deliver(0, windows[0]) is None


def test_an_exception_in_the_estimator_is_an_estimate_refused_with_its_words(flight, windows):
    with EstimatorProcess(flight.params, 1, Limits()) as process:
        estimate = answer(process, "no window")
        assert np.isnan(estimate.length) and "Error" in estimate.reason
        while process._busy:
            process.deliver(0, None)
            time.sleep(0.005)
        assert np.isfinite(answer(process, windows[0]).length)


def test_an_unknown_estimator_is_refused_before_any_process_starts(flight):
    with pytest.raises(ValueError, match=f"must be one of {', '.join(ESTIMATORS)}"):
        EstimatorProcess(flight.params.replace(estimation__estimator="guess"), 1, Limits())
