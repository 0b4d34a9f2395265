"""The evidence for each claim: one value a flight, the value of the recorded flight, and what a reader must know.

A function gets what its claim is read from (bags, then tables of studies, then of benchmarks) and returns
``Evidence``. ``flown`` and ``paired`` serve all claims that a column of the study ``ledger_seeds`` decides.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from fiplib.recording import Flight
from fiplib.reproduction import quantities
from fiplib.reproduction.measures import (
    CONVERGED,
    FALL_ANGLE,
    FINAL_SECONDS,
    angle,
    binomial_interval,
    convergence,
    jumps,
    laps,
    push_times,
    used_length,
)
from fiplib.reproduction.sources import Quantities, Rows

INCOMPLETE = "The study is not complete"


class Evidence(NamedTuple):
    """The evidence for or against a claim.

    ``values`` of the flights (NaN: it fell, or nothing was measured); ``recorded``, the value of the recorded flight;
    ``note``, how it was measured and what limits it; ``ours``, what is shown for our number where it is not the median
    of ``values``; ``facts``, further numbers by name, for the report.
    """

    values: Sequence[float]
    recorded: float = math.nan
    note: str = ""
    ours: float | None = None
    facts: Mapping[str, float] = MappingProxyType({})


Remark = str | Callable[..., tuple[str, Mapping[str, float]]]
"""A note, or a function of the recorded flights and the study's rows that gives it with its facts."""


def column(rows: Rows, name: str, variant: str, scenarios: Sequence[str]) -> list[float]:
    """The values of one column of ``ledger_seeds`` in one variant and some scenarios, in the order of the table."""
    return [row[name] for row in rows if row["variant"] == variant and row["scenario"] in scenarios]


def flown(measure: Callable[[Flight], float], *sources: Flight | Rows, bags: Sequence[str], remark: Remark) -> Evidence:
    """A number of each flight: the column named as its function, and the function of the recorded flights (median)."""
    *flights, rows = sources
    recorded = float(np.median([measure(flight) for flight in flights]))
    note, facts = (remark, {}) if isinstance(remark, str) else remark(*flights, rows)
    return Evidence(column(rows, measure.__name__, "default", bags), recorded, note, facts=facts)


def paired(
    measure: Callable[[Flight], float],
    changed: tuple[str, str],
    remark: Callable[[Rows], tuple[str, Mapping[str, float]]],
    rows: Rows,
) -> Evidence:
    """A number of each flight of a (variant, scenario), over that of the default flight with the same seed."""
    variant, scenario = changed
    usual = {row["seed"]: row[measure.__name__] for row in rows if _is(row, "default", scenario)}
    other = {row["seed"]: row[measure.__name__] for row in rows if _is(row, variant, scenario)}
    values = [value / usual[seed] for seed, value in other.items()]
    note, facts = remark(rows) if values else (INCOMPLETE, {})
    return Evidence(values, note=note, facts=facts)


def _is(row: Mapping, variant: str, scenario: str) -> bool:
    return row["variant"] == variant and row["scenario"] == scenario


# --- remarks on numbers of one flight


def when_pushed(flight: Flight, rows: Rows) -> tuple[str, dict]:
    """D1."""
    when = ", ".join(f"{time:.1f}" for time in push_times(flight))
    words = f"Pushed at {when} s, with impulses of our choice (D2). Up: the rod leans less than "
    return words + f"{math.degrees(FALL_ANGLE):.0f} deg until the next push, or the end", {}


def _angles(offset: float, printed: float, flight: Flight, found: float) -> str:
    words = f"asin(offset / (l/2)) is {angle(found, flight):.2f} deg in the recorded flight; the paper's own "
    return words + f"{100 * offset:g} cm make {angle(offset, flight):.2f} deg, where it prints {printed:g}"


def push_angle(offset: float, printed: float, flight: Flight, rows: Rows) -> tuple[str, dict]:
    """D2: the same in degrees, and how hard we pushed."""
    known = (event.data.get("impulse") for event in flight.events if event.kind == "push")
    impulses = [1e3 * math.hypot(*impulse) for impulse in known if impulse]
    words = _angles(offset, printed, flight, quantities.push_lean(flight))
    return words, {"impulse": max(impulses, default=math.nan)}


def circle_angle(offset: float, printed: float, flight: Flight, rows: Rows) -> tuple[str, dict]:
    """C1: the same in degrees, and our circle."""
    lap = laps(flight)
    words = f"A lap in {lap.period:.1f} s. {_angles(offset, printed, flight, quantities.circle_lean(flight))}"
    return words, {"period": lap.period, "radius": lap.radius}


def band(flight: Flight, rows: Rows) -> tuple[str, dict]:
    """D3."""
    words = f"Settled: a and b stay within {100 * quantities.SETTLED:g} cm (the paper names no band); slowest push"
    return words, {"band": 100 * quantities.SETTLED}


def pushed_alike(flight: Flight, rows: Rows) -> tuple[str, dict]:
    """D4: what the weights of x do for y."""
    alike = _median(column(rows, "pushed_axes", "y heavy", ("push-hover",)))
    words = f"RMS error of y over that of x from the first push on; with the weights of x for y, too: {alike:.2f}"
    return words, {"alike": alike}


def printed_error(error: float, flight: Flight, rows: Rows) -> tuple[str, dict]:
    """G1-G3: what the lengths stand on."""
    e, lap = flight.params.estimation, laps(flight)
    words = (
        f"Agrees when as close as the paper's worst flight. The paper's error is {error:.3f} m; that of our recorded "
    )
    words += f"flight {convergence(flight).error:.3f} m. A run each {e.run_period:g} s on {e.window} samples at "
    words += f"{1 / e.sample_period:g} Hz, fitness '{e.fitness}'; median of the used length over the last "
    words += f"{FINAL_SECONDS:g} s. Other interpretations: table6-readings, table17-choices"
    return words, {"period": lap.period, "radius": lap.radius}


def first_time(flight: Flight, rows: Rows) -> tuple[str, dict]:
    """G1-G3: when the recorded flight first comes close, and when its first window is full."""
    moments, used = used_length(flight)
    first = float(moments[np.argmax(np.abs(used - convergence(flight).length) <= CONVERGED)])
    full = (flight.params.estimation.window - 1) * flight.params.estimation.sample_period
    words = f"Within {100 * CONVERGED:g} cm of its final value to stay there (the paper defines no convergence). The "
    words += (
        f"recorded flight first comes that close at {first:.1f} s; its first window is full at {full:.1f} s, counted "
    )
    return words + "from the start of the recording", {"window": full, "first": first}


def identity(*sources: Flight | Rows) -> tuple[str, dict]:
    """Return the printed fitness with unit covariances."""
    *flights, rows = sources
    starts = [flight.metadata.get("scenario", "") for flight in flights]
    plain = column(rows, "printed_identity", "default", starts) if rows else []
    words = "Fitness exactly as printed, exhaustive search, median over windows of each flight, our noise covariances. "
    words += f"With Q_e = R_e = I the median of all flights is {_median(plain):.2f} m"
    recorded = {f"start {number}": quantities.printed_best(flight) for number, flight in enumerate(flights, 1)}
    unit = {f"unit {number}": quantities.printed_identity(flight) for number, flight in enumerate(flights, 1)}
    return words, recorded | unit


# --- evidence that is not one number of each flight


def heavier_y(rows: Rows) -> Evidence:
    """C3: the largest error of y with the weights of x for y, over the mean of that with ours."""
    light, heavy = (column(rows, "y_error", variant, ("circle-0.8",)) for variant in ("default", "y heavy"))
    if not (light and heavy):
        return Evidence([], note=INCOMPLETE)
    facts = {"light": float(np.mean(light)), "heavy": float(np.mean(heavy))}
    words = f"Weights of y and y' ten times ours, as those of x and x': {facts['light']:.3f} m become "
    words += f"{facts['heavy']:.3f} m (means)"
    return Evidence([value / facts["light"] for value in heavy], note=words, facts=facts)


def _gaps(rows: Rows) -> list[tuple[float, float, float]]:
    return [
        (row["search_gap"], row["explored_gap"], row["optimum_error"])
        for row in rows
        if row["variant"] == "default" and str(row["scenario"]).startswith("estimate")
    ]


def search(*sources: Flight | Rows) -> Evidence:
    """G4: exploration limits the estimate where the GA ends farther from l_best than l_best lies from the rod."""
    *flights, rows = sources
    gap, _, optimum, count = quantities.search_gaps(*flights)
    words = "A flight agrees if the GA's answer is farther from the best of all lengths than that is from the rod "
    words += f"(medians over windows). In {count} windows of the recorded flights the GA is {1e3 * gap:.1f} mm off the "
    words += f"best, the best {1e3 * optimum:.0f} mm off the rod. N_c, generations are ours"
    facts = {"optimum": 1e3 * optimum, "windows": count, "gap": 1e3 * gap}
    found = _gaps(rows)
    values = [float(gap > optimum) for gap, _, optimum in found]
    return Evidence(values, gap, words, _median([gap for gap, *_ in found]), facts)


def remedy(*sources: Flight | Rows) -> Evidence:
    """G4: with ``EXPLORING`` the GA comes closer, in a flight where exploration limits it."""
    *flights, rows = sources
    _, explored, _, _ = quantities.search_gaps(*flights)
    share, rate = quantities.EXPLORING.values()
    words = f"As G4.search, with r_p = {share:g} and r_m = {rate:g}. A flight agrees if exploration limits it and "
    words += "the GA comes closer to the best of all lengths"
    found = _gaps(rows)
    values = [float(gap > optimum and explored < gap) for gap, explored, optimum in found]
    ours = _median([explored for _, explored, _ in found])
    return Evidence(values, explored, words, ours, {"gap": 1e3 * explored})


def _falls(rows: Rows, variant: str) -> list[float]:
    """Return whether each flight of a variant of the changed length fell."""
    return [1.0 - row["survived"] for row in rows if _is(row, variant, "length-jump")]


def safe_changes(flight: Flight, rows: Rows) -> Evidence:
    """G6: changes of up to 0.8 m that stay, in the study of jumps, both rods and directions: share survived."""
    recorded = quantities.survived_change(flight)
    if not rows:
        return Evidence([], recorded, INCOMPLETE)
    flights = int(max(row["survived"] for row in rows))
    some = {"2 s": [], "to the end": []}
    for row in rows:
        if row["change"] == "at once" and abs(row["jump"]) <= 0.8:
            some[row["lasting"]] += [float(number < row["survived"]) for number in range(flights)]
    fell = [row for row in rows if row["change"] == "at once" and row["survived"] < flights]
    least = min((abs(row["jump"]) for row in fell), default=math.inf)
    largest = max((abs(row["jump"]) for row in rows if abs(row["jump"]) < least), default=math.nan)
    rods = {row["rod"]: min(one["jump"] for one in fell if one["rod"] == row["rod"]) for row in fell}
    limits = " and ".join(f"{jump:+.1f} m ({rod})" for rod, jump in rods.items()) or "no change"
    short, lasting = (f"{sum(values):.0f} of {len(values)}" for values in some.values())
    words = (
        f"Every length up to 0.8 m too short or too long, a uniform rod and a point mass: {lasting} flights survive "
    )
    words += f"one that stays, {short} one of 2 s. Ours: the largest that stays and is survived in all flights; falls "
    words += f"begin at {limits}. A limit is a claim on every change below it"
    return Evidence(
        some["to the end"], recorded, words, largest, {"short": sum(some["2 s"]), "flights": len(some["2 s"])}
    )


OUTLIERS = {"outlier": "0.85 m too long", "short outlier": "that jumps 0.9 m down to 0.2 m"}
"""The changes beyond the paper's limit that are flown for 2 s, by variant."""


def fatal_changes(flight: Flight, rows: Rows) -> Evidence:
    """G6: falls after a change that lasts 2 s, as a jump of an estimate does; beside one that stays."""
    fatal, standing = quantities.fatal_jump(flight), _falls(rows, "standing")
    falls = {variant: _falls(rows, variant) for variant in OUTLIERS}
    words = ", ".join(
        f"{sum(falls[variant]):.0f} of {len(falls[variant])} flights fall with a length {change} for 2 s"
        for variant, change in OUTLIERS.items()
    )
    words += f". With 0.85 m too long to the end {sum(standing):.0f} of {len(standing)} fall: the wrong length causes "
    words += "the fall, not the change"
    facts = {"standing": sum(standing), "flights": len(standing)}
    if fatal is not None:
        delay = fatal.end - fatal.start
        words += f"; in the recorded flight it takes {delay:.1f} s"
        facts |= {"delay": delay}
    size = max(jump.size for jump in jumps(flight))
    return Evidence(
        [one for some in falls.values() for one in some], quantities.fatal_change(flight), words, size, facts
    )


def wild_commands(variant: str, *sources: Flight | Rows) -> Evidence:
    """G6: RMS of the rate commands in the 2 s of a change over that before it."""
    *flights, rows = sources
    words = f"RMS of the rate commands in the 2 s of a length {OUTLIERS[variant]} over that before"
    recorded = quantities.command_ratio(flights[0]) if flights else math.nan
    if flights:
        standing = _median(column(rows, "command_ratio", "default", ("length-jump",)))
        words += f". Where it stays, until the fall: {standing:.2f} (median), {recorded:.3f} in the recorded flight"
    facts = {"ratio": recorded} if flights else {}
    return Evidence(column(rows, "command_ratio", variant, ("length-jump",)), recorded, words, facts=facts)


def small_steps(rows: Rows, jumps: Rows) -> Evidence:
    """G6: of the flights that a change of 0.85 m at once makes fall, the share that steps of 5 cm save."""
    if not (rows and jumps):
        return Evidence([], note=INCOMPLETE)
    at_once, stepped = _falls(rows, "standing"), _falls(rows, "standing in steps")
    saved = [1.0 - after for before, after in zip(at_once, stepped, strict=True) if before]
    outliers = sum(_falls(rows, "outlier"))
    flights = max(row["survived"] for row in jumps)
    cases = [row for row in jumps if row["lasting"] == "to the end"]
    fell = {(row["length"], row["rod"]): flights - row["survived"] for row in cases if row["change"] == "at once"}
    still = {(row["length"], row["rod"]): flights - row["survived"] for row in cases if row["change"] == "in steps"}
    wrong, lost = sum(fell.values()), sum(min(still[case], count) for case, count in fell.items())
    words = (
        f"A length 0.85 m too long that stays: of {len(saved)} flights that fall at once, {sum(saved):.0f} survive in "
    )
    words += "steps of 5 cm each 0.2 s; the others fall later, since the loop is unstable. One of 2 s makes "
    words += f"{outliers:.0f} fall, so that steps cannot help: in 2 s they change the length by 0.5 m only. "
    words += f"Over all lengths of the study 'length_jumps' steps save {wrong - lost:.0f} of {wrong:.0f} flights"
    facts = {"outliers": outliers, "wrong": wrong, "lasting": (wrong - lost) / wrong if wrong else math.nan}
    return Evidence(saved, note=words, ours=float(np.mean(saved)) if saved else math.nan, facts=facts)


def hover_exact(rows: Rows) -> tuple[str, dict]:
    """G8: how exact the flights in hover end, and those on the circle."""
    hover, circle = (column(rows, "final_length", variant, ("estimate-1.2",)) for variant in ("hover", "default"))
    off = [1e3 * _median([abs(value - 1.0) for value in values]) for values in (hover, circle)]
    words = "RMS error of the estimator's answers in hover over that on the circle of 0.4 m, same seed. Final lengths "
    words += f"are {off[0]:.0f} mm off in hover, {off[1]:.0f} mm on the circle (medians). Noise moves our hover, which "
    return words + "is not still", {"hover": off[0], "circle": off[1]}


def swayed(rows: Rows) -> tuple[str, dict]:
    """M1: how far altitude and yaw moved."""
    height, yaw = (_median(column(rows, name, "swaying", ("circle-0.8",))) for name in ("height_sway", "yaw_sway"))
    words = (
        "Largest deviation of a, b on the circle of 0.8 m while a slow disturbance of thrust and yaw rate moves the "
    )
    words += f"vehicle by {100 * height:.0f} cm and {yaw:.0f} deg (medians), over that without, same seed"
    return words, {"height": 100 * height, "yaw": yaw}


def mass_in_length(rows: Rows) -> tuple[str, dict]:
    """M2: what the rod's mass does to the length that the motion shows."""
    from fiplib.params import Params

    vehicle, rod = Params().vehicle.mass, Params().pendulum
    shift = 100 * rod.inertia_factor * rod.mass / (vehicle + rod.mass)
    words = (
        "Largest deviation of a, b on the circle of 0.8 m with a rod of 0.1 g over that with the paper's 32 g, same "
    )
    words += (
        f"seed. For the estimator the mass matters: the motion is that of a pendulum {shift:.1f} % shorter, more than "
    )
    return words + "the paper's largest error", {"shift": shift}


def terminal(rows: Rows) -> Evidence:
    """M3: share of the problems after pushes that a terminal constraint makes infeasible."""
    words = "Share of the hard-bounded problems, 0.1 to 1 s after each push with 0.4, 1.0 and 1.6 m in use, that "
    words += "x_N = x_ref makes infeasible (linear programmes). A flight agrees if there is one. In 6 s each of these "
    words += "states that can be kept within bounds can be brought to rest, too"
    return Evidence(column(rows, "terminal_loss", "default", ("push-hover",)), note=words)


def solve_time(solves: Quantities, ticks: Quantities) -> Evidence:
    """R1: the longest of 99 % of the solves, ms; and the solves of a flight in real time, each within its bin."""
    kind = "solve_us_"
    times = [(float(name.removeprefix(kind)) / 1e3, count) for name, count in ticks.items() if name.startswith(kind)]
    values = [time for time, count in times for _ in range(int(count))]
    if not values or "mpc_p99" not in solves:
        return Evidence([], note="The benchmark has not been recorded yet")
    words = (
        f"All {len(values)} solves of a flight in real time; 99 % of those of the benchmark take no longer than the "
    )
    words += "time shown. Needed: 99 % within a tick. Our exact solver in place of acados, on our machine"
    return Evidence(values, max(values), words, solves["mpc_p99"] / 1e3)


def late_ticks(ticks: Quantities) -> Evidence:
    """R1: every tick whose command left later than its deadline, whatever the cause; then the causes."""
    if "missed" not in ticks:
        return Evidence([], note="The benchmark has not been recorded yet")
    count, missed, machine = int(ticks["ticks"]), int(ticks["missed"]), int(ticks["missed_machine"])
    ours = int(ticks["missed_ours"])
    low, high = (100 * limit for limit in binomial_interval(missed, count))
    words = (
        f"{missed} of {count} ticks are late ({low:.3f} to {high:.3f} %), in {ticks['minutes']:.0f} min in real time "
    )
    words += (
        f"on {ticks['cores']:.0f} cores with the GA in its own process. Of these our own code made {ours} late, the "
    )
    words += f"machine {machine}, and {missed - ours - machine} are unexplained. Needed: 99 % in time. The vehicle was "
    words += "simulated, its computer not tried"
    values = [0.0] * missed + [1.0] * (count - missed)
    facts = {"minutes": ticks["minutes"], "missed": missed, "ours": ours, "machine": machine, "ticks": count}
    return Evidence(values, note=words, ours=100 * missed / count, facts=facts)


def none() -> Evidence:
    """V1: there is none."""
    return Evidence([])


def _median(values: Sequence[float]) -> float:
    known = [value for value in values if not math.isnan(value)]
    return float(np.median(known)) if known else math.nan
