"""A geometric tracking law for the rod, by backstepping, with two disturbance observers.

A point mass on a rod flies like a quadrotor whose thrust is the rod's push: with q the rod's unit direction, r = l/2,
and s the seat, the centre of mass c = s + r q accelerates along q only. It is the flat output of vehicle and rod:

    c'' + g e3 = T q + w_c,   q'' = -|q'|^2 q - P_q (alpha - w_c) / r,   alpha = s'' + g e3 = F e + w_a,
    e' = omega x e,

P_v = I - v v' the projection across a unit vector v, F the specific thrust, w_c and w_a what else acts on rod and
vehicle. Altitude is the pilot's: alpha_z = g. Three steps, each with its error on the sphere of directions:

1. Rod's mass: q_d is the direction of g e3 + c_ref'' - k_p (c - c_ref) - k_v (c' - c_ref') - w_c.
2. Rod's direction: tau = k_q P_q q_d + k_w (P_q q_d' - q') + P_q q_d'', and so alpha = P_q w_c - r tau + (...) q.
3. Thrust's direction: e_d is that of alpha - w_a, and omega = e x (k_e P_e e_d + e_d').

The derivatives of q_d and e_d follow from the equations above, to first order in the lean; then the closed loop's poles
are those of the three steps: (k_p, k_v) and (k_q, k_w), double, and k_e, at 1/``CALMER``, 1 and ``QUICKER`` times
sqrt(g / r), the rate at which the rod falls. A vehicle that is to follow s_ref needs
c_ref = s_ref + r (s_ref'' - w_c) / g. Each observer is w' = L (v' - model - w), L one of ``ESTIMATION_SHARES`` of that
rate.

Source: K. Sreenath, T. Lee, V. Kumar, "Geometric control and differential flatness of a quadrotor UAV with a
cable-suspended load", IEEE CDC, 2013, doi:10.1109/CDC.2013.6760219 (there the load hangs); T. Lee, M. Leok,
N. H. McClamroch, "Geometric tracking control of a quadrotor UAV on SE(3)", IEEE CDC, 2010,
doi:10.1109/CDC.2010.5717652; the observers: W.-H. Chen, J. Yang, L. Guo, S. Li, "Disturbance-observer-based control and
related methods: an overview", IEEE Trans. Industrial Electronics, 2016, doi:10.1109/TIE.2015.2478397.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fiplib.controllers import ESTIMATION_SHARES, answer
from fiplib.mpc import Solution
from fiplib.params import A_DOT, B_DOT, GRAVITY, PHI, THETA, X_DOT, Y_DOT, A, B, Params, X, Y

CALMER, QUICKER = 3.0, 2.0
"""Ratio of the poles of the rod's direction to those of its mass, and of those of the thrust's direction to them.

The cheapest feedback reflects the unstable pole; the MPC's closed loop has poles at 1/2.8 (x) and 1/4.8 (y), 1 and 1.4
times that rate, and ours are near these. Chosen on flights of seed 1: with 1.5 for 2, pushes are not survived with
1.4 m in use for a rod of 1 m."""

_PLACE, _SPEED, _OFFSET, _OFFSET_RATE = [X, Y], [X_DOT, Y_DOT], [A, B], [A_DOT, B_DOT]


def _across(v: NDArray, w: NDArray) -> NDArray:
    """Return P_v w, the part of w across the unit vector v."""
    return w - v * (v @ w)


def _flat(v: NDArray) -> NDArray:
    """Return a horizontal vector (2,) in space."""
    return np.array([v[0], v[1], 0.0])


class DisturbanceObserver:
    """The specific force that a model does not explain, from the velocity; horizontal, (2,) m/s^2."""

    def __init__(self, period: float) -> None:
        self._period, self.force = period, np.zeros(2)
        self._velocity: NDArray | None = None

    def update(self, velocity: NDArray, acceleration: NDArray, bandwidth: float) -> NDArray:
        """Take a velocity and the model's acceleration from now on; returns the estimate."""
        if self._velocity is None:
            self._velocity = velocity
        self.force = bandwidth * (velocity - self._velocity)
        self._velocity = self._velocity + self._period * (acceleration + self.force)
        return self.force


class GeometricControl:
    """The geometric law; only its observers remember anything."""

    def __init__(self, params: Params) -> None:
        self.params = params
        period = 1.0 / params.piloting.control_rate
        self._of_rod, self._of_vehicle = DisturbanceObserver(period), DisturbanceObserver(period)

    def solve(self, state: ArrayLike, reference: ArrayLike, length: float | None = None) -> Solution:
        """As ``mpc.MPC.solve``, one call per control period; of the reference the first two nodes are used."""
        state, reference = np.asarray(state, dtype=float), np.asarray(reference, dtype=float)
        r = (self.params.pendulum.length if length is None else float(length)) / 2.0
        falls = math.sqrt(GRAVITY / r)
        outer, inner = falls / CALMER, QUICKER * falls
        kp, kv, kq, kw = outer**2, 2.0 * outer, falls**2, 2.0 * falls

        q, q_dot, e, body = _directions(state, r)
        slope, thrust = q[:2] / q[2], GRAVITY * e[:2] / e[2]
        velocity = state[_SPEED] + state[_OFFSET_RATE]
        on_rod = self._of_rod.update(velocity, GRAVITY * slope, ESTIMATION_SHARES[1] * falls)
        on_vehicle = self._of_vehicle.update(state[_SPEED], thrust, ESTIMATION_SHARES[0] * falls)

        # the wanted slope of the rod and its first three derivatives
        ahead = (reference[1, _SPEED] - reference[0, _SPEED]) / self.params.control.step
        c = state[_PLACE] + state[_OFFSET] - reference[0, _PLACE] - r / GRAVITY * (ahead - on_rod)
        c1 = velocity - reference[0, _SPEED]
        c2, c3 = GRAVITY * slope + on_rod - ahead, GRAVITY * q_dot[:2]
        q_ddot = (GRAVITY * slope - thrust - on_vehicle + on_rod) / r
        wanted = (ahead - kp * c - kv * c1 - on_rod) / GRAVITY
        wanted1, wanted2 = -(kp * c1 + kv * c2) / GRAVITY, -(kp * c2 + kv * c3) / GRAVITY
        wanted3 = -(kp * c3 / GRAVITY + kv * q_ddot)

        q_d = np.array([*wanted, 1.0]) / math.sqrt(1.0 + wanted @ wanted)
        tau = kq * _across(q, q_d) + kw * (_across(q, _flat(wanted1)) - q_dot) + _across(q, _flat(wanted2))
        alpha = _across(q, _flat(on_rod)) - r * tau
        alpha = alpha + (GRAVITY - alpha[2]) / q[2] * q
        tau_dot = kq * (wanted1 - q_dot[:2]) + kw * (wanted2 - q_ddot) + wanted3
        e_d = alpha - _flat(on_vehicle)
        e_d_dot = _flat(q_dot[:2] - r / GRAVITY * tau_dot)
        turn = np.cross(e, inner * _across(e, e_d / np.linalg.norm(e_d)) + e_d_dot)
        return answer(body @ turn, self.params.vehicle.max_body_rate)


def _directions(state: NDArray, r: float) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Return q, q', e, (3,) each, and the body's x and y axes (2, 3), heading zero."""
    offset, offset_rate = state[_OFFSET], state[_OFFSET_RATE]
    height = math.sqrt(max(r * r - offset @ offset, (0.1 * r) ** 2))  # a rod that lies down is past saving
    q = np.array([*offset, height]) / r
    q_dot = np.array([*offset_rate, -offset @ offset_rate / height]) / r
    (sin_phi, cos_phi), (sin, cos) = ((math.sin(angle), math.cos(angle)) for angle in (state[PHI], state[THETA]))
    body = np.array([[cos, sin_phi * sin, -cos_phi * sin], [0.0, cos_phi, sin_phi]])
    return q, q_dot, np.array([sin, -sin_phi * cos, cos_phi * cos]), body
