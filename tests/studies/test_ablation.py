"""The ablation of data, model and search."""

import numpy as np
import pytest

from fiplib import kalman
from fiplib.dynamics import jacobians, prediction_model
from fiplib.estimators.poses.knowledge import Told
from fiplib.kalman import LinearModel, filter_step
from fiplib.params import A_DOT, B_DOT, PHI, THETA, A, B, Params
from fiplib.studies import ablation as study
from tests.test_kalman import simulated_window

ESTIMATION = Params().estimation
LENGTHS = np.array([0.7, 1.0, 1.3])


def likelihood(length: float, factor: float, window: kalman.Window) -> float:
    """-2 log L by the textbook's filter, lambda in the matrices of the model."""
    a, b = (matrix.full() for matrix in jacobians(prediction_model())(0, 0, length))
    for state, rate, tilt in ((A, A_DOT, THETA), (B, B_DOT, PHI)):
        a[rate, state] *= factor
        a[rate, tilt] *= factor
    f, g = np.eye(10), np.zeros((10, 10))
    for order in range(4, 0, -1):  # the series of RK4: I + h A (I + h A / 2 (I + h A / 3 (I + h A / 4)))
        g = window.step / order * (np.eye(10) + a @ g)
    f, held = np.eye(10) + a @ g, g @ b
    q, r = np.diag(ESTIMATION.process_noise), np.diag(ESTIMATION.measurement_noise)
    x, p, total = window.states[0], r, 0.0
    for k in range(len(window.states) - 1):
        x, p, y, s = filter_step(x, p, window.inputs[k], window.states[k + 1], LinearModel(f, held, f), q, r)
        total += y @ np.linalg.solve(s, y) + np.linalg.slogdet(s)[1]
    return float(total)


def window() -> kalman.Window:
    return simulated_window(1.0, np.random.default_rng(4), ESTIMATION)


def test_the_paper_s_model_is_the_fitness_of_the_paper():
    fitness = study.derived_fitness(window(), ESTIMATION, Told(1.0, 1e-4))
    np.testing.assert_allclose(fitness(LENGTHS), kalman.fitness(LENGTHS, window(), ESTIMATION), rtol=1e-12)


def test_another_inertia_is_a_change_of_units():
    known = study.derived_fitness(window(), ESTIMATION, Told(0.75, 1e-4))(LENGTHS)
    expected = [likelihood(length, 0.75, window()) for length in LENGTHS]
    np.testing.assert_allclose(known, expected, rtol=1e-9)
    # and the helper above is the paper's model where lambda is 1
    np.testing.assert_allclose(
        likelihood(1.0, 1.0, window()), kalman.fitness([1.0], window(), ESTIMATION)[0], rtol=1e-9
    )


def test_an_inertia_with_a_tolerance_is_at_its_most_likely_value():
    told = Told(0.75, 0.05)
    profile = study.derived_fitness(window(), ESTIMATION, told)(LENGTHS)
    factors = np.linspace(0.63, 0.87, 241)
    for length, value in zip(LENGTHS, profile, strict=True):
        values = [
            study.derived_fitness(window(), ESTIMATION, Told(float(one), 1e-4))(np.array([length]))[0]
            + ((one - told.value) / told.tolerance) ** 2
            for one in factors
        ]
        assert value == pytest.approx(min(values), abs=0.1)  # a tenth of what one standard deviation is worth


def row(length: float, error: float, **more: float) -> dict:
    made = {"true_length": length, "seed": 0, "survived": 1}
    for data, model, search in study.ARMS:
        made |= {f"prepare_ms_{data}_{model}": 10.0, f"ms_{data}_{model}_{search}": 1.0}
        made |= {f"length_{data}_{model}_{search}": length * (1 + error), f"sd_{data}_{model}_{search}": 0.01}
    return made | more


def test_the_table_has_every_combination_with_intervals():
    rows = [row(length, error) for length in study.RODS for error in (-0.01, 0.0, 0.01)]
    table = study.table16_ablation(rows)
    assert len(table.rows) == len(study.ARMS) == 12
    bias, rmse, covered, cost = table.rows[0][3:]
    assert "0.00 (" in bias and rmse.startswith("0.82 (") and cost == "11"
    assert covered.startswith("100 (66 to 100")  # nine of nine: 0.025^(1/9)
    found = study.judged(rows, "poses", "point", "ga")
    assert found.rms[1] < found.rms[0] < found.rms[2] and found.covered[0] == 1.0
    silent = [row(1.0, 0.0, sd_poses_point_ga=float("nan"))]
    assert study.judged(silent, "poses", "point", "ga").covered[0] == 0.0


def test_a_case_answers_in_every_way():
    made = study.run({"true_length": 1.0, "seed": 0})
    assert made["survived"] == 1
    for data, model, search in study.ARMS:
        assert 0.7 < made[f"length_{data}_{model}_{search}"] < 1.4
        assert made[f"length_{data}_{model}_{search}"] == pytest.approx(made[f"length_{data}_{model}_grid"], abs=0.01)
    assert abs(made["length_poses_tolerance_grid"] - 1.0) < 4 * made["sd_poses_tolerance_grid"] < 0.03
