"""Which of the choices that the paper does not print give its Table 3?

A row is one setting of what takes a run of the estimator: the tracked point, the fitness, the noise covariances, N_c
and the number of generations. Its columns are all combinations of the rest, ``ARMS``: the window at t = 0, new or kept
populations, period and phase of the runs, the median filter, and what is called convergence. ``choices_runs`` says how
they are run: in 20 flights a rod of 1 m, from each of the paper's three starts.

``fit_ARM`` is the log of the probability of the paper's numbers, ``log_probability``; ``within_ARM``, how many of its
six independent numbers lie in the central 95 % of the simulated ones: each error is that of its length, so that six
say all that nine do.
324 rows, SECONDS_TO_STATE.
"""

import itertools
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.special import logsumexp, ndtr

from fiplib import kalman
from fiplib.params import Params
from fiplib.reproduction.claims import PAPER
from fiplib.reproduction.measures import binomial_interval
from fiplib.reproduction.sources import Rows
from fiplib.reproduction.style import BLUE, COLUMN, GREEN, GREY, ORANGE, origin
from fiplib.reproduction.tables import Facts, Table
from fiplib.studies import choices_runs as runs
from fiplib.studies.choices_runs import Outcome

KEYS = ("tracked", "fitness", "noise", "population", "generations")

FITNESSES = tuple(name for name in kalman.READINGS if name != "paper")
CANDIDATES, GENERATIONS = (12, 30, 60), (5, 20, 40)

SETTINGS = (tuple(runs.TRACKED), FITNESSES, runs.NOISES, CANDIDATES, GENERATIONS)
"""Levels of each of ``KEYS``."""

COLUMNS = (tuple(runs.WINDOWS), runs.POPULATIONS, runs.PERIODS, runs.PHASES, runs.MEDIANS, tuple(runs.DEFINITIONS))
"""Levels of the choices within a row."""

ARMS = tuple(itertools.product(*COLUMNS))

LEVELS = {
    "tracked": ("tracked point of the vehicle", SETTINGS[0]),
    "fitness": ("fitness", SETTINGS[1]),
    "noise": ("noise covariances", SETTINGS[2]),
    "population": ("number of candidates $N_c$", SETTINGS[3]),
    "generations": ("number of generations", SETTINGS[4]),
    "window": ("window at $t = 0$", COLUMNS[0]),
    "first": ("first population of a run", COLUMNS[1]),
    "period": ("period of the runs", COLUMNS[2]),
    "phase": ("phase of the first run", COLUMNS[3]),
    "median": ("length of the median filter", COLUMNS[4]),
    "definition": ("definition of convergence", COLUMNS[5]),
}
"""Every choice, in words, and its levels: the order of the axes of ``log_probabilities``."""

WORDS = {
    "identity": "$Q_e = R_e = I$",
    "empty": "empty",
    "hover": "filled in hover",
    "circle": "filled on the circle",
    "fresh": "drawn anew",
    "kept": "the last one",
    "window": "when the window is full",
    "clock": "by a free clock",
    "stays5": "stays within 5 cm",
    "stays10": "stays within 10 cm",
    "first5": "first within 5 cm",
}
"""Levels that need words; those of the fitness are ``TRANSITIONS`` and a score."""
TRANSITIONS = {"printed": "as printed", "euler": "Euler", "rk4": "Runge-Kutta"}

STARTS = {"G2": 1.2, "G1": 0.8, "G3": 1.4}
"""Rows of the ledger with the paper's numbers, and the length in m that each flight starts with."""

HALF_DIGIT = {"G1": 5e-4, "G2": 5e-4, "G3": 5e-2}
"""Half a unit of the last digit that the paper prints of each error, m: the third is printed as 0.0."""
HALF_TIME = 5e-3
"""The same of the times, s."""

KERNEL = (0.01, 0.25)
"""Standard deviations in m and s of the Gaussian kernels: about what the neglected feedback moves a single flight by
(``choices_checks``), so that nothing finer is read from the runs than they hold."""

BASE = (Params().estimation.length_max - Params().estimation.length_min, runs.SECONDS)
"""Extent in m and s of the uniform density that counts as one more flight: what 20 never did is not impossible."""


def arm_name(arm: tuple) -> str:
    """Return the ending of an arm's columns."""
    return "_".join(f"{level:g}" if isinstance(level, float) else f"{level}" for level in arm)


def cases() -> list[dict]:
    """Every setting."""
    return [dict(zip(KEYS, levels, strict=True)) for levels in itertools.product(*SETTINGS)]


def run(case: dict) -> dict[str, float | int]:
    """Run the estimator of one setting in every arm: the columns of all ``ARMS``."""
    row: dict[str, float | int] = {}
    setting = case["tracked"], case["fitness"], case["noise"], int(case["population"]), int(case["generations"])
    for arm, found in runs.every_sequence(*setting):
        for filter_length in runs.MEDIANS:
            ends = {id: runs.outcomes(found, filter_length, start) for id, start in STARTS.items()}
            for definition in runs.DEFINITIONS:
                name = arm_name((*arm, filter_length, definition))
                judged = [judge(end, definition, found.weights, id) for id, end in ends.items()]
                row[f"fit_{name}"] = round(sum(one[0] for one in judged), 2)
                row[f"within_{name}"] = sum(one[1] for one in judged)
    return row


def judge(end: Outcome, definition: str, weights: NDArray, id: str) -> tuple[float, int]:
    """Return the log probability of a pair of the paper's numbers, length and time, and how many of the two lie in the
    central 95 % of the simulated ones."""
    length, seconds, half = PAPER[f"{id}.length"], PAPER[f"{id}.time"], HALF_DIGIT[id]
    simulated = end.length, end.seconds[definition]
    inside = [
        between(values, weights, paper, slack)
        for values, paper, slack in zip(simulated, (length, seconds), (half, HALF_TIME), strict=True)
    ]
    return log_probability(*simulated, weights, (length, seconds), (half, HALF_TIME)), sum(inside)


def log_probability(
    lengths: NDArray, seconds: NDArray, weights: NDArray, paper: tuple[float, float], half: tuple[float, float]
) -> float:
    """Return the log of the probability that another flight gives the paper's two numbers as it rounds them.

    The density is the mean of Gaussian kernels at the simulated pairs (S,) and, as one more flight, a uniform one: the
    predictive density of a Dirichlet process. ``weights`` (S,): of a flight together 1.
    """
    cells = []
    for values, number, slack, width in zip((lengths, seconds), paper, half, KERNEL, strict=True):
        cells.append(ndtr((number + slack - values) / width) - ndtr((number - slack - values) / width))
    base = np.prod([2.0 * slack / extent for slack, extent in zip(half, BASE, strict=True)])
    return float(np.log((weights @ (cells[0] * cells[1]) + base) / (weights.sum() + 1.0)))


def between(values: NDArray, weights: NDArray, number: float, slack: float) -> bool:
    """Whether a number, give or take the slack, lies in the central 95 % of weighted values."""
    share = weights / weights.sum()
    below, above = share @ (values < number - slack), share @ (values > number + slack)
    return bool(below <= 0.975 and above <= 0.975)


# --- the posterior


def log_probabilities(rows: Rows, column: str = "fit") -> NDArray:
    """Return a column's values of every combination, an axis for each of ``LEVELS``."""
    known = {tuple(row[key] for key in KEYS): row for row in rows}
    names = [f"{column}_{arm_name(arm)}" for arm in ARMS]
    found = [[known[setting][name] for name in names] for setting in itertools.product(*SETTINGS)]
    return np.array(found).reshape([len(levels) for _, levels in LEVELS.values()])


class Posterior(NamedTuple):
    """Of all combinations, each as probable as the others before: ``log`` their log probabilities, one axis a choice;
    ``shares`` those of the levels of each choice; ``number`` the effective number of combinations, exp of the entropy;
    ``effects`` the range of the log probability over the levels of a choice, all others fixed: posterior mean."""

    log: NDArray
    shares: dict[str, NDArray]
    number: float
    effects: dict[str, float]


def posterior(fit: NDArray) -> Posterior:
    """Return the posterior of log probabilities of the paper's numbers, one axis for each of ``LEVELS``."""
    log = fit - logsumexp(fit)
    probability = np.exp(log)
    shares, effects = {}, {}
    for axis, choice in enumerate(LEVELS):
        others = tuple(other for other in range(fit.ndim) if other != axis)
        shares[choice] = probability.sum(axis=others)
        effects[choice] = float((probability.sum(axis=axis) * np.ptp(fit, axis=axis)).sum())
    return Posterior(log, shares, effective(probability), effects)


def effective(probability: NDArray) -> float:
    """Return exp of the entropy: how many equally probable ones are as undecided as these."""
    some = probability[probability > 0]
    return float(np.exp(-(some * np.log(some)).sum()))


def best(fit: NDArray, number: int = 1) -> list[tuple]:
    """Return the most probable combinations, levels in the order of ``LEVELS``."""
    levels = [levels for _, levels in LEVELS.values()]
    order = np.argsort(-fit, axis=None, kind="stable")[:number]
    places = zip(*np.unravel_index(order, fit.shape), strict=True)
    return [tuple(known[at] for known, at in zip(levels, place, strict=True)) for place in places]


def word(choice: str, level: object) -> str:
    """Return a level in words."""
    if choice == "fitness":
        transition, _, score = str(level).partition("_")
        return f"{TRANSITIONS[transition]}, {score}"
    unit = {"period": r"\,s"}.get(choice, "")
    return WORDS.get(str(level), f"{level:g}{unit}" if isinstance(level, float | int) else str(level))


SETTLED, MATTERS = 0.9, 1.0
"""A choice is settled by the paper's numbers from this share of a level on; it matters to them if it changes the log of
their probability by so much."""


def questions(found: Posterior) -> str:
    """Return what to ask the authors, in words: the choices that matter to the numbers and are not settled by them."""
    entropy = {choice: np.log(effective(share)) / np.log(len(share)) for choice, share in found.shares.items()}
    order = sorted(LEVELS, key=lambda choice: -entropy[choice])
    matters = [choice for choice in order if found.effects[choice] >= MATTERS]
    settled = [choice for choice in reversed(order) if found.shares[choice].max() >= SETTLED]
    open_ = [choice for choice in matters if choice not in settled]
    rest = [choice for choice in order if choice not in (*open_, *settled)]

    def named(choice: str) -> str:
        name, levels = LEVELS[choice]
        at = int(found.shares[choice].argmax())
        return f"the {name} (most probably: {word(choice, levels[at])}, {100 * found.shares[choice][at]:.0f}" + r"\,\%)"

    sentences = []
    if open_:
        sentences.append(f"A reader should ask the authors for {joined([named(choice) for choice in open_])}: ")
        sentences[-1] += "the numbers of Table 3 depend on each of them and settle none."
    if settled:
        sentences.append(f"The numbers themselves settle {joined([named(choice) for choice in settled])}.")
    if rest:
        names = joined([f"the {LEVELS[choice][0]}" for choice in rest])
        sentences.append(
            f"{names[0].upper()}{names[1:]} {'hardly matters' if len(rest) == 1 else 'hardly matter'} here."
        )
    return " ".join(sentences)


def joined(words: list[str]) -> str:
    """Return words as a list in a sentence."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def table17_choices(rows: Rows) -> Table:
    """Table 17: the posterior share of each level of each unprinted choice, how many levels are left, and how much the
    choice matters."""
    found, lines = posterior(log_probabilities(rows)), []
    for choice, (name, levels) in LEVELS.items():
        share = found.shares[choice]
        order = np.argsort(-share, kind="stable")[:3]
        words = "; ".join(f"{word(choice, levels[at])} {100 * share[at]:.0f}" for at in order)
        lines.append((name, f"{len(levels)}", words, f"{effective(share):.1f}", f"{found.effects[choice]:.1f}"))
    header = ("Choice", "Levels", r"Most probable levels (\%)", "Levels left", "Effect (nats)")
    return Table(header, lines, "lrlrr")


def fig20_choices(rows: Rows, flown: Rows, exploring: Rows) -> Figure:
    """Fig. 20: posterior shares of all unprinted choices; the most probable combination flown; the paper's remarks."""
    found = posterior(log_probabilities(rows))
    figure = Figure(figsize=(COLUMN, 7.4), layout="constrained")
    grid = figure.add_gridspec(3, 3, height_ratios=(4.4, 1.5, 1.3))
    above, middle = figure.add_subplot(grid[0, :]), figure.add_subplot(grid[1, :])
    lines, ticks, names = 0.0, [], []
    for choice, (name, levels) in LEVELS.items():
        above.text(1.0, lines, name, ha="right", va="center", fontsize=7, color=GREY, style="italic")
        for level, share in zip(levels, found.shares[choice], strict=True):
            above.barh(lines, share, height=0.75, color=BLUE)
            ticks.append(lines)
            names.append(word(choice, level))
            lines += 1.0
        above.plot([1 / len(levels)] * 2, [lines - len(levels) - 0.5, lines - 0.5], color=ORANGE, lw=0.9)
        lines += 0.5
    above.set(yticks=ticks, yticklabels=names, xlim=(0, 1), ylim=(lines - 0.6, -0.8), xlabel="posterior share")
    above.tick_params(axis="y", labelsize=6, length=0)
    colours = {1.2: GREEN, 0.8: BLUE, 1.4: ORANGE}
    for id, start in STARTS.items():
        some = [row for row in flown if (row["combination"], row["start"]) == ("best", start)]
        points = np.array([(row["seconds"], row["length"]) for row in some])
        style = {"color": colours[start], "ls": "none"}
        middle.plot(*points.T, "o", ms=2.5, mfc="none", mew=0.6, **style)
        label = f"$l_0$ = {start} m"
        middle.plot(PAPER[f"{id}.time"], PAPER[f"{id}.length"], "*", ms=8, mec="black", mew=0.5, label=label, **style)
    middle.axhline(1.0, color="black", lw=0.5)
    middle.set(xlabel="convergence time (s)", ylabel="length (m)", xlim=(0, runs.SECONDS))
    middle.legend(loc="upper right", ncols=3, handlelength=1.0)
    titles = {"late": "little change\nafter 14 s", "search": "search is\nthe limit", "remedy": "remedy\nmends it"}
    below = [figure.add_subplot(grid[2, column]) for column in range(3)]
    for axes, (remark, title) in zip(below, titles.items(), strict=True):
        for first, colour, marker, shift in (("fresh", BLUE, "o", 0.96), ("kept", ORANGE, "s", 1.04)):
            points = np.array(
                [
                    (row["population"] * row["generations"], *share(row, f"{remark}_{first}_0.2"))
                    for row in seat(exploring)
                ]
            )
            spread = np.abs(points[:, 2:] - points[:, 1:2]).T
            look = {"color": colour, "ls": "none", "elinewidth": 0.5, "label": WORDS[first]}
            axes.errorbar(shift * points[:, 0], points[:, 1], spread, marker=marker, ms=2.5, **look)
        axes.set(xscale="log", ylim=(-0.04, 1.04), xlim=(40, 3600), title=title)
        axes.set_yticks((0, 0.5, 1), ("0", "½", "1") if axes is below[0] else ("", "", ""))
    below[0].set_ylabel("share of flights")
    below[1].set_xlabel("candidates x generations of a run")
    below[2].legend(loc="best", fontsize=6)
    origin(figure, f"simulated flights, 1 m rod, {len(runs.SEEDS)} seeds")
    return figure


def seat(exploring: Rows) -> Rows:
    """Return the rows of the seat tracked and the likelihood as fitness."""
    return [row for row in exploring if (row["tracked"], row["fitness"]) == ("seat", "rk4_likelihood")]


def share(row: dict, column: str) -> tuple[float, float, float]:
    """Return the share of flights in which a remark holds, and its exact 95 % interval."""
    holds, flights = round(row[column]), len(runs.SEEDS)
    return holds / flights, *binomial_interval(holds, flights)


def facts(rows: Rows) -> Facts:
    """Return what the report states: the shares in %, the effective numbers, the combinations that give all numbers,
    and what to ask the authors."""
    fit, within = log_probabilities(rows), log_probabilities(rows, "within")
    found = posterior(fit)
    facts_: Facts = {
        ("combinations",): f"{fit.size}",
        ("effective",): f"{found.number:.0f}",
        ("all", "numbers"): f"{int((within == 6).sum())}",
        ("all", "share"): f"{100 * (within == 6).mean():.1f}",
        ("questions",): questions(found),
    }
    for choice, (_, levels) in LEVELS.items():
        facts_[choice, "left"] = f"{effective(found.shares[choice]):.1f}"
        facts_[choice, "effect"] = f"{found.effects[choice]:.1f}"
        for level, probability in zip(levels, found.shares[choice], strict=True):
            facts_[choice, f"{level:g}" if isinstance(level, float) else f"{level}"] = f"{100 * probability:.0f}"
    return facts_
