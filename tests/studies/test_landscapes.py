"""Why the posterior residual rewards gain, in numbers; and the study of the landscapes."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from fiplib import ga, kalman
from fiplib.dynamics import axis_matrices, jacobians, prediction_model, rk4
from fiplib.kalman import Window
from fiplib.params import A_DOT, AXES, B_DOT, GRAVITY, A, B, Estimation, Params
from fiplib.studies import landscapes as study

STEP = 0.1
SAMPLES = 55
UNIT = replace(Estimation(), fitness="rk4_likelihood", process_noise=(1.0,) * 10, measurement_noise=(1.0,) * 10)
# Fixed here, whatever the defaults are tuned to
CALIBRATED = replace(
    Estimation(),
    process_noise=(1e-7, 6e-5) * 4 + (1e-4, 1e-4),
    measurement_noise=(4e-8, 5e-4, 4e-8, 5e-4, 8e-8, 1e-3, 8e-8, 1e-3, 1e-6, 1e-6),
)
COARSE = np.linspace(0.2, 2.0, 91)
OFFSETS, VELOCITIES = [A, B], [A_DOT, B_DOT]
CIRCLE = "circle 0.4 m / 8 s"


def noise_window(seed: int, estimation: Estimation) -> Window:
    """Measurement noise and nothing else: no motion, no input, nothing that depends on a length."""
    noise = np.random.default_rng(seed).standard_normal((SAMPLES, 10))
    return Window(np.sqrt(estimation.measurement_noise) * noise, np.zeros((SAMPLES, 2)), STEP)


def model_window(length: float, seed: int, estimation: Estimation) -> Window:
    """Data of the filter's own model with exactly the noise that the filter is told, kept up by state feedback."""
    f, b = (np.array(m) for m in jacobians(rk4(prediction_model(), STEP))(np.zeros(10), np.zeros(2), length))
    cost = solve_discrete_are(f, b, np.eye(10), np.eye(2))
    feedback = np.linalg.solve(np.eye(2) + b.T @ cost @ b, b.T @ cost @ f)
    rng = np.random.default_rng(seed)
    states, inputs, x = np.zeros((SAMPLES, 10)), np.zeros((SAMPLES, 2)), np.zeros(10)
    for k in range(SAMPLES):
        states[k] = x + np.sqrt(estimation.measurement_noise) * rng.standard_normal(10)
        inputs[k] = -feedback @ states[k]
        x = f @ x + b @ inputs[k] + np.sqrt(estimation.process_noise) * rng.standard_normal(10)
    return Window(states, inputs, STEP)


def best_lengths(windows: list[Window], estimation: Estimation, reading: str) -> NDArray:
    told = replace(estimation, fitness=reading)
    return np.array([COARSE[kalman.fitness(COARSE, window, told).argmin()] for window in windows])


# --- the argument


@pytest.mark.parametrize("length", [0.2, 1.0])
def test_the_posterior_residual_is_the_innovation_times_r_over_s(length: float) -> None:
    # A textbook filter with K = P S^-1 and the update of the state, against x - x+ = R S^-1 y
    window = model_window(1.0, 1, UNIT)
    a, b = (np.array(m) for m in jacobians(prediction_model())(np.zeros(10), np.zeros(2), length))
    q, r = np.eye(10), np.eye(10)
    x, p, total = window.states[0], r, 0.0
    for k in range(1, SAMPLES):
        x = x + STEP * (a @ x + b @ window.inputs[k - 1])
        p = a @ p @ a.T + q
        y, s = window.states[k] - x, p + r
        gain = p @ np.linalg.inv(s)
        x, p = x + gain @ y, (np.eye(10) - gain) @ p
        residual = window.states[k] - x
        np.testing.assert_allclose(residual, r @ np.linalg.solve(s, y), atol=1e-10)  # rounding, of residuals near 1
        total += residual @ residual
    told = replace(UNIT, fitness="printed_posterior")
    # rounding: cond(S) is about 1e4 for the shorter length
    np.testing.assert_allclose(kalman.fitness([length], window, told), total, rtol=1e-10)


@pytest.mark.parametrize("printed", [True, False])
def test_completing_the_square_leaves_the_length_in_a_single_vector(printed: bool) -> None:
    # S = s^2 h h' + T and y = eta - beta a h, with h = kappa e + J0 P c / s^2: T and eta do not know the length
    rng = np.random.default_rng(3)
    root = rng.standard_normal((5, 5))
    covariance, noise = root @ root.T, np.diag(rng.uniform(0.5, 2.0, 5))
    posterior, measured = rng.standard_normal(5), rng.standard_normal(5)
    offset, row = np.eye(5)[2], np.eye(5)[3]
    rests = []
    for length in (0.3, 1.7):
        a, _ = axis_matrices(length)
        f = np.eye(5) + STEP * a
        j, kappa, beta = (a, 2 * GRAVITY / length, STEP) if printed else (f, 2 * GRAVITY / length * STEP, 1.0)
        j_0 = j - kappa * np.outer(row, offset)
        variance = offset @ covariance @ offset
        h = kappa * row + j_0 @ covariance @ offset / variance
        s, y = j @ covariance @ j.T + noise, measured - f @ posterior
        rests.append((s - variance * np.outer(h, h), y + beta * (offset @ posterior) * h))
        assert np.linalg.eigvalsh(rests[-1][0] - noise).min() > -1e-9  # T >= Q + R, up to rounding
    for short, long in zip(*rests, strict=True):
        np.testing.assert_allclose(short, long, atol=1e-9)  # rounding, of entries up to 1e4


@pytest.mark.parametrize("estimation", [UNIT, CALIBRATED], ids=["unit", "calibrated"])
@pytest.mark.parametrize("transition", ["printed", "euler"])
def test_towards_a_short_length_the_residual_goes_blind_where_the_length_acts(
    transition: str, estimation: Estimation
) -> None:
    told = replace(estimation, fitness=f"{transition}_likelihood")
    window, lengths = noise_window(5, estimation), np.array([1e-3, 1e-4, 1e-5])
    filtered = kalman.filter_window(lengths, window, told)
    residual = window.states[1:] - filtered.posteriors
    blind = np.linalg.norm(residual[:, :, VELOCITIES], axis=(1, 2))
    # in proportion to l, with corrections of relative size 1/kappa
    np.testing.assert_allclose(blind[:-1] / blind[1:], 10.0, rtol=0.02)
    rest = np.linalg.norm(np.delete(residual, VELOCITIES, axis=2), axis=(1, 2))
    np.testing.assert_allclose(rest, rest[-1], rtol=0.002)  # the same corrections
    assert blind[0] < 0.1 * rest[0]
    # The innovation itself grows as 1/l, what the likelihood makes of it does not, and log det S grows as -2 log l
    squared = (filtered.innovations**2).sum(axis=(1, 2))
    np.testing.assert_allclose(squared[1:] / squared[:-1], 100.0, rtol=0.02)
    np.testing.assert_allclose(filtered.nis.sum(axis=1), filtered.nis[-1].sum(), rtol=0.01)
    charge = np.diff(np.linalg.slogdet(filtered.covariances)[1].mean(axis=1)) / len(AXES)
    np.testing.assert_allclose(charge, 2 * np.log(10.0), rtol=0.002)


def test_with_runge_kutta_two_rows_go_blind_and_the_charge_is_higher() -> None:
    # Its fourth order brings l^-2 into the columns of the offset and of its rate. The textbook's (I - K) P would lose
    # all digits at such lengths; P+ = R - R S^-1 R and x+ = z - R S^-1 y, with R = I here, do not
    window, lengths = noise_window(5, UNIT), (1e-4, 1e-5)
    residuals, log_determinants = np.empty((2, SAMPLES - 1, 10)), np.zeros(2)
    for i, length in enumerate(lengths):
        model, x, p = kalman.linear_model(length, STEP, "rk4"), window.states[0], np.eye(10)
        for k in range(SAMPLES - 1):
            s = model.jacobian @ p @ model.jacobian.T + 2 * np.eye(10)
            y = window.states[k + 1] - model.transition @ x - model.input_matrix @ window.inputs[k]
            residuals[i, k] = np.linalg.solve(s, y)
            x, p = window.states[k + 1] - residuals[i, k], np.eye(10) - np.linalg.inv(s)
            log_determinants[i] += np.linalg.slogdet(s)[1] / (SAMPLES - 1)
    for blind in (residuals[:, :, OFFSETS], residuals[:, :, VELOCITIES]):
        norm = np.linalg.norm(blind, axis=(1, 2))
        assert norm[0] / norm[1] == pytest.approx(100.0, rel=0.02)  # in proportion to l^2, to first order
    # two directions, each as l^-4
    assert np.diff(log_determinants) / len(AXES) == pytest.approx(8 * np.log(10.0), rel=0.002)


@pytest.mark.parametrize("transition", ["printed", "euler", "rk4"])
def test_from_pure_noise_the_posterior_residual_rises_all_the_way_from_the_shortest_length(transition: str) -> None:
    told = replace(UNIT, fitness=f"{transition}_posterior")
    for seed in range(6):
        assert (np.diff(kalman.fitness(COARSE, noise_window(seed, UNIT), told)) > 0).all()


@pytest.mark.parametrize("reading", [name for name in study.READINGS if "posterior" not in name])
def test_from_pure_noise_the_other_readings_do_not_take_the_shortest_length(reading: str) -> None:
    # They take the longest: noise does not grow as an unstable model says it should
    best = best_lengths([noise_window(seed, UNIT) for seed in range(6)], UNIT, reading)
    assert (best == COARSE[-1]).all()


def test_told_the_true_noise_the_likelihood_finds_the_length_and_the_printed_formula_the_shortest() -> None:
    windows = [model_window(1.0, seed, UNIT) for seed in range(16)]
    assert (best_lengths(windows, UNIT, "printed_posterior") == COARSE[0]).all()
    found = best_lengths(windows, UNIT, "rk4_likelihood")
    # 3 standard errors of the mean, and a bias of second order that shrinks with the window
    assert abs(found.mean() - 1.0) < 3 * found.std(ddof=1) / np.sqrt(len(found)) + 0.05
    assert found.std(ddof=1) < 0.2  # there is something to find: 1.8 m wide, all lengths alike would give 0.5 m


def test_the_reward_is_large_with_unit_matrices_and_small_with_calibrated_ones() -> None:
    # rho_l = kappa^2 sigma^2 / (q + r) of the printed Jacobian, with the variance of the offset after the last update
    lengths = np.array([0.2, 1.0, 2.0])
    rewards = []
    for estimation in (UNIT, CALIBRATED):
        told = replace(estimation, fitness="printed_likelihood")
        covariances = kalman.filter_window(lengths, model_window(1.0, 0, told), told).covariances
        information = np.linalg.inv(covariances[:, -1])[:, A, A]
        r, q_rate, r_rate = told.measurement_noise[A], told.process_noise[A_DOT], told.measurement_noise[A_DOT]
        variance = r - r * information * r
        assert (variance <= r).all()
        rewards.append((2 * GRAVITY / lengths) ** 2 * variance / (q_rate + r_rate))
    unit, calibrated = rewards
    assert (unit > 1).all() and unit[0] > 1000
    assert calibrated[1] < 0.05 and 0.5 < calibrated[0] < 1


def test_the_printed_covariance_does_not_correct_the_rate_from_the_offset_and_a_consistent_one_does() -> None:
    for transition, low, high in (("printed", 0.0, 0.01), ("euler", 0.5, 1.0), ("rk4", 0.5, 1.0)):
        told = replace(CALIBRATED, fitness=f"{transition}_likelihood")
        covariances = kalman.filter_window(1.0, model_window(1.0, 0, told), told).covariances
        information = np.linalg.inv(covariances[-1])
        # K = I - R S^-1, its row of the rate and column of the offset; 1 / step would be to differentiate the offset
        gain = -told.measurement_noise[A_DOT] * information[A_DOT, A]
        assert low <= abs(gain) * STEP <= high


@pytest.mark.parametrize("score", ["posterior", "prior"])
def test_a_residual_sees_the_ratio_of_the_noise_covariances_only(score: str) -> None:
    window = model_window(1.0, 2, CALIBRATED)
    for transition in ("printed", "euler", "rk4"):
        told = replace(CALIBRATED, fitness=f"{transition}_{score}")
        louder = replace(
            told,
            process_noise=tuple(100 * variance for variance in told.process_noise),
            measurement_noise=tuple(100 * variance for variance in told.measurement_noise),
        )
        first, second = (kalman.fitness(COARSE, window, estimation) for estimation in (told, louder))
        np.testing.assert_allclose(first, second, rtol=1e-9)  # rounding


def test_the_share_that_is_kept_is_that_of_a_full_filter() -> None:
    window = model_window(1.0, 2, CALIBRATED)
    told = replace(CALIBRATED, fitness="printed_posterior", measurement_noise=tuple(np.linspace(1e-4, 1e-3, 10)))
    covariances = kalman.filter_window(COARSE[[0, 40]], window, told).covariances
    shares = np.linalg.inv(covariances)[..., VELOCITIES, VELOCITIES] * np.array(told.measurement_noise)[VELOCITIES]
    kept = study.acceleration_kept(COARSE[[0, 40]], window, told)
    np.testing.assert_allclose(kept, shares.mean(axis=(1, 2)), rtol=1e-9)  # rounding
    assert 0 < kept[0] < kept[1] < 1


# --- flights


@pytest.fixture(scope="module", autouse=True)
def one_flight_for_each_excitation() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study, "SEEDS", (1,))
        yield


@pytest.fixture(scope="module")
def best_in_flight() -> Callable[..., NDArray]:
    """Best lengths, to 1 cm, on the windows of the study at the default setting with some factors changed."""

    def best(reading: str, **changes: str) -> NDArray:
        params = study.params_of({**study.DEFAULT, "reading": reading, **changes})
        windows = study.windows_of(changes.get("excitation", CIRCLE), params)
        estimation = replace(params.estimation, resolution=0.01)
        lengths, fitness = study.landscapes(windows, estimation)
        return lengths[fitness.argmin(axis=1)]

    return best


def test_on_the_circle_unit_matrices_send_every_consistent_reading_to_an_end(best_in_flight: Callable) -> None:
    for transition in ("euler", "rk4"):
        # to 3 cm: near the end the posterior residual is flat to a few parts in a thousand
        assert (best_in_flight(f"{transition}_posterior", noise="identity") <= 0.23).all()
        assert (best_in_flight(f"{transition}_likelihood", noise="identity") == 2.0).all()
    # the printed form stays a little above the end, far below the truth
    assert np.median(best_in_flight("printed_posterior", noise="identity")) < 0.6


def test_on_the_circle_calibrated_covariances_mend_the_printed_formula(best_in_flight: Callable) -> None:
    # 5 cm: one standard deviation by the curvature of the likelihood, three by the scatter of its windows
    np.testing.assert_allclose(best_in_flight("printed_posterior"), 1.0, atol=0.05)
    np.testing.assert_allclose(best_in_flight("rk4_likelihood"), 1.0, atol=0.05)


def test_in_a_still_hover_the_printed_formula_takes_the_shortest_length_in_every_window(
    best_in_flight: Callable,
) -> None:
    assert (best_in_flight("printed_posterior", excitation="hover") == 0.2).all()
    assert (best_in_flight("rk4_likelihood", excitation="hover") > 0.5).all()


# --- the study


def test_cases_vary_one_factor_at_a_time_and_read_each_setting_in_every_way() -> None:
    cases = study.cases()
    assert len({tuple(case[key] for key in study.KEYS) for case in cases}) == len(cases) == 17 * 9
    for case in cases:
        assert set(case) == set(study.KEYS)
        changed = [key for key, value in study.DEFAULT.items() if case[key] != value]
        assert changed == ([] if case["factor"] == "none" else [case["factor"]])
    assert len({kalman.READINGS[name] for name in study.READINGS}) == len(set(kalman.READINGS.values())) == 9


def test_params_of_a_case_are_the_defaults_but_for_what_the_case_says() -> None:
    case = {**study.DEFAULT, "reading": Params().estimation.fitness}
    assert study.params_of(case) == Params()
    faster = study.params_of({**case, "rate": 40}).estimation
    # a quarter of the period adds a quarter of the variance
    np.testing.assert_allclose(np.array(faster.process_noise) * 4, Params().estimation.process_noise, rtol=1e-12)
    assert study.params_of({**case, "noise": "identity"}).estimation.measurement_noise == (1.0,) * 10
    assert study.params_of({**case, "rod": "point mass"}).pendulum.inertia_factor == 1.0


def test_windows_end_where_they_should_and_share_no_sample() -> None:
    params = Params()
    windows = study.windows_of(CIRCLE, params)
    assert len(windows) == len(study.SEEDS) * len(study.ENDS)
    assert all(window.states.shape == (params.estimation.window, 10) for window in windows)
    rows = np.concatenate([window.states for window in windows])
    assert len(np.unique(rows, axis=0)) == len(rows)


def test_the_landscapes_of_many_windows_are_those_of_one_at_a_time() -> None:
    params = study.params_of({**study.DEFAULT, "reading": "printed_posterior", "samples": 14})
    params = params.replace(estimation__resolution=1e-3)  # two chunks of candidates
    windows = study.windows_of(CIRCLE, params)[:2]
    lengths, fitness = study.landscapes(windows, params.estimation)
    for window, row in zip(windows, fitness, strict=True):
        alone = ga.landscape(window, params)
        assert (alone.lengths == lengths).all() and (alone.fitness == row).all()


def test_the_summary_of_parabolas_is_known() -> None:
    lengths = np.round(np.linspace(0.2, 2.0, 18001), 12)
    centres = np.array([0.9, 1.0, 1.4])
    likelihood = ((lengths - centres[:, None]) / 0.05) ** 2 - 7.0
    result = study.summary(lengths, likelihood, 1.0, True)
    assert result["bias"] == pytest.approx(0.1) and result["spread"] == pytest.approx(np.std(centres, ddof=1))
    assert result["curvature_sd"] == pytest.approx(0.05)
    assert result["width"] == pytest.approx(0.05, abs=1.1e-4)  # a candidate at either edge
    assert result["at_min"] == result["at_max"] == 0.0
    # (1 + (error / 0.05)^2) rises by 1 % at 5 mm
    result = study.summary(lengths, likelihood + 8.0, 1.0, False)
    assert result["width"] == pytest.approx(0.005, abs=1.1e-4) and np.isnan(result["curvature_sd"])


def test_the_summary_of_slopes_says_at_which_end_they_stop() -> None:
    lengths = np.linspace(0.2, 2.0, 1801)
    result = study.summary(lengths, np.array([lengths, -lengths, -lengths, -lengths]) * 1e3, 1.0, True)
    assert (result["at_min"], result["at_max"]) == (0.25, 0.75)
    assert np.isnan(result["curvature_sd"])
    assert result["width"] == pytest.approx(0.0005)  # 1 mm of slope, one half
    assert study.summary(lengths, np.array([lengths, lengths]), 1.0, True)["spread"] == 0.0


def test_a_case_runs_over_all_lengths_and_its_row_says_what_the_windows_said() -> None:
    case = next(c for c in study.cases() if c["samples"] == 14 and c["reading"] == "rk4_likelihood")
    row = study.run(case)
    assert row["windows"] == 3 and row["at_min"] == row["at_max"] == 0.0
    # 1.4 s of the circle hold the length to about 0.1 m (their curvature); 2 standard errors of the mean of three
    assert abs(row["bias"]) < 0.1 and 0.05 < row["curvature_sd"] < 0.2
    assert row["width"] == pytest.approx(row["curvature_sd"], rel=0.1)  # nearly a parabola
    assert 0 < row["kept_at_min"] < row["kept_at_truth"] < 1


# --- the curves of the figure


def test_curves_start_from_zero_and_their_median_is_one() -> None:
    cases = study.Curves.cases()
    assert len({tuple(case[key] for key in study.Curves.KEYS) for case in cases}) == len(cases) == 9 * 2 * 181
    for noise in study.CURVE_NOISES:
        rows = [
            study.Curves.run(case)
            for case in cases
            if case["noise"] == noise and case["reading"] == "printed_posterior"
        ]
        curve = np.array([row["normalised"] for row in rows])
        assert curve.min() == 0.0 and np.median(curve) == 1.0
        fitness = np.array([row["fitness"] for row in rows])
        assert np.argmin(fitness) == np.argmin(curve) and fitness.min() > 0.0
