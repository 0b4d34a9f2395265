"""The bound from poses alone, beside a Fisher information computed by brute force, and what must hold of any bound."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fiplib.dynamics import PLANT, coupled_plant, rk4
from fiplib.estimators.cramer_rao import CALIBRATION, Motion, cramer_rao, cramer_rao_of_poses
from fiplib.estimators.poses.knowledge import ANY_INERTIA, MIDDLE, Knowledge, Told
from fiplib.params import Params
from fiplib.studies.poses import CONDITIONS, STATED, flown

PARAMS = Params()


@cache
def whole(name: str = "circle 0.4 m / 8 s") -> Motion:
    return flown(CONDITIONS[name], 3, 6.0)


def stretch(seconds: float = 2.5, start: float = 3.0, name: str = "circle 0.4 m / 8 s") -> Motion:
    first = round(240 * start)
    part = slice(first, first + round(240 * seconds))
    return Motion(whole(name).states[part], whole(name).commands[part], whole(name).period)


def seen(unknown: np.ndarray, motion: Motion) -> np.ndarray:
    """Whitened poses of all frames, nonlinear, and whitened priors, as functions of everything that is unknown.

    Unknown are 17 numbers of the first state, a deviation of every command, and 13 parameters.
    """
    frames = len(motion.states)
    start, rest = unknown[:17], unknown[17:]
    deviations, constants = rest[: 4 * (frames - 1)].reshape(-1, 4), rest[4 * (frames - 1) :]
    rod, frame, direction, seat, point = constants[:2], constants[2:4], constants[4:6], constants[6], constants[7]
    factor, lag, com, mass, length = constants[8:]
    x = motion.states[0].copy()
    x[:6] += start[:6]
    x[6:10] = (Rotation.from_quat(x[6:10]) * Rotation.from_rotvec(start[6:9])).as_quat()
    q, rate = x[10:13].copy(), x[13:16].copy()
    across = np.linalg.svd(q[None])[2][1:].T
    x[10:13] = (q + across @ start[9:11]) / np.linalg.norm(q + across @ start[9:11])
    rate = rate + across @ start[11:13]
    x[13:16] = rate - x[10:13] * (x[10:13] @ rate)
    x[16:] += start[13:]
    rods, vehicle = PARAMS.pendulum, PARAMS.vehicle
    share = rods.mass / (rods.mass + vehicle.mass) + mass
    pendulum = replace(
        rods,
        length=rods.length + length,
        gyration_ratio=0.25 / (rods.inertia_factor + factor) - 0.25,
        mass=vehicle.mass * share / (1 - share),
    )
    params = replace(
        PARAMS,
        pendulum=pendulum,
        vehicle=replace(vehicle, seat_height=vehicle.seat_height + com),
        simulation=replace(PARAMS.simulation, rate_lag=PARAMS.simulation.rate_lag + lag),
    )
    step, path = rk4(coupled_plant(params), motion.period), [x]
    for command, deviation in zip(motion.commands[:-1], deviations, strict=True):
        path.append(np.array(step(path[-1], command + deviation, np.zeros(3))).ravel())
    path = np.array(path)
    simulation = PARAMS.simulation
    turned = Rotation.from_quat(path[:, PLANT["attitude"]])
    up, q = turned.apply([0.0, 0.0, 1.0]), path[:, PLANT["direction"]]
    below = PARAMS.seat_above_tracked + seat
    turn = (Rotation.from_quat(motion.states[:, 6:10]).inv() * turned).as_rotvec()
    turn[:, :2] += frame
    parts = [
        (path[:, :3] - below * up) / simulation.position_noise,
        ((path[:, :3] + (pendulum.length / 2 + point) * q)[:, :2] + rod) / simulation.position_noise,
        turn / simulation.attitude_noise,
        (q[:, :2] + direction) / simulation.attitude_noise,
    ]
    sizes = np.sqrt(np.mean((motion.commands - motion.commands.mean(axis=0)) ** 2, axis=0))
    k = STATED
    known = [
        rod / 0.02, frame / 0.1, direction / 0.1, seat / k.seat_height.tolerance, point / MIDDLE.tolerance,
        factor / ANY_INERTIA.tolerance, lag / simulation.rate_lag, (seat - com) / k.com_height.tolerance,
        mass / k.mass_ratio.tolerance, (length / 2 + point + seat) / k.distance_tolerance,
    ]  # fmt: skip
    return np.concatenate([*(part.ravel() for part in parts), (deviations / sizes).ravel(), np.hstack(known)])


def test_the_bound_is_that_of_the_whole_fisher_information():
    motion = stretch(0.1)
    unknowns = 17 + 4 * (len(motion.states) - 1) + 13
    sizes = np.full(unknowns, 1e-4)
    sizes[: 17 + 4 * (len(motion.states) - 1)] = 1e-3
    sensitivities = np.empty((len(seen(np.zeros(unknowns), motion)), unknowns))
    for column, size in enumerate(sizes):
        shift = size * (np.arange(unknowns) == column)
        sensitivities[:, column] = (seen(shift, motion) - seen(-shift, motion)) / (2 * size)
    # QR without normal equations; the last diagonal element is the root of the length's information
    brute = 1 / abs(np.linalg.qr(sensitivities, mode="r")[-1, -1])
    # central differences of 1e-3 rad and m leave 1e-6 relative; the tangents at first order as much
    assert cramer_rao_of_poses(motion, PARAMS, STATED)[-1] == pytest.approx(brute, rel=1e-3)


def test_more_poses_and_more_knowledge_lower_the_bound() -> None:
    limit = cramer_rao_of_poses(stretch(), PARAMS, STATED)
    assert np.isfinite(limit[3:]).all() and (np.diff(limit[3:]) <= 1e-12).all()
    at_end = limit[-1]
    told = replace(STATED, seat_height=Told(0.08, 1e-3), inertia_factor=Told(0.75, 3e-3))
    assert cramer_rao_of_poses(stretch(), PARAMS, told)[-1] < 0.9 * at_end
    assert cramer_rao_of_poses(stretch(), PARAMS, replace(STATED, distance_tolerance=1e3))[-1] > 1.2 * at_end
    # the rod's middle or its inertia, one of them must be known: with neither, the priors alone are left
    assert cramer_rao_of_poses(stretch(), PARAMS, Knowledge())[-1] > 5 * at_end
    louder = PARAMS.replace(simulation__position_noise=0.4e-3, simulation__attitude_noise=2e-3)
    assert 1.2 * at_end < cramer_rao_of_poses(stretch(), louder, STATED)[-1] < 2 * at_end


def test_commands_hardly_matter_and_who_sees_them_does_better() -> None:
    limits = [cramer_rao_of_poses(stretch(), PARAMS, STATED, slack)[-1] for slack in (0.1, 1.0, 100.0)]
    assert limits == sorted(limits)
    # tilt and position show what the vehicle does: commands of any size cost one part in a hundred
    assert limits[2] < 1.01 * limits[0]
    assert limits[0] > cramer_rao(stretch(), PARAMS, (CALIBRATION,))[-1]
