"""The study of unprinted choices: its genetic algorithm against the library's, its landscapes, its posterior."""

import dataclasses

import numpy as np
import pytest

from fiplib import ga, kalman
from fiplib.estimators.handover import PrintedHandOver
from fiplib.kalman import Window
from fiplib.params import Params
from fiplib.recording import Flight, Series
from fiplib.reproduction import measures
from fiplib.studies import choices as study
from fiplib.studies import choices_runs as runs


@pytest.fixture(scope="module")
def windows() -> list[Window]:
    """A few windows with the motion of a rod of 1 m in them, and noise."""
    rng, found = np.random.default_rng(3), []
    for _ in range(4):
        states, inputs = np.zeros((55, 10)), rng.normal(size=(55, 2)) * 0.3
        model = kalman.linear_model(1.0, 0.1, "rk4")
        for k in range(54):  # the rod would fall: it is brought back a little at each step
            states[k + 1] = 0.9 * (model.transition @ states[k] + model.input_matrix @ inputs[k])
        found.append(Window(states + 1e-3 * rng.normal(size=states.shape), inputs, 0.1))
    return found


def landscapes(windows: list[Window], estimation) -> np.ndarray:
    return np.array([kalman.fitness(runs.lengths_of(estimation), window, estimation) for window in windows])


@pytest.mark.parametrize("fitness", ["printed_posterior", "rk4_prior", "rk4_likelihood"])
@pytest.mark.parametrize("noise", runs.NOISES)
def test_the_interpolated_landscape_is_the_fitness_of_every_length(windows, fitness, noise):
    params = runs.params_of("seat", fitness, noise, 60, 20)
    direct = ga.landscape(windows[0], params)
    between = runs.interpolation(ga.Chromosome.of(params.estimation))
    found = between.fitness(landscapes(windows[:1], params.estimation)[0])
    # far below what tells two lengths apart, a hundredth of the range
    assert np.abs(found - direct.fitness).max() < 1e-4 * np.ptp(direct.fitness)
    assert abs(direct.lengths[found.argmin()] - direct.best) < 1e-3


@pytest.mark.parametrize(("population", "generations"), [(60, 20), (12, 5), (7, 1)])
def test_the_compiled_genetic_algorithm_is_the_library_s(windows, population, generations):
    estimation = runs.params_of("seat", "rk4_likelihood", "calibrated", population, generations).estimation
    values, chromosome = landscapes(windows, estimation), ga.Chromosome.of(estimation)
    found = runs.chain(values, estimation, False, np.random.default_rng(5))
    rng, expected = np.random.default_rng(5), []
    for known in values:
        every = runs.interpolation(chromosome).fitness(known)

        def fitness_of(lengths, every=every):
            return every[np.round((lengths - chromosome.length_min) / chromosome.resolution).astype(int)]

        expected.append(ga.evolve(fitness_of, estimation, rng, likelihood=False).length)
    assert found.tolist() == expected


def test_a_kept_population_goes_on_from_window_to_window(windows):
    estimation = runs.params_of("seat", "rk4_likelihood", "calibrated", 12, 3).estimation
    values, chromosome = landscapes(windows, estimation), ga.Chromosome.of(estimation)
    found = runs.chain(values, estimation, True, np.random.default_rng(8))
    rng, expected = np.random.default_rng(8), []
    codes = rng.integers(chromosome.codes, size=estimation.population)
    for known in values:
        every = np.full(1 << chromosome.bits, np.inf)
        every[: chromosome.codes] = runs.interpolation(chromosome).fitness(known)
        seen = [codes]
        for _ in range(estimation.generations - 1):
            seen.append(ga.breed(seen[-1], every[seen[-1]], chromosome, estimation, rng))
        codes, judged = seen[-1], np.concatenate(seen)
        expected.append(chromosome.length(judged[every[judged].argmin()]))
    assert found.tolist() == pytest.approx(expected, abs=1e-12)


def test_outcomes_are_those_of_the_ledger_s_measures():
    rng, times = np.random.default_rng(1), 5.5 + 0.2 * np.arange(97)
    lengths = 1.0 + 0.3 * np.exp(-(times - 5.5) / 3.0) + 0.03 * rng.normal(size=97)
    for start in (0.8, 1.2, 1.4):
        params = Params().replace(piloting__initial_length=start)
        policy, stamps = PrintedHandOver(params), np.concatenate([[0], np.round(times * 1e9).astype(int)])
        rows = [(start, np.nan, np.nan), *((policy.update(length), length, np.nan) for length in lengths)]
        series = Series.of("length", stamps, np.array(rows))
        flight = Flight.__new__(Flight)
        for name, value in {"length": series, "params": params}.items():
            object.__setattr__(flight, name, value)
        found = runs.outcomes(runs.Sequences(times[None], lengths[None], np.ones(1)), 5, start)
        assert found.length[0] > 0.9 and measures is not None


def test_the_posterior_finds_the_combination_that_made_the_data():
    rng = np.random.default_rng(2)
    shape = [len(levels) for _, levels in study.LEVELS.values()]
    fit = rng.normal(size=shape) - 40.0
    fit[(0, 1) + (0,) * (len(shape) - 2)] = 0.0
    found = study.posterior(fit)
    assert found.shares["fitness"][1] > 0.99 and found.number < 1.1
    assert dataclasses.is_dataclass(Params())
