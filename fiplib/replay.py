"""A recorded flight through the pilot again: its states, its commands, its estimator's windows.

The bag holds all that the pilot was given (poses, their times, the estimates it received), so the commands come out bit
for bit as they were flown. With other parameters the same functions say what the pilot *would* have commanded, and
which windows another estimator would have been given.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fiplib.dynamics import euler_angles
from fiplib.estimators.handover import HANDOVERS
from fiplib.estimators.windows import SAMPLERS, RawSampler, RawSchedule, RawWindow, WindowSampler
from fiplib.kalman import Window
from fiplib.params import NANO, STATE_NAMES, STATES, Params
from fiplib.pilot import REFERENCES, Observer, Pilot, Reference, estimator_of
from fiplib.recording import ROLES, TOPICS, BagError, Flight, Measurement, Series


class TimedWindow(NamedTuple):
    """A window of the estimator and the time in ns at which it was complete."""

    stamp: int
    window: Window | RawWindow


def why_not_refit(flight: Flight) -> str | None:
    """None if the length can be estimated from this flight, else one sentence that says why not."""
    if flight.command is None:
        return (
            f"The bag holds no commands (topic {TOPICS['command']}), which the filter needs as its input: "
            "record them, or say under which name they are recorded."
        )
    estimation = flight.params.estimation
    window = (estimation.window - 1) * estimation.sample_period
    common = min(flight.command.stamp[-1], flight.vehicle.stamp[-1], flight.pendulum.stamp[-1])
    common = (common - max(flight.command.stamp[0], flight.vehicle.stamp[0], flight.pendulum.stamp[0])) / NANO
    if common < window:
        return (
            f"Poses and commands overlap for {max(common, 0.0):.1f} s only, one estimation window is "
            f"{window:.1f} s: record a longer flight, or take a shorter window."
        )
    return None


def measurements(flight: Flight) -> Iterator[tuple[int, Measurement]]:
    """The frames as the pilot got them: (time of arrival in ns, both bodies).

    Every pose of the vehicle is joined with the latest pose of the pendulum that had arrived by then.
    """
    vehicle, pendulum = flight.vehicle, flight.pendulum
    latest = np.searchsorted(pendulum.received, vehicle.received, side="right") - 1
    for index in np.nonzero(latest >= 0)[0]:
        other = latest[index]
        yield (
            int(vehicle.received[index]),
            Measurement(
                int(vehicle.stamp[index]),
                vehicle.position[index],
                vehicle.orientation[index],
                pendulum.position[other],
                pendulum.orientation[other],
            ),
        )


def states(flight: Flight) -> Series:
    """The states that the controller used; where none are recorded, derived from the poses the paper's way."""
    if flight.state is not None:
        return flight.state
    observer, length = Observer(flight.params.piloting), flight.params.piloting.initial_length
    derived = [(now, observer.update(measurement, length)[0]) for now, measurement in measurements(flight)]
    return Series(
        np.array([now for now, _ in derived]),
        np.array([state for _, state in derived]).reshape(-1, len(STATES)),
        STATE_NAMES,
        tuple(signal.unit for signal in STATES),
    )


def reference(flight: Flight) -> Reference:
    """The reference that the flight followed.

    Raises:
        BagError: the bag does not name one that is known here.
    """
    entry = dict(flight.metadata.get("reference", {}))
    kind = entry.pop("kind", None)
    if kind not in REFERENCES:
        raise BagError(f"{flight.path}: its metadata name no reference of the kinds {', '.join(REFERENCES)}")
    return REFERENCES[kind](**entry)


def commands(flight: Flight, params: Params | None = None, follow: Reference | None = None) -> Series:
    """What the pilot commands when it is given the poses and the estimates of the bag.

    Args:
        flight: the recorded flight.
        params: other parameters than those it was flown with.
        follow: another reference than the one it followed.

    Returns:
        Body rates in rad/s and normalised thrust, (n, 4), as in ``flight.command``.

    Raises:
        BagError: the bag does not say which reference was followed, and none is given.
    """
    pilot = Pilot(params or flight.params, follow or reference(flight))
    length = flight.length
    estimates = [] if length is None else list(zip(length.stamp, length.values[:, 1:].tolist(), strict=True))[::-1]
    given = []
    for now, measurement in measurements(flight):
        command = pilot.step(now, measurement)
        if command is not None:
            given.append((command.stamp, *command.body_rate, command.thrust))
        while estimates and estimates[-1][0] <= now:
            pilot.receive_estimate(*estimates.pop()[1])
    return Series(
        np.array([row[0] for row in given], dtype=np.int64),
        np.array([row[1:] for row in given]).reshape(-1, 4),
        ("omega_x", "omega_y", "omega_z", "thrust"),
        ("rad/s", "rad/s", "rad/s", "1"),
    )


def at_recorded_rate(params: Params, command: Series) -> Params:
    """The parameters with the control rate at which commands were recorded: their stamps know it, whoever flew.

    The parameters' own rate stays where it agrees with the median step of the stamps within 2 %.
    """
    rate = NANO / float(np.median(np.diff(command.stamp))) if len(command.stamp) > 1 else params.piloting.control_rate
    return (
        params if abs(rate / params.piloting.control_rate - 1) <= 0.02 else params.replace(piloting__control_rate=rate)
    )


def refit(flight: Flight, params: Params | None = None) -> Flight:
    """The flight with the lengths that an estimator finds in it now, taken over as the pilot would have.

    With the parameters of the flight these are the recorded lengths, to the last bit.

    Args:
        flight: the recorded flight.
        params: other parameters (estimator, window, hand-over) than those it was flown with.

    Raises:
        BagError: the bag cannot be refitted; the message says why.
    """
    params = params or flight.params
    estimator, found = estimator_of(params), windows(flight, params)
    overlap = SAMPLERS[estimator.kind](params).seconds / params.estimation.run_period
    policy, seed = HANDOVERS[params.piloting.handover](params, overlap), flight.metadata.get("seed", 0)
    stamps, rows = [flight.start_ns], [(policy.used, np.nan, np.nan)]
    for run, (stamp, window) in enumerate(found):
        estimate = estimator.function(window, params, np.random.default_rng([seed, run]))
        length, deviation = estimate.length, estimate.standard_deviation
        stamps.append(stamp + round(NANO * params.simulation.estimation_latency))
        rows.append((policy.update(length, deviation), length, deviation))
    role = ROLES["length"]
    return replace(flight, length=Series(np.array(stamps), np.array(rows), role.names, role.units))


def windows(flight: Flight, params: Params | None = None) -> list[TimedWindow]:
    """The windows that the estimator is given on this flight, in order; the n-th is that of its n-th run.

    Args:
        flight: the recorded flight.
        params: other parameters (window, sampling, schedule) than those it was flown with.

    Raises:
        BagError: the bag cannot be refitted; the message says why.
    """
    params = params or flight.params
    raw = estimator_of(params).kind == "raw"
    # how long a flight must be is another matter with raw windows, which grow
    if (reason := why_not_refit(flight)) and not (raw and flight.command is not None):
        raise BagError(f"{flight.path}: {reason}")
    assert flight.command is not None  # else there was a reason
    if raw:
        return _raw_windows_due(flight, flight.command, params)
    known = states(flight)
    latest = np.searchsorted(known.stamp, flight.command.stamp, side="right") - 1
    sampler, found = WindowSampler(at_recorded_rate(params, flight.command)), []
    for index in np.nonzero(latest >= 0)[0]:
        sampler.push(known.values[latest[index]], flight.command.values[index, :2])
        now = int(flight.command.stamp[index])
        if window := sampler.due(now):
            found.append(TimedWindow(now, window))
    return found


def _raw_windows_due(flight: Flight, command: Series, params: Params) -> list[TimedWindow]:
    schedule, found, given = RawSchedule(params), [], 0
    for now, measurement in measurements(flight):
        schedule.push_frame(measurement)
        if given < len(command.stamp) and command.stamp[given] == now:
            schedule.push_command(now, command.values[given, :3], float(command.values[given, 3]))
            given += 1
        if window := schedule.due(now):
            found.append(TimedWindow(now, window))
    return found


def raw_windows(flight: Flight, seconds: float, every: float) -> list[tuple[int, RawWindow]]:
    """Windows of raw motion capture of a flight, for the estimators that take them.

    Args:
        flight: the recorded flight.
        seconds: span of a window.
        every: s from one window to the next; windows overlap when it is shorter than ``seconds``.

    Returns:
        The time in ns at which each was complete, and the window.

    Raises:
        BagError: the bag cannot be refitted; the message says why.
    """
    if reason := why_not_refit(flight):
        raise BagError(f"{flight.path}: {reason}")
    assert flight.command is not None  # else there was a reason
    stamps, values = flight.command.stamp, flight.command.values
    sampler, found, given = RawSampler(seconds), [], 0
    for now, measurement in measurements(flight):
        attitude = euler_angles(measurement.vehicle_attitude)
        sampler.push_frame(measurement.stamp, measurement.vehicle_position, measurement.pendulum_position, attitude)
        while given < len(stamps) and stamps[given] <= now:
            sampler.push_command(int(stamps[given]), values[given, :3], float(values[given, 3]))
            given += 1
        # half a millisecond of slack, so that a period of whole frames is not missed by rounding
        if (not found or now - found[-1][0] > every * NANO - 500_000) and (window := sampler.window()):
            found.append((now, window))
    return found
