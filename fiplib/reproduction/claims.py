"""Every number that the paper states, what our flights give, and the verdict: the ledger.

A new claim is one function, (paper's number, what it is read from) -> ``Finding``, and one line in ``CLAIMS``. What is
measured on a flight stands in ``measures``; ``fip claims`` judges all claims and writes the files.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache, partial
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from fiplib.params import X_DOT, Y_DOT, X, Y
from fiplib.recording import Flight
from fiplib.reproduction.measures import (
    CONVERGED,
    FALL_ANGLE,
    FINAL_SECONDS,
    angle,
    convergence,
    fall_time,
    jumps,
    laps,
    lean,
    push_times,
    rms,
    settling_time,
    tracking_error,
    used_length,
    x_response,
)
from fiplib.reproduction.sources import Quantities, Rows, Sources

ABOUT = 0.25
"""Relative difference within which a measured number of the paper counts as met. It says "approximately", and pushes,
period and noise were other ones than ours: closer agreement would mean nothing."""

LITTLE = 0.1
"""What the paper calls minimal (undershoot), slight (delay, in quarter periods) or little (convergence): a tenth."""

SETTLED = 0.01
"""Band in m within which a and b count as settled (D3). The paper names none; 1 cm is a sixth of its largest push."""

ACCURACY = 0.029
"""Largest error in the paper's Table 3, m. Its three flights scatter from 0.0 to here: a flight of ours that ends as
close as the worst of them is as good, and one flight cannot tell more."""

LATE = 14.0
"""Time in s after which the paper saw little to no convergence (G4)."""

EXPLORING = {"estimation__elite_fraction": 0.05, "estimation__mutation_rate": 0.2}
"""The paper's remedy, fewer elites and more mutation, for which it gives no numbers: r_p from a sixth to a twentieth,
r_m doubled."""

SOLVE_TIME = "mpc_p99"
"""The quantity of benchmarks/solve_times.csv that must fit into a tick: 99 % of the solves take no longer."""


CHOSEN = "Our weights were chosen among those that met this row before the plant had a raised seat (table 7)"
"""Said by rows that the study 'weights' asked for and that other weights would not meet."""


class Verdict(StrEnum):
    """What a row of the ledger says."""

    REPRODUCED = "reproduced"
    STATED = "reproduced under a stated reading"
    NOT = "not reproduced"
    VEHICLE = "cannot be tested without the vehicle"
    OPEN = "open"


HELD = (Verdict.REPRODUCED, Verdict.STATED)
"""The verdicts of a row that holds."""


class Finding(NamedTuple):
    """What a claim's function found: ``value`` in the claim's unit (NaN: none), the verdict, under which ``reading`` of
    the paper and why; ``facts`` are further numbers by name, for the report."""

    value: float
    verdict: Verdict
    reading: str
    facts: Mapping[str, float] = MappingProxyType({})


@dataclass(frozen=True)
class Claim(Sources):
    """A claim of the paper: ``paper`` is its number in ``unit`` (None: it states none), shown with ``decimals``.

    ``judge(paper, *sources)`` gets what ``Sources.read`` returns.
    """

    id: str
    text: str
    paper: float | None
    unit: str
    decimals: int
    judge: Callable[..., Finding]


def verdict(holds: bool) -> Verdict:
    """The verdict of a row that was tested. None is reproduced without more: each stands on a choice of ours, if only
    the simulated vehicle's noise, push or circle, and its reading says which."""
    return Verdict.STATED if holds else Verdict.NOT


def about(value: float, paper: float) -> bool:
    """Whether a number meets the paper's within ``ABOUT``."""
    return abs(value - paper) <= ABOUT * abs(paper)


def pushes_kept(paper: float, flight: Flight) -> Finding:
    """D1: the number of pushes after which the rod is still up when the next one comes, or the flight ends."""
    times, fell = push_times(flight), fall_time(flight)
    kept = sum(fell > until for until in [*times[1:], flight.duration])
    when = ", ".join(f"{time:.1f}" for time in times)
    words = f"Pushed at {when} s, as hard as we chose (D2). Up: the rod leans less than "
    words += f"{math.degrees(FALL_ANGLE):.0f} deg"
    return Finding(kept, verdict(kept == len(times) == paper), words)


def push_lean(paper: float, flight: Flight) -> Finding:
    """D2: max(|a|, |b|) from the first push on, m."""
    largest = float(lean(flight)[flight.time(flight.state) >= push_times(flight)[0]].max())
    known = (event.data.get("impulse") for event in flight.events if event.kind == "push")
    impulses = [1e3 * math.hypot(*impulse) for impulse in known if impulse]
    words = "The paper does not say how hard it pushed. Our pushes were chosen to lead about as far; what is tested is"
    words += " that the rod comes back from there"
    met = math.isinf(fall_time(flight)) and about(largest, paper)
    return Finding(largest, verdict(met), words, {"impulse": max(impulses, default=math.nan)})


def as_angle(paper: float, flight: Flight, *, of: str) -> Finding:
    """D2, C1 in degrees: asin(offset / (l/2)); the paper's own offset is turned into degrees the same way."""
    found, theirs = BY_ID[of].judge(PAPER[of], flight), angle(PAPER[of], flight)
    words = f"Row {of}, asin(offset / (l/2)). The paper's {PAPER[of]:g} m make {theirs:.2f} deg; it prints {paper:g}"
    return Finding(angle(found.value, flight), found.verdict, words, {"arithmetic": theirs})


def push_settling(paper: float, flight: Flight) -> Finding:
    """D3: time from a push until |a| and |b| stay below ``SETTLED``, s; the longest of all pushes."""
    outside, starts = lean(flight) > SETTLED, push_times(flight)
    time = flight.time(flight.state)
    spans = [(time >= start) & (time < until) for start, until in zip(starts, [*starts[1:], math.inf], strict=True)]
    longest = max(settling_time(time[s], outside[s]) - start for s, start in zip(spans, starts, strict=True))
    words = f"Settled: a and b stay within {100 * SETTLED:g} cm (the paper names no band). The slowest of the pushes."
    words += f" {CHOSEN}"
    return Finding(longest, verdict(about(longest, paper)), words, {"band": 100 * SETTLED})


def circle_lean(paper: float, flight: Flight) -> Finding:
    """C1: max(|a|, |b|) over the whole flight, start included, m."""
    largest, lap = float(lean(flight).max()), laps(flight)
    words = f"A lap in {lap.period:.1f} s is our reading, chosen so that the lean agrees: the paper states no period"
    met = math.isinf(fall_time(flight)) and about(largest, paper)
    return Finding(largest, verdict(met), words, {"period": lap.period, "radius": lap.radius})


def circle_gain(paper: None, flight: Flight) -> Finding:
    """C2: amplitude of x over that of its reference, last whole laps."""
    gain, _ = x_response(flight)
    words = f"'Minimal undershoot': an amplitude short by up to {100 * LITTLE:g} %. Our period, see C1. {CHOSEN}"
    return Finding(gain, verdict(1 - LITTLE <= gain < 1), words)


def circle_delay(paper: None, flight: Flight) -> Finding:
    """C2: how far x lags behind its reference, s, last whole laps."""
    _, delay = x_response(flight)
    slight = LITTLE * laps(flight).period / 4
    words = f"'Slight delay': above 0, up to a tenth of a quarter period, {slight:.2f} s"
    ahead = ". Ours runs ahead: the MPC sees the reference over its whole horizon" if delay <= 0 else ""
    return Finding(delay, verdict(0 < delay <= slight), words + ahead)


def circle_y(paper: float, flight: Flight) -> Finding:
    """C2: max |y - y_ref| over the whole flight, m."""
    largest = float(np.abs(tracking_error(flight)[:, 1]).max())
    words = "Largest error of the whole flight"
    light = [f"{flight.params.control.state_weights[state]:g}" for state in (X, X_DOT, Y, Y_DOT)]
    words += f". Weights of x, x', y, y': {', '.join(light)}; those of y were chosen light for this row, see C3"
    return Finding(largest, verdict(about(largest, paper)), words)


def heavier_y(paper: None, rows: Rows) -> Finding:
    """C3: largest error of y with the weights of x and x' for y and y' too, over that with ours; means over seeds.

    Mended means that the difference is more than chance and choice of the criterion could make: beyond ``ABOUT``.
    """
    circling = [row for row in rows if row["scenario"] == "circle-0.8"]
    errors = ([row["y_error"] for row in circling if row["variant"] == variant] for variant in ("default", "y heavy"))
    (seeds, light), (heavy_seeds, heavy) = ((len(some), float(np.mean(some or math.nan))) for some in errors)
    if not (seeds and heavy_seeds):
        return Finding(math.nan, Verdict.OPEN, "The study 'ledger_seeds' is not complete")
    words = f"Weights of y and y' ten times ours, as those of x and x': {light:.3f} m ({seeds} seeds) become "
    words += f"{heavy:.3f} m ({heavy_seeds} seeds). That y's weights were light in the paper is our reading"
    return Finding(heavy / light, verdict(heavy / light < 1 - ABOUT), words, {"light": light, "heavy": heavy})


def small_steps(paper: None, rows: Rows) -> Finding:
    """G6: of the outliers of 2 s that make the rod fall when taken over at once, the share that steps make harmless."""
    if not rows:
        return Finding(math.nan, Verdict.OPEN, "The study 'length_jumps' is not complete")
    at_once, stepped = (
        {(row["lasting"], row["length"], row["rod"]): row["survived"] for row in rows if row["change"] == change}
        for change in ("at once", "in steps")
    )
    flights = max(stepped.values())
    outliers, lasting = (
        [stepped[case] == flights for case, survived in at_once.items() if case[0] == kind and survived == 0]
        for kind in ("2 s", "to the end")
    )
    saved, delayed = (float(np.mean(some)) if some else math.nan for some in (outliers, lasting))
    words = "No outlier of 2 s makes the rod fall at once, so that steps have none to save"
    if outliers:
        words = f"Outliers of 2 s that fell at once ({len(outliers)} of the study): share that steps of 5 cm each 0.2 s"
        words += " make harmless"
    words += f". Of wrong lengths that stay ({len(lasting)}): {delayed:.2f}, the rest "
    words += "is only put off, since such a length does not fly"
    facts = {"lasting": delayed, "outliers": len(outliers), "wrong": len(lasting)}
    return Finding(saved, verdict(saved > 0.5), words, facts)


def final_length(paper: float, flight: Flight) -> Finding:
    """G1-G3: the length that the flight's estimate came to, m."""
    found, e, lap = convergence(flight), flight.params.estimation, laps(flight)
    words = f"A run each {e.run_period:g} s on {e.window} samples at {1 / e.sample_period:g} Hz, fitness '{e.fitness}',"
    words += " noise covariances from a simulated flight's truth, our circle; median of the used length over the last"
    words += f" {FINAL_SECONDS:g} s"
    return Finding(found.length, verdict(found.error <= ACCURACY), words, {"period": lap.period, "radius": lap.radius})


def final_error(paper: float, flight: Flight) -> Finding:
    """G1-G3: how far that is from the rod's length, m."""
    error = convergence(flight).error
    words = f"Met when as close as the paper's worst flight, {ACCURACY:g} m: one flight cannot tell more"
    return Finding(error, verdict(error <= ACCURACY), words)


def convergence_time(paper: float, flight: Flight) -> Finding:
    """G1-G3: when the used length came to within ``CONVERGED`` of its final value to stay there, s from the start.

    Met if it first came that close at about the same time: what comes, drifts off and returns has not converged then.
    """
    final, _, time = convergence(flight)
    moments, used = used_length(flight)
    first = float(moments[np.argmax(np.abs(used - final) <= CONVERGED)])
    full = (flight.params.estimation.window - 1) * flight.params.estimation.sample_period
    words = f"Within {100 * CONVERGED:g} cm of its final value to stay there (the paper defines no convergence)"
    if full > paper:
        words += f". {paper:g} s cannot be reached under this reading: the first window takes {full:.1f} s to fill"
    elif about(time, paper) and not about(first, paper):
        words += f". No match: it first comes that close at {first:.1f} s, drifts off by a little and returns"
    elif time < paper and not about(time, paper):
        words += f". Ours is earlier: the first window, full at {full:.1f} s, gives nearly the final value"
    return Finding(time, verdict(about(time, paper) and about(first, paper)), words, {"window": full, "first": first})


def printed_fitness(paper: float, flight: Flight) -> Finding:
    """G1-G3: the length at which the fitness as printed (Euler, J = df/dx, posterior residual) is smallest, searched
    exhaustively in steps of 1 mm; median over windows of the flight."""
    from fiplib import ga, replay  # here and below: figures import this module, and need not wait for CasADi

    ours = flight.params.replace(estimation__fitness="paper", estimation__resolution=1e-3)
    unit = ours.replace(estimation__process_noise=(1.0,) * 10, estimation__measurement_noise=(1.0,) * 10)
    windows = replay.spaced_windows(flight)
    best, plain = (float(np.median([ga.landscape(window, p).best for window in windows])) for p in (ours, unit))
    words = f"Fitness exactly as printed, exhaustive search, median of {len(windows)} windows of this flight, our noise"
    words += f" covariances. With Q_e = R_e = I it is {plain:.3f} m"
    met, plain_met = (abs(length - flight.params.pendulum.length) <= ACCURACY for length in (best, plain))
    words += ": it is the covariances that decide" if met != plain_met else ""
    return Finding(best, verdict(met), words, {"identity": plain})


def late_convergence(paper: None, *flights: Flight) -> Finding:
    """G4: share of the initial error that goes after ``LATE``; the largest of the flights."""
    shares = []
    for flight in flights:
        time, used = used_length(flight)
        initial, late = np.abs(used[[0, np.searchsorted(time, LATE, "right") - 1]] - flight.params.pendulum.length)
        shares.append(float((late - convergence(flight).error) / initial))
    words = f"Share of the initial error that goes after {LATE:g} s, largest of {len(flights)} flights. 'Little to no':"
    return Finding(max(shares), verdict(max(shares) <= LITTLE), f"{words} up to {LITTLE:g}")


@lru_cache(maxsize=1)
def search_gaps(*flights: Flight) -> tuple[float, float, float, int]:
    """The GA against the exhaustive optimum l_best of the same fitness.

    Returns:
        |l_GA - l_best| in m as flown and with ``EXPLORING``, |l_best - l| in m, all medians over windows; their number.
    """
    from fiplib import ga, replay
    from fiplib.estimators.grid import best_length

    cases = [(window, flight.params) for flight in flights for window in replay.spaced_windows(flight)]
    best = np.array([best_length(*case) for case in cases])
    found = {explore: [] for explore in (False, True)}
    for run, (window, params) in enumerate(cases):
        for explore, lengths in found.items():
            rng = np.random.default_rng([0, run])
            lengths.append(ga.estimate(window, params.replace(**EXPLORING) if explore else params, rng).length)
    flown, explored = (float(np.median(np.abs(np.array(lengths) - best))) for lengths in found.values())
    optimum = float(np.median(np.abs(best - [params.pendulum.length for _, params in cases])))
    return flown, explored, optimum, len(cases)


def search_as_printed(paper: None, *flights: Flight) -> Finding:
    """G4: |l_GA - l_best| in m. Exploration limits the estimate where this exceeds what l_best itself is wrong by."""
    gap, _, optimum, count = search_gaps(*flights)
    words = f"GA's answer to best of all lengths, median of {count} windows; N_c, generations ours. The best is"
    words += f" {1e3 * optimum:.0f} mm off the rod" + ("" if gap > optimum else ": exploration is not what limits it")
    return Finding(gap, verdict(gap > optimum), words, {"optimum": 1e3 * optimum, "windows": count, "gap": 1e3 * gap})


def search_mended(paper: None, *flights: Flight) -> Finding:
    """G4: the same with ``EXPLORING``: a remedy if there is something to mend, and it comes closer."""
    gap, explored, optimum, _ = search_gaps(*flights)
    share, rate = EXPLORING.values()
    words = f"As G4.search, with r_p = {share:g} and r_m = {rate:g}; as printed it is {1e3 * gap:.1f} mm"
    words += "" if gap > optimum else ", and there is nothing to mend"
    return Finding(explored, verdict(gap > optimum and explored < gap), words, {"gap": 1e3 * explored})


def tracking_ratio(paper: None, flight: Flight) -> Finding:
    """G5: RMS error of x on the arc flown before the first update of the length, in later laps over the first."""
    phase, time = laps(flight).phase, flight.time(flight.reference)
    before = (phase > 0) & (time < jumps(flight)[0].start)
    arc = phase[before].max()
    after = (phase > 2 * math.pi) & (phase % (2 * math.pi) <= arc)
    x, y = (rms(error[after]) / rms(error[before]) for error in tracking_error(flight).T)
    words = "RMS error of x on the arc flown before the first update: later laps over the first, that starts from rest."
    return Finding(x, verdict(x < 1), f"{words} Better: below 1. The same of y: {y:.2f}", {"y": y})


def survived_jump(paper: float, flight: Flight) -> Finding:
    """G6: the largest change of the used length at once, m, after which the rod stays up."""
    all_jumps = jumps(flight)
    largest = max((jump.size for jump in all_jumps if not jump.fell), default=math.nan)
    met = largest < paper and all(jump.size > paper for jump in all_jumps if jump.fell)
    words = "Met if no change below the paper's makes the rod fall. Changes in this flight: "
    return Finding(largest, verdict(met), words + ", ".join(f"{jump.size:.2f}" for jump in all_jumps) + " m")


def fatal_jump(paper: float, flight: Flight) -> Finding:
    """G6: the smallest change of the used length at once, m, after which the commands fluctuate and the rod falls."""
    all_jumps = jumps(flight)
    if not (fatal := [jump for jump in all_jumps if jump.fell]) or flight.command is None:
        return Finding(math.nan, Verdict.NOT, "No change of the length makes the rod fall in this flight")
    size, start, end, _ = min(fatal)
    time, rates = flight.time(flight.command), flight.command.values[:, :2]
    ratio = rms(rates[(time >= start) & (time < end)]) / rms(rates[time < all_jumps[0].start])
    words = f"It falls {end - start:.1f} s after the change; until then the rate commands are {ratio:.3f} times those"
    words += " before any change (RMS)"
    words += "" if ratio > 1 + ABOUT else f": not the fluctuation that the paper saw, which we take for {1 + ABOUT:g}"
    words += ". Whether the jump does it or flying on with a wrong length is not told apart"
    return Finding(size, verdict(size > paper and ratio > 1 + ABOUT), words, {"delay": end - start, "ratio": ratio})


UNRECORDED = Finding(math.nan, Verdict.OPEN, "No flight can tell; the benchmark has not been recorded yet")


def solve_time(paper: float, table: Quantities) -> Finding:
    """R1: time of one MPC solve, ms, from the benchmark's table."""
    if SOLVE_TIME not in table:
        return UNRECORDED
    words = "99 % of the solves take no longer, on the benchmark's machine; our exact solver in place of acados"
    return Finding(table[SOLVE_TIME] / 1e3, verdict(table[SOLVE_TIME] / 1e3 < paper), words)


def stalled_ticks(paper: None, table: Quantities) -> Finding:
    """R1: control ticks missed for another cause than the machine, with the GA beside the MPC in real time."""
    if "missed" not in table:
        return UNRECORDED
    ours = table["missed"] - table["missed_machine"]
    words = (
        f"{table['minutes']:.0f} min in real time on {table['cores']:.0f} cores, the GA in its own process: of "
        f"{table['ticks']:.0f} ticks the machine itself made us miss {table['missed_machine']:.0f}, our code "
        f"{ours:.0f}. The vehicle was simulated, its computer not tried"
    )
    return Finding(ours, verdict(ours == 0), words, {"minutes": table["minutes"], "machine": table["missed_machine"]})


def _estimation(id: str, start: str, length: float, error: float, time: float) -> tuple[Claim, ...]:
    """The rows of one of the paper's three estimation flights (its Table 3 and section 4.3)."""
    text, bag = f"From l0 = {start} m:", (f"estimate-{start}",)
    return (
        Claim(f"{id}.length", f"{text} length reached", length, "m", 3, final_length, bags=bag),
        Claim(f"{id}.error", f"{text} its error", error, "m", 3, final_error, bags=bag),
        Claim(f"{id}.time", f"{text} convergence time", time, "s", 2, convergence_time, bags=bag),
        Claim(f"{id}.literal", f"{text} best length by the printed fitness", length, "m", 3, printed_fitness, bags=bag),
    )


_PUSH, _CIRCLE, _JUMP = ("push-hover",), ("circle-0.8",), ("length-jump",)
_SOLVES, _DEADLINES = ("solve_times",), ("deadlines",)
_ESTIMATES = ("estimate-0.8", "estimate-1.2", "estimate-1.4")

CLAIMS = (
    Claim("D1", "Three pushes in hover: balance is kept", 3, "pushes", 0, pushes_kept, bags=_PUSH),
    Claim("D2", "Pushes: largest deviation of a, b", 0.058, "m", 3, push_lean, bags=_PUSH),
    Claim("D2.angle", "The same as an angle", 6.67, "deg", 2, partial(as_angle, of="D2"), bags=_PUSH),
    Claim("D3", "Pushes: settling time of a, b", 2.0, "s", 2, push_settling, bags=_PUSH),
    Claim("C1", "Circle of 0.8 m: largest deviation of a, b", 0.025, "m", 3, circle_lean, bags=_CIRCLE),
    Claim("C1.angle", "The same as an angle", 2.87, "deg", 2, partial(as_angle, of="C1"), bags=_CIRCLE),
    Claim("C2.gain", "Circle: minimal undershoot of x", None, "1", 3, circle_gain, bags=_CIRCLE),
    Claim("C2.delay", "Circle: slight delay of x", None, "s", 3, circle_delay, bags=_CIRCLE),
    Claim("C2.y", "Circle: largest error of y", 0.2, "m", 3, circle_y, bags=_CIRCLE),
    Claim("C3", "Other weights on y and its rate would mend y", None, "1", 2, heavier_y, studies=("ledger_seeds",)),
    *_estimation("G1", "0.8", 0.973, 0.027, 14.68),
    *_estimation("G2", "1.2", 1.029, 0.029, 3.99),
    *_estimation("G3", "1.4", 1.0, 0.0, 12.43),
    Claim("G4.late", "Little to no convergence after 14 s", None, "1", 2, late_convergence, bags=_ESTIMATES),
    Claim("G4.search", "The GA explores too little", None, "m", 4, search_as_printed, bags=_ESTIMATES),
    Claim("G4.remedy", "Fewer elites, more mutation would mend it", None, "m", 4, search_mended, bags=_ESTIMATES),
    Claim("G5", "Tracking in x improves once l is updated", None, "1", 2, tracking_ratio, bags=("estimate-1.4",)),
    Claim("G6.safe", "A change of l at once up to here is survived", 0.8, "m", 2, survived_jump, bags=_JUMP),
    Claim("G6.fatal", "A change of l at once beyond here: instability", 0.8, "m", 2, fatal_jump, bags=_JUMP),
    Claim("G6.steps", "Small steps of l would mend it", None, "1", 2, small_steps, studies=("length_jumps",)),
    Claim("R1.mpc", "MPC in real time at 120 Hz: time of one solve", 8.33, "ms", 2, solve_time, benchmarks=_SOLVES),
    Claim("R1.ga", "The GA does not stall the MPC", None, "ticks", 0, stalled_ticks, benchmarks=_DEADLINES),
)  # fmt: skip
"""The ledger, row by row."""

BY_ID = {claim.id: claim for claim in CLAIMS}
PAPER = {claim.id: claim.paper for claim in CLAIMS if claim.paper is not None}
"""The paper's numbers by id of the claim, each in its claim's unit."""
