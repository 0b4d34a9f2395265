"""The length estimator and its rivals on one simulated window: ``python -m benchmarks.estimation``.

The genetic algorithm of the paper, 60 candidates and 20 generations, beside the same search with a textbook filter, one
candidate at a time, and beside other libraries' searches, which all score their candidates with our compiled filter and
may ask for as many as the genetic algorithm does. Then the landscape of all 18 001 lengths beside the textbook filter
(extrapolated from a few lengths), and the peak of memory of both. At last the length from poses alone: our scoring
beside SciPy's search of the same likelihood with its gradient, and a flight of 15 minutes over a window of 2.5 s.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.harness import Contender, Row, compare, line, main, needs, peak_memory, rate
from fiplib import ga, kalman
from fiplib.dynamics import axis_matrices
from fiplib.estimators.poses.estimate import estimate, problem_of
from fiplib.estimators.poses.filter import R, run
from fiplib.estimators.poses.fit import STEP, neighbours
from fiplib.estimators.poses.rows import Body
from fiplib.kalman import READINGS, Window
from fiplib.params import AXES, GRAVITY, Estimation, Params
from fiplib.studies import poses

TOPIC = "estimation"
RADIUS, PERIOD = 0.4, 8.0  # m, s
READING = "euler_likelihood"
"""The fitness of the comparison: the one that finds the length of a window made by the model."""

LENGTH_TOLERANCE = 0.005
"""Searches agree when their lengths lie within this of the best of all lengths, m: a random search has no more to
offer with 1200 candidates."""

POSE_TOLERANCE = 1e-3
"""Searches of the likelihood of poses agree within this, m: a fifth of a standard deviation."""


def parameters(reading: str = READING) -> Params:
    """60 candidates, 20 generations, one reading of the fitness."""
    return Params().replace(estimation__fitness=reading, estimation__population=60, estimation__generations=20)


def steady_circle(params: Params, samples: int | None = None) -> Window:
    """A circle flown perfectly by the linear model, measured with noise. The times hardly depend on the data."""
    estimation, length = params.estimation, params.pendulum.length
    step = estimation.sample_period
    w = 2 * np.pi / PERIOD
    angle = w * step * np.arange(samples or estimation.window)
    lean = -RADIUS * w**2 / (w**2 + 2 * GRAVITY / length)
    tilt = -RADIUS * w**2 / GRAVITY
    states, inputs = np.zeros((len(angle), 10)), np.zeros((len(angle), 2))
    for axis, phase in zip(AXES, (0.0, np.pi / 2), strict=True):
        c, s = np.cos(angle - phase), -w * np.sin(angle - phase)
        states[:, axis.states] = np.stack([RADIUS * c, RADIUS * s, lean * c, lean * s, axis.sign * tilt * c], axis=1)
        inputs[:, axis.input] = axis.sign * tilt * s
    noise = np.random.default_rng(0).standard_normal(states.shape)
    return Window(states + np.sqrt(estimation.measurement_noise) * noise, inputs, step)


def filterpy_fitness(lengths: NDArray, window: Window, estimation: Estimation) -> NDArray:
    """Candidates one at a time through filterpy's ten-state filter: Euler, likelihood of the innovations."""
    (filters,) = needs("filterpy.kalman")
    found = np.empty(len(lengths))
    for index, length in enumerate(lengths):
        f, b = np.eye(10), np.zeros((10, 2))
        axis_a, axis_b = axis_matrices(length)
        for axis in AXES:
            sign = np.array([1, 1, 1, 1, axis.sign])
            f[np.ix_(axis.states, axis.states)] += window.step * axis_a * np.outer(sign, sign)
            b[axis.states, axis.input] = window.step * axis_b[:, 0]
        judge = filters.KalmanFilter(dim_x=10, dim_z=10, dim_u=2)
        judge.x, judge.F, judge.B, judge.H = window.states[0], f, b, np.eye(10)
        judge.Q, judge.R = np.diag(estimation.process_noise), np.diag(estimation.measurement_noise)
        judge.P = judge.R.copy()
        total = 0.0
        for z, u in zip(window.states[1:], window.inputs[:-1], strict=True):
            judge.predict(u)
            judge.update(z)
            total += judge.y @ judge.SI @ judge.y + np.linalg.slogdet(judge.S)[1]
        found[index] = total
    return found


# --- searches: each takes a seed and returns a length in m


def genetic(params: Params, window: Window, fitness: Callable[..., NDArray] = kalman.fitness) -> Contender:
    """The paper's genetic algorithm, with another way to score candidates if one is given."""
    if fitness is kalman.fitness:
        return Contender(lambda seed: ga.estimate(window, params, np.random.default_rng(seed)), lambda e: e.length)
    estimation = params.estimation
    chromosome = ga.Chromosome.of(estimation)

    def search(seed: int) -> float:
        rng, known = np.random.default_rng(seed), {}
        codes = rng.integers(chromosome.codes, size=estimation.population)
        for generation in range(estimation.generations):
            unseen = [code for code in np.unique(codes) if code not in known]
            feasible = [code for code in unseen if code < chromosome.codes]
            known |= dict.fromkeys(unseen, np.inf)
            known |= dict(
                zip(feasible, fitness(chromosome.length(np.array(feasible)), window, estimation), strict=True)
            )
            if generation + 1 < estimation.generations:
                scores = np.array([known[code] for code in codes])
                codes = ga.breed(codes, scores, chromosome, estimation, rng)
        return float(chromosome.length(np.array(min(known, key=known.get))))

    return Contender(search, tolerance=LENGTH_TOLERANCE, remark="same search and draws, one candidate at a time")


def pygad(params: Params, window: Window) -> Contender:
    """PyGAD: one gene, a whole generation scored at once."""
    (module,) = needs("pygad")
    estimation = params.estimation

    def score(_: Any, candidates: NDArray, __: Any) -> NDArray:
        return -kalman.fitness(np.ravel(candidates), window, estimation)

    def search(seed: int) -> float:
        run = module.GA(
            num_generations=estimation.generations,
            num_parents_mating=estimation.population // 2,
            sol_per_pop=estimation.population,
            num_genes=1,
            gene_space={"low": estimation.length_min, "high": estimation.length_max},
            mutation_num_genes=1,
            fitness_func=score,
            fitness_batch_size=estimation.population,
            random_seed=seed,
            suppress_warnings=True,
        )
        run.run()
        return float(run.best_solution(run.last_generation_fitness)[0][0])

    return Contender(search, tolerance=LENGTH_TOLERANCE, remark="our filter")


def differential_evolution(params: Params, window: Window) -> Contender:
    """SciPy's differential evolution, vectorised, without its final polish."""
    from scipy import optimize

    estimation = params.estimation

    def search(seed: int) -> float:
        found = optimize.differential_evolution(
            lambda x: kalman.fitness(x.ravel(), window, estimation),
            [(estimation.length_min, estimation.length_max)],
            popsize=estimation.population,
            maxiter=estimation.generations - 1,
            rng=seed,
            polish=False,
            vectorized=True,
            updating="deferred",
            tol=0.0,
        )
        return float(found.x[0])

    return Contender(search, tolerance=LENGTH_TOLERANCE, remark="our filter")


def pymoo(params: Params, window: Window) -> Contender:
    """pymoo's genetic algorithm, a whole generation scored at once."""
    algorithms, problems, optimize = needs("pymoo.algorithms.soo.nonconvex.ga", "pymoo.core.problem", "pymoo.optimize")
    estimation = params.estimation

    class Length(problems.Problem):
        def __init__(self) -> None:
            super().__init__(n_var=1, n_obj=1, xl=estimation.length_min, xu=estimation.length_max)

        def _evaluate(self, x: NDArray, out: dict, *_: Any, **__: Any) -> None:
            out["F"] = kalman.fitness(x.ravel(), window, estimation)[:, None]

    def search(seed: int) -> float:
        algorithm = algorithms.GA(pop_size=estimation.population)
        stop = ("n_gen", estimation.generations)
        return float(optimize.minimize(Length(), algorithm, stop, seed=seed, verbose=False).X[0])

    return Contender(search, tolerance=LENGTH_TOLERANCE, remark="our filter")


# --- the length from poses alone


Bodies = tuple[Body, Body]


def circling(seconds: float) -> Bodies:
    """Vehicle and rod of a simulated circle of 0.4 m, from 3 s on."""
    true = poses.flown(poses.Condition(), 70_000, 3.0 + seconds)
    vehicle, rod = poses.observed(true.states, np.random.default_rng(0))
    return vehicle.part(vehicle.time >= 3.0), rod.part(rod.time >= 3.0)


def stretches(bodies: Bodies, seconds: float) -> list[Bodies]:
    """Windows one after the other."""
    vehicle, rod = bodies
    starts = np.arange(3.0, vehicle.time[-1] - seconds, seconds)
    keeps = [(vehicle.time >= start) & (vehicle.time < start + seconds) for start in starts]
    return [(vehicle.part(keep), rod.part(keep)) for keep in keeps]


def from_poses() -> Contender:
    """The estimate with all its checks."""
    return Contender(lambda bodies: estimate(*bodies, poses.STATED), lambda found: found.length, POSE_TOLERANCE)


def scipy_from_poses() -> Contender:
    """SciPy's BFGS on the same posterior, with our filter's gradient, from the same start, without checks."""
    from scipy import optimize

    def search(bodies: Bodies) -> float:
        problem = problem_of(*bodies, poses.STATED, [])
        first = problem.start(problem.inertia, problem.offset)
        scale = np.sqrt(np.diag(first.covariance))

        def descend(x: NDArray) -> tuple[float, NDArray]:
            theta = first.theta.copy()
            theta[first.free] += scale * x
            lanes = neighbours(theta, first.free)
            out = run(problem.rows, lanes, np.full(len(first.free), STEP))
            deviations, slopes = first.prior.at(lanes)
            score = out.score - slopes @ deviations
            return float(0.5 * deviations @ deviations - out.total[0]), -scale * score

        found = optimize.minimize(descend, np.zeros(len(scale)), jac=True, method="BFGS", options={"gtol": 0.3})
        at = int(np.flatnonzero(first.free == R)[0])
        return 2.0 * float(first.theta[R] + scale[at] * found.x[at])

    return Contender(search, tolerance=POSE_TOLERANCE, remark="our filter and its gradient, no checks")


def measure_poses(quick: bool) -> list[Row]:
    """A window, and how much longer a flight of 15 minutes takes."""
    flight = circling(60.0 if quick else 900.0)
    windows = stretches(tuple(body.part(body.time < 63.0) for body in flight), 2.5)
    rows = compare(
        TOPIC,
        "poses to length, 2.5 s",
        from_poses(),
        {"SciPy BFGS": scipy_from_poses},
        windows[: 4 if quick else 20],
        budget=1.0 if quick else 10.0,
        checks=3,
        block=2,
    )
    spent = []
    for _ in range(1 if quick else 3):
        begin = time.process_time()
        estimate(*flight, poses.STATED)
        spent.append(time.process_time() - begin)
    taken, seconds = min(spent), flight[0].time[-1] - flight[0].time[0]
    remark = f"{taken:.2g} s, over a window's median; it has {seconds / 2.5:.0f} times as many poses"
    rows.append(
        rate(TOPIC, f"poses to length, {seconds / 60:.0f} minutes", "fip", 1e6 * taken / rows[0].p50_us, remark)
    )
    return rows


# --- measured


def run_landscape(small: bool) -> None:
    """One landscape; its memory is measured in a process of its own."""
    params = parameters().replace(estimation__resolution=0.1) if small else parameters()
    ga.landscape(steady_circle(params, 5 if small else None), params)


def run_genetic(small: bool) -> None:
    """Five runs of the genetic algorithm; memory as ``run_landscape``."""
    params = parameters().replace(estimation__generations=1) if small else parameters()
    window = steady_circle(params, 5 if small else None)
    for seed in range(1 if small else 5):
        ga.estimate(window, params, np.random.default_rng(seed))


def measure(quick: bool) -> list[Row]:
    """Searches, readings of the fitness, landscape, memory."""
    params = parameters()
    window, estimation = steady_circle(params), params.estimation
    best = ga.landscape(window, params).best
    own = genetic(params, window)
    own = Contender(own.call, own.answer, LENGTH_TOLERANCE, "60 candidates, 20 generations")
    others = {
        "filterpy, same search": lambda: genetic(params, window, filterpy_fitness),
        "PyGAD": lambda: pygad(params, window),
        "SciPy differential evolution": lambda: differential_evolution(params, window),
        "pymoo": lambda: pymoo(params, window),
    }
    seeds = list(range(3 if quick else 40))
    needs("filterpy")
    print(f"the best of all lengths is {best:.4f} m")
    rows = compare(TOPIC, "GA, 60 x 20", own, others, seeds, budget=1.0 if quick else 20.0, checks=3, block=2)

    lengths = ga.Chromosome.of(estimation).length(np.arange(ga.Chromosome.of(estimation).codes))
    few = lengths[:: len(lengths) // 8]
    per_length = compare(
        TOPIC,
        f"{len(few)} lengths x {len(window.states)} samples",
        Contender(lambda _: kalman.fitness(few, window, estimation), tolerance=1e-6 * len(window.states)),
        {
            "filterpy": lambda: Contender(
                lambda _: filterpy_fitness(few, window, estimation), tolerance=1e-6 * len(window.states)
            )
        },
        [None] * (3 if quick else 20),
        checks=1,
        block=2,
    )
    work = f"landscape, {len(lengths)} lengths"
    whole = compare(
        TOPIC,
        work,
        Contender(lambda _: ga.landscape(window, params).fitness),
        {},
        [None] * (2 if quick else 8),
        checks=1,
    )
    filterpy = per_length[-1]
    if filterpy.calls:
        taken = filterpy.p50_us * len(lengths) / len(few)
        remark = f"extrapolated from {len(few)} lengths"
        ratio = taken / whole[0].p50_us
        whole.append(
            Row(TOPIC, work, "filterpy", ratio, taken, np.nan, 1, filterpy.difference, filterpy.agrees, remark)
        )
        print(line(whole[-1]))
    rows += per_length + whole

    for name in READINGS:
        reading = parameters(name)
        rows += compare(
            TOPIC,
            f"GA, reading {name}",
            Contender(lambda seed, reading=reading: ga.estimate(window, reading, np.random.default_rng(seed)).length),
            {},
            seeds[: 3 if quick else 10],
            checks=1,
        )
    remark = "MB by which the peak of resident memory rises"
    rows.append(rate(TOPIC, "memory, landscape", "fip", peak_memory(run_landscape), remark))
    rows.append(rate(TOPIC, "memory, five runs of the GA", "fip", peak_memory(run_genetic), remark))
    return rows + measure_poses(quick)


if __name__ == "__main__":
    main(TOPIC, measure, __doc__)
