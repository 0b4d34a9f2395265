"""Identifiability from two tracked points: distance, effective length and seat height are parts of one response.

Linear, per axis, in bounded motion. With e the horizontal part of the vehicle's z axis, rho the distance from the seat
to the rod's tracked point, L_e the effective length, h the height of the seat above the tracked point of the vehicle
(its centre of mass here) and mu the rod's share of the mass, the difference of the two points is a_rho + h e, and

    a_rho'' = (g / L_e) a_rho - (rho / L_e) (g e + (1 - mu) h e'').

So the difference over e is a real function of frequency, ``response``.
"""

import math

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.signal import csd, welch
from scipy.special import chdtri

from fiplib.dynamics import z_axis
from fiplib.params import GRAVITY, THETA, Params
from fiplib.recording import Flight
from fiplib.reproduction import measures
from fiplib.reproduction.style import BLUE, COLUMN, GREEN, GREY, ORANGE, PURPLE, origin

FREQUENCIES = np.geomspace(0.05, 20.0, 200)
"""Hz."""

HIGHEST = np.geomspace(0.4, 20.0, 60)
"""Highest frequencies used, Hz."""

RESOLUTION = 8.0
"""Length of the segments whose spectra are averaged, s."""

TAKE_OFF = 6.0
"""Seconds of a flight that are left out: a circle comes to speed in them."""


def lengths_of(params: Params) -> tuple[float, float, float]:
    """Return rho, L_e and h in m of a rod that is tracked at its middle."""
    rod, vehicle = params.pendulum, params.vehicle
    share = rod.mass / (rod.mass + vehicle.mass)
    middle = rod.length / 2
    return middle, middle * (1.0 - share * rod.inertia_factor) / rod.inertia_factor, vehicle.seat_height


def response(frequency: NDArray, rho: float, effective: float, height: float, share: float = 0.0) -> NDArray:
    """Return the difference of the two tracked points over e, m, at frequencies in Hz.

    It is ``rho + height`` in slow motion and ``height - (1 - share) height rho / effective`` in fast motion; between
    the two it bends at sqrt(g / effective).
    """
    square = (2 * np.pi * np.asarray(frequency, dtype=float)) ** 2
    push = GRAVITY - (1.0 - share) * height * square
    return height + rho / effective * push / (square + GRAVITY / effective)


def spectrum(flight: Flight) -> tuple[NDArray, NDArray]:
    """Return frequencies in Hz and the power spectral density of the true tilt about y, rad^2/Hz."""
    rate = flight.params.piloting.mocap_rate
    tilt = flight.truth_state.values[flight.time(flight.truth_state) > TAKE_OFF, THETA]
    return welch(tilt, rate, nperseg=round(RESOLUTION * rate), detrend="linear")


def spectrum_interval(seconds: float) -> tuple[float, float]:
    """Return the factors on a ``spectrum`` of so many seconds of random motion that give its 95 % interval.

    Segments overlap by half, and are weighted by a Hann window: two neighbours' spectra correlate by 1/36 (Welch,
    1967), which leaves a chi-square distribution of so many degrees of freedom.
    """
    segments = math.floor(2.0 * seconds / RESOLUTION) - 1
    freedom = 2.0 * segments / (1.0 + (1.0 - 1.0 / segments) / 18.0)
    return freedom / float(chdtri(freedom, 0.025)), freedom / float(chdtri(freedom, 0.975))


def measured_response(flight: Flight) -> tuple[NDArray, NDArray]:
    """Return frequencies in Hz and the response in m that the poses of a flight show along x, complex.

    The two bodies must be exposed together. Noise in the vehicle's attitude makes it smaller where the tilt is small.
    """
    rate = flight.params.piloting.mocap_rate
    later = flight.time(flight.vehicle) > TAKE_OFF
    tilt = z_axis(*flight.vehicle.orientation[later].T)[0]
    difference = (flight.pendulum.position - flight.vehicle.position)[later, 0]
    chosen = {"fs": rate, "nperseg": round(RESOLUTION * rate), "detrend": "linear"}
    frequency, cross = csd(tilt, difference, **chosen)
    return frequency, cross / welch(tilt, **chosen)[1]


def deviations(flight: Flight, seconds: float, below: NDArray) -> NDArray:
    """Return standard deviations of rho, L_e, h and rho + h, (n, 4), from motion ``below`` frequencies, (n,) Hz.

    In m, of one axis: the inverse of the Fisher information of ``seconds`` with the flight's spectrum of tilt. At each
    frequency e is unknown too, and seen three times: in the vehicle's position -(g/w^2) e, in its tilt e, and in the
    rod's position, which adds ``response`` times e to the vehicle's.
    """
    params, (frequency, power) = flight.params, spectrum(flight)
    frequency, power = frequency[1:], power[1:]
    lengths, noise = lengths_of(params), params.simulation
    share = params.pendulum.mass / (params.pendulum.mass + params.vehicle.mass)
    gradient = np.empty((3, len(frequency)))
    for row in range(3):
        step = 1e-6 * np.eye(3)[row]
        ends = (response(frequency, *(np.array(lengths) + way * step), share) for way in (1, -1))
        gradient[row] = np.subtract(*ends) / 2e-6
    base = -GRAVITY / (2 * np.pi * frequency) ** 2
    rod = base + response(frequency, *lengths, share)
    place, tilt = noise.position_noise**2, noise.attitude_noise**2
    # what is left of the rod's information once e is estimated from all three
    left = (1.0 - rod**2 / place / ((base**2 + rod**2) / place + 1.0 / tilt)) / place
    weight = seconds * frequency[0] * power * params.piloting.mocap_rate / 2.0 * left
    readings = np.vstack([np.eye(3), (1.0, 0.0, 1.0)])
    found = np.empty((len(below), 4))
    for row, limit in enumerate(below):
        known = frequency <= limit
        covariance = np.linalg.inv(gradient[:, known] * weight[known] @ gradient[:, known].T)
        found[row] = np.sqrt(np.einsum("ij,jk,ik->i", readings, covariance, readings))
    return found


def fig15_identifiability(hover: Flight, circle: Flight) -> Figure:
    """Fig. 15: identifiability of a rod from two tracked points, by frequency; uniform rod of 1 m, seat at 8 cm.

    Top: difference of the two points over the horizontal part e of the vehicle's body axis, for four rods; rho is the
    distance from the seat to the rod's tracked point, Le the effective length, h the seat's height. Middle: tilt in two
    recorded flights (simulated), averaged over segments of 8 s, with the 95 % intervals of a spectrum of random motion
    (chi-square), and the noise of its measurement (grey). Bottom: standard deviations that 2.5 s of motion up to a
    frequency allow (dotted: hover). Below half a hertz only the sum rho + h is known; motion above
    the bend of the curves separates the three.
    """
    for flight in (hover, circle):
        measures.need(flight, "truth_state")
    figure = Figure(figsize=(COLUMN, 4.6), layout="constrained")
    curve, motion, limits = figure.subplots(3, 1, sharex=True, height_ratios=(1.25, 1.0, 1.0))
    rho, effective, height = lengths_of(circle.params)
    variants = (
        (f"$\\rho$ = {rho:.2f}, $L_e$ = {effective:.2f}, $h$ = {height:.2f} m", (rho, effective, height), BLUE, "-"),
        ("$L_e$ 20 % longer", (rho, 1.2 * effective, height), ORANGE, "--"),
        ("$h$ = 0, same $\\rho + h$", (rho + height, effective, 0.0), GREEN, "-."),
        ("$\\rho$ 10 % longer", (1.1 * rho, effective, height), PURPLE, ":"),
    )
    for label, lengths, colour, dashes in variants:
        curve.semilogx(FREQUENCIES, response(FREQUENCIES, *lengths), ls=dashes, color=colour, label=label)
    curve.axhline(0.0, color=GREY, lw=0.4)
    curve.set(ylabel="difference / e (m)", ylim=(-0.05, 0.72))
    curve.legend(loc="upper right")
    for flight, colour in ((circle, BLUE), (hover, ORANGE)):
        frequency, power = spectrum(flight)
        amplitude = 1e3 * np.sqrt(power[1:])
        motion.loglog(frequency[1:], amplitude, color=colour, label=flight.path.name)
        low, high = np.sqrt(spectrum_interval(flight.duration - TAKE_OFF))
        motion.fill_between(frequency[1:], low * amplitude, high * amplitude, color=colour, alpha=0.25, lw=0)
    noise = circle.params.simulation.attitude_noise * math.sqrt(2.0 / circle.params.piloting.mocap_rate)
    motion.axhline(1e3 * noise, color=GREY, lw=0.6)
    motion.set(ylabel="tilt (mrad/$\\sqrt{\\mathrm{Hz}}$)", ylim=(0.05, 100))
    motion.legend(loc="upper right")
    styles = ((r"$\rho$", PURPLE, 2.0), ("$L_e$", ORANGE, 0.9), ("$h$", GREEN, 0.9), (r"$\rho + h$", "black", 0.9))
    for flight, dashes in ((circle, "-"), (hover, ":")):
        found = deviations(flight, 2.5, HIGHEST)
        for values, (name, colour, width) in zip(found.T, styles, strict=True):
            label = name if flight is circle else None
            limits.loglog(HIGHEST, 1e3 * values, ls=dashes, lw=width, color=colour, label=label)
    limits.set(ylabel="std. dev. (mm)", ylim=(0.3, 1500), xlabel="frequency; below: highest frequency used (Hz)")
    limits.set(xlim=(0.1, 20.0), xticks=(0.1, 1, 10), xticklabels=("0.1", "1", "10"))
    limits.legend(loc="upper right", ncols=2)
    origin(figure, "simulated, uniform rod of 1 m; bottom: 2.5 s, hover dotted")
    return figure
