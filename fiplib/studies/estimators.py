"""Every estimator against the Cramer-Rao bound, on the same flights.

One case is one simulated flight, which flies with a used length 0.1 m too short, right, or 0.1 m too long by its seed.
Each estimator gets all windows of its kind that follow each other without overlap once the circle is at speed: 5.5 s of
derived states, or 2.5 s of raw motion capture. Per estimator ``NAME`` the row holds

- ``n_NAME``: windows answered; ``refused_NAME``: windows refused;
- ``bias_NAME``, ``rms_NAME``, ``worst_NAME``: mean, root mean square and largest size of the answers' errors, m;
- ``covered_NAME``: answers whose 95 % interval covers the truth; ``sd_NAME``: their mean standard deviation, m; nan
  both for an estimator that states none;
- ``bound_NAME``: root mean square over the windows of the bound for the *raw* motion capture of the same span, m, so
  that derived states and raw frames are compared with the same limit. A quantity that an estimator takes as unknown
  is unknown in its bound too (``UNKNOWN``); the other estimators take the calibration of motion capture as exact.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from fiplib import replay
from fiplib.estimators import ESTIMATORS
from fiplib.estimators.base import Estimate
from fiplib.estimators.cramer_rao import CALIBRATION, cramer_rao, motion
from fiplib.params import NANO, Params
from fiplib.recording import BagError, Flight
from fiplib.references import Circle, Hover
from fiplib.reproduction import bands, measures
from fiplib.reproduction.sources import Rows
from fiplib.reproduction.style import BLUE, COLUMN, ORANGE, origin
from fiplib.reproduction.tables import NONE, Facts, Table, number
from fiplib.simulate import Scenario
from fiplib.studies.batch import fly_many

KEYS = ("excitation", "gyration_ratio", "seed")

EXCITATIONS = {"circle-0.4": Circle(0.4, 8.0), "circle-0.8": Circle(0.8, 9.0), "hover": Hover()}

UNKNOWN = dict.fromkeys(("poses", "ga_poses"), (CALIBRATION, "inertia_factor"))
"""The quantities that each estimator takes as unknown beside state and length."""

DURATION = 22.0
"""s: three windows of derived states and five of raw motion capture after ``SETTLED``."""

SETTLED = 5.0
"""s after which windows begin: the circle has come to speed."""

Z95 = 1.959964
"""Half-width of a 95 % interval in standard deviations."""


def cases() -> list[dict]:
    """40 flights of the paper's excitation and a real rod, on which the target is judged; 10 of each other kind."""
    return [
        {"excitation": excitation, "gyration_ratio": ratio, "seed": seed}
        for excitation in EXCITATIONS
        for ratio in (0.0, round(1 / 12, 6))
        for seed in range(40 if excitation == "circle-0.4" and ratio > 0 else 10)
    ]


def run(case: dict) -> dict[str, float | int | str]:
    """Fly the case, ask every estimator, hold the answers against the bound."""
    flight = _flown(case)
    row: dict[str, float | int | str] = {"survived": int(flight.survived)}
    params = flight.params
    for kind, (seconds, kept) in windows_of(flight).items():
        bounds: dict[tuple[str, ...], float] = {}
        for name, estimator in ESTIMATORS.items():
            if estimator.kind != kind:
                continue
            unknown = UNKNOWN.get(name, ())
            if unknown not in bounds:
                bounds[unknown] = _bound(flight, [end for end, _ in kept], seconds, unknown)
            rng = np.random.default_rng([case["seed"], list(ESTIMATORS).index(name)])
            answers = [estimator.function(window, params, rng) for _, window in kept]
            summary = summarise(answers, params.pendulum.length) | {"bound": bounds[unknown]}
            row |= {f"{column}_{name}": value for column, value in summary.items()}
    return row


def windows_of(flight: Flight) -> dict[str, tuple[float, list[tuple[int, Any]]]]:
    """By kind of estimator: the span of its windows in s, and those that begin after ``SETTLED`` and do not overlap.

    Each window comes with the time in ns at which its last frame was exposed.
    """
    params = flight.params
    settled = flight.start_ns + round(SETTLED * NANO)
    span = (params.estimation.window - 1) * params.estimation.sample_period
    sampled = params.replace(estimation__run_period=params.estimation.window * params.estimation.sample_period)
    latency = round(params.simulation.mocap_latency * NANO)
    found = {
        "states": (span, replay.windows(flight, sampled)),
        "raw": (params.estimation.raw_window, replay.raw_windows(flight, *2 * (params.estimation.raw_window,))),
    }
    return {
        kind: (
            seconds,
            [(stamp - latency, one) for stamp, one in some if stamp - latency - round(seconds * NANO) >= settled],
        )
        for kind, (seconds, some) in found.items()
    }


def summarise(answers: list[Estimate], truth: float) -> dict[str, float | int]:
    """Counts and errors of the answers for one flight, as described above."""
    given = [answer for answer in answers if answer.reason is None]
    errors = np.array([answer.length for answer in given]) - truth
    deviations = np.array([answer.standard_deviation for answer in given])
    stated = bool(np.isfinite(deviations).any())
    return {
        "n": len(given),
        "refused": len(answers) - len(given),
        "bias": float(errors.mean()) if given else math.nan,
        "rms": measures.rms(errors),
        "worst": float(np.abs(errors).max()) if given else math.nan,
        "covered": int(np.count_nonzero(np.abs(errors) <= Z95 * deviations)) if stated else math.nan,
        "sd": float(np.nanmean(deviations)) if stated else math.nan,
    }


def _flown(case: dict) -> Flight:
    seed = int(case["seed"])
    params = Params().replace(
        pendulum__gyration_ratio=float(case["gyration_ratio"]), piloting__initial_length=(0.9, 1.0, 1.1)[seed % 3]
    )
    kind = case["excitation"]
    # a stretch of seeds for each kind of flight, so that no two share their noise; none that a recorded scenario flies
    first = 10_000 * (1 + list(EXCITATIONS).index(kind)) + (5_000 if case["gyration_ratio"] > 0 else 0)
    return next(fly_many([Scenario(kind, "", DURATION, EXCITATIONS[kind], params=params, seed=first + seed)]))


def _bound(flight: Flight, ends: list[int], seconds: float, unknown: tuple[str, ...]) -> float:
    bounds = [cramer_rao(motion(flight, end - round(seconds * NANO), end), flight.params, unknown)[-1] for end in ends]
    return measures.rms(bounds)


LABELS = {
    "poses": "raw poses alone",
    "ga_poses": "GA on raw poses",
    "ga": "GA, printed settings",
    "ga_improved": "GA, more exploration",
    "grid": "exhaustive search",
    "scalar": "scalar search (SciPy)",
    "ekf": "EKF, joint state",
    "ukf": "UKF, joint state",
    "moving_horizon": "moving horizon",
    "recursive_least_squares": "recursive least squares",
    "concurrent_learning": "concurrent learning",
}
"""Estimators as figures and tables name them."""


class Pooled(NamedTuple):
    """An estimator over many windows: how many were answered, mean and RMS error and RMS bound in m (nan where none was
    computed), and the share of 95 % intervals that cover the truth (nan where none is stated)."""

    windows: int
    bias: float
    rms: float
    bound: float
    covered: float


def pooled(rows: Rows, name: str) -> Pooled:
    """An estimator's rows of the study 'estimators' or 'imperfections', each weighted by its number of windows."""
    given = answered(rows, name)
    if not given:
        return Pooled(0, math.nan, math.nan, math.nan, math.nan)
    n, bias, rms, bound, covered = (
        np.array([row.get(f"{column}_{name}", math.nan) for row in given])
        for column in ("n", "bias", "rms", "bound", "covered")
    )
    total = n.sum()
    squares = (float(np.sqrt(n @ values**2 / total)) for values in (rms, bound))
    return Pooled(int(total), float(n @ bias / total), *squares, float(covered.sum() / total))


def circling(rows: Rows, uniform: bool) -> Rows:
    """The flights of the paper's 0.4 m circle with a uniform rod, or with a point mass."""
    return [row for row in rows if row["excitation"] == "circle-0.4" and (row["gyration_ratio"] > 0) == uniform]


Interval = tuple[float, float, float]
"""A value with the ends of its 95 % interval."""


def resampled(rows: Rows, statistic: Callable[..., NDArray], *columns: str) -> Interval:
    """Return a statistic of columns of independent flights, with its 95 % interval: a bootstrap over flights."""
    values = np.array([[row[column] for row in rows] for column in columns])

    def of(chosen: NDArray) -> float:
        return float(statistic(*values[:, chosen.astype(int)]))

    flights = np.arange(len(rows))
    return of(flights), *measures.bootstrap_interval(flights, of)


def pooled_bias(n: NDArray, bias: NDArray) -> NDArray:
    """Mean error over all windows, from means and numbers of windows by flight."""
    return n @ bias / n.sum()


def pooled_rms(n: NDArray, rms: NDArray) -> NDArray:
    """Root mean square over all windows, from those and numbers of windows by flight."""
    return np.sqrt(n @ rms**2 / n.sum())


def interval(covered: ArrayLike, answered: ArrayLike, draws: int = 4000) -> tuple[float, float, float]:
    """Return the share of answers whose interval holds the length, and its 95 % interval by a bootstrap over flights.

    Where all of them do, which leaves a bootstrap nothing to draw, the interval is that of Wilson.

    Args:
        covered, answered: numbers of windows by flight.
        draws: how many times the flights are drawn anew.
    """
    covered, answered = np.asarray(covered, dtype=float), np.asarray(answered, dtype=float)
    n, share = max(answered.sum(), 1.0), covered.sum() / max(answered.sum(), 1.0)
    if share in (0.0, 1.0):
        z2 = Z95**2
        edge = z2 / (n + z2)
        return (share, 1.0 - edge, 1.0) if share else (share, 0.0, edge)
    chosen = np.random.default_rng(0).integers(len(covered), size=(draws, len(covered)))
    shares = covered[chosen].sum(axis=1) / np.maximum(answered[chosen].sum(axis=1), 1.0)
    low, high = np.quantile(shares, (0.025, 0.975))
    return float(share), float(low), float(high)


def answered(rows: Rows, name: str) -> Rows:
    """The flights in which an estimator answered."""
    return [row for row in rows if row[f"n_{name}"] > 0]


def covering(rows: Rows, name: str) -> Interval:
    """Return the share of an estimator's intervals that hold the length."""
    return interval([row[f"covered_{name}"] for row in rows], [row[f"n_{name}"] for row in rows])


def ratio(rows: Rows, name: str) -> Interval:
    """Return RMS error over RMS bound of an estimator."""
    columns = (f"{column}_{name}" for column in ("n", "rms", "bound"))
    return resampled(answered(rows, name), lambda n, rms, bound: pooled_rms(n, rms) / pooled_rms(n, bound), *columns)


def fig9_estimators(rows: Rows) -> Figure:
    """Fig. 9: RMS error of every estimator over the Cramer-Rao bound of raw motion capture, on the 0.4 m circle (8 s).

    40 simulated flights with a uniform rod, 10 with a point mass, 1 m; bars: 95 % intervals, bootstrap over flights.
    Rows that share an axis have the same data and the same bound. Above: all poses in windows of 2.5 s, with
    calibration and inertia unknown to the estimator as to the bound; dashed: the target of 1.2. Below: 55 derived
    states in steps of 0.1 s, against the bound of all poses of that time with everything else known. Derived states
    cost a factor of fifty with any search; the estimates from raw poses are at the bound, a little below where
    they are given tolerances that it takes as unknown.
    """
    figure = Figure(figsize=(COLUMN, 3.4), layout="constrained")
    kinds = {kind: [name for name in LABELS if ESTIMATORS[name].kind == kind] for kind in ("raw", "states")}
    panels = figure.subplots(2, 1, height_ratios=[len(names) + 1 for names in kinds.values()])
    rods = ((True, "o", BLUE, "uniform rod"), (False, "D", ORANGE, "point mass"))
    for axes, names in zip(panels, kinds.values(), strict=True):
        for shift, (uniform, marker, colour, label) in zip((-0.14, 0.14), rods, strict=True):
            found = np.array([ratio(circling(rows, uniform), name) for name in names])
            spread = np.abs(found[:, 1:] - found[:, :1]).T
            at = np.arange(len(names)) + shift
            axes.errorbar(found[:, 0], at, xerr=spread, fmt=marker, color=colour, ms=3, elinewidth=0.7, label=label)
        axes.set(yticks=range(len(names)), yticklabels=[LABELS[name] for name in names])
        axes.set_ylim(len(names) - 0.5, -0.5)
    above, below = panels
    above.axvline(1.0, color="black", lw=0.6, label="bound")
    above.axvline(1.2, color="black", lw=0.6, ls="--", label="target")
    above.set(xlim=(0.7, 1.5), xlabel="RMSE / bound, raw poses (1)")
    below.set(xscale="log", xlim=(30, 500), xlabel="RMSE / bound, derived states (1)")
    below.set_xticks(ticks := (30, 50, 100, 200, 500), [f"{tick}" for tick in ticks])
    below.minorticks_off()
    figure.legend(*above.get_legend_handles_labels(), loc="outside lower center", ncols=4)
    origin(figure, "simulated flights, 0.4 m circle")
    return figure


def fig10_intervals(flight: Flight, spread: Rows = ()) -> Figure:
    """Fig. 10: the estimate from raw poses with its stated 95 % interval on the flight of Fig. 5, beside the GA's.

    Bars: windows of 2.5 s, one every half second, of the recorded flight (simulated, l0 = 1.4 m, a rod of 1 m on the
    0.4 m circle). Bands: 5 to 95 % of the answers over 20 simulated flights, among them the recorded one: blue of the
    poses, orange of the genetic algorithm. The blue band, 0.995 to 1.006 m, is as wide as the stated intervals, so
    these can be trusted; the orange one is ten times as wide, and below the true length at first.
    """
    from fiplib.estimators.poses.in_flight import InFlight  # compiled code: half a second to import

    measures.need(flight, "length")
    figure = Figure(figsize=(COLUMN, 2.7), layout="constrained")
    axes = figure.subplots()
    found = []
    for stamp, window in replay.raw_windows(flight, flight.params.estimation.raw_window, 0.5):
        estimate = InFlight()(window, flight.params)
        if estimate.reason is None:
            found.append(((stamp - flight.start_ns) / NANO, estimate.length, estimate.standard_deviation))
    if not found:
        raise BagError(f"{flight.path}: no window of it gives a length")
    times, lengths, deviations = np.array(found).T
    if known := bands.flights(spread, flight.path.name):
        for quantity, colour, label in (("estimate", ORANGE, "GA"), ("pose_length", BLUE, "raw poses")):
            band = bands.band(bands.values(known, quantity))
            label = f"{label}, {len(known)} flights"
            axes.fill_between(band.time, band.low, band.high, color=colour, alpha=0.2, lw=0, label=label)
    recorded = flight.length.values[1:, 1]
    axes.plot(flight.time(flight.length)[1:], recorded, ".", ms=2.5, color=ORANGE, label="GA, recorded in flight")
    axes.errorbar(times, lengths, Z95 * deviations, fmt=".", ms=2.5, lw=0.6, color=BLUE, label="raw poses, 95 %")
    axes.axhline(measures.true_length(flight), color="black", lw=0.6, label="true")
    axes.set(xlabel="time (s)", ylabel="length (m)", xlim=(0, flight.duration))
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    origin(figure, f"{flight.metadata['origin']}, {flight.path.name}")
    return figure


def table4_estimators(rows: Rows) -> Table:
    """Table 4: every estimator on the 0.4 m circle (8 s) with a uniform rod of 1 m.

    40 simulated flights, pooled over their windows: 3 of 5.4 s of derived states or 5 of 2.5 s of raw poses a flight;
    in brackets: 95 % intervals, bootstrap over flights. The bound is that of the raw poses in the same time, with the
    same unknowns as the estimator has.
    """
    chosen = circling(rows, uniform=True)
    lines = []
    for name, label in LABELS.items():
        found, some, n = pooled(chosen, name), answered(chosen, name), f"n_{name}"
        bias = (1e3 * value for value in resampled(some, pooled_bias, n, f"bias_{name}"))
        error = (1e3 * value for value in resampled(some, pooled_rms, n, f"rms_{name}"))
        covered = NONE
        if not math.isnan(found.covered):
            covered = ranged(*(100 * value for value in covering(some, name)), 0)
        ratio_ = f"{found.rms / found.bound:.2f}"
        lines.append((label, f"{found.windows}", ranged(*bias, 1), ranged(*error, 1), ratio_, covered))
    header = ("Estimator", "Windows", "Bias (mm)", "RMSE (mm)", "RMSE / bound", r"In 95\,\% interval (\%)")
    return Table(header, lines, "lrrrrr")


def ranged(value: float, low: float, high: float, decimals: int) -> str:
    """A cell with a number and its interval in brackets."""
    return f"{number(value, decimals)} ({number(low, decimals)} to {number(high, decimals)})"


def facts(rows: Rows) -> Facts:
    """Return what the report states of three estimators on the paper's excitation."""
    found: Facts = {}
    chosen = circling(rows, uniform=True)
    for name in ("poses", "ga", "grid"):
        one = pooled(chosen, name)
        found |= {
            (name, "windows"): f"{one.windows}",
            (name, "bias"): f"{1e3 * one.bias:.2f}",
            (name, "rms"): f"{1e3 * one.rms:.2f}",
            (name, "ratio"): f"{one.rms / one.bound:.2f}",
        }
        given = answered(chosen, name)
        for column, statistic in (("bias", pooled_bias), ("rms", pooled_rms)):
            _, low, high = resampled(given, statistic, f"n_{name}", f"{column}_{name}")
            found |= {(name, column, "low"): f"{1e3 * low:.2f}", (name, column, "high"): f"{1e3 * high:.2f}"}
        _, low, high = interval(*([row[f"{column}_{name}"] for row in given] for column in ("covered", "n")))
        if not math.isnan(one.covered):
            found[name, "covered"] = f"{100 * one.covered:.1f}"
            found[name, "covered", "low"], found[name, "covered", "high"] = f"{100 * low:.1f}", f"{100 * high:.1f}"
    return found
