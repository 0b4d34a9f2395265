"""Excitation by design: the trajectory that identifies the length soonest, with the rod no further from upright.

A case is one simulated flight that estimates its length (uniform rod of 1 m on the 8 cm seat) with one ``excitation``
and one ``estimator``; it starts at rest and knows nothing: ``poses`` with the trusted hand-over from 0.5 m on, or the
paper's ``ga`` from 0.8 m on. Beside the outcome of the flight a row has, at ``TIMES`` of it, the stated deviation
and the error of the newest estimate, and the Cramer-Rao bound of all poses so far.

``design`` looks for the multisine whose bound falls to ``WANTED`` soonest while |a| and |b| stay below ``LEAN``; it
made ``DESIGNED``. What was found: docs/studies.md. 280 rows, about 4 minutes of one core; the design takes
three: ``python -m fiplib.studies.excitation``.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from fiplib.estimators.cramer_rao import Motion, cramer_rao_of_poses, motion
from fiplib.estimators.poses.in_flight import knowledge_in_flight
from fiplib.estimators.windows import LEAD
from fiplib.params import NANO, A, B, Params, X, Y
from fiplib.recording import Flight
from fiplib.references import Circle, Hover, Multisine, Reference
from fiplib.reproduction.measures import bootstrap_interval, rms
from fiplib.reproduction.sources import Rows
from fiplib.reproduction.style import BLUE, COLUMN, GREEN, GREY, ORANGE, PURPLE, origin
from fiplib.reproduction.tables import NONE, Facts, Table
from fiplib.simulate import Scenario
from fiplib.studies import seconds_flown
from fiplib.studies.batch import fly_many

KEYS = ("excitation", "estimator", "seed")
"""``excitation`` is a name in ``EXCITATIONS``, ``estimator`` one in ``ESTIMATED``."""

TRUE_LENGTH = 1.0
LEAN = 0.025
"""Largest |a| and |b| that an excitation may ask for, m: that of the paper's circle of 0.8 m."""

REACH = 0.8
"""Largest |x| and |y| that the design may fly to, m: that of the same circle."""

WANTED = 0.005
"""Standard deviation of the length that the excitation is designed for, and ends at, m."""

DEVIATIONS = {"20": 0.02, "10": 0.01, "5": 0.005}
"""Standard deviations whose times are compared, m, by their mm."""

FOUND = Multisine(0.1185, (0.4083, -0.1672, -0.0906, 0.0986), (0.8639, -0.3538, -0.1915, 0.2086), ramp=0.946)
DESIGNED = Multisine(0.1185, (0.3476, -0.1424, -0.0771, 0.084), (0.6987, -0.2861, -0.1549, 0.1687), ramp=0.946)
"""The trajectory that ``design()`` finds, and the one it returns: scaled so that the rod stays within ``LEAN``."""

ESTIMATED: dict[str, dict] = {
    "poses": {"estimation__estimator": "poses", "piloting__handover": "trusted"},
    "ga": {"piloting__initial_length": 0.8},
}
_CALM = {"piloting__observer": "kalman"}


class Excitation(NamedTuple):
    """A trajectory, and parameters of the pilot that flies it."""

    reference: Reference
    changes: dict


EXCITATIONS = {
    "hover": Excitation(Hover(), {}),
    "circle 0.4 m / 8 s": Excitation(Circle(0.4, 8.0, start=0.0, ramp=2.0), {}),
    "circle 0.8 m / 9 s": Excitation(Circle(0.8, 9.0, start=0.0, ramp=2.0), {}),
    "circle 0.8 m / 9 s, slow start": Excitation(Circle(0.8, 9.0), {}),
    "designed": Excitation(DESIGNED, {}),
    "designed, lean of the circle": Excitation(FOUND, {}),
    "designed, until known": Excitation(replace(DESIGNED, wanted=WANTED), {}),
    "hover, calm": Excitation(Hover(), _CALM),
    "circle 0.8 m / 9 s, calm": Excitation(Circle(0.8, 9.0, start=0.0, ramp=2.0), _CALM),
    "designed, calm": Excitation(DESIGNED, _CALM),
}
"""Circles come to speed within 2 s; the slow start is that of our bags, 4 s after a second of hover. With other noise
the circle of 0.8 m leans further than ``LEAN``, and ``FOUND`` as far as that. "calm" is the Kalman observer, whose
commands are a quarter as large."""

TO_THE_END = ("hover", "circle 0.4 m / 8 s", "circle 0.8 m / 9 s", "designed")
"""The trajectories that are also flown with the genetic algorithm."""

SEEDS = range(20)
BOUNDED, BOUND_SECONDS = 6, 6.0
"""The bound is computed of so many seeds, from poses of so many s."""

SECONDS = 12.0
TIMES = (*(round(0.2 * step, 1) for step in range(2, 16)), 4.0, 5.0, 6.0, 8.0, 10.0, 12.0)
"""s of the flight at which a row says what is known."""

SETTLED = 6.0
"""From here on a flight's distance from its place of hover is taken, s."""


def cases() -> list[dict]:
    """Every excitation and estimator with every seed; the genetic algorithm is never sure enough to end one."""
    return [
        dict(zip(KEYS, values, strict=True))
        for values in itertools.product(EXCITATIONS, ESTIMATED, SEEDS)
        if values[1] == "poses" or values[0] in TO_THE_END
    ]


def params_of(excitation: str, estimator: str) -> Params:
    """Return the parameters of a case."""
    changes = ESTIMATED[estimator] | EXCITATIONS[excitation].changes
    return Params().replace(pendulum__length=TRUE_LENGTH, piloting__estimate=True, **changes)


def run(case: dict) -> dict[str, float | int | str]:
    """Fly one case.

    Returns:
        survived (1 or 0), flown (s until a fall); lean (largest |a| or |b|, m) and within (share of time in which both
        are at most ``LEAN``); rate (RMS of the two commanded body rates, rad/s) and fastest (largest of them);
        tracking (RMS distance from the reference, m) and away (RMS distance from where it started after ``SETTLED`` s,
        m); reached_MM (s of the first answer that states so many mm or less, nan: never), of ``DEVIATIONS``. And for
        each of ``TIMES``: deviation_T and error_T of the newest answer (m, nan: none yet), bound_T (m), lean_T (largest
        |a| or |b| since the time before, m), x_T and y_T (m).
    """
    scenario = Scenario(
        "excitation",
        "",
        SECONDS,
        EXCITATIONS[case["excitation"]].reference,
        params=params_of(case["excitation"], case["estimator"]),
        seed=80_000 + int(case["seed"]),
    )
    [flight] = fly_many([scenario])
    truth, time = flight.truth_state.values, flight.time(flight.truth_state)
    place, lean = truth[:, [X, Y]], np.abs(truth[:, [A, B]]).max(axis=1)
    rates = np.abs(flight.command.values[:, :2])
    off = (flight.state.values - flight.reference.values)[:, [X, Y]]
    row: dict[str, float | int | str] = {
        "survived": int(flight.survived),
        "flown": seconds_flown(flight, scenario),
        "lean": lean.max(),
        "within": (lean <= LEAN).mean(),
        "rate": rms(rates),
        "fastest": rates.max(),
        "tracking": math.sqrt(2.0) * rms(off),
        "away": math.sqrt(2.0) * rms(place[time > SETTLED] - place[0]),
    }
    at, answers = answers_of(flight)
    for name, wanted in DEVIATIONS.items():
        reached = at[answers[:, 1] <= wanted]
        row[f"reached_{name}"] = reached[0] if len(reached) else math.nan
    bounded = case["estimator"] == "poses" and int(case["seed"]) < BOUNDED
    bound = bound_of(flight, BOUND_SECONDS) if bounded else np.full((2, 1), math.nan)
    columns: dict[str, list] = {"deviation": [], "error": [], "bound": [], "lean": [], "x": [], "y": []}
    for before, moment in itertools.pairwise((0.0, *TIMES)):
        newest = answers[at <= moment][-1:]
        columns["deviation"].append(newest[0, 1] if len(newest) else math.nan)
        columns["error"].append(newest[0, 0] - TRUE_LENGTH if len(newest) else math.nan)
        columns["bound"].append(np.interp(moment, *bound) if moment <= BOUND_SECONDS else math.nan)
        since = lean[(time > before) & (time <= moment)]
        columns["lean"].append(since.max() if len(since) else math.nan)
        here = place[np.searchsorted(time, moment - 1e-6)] if moment <= time[-1] else place[-1]
        columns["x"].append(here[0])
        columns["y"].append(here[1])
    for name, values in columns.items():
        row |= {f"{name}_{moment:g}": round(float(value), 6) for moment, value in zip(TIMES, values, strict=True)}
    return row


def answers_of(flight: Flight) -> tuple[NDArray, NDArray]:
    """Return when an estimate came (n,), s, and the length and standard deviation that it stated (n, 2), m."""
    given, values = flight.time(flight.length), flight.length.values[:, 1:]
    known = np.isfinite(values).all(axis=1)
    return given[known], values[known]


def bound_of(flight: Flight, seconds: float) -> NDArray:
    """Return times in s and the bound in m from all poses of the flight's first seconds, (2, n).

    It is the bound for who knows what the estimator in flight knows, and takes poses from when that does; in steps of
    two frames, one tick, each as certain as both together, which changes it by half a percent at most.
    """
    first = flight.start_ns + round(LEAD * NANO)
    true = motion(flight, first, flight.start_ns + round(seconds * NANO))
    thinned = Motion(true.states[::2], true.commands[::2], 2 * true.period)
    noise = flight.params.simulation
    params = flight.params.replace(
        simulation__position_noise=noise.position_noise / math.sqrt(2.0),
        simulation__attitude_noise=noise.attitude_noise / math.sqrt(2.0),
    )
    found = cramer_rao_of_poses(thinned, params, knowledge_in_flight(flight.params))
    return np.array((LEAD + thinned.period * np.arange(len(found)), found))


# --- What the rows say


def chosen(rows: Rows, excitation: str, estimator: str = "poses") -> Rows:
    """Return a case's rows in the order of their seeds."""
    found = [row for row in rows if (row["excitation"], row["estimator"]) == (excitation, estimator)]
    return sorted(found, key=lambda row: row["seed"])


def times_to(rows: Rows, excitation: str, wanted: str) -> NDArray:
    """Return when each seed's flight states so many mm or less, s; ``SECONDS`` if it never does, which is too soon."""
    reached = np.array([row[f"reached_{wanted}"] for row in chosen(rows, excitation)])
    return np.where(np.isfinite(reached), reached, SECONDS)


def reached(rows: Rows, excitation: str, wanted: str, estimator: str = "poses") -> int:
    """Return how many flights state so many mm or less before they end."""
    return sum(math.isfinite(row[f"reached_{wanted}"]) for row in chosen(rows, excitation, estimator))


class Mean(NamedTuple):
    """A mean over seeds and its 95 % interval by a bootstrap over them."""

    value: float
    low: float
    high: float

    @classmethod
    def of(cls, values: ArrayLike) -> "Mean":
        """Return the mean of one value a seed."""
        return cls(float(np.mean(values)), *bootstrap_interval(values, lambda some: float(some.mean())))


def gain(rows: Rows, excitation: str, against: str, wanted: str) -> Mean:
    """Return by how many s a trajectory is sooner to a deviation than another one on the same seeds."""
    return Mean.of(times_to(rows, against, wanted) - times_to(rows, excitation, wanted))


def rms_error(rows: Rows, excitation: str, estimator: str, time: float) -> float:
    """Return the root mean square error over the seeds at a time, m; nan if a flight has no estimate yet."""
    return rms([row[f"error_{time:g}"] for row in chosen(rows, excitation, estimator)])


def stated(rows: Rows, excitation: str, estimator: str, time: float) -> float:
    """Return the root mean square of the stated deviations at a time, m; nan if a flight has no estimate yet."""
    return rms([row[f"deviation_{time:g}"] for row in chosen(rows, excitation, estimator)])


COLOURS = {"hover": ORANGE, "circle 0.8 m / 9 s": PURPLE, "designed": BLUE, "designed, until known": GREEN}
STYLES = {"hover": ":", "circle 0.8 m / 9 s": "-.", "designed": "-", "designed, until known": "--"}


def fig22_excitation(rows: Rows) -> Figure:
    """Fig. 22: excitation by design: the trajectory, the lean that it takes, and how soon the length is known.

    20 simulated flights each from rest, a uniform rod of 1 m on the 8 cm seat, length estimated from poses; lines:
    medians (means of the paths), bands: 5 to 95 %. Top: paths of the first 3 s, a dot every 0.2 s, and the largest of
    |a| and |b| since the time before; grey: the lean that the design may take. Bottom: stated standard deviation,
    crosses: root mean square error, black: Cramer-Rao bound (6 flights), grey: the deviation designed for, at which
    the excitation ends. Estimates state what the bound allows, 0.1 to 0.3 s later; the design is the first to reach
    10 mm, with less lean than the circle, and gains nothing near 5 mm, where the seat's height limits all of them.
    """
    figure = Figure(figsize=(COLUMN, 4.4), layout="constrained")
    panels = figure.subplot_mosaic([["path", "lean"], ["known", "known"]], height_ratios=(1.0, 1.6))
    early = [time for time in TIMES if time <= 3.0]
    for name in ("circle 0.8 m / 9 s", "designed", "designed, until known"):
        some = chosen(rows, name)
        start = EXCITATIONS[name].reference.at(np.zeros(1))[0, [X, Y]]
        flown = [_values(some, axis, early).mean(axis=0) - place for axis, place in zip("xy", start, strict=True)]
        panels["path"].plot(*flown, ls=STYLES[name], color=COLOURS[name], marker=".", ms=2)
    for name in ("hover", "circle 0.8 m / 9 s", "designed"):
        _band(panels["lean"], early, _values(chosen(rows, name), "lean", early), 100.0, name)
    panels["lean"].axhline(100 * LEAN, color=GREY, lw=0.6)
    known = panels["known"]
    for name, colour in COLOURS.items():
        some = chosen(rows, name)
        _band(known, TIMES, _values(some, "deviation", TIMES), 1e3, name)
        errors = [1e3 * rms_error(rows, name, "poses", time) for time in TIMES]
        known.plot(TIMES, errors, "x", ms=3, mew=0.6, color=colour)
        bounds = _values([row for row in some if row["seed"] < BOUNDED], "bound", TIMES)
        known.plot(TIMES, 1e3 * np.sqrt(np.mean(bounds**2, axis=0)), lw=0.6, color="black", zorder=1)
    known.axhline(1e3 * WANTED, color=GREY, lw=0.6)
    panels["path"].set(
        xlabel="x from the start (m)", ylabel="y from the start (m)", aspect="equal", adjustable="datalim"
    )
    panels["lean"].set(xlabel="time (s)", ylabel="|a|, |b| (cm)", ylim=(0.0, None), xlim=(0.0, 3.0))
    known.set(xscale="log", yscale="log", xlabel="time (s)", ylabel="std. deviation (mm)", xlim=(0.4, 1.04 * SECONDS))
    for axis, ticks in ((known.xaxis, (0.5, 1, 2, 5, 10)), (known.yaxis, (3, 5, 10, 20, 50))):
        axis.set_ticks(ticks, [f"{tick:g}" for tick in ticks])
    known.minorticks_off()
    known.legend(*known.get_legend_handles_labels(), loc="upper right", handlelength=2.4)
    origin(figure, f"simulated, 1 m rod, {len(SEEDS)} seeds; black: bound, crosses: RMS error")
    return figure


def _values(rows: Rows, column: str, times: Sequence[float]) -> NDArray:
    """A column at times, (seeds, times)."""
    return np.array([[row[f"{column}_{time:g}"] for time in times] for row in rows])


def _band(axes: Axes, times: Sequence[float], values: NDArray, factor: float, name: str) -> None:
    """The median of values (seeds, times) and the band that holds 90 % of them, from when all seeds have one."""
    low, middle, high = factor * np.quantile(values, (0.05, 0.5, 0.95), axis=0)
    axes.fill_between(times, low, high, color=COLOURS[name], alpha=0.15, lw=0)
    axes.plot(times, middle, ls=STYLES[name], color=COLOURS[name], label=name)


def table20_excitation(rows: Rows) -> Table:
    """Table 20: excitation by design: time to a stated deviation, deviation later, and lean of the trajectory.

    20 simulated flights each of 12 s from rest, a uniform rod of 1 m on the 8 cm seat. A deviation is reached with the
    first estimate that states it: mean with its 95 % interval (bootstrap over seeds), or, where not all flights reach
    it, a lower limit and how many do. Calm: with the Kalman filter as state observer.
    """
    lines = []
    for excitation, estimator in dict.fromkeys((row["excitation"], row["estimator"]) for row in cases()):
        some, cells = chosen(rows, excitation, estimator), [excitation, {"poses": "poses", "ga": "GA"}[estimator]]
        for wanted in DEVIATIONS:
            count = reached(rows, excitation, wanted, estimator)
            mean = Mean.of(times_to(rows, excitation, wanted)) if estimator == "poses" else Mean(*(math.nan,) * 3)
            late = f" ({count} of {len(some)})" if count < len(some) else f" ({mean.low:.2f} to {mean.high:.2f})"
            cells.append(f"{'$>$' if count < len(some) else ''}{mean.value:.2f}{late}" if count else NONE)
        for time in (2.0, SECONDS):
            for value in (rms_error(rows, excitation, estimator, time), stated(rows, excitation, estimator, time)):
                cells.append(f"{1e3 * value:.1f}" if math.isfinite(value) else NONE)
        leans = [100 * row["lean"] for row in some]
        cells += [f"{np.quantile(leans, 0.95):.2f}", f"{max(leans):.2f}"]
        cells.append(f"{100 * np.mean([row['within'] for row in some]):.1f}")
        cells.append(f"{math.degrees(rms([row['rate'] for row in some])):.1f}")
        cells.append(f"{100 * rms([row['away'] for row in some]):.1f}")
        cells.append(f"{sum(row['survived'] == 1 for row in some)}")
        lines.append(tuple(cells))
    header = (
        "Trajectory", "Estimator", *(f"{wanted} mm after (s)" for wanted in DEVIATIONS),
        "RMS error, 2 s (mm)", "Stated, 2 s (mm)", "RMS error, 12 s (mm)", "Stated, 12 s (mm)",
        r"Lean, 95\,\% (cm)", "Lean, largest (cm)", r"Within 2.5 cm (\%)", "RMS rates (deg/s)",
        "From the start, after 6 s (cm)", f"Up of {len(SEEDS)}",
    )  # fmt: skip
    return Table(header, lines, "ll" + "r" * (len(header) - 2))


def facts(rows: Rows) -> Facts:
    """Return what the report states: times to each deviation, and what the design gains on the same seeds."""
    names = {
        "hover": "hover",
        "small": "circle 0.4 m / 8 s",
        "large": "circle 0.8 m / 9 s",
        "slow": "circle 0.8 m / 9 s, slow start",
        "designed": "designed",
        "far": "designed, lean of the circle",
        "ended": "designed, until known",
        "calm": "hover, calm",
        "calmlarge": "circle 0.8 m / 9 s, calm",
        "calmdesigned": "designed, calm",
    }
    words = {"20": "twenty", "10": "ten", "5": "five"}
    found: Facts = {("seeds",): f"{len(SEEDS)}", ("wanted",): f"{1e3 * WANTED:g}"}
    for (name, excitation), (wanted, word) in itertools.product(names.items(), words.items()):
        reaching = Mean.of(times_to(rows, excitation, wanted))
        found[name, word] = f"{reaching.value:.2f}"
        found[name, word, "low"], found[name, word, "high"] = f"{reaching.low:.2f}", f"{reaching.high:.2f}"
        found[name, word, "reached"] = f"{reached(rows, excitation, wanted)}"
    for against, (wanted, word) in itertools.product(("hover", "small", "large", "slow", "far"), words.items()):
        pair = ("designed", names[against]) if against != "far" else (names["far"], names["large"])
        gained = gain(rows, *pair, wanted)
        for part, value in zip(((), ("low",), ("high",)), gained, strict=True):
            found[against, word, "gain", *part] = f"{value:.2f}"
    for name, excitation in names.items():
        leans = [100 * row["lean"] for row in chosen(rows, excitation)]
        found[name, "lean"] = f"{max(leans):.2f}"
    return found


# --- The design

SEARCHED = ((0.1, 0.4), (0.2, 1.2), (-1.0, 1.0), (-1.0, 1.0), (-1.0, 1.0), (-1.0, 1.0))
"""Interval of each parameter of ``shape``."""

DESIGN_SECONDS, LATER_SECONDS, DESIGN_SEED = 2.0, 8.0, 90_001
SCALINGS = 3
"""How often a trajectory is flown until its lean is as wanted, to within 5 %: lean grows with the amplitude, but noise
is part of it."""

MARGIN = 1.5e-3
"""Margin to ``LEAN`` in the search, m: shapes are compared at the same lean with the noise of one seed."""


FINAL_SEEDS, FINAL_MARGIN = range(90_002, 90_010), 0.5e-3
"""Seeds with which the result is scaled once more, and its margin to ``LEAN`` then, m."""

FELL = 100.0
"""Cost of a trajectory that lets the rod fall, s."""


class Tried(NamedTuple):
    """A trajectory, the first part of its flight, and the largest |a|, |b| (2,) and |x|, |y| (2,) of all, m."""

    reference: Multisine
    flight: Flight
    lean: NDArray
    reach: NDArray


def shape(parameters: ArrayLike) -> Multisine:
    """Return the trajectory of parameters as in ``SEARCHED``, the same along x and y.

    They are the frequency in Hz, the ramp in s, and the amplitudes (cos, sin) of each harmonic as accelerations, of
    which only the ratios count.
    """
    frequency, ramp, *shares = np.asarray(parameters, dtype=float).tolist()
    size = 0.4 / max(math.hypot(*shares), 1e-9)
    speeds = [2 * math.pi * frequency * (1 + at // 2) for at in range(len(shares))]
    amplitudes = tuple(size * share / speed**2 for share, speed in zip(shares, speeds, strict=True))
    return Multisine(frequency, amplitudes, amplitudes, ramp)


def tried(reference: Multisine) -> Tried:
    """Fly a trajectory: once as the recommended estimator does, whose pilot knows little at first, and once for longer
    with the length known."""
    params = params_of("designed", "poses")
    scenario = Scenario("design", "", DESIGN_SECONDS, reference, params=params, seed=DESIGN_SEED)
    known = replace(scenario, duration=LATER_SECONDS, params=Params().replace(pendulum__length=TRUE_LENGTH))
    flight, later = fly_many([scenario, known])
    largest = np.abs(np.vstack([flight.truth_state.values, later.truth_state.values])).max(axis=0)
    return Tried(reference, flight, largest[[A, B]], largest[[X, Y]])


def scaled(reference: Multisine) -> Tried:
    """Return a trajectory of the same shape whose lean along both axes is the largest allowed, less ``MARGIN``."""
    for _ in range(SCALINGS - 1):
        x, y = ((LEAN - MARGIN) / tried(reference).lean).tolist()
        reference = replace(reference, x=magnified(x, reference.x), y=magnified(y, reference.y))
    return tried(reference)


def time_of(flight: Flight, wanted: float = WANTED) -> float:
    """Return when the bound falls to ``wanted`` m within the first ``DESIGN_SECONDS`` of a flight, s.

    Where it does not, it is the later the larger the bound is at the end.
    """
    time, bound = bound_of(flight, DESIGN_SECONDS)
    below = np.flatnonzero(bound <= wanted)
    return float(time[below[0]] if len(below) else DESIGN_SECONDS + math.log(bound[-1] / wanted))


def cost(parameters: ArrayLike, wanted: float = WANTED) -> float:
    """Return ``time_of`` a shape, scaled; more, where rod or vehicle go too far."""
    found = scaled(shape(parameters))
    excess = np.maximum(0.0, (*(found.lean - LEAN + 0.5 * MARGIN), *(found.reach - REACH)))
    return time_of(found.flight, wanted) + 100.0 * float(excess.sum()) if found.flight.survived else FELL


def finished(reference: Multisine) -> Multisine:
    """Return a trajectory scaled anew, so that no flight of ``FINAL_SEEDS`` leans too far in ``SECONDS``."""
    params = params_of("designed", "poses")
    for _ in range(SCALINGS - 1):
        flights = [Scenario("design", "", SECONDS, reference, params=params, seed=seed) for seed in FINAL_SEEDS]
        largest = [np.abs(flight.truth_state.values[:, [A, B]]).max(axis=0) for flight in fly_many(flights)]
        x, y = ((LEAN - FINAL_MARGIN) / np.max(largest, axis=0)).tolist()
        reference = replace(reference, x=magnified(x, reference.x), y=magnified(y, reference.y))
    return reference


def magnified(factor: float, amplitudes: tuple[float, ...]) -> tuple[float, ...]:
    """Return amplitudes times a factor, to a tenth of a millimetre."""
    return tuple(round(factor * amplitude, 4) for amplitude in amplitudes)


def design(wanted: float = WANTED, generations: int = 8, members: int = 4, seed: int = 0) -> Multisine:
    """Return the multisine with the least ``cost`` that differential evolution finds; the same for the same seed."""
    from scipy.optimize import differential_evolution

    found = differential_evolution(
        cost, SEARCHED, (wanted,), maxiter=generations, popsize=members, rng=seed, polish=False
    )
    best = scaled(shape(found.x)).reference
    return finished(replace(best, frequency=round(best.frequency, 4), ramp=round(best.ramp, 3)))


if __name__ == "__main__":
    print(design())
