"""Disturbances of the simulated vehicle: wind, gusts, a hindered rotor, a battery that sags. All off by default.

With every option at its default a plant is advanced by the force of a push alone, to the bit as before there were any.

- Wind: steady, and gusts about it: per axis a Gauss-Markov process of first order (Dryden's longitudinal spectrum) of
  standard deviation ``simulation.gusts`` and the time constant ``GUST_TIME``. Its generator is the second stream of the
  flight's seed, so that motion capture has the same noise with it and without. Vehicle and rod's COM feel linear drag,
  f = -c (v - wind), by the two coefficients ``simulation.drag``; the vehicle's velocity is taken at the rod's seat.
- Hindered rotor: from ``simulation.rotor_loss_start`` on, the front left one of four gives a share p less than it is
  commanded. The vehicle loses p/4 of its thrust, and at hover the thrust F = p/4 (m + m_p) g at the arm
  d = wheelbase / 2^1.5 turns it about x and y with d F / J, J = m (``GYRATION`` wheelbase)^2. A rate loop answers with
  an offset of ``rate_lag`` d F / J, which its integral takes back with the time constant ``INTEGRAL_TIME``. Defaults
  and p = 0.2: 25 deg/s at first about each axis, which would tilt it by 1.8 deg. The torque about z is left out.
- Battery: the thrust of a command falls by the share ``simulation.battery_sag`` per second, linearly.
"""

import math

import numpy as np
from numpy.typing import NDArray

from fiplib.params import GRAVITY, Params

GUST_TIME = 1.0
"""Time constant of the gusts in s: our choice; a length scale of 2 m, a room's, in a wind of 2 m/s."""

GYRATION = 0.2
"""Radius of gyration about x and y over the wheelbase: our choice; motors at 0.35, the battery in the middle."""

INTEGRAL_TIME = 0.074
"""Time in s in which a rate loop's integral takes a torque over: P over I gain of Betaflight 4.5 as it is delivered,
45 * 0.032029 and 80 * 0.244381 1/s, roll."""

SIZE = 8
"""Numbers of a load: force on the rod's COM (3,) in N, wind (2,) in m/s, offset of the two body rates in rad/s, and the
factor of the commanded thrust."""


class Disturbance:
    """The loads on a plant, one for each frame of motion capture in order, of one seed."""

    def __init__(self, params: Params, seed: int) -> None:
        simulation, vehicle = params.simulation, params.vehicle
        self._period, self._simulation = 1.0 / params.piloting.mocap_rate, simulation
        self._rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1,)))
        self._gust, self._frames = simulation.gusts * self._rng.normal(size=2), 0
        lost = simulation.rotor_loss / 4 * (vehicle.mass + params.pendulum.mass) * GRAVITY
        inertia = vehicle.mass * (GYRATION * vehicle.wheelbase) ** 2
        self.offset = simulation.rate_lag * lost * vehicle.wheelbase / 2**1.5 / inertia
        """Size of the first rate offset about each axis, rad/s."""
        self._wind, self._blown = np.array(simulation.wind), any(simulation.wind) or simulation.gusts > 0.0
        self.acts = self._blown or simulation.rotor_loss > 0.0 or simulation.battery_sag > 0.0
        """Whether any option is on."""
        self.size = SIZE if self.acts else 3
        """How many numbers ``load`` returns."""

    def load(self, force: NDArray) -> NDArray:
        """Return the load of the next frame under a push's force (3,) in N: (``size``,)."""
        if not self.acts:
            return force
        load, seconds = np.zeros(SIZE), self._frames * self._period
        self._frames += 1
        load[:3] = force
        load[3:5] = self._wind + self._gust if self._blown else math.nan
        kept = math.exp(-self._period / GUST_TIME)
        chance = self._simulation.gusts * math.sqrt(1.0 - kept * kept)
        self._gust = kept * self._gust + chance * self._rng.normal(size=2)
        load[7] = max(0.0, 1.0 - self._simulation.battery_sag * seconds)
        since = seconds - self._simulation.rotor_loss_start
        if since >= 0.0:
            offset = self.offset * math.exp(-since / INTEGRAL_TIME)
            load[5], load[6] = -offset, offset  # the front left: x and y of its arm are positive
            load[7] *= 1.0 - self._simulation.rotor_loss / 4
        return load
