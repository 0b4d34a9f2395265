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
            thrust_only = full(dynamics.body_z(ca.DM(x[6:10]))) * x[19] / params.vehicle.mass - [0, 0, GRAVITY]
            expected = full(pendulum(np.r_[r * x[10:12], r * x[13:15]], thrust_only, 0.9))
            worst = np.maximum(worst, np.abs([x_dot[3:6] - thrust_only, np.r_[r * x_dot[13:15] - expected, 0]]).max(1))
        errors.append(worst)
    vehicle, rod = np.array(errors).T
    # the reaction is proportional to the mass: two decades of mass, two decades of difference, less (m_p/m)^2 of it
    np.testing.assert_allclose(vehicle[:-1] / vehicle[1:], 100, rtol=0.05)
    if gyration_ratio == 0:
        # a point mass pulls along the rod only, which does not turn the rod: no difference at any mass
        np.testing.assert_allclose(rod, 0, atol=1e-11)
    else:
        np.testing.assert_allclose(rod[:-1] / rod[1:], 100, rtol=0.05)


def test_the_plant_obeys_newton_and_the_balance_of_power_at_any_attitude_and_push():
    rng = np.random.default_rng(2)
    plant = dynamics.coupled_plant(PARAMS)
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
    params = PARAMS
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


def test_the_consistent_euler_rate_map_belongs_to_the_stated_rotation_and_the_printed_one_does_not():
    rng = np.random.default_rng(4)
    angles, body_rate, step = np.array([0.4, -0.5, 0.3]), rng.normal(size=3), 1e-6

    def moved(sign: float) -> np.ndarray:
        turned = Rotation.from_euler("XYZ", angles) * Rotation.from_rotvec(sign * step * body_rate)
        return turned.as_euler("XYZ")

    measured = (moved(1) - moved(-1)) / (2 * step)
    assert full(dynamics.euler_rate_map()(angles, body_rate)) == pytest.approx(measured, abs=1e-9)
    assert np.abs(full(dynamics.printed_euler_rate_map()(angles, body_rate)) - measured).max() > 0.1
    small = 1e-4 * angles  # both agree to first order: the difference falls with the angle
    difference = full(dynamics.printed_euler_rate_map()(small, body_rate) - dynamics.euler_rate_map()(small, body_rate))
    assert np.abs(difference).max() < 10 * np.abs(small).max()


def test_the_bodys_z_axis_in_numbers_is_the_third_column_of_its_rotation_and_leans_by_its_inclination():
    for seed in range(20):
        rotation = Rotation.random(rng=np.random.default_rng(seed))
        axis = dynamics.body_z_of(rotation.as_quat())
        np.testing.assert_allclose(axis, rotation.as_matrix()[:, 2], atol=1e-15)
        np.testing.assert_array_equal(axis, full(dynamics.body_z(ca.DM(rotation.as_quat()))))
        assert np.isclose(np.cos(dynamics.inclination(axis)), axis[2], atol=1e-15)
