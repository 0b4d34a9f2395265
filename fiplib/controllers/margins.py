"""Linear analysis of one axis of the closed loop, delay and lag included: stability and its margins.

Between two control ticks everything in the loop is linear and runs on a fixed grid: the plant's substeps, the frames of
motion capture, the ticks. So the loop from tick to tick is one matrix, without approximation of delay or sampling:

- plant: vehicle and rod with reaction and inertia (``dynamics.coupled_plant``, linearised upright), the inner loop's
  lag, and as a pure delay in whole substeps the delay of the inner loop and the latency of motion capture;
- observer: the one that ``piloting.observer`` names, at every frame (``observers.LinearObserver``);
- controller: the first Riccati gain of ``mpc.MPC`` for the length it *uses*, while the plant has the *true* one.

What it leaves out: bounds, noise, large angles. Margins are those of the loop broken at the commanded body rate.
"""

import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import control
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from fiplib import observers
from fiplib.mpc import MPC
from fiplib.params import GRAVITY, Params

FREQUENCIES = 400
"""Points of a frequency response, evenly spaced on a logarithmic axis from ``SLOWEST`` to the Nyquist frequency: 2.6 %
apart, and the margins are interpolated between them."""

SLOWEST = 0.01
"""Lowest frequency of a response in rad/s: well below the slowest closed-loop mode met, 0.07 1/s."""

SHARES = tuple(math.exp(exponent / 100.0) for exponent in range(-200, 201))
"""Factors tried on the pendulum's gains: 1 % apart, from 0.14 to 7.4."""


@dataclass(frozen=True)
class Margins:
    """Margins of a stable loop at its input; 1, 1, 0, 0 where it is unstable.

    ``gain_low`` and ``gain_high`` are the factors, below and above 1, between which the loop gain may lie; ``delay`` is
    additional delay in s, ``disk`` the balanced disk margin alpha: gain and phase may vary together within a disk, from
    (2 - alpha)/(2 + alpha) to its inverse in gain alone.
    """

    gain_low: float
    gain_high: float
    delay: float
    disk: float


UNSTABLE = Margins(1.0, 1.0, 0.0, 0.0)


@dataclass(frozen=True)
class LinearLoop:
    """One axis from control tick to control tick: plant (6), the observer's states, and the commands under way.

    ``open_loop`` is L(z), from the commanded body rate to the controller's answer to it, sign reversed; ``step`` the
    control period in s; ``gain`` K (5,) of u = -K (s, s', d, d', tilt), and ``sees`` (5, n) what the controller takes
    for these from the loop's n states.
    """

    open_loop: control.StateSpace
    step: float
    gain: NDArray
    sees: NDArray

    @functools.cached_property
    def eigenvalues(self) -> NDArray:
        """Return the eigenvalues of the closed loop over one control period, largest magnitude first."""
        values = np.linalg.eigvals(self.open_loop.A - self.open_loop.B @ self.open_loop.C)
        return values[np.argsort(-np.abs(values), kind="stable")]

    @property
    def spectral_radius(self) -> float:
        """Largest magnitude of an eigenvalue; below 1 the loop is stable."""
        return float(np.abs(self.eigenvalues[0]))

    @property
    def growth_rate(self) -> float:
        """Rate of the slowest decaying or fastest growing mode, 1/s; negative if the loop is stable."""
        return math.log(self.spectral_radius) / self.step

    @property
    def frequency(self) -> float:
        """Frequency of that mode, rad/s; 0 if it does not oscillate."""
        return abs(float(np.angle(self.eigenvalues[0]))) / self.step

    @functools.cached_property
    def margins(self) -> Margins:
        """Margins of the loop broken at the input."""
        if self.spectral_radius >= 1.0:
            return UNSTABLE
        omega = np.geomspace(SLOWEST, 0.999 * math.pi / self.step, FREQUENCIES)
        loop = self.open_loop(np.exp(1j * omega * self.step), squeeze=True)
        smooth = control.frd(loop, omega, smooth=True)
        gains, phases, _, _, crossings, _ = control.stability_margins(smooth, returnall=True)
        lag = np.radians(np.mod(phases, 360.0)) / crossings  # further delay turns the response one way only
        # as control.disk_margins, from the response at hand: 2 / |S - T| with S - T = (1 - L) / (1 + L)
        disk = 2.0 * np.abs((1.0 + loop) / (1.0 - loop)).min()
        low, high = gains[gains < 1.0].max(initial=0.0), gains[gains > 1.0].min(initial=math.inf)
        return Margins(float(low), float(high), float(lag.min(initial=math.inf)), float(disk))

    def pendulum_share(self) -> tuple[float, float]:
        """Factors between which the gains of d and d' alone may lie, the others left as they are: (low, high).

        The first of ``SHARES`` on either side at which the loop is unstable (0, inf: none); 1, 1 where it is already.
        """
        if self.spectral_radius >= 1.0:
            return 1.0, 1.0
        factors = np.array(SHARES)
        gains = self.gain * np.where([False, False, True, True, False], factors[:, None], 1.0)
        closed = self.open_loop.A - self.open_loop.B * (gains @ self.sees)[:, None, :]
        stable = np.abs(np.linalg.eigvals(closed)).max(axis=1) < 1.0
        below, above = factors[(factors < 1.0) & ~stable], factors[(factors > 1.0) & ~stable]
        return float(below.max(initial=0.0)), float(above.min(initial=math.inf))


def linear_plant(params: Params) -> tuple[NDArray, NDArray]:
    """``dynamics.coupled_plant`` linearised about the upright hover, one axis: A (6, 6) and B (6, 1).

    The state is (s, s', d, d', tilt, rate), the input the commanded body rate. With r = l/2 and
    kappa = (m + m_p) / (m + m_p (1 - lambda)), by how much the vehicle is lighter across the rod than along it, and
    eta = m h / (m + m_p) of the seat's height h above the vehicle's centre of mass:

        s'' = g (kappa tilt + (1 - kappa) d/r) + kappa eta rate',   rate' = (command - rate) / lag,
        d'' = lambda kappa (g d/r - g tilt - eta rate').
    """
    m, m_p, r = params.vehicle.mass, params.pendulum.mass, params.pendulum.length / 2
    factor = params.pendulum.inertia_factor
    kappa = (m + m_p) / (m + m_p * (1 - factor))
    a, b = np.zeros((6, 6)), np.zeros((6, 1))
    a[0, 1] = a[2, 3] = a[4, 5] = 1.0
    a[1, 4], a[1, 2] = GRAVITY * kappa, GRAVITY * (1 - kappa) / r
    a[3, 2], a[3, 4] = factor * kappa * GRAVITY / r, -factor * kappa * GRAVITY
    a[5, 5], b[5, 0] = -1 / params.simulation.rate_lag, 1 / params.simulation.rate_lag
    seat = kappa * m * params.vehicle.seat_height / (m + m_p)
    for row, share in ((1, seat), (3, -factor * seat)):
        a[row, 5], b[row, 0] = share * a[5, 5], share * b[5, 0]
    return a, b


class Gains(Protocol):
    """The feedback gains of one axis: K_k in the rows of ``gains``, (N, 5), of which the loop uses the first."""

    @property
    def gains(self) -> NDArray: ...


class Regulator(Protocol):
    """A linear controller, such as the MPC, that returns the gains of both axes for a length in use."""

    def prepare(self, length: float) -> Sequence[Gains]: ...


def closed_loop(used_length: float, params: Params, mpc: Regulator | None = None, axis: int = 0) -> LinearLoop:
    """The loop of one axis, an index into ``params.AXES``, when the MPC uses a length in m and the rod is another.

    ``params`` give the rod, weights, rates, delays and lags; ``mpc`` of the same weights serves for many lengths and
    rods. Raises ValueError: rates are no whole multiples of each other, or the pendulum is not measured by position.
    """
    if params.piloting.pendulum_measurement != "position":
        raise ValueError("the linear loop needs piloting.pendulum_measurement = 'position'")
    rates = params.simulation.plant_rate, params.piloting.mocap_rate, params.piloting.control_rate
    substeps, frames = (round(fast / slow) for fast, slow in itertools.pairwise(rates))
    if not math.isclose(rates[0], substeps * rates[1]) or not math.isclose(rates[1], frames * rates[2]):
        raise ValueError(f"plant, mocap and control rate must be whole multiples of each other, got {rates} Hz")
    delay = round((params.simulation.mocap_latency + params.simulation.rate_delay) * rates[0])  # as simulate.Plant
    ticks = math.ceil(delay / (frames * substeps))

    # Within a tick: plant (6), the observer's states, commands from this tick's to that of `ticks` ago
    observer = observers.module(params).linear(params, used_length)
    given = 6 + len(observer.a)
    size = given + 1 + ticks
    observe, tick, measured = np.eye(size), np.eye(size), np.zeros((3, size))
    measured[[0, 1, 1, 2], [0, 0, 2, 4]] = 1.0  # tracked points of vehicle and rod, tilt
    measured[0, 4] = -params.seat_above_tracked
    observe[6:given, 6:given] = observer.a
    observe[6:given] += observer.b @ measured
    a, b = linear_plant(params)
    held = expm(np.block([[a, b], [np.zeros((1, 7))]]) / rates[0])
    for substep in range(frames * substeps):
        if substep % substeps == 0:
            tick = observe @ tick
        age = max(0, math.ceil((delay - substep) / (frames * substeps)))
        advance = np.eye(size)
        advance[:6, :6], advance[:6, given + age] = held[:6, :6], held[:6, 6]
        tick = advance @ tick
    # Between ticks the oldest command has done its work; the new one comes in as the input
    kept = np.delete(np.eye(size), given, axis=1)
    gain = (mpc or MPC(params)).prepare(used_length)[axis].gains[0]
    sees = observer.c @ (observe @ kept)[6:given] + observer.d @ measured @ kept
    open_loop = control.ss((tick @ kept)[:-1], tick[:-1, given : given + 1], gain[None] @ sees, 0.0, 1.0 / rates[2])
    return LinearLoop(open_loop, 1.0 / rates[2], gain, sees)
