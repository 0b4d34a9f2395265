"""A vehicle with motors for Betaflight's own inner loop to fly, and the packets that its SITL build exchanges.

``simulate.Plant`` stands for an inner loop by a delay and a lag. ``MotorPlant`` is the same vehicle and rod with four
motors instead: body rates follow from the motors' thrusts, and these from whatever firmware is given to it, which sees
a gyroscope, an accelerometer and radio channels as on a vehicle. Pure: no sockets and no clock, see
``sitl.Betaflight``. A model, and simulated like everything here: vibration, battery, blade stall, ground effect,
gyroscope noise and the radio's own delay are not in it.

Axes are ours, x forward, y left, z up; Betaflight's packets take x forward, y right, z down.
"""

import math
import struct
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares
from scipy.signal import lfilter

from fiplib.dynamics import PLANT, body_z, body_z_acceleration, coupled_plant, projected, rk4
from fiplib.flight.crsf_frames import US_OFFSET, US_PER_COUNT, betaflight_settings
from fiplib.flight.limits import Limits
from fiplib.flight.setpoint import weight
from fiplib.params import GRAVITY, Params, quantity
from fiplib.simulate import Plant

TURNS = (1.0, -1.0, -1.0, 1.0)
"""Sign of each motor's reaction on the vehicle about z, in Betaflight's order: rear right, front right, rear left,
front left. Seen from above the first and the last turn clockwise, which turns the vehicle left."""
SPEEDS = slice(19, 23)
"""Speeds of the motors in [0, 1], after the first 19 states of ``dynamics.PLANT``."""

STATE = struct.Struct("<18d")
"""Time stamp, body rates rad/s, minus the specific force m/s^2, attitude (w, x, y, z), velocity, position, pressure."""
RC = struct.Struct("<d16H")
"""Time stamp and 16 channels in us."""
PWM = struct.Struct("<4f")
"""The motors' commands in [0, 1], in the order 2, 3, 4, 1."""
PRESSURE = 101325.0
RELEASE = 0.95
"""Share of the weight at which the vehicle is let go."""


@dataclass(frozen=True)
class Airframe:
    """Parameters of a vehicle with motors beyond ``params.Vehicle``. None was measured on a vehicle."""

    inertia: tuple[float, float, float] = quantity(
        (7e-4, 1.1e-3, 1.5e-3), "kg m^2", "our estimate: 35 g at each motor, the rest a box of 12 x 5 x 6 cm"
    )
    torque_ratio: float = quantity(0.01, "m", "our choice: reaction torque per thrust; usual for 3.5 in propellers")
    spin: float = quantity(
        7e-3,
        "N m s",
        "our estimate: angular momentum of a motor at full speed, 1.6e-6 kg m^2 (2 g propeller, 7 g bell) at 43000/min",
        zero=True,
    )
    motor_lag: float = quantity(30e-3, "s", "as simulation.thrust_lag: speed of motor and propeller, first order")
    exchange_rate: float = quantity(1920.0, "Hz", "our choice: sensors and motors; eight to a frame of motion capture")


class InnerLoop(Protocol):
    """An inner loop: sensors and channels in, motor commands out."""

    def exchange(
        self, body_rate: NDArray, specific_force: NDArray, attitude: NDArray, channels: Sequence[int] | None
    ) -> NDArray:
        """One period further; returns the commands of the four motors in [0, 1].

        Body rate (3,) in rad/s; specific force (3,) in m/s^2, what an accelerometer shows: +g upwards at rest; attitude
        as quaternion (x, y, z, w); 16 channels of 11 bits as a CRSF receiver gives them, ``None``: no frame has come.
        """
        ...


def settings(params: Params, limits: Limits) -> list[str]:
    """Lines for Betaflight's command line: ``betaflight_settings`` but for the serial receiver that SITL lacks."""
    return [line for line in betaflight_settings(params.vehicle, limits.radio) if not line.startswith("set serialrx_")]


def sensors(body_rate: ArrayLike, specific_force: ArrayLike, attitude: ArrayLike) -> bytes:
    """The packet with which the simulation answers, from our axes; position and velocity would only serve GPS."""
    p, q, r = np.asarray(body_rate, dtype=float).tolist()
    forward, left, up = np.asarray(specific_force, dtype=float).tolist()
    x, y, z, w = np.asarray(attitude, dtype=float).tolist()
    # a constant time stamp keeps the firmware from adapting the rate of its clock
    return STATE.pack(0.0, p, -q, -r, -forward, -left, -up, w, x, y, z, *(0.0,) * 6, PRESSURE)


def microseconds(channels: Sequence[int]) -> list[int]:
    """Channels of 11 bits as Betaflight reads them, rounded to the whole us that SITL takes."""
    return [round(US_OFFSET + US_PER_COUNT * channel) for channel in channels]


def radio(channels: Sequence[int]) -> bytes:
    """Return the packet that carries 16 channels of 11 bits, as us."""
    return RC.pack(0.0, *microseconds(channels))


def motors(packet: bytes) -> NDArray:
    """Return the commands of motors 1 to 4. Raises ValueError for a packet of another size."""
    if len(packet) != PWM.size:
        raise ValueError(f"a packet of motor commands has {PWM.size} bytes, not {len(packet)}")
    second, third, fourth, first = PWM.unpack(packet)
    return np.array((first, second, third, fourth))


def mixing(params: Params, airframe: Airframe) -> NDArray:
    """Thrusts of the four motors (N) to total thrust and torques about x, y, z (N, N m): a matrix (4, 4)."""
    across = params.vehicle.wheelbase / 2 / math.sqrt(2.0)
    ahead = across * np.array((-1.0, 1.0, -1.0, 1.0))
    left = across * np.array((-1.0, -1.0, 1.0, 1.0))
    return np.array((np.ones(4), left, -ahead, airframe.torque_ratio * np.array(TURNS)))


def motor_plant(params: Params, airframe: Airframe) -> ca.Function:
    """Vehicle and rod as in ``dynamics.coupled_plant``, with a rigid body and four motors for the inner loop.

    Each motor's speed n in [0, 1] follows its command with ``motor_lag``; its thrust is a quarter of
    ``vehicle.max_thrust`` times n^2. A motor that is sped up turns the vehicle the other way (``spin``): without that,
    Betaflight's yaw loop in its default tuning would be unstable on this vehicle. With the inertia J, the motors'
    torques tau, and the rod's force on its seat, h above the vehicle's centre of mass,

        J omega' = tau - omega x J omega + h e3 x R' (m (s'' - h e'' + g e3) - F e).

    Returns (x (23,), motor commands (4,), force (3,) N on the rod's COM) -> x'.
    """
    x, command, force = ca.SX.sym("x", 23), ca.SX.sym("command", 4), ca.SX.sym("force", 3)
    rate, speed = x[PLANT["body_rate"]], x[SPEEDS]
    wrench = ca.DM(mixing(params, airframe)) @ (params.vehicle.max_thrust / 4 * speed**2)
    inertia, speed_up = ca.DM(airframe.inertia), (command - speed) / airframe.motor_lag
    torque = wrench[1:] + ca.vertcat(0, 0, airframe.spin * ca.dot(ca.DM(TURNS), speed_up))
    torque -= ca.cross(rate, inertia * rate)
    plant, seat, lag = coupled_plant(params), params.vehicle.seat_height, params.simulation.rate_lag
    rate_dot, attitude = torque / inertia, x[PLANT["attitude"]]

    def coupled(rate_dot: ca.SX) -> ca.SX:
        commanded = ca.vertcat(rate + lag * rate_dot, 0)  # what makes the plant's inner loop turn it like this
        return plant(ca.vertcat(x[:19], wrench[0]), commanded, force)

    if seat > 0:  # the rod's force depends on omega', linearly
        turn, fall = ca.SX.sym("rate_dot", 3), ca.SX([0, 0, GRAVITY])
        specific = coupled(turn)[PLANT["velocity"]] + fall - seat * body_z_acceleration(attitude, rate, turn)
        pull = params.vehicle.mass * specific - wrench[0] * body_z(attitude)
        unbalanced = torque + seat * ca.cross(ca.SX([0, 0, 1]), into_body(attitude, pull)) - inertia * turn
        at_rest = ca.substitute(unbalanced, turn, ca.SX.zeros(3))
        rate_dot = ca.solve(-ca.jacobian(unbalanced, turn), at_rest)
    x_dot = ca.vertcat(coupled(rate_dot)[:16], rate_dot, speed_up)
    return ca.Function("motor_plant", [x, command, force], [x_dot], ["x", "command", "force"], ["x_dot"])


def into_body(attitude: ca.SX, vector: ca.SX) -> ca.SX:
    """Return a vector of the world in the body's axes, both (3,); the attitude is a quaternion (x, y, z, w)."""
    axis, w = attitude[:3], -attitude[3]  # the rotation backwards
    return vector + 2 * ca.cross(axis, ca.cross(axis, vector) + w * vector)


def _exchange_period(params: Params, airframe: Airframe) -> ca.Function:
    """(x, commands, force) -> x one period later, projected onto unit quaternion and direction; specific force."""
    plant = motor_plant(params, airframe)
    x, command, force = ca.SX.sym("x", 23), ca.SX.sym("command", 4), ca.SX.sym("force", 3)
    after = projected(rk4(plant, 1.0 / airframe.exchange_rate)(x, command, force))
    attitude = after[PLANT["attitude"]]
    motion = plant(after, command, force)
    felt = motion[PLANT["velocity"]] + ca.vertcat(0, 0, GRAVITY)
    if seat := params.vehicle.seat_height:  # the accelerometer lies at the vehicle's centre of mass
        felt -= seat * body_z_acceleration(attitude, after[PLANT["body_rate"]], motion[PLANT["body_rate"]])
    return ca.Function("exchange", [x, command, force], [after, into_body(attitude, felt)])


class MotorPlant(Plant):
    """``simulate.Plant`` with motors and a firmware, commanded by channels; held in place until the motors carry it.

    ``idle`` are the 16 channels from the start on, before any command; ``x`` (23,) are 19 states of ``dynamics.PLANT``,
    then the motors' speeds; ``held`` whether something still holds it; ``outputs`` (4,) the motors' newest commands in
    [0, 1]. ``trace``, if set, is called after each exchange with the state.
    """

    def __init__(
        self,
        params: Params,
        position: ArrayLike,
        lean: ArrayLike,
        inner: InnerLoop,
        airframe: Airframe,
        idle: Sequence[int],
    ) -> None:
        super().__init__(params, position, lean)
        self.substeps = round(airframe.exchange_rate / params.piloting.mocap_rate)
        self.x = np.concatenate([self.x[:19], np.zeros(4)])
        self.held = True
        self.trace: Callable[[NDArray], None] | None = None
        self._inner = inner
        self._latency = round(params.simulation.mocap_latency * airframe.exchange_rate)
        self._frames: deque[tuple[int, Sequence[int]]] = deque([(0, idle)])
        self._lag = 1.0 - math.exp(-1.0 / (airframe.exchange_rate * airframe.motor_lag))
        self._release = RELEASE * weight(params)
        self._felt = np.array((0.0, 0.0, GRAVITY))
        self._full = params.vehicle.max_thrust / 4
        self.outputs = np.zeros(4)
        # CasADi reads and writes these arrays in place: no conversion on the way
        self._pushed, self._after, self._turned = np.zeros(3), np.zeros(23), np.zeros(3)
        self._buffer, self._advance = _exchange_period(params, airframe).buffer()
        for index, array in enumerate((self.x, self.outputs, self._pushed)):
            self._buffer.set_arg(index, memoryview(array))
        for index, array in enumerate((self._after, self._turned)):
            self._buffer.set_res(index, memoryview(array))

    @property
    def thrust(self) -> float:
        """Total thrust of the motors, N."""
        return self._full * float(np.sum(self.x[SPEEDS] ** 2))

    def channels(self, values: Sequence[int]) -> None:
        """A frame of 16 channels, computed from the motion capture exposed now: it arrives after its latency."""
        self._frames.append((self._substep + self._latency, values))

    def advance(self, force: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        """One frame of motion capture further, with a constant force (3,) in N on the rod's COM."""
        for _ in range(self.substeps):
            came = None
            while self._frames and self._frames[0][0] <= self._substep:
                came = self._frames.popleft()[1]
            x = self.x
            self.outputs[:] = self._inner.exchange(x[PLANT["body_rate"]], self._felt, x[PLANT["attitude"]], came)
            np.clip(self.outputs, 0.0, 1.0, out=self.outputs)
            if self.held:
                x[SPEEDS] += self._lag * (self.outputs - x[SPEEDS])
                self.held = self.thrust < self._release
            else:
                self._pushed[:] = force
                self._advance()
                x[:] = self._after
                self._felt[:] = self._turned
            self._substep += 1
            if self.trace is not None:
                self.trace(x)


class Response(NamedTuple):
    """A delay and a first-order lag, s, with a gain; ``residual`` is the rms misfit in units of the data."""

    delay: float
    lag: float
    gain: float
    residual: float


def respond(command: NDArray, period: float, delay: float, lag: float) -> NDArray:
    """Return the response of a delay and a first-order lag, from rest, to a command (n,) that is held; times in s."""
    whole, part = divmod(delay / period, 1.0)
    after, before = math.exp(-(1.0 - part) * period / lag), math.exp(-part * period / lag)
    # exact: over each period the older value acts for its first part, the newer one for the rest
    numerator = np.concatenate([np.zeros(int(whole) + 1), [1.0 - after, (1.0 - before) * after]])
    return command[0] + lfilter(numerator, [1.0, -before * after], command - command[0])


def fit(command: NDArray, measured: NDArray, period: float) -> Response:
    """Return the delay, lag and gain that turn the command (n,) into what was measured (n,) with least squared error.

    Both are of one unit: ``command[k]`` acts from time k on, ``measured[k]`` is seen at time k; period in s.
    """

    def error(guess: NDArray) -> NDArray:
        delay, lag, gain = guess
        return gain * respond(command, period, delay, lag) - measured

    # least squares over a delay is not convex: the best of a few starts
    starts = [(delay, lag, 1.0) for delay in (0.004, 0.012, 0.03) for lag in (0.005, 0.02)]
    bounds = ([0.0, 1e-4, 0.1], [0.1, 0.2, 3.0])
    found = [least_squares(error, start, bounds=bounds, x_scale=(0.01, 0.01, 1.0)) for start in starts]
    best = min(found, key=lambda result: result.cost)
    delay, lag, gain = best.x.tolist()
    return Response(delay, lag, gain, float(np.sqrt(np.mean(best.fun**2))))


class Step(NamedTuple):
    """Shape of a step response. Times in s from the command; ``overshoot`` as a share of the step."""

    t10: float
    t63: float
    t90: float
    overshoot: float
    settled: float


def step_shape(time: NDArray, response: NDArray) -> Step:
    """Return the shape of a response (n,), normalised to the step, at times (n,); nan for a level never reached."""

    def reached(level: float) -> float:
        above = np.flatnonzero(response >= level)
        if not len(above):
            return math.nan
        around = slice(max(0, above[0] - 1), above[0] + 1)
        return float(np.interp(level, response[around], time[around]))

    outside = np.flatnonzero(np.abs(response - 1.0) > 0.05)
    settled = float(time[outside[-1]]) if len(outside) else 0.0
    return Step(reached(0.1), reached(0.63), reached(0.9), max(float(response.max()) - 1.0, 0.0), settled)
