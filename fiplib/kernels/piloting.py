"""The pilot around the MPC: the trajectories it follows, and the loops for altitude and yaw."""

import math

import numpy as np
from numpy.typing import NDArray

from fiplib.kernels.compiling import compiled
from fiplib.kernels.poses import single
from fiplib.params import GRAVITY, Params


@compiled("void(f8[::1], f8, f8, f8, f8, f8[:,::1])")
def circle(times: NDArray, radius: float, period: float, start: float, ramp: float, states: NDArray) -> None:
    """Write the states (n, 10) of ``references.Circle`` at times (n,) in s."""
    speed = 2.0 * math.pi / period
    states[:] = 0.0
    for n in range(len(times)):
        since = max(times[n] - start, 0.0)
        u = min(since / ramp, 1.0)
        # the angular speed rises as 3 u^2 - 2 u^3; its integral over the whole ramp is half the ramp
        angle = speed * (ramp * u * u * u * (1.0 - u / 2.0) + max(since - ramp, 0.0))
        rate = speed * u * u * (3.0 - 2.0 * u)
        cos, sin = radius * math.cos(angle), radius * math.sin(angle)
        states[n, 0], states[n, 1], states[n, 2], states[n, 3] = cos, -rate * sin, sin, rate * cos


@compiled()
def _step(u: float) -> tuple:
    """A smooth step from 0 to 1 as u does, and its slope: at rest and without acceleration at both ends."""
    u = min(max(u, 0.0), 1.0)
    return u * u * u * (10.0 - u * (15.0 - 6.0 * u)), 30.0 * u * u * (1.0 - u) * (1.0 - u)


@compiled("void(f8[::1], f8[::1], f8[:,::1], f8[:,::1])")
def multisine(times: NDArray, about: NDArray, amplitudes: NDArray, states: NDArray) -> None:
    """Write the states (n, 10) of ``references.Multisine`` at times (n,) in s.

    ``about``: frequency in Hz, ramp, time of the fade and its length in s; ``amplitudes`` (2, 2 H) in m.
    """
    frequency, ramp, known, fade = about
    states[:] = 0.0
    for n in range(len(times)):
        come, coming = _step(times[n] / ramp)
        gone, going = _step((times[n] - known) / fade)
        envelope = come * (1.0 - gone)
        slope = coming / ramp * (1.0 - gone) - come * going / fade
        for harmonic in range(amplitudes.shape[1] // 2):
            speed = 2.0 * math.pi * frequency * (harmonic + 1)
            cos, sin = math.cos(speed * times[n]), math.sin(speed * times[n])
            for axis in range(2):
                c, s = amplitudes[axis, 2 * harmonic], amplitudes[axis, 2 * harmonic + 1]
                place, rate = c * cos + s * sin, speed * (s * cos - c * sin)
                states[n, 2 * axis] += envelope * place
                states[n, 2 * axis + 1] += envelope * rate + slope * place


def pilot_constants(params: Params, height: float) -> NDArray:
    """Return the parameters that ``answer`` uses, with the height to hold in m: (12,)."""
    piloting, vehicle = params.piloting, params.vehicle
    loops = (*piloting.altitude_gains, piloting.altitude_integral_limit, *piloting.yaw_gains, math.inf)
    mass = vehicle.mass + params.pendulum.mass
    return np.array((height, mass, vehicle.max_thrust, vehicle.max_body_rate, *loops))


@compiled()
def _pid(error: float, error_rate: float, elapsed: float, about: NDArray, first: int, integral: float) -> tuple:
    """Answer and new integral share of a PID loop on a given error and its given derivative."""
    limit = about[first + 3]
    integral = max(-limit, min(limit, integral + about[first + 1] * error * elapsed))
    return about[first] * error + integral + about[first + 2] * error_rate, integral


@compiled("void(f8, f8, f8, f8, f8, f8, f8, f8, f8[::1], f8[::1], f8[::1])")
def answer(
    phi: float,
    theta: float,
    height: float,
    climb_rate: float,
    yaw: float,
    omega_x: float,
    omega_y: float,
    elapsed: float,
    about: NDArray,
    integrals: NDArray,
    command: NDArray,
) -> None:
    """Write the command (4,), body rates in rad/s and normalised thrust, of the MPC's rates and the loops beside it.

    Args:
        phi, theta, yaw: in rad.
        height, climb_rate: in m and m/s.
        omega_x, omega_y: the MPC's input in rad/s.
        elapsed: since the last tick in s.
        about: ``pilot_constants``.
        integrals: of altitude and yaw, (2,); zeros at first.
        command: thrust in single precision, as AttitudeTarget carries it: fly what is recorded.
    """
    climb, integrals[0] = _pid(about[0] - height, -climb_rate, elapsed, about, 4, integrals[0])
    lift = about[1] * (GRAVITY + climb) / (math.cos(phi) * math.cos(theta))
    turn, integrals[1] = _pid(-yaw, 0.0, elapsed, about, 8, integrals[1])
    command[0], command[1] = omega_x, omega_y
    command[2] = max(-about[3], min(about[3], turn))
    command[3] = single(max(0.0, min(1.0, lift / about[2])))
