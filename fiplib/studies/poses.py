"""Coverage of the pose estimator's interval, whatever was not stated (docs/studies.md).

A case is one simulated flight of 16 s; its columns summarise four windows of 2.5 s, in which only the poses of vehicle
and rod are seen: no commands, no thrust, no delays. The poses are made from the true states here, with fresh noise: the
vehicle is tracked at its frame, below the seat, the rod ``above`` its middle, within 1 mm. By group:

- ``stated``: that the rod is tracked at its middle is stated, within 1 mm, as in all bags of ours; calibration, seat,
  inertia and noise are not;
- ``untold``: nothing is stated, and seat, inertia and tracked point are not as usual;
- ``wrong``: something is stated that is not so: the estimate should be refused.

Per case ``n`` windows are answered and ``refused`` are not; ``bias``, ``rms``, ``worst``, ``sd`` in m and ``covered``
are of the answers' lengths; ``seat`` in m and ``inertia`` are root mean square errors of the seat's height and of the
inertia factor. ``bound`` in m is the Cramer-Rao bound from poses alone in the first window, where it is computed.
760 rows, about 4 minutes of one core.
"""

import math
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from fiplib.dynamics import PLANT
from fiplib.estimators.cramer_rao import Motion, cramer_rao_of_poses, motion
from fiplib.estimators.poses.estimate import PoseEstimate, estimate
from fiplib.estimators.poses.knowledge import MIDDLE, Knowledge, Told
from fiplib.estimators.poses.rows import Body, upright_axis
from fiplib.params import Params
from fiplib.references import Circle, Hover, Reference
from fiplib.reproduction.measures import rms
from fiplib.reproduction.sources import Rows
from fiplib.reproduction.style import BLUE, COLUMN, GREY, ORANGE, PURPLE, origin
from fiplib.reproduction.tables import NONE, Facts, Table, number
from fiplib.simulate import Plant, Push, Scenario, fly
from fiplib.studies.batch import fly_many
from fiplib.studies.estimators import interval, pooled_bias, pooled_rms, ranged, resampled, summarise
from fiplib.studies.imperfections import Imperfection, ImperfectPlant

KEYS = ("condition", "seed")

SEEDS = range(20)

STARTS = (3.0, 6.1, 9.2, 12.3)
"""When the windows begin, s."""

SECONDS, DURATION = 2.5, 16.0

FEW = 8
"""Answered windows below which figure 16 draws no share, and table 13 gives no interval of an error."""

CIRCLE = Circle(0.4, 8.0)

STATED, NOTHING = Knowledge(marker_offset=MIDDLE), Knowledge()


@dataclass(frozen=True)
class Condition:
    """A flight, what is seen of it, and what is stated.

    Args:
        length, seat: true length of the rod, and height of its seat above the vehicle's frame, m.
        above: how far above its middle the rod is tracked, m.
        noise: factor on the noise of motion capture.
        jitter: standard deviation of the stamps, s.
        losses: share of the rod's poses that are lost.
        rate: poses a second.
        turned: angle in rad by which the vehicle's body frame is turned about its x axis.
        thrust: share of the commanded thrust that acts.
        knowledge: what is stated.
        inertia_tolerance: if positive, an inertia factor is stated that is wrong by a normal error of this size.
        reference, changes: what is flown, and parameters of it.
        bound: whether the Cramer-Rao bound is computed, too.
    """

    length: float = 1.0
    seat: float = 0.08
    above: float = 0.0
    noise: float = 1.0
    jitter: float = 0.0
    losses: float = 0.0
    rate: float = 240.0
    turned: float = 0.0
    thrust: float = 1.0
    knowledge: Knowledge = STATED
    inertia_tolerance: float = 0.0
    reference: Reference = CIRCLE
    changes: dict[str, Any] = field(default_factory=dict)
    bound: bool = False

    @property
    def group(self) -> str:
        """``stated``, ``untold`` or ``wrong``, see above."""
        if self.knowledge == NOTHING:
            return "untold"
        return "stated" if self.knowledge == STATED else "wrong"


def _untold(**differences: Any) -> Condition:
    return Condition(knowledge=NOTHING, **differences)


def _inertia(ratio: float) -> dict[str, Any]:
    return {"changes": {"pendulum__gyration_ratio": ratio}}


CONDITIONS = {
    "circle 0.4 m / 8 s": Condition(bound=True),
    "circle 0.2 m / 12 s": Condition(reference=Circle(0.2, 12.0), bound=True),
    "circle 0.6 m / 6 s": Condition(reference=Circle(0.6, 6.0), bound=True),
    "circle 0.8 m / 9 s": Condition(reference=Circle(0.8, 9.0), bound=True),
    "hover": Condition(reference=Hover(), bound=True),
    "rod 0.3 m": Condition(length=0.3, bound=True),
    "rod 0.7 m": Condition(length=0.7, bound=True),
    "rod 1.5 m": Condition(length=1.5, bound=True),
    "seat at 0": Condition(seat=0.0),
    "seat at 3 cm": Condition(seat=0.03),
    "seat at 12 cm": Condition(seat=0.12),
    "noise doubled": Condition(noise=2.0),
    "stamps jitter by 0.3 ms": Condition(jitter=0.3e-3),
    "100 Hz": Condition(rate=100.0),
    "30 % of the rod's poses lost": Condition(losses=0.3),
    "body frame turned by 20 deg": Condition(turned=math.radians(20.0)),
    "thrust 5 % less": Condition(thrust=0.95),
    "inertia factor stated, 0.02 wrong": Condition(inertia_tolerance=0.02),
    "inertia ratio 0": Condition(**_inertia(0.0)),
    "inertia ratio 1/24": Condition(**_inertia(1 / 24)),
    "inertia ratio 1/9": Condition(**_inertia(1 / 9)),
    "uniform, at its middle": _untold(),
    "uniform, hover": _untold(reference=Hover()),
    "uniform, seat at 0": _untold(seat=0.0),
    "uniform, seat at 3 cm": _untold(seat=0.03),
    "uniform, seat at 12 cm": _untold(seat=0.12),
    "point mass": _untold(**_inertia(0.0)),
    "ratio 1/24": _untold(**_inertia(1 / 24)),
    "ratio 1/9": _untold(**_inertia(1 / 9)),
    "tracked 1 cm below": _untold(above=-0.01),
    "tracked 3 cm below": _untold(above=-0.03),
    "tracked 3 cm above": _untold(above=0.03),
    "tracked 10 cm above": _untold(above=0.1),
    "tracked 30 cm below": _untold(above=-0.3),
    "tracked 30 cm above": _untold(above=0.3),
    "seat stated 0, is 8 cm": Condition(knowledge=Knowledge(marker_offset=MIDDLE, seat_height=Told(0.0, 2e-3))),
    "inertia stated 1, is 3/4": Condition(knowledge=Knowledge(inertia_factor=Told(1.0, 5e-3), marker_offset=MIDDLE)),
    "middle stated, 3 cm above": Condition(
        above=0.03, knowledge=Knowledge(inertia_factor=Told(0.75, 3e-3), marker_offset=MIDDLE)
    ),
}


def flown(condition: Condition, seed: int, duration: float = DURATION, pushes: tuple[Push, ...] = ()) -> Motion:
    """Return the true motion of a flight, a frame of motion capture each; its pilot knows length and seat."""
    told = {"pendulum__length": condition.length, "piloting__initial_length": condition.length}
    told |= {"vehicle__seat_height": condition.seat, "piloting__seat_height": condition.seat}
    params = Params().replace(**told, **condition.changes)
    scenario = Scenario("poses", "", duration, condition.reference, pushes, params=params, seed=seed)

    def vehicle(params: Params, position: ArrayLike, lean: ArrayLike) -> Plant:
        return ImperfectPlant(params, position, lean, imperfection=Imperfection(thrust=condition.thrust), seed=seed)

    return motion(next(fly_many([scenario])) if condition.thrust == 1.0 else fly(scenario, vehicle=vehicle))


def observed(
    x: NDArray,
    rng: np.random.Generator,
    length: float = 1.0,
    below: float = 0.08,
    above: float = 0.0,
    noise: tuple[float, float] = (0.2e-3, 1e-3),
    rate: float = 240.0,
    turned: float = 0.0,
) -> tuple[Body, Body]:
    """Return vehicle and rod as motion capture sees the states x (n, 20).

    The vehicle is tracked ``below`` the seat, the rod ``above`` its middle, m; ``noise`` is of positions in m and of
    attitudes in rad; ``turned`` is the angle of the vehicle's body frame, rad; positions have single precision.
    """
    attitude, q = Rotation.from_quat(x[:, PLANT["attitude"]]), x[:, PLANT["direction"]]

    def body(position: NDArray, axis: NDArray) -> Body:
        position = position + noise[0] * rng.normal(size=position.shape)
        return Body(np.arange(len(x)) / rate, position.astype(np.float32).astype(float), axis)

    wrong = Rotation.from_rotvec(noise[1] * rng.normal(size=(len(x), 3)))
    axis, _ = upright_axis((attitude * wrong * Rotation.from_euler("x", turned)).as_quat())
    direction = q + noise[1] * rng.normal(size=q.shape) * [1, 1, 0]
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    up = attitude.apply([0.0, 0.0, 1.0])
    return body(x[:, :3] - below * up, axis), body(x[:, :3] + (length / 2 + above) * q, direction)


def cases() -> list[dict]:
    """Every condition, over ``SEEDS``."""
    return [{"condition": name, "seed": seed} for name in CONDITIONS for seed in SEEDS]


def run(case: dict) -> dict[str, float | int]:
    """Fly the case and estimate the length in its windows."""
    condition, seed = CONDITIONS[case["condition"]], int(case["seed"])
    at = list(CONDITIONS).index(case["condition"])
    true, rng = flown(condition, 60_000 + 100 * at + seed), np.random.default_rng([60, at, seed])
    found = answers(condition, true, rng)
    given = [one for one in found if one.reason is None]
    ratio = {"pendulum__gyration_ratio": 1 / 12} | condition.changes
    inertia = 0.25 / (0.25 + ratio["pendulum__gyration_ratio"])
    row: dict[str, float | int] = summarise(found, condition.length)
    row["seat"] = rms([one.seat_height.value - condition.seat for one in given]) if given else math.nan
    row["inertia"] = rms([one.inertia_factor.value - inertia for one in given]) if given else math.nan
    return row | {"bound": bound_of(condition, true) if condition.bound and found else math.nan}


def answers(condition: Condition, true: Motion, rng: np.random.Generator) -> list[PoseEstimate]:
    """Return the answers to the windows that end before the flight does."""
    marker = condition.above + MIDDLE.tolerance * rng.normal()
    noise, x = (0.2e-3 * condition.noise, 1e-3 * condition.noise), true.states
    if condition.rate * true.period < 0.99:
        clock = true.period * np.arange(len(x))
        x = CubicSpline(clock, x)(np.arange(0.0, clock[-1], 1.0 / condition.rate))
    bodies = observed(x, rng, condition.length, condition.seat, marker, noise, condition.rate, condition.turned)
    knowledge = condition.knowledge
    if tolerance := condition.inertia_tolerance:
        knowledge = replace(knowledge, inertia_factor=Told(0.75 + tolerance * rng.normal(), tolerance))
    found = []
    for start in STARTS:
        window = [body.part((body.time >= start) & (body.time < start + SECONDS)) for body in bodies]
        if len(window[0].time) < math.floor(condition.rate * SECONDS):
            break
        jittered = [
            body._replace(time=body.time + condition.jitter * rng.normal(size=len(body.time))) for body in window
        ]
        kept = rng.random(len(window[1].time)) >= condition.losses
        found.append(estimate(jittered[0], jittered[1].part(kept), knowledge))
    return found


def bound_of(condition: Condition, true: Motion) -> float:
    """Return the bound of the length in the first window, m: the others differ little, and it takes half a second.

    It is the bound of the flights as they are simulated: the distance of the tracked points is exactly as it looks,
    which an estimate that allows for a millimetre does not know.
    """
    told = {"pendulum__length": condition.length, "vehicle__seat_height": condition.seat}
    first = round(STARTS[0] / true.period)
    part = slice(first, first + round(SECONDS / true.period))
    window = Motion(true.states[part], true.commands[part], true.period)
    params = Params().replace(**told, **condition.changes)
    return float(cramer_rao_of_poses(window, params, replace(condition.knowledge, distance_tolerance=1e-5))[-1])


class Pooled(NamedTuple):
    """A condition over its flights: windows answered, and the share refused; mean and root mean square error, mean
    stated deviation and bound in m; the share of intervals that hold the length, with its interval."""

    windows: int
    refused: float
    bias: float
    rms: float
    sd: float
    bound: float
    covered: tuple[float, float, float]


def pooled(rows: Rows, condition: str) -> Pooled:
    """Return a condition's rows as one."""
    chosen = [row for row in rows if row["condition"] == condition]
    n, refused = (np.array([row[column] for row in chosen]) for column in ("n", "refused"))
    given = [row for row in chosen if row["n"] > 0]
    weights = n[n > 0]
    shares = float(refused.sum() / max(n.sum() + refused.sum(), 1))
    if not given:
        return Pooled(0, shares, *(math.nan,) * 4, (math.nan,) * 3)
    bias, error, sd, bound = (np.array([row[column] for row in given]) for column in ("bias", "rms", "sd", "bound"))
    total = weights.sum()
    mean, square = float(weights @ bias / total), float(np.sqrt(weights @ error**2 / total))
    limit = float(np.sqrt(weights @ bound**2 / total))
    covered = interval([row["covered"] for row in given], weights)
    return Pooled(int(total), shares, mean, square, float(weights @ sd / total), limit, covered)


def refusal(rows: Rows, condition: str) -> tuple[float, float, float]:
    """Return the share of a condition's windows that are refused, with its 95 % interval as ``interval`` gives it."""
    n, refused = np.array([(row["n"], row["refused"]) for row in rows if row["condition"] == condition]).T
    return interval(refused, n + refused)


def fig16_coverage(rows: Rows) -> Figure:
    """Fig. 16: share of stated 95 % intervals that cover the length, and share of windows refused, by condition.

    The estimate from poses alone, 20 simulated flights of 4 windows of 2.5 s for each condition; bars: 95 % intervals,
    bootstrap over flights, or Wilson's where all windows or none count. Blue: the rod's middle is tracked and that is
    stated; orange: nothing is stated; purple: something is stated wrongly. Lines at 95 and 90 %. Where fewer
    than 8 windows are answered no share is drawn. Where the estimator answers, 93 to 100 % of the intervals cover it;
    wrong statements are refused.
    """
    figure = Figure(figsize=(COLUMN, 5.2), layout="constrained")
    axes, right = figure.subplots(1, 2, sharey=True, width_ratios=(3, 1))
    colours = {"stated": BLUE, "untold": ORANGE, "wrong": PURPLE}
    for at, (name, condition) in enumerate(CONDITIONS.items()):
        found, colour = pooled(rows, name), colours[condition.group]
        if found.windows >= FEW:
            share, low, high = (100 * value for value in found.covered)
            axes.errorbar(share, at, xerr=[[share - low], [high - share]], fmt="o", ms=3, lw=0.8, color=colour)
        share, low, high = (100 * value for value in refusal(rows, name))
        bars = {"elinewidth": 0.6, "ecolor": "black"}
        right.barh(at, share, color=colour, xerr=[[share - low], [high - share]], error_kw=bars)
    for value, style in ((95.0, "-"), (90.0, "--")):
        axes.axvline(value, color=GREY, lw=0.6, ls=style)
    axes.set(yticks=range(len(CONDITIONS)), yticklabels=list(CONDITIONS), ylim=(len(CONDITIONS) - 0.4, -0.6))
    axes.set(xlabel="in interval (%)", xlim=(75, 101))
    axes.tick_params(axis="y", labelsize=6)
    right.set(xlabel="refused (%)", xlim=(0, 100))
    origin(figure, "simulated flights, windows of 2.5 s, poses alone")
    return figure


def table13_coverage(rows: Rows) -> Table:
    """Table 13: the estimate from poses alone by condition: windows answered and refused, errors, and the intervals.

    20 simulated flights of 4 windows of 2.5 s for each condition. Stated: the mean standard deviation that the
    estimator gives; in brackets: 95 % intervals, bootstrap over flights, of errors where at least 8 windows are
    answered. RMSE / bound: where the Cramer-Rao bound is computed.
    """
    lines = []
    for name in CONDITIONS:
        found = pooled(rows, name)
        cells = [NONE] * 5
        if found.windows:
            share, low, high = (100 * value for value in found.covered)
            ratio = NONE if math.isnan(found.bound) else f"{found.rms / found.bound:.2f}"
            given = [row for row in rows if row["condition"] == name and row["n"] > 0]
            errors = [number(1e3 * value, 1) for value in (found.bias, found.rms, found.sd)]
            if found.windows >= FEW:
                for at, (statistic, column) in enumerate(((pooled_bias, "bias"), (pooled_rms, "rms"))):
                    errors[at] = ranged(*(1e3 * value for value in resampled(given, statistic, "n", column)), 1)
            cells = [*errors, f"{share:.0f} ({low:.0f} to {high:.0f})", ratio]
        label = name.replace("%", r"\%")
        lines.append((label, f"{found.windows}", f"{100 * found.refused:.0f}", *cells))
    header = (
        "Condition", "Answered", r"Refused (\%)", "Bias (mm)", "RMSE (mm)", "Stated (mm)",
        r"In 95\,\% interval (\%)", "RMSE / bound",
    )  # fmt: skip
    return Table(header, lines, "lrrrrrrr")


def facts(rows: Rows) -> Facts:
    """Return what the report states of the circle, of the worst condition, and of what is stated wrongly."""
    usual = pooled(rows, next(iter(CONDITIONS)))
    share, low, high = (f"{100 * value:.0f}" for value in usual.covered)
    found: Facts = {
        ("windows",): f"{usual.windows}",
        ("bias",): f"{1e3 * usual.bias:.1f}",
        ("rms",): f"{1e3 * usual.rms:.1f}",
        ("sd",): f"{1e3 * usual.sd:.1f}",
        ("ratio",): f"{usual.rms / usual.bound:.2f}",
        ("covered",): share,
        ("covered", "low"): low,
        ("covered", "high"): high,
    }
    for group in ("stated", "untold", "wrong"):
        some = [pooled(rows, name) for name, condition in CONDITIONS.items() if condition.group == group]
        shares = [one.covered[0] for one in some if one.windows]
        found[group, "conditions"] = f"{len(some)}"
        found[group, "refused"] = f"{100 * min(one.refused for one in some):.0f}"
        if shares:
            found[group, "least"] = f"{100 * min(shares):.0f}"
    return found
