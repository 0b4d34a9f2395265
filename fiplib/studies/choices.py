"""Which of the choices that the paper does not print give its Table 3?

A row is a tracked point and a fitness. Its columns are all combinations of the rest, ``ARMS``: number of candidates and
of generations, the window at t = 0, new or kept populations, period and phase of the runs, the median filter, and what
is called convergence. ``choices_runs`` says how they are run: in 20 flights of a rod of 1 m.

``fit_ARM`` is the log of the probability of the paper's numbers, ``log_probability``, and ``wide_ARM``, ``strict_ARM``
the same under two other assumptions, ``SENSITIVITY``. ``within_ARM``: how many of its six independent numbers lie in
the central 95 % of the simulated ones; each error is that of its length, so that six say all that nine do.
22 rows, about 5 minutes of one core.
"""

import itertools
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
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

KEYS = ("tracked", "fitness")

FITNESSES = (
    *(name for name in kalman.READINGS if name != "paper"),
    f"printed_posterior{runs.UNIT}",
    f"printed_prior{runs.UNIT}",
)
"""All readings with calibrated covariances. With unit ones the others end at l_min or l_max (table 9)."""
CANDIDATES, GENERATIONS = (12, 60), (5, 20)

SETTINGS = (tuple(runs.TRACKED), FITNESSES)
"""Levels of each of ``KEYS``."""

COLUMNS = (
    *(CANDIDATES, GENERATIONS, tuple(runs.WINDOWS), runs.POPULATIONS),
    *(runs.PERIODS, runs.PHASES, runs.MEDIANS, tuple(runs.DEFINITIONS)),
)
"""Levels of the choices within a row."""

ARMS = tuple(itertools.product(*COLUMNS))

LEVELS = {
    "tracked": ("tracked point of the vehicle", SETTINGS[0]),
    "fitness": ("fitness", SETTINGS[1]),
    "population": ("number of candidates $N_c$", COLUMNS[0]),
    "generations": ("number of generations", COLUMNS[1]),
    "window": ("window at $t = 0$", COLUMNS[2]),
    "first": ("first population of a run", COLUMNS[3]),
    "period": ("period of the runs", COLUMNS[4]),
    "phase": ("phase of the first run", COLUMNS[5]),
    "median": ("length of the median filter", COLUMNS[6]),
    "definition": ("definition of convergence", COLUMNS[7]),
}
"""Every choice, in words, and its levels: the order of the axes of ``log_probabilities``."""

WORDS = {
    "empty": "empty",
    "hover": "filled in hover",
    "circle": "filled on the circle",
    "fresh": "drawn anew",
    "kept": "kept",
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

HALF_DIGIT, HALF_TIME = 5e-4, 5e-3
"""Half a unit of the last digit that the paper prints of its lengths, m, and times, s."""
HALF_DIGITS = {"G1": HALF_DIGIT, "G2": HALF_DIGIT, "G3": 5e-2}
"""The same of the errors, m: the third is printed as 0.0."""

KERNEL = (0.01, 0.25)
"""Standard deviations in m and s of the Gaussian kernels, coarser than the rounding: nothing finer is read from 20
flights. ``wide`` doubles them; the neglected feedback moves a single flight by more (``choices_checks``)."""

SENSITIVITY = {"fit": (1.0, HALF_DIGITS["G3"]), "wide": (2.0, HALF_DIGITS["G3"]), "strict": (1.0, HALF_DIGIT)}
"""Columns: as stated; with kernels twice as wide; and with the third error taken to be 0.000."""

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
    for arm, found in runs.every_sequence(case["tracked"], case["fitness"], CANDIDATES, GENERATIONS):
        for filter_length in runs.MEDIANS:
            ends = {id: runs.outcomes(found, filter_length, start) for id, start in STARTS.items()}
            for definition in runs.DEFINITIONS:
                name = arm_name((*arm, filter_length, definition))
                pairs = {id: (end.length, end.seconds[definition]) for id, end in ends.items()}
                for column, (widening, third) in SENSITIVITY.items():
                    total = 0.0
                    for id, pair in pairs.items():
                        half = third if id == "G3" else HALF_DIGIT, HALF_TIME
                        kernel = widening * KERNEL[0], widening * KERNEL[1]
                        total += log_probability(*pair, found.weights, paper_of(id), half, kernel)
                    row[f"{column}_{name}"] = round(total, 1)
                inside = [
                    between(values, found.weights, number, slack)
                    for id, pair in pairs.items()
                    for values, number, slack in zip(pair, paper_of(id), (HALF_DIGITS[id], HALF_TIME), strict=True)
                ]
                row[f"within_{name}"] = sum(inside)
    return row


def paper_of(id: str) -> tuple[float, float]:
    """Return the paper's length in m and time in s of one of its flights."""
    return PAPER[f"{id}.length"], PAPER[f"{id}.time"]


def log_probability(
    lengths: NDArray,
    seconds: NDArray,
    weights: NDArray,
    paper: tuple[float, float],
    half: tuple[float, float],
    kernel: tuple[float, float],
) -> float:
    """Return the log of the probability that another flight gives the paper's two numbers as it rounds them.

    The density is the mean of Gaussian kernels at the simulated pairs (S,) and, as one more flight, a uniform one: the
    predictive density of a Dirichlet process. ``weights`` (S,): of a flight together 1. ``half`` a unit of the last
    digits and ``kernel``, the standard deviations, in m and s.
    """
    cells = []
    for values, number, slack, width in zip((lengths, seconds), paper, half, kernel, strict=True):
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
        return f"{TRANSITIONS[transition]}, {score.replace(runs.UNIT, ', $Q_e$=$R_e$=$I$')}"
    unit = {"period": " s"}.get(choice, "")
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
        percent = f"{100 * found.shares[choice][at]:.0f}" if found.shares[choice][at] < 0.99 else "over 99"
        return f"the {name} (most probably: {word(choice, levels[at])}, {percent}" + r"\,\%)"

    sentences = []
    if open_:
        sentences.append(f"A reader should ask the authors for {joined([named(choice) for choice in open_])}: ")
        sentences[-1] += "the numbers of the paper's Table 3 depend on each of them and settle none."
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
    """Table 17: the posterior share of each level of each unprinted choice, how many levels are left, and its effect.

    From 20 simulated flights for each of the paper's three first lengths, a rod of 1 m: the probability of the paper's
    Table 3 under every combination of the choices, with equal shares before.
    """
    found, *others = (posterior(log_probabilities(rows, column)) for column in SENSITIVITY)
    lines: list[tuple[str, ...]] = []
    for choice, (name, levels) in LEVELS.items():
        share = found.shares[choice]
        order = np.argsort(-share, kind="stable")[:3]
        words = "; ".join(f"{word(choice, levels[at])} {100 * share[at]:.0f}" for at in order)
        first = [f"{100 * other.shares[choice][order[0]]:.0f}" for other in others]
        rest = f"{effective(share):.1f}", f"{found.effects[choice]:.1f}"
        lines.append((name, f"{len(levels)}", words, *first, *rest))
    header = ("Choice", "Levels", r"Most probable levels (\%)", r"Wide (\%)", r"Strict (\%)", "Levels left", "Effect")
    return Table(header, lines, "lrlrrrr")


def fig20_choices(rows: Rows, flown: Rows, exploring: Rows) -> Figure:
    """Fig. 20: which unprinted choices give the paper's Table 3: posterior shares, and the most probable ones flown.

    20 simulated flights of a rod of 1 m serve all combinations and first lengths. Above: posterior share of each
    level of each choice; orange: its share before. Middle: convergence time and length of flights of the most probable
    combination (circles; with feedback, four flights a start), and those of the paper (stars). Below: how often the
    remarks of the paper on the search come true.
    """
    figure = Figure(figsize=(COLUMN, 7.6), layout="constrained")
    above, middle, below = figure.subfigures(3, 1, height_ratios=(4.6, 1.5, 1.7))
    _draw_shares(above.subplots(), posterior(log_probabilities(rows)))
    _draw_flights(middle.subplots(), flown)
    _draw_remarks(below, exploring)
    origin(figure, f"simulated flights, 1 m rod, {len(runs.SEEDS)} seeds")
    return figure


def _draw_shares(axes: Axes, found: Posterior) -> None:
    """A bar for each level; a line where each level was before."""
    at, names, line = [], [], 0.0
    for choice, (name, levels) in LEVELS.items():
        at.append(line)
        names.append(name)
        lines = line + 1.0 + np.arange(len(levels))
        axes.barh(lines, found.shares[choice], height=0.75, color=BLUE)
        axes.plot([1 / len(levels)] * 2, [lines[0] - 0.5, lines[-1] + 0.5], color=ORANGE, lw=0.9)
        at.extend(lines)
        names.extend(word(choice, level) for level in levels)
        line = lines[-1] + 1.3
    axes.set_yticks(at, names, fontsize=6)
    headings = {name for name, _ in LEVELS.values()}
    for label in axes.get_yticklabels():
        if label.get_text() in headings:
            label.set(style="italic", color=GREY)
    axes.tick_params(axis="y", length=0)
    axes.set(xlim=(0, 1), ylim=(line - 0.6, -0.6), xlabel="posterior share (line: before)")


def _draw_flights(axes: Axes, flown: Rows) -> None:
    """The most probable combination flown with its estimates fed back, and the paper's three flights."""
    colours = {1.2: GREEN, 0.8: BLUE, 1.4: ORANGE}
    for id, start in STARTS.items():
        some = [row for row in flown if (row["combination"], row["start"]) == ("best", start)]
        points = np.array([(row["seconds"], row["length"]) for row in some])
        style = {"color": colours[start], "ls": "none"}
        axes.plot(*points.T, "o", ms=2.5, mfc="none", mew=0.6, **style)
        label = f"paper, $l_0$ = {start} m"
        axes.plot(PAPER[f"{id}.time"], PAPER[f"{id}.length"], "*", ms=8, mec="black", mew=0.5, label=label, **style)
    axes.axhline(1.0, color="black", lw=0.5)
    axes.margins(y=0.15)
    axes.set(xlabel="convergence time (s)", ylabel="length (m)", xlim=(0, runs.SECONDS))
    axes.figure.legend(loc="outside upper center", ncols=3, handlelength=0.8)


def _draw_remarks(figure: SubFigure, exploring: Rows) -> None:
    """Share of flights in which each of the paper's remarks on the search holds, with intervals."""
    titles = {"late": "little changes\nafter 14 s", "search": "search is\nthe limit", "remedy": "the remedy\nhelps"}
    panels = figure.subplots(1, len(titles), sharey=True)
    for axes, (remark, title) in zip(panels, titles.items(), strict=True):
        for first, colour, marker, shift in (("fresh", BLUE, "o", 0.95), ("kept", ORANGE, "s", 1.05)):
            column, some = f"{remark}_{first}_{runs.STEP:g}", likelihood(exploring)
            points = np.array([(row["population"] * row["generations"], *holding(row, column)) for row in some])
            spread = np.abs(points[:, 2:] - points[:, 1:2]).T
            look = {"color": colour, "ls": "none", "elinewidth": 0.5, "label": f"population {WORDS[first]}"}
            axes.errorbar(shift * points[:, 0], points[:, 1], spread, marker=marker, ms=2.5, **look)
        axes.set(xscale="log", ylim=(-0.04, 1.04), xlim=(40, 3600), title=title)
    panels[0].set_ylabel("share of flights")
    panels[1].set_xlabel("candidates x generations of a run")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)


def likelihood(exploring: Rows) -> Rows:
    """Return the rows of the likelihood as fitness."""
    return [row for row in exploring if row["fitness"] == "rk4_likelihood"]


def holding(row: dict, column: str) -> tuple[float, float, float]:
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
