"""Tables beyond the paper: what the studies of ``make sweep`` found, from their rows in ``data/sweeps``.

As in ``tables``: rows in, ``Table`` out. All of it is simulated.
"""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from fiplib.reproduction.claims import BY_ID
from fiplib.reproduction.rows import Rows
from fiplib.reproduction.tables import Table

LABELS = {
    "maximum_likelihood": "maximum likelihood, raw",
    "maximum_likelihood_free": "the same, inertia, lag unknown",
    "maximum_likelihood_calibrated": "the same, calibration exact",
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

POLICIES = {
    "told": "told the true length",
    "trusted": "trusted hand-over, maximum likelihood",
    "printed": "as printed, GA with the likelihood",
    "literal": "as printed, GA with the printed fitness",
}
"""Ways to the used length, as figures and tables name them."""

SHOWN_READINGS = {
    "printed_posterior": "as printed",
    "rk4_posterior": "posterior residual",
    "rk4_prior": "prior residual",
    "rk4_likelihood": "likelihood",
}
"""Readings of the fitness, as figures and tables name them."""

NONE = "--"


def table4_estimators(rows: Rows) -> Table:
    """Table 4: every estimator on the 0.4 m circle with a uniform rod, pooled over the windows of all flights."""
    chosen = [row for row in rows if row["excitation"] == "circle-0.4" and row["gyration_ratio"] > 0]
    lines = []
    for name, label in LABELS.items():
        found = pooled(chosen, name)
        covered = NONE if math.isnan(found.covered) else f"{100 * found.covered:.1f}"
        lines.append((
            label, f"{found.windows}", _number(1e3 * found.bias, 2), f"{1e3 * found.rms:.2f}",
            f"{found.rms / found.bound:.2f}", covered,
        ))  # fmt: skip
    header = ("Estimator", "Windows", "Bias (mm)", "RMSE (mm)", "RMSE / bound", r"In 95\,\% interval (\%)")
    return Table(header, lines, "lrrrrr")


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
    columns = ("n", "bias", "rms", "bound", "covered")
    n, bias, rms, bound, covered = np.array(
        [[row.get(f"{column}_{name}", math.nan) for column in columns] for row in answered]
    ).T
    total = n.sum()
    squares = (float(np.sqrt(n @ values**2 / total)) for values in (rms, bound))
    return Pooled(int(total), float(n @ bias / total), *squares, float(covered.sum() / total))


def table5_seeds(rows: Rows) -> Table:
    """Table 5: every row of the ledger that one flight decides, over many seeds: is it a rule, or one lucky flight?"""
    from fiplib.studies.ledger_seeds import ROWS  # here: the other tables need not wait for CasADi

    default = [row for row in rows if row["variant"] == "default"]
    lines = []
    for scenario, columns in ROWS.items():
        if scenario == "push-hover":
            columns = {"survived": "D1"} | columns
        flown = [row for row in default if row["scenario"] == scenario]
        for column, id in columns.items():
            held = column if column == "survived" else f"holds_{column}"
            name = f"{id}, {scenario}" if id in ("G4.late", "G5") else id
            lines.append((name, *_spread([row[column] for row in flown], id), *_share([row[held] for row in flown])))
    header = ("Row", "Paper", "Mean", "SD", "Least", "Most", "Unit", "Flights", "Row holds")
    return Table(header, sorted(lines, key=lambda line: _order(line[0])), "lrrrrrlrr")


def table6_readings(default: Rows, readings: Rows) -> Table:
    """Table 6: the length that the estimator's flights come to under other readings of the paper, and its remedy."""
    lines = []
    for variant in ("default", *dict.fromkeys(row["variant"] for row in readings)):
        for scenario in ("estimate-0.8", "estimate-1.4"):
            flown = [row for row in (*default, *readings) if row["variant"] == variant and row["scenario"] == scenario]
            lengths = np.array([row["final_length"] for row in flown if math.isfinite(row["final_length"])])
            mean, deviation, error = NONE, NONE, NONE
            if lengths.size:
                mean, deviation = f"{lengths.mean():.3f}", f"{lengths.std(ddof=1):.3f}"
                errors = [row["final_error"] for row in flown if math.isfinite(row["final_error"])]
                error = f"{np.sqrt(np.mean(np.square(errors))):.3f}"
            up, held = sum(row["survived"] for row in flown), _share([row["holds_final_length"] for row in flown])[1]
            lines.append((variant, scenario[-3:], f"{len(flown)}", f"{up:g}", mean, deviation, error, held))
    header = ("Reading", "$l_0$ (m)", "Flights", "Up", "Mean (m)", "SD (m)", "RMSE (m)", "Row holds")
    return Table(header, lines, "lrrrrrrr")


def table7_weights(rows: Rows) -> Table:
    """Table 7: the search for one set of weights: how many candidates pass each condition, alone and with the rest."""
    equal = [row for row in rows if row["y_share"] == 1.0]
    conditions = {
        "linear loop stable, every start": lambda row: row["linear"] == 1,
        "every start flies": lambda row: row["starts"] == 3,
        **{f"{id} holds": lambda row, id=id: row[f"holds_{id}"] == 1 for id in ("D1", "D2", "D3", "C1", "C2.gain")},
        "all of these": lambda row: row["passes"] == 1,
        "C2.delay holds": lambda row: row["holds_C2.delay"] == 1,
        "C2.delay and C2.gain": lambda row: row["holds_C2.delay"] == 1 and row["holds_C2.gain"] == 1,
        "C2.y holds": lambda row: row["holds_C2.y"] == 1,
        "C2.y and C2.gain": lambda row: row["holds_C2.y"] == 1 and row["holds_C2.gain"] == 1,
        "all but C2.delay": lambda row: row["passes"] == 1 and row["holds_C2.y"] == 1,
    }
    others = [row for row in rows if row["y_share"] != 1.0]
    lines = [(text, f"{sum(map(holds, equal))}", f"{sum(map(holds, others))}") for text, holds in conditions.items()]
    header = ("Condition", f"Axes alike, of {len(equal)}", f"$y$ lighter, of {len(others)}")
    return Table(header, lines, "lrr")


def table8_handover(rows: Rows) -> Table:
    """Table 8: random rods and first lengths under four ways to the used length: who stays up, how soon it is right."""
    lines = []
    for policy, label in POLICIES.items():
        found = handed_over(rows, policy)
        late = (NONE,) * 3
        if policy != "told":
            late = f"{100 * found.right:.1f}", f"{found.mean_time:.2f}", f"{found.late_time:.2f}"
        kept = f"{100 * found.kept:.1f}"
        lines.append((label, f"{found.flights}", f"{found.up}", kept, *late, f"{found.longest:.2f}"))
    header = (
        "Used length", "Flights", "Up", r"Up, of those up when told (\%)",
        r"Right at the end (\%)", "After, mean (s)", r"After, 95\,\% (s)", "Longest used / true",
    )  # fmt: skip
    return Table(header, lines, "lrrrrrrr")


class HandedOver(NamedTuple):
    """A policy over all flights: how many; how many stay up; the share ``kept`` of those that stay up when told the
    true length; of those up, the share whose used length is ``right`` at the end, mean and 95 % quantile of the time
    after which it is, s; the largest used over true length."""

    flights: int
    up: int
    kept: float
    right: float
    mean_time: float
    late_time: float
    longest: float


def handed_over(rows: Rows, policy: str) -> HandedOver:
    """A policy's rows of the study 'handover'."""
    told = {row["index"] for row in rows if row["policy"] == "told" and row["survived"] == 1}
    flown = [row for row in rows if row["policy"] == policy]
    up = [row for row in flown if row["survived"] == 1]
    kept = float(np.mean([row["survived"] == 1 for row in flown if row["index"] in told]))
    times = np.array([row["settled"] for row in up if math.isfinite(row["settled"])])
    longest = float(max(row["longest_used"] for row in flown))
    late = float(np.quantile(times, 0.95))
    return HandedOver(len(flown), len(up), kept, len(times) / len(up), float(times.mean()), late, longest)


def table9_landscapes(rows: Rows) -> Table:
    """Table 9: mean error (standard deviation over windows) of the best of all lengths, in cm, for four readings, as
    one thing at a time differs from the default."""
    settings = dict.fromkeys(_setting(row) for row in rows)
    cells = {(_setting(row), row["reading"]): row for row in rows}
    lines = []
    for setting in sorted(settings, key=lambda setting: setting != "default"):
        found = [cells[setting, reading] for reading in SHOWN_READINGS]
        errors = (f"{_number(100 * row['bias'], 1)} ({100 * row['spread']:.1f})" for row in found)
        lines.append((setting, *errors))
    return Table(("What differs", *SHOWN_READINGS.values()), lines, "lrrrr")


def table10_rates(rates: dict[str, float]) -> Table:
    """Table 10: flights a second of a sweep, from ``benchmarks/sweep_rates.csv``, and what a million would take."""
    one, two, cores = rates["rate_1_worker_per_s"], rates["rate_2_workers_per_s"], rates["extrapolated_cores"]
    seconds, hours = rates["flight_duration_s"], f"extrapolated: {rates['extrapolated_hours']:.1f} h for a million"
    lines = [
        (f"{workers:g}", f"{rate:.{decimals}f}", f"{seconds * rate:.0f}", f"{rate / one:.2f}", origin)
        for workers, rate, decimals, origin in (
            (1, one, 2, "measured"),
            (2, two, 2, "measured"),
            (cores, cores * one, 0, hours),
        )
    ]
    return Table(("Workers", "Flights / s", "Simulated s / s", "Speed-up", "Origin"), lines, "rrrrl")


def table11_imperfections(rows: Rows) -> Table:
    """Table 11: what becomes of three estimators when vehicle and laboratory are not quite as they are told."""
    from fiplib.studies.imperfections import IMPERFECTIONS  # here: the other tables need not wait for CasADi

    lines = []
    for name in IMPERFECTIONS:
        chosen = [row for row in rows if row["imperfection"] == name]
        cells = [_number(1e3 * pooled(chosen, "ga").rms, 0)]
        for estimator in ("maximum_likelihood_calibrated", "maximum_likelihood"):
            found = pooled(chosen, estimator)
            cells.append(f"{100 * found.windows / _given(chosen, estimator):.0f}")
            cells += [_number(1e3 * found.rms, 1), f"{100 * found.covered:.0f}"] if found.windows else [NONE, NONE]
        lines.append((name.replace("%", r"\%"), *cells))
    header = ("Imperfection", "GA: RMSE (mm)")
    for who in ("Exact", "Ours"):
        header += (rf"{who}: answered (\%)", "RMSE (mm)", r"In 95\,\% interval (\%)")
    return Table(header, lines, "lrrrrrrr")


def _given(rows: Rows, name: str) -> float:
    """How many windows an estimator was given."""
    return sum(row[f"n_{name}"] + row[f"refused_{name}"] for row in rows)


FACTS = ("estimators", "weights", "handover", "length_jumps", "bounds", "imperfections")
"""The studies of which the report states numbers outside its tables."""


def facts(studies: Mapping[str, Rows]) -> dict[tuple[str, ...], str]:
    """Those numbers as text, by (study, ...), from the rows of each study in ``FACTS``; one without rows has none."""
    found: dict[tuple[str, ...], str] = {}
    if rows := studies["estimators"]:
        chosen = [row for row in rows if row["excitation"] == "circle-0.4" and row["gyration_ratio"] > 0]
        for name in ("maximum_likelihood", "maximum_likelihood_calibrated", "maximum_likelihood_free", "ga", "grid"):
            one = pooled(chosen, name)
            found |= {
                ("estimators", name, "windows"): f"{one.windows}",
                ("estimators", name, "bias"): f"{1e3 * one.bias:.2f}",
                ("estimators", name, "rms"): f"{1e3 * one.rms:.2f}",
                ("estimators", name, "ratio"): f"{one.rms / one.bound:.2f}",
            }
            if not math.isnan(one.covered):
                found["estimators", name, "covered"] = f"{100 * one.covered:.1f}"
    if rows := studies["weights"]:
        alike = [row for row in rows if row["y_share"] == 1.0]
        both = [row for row in alike if row["holds_C2.gain"] == 1 and 1 in (row["holds_C2.y"], row["holds_C2.delay"])]
        found |= {
            ("weights", "candidates"): f"{len(alike)}",
            ("weights", "stable"): f"{sum(row['linear'] == 1 for row in alike)}",
            ("weights", "pass"): f"{sum(row['passes'] == 1 for row in alike)}",
            ("weights", "both"): f"{len(both)}",
        }
    if rows := studies["handover"]:
        for policy in POLICIES:
            one = handed_over(rows, policy)
            found |= {
                ("handover", policy, "flights"): f"{one.flights}",
                ("handover", policy, "up"): f"{one.up}",
                ("handover", policy, "kept"): f"{100 * one.kept:.1f}",
                ("handover", policy, "time"): f"{one.mean_time:.2f}",
                ("handover", policy, "longest"): f"{one.longest:.2f}",
            }
    if rows := studies["length_jumps"]:
        flights = max(row["survived"] for row in rows)
        for rod in ("uniform", "point mass"):
            for change in ("at once", "in steps"):
                for lasting in ("for good", "2 s"):
                    kind = {"rod": rod, "change": change, "lasting": lasting}
                    some = [row for row in rows if kind.items() <= row.items()]
                    fell = [row["length"] for row in some if row["survived"] < flights]
                    ends = {
                        "shortest": min(
                            r["length"] for r in some if r["length"] > max((x for x in fell if x < 1), default=0)
                        ),
                        "longest": max(
                            r["length"] for r in some if r["length"] < min((x for x in fell if x > 1), default=9)
                        ),
                    }
                    name = ("length_jumps", rod, change, "outlier" if lasting == "2 s" else "lasting")
                    found |= {(*name, end): f"{length:.1f}" for end, length in ends.items()}
    if rows := studies["imperfections"]:
        for key, kind in {
            "marker": "marker 0.1 mm off",
            "turned": "frame turned by 0.5 deg",
            "all": "all of them",
        }.items():
            chosen = [row for row in rows if row["imperfection"] == kind]
            for name in ("ga", "maximum_likelihood_calibrated", "maximum_likelihood"):
                one = pooled(chosen, name)
                found["imperfections", key, name, "answered"] = f"{100 * one.windows / _given(chosen, name):.0f}"
                if one.windows:
                    found["imperfections", key, name, "rms"] = f"{1e3 * one.rms:.1f}"
                    found["imperfections", key, name, "covered"] = f"{100 * one.covered:.0f}"
    if rows := studies["bounds"]:
        usual = {"excitation": "circle 0.4 m / 8 s", "rod": "uniform", "noise": "default", "knowledge": "plant known"}
        for name, changes in {
            "usual": {},
            "hover": {"excitation": "hover"},
            "fast": {"excitation": "circle 0.4 m / 5 s"},
            "positions": {"noise": "positions x 5"},
            "attitude": {"noise": "attitude x 5"},
            "calibration": {"knowledge": "calibration unknown"},
            "unknown": {"knowledge": "inertia and lag unknown"},
            "height": {"knowledge": "height measured"},
        }.items():
            [row] = [row for row in rows if (usual | changes).items() <= row.items()]
            found["bounds", name] = f"{1e3 * row['bound_2.5']:.2g}"
    return found


def _spread(values: Sequence[float], id: str) -> tuple[str, ...]:
    """Paper, mean, standard deviation, least, most, unit: of the finite values, with the decimals of the claim."""
    claim = BY_ID[id]
    finite = np.array([value for value in values if math.isfinite(value)])
    paper = NONE if claim.paper is None or id == "D1" else _number(claim.paper, claim.decimals)
    unit = "" if claim.unit == "1" or id == "D1" else claim.unit
    if not finite.size:
        return paper, NONE, NONE, NONE, NONE, unit
    decimals = 2 if id == "D1" else claim.decimals
    deviation = finite.std(ddof=1) if finite.size > 1 else math.nan
    return paper, *(_number(value, decimals) for value in (finite.mean(), deviation, finite.min(), finite.max())), unit


def _share(held: Sequence[float]) -> tuple[str, str]:
    """How many flights there are, and in how many of them the row holds; one that fell does not count as holding."""
    return f"{len(held)}", f"{sum(value == 1 for value in held)}"


def _order(name: str) -> tuple[int, str]:
    return list(BY_ID).index(name.split(",")[0]), name


def _setting(row: dict) -> str:
    """What differs from the default in a row of the study 'landscapes'."""
    if row["factor"] == "none":
        return "default"
    noise = str(row["noise"]).replace("Q_e", "$Q_e$").replace("R_e", "$R_e$").replace("*", r"$\times$")
    words = {
        "excitation": row["excitation"],
        "noise": noise.replace("identity", "$Q_e = R_e = I$"),
        "samples": f"{row['samples']:g} samples",
        "rate": f"{row['rate']:g} Hz",
        "rod": row["rod"],
    }
    return str(words[row["factor"]])


def _number(value: float, decimals: int) -> str:
    return f"{value:.{decimals}f}".replace("-", "$-$")
