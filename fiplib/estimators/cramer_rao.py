"""The Cramer-Rao bound of the length from a stretch of motion capture: no unbiased estimator does better.

The simulated vehicle has no process noise: what is measured is a deterministic trajectory of the coupled plant, fixed
by the state at its first frame, the length, and the commands, plus the independent noise of motion capture. The Fisher
information is then the sum over frames of h' R^-1 h with the sensitivities h of what is measured. That the commands
come from feedback changes nothing: given what was seen, they depend on no unknown, and drop out of the likelihood.

The information is gathered frame by frame as a triangular square root over (first state, nuisances, length), by QR. The
length stands last: the last diagonal element of the triangle is the root of its Schur complement, the information on
the length when everything else is unknown. One pass thus gives the bound for every window length. The plant is unstable
and its sensitivities grow beyond all digits; every ``REBASE`` frames the unknowns are exchanged for such combinations
of them that the sensitivities are of size 1 again, which changes no Schur complement.

Measured are position and attitude of the vehicle, and the horizontal position of the pendulum's centre of mass. The
height of the seat above the vehicle's tracked point is known exactly. The height of the pendulum's centre of mass is
left out unless asked for: it would give half the length away at once.
"""

import math
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from fiplib.dynamics import PLANT, coupled_plant, projected, rk4
from fiplib.estimators.poses.knowledge import ANY_INERTIA, ANY_OFFSET, Knowledge
from fiplib.estimators.signals import first_order
from fiplib.params import GRAVITY, NANO, PHI, THETA, A, B, Params, X, Y
from fiplib.recording import BagError, Flight

CALIBRATION = "calibration"
NUISANCES = (CALIBRATION, "inertia_factor", "rate_lag")
"""Quantities that may be unknown beside the state and the length: marker offsets (``OFFSETS``), lambda of
the rod, and the first-order lag of the inner loop in s."""

REBASE = 24
"""Frames between two changes of the basis: 0.1 s, in which the rod's fall grows by a factor of about 1.5."""

FREE = 17
"""Degrees of freedom of the plant's 20 states: attitude and direction are unit vectors, direction rate lies across."""

OFFSETS = 4
"""Constants that a calibration leaves unknown: of the pendulum's centre of mass along x and y in m, and of the
vehicle's attitude about its x and y in rad."""


class Motion(NamedTuple):
    """A true trajectory: plant states (n, 20) laid out by ``PLANT``, commands that acted from each frame to the next
    (n, 4) in rad/s and N, and the period of the frames in s."""

    states: NDArray
    commands: NDArray
    period: float


def motion(flight: Flight, start_ns: int | None = None, end_ns: int | None = None) -> Motion:
    """Return the true trajectory of a simulated flight between two times of exposure, heading along x.

    Raises BagError: the flight holds no truth or no commands.
    """
    if flight.truth_state is None or flight.command is None:
        raise BagError(f"{flight.path}: the bound needs the true states and the commands of a simulated flight")
    params, stamps, truth = flight.params, flight.truth_state.stamp, flight.truth_state.values
    period = float(np.median(np.diff(stamps))) / NANO
    acts = flight.command.stamp + round(params.simulation.rate_delay * NANO)
    acting = np.searchsorted(acts, stamps + NANO // 1_000_000, side="right") - 1
    commands = flight.command.values[np.maximum(acting, 0)].copy()
    weight = (params.vehicle.mass + params.pendulum.mass) * GRAVITY
    commands[:, 3] *= params.vehicle.max_thrust
    commands[acting < 0] = 0.0, 0.0, 0.0, weight

    states, r = np.zeros((len(stamps), 20)), params.pendulum.length / 2
    states[:, :3] = truth[:, [X, Y, 10]]
    states[:, 3:6] = np.gradient(states[:, :3], period, axis=0)
    states[:, 3:5] = truth[:, [X + 1, Y + 1]]
    sin, cos = np.sin(truth[:, [PHI, THETA]] / 2).T, np.cos(truth[:, [PHI, THETA]] / 2).T
    states[:, 6:10] = np.array([sin[0] * cos[1], cos[0] * sin[1], sin[0] * sin[1], cos[0] * cos[1]]).T
    states[:, 10:12], states[:, 13:15] = truth[:, [A, B]] / r, truth[:, [A + 1, B + 1]] / r
    states[:, 12] = np.sqrt(1 - np.sum(states[:, 10:12] ** 2, axis=1))
    states[:, 15] = -np.sum(states[:, 10:12] * states[:, 13:15], axis=1) / states[:, 12]
    states[0, 16:] = commands[0]
    for given, lag in ((slice(0, 3), params.simulation.rate_lag), (slice(3, 4), params.simulation.thrust_lag)):
        decay, source = math.exp(-period / max(lag, 1e-6)), commands[:-1, given].T
        states[1:, 16:][:, given] = first_order(source, 1 - decay, decay, start=decay * source[:, 0]).T
    chosen = (stamps >= (start_ns or stamps[0])) & (stamps <= (end_ns or stamps[-1]))
    return Motion(states[chosen], commands[chosen], period)


def cramer_rao(
    motion: Motion, params: Params, nuisances: tuple[str, ...] = (), pendulum_height: bool = False
) -> NDArray:
    """Smallest standard deviation in m that an unbiased estimate of the length can have, after each frame.

    Element k (n,) is the bound for the window of frames 0 to k; infinite as long as they do not fix the length.
    ``params`` are the true ones, the length among them, and the noise of motion capture; ``nuisances``, names out of
    ``NUISANCES``, are unknown too; with ``pendulum_height`` that of the pendulum's centre of mass is
    measured too. Raises ValueError: an unknown nuisance, or no noise (the bound would be zero).
    """
    if unknown := set(nuisances) - set(NUISANCES):
        raise ValueError(f"unknown nuisance {', '.join(sorted(unknown))}; there are {', '.join(NUISANCES)}")
    simulation = params.simulation
    if min(simulation.position_noise, simulation.attitude_noise) <= 0:
        raise ValueError("the bound needs the noise of position and attitude to be positive")
    # unknowns: the first state, offsets of what is measured, what the plant depends on, the length last
    offsets = OFFSETS if CALIBRATION in nuisances else 0
    names = (*(name for name in nuisances if name != CALIBRATION), "length")
    transition, shift = _sensitivities(motion, params, names)
    seen = _measured(motion.states, params, pendulum_height)
    unknowns = FREE + offsets + len(names)
    sensitivity = np.hstack([_tangents(motion.states[0]), np.zeros((20, offsets + len(names)))])
    triangle, bound = np.zeros((0, unknowns)), np.full(len(motion.states), np.inf)
    for k, rows in enumerate(seen):
        frame = rows[:, :20] @ sensitivity
        frame[:, FREE : FREE + offsets] += rows[:, 21 : 21 + offsets]
        frame[:, -1] += rows[:, 20]
        triangle = np.linalg.qr(np.vstack([triangle, frame]), mode="r")
        # what rounding leaves of zero counts as no information
        if len(triangle) == unknowns and abs(triangle[-1, -1]) > 1e-9 * np.linalg.norm(triangle[:, -1]):
            bound[k] = 1 / abs(triangle[-1, -1])
        if k < len(transition):
            sensitivity = transition[k] @ sensitivity
            sensitivity[:, FREE + offsets :] += shift[k]
            if (k + 1) % REBASE == 0:
                sensitivity, triangle = _rebased(sensitivity, triangle)
    return bound


COMMANDS = 4

DYNAMIC = ("inertia_factor", "rate_lag", "com_height", "mass_ratio", "length")
"""Parameters of the plant that an estimate from poses alone does not know."""

CONSTANTS = np.array([0.02, 0.02, 0.1, 0.1, 0.1, 0.1])
"""Standard deviations of the calibration: the rod's tracked point beside its axis, m, the vehicle's body frame and
the rod's, rad, each along x and y."""


def cramer_rao_of_poses(motion: Motion, params: Params, knowledge: Knowledge, slack: float = 1.0) -> NDArray:
    """Smallest standard deviation in m that an estimate of the length from poses alone can have, after each frame.

    The commands are not seen: each may deviate from the true one, independently, with the root mean square of the true
    ones over the motion, times ``slack``. Commands are normal and so are the priors of ``knowledge``, of inertia,
    tracked points, centre of mass and masses, and of the measured distance of both tracked points; calibration, lag
    and the first state are unknown. So this is the bound for who knows how large commands are, but not which.

    With process noise the information is gathered about the newest state instead of the first one, by a square-root
    information filter (Bierman, 1977): a step eliminates the command and the state before it by QR. ``motion`` and
    ``params`` as for ``cramer_rao``.
    """
    n = len(motion.states)
    sizes = slack * np.sqrt(np.mean((motion.commands - motion.commands.mean(axis=0)) ** 2, axis=0))
    transition, shift = _sensitivities(motion, params, DYNAMIC)
    drive = _drive(motion, params) * np.maximum(sizes, 1e-9)
    seen, prior = _poses(motion.states, params), _priors(params, knowledge)
    unknowns = FREE + prior.shape[1]
    triangle = np.hstack([np.zeros((len(prior), FREE)), prior])
    at = FREE + prior.shape[1] - len(DYNAMIC)
    tangents, bound = _tangents(motion.states[0]), np.full(n, np.inf)
    for k in range(n):
        rows = np.hstack([seen[k, :, :20] @ tangents, seen[k, :, 20:]])
        triangle = np.linalg.qr(np.vstack([triangle, rows]), mode="r")
        if len(triangle) == unknowns and abs(triangle[-1, -1]) > 1e-9 * np.linalg.norm(triangle[:, -1]):
            bound[k] = 1 / abs(triangle[-1, -1])
        if k < n - 1:
            after = _tangents(motion.states[k + 1])
            back = np.linalg.inv(np.linalg.pinv(after) @ transition[k] @ tangents)
            known = triangle[:, :FREE] @ back
            stacked = np.zeros((COMMANDS + len(triangle), COMMANDS + unknowns))
            stacked[:COMMANDS, :COMMANDS] = np.eye(COMMANDS)
            stacked[COMMANDS:, :COMMANDS] = -known @ np.linalg.pinv(after) @ drive[k]
            stacked[COMMANDS:, COMMANDS : COMMANDS + FREE] = known
            stacked[COMMANDS:, COMMANDS + FREE :] = triangle[:, FREE:]
            stacked[COMMANDS:, COMMANDS + at :] -= known @ np.linalg.pinv(after) @ shift[k]
            triangle, tangents = np.linalg.qr(stacked, mode="r")[COMMANDS:, COMMANDS:], after
    return bound


def _drive(motion: Motion, params: Params) -> NDArray:
    """Sensitivities of the state a frame later to the commands (n - 1, 20, 4)."""
    states, commands = motion.states[:-1].T, motion.commands[:-1].T
    step, force = _step(params, motion.period)[0].map(states.shape[1]), np.zeros((3, states.shape[1]))
    drive = np.empty((states.shape[1], 20, COMMANDS))
    for column in range(COMMANDS):
        change = 1e-3 * (np.arange(COMMANDS) == column)[:, None]
        more, less = (np.array(step(states, commands + sign * change, force)) for sign in (1, -1))
        drive[..., column] = (more - less).T / 2e-3
    return drive


def _poses(states: NDArray, params: Params) -> NDArray:
    """Whitened rows (n, 10, 33) of what poses show: sensitivities to state, constants, seat, rod point, ``DYNAMIC``."""
    position, attitude = params.simulation.position_noise, params.simulation.attitude_noise
    seat, rho, n = params.seat_above_tracked, params.pendulum.length / 2, len(states)
    rows = np.zeros((n, 10, 20 + len(CONSTANTS) + 2 + len(DYNAMIC)))
    constants, seats, offset, length = 20, 26, 27, -1
    x, y, z, w = states[:, PLANT["attitude"]].T
    zero = np.zeros(n)
    up = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    slopes = np.array([[2 * z, 2 * w, 2 * x, 2 * y], [-2 * w, 2 * z, 2 * y, -2 * x], [-4 * x, -4 * y, zero, zero]])
    for axis in range(3):
        rows[:, axis, axis] = 1 / position
        rows[:, axis, PLANT["attitude"]] = -seat * slopes[axis].T / position
        rows[:, axis, seats] = -up[axis] / position
    for axis in range(2):
        rows[:, 3 + axis, axis], rows[:, 3 + axis, 10 + axis] = 1 / position, rho / position
        rows[:, 3 + axis, constants + axis] = 1 / position
        rows[:, 3 + axis, offset] = states[:, 10 + axis] / position
        rows[:, 3 + axis, length] = states[:, 10 + axis] / 2 / position
        rows[:, 8 + axis, 10 + axis] = rows[:, 8 + axis, constants + 4 + axis] = 1 / attitude
        rows[:, 5 + axis, constants + 2 + axis] = 1 / attitude
    turn = 2 * np.array([[w, z, -y, -x], [-z, w, x, -y], [y, -x, w, -z]]) / attitude
    rows[:, 5:8, PLANT["attitude"]] = turn.transpose(2, 0, 1)
    return rows


def _priors(params: Params, knowledge: Knowledge) -> NDArray:
    """Whitened rows (m, 13) of what is known beforehand, in the columns of ``_poses``."""
    told, wide = knowledge, (ANY_INERTIA, ANY_OFFSET)
    inertia, offset = told.inertia_factor or wide[0], told.marker_offset or wide[1]
    columns = len(CONSTANTS) + 2 + len(DYNAMIC)
    constants, seat, point = np.eye(columns)[: len(CONSTANTS)], *np.eye(columns)[len(CONSTANTS) : len(CONSTANTS) + 2]
    factor, lag, com, mass, length = np.eye(columns)[-len(DYNAMIC) :]
    return np.vstack([
        constants / CONSTANTS[:, None],
        seat / told.seat_height.tolerance,
        point / offset.tolerance,
        factor / inertia.tolerance,
        lag / params.simulation.rate_lag,  # within a factor of e
        (seat - com) / told.com_height.tolerance,
        mass / told.mass_ratio.tolerance,
        (length / 2 + point + seat) / told.distance_tolerance,
    ])  # fmt: skip


def _rebased(sensitivity: NDArray, triangle: NDArray) -> tuple[NDArray, NDArray]:
    """Other unknowns for the first state: what has grown is scaled down, and taken out of the parameters' columns."""
    u, sizes, vt = np.linalg.svd(sensitivity[:, :FREE], full_matrices=False)
    states, parameters = u * np.minimum(sizes, 1.0), sensitivity[:, FREE:]
    known = triangle[:, :FREE] @ (vt.T / np.maximum(sizes, 1.0))
    share = (u.T @ parameters) * (sizes >= 1.0)[:, None]
    return np.hstack([states, parameters - states @ share]), np.hstack([known, triangle[:, FREE:] - known @ share])


def _tangents(state: NDArray) -> NDArray:
    """Return the ways (20, 17) in which a state can differ from this one and still be a state."""
    x, y, z, w = state[PLANT["attitude"]]
    q, q_dot = state[PLANT["direction"]], state[PLANT["direction_rate"]]
    across = np.linalg.svd(q[None])[2][1:].T
    tangents = np.zeros((20, FREE))
    tangents[:6, :6] = np.eye(6)
    tangents[6:10, 6:9] = np.array([[w, -z, y], [z, w, -x], [-y, x, w], [-x, -y, -z]]) / 2
    tangents[10:13, 9:11], tangents[13:16, 9:11] = across, -np.outer(q, q_dot @ across)
    tangents[13:16, 11:13] = across
    tangents[16:, 13:] = np.eye(4)
    return tangents


def _sensitivities(motion: Motion, params: Params, names: tuple[str, ...]) -> tuple[NDArray, NDArray]:
    """Return the derivatives of the next frame's state: by the state (n - 1, 20, 20), by the parameters (n - 1, 20, P).

    CasADi gives the former. A frame is one step of RK4: its error is (period / lag)^5 / 120 = 1e-5 of the body rate.
    The parameters enter through central differences of this one step, which are exact to 1e-8.
    """
    states, commands = motion.states[:-1].T, motion.commands[:-1].T
    force = np.zeros((3, states.shape[1]))

    # matrices lie side by side: (20, 20 n)
    flat = np.array(_step(params, motion.period)[1].map(states.shape[1])(states, commands, force))
    transition = flat.reshape(20, -1, 20).swapaxes(0, 1)
    shift = np.empty((len(transition), 20, len(names)))
    for column, name in enumerate(names):
        steps = (_step(_changed(params, name, change), motion.period)[0] for change in (1e-4, -1e-4))
        more, less = (np.array(step.map(states.shape[1])(states, commands, force)) for step in steps)
        shift[..., column] = (more - less).T / 2e-4
    return transition, shift


@lru_cache(maxsize=32)
def _step(params: Params, period: float) -> tuple[ca.Function, ca.Function]:
    """One frame of the plant (state, command, force) -> state, and its Jacobian to the state."""
    step = rk4(coupled_plant(params), period)
    x, u, f = step.sx_in()
    step = ca.Function("step", [x, u, f], [projected(step(x, u, f))])
    return step, ca.Function("derivative", [x, u, f], [ca.densify(ca.jacobian(step(x, u, f), x))])


def _changed(params: Params, name: str, change: float) -> Params:
    """The parameters with one of them a little larger (past what ``Params.replace`` would let a user ask for)."""
    pendulum, simulation = params.pendulum, params.simulation
    vehicle, rod = params.vehicle, pendulum.mass
    if name == "rate_lag":
        return replace(params, simulation=replace(simulation, rate_lag=simulation.rate_lag + change))
    if name == "com_height":
        return replace(params, vehicle=replace(vehicle, seat_height=vehicle.seat_height + change))
    if name == "mass_ratio":
        ratio = rod / (rod + vehicle.mass) + change
        return replace(params, pendulum=replace(pendulum, mass=vehicle.mass * ratio / (1 - ratio)))
    ratio = 0.25 / (pendulum.inertia_factor + change) - 0.25
    changed = {"length": pendulum.length + change} if name == "length" else {"gyration_ratio": ratio}
    return replace(params, pendulum=replace(pendulum, **changed))


def _measured(states: NDArray, params: Params, pendulum_height: bool) -> NDArray:
    """Whitened rows (n, m, 25) of what is measured in each frame: its sensitivity to state, length and offsets."""
    position, attitude = params.simulation.position_noise, params.simulation.attitude_noise
    axes = 3 if pendulum_height else 2
    rows = np.zeros((len(states), 6 + axes, 21 + OFFSETS))
    rows[:, range(3), range(3)] = 1 / position
    x, y, z, w = states[:, PLANT["attitude"]].T
    # the vehicle's tracked point lies below its seat along the body's z axis: minus that axis' change with the attitude
    none, below = np.zeros(len(x)), 2 * params.seat_above_tracked / position
    axis = np.array([[z, w, x, y], [-w, z, y, -x], [-2 * x, -2 * y, none, none]])
    rows[:, :3, PLANT["attitude"]] = -below * axis.transpose(2, 0, 1)
    for axis in range(axes):
        rows[:, 3 + axis, axis] = 1 / position
        rows[:, 3 + axis, 10 + axis] = params.pendulum.length / 2 / position
        rows[:, 3 + axis, 20] = states[:, 10 + axis] / 2 / position
    # rotation vector of q^-1 dq, twice its vector part
    turn = 2 * np.array([[w, z, -y, -x], [-z, w, x, -y], [y, -x, w, -z]]) / attitude
    rows[:, 3 + axes : 6 + axes, PLANT["attitude"]] = turn.transpose(2, 0, 1)
    rows[:, [3, 4], [21, 22]] = 1 / position
    rows[:, [3 + axes, 4 + axes], [23, 24]] = 1 / attitude
    return rows
