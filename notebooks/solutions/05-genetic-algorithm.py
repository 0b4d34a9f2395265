"""Solutions of the exercises in 05-genetic-algorithm."""

import math

import numpy as np


def decode(bits, length_min, resolution):
    codes = bits @ 2 ** np.arange(bits.shape[1])[::-1]
    return length_min + codes * resolution


def roulette_probabilities(fitness):
    feasible = np.isfinite(fitness)
    weight = np.where(feasible, fitness[feasible].max() - fitness, 0.0)
    return weight / weight.sum()


def diversity(bits):
    # a bit that m of N candidates have set differs in m (N - m) pairs
    ones = bits.sum(axis=0)
    return (ones * (len(bits) - ones)).sum() / math.comb(len(bits), 2)
