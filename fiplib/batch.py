"""Simulated flights by the thousand: the flights of ``simulate.fly``, each in a few compiled calls.

A flight runs in compiled code (``kernels.fly``) from one event to the next: a length handed over, or the moment at
which the estimator could first answer. Plant, pilot, noise and estimator are those of ``simulate.fly``, and a test
holds the records equal to the bit. Another vehicle than ``simulate.Plant`` cannot fly here.
"""

import math
from bisect import bisect_left
from collections import deque
from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from fiplib.estimators.windows import SAMPLERS, RawSchedule
from fiplib.mpc import MPC, STATUSES, Status
from fiplib.params import NANO, Params
from fiplib.pilot import Pilot, estimator_of
from fiplib.recording import EPOCH, Measurement, MemoryRecorder
from fiplib.simulate import Outcome, Plant, Push, Scenario, SimulatedEstimator


def fly_many(scenarios: Iterable[Scenario]) -> Iterator[tuple[MemoryRecorder, Outcome]]:
    """Fly scenarios one after the other; yields what ``simulate.fly`` records and returns for each."""
    for scenario in scenarios:
        yield fly(scenario)


def fly(scenario: Scenario) -> tuple[MemoryRecorder, Outcome]:
    """Fly one scenario: what ``simulate.fly`` records in memory and returns, to the bit."""
    from fiplib import kernels

    params, reference, seed = scenario.params, scenario.reference, scenario.seed
    piloting, simulation, rate = params.piloting, params.simulation, params.piloting.mocap_rate
    count = round(scenario.duration * rate)
    rng = np.random.default_rng(seed)  # drawn from in the order of simulate.fly
    start = reference.at(np.zeros(1))[0]
    lean = rng.normal(size=2) * simulation.initial_lean
    x = Plant(params, (start[0], start[2], reference.height), lean).x
    noise = rng.normal(size=(count, 12)) * np.repeat([simulation.position_noise, simulation.attitude_noise], 6)
    forces, events = _forces(scenario.pushes, count, rate)

    stamps = [EPOCH + round(index * NANO / rate) for index in range(count)]
    now = [stamp + round(simulation.mocap_latency * NANO) for stamp in stamps]
    at = _control_ticks(now, params)
    ticks = np.full(count, -1)
    ticks[at] = range(len(at))
    arrival = np.array(now)
    elapsed, tick_elapsed = (np.diff(times, prepend=times[0]) / NANO for times in (np.array(stamps), arrival[at]))
    horizon = np.arange(params.control.nodes + 1) * params.control.step
    nodes = ((arrival[at] - arrival[0]) / NANO)[:, None] + horizon
    references = np.ascontiguousarray(reference.at(nodes.ravel()).reshape(*nodes.shape, 10))
    substeps = round(simulation.plant_rate / rate)
    delay = round((simulation.mocap_latency + simulation.rate_delay) * simulation.plant_rate)
    schedule = np.tile(np.array([0.0, 0.0, 0.0, x[19]]), (substeps, 1))
    plan = (schedule, noise, forces, ticks, np.array(at) * substeps + delay, elapsed, tick_elapsed, references)

    about, about_pilot = kernels.plant_constants(params), kernels.pilot_constants(params, reference.height)
    memory, integrals = np.zeros(10), np.zeros(2)
    frames, truths = np.empty((count, 14)), np.empty((count, 11))
    states, commands, statuses = np.empty((len(at), 10)), np.empty((len(at), 4)), np.zeros(len(at), dtype=np.int64)
    written = (frames, truths, states, commands, statuses)

    pilot, mpc, estimator = Pilot(params, reference), MPC(params), SimulatedEstimator(params, seed)
    sampler = SAMPLERS[estimator_of(params).kind](params)
    told = deque(scenario.told_lengths)
    latency, refused, fell = round(simulation.estimation_latency * NANO), None, False
    newest: int | None = None
    lengths = [(EPOCH, pilot.length, math.nan, math.nan)]
    first = 0
    while first < count and not fell:
        last = count
        if told:
            last = min(last, max(first, _first_at(told[0][0], rate)) + 1)
        if piloting.estimate:  # no answer to what happens from now on comes before this
            last = min(last, max(first + 1, bisect_left(now, now[first] + latency)) + 1)
            if estimator.due is not None:
                last = min(last, max(first, bisect_left(now, estimator.due)) + 1)
        used = 0.0 if piloting.pendulum_measurement == "position" else pilot.length
        answer = (used, piloting.velocity_cutoff, memory, about_pilot, integrals, *mpc.prepared(pilot.length))
        reached = kernels.fly(first, last, x, about, *plan, *answer, *written)
        fell, last = reached < last, min(reached + 1, last)
        for index in range(first, last) if piloting.estimate else ():
            tick = ticks[index]
            if isinstance(sampler, RawSchedule):
                sampler.push_frame(_measurement(stamps[index], frames[index]))
                if tick >= 0:
                    sampler.push_command(now[index], commands[tick, :3], float(commands[tick, 3]))
            elif tick >= 0:
                sampler.push(states[tick], commands[tick, :2])
            newest = now[index] if tick >= 0 else newest
            if estimate := estimator.deliver(now[index], sampler.due(newest)):
                if estimate.reason is None:
                    used = pilot.receive_estimate(estimate.length, estimate.standard_deviation)
                    lengths.append((now[index], used, estimate.length, estimate.standard_deviation))
                elif estimate.reason != refused:
                    events.append((index, 1, "warn", f"no estimate: {estimate.reason}"))
                refused = estimate.reason
        if told and (last - 1) / rate >= told[0][0]:
            length = told.popleft()[1]
            events.append((last - 1, 2, "warn", f"pilot is told the length {length:g} m"))
            lengths.append((now[last - 1], pilot.receive_estimate(length), length, math.nan))
        first = last

    if fell:
        events.append((first - 1, 4, "error", "rod or vehicle fell: flight ended"))
    before = Status.OPTIMAL
    for tick, index in enumerate(at[: bisect_left(at, first)]):
        if (status := STATUSES[statuses[tick] & 3]) is not before:
            events.append((index, 0, "info", f"MPC status {status.value}"))
        before = status
    recorder = MemoryRecorder()
    recorder.truth_length(EPOCH, params.pendulum.length)
    for length in lengths:
        recorder.length(*length)
    for index, _, level, text in sorted(event for event in events if event[0] < first):
        recorder.event(now[index], level, text)
    flown, answered = slice(0, first), slice(0, bisect_left(at, first))
    topics = {
        "vehicle": (stamps[flown], frames[flown, :7]),
        "pendulum": (stamps[flown], frames[flown, 7:]),
        "truth_state": (stamps[flown], truths[flown]),
        "state": (arrival[at][answered].tolist(), states[answered]),
        "reference": (arrival[at][answered].tolist(), references[answered, 0]),
        "command": (arrival[at][answered].tolist(), commands[answered]),
    }
    for topic, (times, values) in topics.items():
        recorder.stamps[topic], recorder.values[topic] = times, list(map(tuple, values.tolist()))
    for body in ("vehicle", "pendulum"):
        recorder.stamps[f"{body} received"] = now[flown]
    return recorder, Outcome((first - 1) / rate, False) if fell else Outcome(scenario.duration, True)


def _forces(pushes: Iterable[Push], count: int, rate: float) -> tuple[NDArray, list[tuple[int, int, str, str]]]:
    """Force on the rod's COM at each frame, (count, 3) in N, and pushes as (frame, order within it, level, text)."""
    forces, events, waiting = np.zeros((count, 3)), [], deque(pushes)
    for index in range(count):
        seconds = index / rate
        if waiting and seconds >= waiting[0].start:
            push = waiting[0]
            if seconds < push.start + 1 / rate:
                text = f"push of {1e3 * math.hypot(*push.impulse):g} mN s on the rod's COM"
                events.append((index, 3, "info", text))
            forces[index, :2] = np.array(push.impulse) / push.duration
            if seconds >= push.start + push.duration - 1 / rate:
                waiting.popleft()
    return forces, events


def _control_ticks(now: list[int], params: Params) -> list[int]:
    """The frames at which ``Pilot.step`` answers, of their arrivals in ns."""
    piloting, ticks = params.piloting, [0]
    least = round(NANO / piloting.control_rate) - round(NANO / piloting.mocap_rate / 2)
    for index, arrival in enumerate(now):
        if arrival - now[ticks[-1]] >= least:
            ticks.append(index)
    return ticks


def _first_at(seconds: float, rate: float) -> int:
    """The first frame at or after a time in s."""
    index = max(0, int(seconds * rate) - 1)
    while index / rate < seconds:
        index += 1
    return index


def _measurement(stamp: int, frame: NDArray) -> Measurement:
    return Measurement(stamp, frame[:3], frame[3:7], frame[7:10], frame[10:])
