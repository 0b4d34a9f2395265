"""The regulator of 2011 with the weights chosen by the genetic algorithm of ``fiplib.ga``.

The weights of (s, s', d, d', tilt), with that of the input at 1 s^2/rad^2, are a chromosome of five times ``BITS``
bits, evenly spaced in their logarithms over ``SPAN``. Elites, roulette wheel, crossover and mutation are those of the
length estimator. The fitness is the ``cost`` of the exact linear loop from tick to tick (``controllers.margins``), with
delay, lag, seat, inertia and observer, for each of the ``LENGTHS`` in use on the rod of 1 m: a push is to be answered
softly and soon, noise is not to be amplified, and lengths that are wrong by a quarter are to fly. ``WEIGHTS`` is what
``python -m fiplib.controllers.lqr_ga`` prints, after some 40 s.
"""

import functools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fiplib import ga, observers
from fiplib.controllers.lqr import LQR, Weights, gain
from fiplib.params import Params

BITS, SPAN = 8, (1e-2, 1e4)
POPULATION, GENERATIONS, SEED = 60, 40, 1
LENGTHS = (0.75, 1.0, 1.25)
"""Lengths in use, m, of a rod of 1 m."""
SECONDS, PUSH = 6.0, 0.2
"""Time for which a loop is followed after a push that gives the rod's COM a velocity, m/s: one of about 8 mN s."""
LARGE = (0.2, 0.05, 1.0)
"""Position in m, offset of the rod in m and rate in rad/s whose squares weigh the same in the cost."""

WEIGHTS = Weights((10.3, 0.0106, 973.0, 0.0238, 0.0106), 1.0)
"""Found by ``tune``: position and offset of the rod count, what is near the lower end of ``SPAN`` hardly does."""


class GATunedLQR(LQR):
    """``lqr.LQR`` with ``WEIGHTS`` of this module."""

    weights = WEIGHTS


class _First(NamedTuple):
    """A gain as ``margins.closed_loop`` asks for it."""

    gains: NDArray


class _Regulator:  # a margins.Regulator
    def __init__(self, weights: Weights) -> None:
        self._weights = weights

    def prepare(self, length: float) -> list[_First]:
        """Return the gain of both axes, (1, 5)."""
        return [_First(gain(length, self._weights)[None])] * 2


def cost(weights: Weights, params: Params | None = None) -> float:
    """Return the mean, over ``LENGTHS``, of int (s/s_0)^2 + (d/d_0)^2 + (u/u_0)^2 dt after a push, plus noise.

    The second term is ``SECONDS`` (u_n/u_0)^2, with u_n the rms rate that the noise of motion capture commands through
    observer and gain, the loop open. The cost is infinite if one of the loops is unstable.
    """
    from scipy.linalg import solve_discrete_lyapunov

    from fiplib.controllers import margins

    params, total = params or Params(), 0.0
    noise = np.array([*[params.simulation.position_noise] * 2, params.simulation.attitude_noise])
    for length in LENGTHS:
        loop = margins.closed_loop(length, params, _Regulator(weights))
        if loop.spectral_radius >= 1.0:
            return math.inf
        system = loop.open_loop
        closed, seen = system.A - system.B @ system.C, np.vstack([np.eye(2, len(system.A)), -system.C])
        seen[1] = np.eye(1, len(system.A), 2)
        state = np.zeros(len(closed))
        state[3] = PUSH
        for _ in range(round(SECONDS / loop.step)):
            total += loop.step * float((((seen @ state) / LARGE) ** 2).sum())
            state = closed @ state
        observer = observers.module(params).linear(params, length)
        entering, at_once = observer.b * noise, loop.gain @ observer.d * noise
        kept = solve_discrete_lyapunov(observer.a, entering @ entering.T)
        remembered = loop.gain @ observer.c
        variance = remembered @ kept @ remembered + 2.0 * remembered @ entering @ at_once + at_once @ at_once
        total += SECONDS * float(variance) / LARGE[2] ** 2
    return total / len(LENGTHS)


def tune(population: int = POPULATION, generations: int = GENERATIONS, seed: int = SEED) -> tuple[Weights, float]:
    """Return the best weights that the genetic algorithm finds, and their cost."""
    rng, known = np.random.default_rng(seed), functools.cache(cost)
    elites = round(Params().estimation.elite_fraction * population)
    bits = rng.random((population, 5 * BITS)) < 0.5
    for generation in range(generations):
        fitness = np.array([known(weights_of(row)) for row in bits])
        order = np.argsort(fitness, kind="stable")
        if generation == generations - 1:
            break
        pairs = (population - elites + 1) // 2
        first, second = bits[ga.roulette(fitness, 2 * pairs, rng)].reshape(2, pairs, -1)
        children = ga.mutate(ga.crossover(first, second, rng), 1.0 / (5 * BITS), rng)
        bits = np.concatenate([bits[order[:elites]], children[: population - elites]])
    return weights_of(bits[order[0]]), float(fitness[order[0]])


def weights_of(bits: NDArray) -> Weights:
    """Return the weights of a chromosome, (5 ``BITS``,) bits, to three digits."""
    codes = bits.reshape(5, BITS) @ (1 << np.arange(BITS)[::-1])
    low, high = map(math.log, SPAN)
    logarithms = low + (high - low) * codes / (2**BITS - 1)
    return Weights(tuple(float(f"{math.exp(value):.3g}") for value in logarithms), 1.0)


if __name__ == "__main__":
    print(*tune())
