"""A recorded flight through the pilot again: its states, its commands, its estimator's windows.

The bag holds all that the pilot was given (poses, their times, the estimates it received), so the commands come out bit
for bit as they were flown. With other parameters the same functions say what the pilot *would* have commanded, and
which windows another estimator would have been given. All windows of a recorded flight are cut here.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from fiplib.estimators.checks import why_no_length
from fiplib.estimators.handover import HANDOVERS
from fiplib.estimators.poses.knowledge import Knowledge
from fiplib.estimators.windows import SAMPLERS, RawSampler, RawWindow, WindowSampler
from fiplib.kalman import Window
from fiplib.observers import Observer
from fiplib.params import NANO, STATES, Params
from fiplib.pilot import Pilot, estimator_of
from fiplib.recording import TOPICS, BagError, Flight, Measurement, Series
from fiplib.references import REFERENCES, Reference

if TYPE_CHECKING:
    from fiplib.estimators.poses.estimate import PoseEstimate

STRIDE = 14
"""Every how many runs of the estimator a spaced window comes: half a window apart, 7 in each of our flights."""

MOST_SAMPLES = 250
"""Samples in a window between two times at most: beyond, an estimate takes longer than one likes to wait."""


class TimedWindow(NamedTuple):
    """A window of the estimator, of its kind (``Window`` or ``RawWindow``), and the time in ns when it was complete."""

    stamp: int
    window: Any


def why_not_refit(flight: Flight, least: float | None = None) -> str | None:
    """None if the length can be estimated from this flight, else one sentence that says why not.

    ``least`` is the time in s for which poses and commands must overlap: one window of the paper's, if none is given.
    """
    if flight.command is None:
        return (
            f"The bag holds no commands (topic {TOPICS['command']}), which the filter needs as its input: "
            "record them, or say under which name they are recorded."
        )
    if least is None:
        least = (flight.params.estimation.window - 1) * flight.params.estimation.sample_period
    common = min(flight.command.stamp[-1], flight.vehicle.stamp[-1], flight.pendulum.stamp[-1])
    common = (common - max(flight.command.stamp[0], flight.vehicle.stamp[0], flight.pendulum.stamp[0])) / NANO
    if common < least:
        return (
            f"Poses and commands overlap for {max(common, 0.0):.1f} s only, one estimation window is "
            f"{least:.1f} s: record a longer flight, or take a shorter window."
        )
    return why_no_length(flight, commands=True)


def measurements(flight: Flight) -> Iterator[tuple[int, Measurement]]:
    """Yield the frames as the pilot got them: (time of arrival in ns, both bodies).

    Every pose of the vehicle is joined with the latest pose of the pendulum that had arrived by then.
    """
    vehicle, pendulum = flight.vehicle, flight.pendulum
    latest = np.searchsorted(pendulum.received, vehicle.received, side="right") - 1
    for index in np.nonzero(latest >= 0)[0]:
        seat = vehicle.position[index], vehicle.orientation[index]
        rod = pendulum.position[latest[index]], pendulum.orientation[latest[index]]
        yield int(vehicle.received[index]), Measurement(int(vehicle.stamp[index]), *seat, *rod)


def states(flight: Flight) -> Series:
    """Return the states that the controller used; where none are recorded, derived from the poses the paper's way."""
    if flight.state is not None:
        return flight.state
    observer, length = Observer(flight.params), flight.params.piloting.initial_length
    derived = [(now, observer.update(measurement, length)[0]) for now, measurement in measurements(flight)]
    stamps, rows = np.array([now for now, _ in derived]), np.array([state for _, state in derived])
    return Series.of("state", stamps, rows.reshape(-1, len(STATES)))


def assumed_seat(flight: Flight) -> str | None:
    """None if a flight says where its seat is, else one sentence: what derived states take it to be."""
    if "params" in flight.metadata:
        return None
    height = 100 * flight.params.piloting.seat_height
    return f"states were derived with the seat {height:g} cm above the tracked point: the recording does not say where"


def reference(flight: Flight) -> Reference:
    """Return the reference that the flight followed. Raises BagError: the bag does not name one that is known here."""
    recorded = flight.metadata.get("reference", {})
    entry = dict(recorded) if isinstance(recorded, dict) else {}
    make = REFERENCES.get(str(entry.pop("kind", None)))
    if make is None:
        raise BagError(f"{flight.path}: its metadata name no reference of the kinds {', '.join(REFERENCES)}")
    try:
        return make(**entry)
    except (TypeError, ValueError) as error:
        raise BagError(f"{flight.path}: its metadata describe no reference that can be followed ({error})") from error


def commands(flight: Flight, params: Params | None = None, follow: Reference | None = None) -> Series:
    """Return the pilot's commands for the poses and the estimates of the bag, (n, 4) as ``flight.command``.

    ``params`` and ``follow`` replace the parameters and the reference it was flown with. Raises BagError as
    ``reference``, if none is given.
    """
    pilot = Pilot(params or flight.params, follow or reference(flight))
    length = flight.length
    estimates = [] if length is None else list(zip(length.stamp, length.values[:, 1:].tolist(), strict=True))[::-1]
    stamps, rows = [], []
    for now, measurement in measurements(flight):
        command = pilot.step(now, measurement)
        if command is not None:
            stamps.append(command.stamp)
            rows.append((*command.body_rate, command.thrust))
        while estimates and estimates[-1][0] <= now:
            pilot.receive_estimate(*estimates.pop()[1])
    return Series.of("command", np.array(stamps, dtype=np.int64), np.array(rows).reshape(-1, 4))


def at_recorded_rate(params: Params, command: Series) -> Params:
    """Return the parameters with the control rate at which commands were recorded, which follows from their stamps.

    The parameters' own rate stays where it agrees with the median step of the stamps within 2 %.
    """
    rate = NANO / float(np.median(np.diff(command.stamp))) if len(command.stamp) > 1 else params.piloting.control_rate
    same = abs(rate / params.piloting.control_rate - 1) <= 0.02
    return params if same else params.replace(piloting__control_rate=rate)


def refit(flight: Flight, params: Params | None = None) -> Flight:
    """Return the flight with the lengths that an estimator finds in it now, taken over as the pilot would have.

    With the parameters of the flight these are the recorded lengths, to the last bit; ``params`` are others (estimator,
    window, hand-over). Raises BagError: the bag cannot be refitted; the message says why.
    """
    params = params or flight.params
    estimator, found = estimator_of(params), windows(flight, params)
    function = estimator.function  # one for all windows: it may remember them
    overlap = SAMPLERS[estimator.kind](params).seconds / params.estimation.run_period
    policy, seed = HANDOVERS[params.piloting.handover](params, overlap), flight.metadata.get("seed", 0)
    stamps, rows = [flight.start_ns], [(policy.used, np.nan, np.nan)]
    for run, (stamp, window) in enumerate(found):
        answer = function(window, params, np.random.default_rng([seed, run]))
        length, deviation = answer.length, answer.standard_deviation
        stamps.append(stamp + round(NANO * params.simulation.estimation_latency))
        rows.append((policy.update(length, deviation), length, deviation))
    notes = (*flight.notes, *filter(None, [assumed_seat(flight)]))
    return replace(flight, length=Series.of("length", np.array(stamps), np.array(rows)), notes=notes)


def estimate(flight: Flight, knowledge: Knowledge | None = None, **stated: Any) -> "PoseEstimate":
    """Return the length of the rod from the poses of the two bodies over a whole flight, or the reason for a refusal.

    ``knowledge`` are priors, by default ``Knowledge.of_flight``; ``stated`` are fields that replace some of them.
    Raises ValueError: ``flight`` is no flight.
    """
    from fiplib.estimators.poses.history import length_of_flight  # compiled code: half a second to import

    if not isinstance(flight, Flight):
        raise ValueError(
            f"estimate takes a Flight, as fiplib.read and fiplib.fly return it, not {type(flight).__name__}"
        )
    return length_of_flight(flight, replace(knowledge or Knowledge.of_flight(flight), **stated)).answer


def windows(flight: Flight, params: Params | None = None) -> list[TimedWindow]:
    """Return the windows that the estimator is given on this flight, in order; the n-th is that of its n-th run.

    ``params`` are other parameters (window, sampling, schedule) than those of the flight. Raises BagError: the bag
    cannot be refitted; the message says why.
    """
    params = params or flight.params
    kind = estimator_of(params).kind
    # how long a flight must be is another matter with raw windows, which grow
    command = _commands(flight, -math.inf if kind == "raw" else None)
    return list(_due(flight, SAMPLERS[kind](at_recorded_rate(params, command))))


def spaced_windows(flight: Flight) -> list[Window]:
    """Return the estimator's window of every ``STRIDE``-th run. Raises BagError as ``windows``."""
    return [timed.window for timed in windows(flight)[::STRIDE]]


def window_between(flight: Flight, start: float, end: float, params: Params) -> tuple[Window, Params]:
    """Return the window of states between two times in s since the start, sampled as the pilot does it.

    ``params`` give the sampling period. They are returned, too, with the number of samples and the rate at which
    commands were recorded. Raises BagError: the bag holds no commands; ValueError: fewer than 2 samples, or more than
    ``MOST_SAMPLES``.
    """
    command = _commands(flight, -math.inf)
    params, at = at_recorded_rate(params, command), flight.time(command)
    count = int(np.sum((at >= start) & (at <= end) & (command.stamp >= states(flight).stamp[0])))
    samples = (count - 1) // max(1, round(params.estimation.sample_period * params.piloting.control_rate)) + 1
    if not 2 <= samples <= MOST_SAMPLES:
        raise ValueError(
            f"the window of {end - start:.1f} s holds {max(samples, 0)} samples; a refit takes 2 to {MOST_SAMPLES}: "
            f"take a {'longer' if samples < 2 else 'shorter'} window or another sampling period"
        )
    params = params.replace(estimation__window=samples)
    return next(_due(flight, WindowSampler(params), start, end)).window, params


def raw_windows(
    flight: Flight, seconds: float, every: float, start: float = -math.inf, end: float = math.inf
) -> list[TimedWindow]:
    """Windows of raw motion capture of a flight, for the estimators that take them.

    A window spans ``seconds``; the next one comes ``every`` s later, and overlaps it when that is shorter. Only what
    lies between ``start`` and ``end``, in s since the start of the flight, is used, and of that what both bodies have.
    """
    bodies = flight.vehicle, flight.pendulum
    first = max(max(float(flight.time(body)[0]) for body in bodies), start)
    last, found = min(min(float(flight.time(body)[-1]) for body in bodies), end), []
    step = 0.5 / flight.params.piloting.mocap_rate  # of slack: a window holds the frame that begins it, not the next
    for number in range(math.floor((last - first - seconds + 3 * step) / every) + 1):
        begin = flight.start_ns + round((first + number * every - step) * NANO)
        window = RawWindow.between(flight, begin, begin + round(seconds * NANO))
        if all(len(body.stamp) for body in window):
            arrived = flight.vehicle.received[flight.vehicle.stamp == window.vehicle.stamp[-1]]
            found.append(TimedWindow(int(arrived[0]), window))
    return found


def raw_window_between(flight: Flight, start: float, end: float) -> RawWindow:
    """The window of raw motion capture of a stretch of flight. Raises ValueError if a body has no poses there."""
    window = RawWindow.between(flight, *(flight.start_ns + round(seconds * NANO) for seconds in (start, end)))
    if not all(len(body.stamp) for body in window):
        raise ValueError("needs poses of both bodies within the window")
    return window


def _due(
    flight: Flight, sampler: WindowSampler | RawSampler, start: float = -math.inf, end: float = math.inf
) -> Iterator[TimedWindow]:
    """Yield the windows that a sampler has ready at the commands between two times in s, fed as in flight."""
    command, known = _commands(flight, -math.inf), states(flight)
    at, latest = flight.time(command), np.searchsorted(known.stamp, command.stamp, side="right") - 1
    frames = measurements(flight)
    frame = next(frames, None)
    for index in np.flatnonzero((at >= start) & (at <= end) & (latest >= 0)):
        now, values = int(command.stamp[index]), command.values[index]
        while frame is not None and frame[0] <= now:
            sampler.push_frame(frame[1])
            frame = next(frames, None)
        sampler.push_command(now, known.values[latest[index]], values[:3], float(values[3]))
        if window := sampler.due(now):
            yield TimedWindow(now, window)


def _commands(flight: Flight, least: float | None) -> Series:
    """Return the commands of a flight. Raises BagError with the reason of ``why_not_refit``."""
    if (reason := why_not_refit(flight, least)) or flight.command is None:
        raise BagError(f"{flight.path}: {reason}")
    return flight.command
