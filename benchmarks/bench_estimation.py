"""Time of the length estimator: ``python benchmarks/bench_estimation.py``.

Prints, for every reading of the fitness, the time of one run of the genetic algorithm, of a landscape, and
how much faster a candidate is filtered than by filterpy, one candidate at a time.
"""

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from filterpy.kalman import KalmanFilter

from fiplib import ga, kalman
from fiplib.dynamics import axis_matrices
from fiplib.kalman import READINGS, Window
from fiplib.params import AXES, GRAVITY, Params

RUNS = 7
RADIUS, PERIOD = 0.4, 8.0  # m, s


def steady_circle(params: Params, rng: np.random.Generator) -> Window:
    """A circle flown perfectly by the linear model, measured with noise. The times hardly depend on the data."""
    estimation, length = params.estimation, params.pendulum.length
    step = estimation.sample_period
    w = 2 * np.pi / PERIOD
    angle = w * step * np.arange(estimation.window)
    lean = -RADIUS * w**2 / (w**2 + 2 * GRAVITY / length)
    tilt = -RADIUS * w**2 / GRAVITY
    states, inputs = np.zeros((len(angle), 10)), np.zeros((len(angle), 2))
    for axis, phase in zip(AXES, (0.0, np.pi / 2), strict=True):
        c, s = np.cos(angle - phase), -w * np.sin(angle - phase)
        states[:, axis.states] = np.stack([RADIUS * c, RADIUS * s, lean * c, lean * s, axis.sign * tilt * c], axis=1)
        inputs[:, axis.input] = axis.sign * tilt * s
    states += np.sqrt(estimation.measurement_noise) * rng.standard_normal(states.shape)
    return Window(states, inputs, step)


def filterpy_fitness(length: float, window: Window, params: Params) -> float:
    """One candidate through filterpy's ten-state filter (Euler, posterior residual: the cheapest honest rival)."""
    f, b = np.eye(10), np.zeros((10, 2))
    axis_a, axis_b = axis_matrices(length)
    for axis in AXES:
        sign = np.array([1, 1, 1, 1, axis.sign])
        f[np.ix_(axis.states, axis.states)] += window.step * axis_a * np.outer(sign, sign)
        b[axis.states, axis.input] = window.step * axis_b[:, 0]
    judge = KalmanFilter(dim_x=10, dim_z=10, dim_u=2)
    judge.x, judge.F, judge.B, judge.H = window.states[0], f, b, np.eye(10)
    judge.Q, judge.R = np.diag(params.estimation.process_noise), np.diag(params.estimation.measurement_noise)
    judge.P = judge.R.copy()
    total = 0.0
    for z, u in zip(window.states[1:], window.inputs[:-1], strict=True):
        judge.predict(u)
        judge.update(z)
        total += np.sum((z - judge.x) ** 2)
    return total


def seconds(task: Callable[[], object], runs: int = RUNS) -> float:
    """Median wall-clock time of a task in s."""
    times = []
    for _ in range(runs):
        start = time.perf_counter()
        task()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def main() -> None:
    rng = np.random.default_rng(0)
    params = Params()
    window = steady_circle(params, rng)
    lengths = ga.landscape(window, params).lengths
    rival = seconds(lambda: filterpy_fitness(1.0, window, params))
    ours = kalman.fitness([1.0], window, replace(params.estimation, fitness="euler_posterior"))[0]
    if not np.isclose(ours, filterpy_fitness(1.0, window, params), rtol=1e-9):
        raise SystemExit("the two filters disagree: their times cannot be compared")
    print(f"simulated window of {len(window.states)} samples, {len(lengths)} lengths; medians of {RUNS} runs")
    print(f"filterpy, one candidate: {1e3 * rival:.2f} ms\n")
    print(f"{'reading':<20} {'GA run':>9} {'landscape':>11} {'against filterpy':>18}")
    for name in READINGS:
        reading = params.replace(estimation__fitness=name)
        run = seconds(lambda reading=reading: ga.estimate(window, reading, rng))
        whole = seconds(lambda reading=reading: kalman.fitness(lengths, window, reading.estimation), 3)
        ratio = rival * len(lengths) / whole
        print(f"{name:<20} {1e3 * run:6.1f} ms {whole:9.2f} s {ratio:16.0f} x")


if __name__ == "__main__":
    main()
