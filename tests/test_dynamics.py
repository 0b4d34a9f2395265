"""The models against each other, against conservation laws, and at large angles."""

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fiplib import dynamics
from fiplib.params import AXES, GRAVITY, PHI, THETA, X_DOT, Y_DOT, A, B, Params

PARAMS = Params()
ROUNDING = 1e-12  # a few dozen operations on numbers of order 1 to 100 in double precision


def full(value) -> np.ndarray:
    return np.asarray(value, dtype=float).squeeze()


def random_plant_state(rng: np.random.Generator) -> np.ndarray:
    """Any attitude, any rod direction, speeds of a violent flight."""
    x = np.zeros(20)
    x[:6] = rng.normal(size=6)
    x[6:10] = Rotation.random(rng=rng).as_quat()
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    spin = 3 * rng.normal(size=3)
    x[10:13], x[13:16] = direction, spin - direction * (direction @ spin)
    x[16:19], x[19] = 2 * rng.normal(size=3), 6 + rng.normal()
    return x


def lagrangian_plant(params: Params) -> ca.Function:
    """Vehicle and rod from Lagrange's equations, (x (20,), command (4,), f (3,)) -> (s'', q'').

    Independent of ``dynamics.coupled_plant``: coordinates are the *vehicle's* centre of mass p and two angles of the
    rod; the seat lies at p + h e with the attitude, and so e, a prescribed motion; e'' is differentiated from the
    quaternion, not written down.
    """
    x, command, force = ca.SX.sym("x", 20), ca.SX.sym("command", 4), ca.SX.sym("force", 3)
    m, rod, h = params.vehicle.mass, params.pendulum, params.vehicle.seat_height
    r, spin = rod.length / 2, rod.mass * rod.gyration_ratio * rod.length**2

    def turning(attitude, rate):
        i, j, k, w = ca.vertsplit(attitude)
        product = ca.vertcat(ca.horzcat(w, -k, j), ca.horzcat(k, w, -i), ca.horzcat(-j, i, w), ca.horzcat(-i, -j, -k))
        return product @ rate / 2

    attitude, rate = x[6:10], x[16:19]
    moving = ca.vertcat(attitude, rate)
    moving_dot = ca.vertcat(turning(attitude, rate), (command[:3] - rate) / params.simulation.rate_lag)
    e = dynamics.body_z(attitude)
    e_dot = ca.jtimes(e, moving, moving_dot)
    e_ddot = ca.jtimes(e_dot, moving, moving_dot)

    # the rod's angles: q = (sin u, -cos u sin v, cos u cos v)
    c, c_dot, c_ddot = (ca.SX.sym(name, 5) for name in ("c", "c_dot", "c_ddot"))  # p, u, v
    axis, axis_dot, axis_ddot = (ca.SX.sym(name, 3) for name in ("e", "e_dot", "e_ddot"))

    def direction(angles):
        u, v = ca.vertsplit(angles)
        return ca.vertcat(ca.sin(u), -ca.cos(u) * ca.sin(v), ca.cos(u) * ca.cos(v))

    q = direction(c[3:])
    q_dot = ca.jtimes(q, c[3:], c_dot[3:])
    com, com_dot = c[:3] + h * axis + r * q, c_dot[:3] + h * axis_dot + r * q_dot
    kinetic = (m * ca.sumsqr(c_dot[:3]) + rod.mass * ca.sumsqr(com_dot) + spin * ca.sumsqr(q_dot)) / 2
    potential = GRAVITY * (m * c[2] + rod.mass * com[2])
    momentum = ca.gradient(kinetic, c_dot)
    changing = [(c, c_dot), (c_dot, c_ddot), (axis, axis_dot), (axis_dot, axis_ddot)]
    momentum_rate = sum(ca.jtimes(momentum, of, by) for of, by in changing)
    applied = ca.vertcat(x[19] * e, 0, 0) + ca.jacobian(com, c).T @ force
    unbalanced = momentum_rate - ca.gradient(kinetic - potential, c) - applied
    solved = ca.solve(ca.jacobian(unbalanced, c_ddot), -ca.substitute(unbalanced, c_ddot, ca.SX.zeros(5)))

    # the angles and their rates of q and q'
    d, d_dot = x[10:13], x[13:16]
    u, u_dot = ca.asin(d[0]), d_dot[0] / ca.sqrt(1 - d[0] ** 2)
    v, v_dot = ca.atan2(-d[1], d[2]), (d[1] * d_dot[2] - d[2] * d_dot[1]) / (d[1] ** 2 + d[2] ** 2)
    values = [ca.vertcat(x[:3], u, v), ca.vertcat(x[3:6] - h * e_dot, u_dot, v_dot), e, e_dot, e_ddot]
    known = [c, c_dot, axis, axis_dot, axis_ddot]
    q_ddot = ca.jtimes(q_dot, c[3:], c_dot[3:]) + ca.jtimes(q_dot, c_dot[3:], c_ddot[3:])
    accelerations = ca.substitute(ca.vertcat(c_ddot[:3] + h * axis_ddot, q_ddot), c_ddot, solved)
    for symbol, value in zip(known, values, strict=True):
        accelerations = ca.substitute(accelerations, symbol, value)
    return ca.Function("lagrange", [x, command, force], [accelerations])


def energy(x: np.ndarray, params: Params) -> float:
    rod, r = params.pendulum, params.pendulum.length / 2
    position, velocity, q, q_dot = x[0:3], x[3:6], x[10:13], x[13:16]
    kinetic = params.vehicle.mass * velocity @ velocity + rod.mass * np.sum((velocity + r * q_dot) ** 2)
    spin = rod.mass * rod.gyration_ratio * rod.length**2 * q_dot @ q_dot
    height = params.vehicle.mass * position[2] + rod.mass * (position[2] + r * q[2])
    return (kinetic + spin) / 2 + GRAVITY * height


@pytest.mark.parametrize("length", [0.2, 1.0, 2.0])
@pytest.mark.parametrize("gyration_ratio", [0.0, 1 / 12])
def test_the_exact_pendulum_linearised_at_hover_is_the_prediction_model(length, gyration_ratio):
    pendulum = dynamics.exact_pendulum(gyration_ratio)
    s, acceleration = ca.SX.sym("s", 4), ca.SX.sym("acceleration", 3)
    value = pendulum(s, acceleration, length)
    at_hover = ca.Function("j", [s, acceleration], [ca.jacobian(value, s), ca.jacobian(value, acceleration)])
    by_state, by_acceleration = (full(j) for j in at_hover(np.zeros(4), np.zeros(3)))

    factor = Params().replace(pendulum__gyration_ratio=gyration_ratio).pendulum.inertia_factor
    f = dynamics.prediction_model(factor)
    df_dx = full(dynamics.jacobians(f)(np.zeros(10), np.zeros(2), length)[0])
    rows = [5, 7]  # a'', b''
    np.testing.assert_allclose(df_dx[np.ix_(rows, [4, 6, 5, 7])], by_state, rtol=ROUNDING, atol=ROUNDING)
    # the vehicle accelerates by its tilt: x'' = g theta, y'' = -g phi
    by_tilt = by_acceleration[:, :2] @ np.array([[0.0, GRAVITY], [-GRAVITY, 0.0]])
    np.testing.assert_allclose(df_dx[np.ix_(rows, [PHI, THETA])], by_tilt, rtol=ROUNDING, atol=ROUNDING)


def test_the_prediction_model_has_the_printed_equations():
    x, u, length = np.arange(1.0, 11.0), np.array([0.3, -0.7]), 0.8
    x_dot = full(dynamics.prediction_model()(x, u, length))
    a, b, phi, theta = x[[A, B, PHI, THETA]]
    expected = np.array([
        x[X_DOT], GRAVITY * theta, x[Y_DOT], -GRAVITY * phi,
        x[5], 2 * a * GRAVITY / length - GRAVITY * theta, x[7], 2 * b * GRAVITY / length + GRAVITY * phi,
        u[0], u[1],
    ])  # fmt: skip
    np.testing.assert_allclose(x_dot, expected, rtol=ROUNDING)


@pytest.mark.parametrize("axis", AXES)
def test_both_axes_are_the_same_five_state_system_after_the_change_of_sign(axis):
    df_dx, df_du = (
        full(j) for j in dynamics.jacobians(dynamics.prediction_model(0.75))(np.zeros(10), np.zeros(2), 1.3)
    )
    sign = np.array([1, 1, 1, 1, axis.sign])
    states = list(axis.states)
    a, b = dynamics.axis_matrices(1.3, 0.75)
    np.testing.assert_allclose(sign[:, None] * df_dx[np.ix_(states, states)] * sign, a, rtol=ROUNDING)
    np.testing.assert_allclose(sign * df_du[states, axis.input] * axis.sign, b[:, 0], rtol=ROUNDING)
    others = [i for i in range(10) if i not in states]
    assert not df_dx[np.ix_(states, others)].any(), "the axes are decoupled"


def test_axis_matrices_of_many_lengths_are_those_of_each_length():
    lengths = np.array([[0.2, 0.5], [1.0, 2.0]])
    many, _ = dynamics.axis_matrices(lengths)
    for index in np.ndindex(lengths.shape):
        np.testing.assert_array_equal(many[index], dynamics.axis_matrices(lengths[index])[0])


@pytest.mark.parametrize("gyration_ratio", [0.0, 1 / 12])
def test_the_coupled_plant_tends_to_the_exact_pendulum_for_a_light_rod(gyration_ratio):
    errors = []
    for mass in (1e-2, 1e-4, 1e-6):
        rng = np.random.default_rng(1)  # the same states for every mass
        params = PARAMS.replace(pendulum__mass=mass, pendulum__gyration_ratio=gyration_ratio, pendulum__length=0.9)
        plant, pendulum = dynamics.coupled_plant(params), dynamics.exact_pendulum(gyration_ratio)
        worst = np.zeros(2)
        for _ in range(50):
            x = random_plant_state(rng)
            x[12] = abs(x[12]) + 0.3  # (a, b) describe the upper half only
            x[10:13] /= np.linalg.norm(x[10:13])
            x[13:16] -= x[10:13] * (x[10:13] @ x[13:16])
            x_dot = full(plant(x, np.zeros(4), np.zeros(3)))
            r = 0.45
            attitude, rate = ca.DM(x[6:10]), ca.DM(x[16:19])
            alone = full(dynamics.body_z(attitude)) * x[19] / params.vehicle.mass - [0, 0, GRAVITY]
            turning = dynamics.body_z_acceleration(attitude, rate, -rate / params.simulation.rate_lag)
            alone += params.vehicle.seat_height * full(turning)  # of the seat, if there were no rod on it
            expected = full(pendulum(np.r_[r * x[10:12], r * x[13:15]], alone, 0.9))
            worst = np.maximum(worst, np.abs([x_dot[3:6] - alone, np.r_[r * x_dot[13:15] - expected, 0]]).max(1))
        errors.append(worst)
    vehicle, rod = np.array(errors).T
    # the reaction is proportional to the mass: two decades of mass, two decades of difference, less (m_p/m)^2 of it
    np.testing.assert_allclose(vehicle[:-1] / vehicle[1:], 100, rtol=0.05)
    if gyration_ratio == 0:
        # a point mass pulls along the rod only, which does not turn the rod: no difference at any mass
        np.testing.assert_allclose(rod, 0, atol=1e-11)
    else:
        np.testing.assert_allclose(rod[:-1] / rod[1:], 100, rtol=0.05)


@pytest.mark.parametrize("seat", [0.0, 0.08, 0.3])
def test_the_plant_with_its_seat_obeys_lagranges_equations_of_vehicle_and_rod(seat):
    params = PARAMS.replace(vehicle__seat_height=seat, pendulum__length=0.7, pendulum__mass=0.2)
    plant, lagrange, rng = dynamics.coupled_plant(params), lagrangian_plant(params), np.random.default_rng(6)
    for _ in range(200):
        x, command, force = random_plant_state(rng), 3 * rng.normal(size=4), 0.3 * rng.normal(size=3)
        if np.hypot(*x[11:13]) < 0.1:
            continue  # there the two angles are singular, not the plant
        x_dot, expected = full(plant(x, command, force)), full(lagrange(x, command, force))
        # rate commands that act with a lag of 15 ms make accelerations of up to 1e3 m/s^2: rounding of those
        np.testing.assert_allclose(np.r_[x_dot[3:6], x_dot[13:16]], expected, rtol=1e-10, atol=1e-9)


def test_the_bodys_z_axis_accelerates_as_its_rotation_says():
    rng, step = np.random.default_rng(7), 1e-4
    start, rate, rate_dot = Rotation.random(rng=rng), rng.normal(size=3), 5 * rng.normal(size=3)

    def axis(t: float) -> np.ndarray:
        # exact to t^3 (Magnus): the rotation vector of body rates that grow linearly
        vector = rate * t + rate_dot * t**2 / 2 + np.cross(rate, rate_dot) * t**3 / 12
        return (start * Rotation.from_rotvec(vector)).as_matrix()[:, 2]

    measured = (axis(step) - 2 * axis(0.0) + axis(-step)) / step**2
    found = full(dynamics.body_z_acceleration(ca.DM(start.as_quat()), ca.DM(rate), ca.DM(rate_dot)))
    np.testing.assert_allclose(found, measured, atol=1e-6)  # 1e-16 / step^2 of rounding; step^2 of the difference


def test_the_plant_obeys_newton_and_the_balance_of_power_at_any_attitude_and_push():
    rng = np.random.default_rng(2)
    plant = dynamics.coupled_plant(PARAMS.replace(vehicle__seat_height=0.0))
    m, rod, r = PARAMS.vehicle.mass, PARAMS.pendulum, PARAMS.pendulum.length / 2
    for _ in range(200):
        x, force = random_plant_state(rng), 0.3 * rng.normal(size=3)
        x_dot = full(plant(x, np.zeros(4), force))
        thrust = Rotation.from_quat(x[6:10]).as_matrix()[:, 2] * x[19]
        weight = (m + rod.mass) * np.array([0, 0, GRAVITY])
        momentum_rate = (m + rod.mass) * x_dot[3:6] + rod.mass * r * x_dot[13:16]
        np.testing.assert_allclose(momentum_rate, thrust + force - weight, atol=1e-11)
        step = 1e-6
        power = (energy(x + step * x_dot, PARAMS) - energy(x - step * x_dot, PARAMS)) / (2 * step)
        expected = thrust @ x[3:6] + force @ (x[3:6] + r * x[13:16])
        assert power == pytest.approx(expected, abs=1e-6)  # rounding of an energy of about 10 J over 2 us


def test_energy_and_length_are_conserved_in_free_motion_to_the_order_of_the_integrator():
    params = PARAMS.replace(vehicle__seat_height=0.0)  # else what turns the vehicle does work on the rod
    drifts, stretches = [], []
    for step in (1 / 120, 1 / 240, 1 / 480):
        forward = dynamics.rk4(dynamics.coupled_plant(params), step)
        x = random_plant_state(np.random.default_rng(3))
        x[19] = 0.0  # no thrust
        start = energy(x, params)
        for _ in range(round(2.0 / step)):
            x = full(forward(x, np.zeros(4), np.zeros(3)))
        drifts.append(abs(energy(x, params) - start))
        stretches.append(abs(np.linalg.norm(x[10:13]) - 1))
    for errors in (drifts, stretches):
        orders = np.log2(np.array(errors[:-1]) / errors[1:])
        assert (orders > 3.5).all(), f"RK4 loses a factor 2^4 or more by halving the step, got 2^{orders}"


@pytest.mark.parametrize("seed", range(3))
def test_euler_angles_belong_to_rx_ry_rz(seed):
    rotation = Rotation.random(rng=np.random.default_rng(seed))
    expected = rotation.as_euler("XYZ")  # capital letters: intrinsic, R = Rx Ry Rz
    np.testing.assert_allclose(dynamics.euler_angles(rotation.as_quat()), expected, atol=ROUNDING)


def test_the_bodys_z_axis_in_numbers_is_the_third_column_of_its_rotation_and_leans_by_its_inclination():
    for seed in range(20):
        rotation = Rotation.random(rng=np.random.default_rng(seed))
        axis = dynamics.body_z_of(rotation.as_quat())
        np.testing.assert_allclose(axis, rotation.as_matrix()[:, 2], atol=1e-15)
        np.testing.assert_array_equal(axis, full(dynamics.body_z(ca.DM(rotation.as_quat()))))
        assert np.isclose(np.cos(dynamics.inclination(axis)), axis[2], atol=1e-15)
