"""The filter against filterpy, against the statistics it promises, and against bad input."""

from dataclasses import replace

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from fiplib import kalman
from fiplib.dynamics import jacobians, prediction_model, rk4
from fiplib.kalman import READINGS, Window
from fiplib.kernels.model import discretise
from fiplib.params import AXES, Estimation

STEP = 0.1
LENGTHS = np.array([0.2, 0.5, 1.0, 1.4, 2.0])
# Fixed here, whatever the defaults are tuned to
EQUAL = Estimation(
    fitness="rk4_likelihood",
    process_noise=(1e-6, 1e-3, 1e-6, 1e-3, 1e-6, 1e-3, 1e-6, 1e-3, 1e-5, 1e-5),
    measurement_noise=(1e-6, 4e-4, 1e-6, 4e-4, 1e-6, 4e-4, 1e-6, 4e-4, 1e-5, 1e-5),
)
UNEQUAL = replace(
    EQUAL,
    process_noise=(1e-6, 1e-3, 3e-6, 2e-3, 2e-6, 1e-3, 1e-6, 4e-3, 1e-5, 3e-5),
    measurement_noise=(1e-6, 4e-4, 2e-6, 1e-4, 3e-6, 4e-4, 1e-6, 5e-4, 2e-5, 1e-5),
)
IDENTITY = replace(EQUAL, process_noise=(1.0,) * 10, measurement_noise=(1.0,) * 10)


def full_model(length: float, transition: str) -> tuple[NDArray, NDArray, NDArray]:
    """F, B and J of the ten states together, from CasADi's derivatives of the prediction model."""
    f = prediction_model()
    a, b = (np.array(value) for value in jacobians(f)(np.zeros(10), np.zeros(2), length))
    if transition == "rk4":
        f_d, b_d = (np.array(value) for value in jacobians(rk4(f, STEP))(np.zeros(10), np.zeros(2), length))
        return f_d, b_d, f_d
    euler = np.eye(10) + STEP * a
    return euler, STEP * b, a if transition == "printed" else euler


def simulated_window(length: float, rng: np.random.Generator, estimation: Estimation, samples: int = 55) -> Window:
    """A 0.4 m circle flown by the linear model itself, with exactly the noise that ``estimation`` speaks of."""
    f, b, _ = full_model(length, "rk4")
    weights = np.diag([20.0, 5.0, 20.0, 5.0, 1000.0, 50.0, 1000.0, 50.0, 1.0, 1.0])
    cost = solve_discrete_are(f, b, weights, 0.5 * np.eye(2))
    feedback = np.linalg.solve(0.5 * np.eye(2) + b.T @ cost @ b, b.T @ cost @ f)
    speed = 2 * np.pi / 8.0
    states, inputs = np.zeros((samples, 10)), np.zeros((samples, 2))
    x = np.array([0.4, 0.0, 0.0, 0.4 * speed, 0, 0, 0, 0, 0, 0])
    for k, angle in enumerate(speed * STEP * np.arange(samples)):
        reference = np.zeros(10)
        reference[:4] = 0.4 * np.array([np.cos(angle), -speed * np.sin(angle), np.sin(angle), speed * np.cos(angle)])
        states[k] = x + np.sqrt(estimation.measurement_noise) * rng.standard_normal(10)
        inputs[k] = -feedback @ (x - reference)
        x = f @ x + b @ inputs[k] + np.sqrt(estimation.process_noise) * rng.standard_normal(10)
    return Window(states, inputs, STEP)


def filterpy_run(length: float, window: Window, estimation: Estimation) -> dict[str, NDArray]:
    """Innovations, S and posteriors of filterpy's ten-state filter, one sample after the other."""
    f, b, j = full_model(length, READINGS[estimation.fitness].transition)
    judge = KalmanFilter(dim_x=10, dim_z=10, dim_u=2)
    judge.x, judge.H = window.states[0].copy(), np.eye(10)
    judge.R, judge.Q = np.diag(estimation.measurement_noise), np.diag(estimation.process_noise)
    judge.P = judge.R.copy()
    rows = {"innovations": [], "covariances": [], "posteriors": []}
    for k in range(1, len(window.states)):
        predicted = f @ judge.x + b @ window.inputs[k - 1]
        judge.predict(F=j)
        judge.x = predicted
        judge.update(window.states[k])
        for key, value in zip(rows, (judge.y, judge.S, judge.x), strict=True):
            rows[key].append(np.array(value))
    return {key: np.array(value) for key, value in rows.items()}


def filterpy_fitness(length: float, window: Window, estimation: Estimation) -> float:
    run = filterpy_run(length, window, estimation)
    match READINGS[estimation.fitness].score:
        case "posterior":
            return np.sum((window.states[1:] - run["posteriors"]) ** 2)
        case "prior":
            return np.sum(run["innovations"] ** 2)
        case "likelihood":
            weighted = np.linalg.solve(run["covariances"], run["innovations"][..., None])[..., 0]
            return np.sum(run["innovations"] * weighted) + np.linalg.slogdet(run["covariances"])[1].sum()


def assert_close(value: NDArray, expected: NDArray) -> None:
    # 1e-9 absolute below 1, relative above: -2 log L is some 1e3 and grows past 1e6 at short lengths, where 1e-9
    # absolute would ask for more digits than a double has
    np.testing.assert_allclose(value, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("noise", [EQUAL, UNEQUAL, IDENTITY], ids=["equal axes", "unequal axes", "identity"])
@pytest.mark.parametrize("name", READINGS)
def test_fitness_agrees_with_filterpy(name: str, noise: Estimation) -> None:
    estimation = replace(noise, fitness=name)
    window = simulated_window(1.0, np.random.default_rng(1), EQUAL)
    expected = [filterpy_fitness(length, window, estimation) for length in LENGTHS]
    assert_close(kalman.fitness(LENGTHS, window, estimation), np.array(expected))


@pytest.mark.parametrize("noise", [EQUAL, UNEQUAL], ids=["equal axes", "unequal axes"])
@pytest.mark.parametrize("name", ["paper", "euler_prior", "rk4_likelihood"])
def test_innovations_covariances_and_posteriors_agree_with_filterpy(name: str, noise: Estimation) -> None:
    estimation = replace(noise, fitness=name)
    window = simulated_window(1.0, np.random.default_rng(2), EQUAL)
    ours = kalman.filter_window(LENGTHS, window, estimation)
    for i, length in enumerate(LENGTHS):
        expected = filterpy_run(length, window, estimation)
        for key, value in expected.items():
            assert_close(getattr(ours, key)[i], value)
        y, s = expected["innovations"], expected["covariances"]
        assert_close(ours.nis[i], np.einsum("ki,ki->k", y, np.linalg.solve(s, y[..., None])[..., 0]))


def test_random_noise_models_agree_with_filterpy_too() -> None:
    rng = np.random.default_rng(3)
    window = simulated_window(0.7, rng, EQUAL)
    for name in READINGS:
        # Six decades between the variances, far from any tuning
        process, measured = (tuple(10.0 ** rng.uniform(-7, -1, 10)) for _ in range(2))
        estimation = Estimation(fitness=name, process_noise=process, measurement_noise=measured)
        length = rng.uniform(0.2, 2.0)
        assert_close(kalman.fitness([length], window, estimation)[0], filterpy_fitness(length, window, estimation))


def test_paper_is_the_printed_formula() -> None:
    assert READINGS["paper"] == ("printed", "posterior")
    assert len(READINGS) == 10


@pytest.mark.parametrize("noise", [EQUAL, UNEQUAL], ids=["equal axes", "unequal axes"])
@pytest.mark.parametrize("name", ["paper", "euler_prior", "rk4_likelihood"])
def test_fitness_does_not_depend_on_the_batch_to_the_last_bit(name: str, noise: Estimation) -> None:
    rng = np.random.default_rng(4)
    estimation = replace(noise, fitness=name)
    window = simulated_window(1.0, rng, EQUAL)
    lengths = rng.uniform(0.2, 2.0, 501)
    whole = kalman.fitness(lengths, window, estimation)
    for size in (1, 2, 3, 7, 64):
        some = rng.permutation(len(lengths))[:size]
        assert np.array_equal(kalman.fitness(lengths[some], window, estimation), whole[some])
    assert np.array_equal(kalman.fitness(lengths[::2], window, estimation), whole[::2])


def textbook_fitness(length: float, window: Window, estimation: Estimation) -> float:
    """Eq. (26) and its variants, summed over the textbook's filter."""
    run = kalman.filter_window(length, window, estimation)
    match READINGS[estimation.fitness].score:
        case "posterior":
            return np.sum((window.states[1:] - run.posteriors) ** 2)
        case "prior":
            return np.sum(run.innovations**2)
        case "likelihood":
            return run.nis.sum() + np.linalg.slogdet(run.covariances)[1].sum()


DECADES = st.lists(st.floats(-7.0, -1.0), min_size=10, max_size=10)


@settings(max_examples=60)
@given(st.sampled_from(sorted(READINGS)), st.floats(0.2, 2.0), DECADES, DECADES, st.integers(0, 99), st.booleans())
def test_the_compiled_filter_is_the_textbook_filter(name, length, process, measured, seed, alike) -> None:
    if alike:  # the same noise on both axes, which then share their covariances
        pairs = [0, 1, 0, 1, 4, 5, 4, 5, 8, 8]
        process, measured = np.array(process)[pairs], np.array(measured)[pairs]
    estimation = Estimation(
        fitness=name,
        process_noise=tuple(10.0 ** np.array(process)),
        measurement_noise=tuple(10.0 ** np.array(measured)),
    )
    window = simulated_window(0.7, np.random.default_rng(seed), EQUAL, samples=20)
    # The two invert S, whose condition reaches 1e6 here, in different ways
    expected = textbook_fitness(length, window, estimation)
    np.testing.assert_allclose(kalman.fitness([length], window, estimation), [expected], rtol=1e-8, atol=1e-8)


def test_squared_innovations_are_chi_squared_at_the_true_length() -> None:
    rng = np.random.default_rng(6)
    nis = [kalman.filter_window(1.0, simulated_window(1.0, rng, UNEQUAL), UNEQUAL).nis for _ in range(20)]
    # Ten degrees of freedom: mean 10, variance 20; independent samples, so four standard errors of the mean
    assert np.mean(nis) == pytest.approx(10.0, abs=4 * np.sqrt(20 / np.size(nis)))


def test_the_first_innovation_is_the_one_step_error_of_the_first_measurement() -> None:
    window = simulated_window(1.0, np.random.default_rng(7), EQUAL)
    f = rk4(prediction_model(), STEP)
    predicted = np.array(f(window.states[0], window.inputs[0], 1.0)).ravel()
    first = kalman.filter_window(1.0, window, EQUAL).innovations[0]
    np.testing.assert_allclose(first, window.states[1] - predicted, atol=1e-14)  # rounding of values below 1


def test_the_last_input_is_not_used() -> None:
    window = simulated_window(1.0, np.random.default_rng(8), EQUAL)
    inputs = window.inputs.copy()
    inputs[-1] += 1.0
    changed = Window(window.states, inputs, STEP)
    assert kalman.fitness([1.0], changed, EQUAL) == kalman.fitness([1.0], window, EQUAL)


def test_filter_window_keeps_the_shape_of_the_lengths() -> None:
    window = simulated_window(1.0, np.random.default_rng(9), EQUAL, samples=12)
    one, many = (kalman.filter_window(length, window, EQUAL) for length in (1.0, np.full((2, 3), 1.0)))
    assert one.innovations.shape == (11, 10) and one.covariances.shape == (11, 10, 10) and one.nis.shape == (11,)
    assert many.posteriors.shape == (2, 3, 11, 10)
    assert np.array_equal(many.posteriors[1, 2], one.posteriors)


def test_two_samples_are_enough_and_one_is_refused() -> None:
    states = np.zeros((2, 10))
    assert np.isfinite(kalman.fitness([1.0], Window(states, np.zeros((2, 2)), STEP), EQUAL)).all()
    with pytest.raises(ValueError, match="at least 2 samples"):
        Window(states[:1], np.zeros((1, 2)), STEP)


def test_no_process_noise_is_a_valid_model() -> None:
    window = simulated_window(1.0, np.random.default_rng(10), EQUAL)
    estimation = replace(EQUAL, process_noise=(0.0,) * 10)
    assert_close(kalman.fitness([1.0], window, estimation)[0], filterpy_fitness(1.0, window, estimation))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", READINGS)
def test_overflow_gives_the_worst_fitness_without_a_warning(name: str) -> None:
    window = Window(np.full((5, 10), 1e200) * np.arange(5)[:, None], np.zeros((5, 2)), STEP)
    assert kalman.fitness([0.2, 1.0], window, Estimation(fitness=name)).tolist() == [np.inf, np.inf]


@pytest.mark.parametrize(
    ("states", "inputs", "step", "message"),
    [
        (np.zeros((5, 9)), np.zeros((5, 2)), STEP, r"states must have shape \(n, 10\)"),
        (np.zeros(10), np.zeros((5, 2)), STEP, r"states must have shape \(n, 10\)"),
        (np.zeros((5, 10)), np.zeros((5, 3)), STEP, r"inputs must have shape \(n, 2\)"),
        (np.zeros((5, 10)), np.zeros((4, 2)), STEP, "5 states but 4 inputs"),
        (np.full((5, 10), np.nan), np.zeros((5, 2)), STEP, "states hold values that are not finite"),
        (np.zeros((5, 10)), np.full((5, 2), np.inf), STEP, "inputs hold values that are not finite"),
        (np.zeros((5, 10)), np.zeros((5, 2)), 0.0, "step must be positive"),
        (np.zeros((5, 10)), np.zeros((5, 2)), np.nan, "step must be positive"),
    ],
)
def test_a_bad_window_is_refused(states: NDArray, inputs: NDArray, step: float, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Window(states, inputs, step)


@pytest.mark.parametrize(
    ("lengths", "changes", "message"),
    [
        ([1.0], {"fitness": "innovation"}, "unknown reading 'innovation'; readings are printed_posterior, .*paper"),
        ([1.0, 0.0], {}, "lengths must be positive"),
        ([-1.0], {}, "lengths must be positive"),
        ([np.nan], {}, "lengths must be positive"),
        ([[1.0]], {}, r"lengths must have shape \(C,\)"),
        ([1.0], {"measurement_noise": (1e-6,) * 9 + (0.0,)}, "measurement_noise must be finite and positive"),
        ([1.0], {"measurement_noise": (1e-6,) * 9}, "measurement_noise must hold 10"),
        ([1.0], {"process_noise": (1e-6,) * 9 + (-1e-6,)}, "process_noise must be finite and not negative"),
        ([1.0], {"process_noise": (np.inf,) * 10}, "process_noise must be finite"),
    ],
)
def test_bad_lengths_noise_and_readings_are_refused(lengths: list, changes: dict, message: str) -> None:
    window = Window(np.zeros((5, 10)), np.zeros((5, 2)), STEP)
    with pytest.raises(ValueError, match=message):
        kalman.fitness(lengths, window, replace(EQUAL, **changes))


def test_the_compiled_loops_discretise_as_casadi_does() -> None:
    f, b = np.empty((5, 5)), np.empty(5)
    rows = np.array(AXES[0].states)
    for length in LENGTHS:
        for order, transition in ((1, "euler"), (4, "rk4")):
            discretise(length, STEP, order, f, b)
            model = kalman.linear_model(length, STEP, transition)
            # rounding of a handful of products
            np.testing.assert_allclose(f, model.transition[np.ix_(rows, rows)], rtol=1e-13, atol=1e-15)
            np.testing.assert_allclose(b, model.input_matrix[rows, AXES[0].input], rtol=1e-13, atol=1e-15)


def test_a_window_of_read_only_arrays_gives_the_same_fitness() -> None:
    window = simulated_window(1.0, np.random.default_rng(5), EQUAL, samples=12)
    frozen = Window(np.asfortranarray(window.states), window.inputs, STEP)
    for array in (frozen.states, frozen.inputs):
        array.flags.writeable = False
    assert kalman.fitness([1.0], frozen, EQUAL) == kalman.fitness([1.0], window, EQUAL)
