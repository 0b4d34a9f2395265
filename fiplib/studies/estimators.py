"""Every estimator against the Cramer-Rao bound, on the same flights.

One case is one simulated flight, which flies with a used length 0.1 m too short, right, or 0.1 m too long by its seed.
Each estimator gets all windows of its kind that follow each other without overlap once the circle is at speed: 5.5 s of
derived states, or 2.5 s of raw motion capture. Per estimator ``NAME`` the row holds

- ``n_NAME``: windows answered; ``refused_NAME``: windows refused;
- ``bias_NAME``, ``rms_NAME``, ``worst_NAME``: mean, root mean square and largest size of the answers' errors, m;
- ``covered_NAME``: answers whose 95 % interval covers the truth; ``sd_NAME``: their mean standard deviation, m; nan
  both for an estimator that states none;
- ``bound_NAME``: root mean square over the windows of the bound for the *raw* motion capture of the same span, m, so
  that derived states and raw frames are held against the same limit. What an estimator takes for unknown is unknown
  in its bound too (``UNKNOWN``); all others take the calibration of motion capture for exact.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from fiplib import replay
from fiplib.estimators import ESTIMATORS
from fiplib.estimators.base import Estimate
from fiplib.estimators.cramer_rao import CALIBRATION, cramer_rao, motion
from fiplib.params import NANO, Params
from fiplib.recording import BagError, Flight
from fiplib.references import Circle, Hover
from fiplib.reproduction import measures
from fiplib.reproduction.sources import Rows
from fiplib.reproduction.style import BLUE, COLUMN, ORANGE, origin
from fiplib.reproduction.tables import NONE, Facts, Table, number
from fiplib.simulate import Scenario
from fiplib.studies.batch import fly_many

KEYS = ("excitation", "gyration_ratio", "seed")

EXCITATIONS = {"circle-0.4": Circle(0.4, 8.0), "circle-0.8": Circle(0.8, 9.0), "hover": Hover()}

UNKNOWN = dict.fromkeys(("poses", "ga_poses"), (CALIBRATION, "inertia_factor"))
"""What is unknown beside state and length, by estimator."""

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
    answered = [row for row in rows if row[f"n_{name}"] > 0]
    if not answered:
        return Pooled(0, math.nan, math.nan, math.nan, math.nan)
    n, bias, rms, bound, covered = (
        np.array([row.get(f"{column}_{name}", math.nan) for row in answered])
        for column in ("n", "bias", "rms", "bound", "covered")
    )
    total = n.sum()
    squares = (float(np.sqrt(n @ values**2 / total)) for values in (rms, bound))
    return Pooled(int(total), float(n @ bias / total), *squares, float(covered.sum() / total))


def circling(rows: Rows, uniform: bool) -> Rows:
    """The flights of the paper's 0.4 m circle with a uniform rod, or with a point mass."""
    return [row for row in rows if row["excitation"] == "circle-0.4" and (row["gyration_ratio"] > 0) == uniform]


def fig9_estimators(rows: Rows) -> Figure:
    """Fig. 9: RMS error of every estimator over the Cramer-Rao bound of raw motion capture, on the 0.4 m circle."""
    figure = Figure(figsize=(COLUMN, 3.0), layout="constrained")
    axes = figure.subplots()
    names = list(LABELS)
    for uniform, marker, colour, label in ((True, "o", BLUE, "uniform rod"), (False, "D", ORANGE, "point mass")):
        found = [pooled(circling(rows, uniform), name) for name in names]
        axes.plot([one.rms / one.bound for one in found], range(len(names)), marker, color=colour, ms=4, label=label)
    axes.axvline(1.0, color="black", lw=0.6)
    axes.axvline(1.2, color="black", lw=0.6, ls="--", label="target, 1.2")
    axes.set(yticks=range(len(names)), yticklabels=[LABELS[name] for name in names])
    axes.set(xscale="log", xlabel="RMSE / bound (1)")
    axes.invert_yaxis()
    axes.margins(x=0.08)
    axes.legend(loc="upper right")
    origin(figure, "simulated flights, 0.4 m circle")
    return figure


def fig10_intervals(flight: Flight) -> Figure:
    """Fig. 10: the pose estimator with its 95 % interval on the flight of Fig. 5, beside the GA's answers."""
    from fiplib.estimators.poses.in_flight import InFlight  # compiled code: half a second to import

    measures.need(flight, "length")
    figure = Figure(figsize=(COLUMN, 2.5), layout="constrained")
    axes = figure.subplots()
    found = []
    for stamp, window in replay.raw_windows(flight, flight.params.estimation.raw_window, 0.5):
        estimate = InFlight()(window, flight.params)
        if estimate.reason is None:
            found.append(((stamp - flight.start_ns) / NANO, estimate.length, estimate.standard_deviation))
    if not found:
        raise BagError(f"{flight.path}: no window of it gives a length")
    times, lengths, deviations = np.array(found).T
    recorded = flight.length.values[1:, 1]
    axes.plot(flight.time(flight.length)[1:], recorded, ".", ms=2.5, color=ORANGE, label="GA, recorded in flight")
    axes.errorbar(times, lengths, 1.96 * deviations, fmt=".", ms=2.5, lw=0.6, color=BLUE, label="raw poses, 95 %")
    axes.axhline(measures.true_length(flight), color="black", lw=0.6, label="true")
    axes.set(xlabel="time (s)", ylabel="length (m)", xlim=(0, flight.duration), ylim=(0.8, 1.1))
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    origin(figure, f"{flight.metadata['origin']}, {flight.path.name}")
    return figure


def table4_estimators(rows: Rows) -> Table:
    """Table 4: every estimator on the 0.4 m circle with a uniform rod, pooled over the windows of all flights."""
    chosen = circling(rows, uniform=True)
    lines = []
    for name, label in LABELS.items():
        found = pooled(chosen, name)
        covered = NONE if math.isnan(found.covered) else f"{100 * found.covered:.1f}"
        lines.append((
            label, f"{found.windows}", number(1e3 * found.bias, 2), f"{1e3 * found.rms:.2f}",
            f"{found.rms / found.bound:.2f}", covered,
        ))  # fmt: skip
    header = ("Estimator", "Windows", "Bias (mm)", "RMSE (mm)", "RMSE / bound", r"In 95\,\% interval (\%)")
    return Table(header, lines, "lrrrrr")


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
        if not math.isnan(one.covered):
            found[name, "covered"] = f"{100 * one.covered:.1f}"
    return found
