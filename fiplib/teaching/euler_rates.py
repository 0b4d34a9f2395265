"""Body rates to rates of roll, pitch and yaw: the map of the rotation that the paper states, and the printed map."""

import casadi as ca


def euler_rate_map() -> ca.Function:
    """Body rates to Euler rates for R = Rx Ry Rz, the rotation that the paper states; singular at theta = 90 deg.

    As a CasADi function (angles = (phi, theta, psi), body rates (3,)) -> rates of the angles.
    """
    angles, body_rate = ca.SX.sym("angles", 3), ca.SX.sym("omega", 3)
    _, theta, psi = ca.vertsplit(angles)
    wx, wy, wz = ca.vertsplit(body_rate)
    phi_dot = (wx * ca.cos(psi) - wy * ca.sin(psi)) / ca.cos(theta)
    theta_dot = wx * ca.sin(psi) + wy * ca.cos(psi)
    return ca.Function("euler", [angles, body_rate], [ca.vertcat(phi_dot, theta_dot, wz - phi_dot * ca.sin(theta))])


def printed_euler_rate_map() -> ca.Function:
    """The map that the paper prints (section 2.1); it belongs to R = Rz Ry Rx and agrees to first order only."""
    angles, body_rate = ca.SX.sym("angles", 3), ca.SX.sym("omega", 3)
    phi, theta, _ = ca.vertsplit(angles)
    wx, wy, wz = ca.vertsplit(body_rate)
    turned = wy * ca.sin(phi) + wz * ca.cos(phi)
    rates = ca.vertcat(wx + turned * ca.tan(theta), wy * ca.cos(phi) - wz * ca.sin(phi), turned / ca.cos(theta))
    return ca.Function("printed_euler", [angles, body_rate], [rates])
