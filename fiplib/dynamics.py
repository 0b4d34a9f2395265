"""Every model of the package, in CasADi: prediction model, exact pendulum, coupled plant; RK4; attitude.

From the plainest to the most complete:

- ``prediction_model``: the paper's 10-state linear model f(x, u, l), the one inside the MPC and the Kalman filter.
- ``exact_pendulum``: the nonlinear pendulum of the paper's Lagrangian, for a prescribed acceleration of its base.
- ``coupled_plant``: vehicle and rod pushing on each other, what the simulator integrates.

Frames: world with z up; body x forward, y left, z up. Quaternions are (x, y, z, w), as in ROS.
"""

import math
from collections.abc import Iterable
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from fiplib.params import AXES, GRAVITY, Params


def axis_matrices(length: ArrayLike, inertia_factor: float = 1.0) -> tuple[NDArray, NDArray]:
    """Continuous-time matrices of one decoupled axis of the prediction model.

    The state is (s, s', d, d', tilt): vehicle position, pendulum offset, tilt, brought to one sign by ``params.AXES``;
    the input is the body rate. s'' = g tilt, d'' = lambda (2 g d / l - g tilt), tilt' = rate.

    For lengths l in m of any shape and lambda, ``inertia_factor`` (1 is the paper's model): ``A`` of shape
    ``shape(length) + (5, 5)`` and ``B`` of shape ``(5, 1)``.
    """
    length = np.asarray(length, dtype=float)
    a = np.zeros((*length.shape, 5, 5))
    a[..., 0, 1] = a[..., 2, 3] = 1.0
    a[..., 1, 4] = GRAVITY
    a[..., 3, 2] = inertia_factor * 2.0 * GRAVITY / length
    a[..., 3, 4] = -inertia_factor * GRAVITY
    b = np.zeros((5, 1))
    b[4, 0] = 1.0
    return a, b


def prediction_model(inertia_factor: float = 1.0) -> ca.Function:
    """Return the paper's prediction model x' = f(x, u, l), linear in x and u (section 2.2), as a CasADi function.

    x and x' are (10,) in the order of ``STATES``, u (2,) in rad/s, l in m. ``inertia_factor`` is lambda: 1 in the
    paper's model, 3/4 for a uniform rod.
    """
    x, u, length = ca.SX.sym("x", 10), ca.SX.sym("u", 2), ca.SX.sym("l")
    x_dot = ca.SX(10, 1)
    for axis in AXES:
        position, velocity, offset, offset_rate, tilt = axis.states
        acceleration = axis.sign * GRAVITY * x[tilt]
        x_dot[position] = x[velocity]
        x_dot[velocity] = acceleration
        x_dot[offset] = x[offset_rate]
        x_dot[offset_rate] = inertia_factor * (2 * GRAVITY / length * x[offset] - acceleration)
        x_dot[tilt] = u[axis.input]
    return ca.Function("f", [x, u, length], [x_dot], ["x", "u", "l"], ["x_dot"])


def rk4(f: ca.Function, step: float) -> ca.Function:
    """One step, in s, of the classical fourth-order Runge-Kutta method: a CasADi function (x, ...) -> x after the step.

    ``f`` is the right-hand side (x, ...) -> x'; all arguments but the first are held over the step.
    """
    x, *held = f.sx_in()
    k1 = f(x, *held)
    k2 = f(x + step / 2 * k1, *held)
    k3 = f(x + step / 2 * k2, *held)
    k4 = f(x + step * k3, *held)
    return ca.Function("f_rk4", [x, *held], [x + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)], f.name_in(), ["x_next"])


def jacobians(f: ca.Function) -> ca.Function:
    """Jacobians of f(x, u, ...) with respect to x and u, as a CasADi function of the same arguments."""
    arguments = f.sx_in()
    matrices = [ca.jacobian(f(*arguments), argument) for argument in arguments[:2]]
    return ca.Function("jacobians", arguments, matrices, f.name_in(), ["df_dx", "df_du"])


def exact_pendulum(gyration_ratio: float = 0.0) -> ca.Function:
    """Return the nonlinear pendulum from its Lagrangian L = K - P in (a, b), for a prescribed acceleration of its base.

    Lagrange's equations are formed by differentiating L, not by hand; the paper leaves this step to the reader. Per
    unit of pendulum mass, K = |v + d/dt (a, b, zeta)|^2 / 2 (+ k^2 |q'|^2 / 2, which the paper leaves out:
    ``gyration_ratio`` k^2 / l^2 is 0 for its point mass at the middle, 1/12 for a uniform rod). As a CasADi function
    (s = (a, b, a', b'), base acceleration (3,) m/s^2, l m) -> (a'', b'') m/s^2.
    """
    offset, offset_rate = ca.SX.sym("ab", 2), ca.SX.sym("ab_dot", 2)
    base_velocity, base_acceleration = ca.SX.sym("v", 3), ca.SX.sym("p_ddot", 3)
    length = ca.SX.sym("l")
    height = ca.sqrt((length / 2) ** 2 - ca.sumsqr(offset))
    com = ca.vertcat(offset, height)
    com_velocity = ca.jacobian(com, offset) @ offset_rate
    spin_energy = gyration_ratio * length**2 * ca.sumsqr(com_velocity / (length / 2)) / 2
    kinetic = ca.sumsqr(base_velocity + com_velocity) / 2 + spin_energy
    potential = GRAVITY * height
    momentum = ca.gradient(kinetic, offset_rate)
    # d/dt dL/dq' - dL/dq = 0, solved for q''
    force = (
        ca.gradient(kinetic - potential, offset)
        - ca.jacobian(momentum, offset) @ offset_rate
        - ca.jacobian(momentum, base_velocity) @ base_acceleration
    )
    acceleration = ca.solve(ca.jacobian(momentum, offset_rate), force)
    acceleration = ca.substitute(acceleration, base_velocity, ca.SX.zeros(3))  # Galilean: no dependence is left
    state = ca.vertcat(offset, offset_rate)
    return ca.Function(
        "pendulum", [state, base_acceleration, length], [acceleration], ["s", "p_ddot", "l"], ["ab_ddot"]
    )


PLANT = {
    "position": slice(0, 3),
    "velocity": slice(3, 6),
    "attitude": slice(6, 10),
    "direction": slice(10, 13),
    "direction_rate": slice(13, 16),
    "body_rate": slice(16, 19),
    "thrust": slice(19, 20),
}
"""Layout of the plant's 20 states: m, m/s, quaternion, unit vector from seat to COM, 1/s, rad/s, N."""


def coupled_plant(params: Params) -> ca.Function:
    """Vehicle and rod with the rod's reaction and inertia; the inner loop as a first-order lag.

    The position s is that of the rod's seat, which lies h (``vehicle.seat_height``) above the vehicle's centre of mass
    along the body's z axis e = R e3. With q the rod's direction, r = l/2, P = I - q q', lambda = r^2/(r^2 + k^2),
    alpha = s'' + g e3 and a force f that acts on the rod's COM:

        (m + m_p) alpha + m_p r q'' = F e + f + m h e'',      q'' = -|q'|^2 q - (lambda/r) P (alpha - f/m_p).

    With h = 0 it is the paper's model. The attitude is a quaternion, so the kinematic map is right at every angle. As
    a CasADi function (x (20,) laid out by ``PLANT``, command (4,): body rates rad/s and thrust N, f (3,) N) -> x'.
    """
    x, command, force = ca.SX.sym("x", 20), ca.SX.sym("command", 4), ca.SX.sym("force", 3)
    velocity, attitude, q, q_dot, body_rate, thrust = (x[PLANT[name]] for name in list(PLANT)[1:])
    m, m_p, r = params.vehicle.mass, params.pendulum.mass, params.pendulum.length / 2
    factor, seat = params.pendulum.inertia_factor, params.vehicle.seat_height
    rate_dot = (command[:3] - body_rate) / params.simulation.rate_lag

    def across(v: ca.SX) -> ca.SX:
        return v - q * ca.dot(q, v)

    # Eliminating q'' leaves [(m + m_p) I - m_p lambda P] alpha = total: stiffer across the rod than along it
    total = thrust * body_z(attitude) + force + m_p * r * ca.sumsqr(q_dot) * q - factor * across(force)
    if seat > 0:
        total += m * seat * body_z_acceleration(attitude, body_rate, rate_dot)
    alpha = (total + m_p * factor / (m + m_p * (1 - factor)) * across(total)) / (m + m_p)
    q_ddot = -ca.sumsqr(q_dot) * q - factor / r * across(alpha - force / m_p)
    # the product of quaternions attitude * (omega, 0) / 2, omega in the body frame
    vector, w = attitude[:3], attitude[3]
    attitude_rate = ca.vertcat(w * body_rate + ca.cross(vector, body_rate), -ca.dot(vector, body_rate)) / 2
    x_dot = ca.vertcat(
        velocity,
        alpha - ca.vertcat(0, 0, GRAVITY),
        attitude_rate,
        q_dot,
        q_ddot,
        rate_dot,
        (command[3] - thrust) / params.simulation.thrust_lag,
    )
    return ca.Function("plant", [x, command, force], [x_dot], ["x", "command", "force"], ["x_dot"])


def projected(x: ca.SX) -> ca.SX:
    """Return the plant's state with quaternion and direction of unit length, and the direction's rate across it.

    What the plant does after every step; without it errors of the length of the direction grow faster than the rod
    falls. ``x`` may be longer than the 20 states.
    """
    attitude, q, q_dot = (x[PLANT[name]] for name in ("attitude", "direction", "direction_rate"))
    q = q / ca.norm_2(q)
    return ca.vertcat(x[:6], attitude / ca.norm_2(attitude), q, q_dot - q * ca.dot(q, q_dot), x[16:])


def z_axis(x: Any, y: Any, z: Any, w: Any) -> tuple[Any, Any, Any]:
    """Third column of the rotation matrix of the unit quaternion (x, y, z, w), of numbers, arrays or symbols."""
    return 2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)


def body_z(q: ca.SX) -> ca.SX:
    """Return the body's z axis in the world, R e3: the thrust direction, of the quaternion q = (x, y, z, w)."""
    return ca.vertcat(*z_axis(*ca.vertsplit(q)))


def body_z_acceleration(q: ca.SX, body_rate: ca.SX, rate_dot: ca.SX) -> ca.SX:
    """Return e'' = R (w x (w x e3) + w' x e3), 1/s^2: of a quaternion, w in rad/s, w' in rad/s^2, in the body."""
    x, y, z = ca.vertsplit(body_rate)
    in_body = ca.vertcat(x * z + rate_dot[1], y * z - rate_dot[0], -(x * x + y * y))
    twice = 2 * ca.cross(q[:3], in_body)
    return in_body + q[3] * twice + ca.cross(q[:3], twice)


def body_z_of(q: Iterable[float]) -> NDArray:
    """Return the body's z axis in the world, (3,), of a unit quaternion (4,) as x, y, z, w: ``body_z`` in numbers."""
    return np.array(z_axis(*(float(value) for value in q)))


def seat_position(position: NDArray, orientation: NDArray, height: float) -> NDArray:
    """Return where the rod's seat is, (..., 3) in m, ``height`` m above a vehicle's tracked point along its body z.

    ``position`` (..., 3) in m and ``orientation`` (..., 4), a quaternion (x, y, z, w), are the vehicle's.
    """
    if height == 0.0:
        return position
    axis = np.stack(z_axis(*np.moveaxis(orientation, -1, 0)), axis=-1)
    return position + height * axis


def inclination(direction: Iterable[float]) -> float:
    """Return the angle of a direction (3,) from the vertical, rad."""
    x, y, z = (float(value) for value in direction)
    return math.atan2(math.hypot(x, y), z)


def euler_angles(q: Iterable[float]) -> tuple[float, float, float]:
    """Roll, pitch, yaw in rad of R = Rx(phi) Ry(theta) Rz(psi), as in the paper, of a quaternion (x, y, z, w)."""
    x, y, z, w = (float(value) for value in q)
    phi = math.atan2(2 * (w * x - y * z), 1 - 2 * (x * x + y * y))
    theta = math.asin(max(-1.0, min(1.0, 2 * (x * z + w * y))))
    psi = math.atan2(2 * (w * z - x * y), 1 - 2 * (y * y + z * z))
    return phi, theta, psi
