"""The genetic algorithm: its operators one by one, and whether it finds what an exhaustive search finds."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fiplib import ga, kalman
from fiplib.ga import Chromosome, MedianFilter
from fiplib.params import Estimation, Params
from tests.test_kalman import EQUAL, IDENTITY, simulated_window

# Fixed here, whatever the defaults are tuned to
PARAMS = Params(estimation=replace(EQUAL, population=60, generations=20, elite_fraction=0.167, mutation_rate=0.1))
PAPER = Chromosome.of(PARAMS.estimation)
COARSE = PARAMS.replace(estimation__resolution=1e-3)  # 1 801 lengths: the same search, a tenth of the time


@cache
def window(length: float = 1.0, seed: int = 0) -> kalman.Window:
    return simulated_window(length, np.random.default_rng(seed), PARAMS.estimation)


def test_the_chromosome_has_18001_codes_in_15_bits_from_end_to_end() -> None:
    assert (PAPER.codes, PAPER.bits) == (18001, 15)
    assert PAPER.length(np.array([0, 8000, 18000])).tolist() == [0.2, 1.0, 2.0]


@given(st.lists(st.integers(0, 2**15 - 1), min_size=1, max_size=50))
def test_decoding_undoes_encoding(codes: list[int]) -> None:
    bits = PAPER.encode(np.array(codes))
    assert bits.shape == (len(codes), 15)
    assert PAPER.decode(bits).tolist() == codes
    assert "".join(str(int(bit)) for bit in bits[0]) == f"{codes[0]:015b}"


@given(st.integers(0, 2**32), st.integers(1, 20), st.integers(1, 15))
def test_crossover_only_recombines_the_bits_of_its_parents(seed: int, pairs: int, bits: int) -> None:
    rng = np.random.default_rng(seed)
    first, second = rng.random((2, pairs, bits)) < 0.5
    children = ga.crossover(first, second, rng)
    assert children.shape == (2 * pairs, bits)
    for a, b, child, twin in zip(first, second, children[:pairs], children[pairs:], strict=True):
        points = [p for p in range(1, bits + 1) if np.array_equal(child, np.concatenate([a[:p], b[p:]]))]
        assert points, "a child is the head of one parent and the tail of the other"
        assert any(np.array_equal(twin, np.concatenate([b[:p], a[p:]])) for p in points)


def test_every_crossover_point_occurs() -> None:
    zeros, ones = np.zeros((2000, 15), bool), np.ones((2000, 15), bool)
    heads = (~ga.crossover(zeros, ones, np.random.default_rng(0))[:2000]).sum(axis=1)
    assert set(heads) == set(range(1, 15))  # each has probability 1/14; missing one of 2000 times is 1e-64


def test_mutation_flips_bits_at_its_rate() -> None:
    bits = np.random.default_rng(0).random((2000, 15)) < 0.5
    flipped = (ga.mutate(bits, 0.1, np.random.default_rng(1)) != bits).mean(axis=0)
    # Per bit position: five standard errors of a proportion of 0.1 among 2000
    assert flipped == pytest.approx(0.1, abs=5 * np.sqrt(0.1 * 0.9 / 2000))
    assert np.array_equal(ga.mutate(bits, 0.0, np.random.default_rng(1)), bits)
    assert np.array_equal(ga.mutate(bits, 1.0, np.random.default_rng(1)), ~bits)


def test_the_roulette_draws_in_proportion_to_worst_minus_fitness() -> None:
    draws = ga.roulette(np.array([0.0, 3.0, 4.0, np.inf]), 20000, np.random.default_rng(0))
    counts = np.bincount(draws, minlength=4)
    # Weights 4 : 1 : 0, nothing for the infeasible one; five standard errors of a proportion of 0.8 among 20000
    assert counts[0] / 20000 == pytest.approx(0.8, abs=5 * np.sqrt(0.8 * 0.2 / 20000))
    assert counts[2] == counts[3] == 0


@given(st.floats(0.001, 1000.0), st.floats(-1e3, 1e3))
def test_the_roulette_is_free_of_scale_and_zero(scale: float, offset: float) -> None:
    fitness = np.array([1.0, 2.0, 5.0, 9.0])
    plain, changed = (ga.roulette(f, 50, np.random.default_rng(0)) for f in (fitness, scale * fitness + offset))
    # Rounding moves the limits of the sectors by 1e-10 at most: a draw would have to fall that near one
    assert np.array_equal(plain, changed)


def test_the_roulette_is_uniform_if_all_are_equal_and_if_all_are_infeasible() -> None:
    for fitness, share in (([3.0, 3.0, np.inf, 3.0], [1 / 3, 1 / 3, 0, 1 / 3]), ([np.inf] * 4, [1 / 4] * 4)):
        draws = ga.roulette(np.array(fitness), 20000, np.random.default_rng(0))
        # Five standard errors of a proportion of 1/3 among 20000
        assert np.bincount(draws, minlength=4) / 20000 == pytest.approx(share, abs=5 * np.sqrt(2 / 9 / 20000))


@given(st.integers(0, 2**32), st.integers(2, 61), st.floats(0.0, 1.0))
def test_breeding_keeps_the_elites_and_the_size(seed: int, population: int, fraction: float) -> None:
    rng = np.random.default_rng(seed)
    estimation = Estimation(population=population, elite_fraction=fraction)
    codes = rng.integers(PAPER.codes, size=population)
    fitness = np.abs(codes - 8000.0)
    children = ga.breed(codes, fitness, PAPER, estimation, rng)
    elites = round(fraction * population)
    assert children.shape == codes.shape and (children >= 0).all() and (children < 2**15).all()
    assert np.abs(children[:elites] - 8000.0).tolist() == np.sort(fitness)[:elites].tolist()


def test_ten_of_sixty_candidates_are_elites() -> None:
    assert ga.elite_count(PARAMS.estimation) == 10


def test_infeasible_codes_are_neither_parents_nor_elites() -> None:
    codes = np.array([0, 1, 2, 3, *range(32000, 32056)])  # 0b11111... beyond l_max: all have their top bits set
    fitness = np.where(codes < PAPER.codes, codes.astype(float), np.inf)
    estimation = Estimation(mutation_rate=0.0, elite_fraction=4 / 60)
    children = ga.breed(codes, fitness, PAPER, estimation, np.random.default_rng(0))
    assert set(children) <= {0, 1, 2, 3}


def test_a_run_is_determined_by_its_seed() -> None:
    one, same, other = (ga.estimate(window(), COARSE, np.random.default_rng(seed)) for seed in (3, 3, 4))
    assert np.array_equal(one.populations, same.populations) and one.length == same.length
    assert not np.array_equal(one.populations, other.populations)


@pytest.mark.parametrize("name", ["paper", "euler_prior", "rk4_likelihood"])
def test_the_best_fitness_never_rises_and_is_always_feasible(name: str) -> None:
    params = COARSE.replace(estimation__fitness=name)
    run = ga.estimate(window(), params, np.random.default_rng(5))
    assert run.populations.shape == (20, 60) and run.best_lengths.shape == (20,)
    assert (run.populations[0] <= 2.0).all()
    assert (run.populations > 2.0).any()  # infeasible offspring do occur, and are counted for nothing:
    assert (run.best_lengths <= 2.0).all() and 0.2 <= run.length <= 2.0
    feasible = np.unique(run.populations[run.populations <= 2.0])
    assert run.evaluations == feasible.size
    history = kalman.fitness(run.best_lengths, window(), params.estimation)
    assert (np.diff(history) <= 0).all()
    assert run.fitness == history[-1] == kalman.fitness(feasible, window(), params.estimation).min()
    assert run.length == run.best_lengths[-1]


def test_without_elites_the_best_ever_is_returned() -> None:
    params = COARSE.replace(estimation__elite_fraction=0.0)
    run = ga.estimate(window(), params, np.random.default_rng(0))
    assert run.fitness == kalman.fitness(run.best_lengths, window(), params.estimation).min()


def test_the_landscape_holds_every_length_and_the_algorithm_finds_its_minimum() -> None:
    whole = ga.landscape(window(), PARAMS)
    assert whole.lengths.shape == whole.fitness.shape == (18001,)
    assert whole.fitness.min() == kalman.fitness([whole.best], window(), PARAMS.estimation)[0]
    for seed in range(10):
        run = ga.estimate(window(), PARAMS, np.random.default_rng(seed))
        # f = -2 log L rises by 1 over one standard deviation of the length, so 0.01 is a tenth of one: far below
        # what the data can tell
        assert 0 <= run.fitness - whole.fitness.min() < 0.01
        assert abs(run.length - whole.best) < 0.15 * run.standard_deviation


@pytest.mark.parametrize("length", [0.5, 1.0, 1.5])
def test_the_likelihood_finds_the_true_length_within_its_own_standard_deviation(length: float) -> None:
    scores = []
    for seed in range(8):
        data = window(length, seed)
        best = ga.landscape(data, COARSE).best
        run = ga.estimate(data, COARSE, np.random.default_rng(seed))
        assert 0.01 * length < run.standard_deviation < 0.15 * length  # 55 samples tell the length to some per cent
        scores.append((best - length) / run.standard_deviation)
    # The errors, in units of the standard deviation each run claims: none beyond four (a chance of 6e-5 each) and
    # a mean square of 1, with five standard errors of a chi-squared mean of 8: sqrt(2 / 8) = 0.5
    assert np.abs(scores).max() < 4
    assert np.mean(np.square(scores)) < 1 + 5 * 0.5


@pytest.mark.parametrize("length", [0.5, 1.0, 1.6])
def test_with_unit_noise_the_printed_fitness_runs_to_the_shortest_length_whatever_the_truth(length: float) -> None:
    # A shorter length means a larger J, a larger gain, and so a smaller posterior residual
    params = COARSE.replace(
        estimation__fitness="paper",
        estimation__process_noise=IDENTITY.process_noise,
        estimation__measurement_noise=IDENTITY.measurement_noise,
    )
    assert [ga.landscape(window(length, seed), params).best for seed in range(3)] == [0.2, 0.2, 0.2]


@pytest.mark.parametrize("length", [0.5, 1.0, 1.6])
def test_with_other_noise_the_printed_fitness_lands_near_the_truth(length: float) -> None:
    # Velocities so noisy that the gain on a' stays small at every length: what is left of the innovation then says
    # more about the prediction than about the gain
    estimation = replace(
        COARSE.estimation,
        fitness="paper",
        process_noise=(1e-7, 6e-5, 1e-7, 6e-5, 1e-7, 6e-5, 1e-7, 6e-5, 1e-4, 1e-4),
        measurement_noise=(4e-8, 5e-4, 4e-8, 5e-4, 8e-8, 1e-3, 8e-8, 1e-3, 1e-6, 1e-6),
    )
    for seed in range(3):
        data = simulated_window(length, np.random.default_rng(seed), estimation)
        best = ga.landscape(data, replace(COARSE, estimation=estimation)).best
        assert best == pytest.approx(length, rel=0.2)  # four times the 5 % that a window of 55 samples can tell


def test_only_a_likelihood_has_a_standard_deviation() -> None:
    for name in kalman.READINGS:
        run = ga.estimate(window(), COARSE.replace(estimation__fitness=name), np.random.default_rng(0))
        at_an_end = not 0.21 <= run.length <= 1.99
        assert np.isnan(run.standard_deviation) == (not name.endswith("likelihood") or at_an_end)


def test_a_window_that_overflows_gives_an_estimate_of_infinite_fitness() -> None:
    data = kalman.Window(np.full((5, 10), 1e200) * np.arange(5)[:, None], np.zeros((5, 2)), 0.1)
    run = ga.estimate(data, COARSE, np.random.default_rng(0))
    assert run.fitness == np.inf and 0.2 <= run.length <= 2.0 and np.isnan(run.standard_deviation)


def test_the_median_filter_takes_the_last_values() -> None:
    median = MedianFilter(3)
    assert [median.push(value) for value in (1.0, 2.0, 9.0, 1.5, 1.0)] == [1.0, 1.5, 2.0, 2.0, 1.5]


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=20), st.integers(1, 7))
def test_the_median_filter_agrees_with_the_median_of_the_tail(values: list[float], length: int) -> None:
    median = MedianFilter(length)
    assert [median.push(value) for value in values][-1] == np.median(values[-length:])


def test_a_median_filter_refuses_no_length_and_values_that_are_not_finite() -> None:
    with pytest.raises(ValueError, match="at least 1"):
        MedianFilter(0)
    with pytest.raises(ValueError, match="finite"):
        MedianFilter(3).push(np.nan)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"generations": 0}, "at least 1 generation"),
        ({"population": 1}, "at least 1 generation of 2"),
        ({"elite_fraction": 1.1}, "elite_fraction must lie"),
        ({"mutation_rate": -0.1}, "mutation_rate must lie"),
        ({"length_min": 0.0}, "cannot cover"),
        ({"length_min": 2.0}, "cannot cover"),
        ({"resolution": 0.0}, "cannot cover"),
        ({"resolution": 5.0}, "cannot cover"),
        ({"fitness": "guess"}, "unknown reading"),
        ({"measurement_noise": (0.0,) * 10}, "measurement_noise must be"),
    ],
)
def test_parameters_that_make_no_sense_are_refused(changes: dict, message: str) -> None:
    params = Params(estimation=replace(Estimation(), **changes))
    with pytest.raises(ValueError, match=message):
        ga.estimate(window(), params, np.random.default_rng(0))
