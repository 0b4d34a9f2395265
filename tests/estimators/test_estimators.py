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
from fiplib.estimators.cramer_rao import cramer_rao, motion
from fiplib.estimators.genetic import IMPROVED
from fiplib.estimators.likelihood import CALIBRATION, LARGEST_SPREAD, NUISANCES, maximum_likelihood
from fiplib.estimators.windows import RawWindow
from fiplib.params import NANO, Params
from fiplib.pilot import Circle, Hover
from fiplib.recording import BagError, Flight
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


def raw(flight: Flight, after: float = 4.0, seconds: float = 2.5) -> RawWindow:
    """The first raw window that begins after so many seconds."""
    found = replay.raw_windows(flight, seconds, 0.1)
    return next(window for stamp, window in found if (stamp - flight.start_ns) / NANO > after + seconds + 0.01)


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


@pytest.mark.parametrize("length", [0.6, 1.0, 1.5])
@pytest.mark.parametrize("gyration_ratio", [0.0, 1 / 12])
def test_maximum_likelihood_finds_the_length_of_a_simulated_flight(length: float, gyration_ratio: float) -> None:
    changes = {"pendulum__length": length, "pendulum__gyration_ratio": gyration_ratio}
    flight = flown(**changes, piloting__initial_length=0.95 * length)
    for nuisances, limit in (((), 0.004), ((CALIBRATION,), 0.009), (NUISANCES, 0.009)):
        answer = maximum_likelihood(raw(flight), flight.params, nuisances=nuisances)
        # 4 deviations are passed once in 16 000
        assert answer.reason is None and answer.standard_deviation < limit
        assert abs(answer.length - length) < 4 * answer.standard_deviation


@pytest.mark.parametrize("nuisances", [(), (CALIBRATION,)])
def test_maximum_likelihood_reaches_the_bound_over_many_windows(nuisances: tuple[str, ...]) -> None:
    errors, stated, bounds = [], [], []
    for seed in range(3):
        flight = flown(seed=seed)
        for end, window in replay.raw_windows(flight, 1.0, 1.0):
            end -= round(flight.params.simulation.mocap_latency * NANO)
            if (end - flight.start_ns) / NANO > 4.0:
                answer = maximum_likelihood(window, flight.params, nuisances=nuisances)
                errors.append(answer.length - 1.0)
                stated.append(answer.standard_deviation)
                bounds.append(cramer_rao(motion(flight, end - NANO, end), flight.params, nuisances)[-1])
    count = len(errors)
    assert count >= 11
    # the root mean square of n errors scatters by 1/sqrt(2 n): three of those
    assert np.sqrt(np.mean(np.square(np.divide(errors, bounds)))) == pytest.approx(1.0, abs=3 / math.sqrt(2 * count))
    np.testing.assert_allclose(stated, bounds, rtol=0.1)  # observed against true information, 1 s of it


def test_what_the_model_leaves_out_is_found_in_the_estimate() -> None:
    """Told a point mass, the estimate of a real rod is wrong by many deviations; fitting the inertia mends it."""
    flight = flown(pendulum__gyration_ratio=1 / 12)
    told = flight.params.replace(pendulum__gyration_ratio=0.0)
    wrong, mended = (maximum_likelihood(raw(flight), told, nuisances=names) for names in ((), NUISANCES))
    assert abs(wrong.length - 1.0) > 4 * wrong.standard_deviation or wrong.reason is not None
    assert abs(mended.length - 1.0) < 4 * mended.standard_deviation


def test_the_answer_does_not_depend_on_where_and_when_the_window_lies() -> None:
    window, shift = raw(flown()), np.array([1.0, -2.0, 0.5])
    moved = replace(
        window,
        vehicle=window.vehicle + shift,
        pendulum=window.pendulum + shift,
        time=window.time + 3.0,
        command_time=window.command_time + 3.0,
    )
    first, second = maximum_likelihood(window, PARAMS), maximum_likelihood(moved, PARAMS)
    assert first.length == pytest.approx(second.length, abs=1e-6)  # the tolerance of the search
    assert first.standard_deviation == pytest.approx(second.standard_deviation, rel=1e-4)


def test_frames_that_are_missing_or_jitter_cost_little() -> None:
    window, rng = raw(flown()), np.random.default_rng(2)
    kept = np.sort(rng.choice(len(window.time), size=len(window.time) * 4 // 5, replace=False))
    names = ("time", "vehicle", "pendulum", "attitude")
    thinned = replace(window, **{name: getattr(window, name)[kept] for name in names})
    full, fewer = maximum_likelihood(window, PARAMS), maximum_likelihood(thinned, PARAMS)
    # a fifth of the frames lost: the rest differ by sqrt(1/0.8 - 1) = half a deviation; four of those
    assert abs(full.length - fewer.length) < 2 * full.standard_deviation
    assert fewer.standard_deviation == pytest.approx(full.standard_deviation * math.sqrt(1 / 0.8), rel=0.15)


def test_a_still_hover_is_refused_for_want_of_information() -> None:
    """Without noise nothing moves. With it the controller answers the noise, and that excites: 2.5 s then suffice."""
    still = flown("hover", simulation__position_noise=0.0, simulation__attitude_noise=0.0, simulation__initial_lean=0.0)
    answer = maximum_likelihood(raw(still, after=2.0), PARAMS)
    assert math.isnan(answer.length) and "too little information" in answer.reason
    restless = flown("hover")
    answer = maximum_likelihood(raw(restless, after=2.0), PARAMS)
    assert answer.reason is None and 0.003 < answer.standard_deviation < 0.03
    assert abs(answer.length - 1.0) < 4 * answer.standard_deviation


def test_a_window_is_refused_when_its_bound_says_so() -> None:
    flight = flown("hover")
    window = raw(flight, after=2.0, seconds=0.25)
    end = flight.start_ns + round(2.25 * NANO)
    bound = cramer_rao(motion(flight, end - NANO // 4, end), flight.params)[-1]
    assert bound > 1.2 * LARGEST_SPREAD, "nobody could say more"
    answer = maximum_likelihood(window, flight.params)
    assert answer.reason is not None and math.isnan(answer.length)


def test_a_push_on_the_rod_is_refused_as_unexplained() -> None:
    answer = maximum_likelihood(raw(flown("hover"), after=4.5), PARAMS)
    assert "the model does not explain the window" in answer.reason and math.isnan(answer.length)


def test_a_length_beyond_the_interval_is_refused() -> None:
    short = PARAMS.replace(estimation__length_max=0.8)
    assert "an end of the interval from 0.2 to 0.8 m" in maximum_likelihood(raw(flown()), short).reason


def test_errors_name_what_is_wrong() -> None:
    with pytest.raises(ValueError, match="unknown nuisance wind; there are calibration, inertia_factor, rate_lag"):
        maximum_likelihood(raw(flown()), PARAMS, nuisances=("wind",))
    window = raw(flown())
    few = replace(window, **{name: getattr(window, name)[:15] for name in ("time", "vehicle", "pendulum", "attitude")})
    with pytest.raises(ValueError, match="at least 16 frames, got 15"):
        maximum_likelihood(few, PARAMS)
    still = replace(PARAMS, estimation=replace(PARAMS.estimation, process_noise=(0.0,) * 10))
    with pytest.raises(ValueError, match="moving_horizon needs process noise"):
        ESTIMATORS["moving_horizon"].function(simulated_window(1.0, np.random.default_rng(0), PARAMS.estimation), still)
    with pytest.raises(BagError, match="command"):
        replay.raw_windows(replace(flown(), command=None), 2.5, 2.5)


def test_raw_windows_follow_each_other_at_the_asked_period() -> None:
    flight = flown()
    found = replay.raw_windows(flight, 1.0, 0.5)
    stamps = np.array([stamp for stamp, _ in found])
    np.testing.assert_allclose(np.diff(stamps) / NANO, 0.5, atol=1e-3)
    for stamp, window in found:
        assert window.time[-1] == pytest.approx(1.0, abs=0.5 / 240)
        assert window.command_time[0] < 0 and window.command_time[-1] <= window.time[-1] + 0.01
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
    cheap = {name: ESTIMATORS[name] for name in ("ekf", "maximum_likelihood", "maximum_likelihood_free")}
    monkeypatch.setattr(study, "ESTIMATORS", cheap)
    monkeypatch.setattr(study, "DURATION", 11.2)
    cases = study.cases()
    assert len({tuple(case[key] for key in study.KEYS) for case in cases}) == len(cases) == 90
    row = study.run(cases[0])
    assert row == study.run(cases[0])
    for name in cheap:
        assert row[f"n_{name}"] >= 1 and 0 < row[f"bound_{name}"] < 0.01
