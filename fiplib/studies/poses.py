"""Does the interval of the pose estimator hold the length, whatever was not stated? On a plant with a seat.

Every case is one flight of 16 s, simulated, of a plant whose seat lies above the vehicle's centre of mass; its columns
summarise four windows of 2.5 s. The motion capture is made from the true states here: the vehicle is tracked at its
centre of mass, the rod ``above`` its middle, within 1 mm. "stated" cases know that the rod is tracked at its middle, as
in all bags of ours; the others know nothing. ``interval`` gives the coverage with a bootstrap over flights.
"""

from collections import deque
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from fiplib.dynamics import PLANT, body_z, rk4, z_axis
from fiplib.estimators.base import Estimate
from fiplib.estimators.poses.estimate import estimate
from fiplib.estimators.poses.knowledge import MIDDLE, Knowledge
from fiplib.estimators.poses.rows import Body
from fiplib.params import GRAVITY, Params
from fiplib.pilot import Circle, Hover, Reference
from fiplib.simulate import Plant, Scenario, fly
from fiplib.studies.estimators import summarise

KEYS = ("condition", "seed")

SEEDS = range(16)

STARTS = (3.0, 6.1, 9.2, 12.3)
"""When the windows begin, s."""

SECONDS, DURATION = 2.5, 16.0

CIRCLE = Circle(0.4, 8.0)


@dataclass(frozen=True)
class Condition:
    """A flight, what is tracked, and what is stated: lengths in m, ``noise`` a factor, ``changes`` of parameters."""

    length: float = 1.0
    seat: float = 0.08
    above: float = 0.0
    noise: float = 1.0
    jitter: float = 0.0
    losses: float = 0.0
    stated: bool = True
    reference: Reference = CIRCLE
    changes: dict[str, Any] = field(default_factory=dict)


CONDITIONS = {
    "circle": Condition(),
    "hover": Condition(reference=Hover()),
    "circle 0.8 m, 9 s": Condition(reference=Circle(0.8, 9.0)),
    "rod 0.3 m": Condition(length=0.3),
    "rod 0.7 m": Condition(length=0.7),
    "rod 1.5 m": Condition(length=1.5),
    "seat 0": Condition(seat=0.0),
    "seat 3 cm": Condition(seat=0.03),
    "seat 12 cm": Condition(seat=0.12),
    "noise doubled": Condition(noise=2.0),
    "stamps jitter by 0.3 ms": Condition(jitter=0.3e-3),
    "30 % of the rod's poses lost": Condition(losses=0.3),
    "circle, nothing stated": Condition(stated=False),
    "marker 1 cm below": Condition(stated=False, above=-0.01),
    "marker 3 cm below": Condition(stated=False, above=-0.03),
    "marker 3 cm above": Condition(stated=False, above=0.03),
    "marker 30 cm below": Condition(stated=False, above=-0.3),
    "inertia ratio 1/24": Condition(stated=False, changes={"pendulum__gyration_ratio": 1 / 24}),
    "inertia ratio 1/9": Condition(stated=False, changes={"pendulum__gyration_ratio": 1 / 9}),
}


def seat_plant(params: Params, seat: float) -> ca.Function:
    """Return ``dynamics.coupled_plant`` with the seat ``seat`` m above the centre of mass: one more force, m seat e''.

    The position is the seat's.
    """
    x, command, force = ca.SX.sym("x", 20), ca.SX.sym("command", 4), ca.SX.sym("force", 3)
    velocity, attitude, q, q_dot, rate, thrust = (x[PLANT[name]] for name in list(PLANT)[1:])
    m, m_p, r = params.vehicle.mass, params.pendulum.mass, params.pendulum.length / 2
    factor, e3 = params.pendulum.inertia_factor, ca.SX([0, 0, 1])
    rate_dot = (command[:3] - rate) / params.simulation.rate_lag
    body = ca.cross(rate, ca.cross(rate, e3)) + ca.cross(rate_dot, e3)
    twice = 2 * ca.cross(attitude[:3], body)
    e_ddot = body + attitude[3] * twice + ca.cross(attitude[:3], twice)

    def across(v: ca.SX) -> ca.SX:
        return v - q * ca.dot(q, v)

    total = thrust * body_z(attitude) + force + m * seat * e_ddot
    total += m_p * r * ca.sumsqr(q_dot) * q - factor * across(force)
    alpha = (total + m_p * factor / (m + m_p * (1 - factor)) * across(total)) / (m + m_p)
    q_ddot = -ca.sumsqr(q_dot) * q - factor / r * across(alpha - force / m_p)
    fall, thrust_dot = ca.SX([0, 0, GRAVITY]), (command[3] - thrust) / params.simulation.thrust_lag
    axis, w = attitude[:3], attitude[3]
    turning = ca.vertcat(w * rate + ca.cross(axis, rate), -ca.dot(axis, rate)) / 2
    x_dot = ca.vertcat(velocity, alpha - fall, turning, q_dot, q_ddot, rate_dot, thrust_dot)
    return ca.Function("plant", [x, command, force], [x_dot])


class SeatPlant(Plant):
    """The plant with a seat; ``states`` are its true states (20,), one a frame."""

    def __init__(self, params: Params, position: ArrayLike, lean: ArrayLike = (0.0, 0.0), *, seat: float) -> None:
        super().__init__(params, position, lean)
        simulation = params.simulation
        self.states: list[NDArray] = []
        self._model = rk4(seat_plant(params, seat), 1.0 / simulation.plant_rate)
        self._latency = round((simulation.mocap_latency + simulation.rate_delay) * simulation.plant_rate)
        self._queue: deque[tuple[int, NDArray]] = deque()
        self._now, self._acting = 0, np.array([0.0, 0.0, 0.0, self.x[19]])

    def command(self, body_rate: ArrayLike, thrust: float, at: int | None = None) -> None:
        """Give a command, as to ``Plant``."""
        self._queue.append((self._now + self._latency if at is None else at, np.array([*body_rate, thrust])))

    def advance(self, force: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        """One frame further, as of ``Plant``."""
        self.states.append(self.x.copy())
        for _ in range(self.substeps):
            while self._queue and self._queue[0][0] <= self._now:
                self._acting = self._queue.popleft()[1]
            after = np.array(self._model(self.x, self._acting, force)).ravel()
            after[6:10] /= np.linalg.norm(after[6:10])
            after[10:13] /= np.linalg.norm(after[10:13])
            after[13:16] -= after[10:13] * (after[10:13] @ after[13:16])
            self.x[:] = after
            self._now += 1


def flown(condition: Condition, seed: int, duration: float = DURATION, pushes: tuple = ()) -> NDArray:
    """Return the true states (n, 20) of a flight at the rate of motion capture; its pilot knows the length."""
    length = {"pendulum__length": condition.length, "piloting__initial_length": condition.length}
    params = Params().replace(**length, **condition.changes)
    flown: list[SeatPlant] = []

    def vehicle(params: Params, position: ArrayLike, lean: ArrayLike) -> Plant:
        flown.append(SeatPlant(params, position, lean, seat=condition.seat))
        return flown[0]

    fly(Scenario("seat", "", duration, condition.reference, pushes, params=params, seed=seed), vehicle=vehicle)
    return np.array(flown[0].states)


def observed(
    x: NDArray,
    rng: np.random.Generator,
    length: float = 1.0,
    below: float = 0.08,
    above: float = 0.0,
    noise: tuple[float, float] = (0.2e-3, 1e-3),
    rate: float = 240.0,
) -> tuple[Body, Body]:
    """Return vehicle and rod as motion capture sees the states x (n, 20).

    The vehicle is tracked ``below`` the seat, the rod ``above`` its middle, m; ``noise`` is of positions in m and of
    attitudes in rad; positions have single precision.
    """
    up, q = np.column_stack(z_axis(*x[:, 6:10].T)), x[:, 10:13]

    def body(position: NDArray, direction: NDArray) -> Body:
        position = position + noise[0] * rng.normal(size=position.shape)
        direction = direction + noise[1] * rng.normal(size=direction.shape) * [1, 1, 0]
        direction /= np.linalg.norm(direction, axis=1)[:, None]
        return Body(np.arange(len(x)) / rate, position.astype(np.float32).astype(float), direction)

    return body(x[:, :3] - below * up, up), body(x[:, :3] + (length / 2 + above) * q, q)


def cases() -> list[dict]:
    """Every condition, over ``SEEDS``."""
    return [{"condition": name, "seed": seed} for name in CONDITIONS for seed in SEEDS]


def run(case: dict) -> dict[str, float | int]:
    """Fly the case and estimate the length in its windows."""
    return summarise(answers(case), CONDITIONS[case["condition"]].length)


def answers(case: dict) -> list[Estimate]:
    """Return the answers to the windows of a case that end before the flight does."""
    condition, seed = CONDITIONS[case["condition"]], int(case["seed"])
    x = flown(condition, 60_000 + 100 * list(CONDITIONS).index(case["condition"]) + seed)
    rng = np.random.default_rng([60, list(CONDITIONS).index(case["condition"]), seed])
    marker = condition.above + MIDDLE.tolerance * rng.normal()
    noise = (0.2e-3 * condition.noise, 1e-3 * condition.noise)
    bodies = observed(x, rng, condition.length, condition.seat, marker, noise)
    knowledge = Knowledge(marker_offset=MIDDLE if condition.stated else None)
    found = []
    for start in STARTS:
        window = [body.part((body.time >= start) & (body.time < start + SECONDS)) for body in bodies]
        if len(window[0].time) < round(240 * SECONDS):
            break
        jittered = [
            body._replace(time=body.time + condition.jitter * rng.normal(size=len(body.time))) for body in window
        ]
        kept = rng.random(len(window[1].time)) >= condition.losses
        found.append(estimate(jittered[0], jittered[1].part(kept), knowledge))
    return found


def interval(covered: ArrayLike, answered: ArrayLike, draws: int = 4000) -> tuple[float, float, float]:
    """Return the share of answers whose interval holds the length, and its 95 % interval by a bootstrap over flights.

    Args:
        covered, answered: numbers of windows by flight.
        draws: how many times the flights are drawn anew.
    """
    covered, answered = np.asarray(covered, dtype=float), np.asarray(answered, dtype=float)
    chosen = np.random.default_rng(0).integers(len(covered), size=(draws, len(covered)))
    shares = covered[chosen].sum(axis=1) / np.maximum(answered[chosen].sum(axis=1), 1.0)
    low, high = np.quantile(shares, (0.025, 0.975))
    return float(covered.sum() / max(answered.sum(), 1.0)), float(low), float(high)
