"""The study of unprinted choices: its genetic algorithm against the library's, its landscapes, its posterior."""

import math
from dataclasses import replace

import numpy as np
import pytest

from fiplib import ga, kalman
from fiplib.estimators.handover import PrintedHandOver
from fiplib.kalman import Window
from fiplib.params import NANO, Params
from fiplib.recording import Series
from fiplib.references import Circle
from fiplib.reproduction import measures
from fiplib.simulate import Scenario
from fiplib.studies import choices as study
from fiplib.studies import choices_checks as checks
from fiplib.studies import choices_runs as runs
from fiplib.studies.batch import fly_many


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


@pytest.mark.parametrize("fitness", ["printed_posterior", "printed_prior_unit", "rk4_prior", "rk4_likelihood"])
def test_the_interpolated_landscape_is_the_fitness_of_every_length(windows, fitness):
    params = runs.params_of("seat", fitness, 60, 20)
    direct = ga.landscape(windows[0], params)
    between = runs.interpolation(ga.Chromosome.of(params.estimation))
    found = between.fitness(landscapes(windows[:1], params.estimation)[0])
    # far below what tells two lengths apart, a hundredth of the range
    assert np.abs(found - direct.fitness).max() < 1e-4 * np.ptp(direct.fitness)
    assert abs(direct.lengths[found.argmin()] - direct.best) < 1e-3


@pytest.mark.parametrize(("population", "generations"), [(60, 20), (12, 5), (7, 1)])
def test_the_compiled_genetic_algorithm_is_the_library_s(windows, population, generations):
    estimation = runs.params_of("seat", "rk4_likelihood", population, generations).estimation
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
    estimation = runs.params_of("seat", "rk4_likelihood", 12, 3).estimation
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
    lengths = np.array([1.0, 1.15])[:, None] + 0.3 * np.exp(-(times - 5.5) / 3.0) + 0.03 * rng.normal(size=(2, 97))
    [flight] = fly_many([Scenario("choices", "", 25.0, Circle(0.4, 8.0))])
    for start in (0.8, 1.2, 1.4):
        params = Params().replace(piloting__initial_length=start)
        found = runs.outcomes(runs.Sequences(np.tile(times, (2, 1)), lengths, np.ones(2)), 5, start)
        for row, sequence in enumerate(lengths):
            policy = PrintedHandOver(params)
            values = [(start, math.nan, math.nan), *((policy.update(x), x, math.nan) for x in sequence.tolist())]
            stamps = flight.start_ns + np.round(np.array([0.0, *times]) * NANO).astype(np.int64)
            given = replace(flight, length=Series.of("length", stamps, np.array(values)))
            expected = measures.convergence(given)
            assert found.length[row] == pytest.approx(expected.length, abs=1e-12)
            assert found.seconds["stays5"][row] == pytest.approx(expected.time, abs=1e-6)


def test_a_sequence_of_the_long_period_is_cut_at_its_phase():
    times, flights, windows = 5.404 + runs.STEP * np.arange(99), 2, 99
    numbers = np.arange(flights * windows, dtype=float).reshape(flights, windows)
    answers = runs.Answers(numbers, numbers, numbers)
    aligned = runs.sequences(times, answers, 0.0, "fresh", 5.0, "window")
    assert aligned.lengths[:, :4].tolist() == [[0, 25, 50, 75], [99, 124, 149, 174]]
    assert aligned.times[0, :4] == pytest.approx([5.5, 10.5, 15.5, 20.5]) and np.isinf(aligned.times[0, 4:]).all()
    free = runs.sequences(times, answers, runs.LEAD, "fresh", 5.0, "clock")
    assert free.weights.sum() == pytest.approx(flights) and np.nanmin(free.times[:, 0]) == pytest.approx(0.1)
    often = runs.sequences(times, answers, 0.0, "kept", 0.2, "window")
    assert often.lengths.shape[0] == flights and np.nanmax(np.where(np.isfinite(often.times), often.times, 0)) <= 25.0


def test_no_answer_leaves_the_first_length_in_use():
    nothing = runs.Sequences(np.full((1, 3), np.inf), np.full((1, 3), np.nan), np.ones(1))
    found = runs.outcomes(nothing, 3, 1.4)
    assert found.length.tolist() == [1.4] and found.seconds["stays5"].tolist() == [0.0]


def test_a_probability_is_that_of_the_rounded_numbers():
    lengths, seconds, weights = np.full(20, 1.0), np.full(20, 12.0), np.ones(20)
    at = study.log_probability(lengths, seconds, weights, (1.0, 12.0), (5e-4, 5e-3), study.KERNEL)
    # 20 of 21 flights at the peak of both kernels
    peak = np.prod([2 * slack / (width * np.sqrt(2 * np.pi)) for slack, width in ((5e-4, 0.01), (5e-3, 0.25))])
    assert at == pytest.approx(np.log(20 / 21 * peak), abs=2e-3)
    far = study.log_probability(lengths, seconds, weights, (1.5, 12.0), (5e-4, 5e-3), study.KERNEL)
    assert far == pytest.approx(np.log(1e-3 / 1.8 * 1e-2 / 25.0 / 21), abs=1e-3)
    never = study.log_probability(lengths, np.full(20, np.inf), weights, (1.0, 12.0), (5e-4, 5e-3), study.KERNEL)
    assert never == pytest.approx(far)


def synthetic(true: dict[str, int], size: int = 20) -> np.ndarray:
    """Log probabilities of every combination, for the paper's numbers drawn from one: each level shifts the outcome."""
    shape = [len(levels) for _, levels in study.LEVELS.values()]
    rng, shift = np.random.default_rng(4), np.zeros((2, *shape))
    for axis, choice in enumerate(study.LEVELS):
        steps = {"tracked": (0.2, 0.0), "period": (0.0, 4.0)}.get(choice)
        if steps is not None:
            view = [1] * len(shape)
            view[axis] = shape[axis]
            shift += np.multiply.outer(steps, np.arange(shape[axis])).reshape(2, *view)
    pairs = {tuple(one) for one in shift.reshape(2, -1).T.tolist()}
    noise = rng.normal(size=(2, size)) * [[0.02], [1.0]]
    made = [sum(steps) for steps in ((0.2 * true["tracked"],), (4.0 * true["period"],))]
    drawn = rng.normal(size=(2, 3)) * [[0.02], [1.0]] + np.array(made)[:, None] + [[1.0], [8.0]]
    known = {}
    for length, seconds in pairs:
        simulated = noise + np.array([[1.0 + length], [8.0 + seconds]])
        known[length, seconds] = sum(
            study.log_probability(*simulated, np.ones(size), paper, (5e-4, 5e-3), study.KERNEL)
            for paper in drawn.T.tolist()
        )
    return np.array([known[tuple(one)] for one in shift.reshape(2, -1).T.tolist()]).reshape(shape)


@pytest.mark.parametrize("true", [{"tracked": 0, "period": 1}, {"tracked": 1, "period": 0}])
def test_the_posterior_finds_the_levels_that_made_the_numbers_and_no_others(true):
    found = study.posterior(synthetic(true))
    for choice, (_, levels) in study.LEVELS.items():
        if choice in true:
            assert found.shares[choice][true[choice]] > 0.95 and found.effects[choice] > 5.0
        else:
            assert found.shares[choice] == pytest.approx(1.0 / len(levels)) and found.effects[choice] < 1e-9
    total = np.prod([len(levels) for _, levels in study.LEVELS.values()])
    assert found.number == pytest.approx(total / 4.0, rel=0.3)  # two choices of two levels are settled, or nearly
    text = study.questions(found)
    assert "The numbers themselves settle" in text and "hardly matter" in text


def rows(fit: np.ndarray) -> list[dict]:
    """The table of the study that holds log probabilities."""
    flat = fit.reshape(len(study.cases()), -1)
    names = [study.arm_name(arm) for arm in study.ARMS]
    return [
        case
        | {f"{column}_{n}": v for column in study.SENSITIVITY for n, v in zip(names, line, strict=True)}
        | {f"within_{n}": 6.0 for n in names}
        for case, line in zip(study.cases(), flat.tolist(), strict=True)
    ]


def test_table_and_facts_state_the_posterior_of_the_rows():
    made = rows(synthetic({"tracked": 0, "period": 1}))
    table, facts = study.table17_choices(made), study.facts(made)
    assert [line[0] for line in table.rows] == [name for name, _ in study.LEVELS.values()]
    assert all(len(line) == len(table.header) for line in table.rows)
    assert table.rows[0][2].startswith("seat 1") or table.rows[0][2].startswith("seat 9")
    assert facts["combinations",] == facts["all", "numbers"] == str(22 * 864)
    assert int(facts["period", "5"]) > 95 and facts["window", "empty"] == "33"
    assert "period of the runs" in facts["questions",]


def test_every_level_of_every_choice_is_in_the_cases_and_columns():
    assert len(study.cases()) * len(study.ARMS) == np.prod([len(levels) for _, levels in study.LEVELS.values()])
    assert len({study.arm_name(arm) for arm in study.ARMS}) == len(study.ARMS)


@pytest.mark.parametrize("combination", checks.FLOWN)
def test_repeated_feedback_settles(combination):
    row = checks.Flown.run({"combination": combination, "start": 1.4, "seed": 3})
    assert row["survived"] == 1 and abs(row["change"]) < 2e-3
    assert abs(row["length"] - 1.0) < 0.5


def test_repeated_feedback_is_the_flight_that_the_estimator_steers():
    *setting, _, _, _, _, _, _ = checks.FLOWN["default"]
    params = runs.params_of(*setting).replace(piloting__initial_length=1.4, piloting__estimate=True)
    number = 97_000 + 100 * checks.Flown.STARTS.index(1.4) + 3
    [flight] = fly_many([Scenario("choices", "", runs.SECONDS, runs.MOTIONS["circle"], params=params, seed=number)])
    row = checks.Flown.run({"combination": "default", "start": 1.4, "seed": 3})
    # other random numbers of the search move an answer by about a millimetre
    assert measures.convergence(flight).length == pytest.approx(row["length"], abs=5e-3)
