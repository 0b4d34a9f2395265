"""Survival of the loop with its own estimator: random rods and first lengths, and five ways to the used length.

A flight is drawn by its index: l0 uniform in [0.4, 1.6] m, and a uniform rod. The first ``EXPECTED`` rods are as the
trusted hand-over expects them, uniform in [0.5, 1.5] m; of the next ``OUTSIDE`` every other one is shorter, in
[0.3, 0.5] m, and the others longer, in [1.5, 2] m. It follows the 0.4 m circle, which starts at once. A row is one
flight under one policy:

- ``told``: the controller has the true length from the start. No estimator could save a rod that falls here.
- ``printed``: the paper's genetic algorithm and hand-over from l0 on, with the likelihood as its fitness (our default);
  ``short``: the same from the first length of ``trusted``, the shortest rod to expect, instead of l0;
  ``literal``, for the first ``LITERAL`` indices only: from l0, with the fitness that the paper prints.
- ``trusted``: the estimate from poses, and the hand-over that trusts it in proportion to its precision.

All policies fly the same rod with the same noise. 840 rows, about 5 minutes of two cores.
"""

import math
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from fiplib.params import A, B, Params
from fiplib.references import Circle
from fiplib.reproduction import measures
from fiplib.reproduction.sources import Rows
from fiplib.reproduction.style import BLUE, COLUMN, GREY, ORANGE, origin
from fiplib.reproduction.tables import NONE, Facts, Table
from fiplib.simulate import Scenario
from fiplib.studies import seconds_flown
from fiplib.studies.batch import fly_many
from fiplib.studies.estimators import ranged

KEYS = ("policy", "index")

EXPECTED, OUTSIDE, LITERAL = 100, 100, 40

POLICIES: dict[str, dict] = {
    "told": {},
    "printed": {"piloting__estimate": True},
    "short": {"piloting__estimate": True},
    "literal": {"piloting__estimate": True, "estimation__fitness": "paper"},
    "trusted": {
        "piloting__estimate": True,
        "piloting__handover": "trusted",
        "estimation__estimator": "poses",
    },
}
"""Parameters of each policy; all but ``told`` and ``short`` start from l0."""

SECONDS = 12.0
CIRCLE = Circle(radius=0.4, period=8.0, start=0.0, ramp=2.0)

FEW = 6
"""Below so many flights no interval of a time is given."""

SETTLED = 0.05
"""The used length counts as brought in when it is within this share of the true one, and stays there."""


def cases() -> list[dict]:
    """Every flight under every policy; lengths in m, ``gyration`` is k^2/l^2 of the rod."""
    found = []
    for index in range(EXPECTED + OUTSIDE):
        rng = np.random.default_rng(index)
        first = round(rng.uniform(0.4, 1.6), 4)
        rods = (0.5, 1.5) if index < EXPECTED else ((0.3, 0.5), (1.5, 2.0))[index % 2]
        flight = {
            "initial_length": first,
            "true_length": round(rng.uniform(*rods), 4),
            "gyration": 1 / 12,
            "seed": index,
        }
        found += [
            {"index": index, "policy": policy, **flight}
            for policy in POLICIES
            if policy != "literal" or index < LITERAL
        ]
    return found


def run(case: dict) -> dict[str, float | int | str]:
    """Fly one case.

    Returns:
        initial_length and true_length (m) of the case; survived (1 or 0) and seconds flown; settled, the time in s from
        which on the used length was within ``SETTLED`` of the true one, nan if at the end it was not; used_length at
        the end (m); longest_used, the largest used over true length; largest_lean, of |a| and |b| (m).
    """
    true, first = case["true_length"], case["initial_length"]
    starts = {"told": true, "short": min(first, Params().piloting.rod_lengths[0])}
    params = Params().replace(
        pendulum__length=true,
        pendulum__gyration_ratio=case["gyration"],
        piloting__initial_length=starts.get(case["policy"], first),
        **POLICIES[case["policy"]],
    )
    scenario = Scenario("handover", "", SECONDS, CIRCLE, params=params, seed=case["seed"])
    [flight] = fly_many([scenario])
    times, used = measures.used_length(flight)
    settled = measures.settling_time(times, np.abs(used / true - 1) >= SETTLED)
    return {
        "initial_length": first,
        "true_length": true,
        "survived": int(flight.survived),
        "seconds": seconds_flown(flight, scenario),
        "settled": settled if settled < math.inf else math.nan,
        "used_length": float(used[-1]),
        "longest_used": float((used / true).max()),
        "largest_lean": float(np.abs(flight.truth_state.values[:, [A, B]]).max()),
    }


LABELS = {
    "told": "the true length",
    "trusted": "trusted hand-over, raw poses",
    "short": "as printed, first length 0.5 m",
    "printed": "as printed, GA with the likelihood",
    "literal": "as printed, GA with the printed fitness",
}
"""Ways to the used length, as figures and tables name them."""

RODS = {"expected": "0.5 to 1.5", "shorter": "0.3 to 0.5", "longer": "1.5 to 2"}
"""Kinds of rods by their lengths in m."""


def kind_of(row: dict) -> str:
    """Return which of ``RODS`` a row's rod is."""
    if row["index"] < EXPECTED:
        return "expected"
    return ("shorter", "longer")[int(row["index"]) % 2]


def fig11_handover(rows: Rows) -> Figure:
    """Fig. 11: random rods and random first lengths: which flights stay up under three ways to hand over the length.

    200 simulated flights of 12 s on the 0.4 m circle (8 s) for each way, the same rods (uniform) and noise: as printed
    from the drawn first length, as printed from 0.5 m, and the trusted hand-over of the estimate from raw poses. Grey:
    rods to expect, half of all flights. Titles: how many stay up, with the binomial 95 % interval of their share. The
    short start alone saves the expected rods; the shorter ones need an estimate within two seconds, which only the
    trusted hand-over has.
    """
    figure = Figure(figsize=(COLUMN, 2.9), layout="constrained")
    panels = figure.subplots(1, 3, sharex=True, sharey=True)
    shown = {"printed": "printed", "short": "from 0.5 m", "trusted": "trusted"}
    for axes, (policy, title) in zip(panels, shown.items(), strict=True):
        told, flown, up = _flown(rows, policy)
        fell = [row for row in flown if row["survived"] != 1 and row["index"] in told]
        hopeless = [row for row in flown if row["survived"] != 1 and row["index"] not in told]
        axes.axhspan(0.5, 1.5, color=GREY, alpha=0.12, lw=0)
        for some, marker, size, colour, label in (
            (up, ".", 2.0, BLUE, "stays up"),
            (fell, "x", 3.5, ORANGE, "falls"),
            (hopeless, "+", 4.0, GREY, "falls with the true length, too"),
        ):
            points = np.array([(row["initial_length"], row["true_length"]) for row in some]).reshape(-1, 2)
            axes.plot(*points.T, marker, ms=size, mew=0.8, color=colour, label=label if some else None)
        low, high = (100 * side for side in measures.binomial_interval(len(up), len(flown)))
        title = f"{title}:\n{len(up)} of {len(flown)} up\n({low:.0f} to {high:.0f} %)"
        axes.set(title=title, xlim=(0.37, 1.63), xticks=(0.5, 1.0, 1.5))
    panels[0].set(ylabel="true length (m)", ylim=(0.25, 2.05))
    panels[1].set(xlabel="first length l0 drawn (m)")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    origin(figure, "simulated flights of 12 s, uniform rods; grey: expected rods")
    return figure


def _flown(rows: Rows, policy: str) -> tuple[set[float], Rows, Rows]:
    """Return the indices that stay up with the true length; the rows of a policy, and those of them that stay up."""
    told = {row["index"] for row in rows if row["policy"] == "told" and row["survived"] == 1}
    flown = [row for row in rows if row["policy"] == policy]
    return told, flown, [row for row in flown if row["survived"] == 1]


def _times(up: Rows) -> NDArray:
    """Return the times in s after which the used length is right, of those flights in which it comes to be so."""
    return np.array([row["settled"] for row in up if math.isfinite(row["settled"])])


class HandedOver(NamedTuple):
    """A policy over all flights with one kind of rod: how many; how many stay up; the share ``kept`` of those that stay
    up with the true length, with its 95 % interval; of those up, the share whose used length is ``right`` at the end,
    mean and 95 % quantile of the time after which it is, s; the largest used over true length. nan: none."""

    flights: int
    up: int
    kept: float
    low: float
    high: float
    right: float
    mean_time: float
    late_time: float
    longest: float


def handed_over(rows: Rows, policy: str, rods: str = "expected") -> HandedOver:
    """A policy's rows of the study 'handover' with one kind of rod."""
    told, flown, up = _flown([row for row in rows if kind_of(row) == rods], policy)
    asked = [row for row in flown if row["index"] in told]
    kept = sum(row["survived"] == 1 for row in asked)
    times = _times(up)
    mean, late = (float(times.mean()), float(np.quantile(times, 0.95))) if len(times) else (math.nan, math.nan)
    return HandedOver(
        len(flown),
        len(up),
        kept / len(asked) if asked else math.nan,
        *measures.binomial_interval(kept, len(asked)),
        len(times) / len(up) if up else math.nan,
        mean,
        late,
        float(max((row["longest_used"] for row in flown), default=math.nan)),
    )


def _after(found: HandedOver, times: NDArray) -> tuple[str, str]:
    """Return cells with the mean and the 95 % quantile of times in s, and their intervals where there are enough."""
    if not len(times):
        return NONE, NONE
    if len(times) < FEW:
        return f"{found.mean_time:.2f}", f"{found.late_time:.2f}"
    mean = measures.bootstrap_interval(times, lambda some: float(some.mean()))
    low, high = (f"{end:.2f}" if math.isfinite(end) else NONE for end in measures.quantile_interval(times, 0.95))
    return ranged(found.mean_time, *mean, 2), f"{found.late_time:.2f} ({low} to {high})"


def table8_handover(rows: Rows) -> Table:
    """Table 8: random rods and first lengths under five ways to the length in use: survival, time until it is right.

    200 simulated flights of 12 s on the 0.4 m circle (8 s), of the printed fitness 40, uniform rods, the same noise for
    all ways. In brackets: 95 % intervals, of shares binomial, of mean times by a bootstrap over flights, of the 95 %
    quantile exact from its order statistics; a dash: too few flights to limit it from above. Right: within 5 % of the
    true length from the time given on.
    """
    lines = []
    for policy, label in LABELS.items():
        for rods, lengths in RODS.items():
            found = handed_over(rows, policy, rods)
            if not found.flights:
                continue
            late = (NONE,) * 3
            if policy != "told" and found.up:
                times = _times(_flown([row for row in rows if kind_of(row) == rods], policy)[2])
                low, high = (100 * side for side in measures.binomial_interval(round(found.right * found.up), found.up))
                late = (
                    f"{100 * found.right:.0f} ({low:.0f} to {high:.0f})",
                    *_after(found, times),
                )
            kept = f"{100 * found.kept:.0f} ({100 * found.low:.0f} to {100 * found.high:.0f})"
            lines.append((
                label, lengths, f"{found.flights}", f"{found.up}", kept if policy != "told" else NONE, *late,
                f"{found.longest:.2f}",
            ))  # fmt: skip
    header = (
        "Used length", "Rods (m)", "Flights", "Up", r"Up, of those up with the true length (\%)",
        r"Right at the end (\%)", "After, mean (s)", r"After, 95\,\% (s)", "Longest used / true",
    )  # fmt: skip
    return Table(header, lines, "llrrrrrrr")


def facts(rows: Rows) -> Facts:
    """Return what the report states of each policy: with the rods to expect, and with all others."""
    found: Facts = {}
    for policy in LABELS:
        one = handed_over(rows, policy)
        found |= {
            (policy, "flights"): f"{one.flights}",
            (policy, "up"): f"{one.up}",
            (policy, "kept"): f"{100 * one.kept:.1f}",
            (policy, "kept", "low"): f"{100 * one.low:.0f}",
            (policy, "kept", "high"): f"{100 * one.high:.0f}",
            (policy, "time"): f"{one.mean_time:.2f}",
            (policy, "late"): f"{one.late_time:.2f}",
            (policy, "right"): f"{100 * one.right:.0f}",
            (policy, "longest"): f"{one.longest:.2f}",
        }
        others = [handed_over(rows, policy, rods) for rods in ("shorter", "longer")]
        if all(other.flights for other in others):
            found[policy, "outside", "flights"] = f"{sum(other.flights for other in others)}"
            found[policy, "outside", "up"] = f"{sum(other.up for other in others)}"
        for rods, other in zip(("shorter", "longer"), others, strict=True):
            if other.flights:
                low, high = measures.binomial_interval(other.up, other.flights)
                found |= {
                    (policy, rods, "flights"): f"{other.flights}",
                    (policy, rods, "up"): f"{other.up}",
                    (policy, rods, "low"): f"{100 * low:.0f}",
                    (policy, rods, "high"): f"{100 * high:.0f}",
                }
    return found
