"""Every estimator behind its one call: right on data of its own model, honest on its spread, clear when it refuses."""

import math
import subprocess
import sys
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from fiplib import replay
from fiplib.estimators import ESTIMATORS
from fiplib.estimators.base import Estimate
from fiplib.estimators.genetic import IMPROVED
from fiplib.params import NANO, Params
from fiplib.recording import Flight
from fiplib.references import Circle, Hover
from fiplib.simulate import Push, Scenario, fly
from fiplib.studies import estimators as study
from tests.test_kalman import simulated_window

# A resolution of 1 mm: a tenth of the time, and still small beside any spread below
# without a raised seat, of which neither the paper's model nor ``likelihood`` knows
PARAMS = Params().replace(estimation__resolution=1e-3, vehicle__seat_height=0.0, piloting__seat_height=0.0)
MODULES = sorted({estimator.path.partition(":")[0] for estimator in ESTIMATORS.values()})
LIKELIHOODS = ["ga", "ga_improved", "grid", "scalar"]


@cache
def answers(name: str, length: float = 1.0) -> list[Estimate]:
    """An estimator's answers on twelve windows that the paper's model flew itself, with the noise it is told of."""
    windows = [simulated_window(length, np.random.default_rng(seed), PARAMS.estimation) for seed in range(12)]
    return [ESTIMATORS[name].function(window, PARAMS, np.random.default_rng(0)) for window in windows]


def lengths(name: str, length: float = 1.0) -> np.ndarray:
    return np.array([answer.length for answer in answers(name, length)])


def deviations(name: str) -> np.ndarray:
    return np.array([answer.standard_deviation for answer in answers(name)])


@cache
def flown(kind: str = "circle", seed: int = 1, **changes: float) -> Flight:
    reference = {"circle": Circle(0.4, 8.0, ramp=2.0), "hover": Hover()}[kind]
    pushes = (Push(6.0, (0.006, 0.0)),) if kind == "hover" else ()
    scenario = Scenario(kind, "", 8.0, reference, pushes=pushes, params=PARAMS.replace(**changes), seed=seed)
    flight = fly(scenario)
    assert flight.survived
    return flight


@pytest.mark.parametrize("name", [*LIKELIHOODS, "ekf", "ukf", "moving_horizon"])
def test_on_data_of_its_own_model_an_estimator_is_unbiased_and_knows_its_spread(name: str) -> None:
    errors, stated = lengths(name) - 1.0, deviations(name)
    assert (0 < stated).all() and (stated < 0.1).all(), "the circle fixes the length"
    # three standard errors of the mean of twelve; those that linearise or fit the states too may be off by half a sigma
    slack = 0.0 if name in LIKELIHOODS else 0.5
    assert abs(np.mean(errors / stated)) < 3 / math.sqrt(12) + slack
    # chi-squared with 12 degrees of freedom: between 2.2 and 32.9 with 99.8 %; twice as far for the approximate ones
    assert 2.2 / (1 + 2 * slack) < np.sum((errors / stated) ** 2) < 32.9 * (1 + 2 * slack)


def test_searches_of_one_fitness_find_the_same_optimum() -> None:
    resolution = PARAMS.estimation.resolution
    np.testing.assert_allclose(lengths("scalar"), lengths("grid"), atol=0.51 * resolution)
    # the genetic search may miss the last bits, 1 to 8 mm; that must stay small beside the spread of some 50 mm
    for name in ("ga", "ga_improved"):
        assert np.abs(lengths(name) - lengths("grid")).max() < 0.2 * deviations("grid").mean()
    np.testing.assert_allclose(deviations("scalar"), deviations("grid"), rtol=0.02)


def test_joint_fits_of_states_and_length_come_close_to_the_likelihood() -> None:
    for name in ("ekf", "ukf", "moving_horizon"):
        assert np.abs(lengths(name) - lengths("grid")).mean() < deviations("grid").mean()


@pytest.mark.parametrize("name", ["recursive_least_squares", "concurrent_learning"])
def test_the_regressions_find_the_length_once_the_noise_is_small(name: str) -> None:
    quiet = replace(PARAMS.estimation, process_noise=(1e-14,) * 10, measurement_noise=(1e-14,) * 10)
    for length in (0.6, 1.0, 1.4):
        window = simulated_window(length, np.random.default_rng(3), quiet)
        answer = ESTIMATORS[name].function(window, replace(PARAMS, estimation=quiet), None)
        # the mean of d over a step taken from its two ends errs by (w dt)^2 / 12 = 2 to 3 %
        assert answer.length == pytest.approx(length, rel=0.05)


def test_the_spread_of_least_squares_is_its_own() -> None:
    errors, stated = lengths("recursive_least_squares") - 1.0, deviations("recursive_least_squares")
    # its model of the noise is white in d'', that of differences is not: right within a factor of 3
    assert 1 / 3 < np.sqrt(np.nanmean(errors**2)) / np.nanmean(stated) < 3
    assert all(math.isnan(answer.standard_deviation) for answer in answers("concurrent_learning"))


def test_the_improved_algorithm_differs_by_its_two_settings_alone() -> None:
    window = simulated_window(1.0, np.random.default_rng(0), PARAMS.estimation)
    changed = replace(PARAMS, estimation=replace(PARAMS.estimation, **IMPROVED))
    rngs = (np.random.default_rng(7) for _ in range(2))
    assert ESTIMATORS["ga_improved"].function(window, PARAMS, next(rngs)) == ESTIMATORS["ga"].function(
        window, changed, next(rngs)
    )
    assert IMPROVED["elite_fraction"] < PARAMS.estimation.elite_fraction
    assert IMPROVED["mutation_rate"] > PARAMS.estimation.mutation_rate


def test_errors_name_what_is_wrong() -> None:
    still = replace(PARAMS, estimation=replace(PARAMS.estimation, process_noise=(0.0,) * 10))
    with pytest.raises(ValueError, match="moving_horizon needs process noise"):
        ESTIMATORS["moving_horizon"].function(simulated_window(1.0, np.random.default_rng(0), PARAMS.estimation), still)


def test_raw_windows_follow_each_other_at_the_asked_period() -> None:
    flight = flown()
    found = replay.raw_windows(flight, 1.0, 0.5)
    stamps = np.array([stamp for stamp, _ in found])
    np.testing.assert_allclose(np.diff(stamps) / NANO, 0.5, atol=1e-3)
    for stamp, window in found:
        assert [len(body.stamp) for body in window] == [240, 240], "the frame that begins it, not the next one's"
        assert window.seconds == pytest.approx(239 / 240, abs=1e-8)  # stamps are whole nanoseconds
        assert stamp <= flight.vehicle.received[-1]


@pytest.mark.parametrize("module", ["fiplib.estimators", *(f"fiplib.estimators.{name}" for name in MODULES)])
def test_a_module_of_the_estimators_imports_no_solver_before_it_is_called(module: str) -> None:
    """SciPy's optimisers and signal filters and filterpy take a second each; the registry alone needs no CasADi."""
    slow = {"scipy.optimize", "scipy.signal", "filterpy"} | ({"casadi"} if module == "fiplib.estimators" else set())
    code = f"import sys, {module}; print(*({slow!r} & sys.modules.keys()))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == ""


def test_a_study_row_counts_what_it_was_given() -> None:
    given = [Estimate(1.01, 0.01), Estimate(0.97, 0.01), Estimate(math.nan, math.nan, "no")]
    row = study.summarise(given, 1.0)
    assert (row["n"], row["refused"], row["covered"]) == (2, 1, 1)
    assert row["bias"] == pytest.approx(-0.01) and row["rms"] == pytest.approx(math.sqrt(5e-4))
    silent = study.summarise([Estimate(1.0, math.nan)], 1.0)
    assert math.isnan(silent["covered"]) and math.isnan(silent["sd"])
    assert study.summarise([], 1.0)["n"] == 0


def test_a_study_case_is_repeatable_and_covers_every_estimator(monkeypatch: pytest.MonkeyPatch) -> None:
    cheap = {name: ESTIMATORS[name] for name in ("ekf", "poses")}
    monkeypatch.setattr(study, "ESTIMATORS", cheap)
    monkeypatch.setattr(study, "DURATION", 11.2)
    cases = study.cases()
    assert len({tuple(case[key] for key in study.KEYS) for case in cases}) == len(cases) == 90
    row = study.run(cases[0])
    assert row == study.run(cases[0])
    for name in cheap:
        assert row[f"n_{name}"] >= 1 and 0 < row[f"bound_{name}"] < 0.01
