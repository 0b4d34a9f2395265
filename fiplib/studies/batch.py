"""Simulated flights by the thousand: the flights of ``simulate.fly``, each in a few compiled calls.

A flight runs in compiled code (``kernels.flight``) from one event to the next: a length handed over, or the moment at
which the estimator could first answer. Plant, pilot, noise and estimator are those of ``simulate.fly``, and a test
holds the flights equal to the bit. Another vehicle than ``simulate.Plant`` cannot fly here; another controller than the
MPC flies, in ``simulate.fly`` itself.
"""

import math
from bisect import bisect_left
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from fiplib.estimators.windows import SAMPLERS
from fiplib.mpc import MPC, STATUSES, Status
from fiplib.observers import Observer
from fiplib.params import NANO
from fiplib.pilot import Pilot, estimator_of, least_period
from fiplib.recording import EPOCH, Event, Flight, Measurement, MemoryRecorder, flight_of
from fiplib.simulate import (
    LengthUpdates,
    Scenario,
    SimulatedEstimator,
    SimulatedVehicle,
    event_of_fall,
    event_of_status,
    fly,
)


def fly_many(scenarios: Iterable[Scenario]) -> Iterator[Flight]:
    """Fly scenarios one after the other; yields for each the flight that ``simulate.fly`` returns, to the bit."""
    return map(_fly, scenarios)


class _Times(NamedTuple):
    """Frames and control ticks of a flight: exposure and arrival of each frame in ns; the frame of each tick."""

    stamps: list[int]
    now: list[int]
    ticks: list[int]


def _fly(scenario: Scenario) -> Flight:
    if scenario.params.piloting.controller != "mpc":
        return fly(scenario)
    params, piloting, rate = scenario.params, scenario.params.piloting, scenario.params.piloting.mocap_rate
    times = _times(scenario)
    stamps, now, at = times
    count, latency = len(now), round(params.simulation.estimation_latency * NANO)
    flown = _Compiled(scenario, times)
    pilot, estimator, tape = (
        Pilot(params, scenario.reference),
        SimulatedEstimator(params, scenario.seed),
        MemoryRecorder(),
    )
    sampler = SAMPLERS[estimator_of(params).kind](params)

    def receive(_: int, length: float, deviation: float) -> float:
        if newest is not None and math.isfinite(length + deviation):
            flown.inform((newest - now[0]) / NANO, deviation)
        return pilot.receive_estimate(length, deviation)

    lengths = LengthUpdates(scenario, estimator, receive, tape)
    tape.numbers("truth_length", EPOCH, (params.pendulum.length,))
    tape.length(EPOCH, pilot.length, math.nan, math.nan)
    first, newest, fell = 0, None, False
    while first < count and not fell:
        # nothing new is known to the pilot before the frame `last`
        last = min(count, max(first, _first_at(lengths.prescribed_at, rate, count)) + 1)
        if piloting.estimate:
            last = min(last, max(first + 1, bisect_left(now, now[first] + latency)) + 1)
            if estimator.due is not None:
                last = min(last, max(first, bisect_left(now, estimator.due)) + 1)
        fell, last = flown.fly(first, last, pilot.length)
        for index in range(first if piloting.estimate else last - 1, last):
            window = None
            if piloting.estimate:
                frame, tick = flown.frames[index], flown.ticks[index]
                sampler.push_frame(Measurement(stamps[index], frame[:3], frame[3:7], frame[7:10], frame[10:]))
                if tick >= 0:
                    command, newest = flown.commands[tick], now[index]
                    sampler.push_command(newest, flown.states[tick], command[:3], float(command[3]))
                window = sampler.due(newest)
            lengths.update(now[index], index / rate, window)
        first = last

    # in the order in which simulate.fly records the events of a frame
    events = [(event.stamp, 1, event) for event in tape.events]
    events += [(event.stamp, 2, event) for event in flown.pushes if event.stamp <= now[first - 1]]
    if fell:
        events.append((now[first - 1], 3, event_of_fall(now[first - 1])))
    answered, before = bisect_left(at, first), Status.OPTIMAL
    for index, number in zip(at, flown.statuses[:answered].tolist(), strict=False):
        if (status := STATUSES[number & 3]) is not before:
            events.append((now[index], 0, event_of_status(now[index], status)))
        before = status
    given = np.array(now)[at[:answered]]
    series = {
        "vehicle": (stamps[:first], flown.frames[:first, :7]),
        "vehicle received": (now[:first], ()),
        "pendulum": (stamps[:first], flown.frames[:first, 7:]),
        "pendulum received": (now[:first], ()),
        "truth_state": (stamps[:first], flown.truths[:first]),
        "state": (given, flown.states[:answered]),
        "reference": (given, flown.references[:answered, 0]),
        "command": (given, flown.commands[:answered]),
    }
    recorded = [tape.stamps | {role: known for role, (known, _) in series.items()}]
    recorded.append(tape.values | {role: values for role, (_, values) in series.items()})
    in_order = [event for _, _, event in sorted(events, key=lambda entry: entry[:2])]
    return flight_of(scenario.name, scenario.metadata(), *recorded, in_order)


class _Compiled:
    """A flight's arrays, and the compiled loop over them: frames, truths, states, references, commands, statuses."""

    def __init__(self, scenario: Scenario, times: _Times) -> None:
        from fiplib.kernels import flight, piloting, vehicle

        params, at, count = scenario.params, np.array(times.ticks), len(times.now)
        simulated = SimulatedVehicle(scenario)
        plant, arrival = simulated.plant, np.array(times.now)
        disturbance = simulated.disturbance
        forces = np.zeros((count, disturbance.size))
        self.pushes: list[Event] = []
        for index in range(count) if scenario.pushes or disturbance.acts else ():
            force, push = simulated.pushes.at(index)
            forces[index] = disturbance.load(force)
            if push:
                self.pushes.append(push.event(times.now[index]))
        self.ticks = np.full(count, -1)
        self.ticks[at] = range(len(at))
        horizon = np.arange(params.control.nodes + 1) * params.control.step
        nodes = ((arrival[at] - arrival[0]) / NANO)[:, None] + horizon
        self._reference, self._nodes = scenario.reference, nodes
        self.references = np.ascontiguousarray(scenario.reference.at(nodes.ravel()).reshape(*nodes.shape, 10))
        schedule = np.tile(np.array([0.0, 0.0, 0.0, plant.x[19]]), (plant.substeps, 1))
        elapsed, tick_elapsed = (
            np.diff(known, prepend=known[0]) / NANO for known in (np.array(times.stamps), arrival[at])
        )
        acts = at * plant.substeps + plant.delay
        self.frames, self.truths = np.empty((count, 14)), np.empty((count, 11))
        self.states, self.commands = np.empty((len(at), 10)), np.empty((len(at), 4))
        self.statuses = np.zeros(len(at), dtype=np.int64)
        self._plant = (plant.x, vehicle.plant_constants(params), schedule, simulated.mocap(count).noise, forces)
        self._plan = (self.ticks, acts, elapsed, tick_elapsed, self.references)
        loops = piloting.pilot_constants(params, scenario.reference.height)
        observer = Observer(params)
        self._pilot = (observer.constants, observer.memory, loops, np.zeros(2))
        self._written = (self.frames, self.truths, self.states, self.commands, self.statuses)
        self._kernel, self._mpc = flight.fly, MPC(params)

    def inform(self, seconds: float, deviation: float) -> None:
        """Follow what the reference makes of it that the length is known, from the tick after ``seconds`` on."""
        if (informed := self._reference.informed(seconds, deviation)) is not self._reference:
            later = self._nodes[:, 0] > seconds
            nodes, self._reference = self._nodes[later], informed
            self.references[later] = informed.at(nodes.ravel()).reshape(*nodes.shape, 10)

    def fly(self, first: int, last: int, length: float) -> tuple[bool, int]:
        """Fly the frames ``first`` to ``last`` - 1 with a length in use, m; whether it fell, and the next frame."""
        answer = (*self._pilot, *self._mpc.prepared(length))
        reached = self._kernel(first, last, *self._plant, *self._plan, length, *answer, *self._written)
        if self.statuses.min(initial=0) < 0:
            raise ValueError("state must be finite")
        return reached < last, min(reached + 1, last)


def _times(scenario: Scenario) -> _Times:
    params, rate = scenario.params, scenario.params.piloting.mocap_rate
    stamps = [EPOCH + round(index * NANO / rate) for index in range(round(scenario.duration * rate))]
    now = [stamp + round(params.simulation.mocap_latency * NANO) for stamp in stamps]
    ticks = [0]
    for index, arrival in enumerate(now):
        if arrival - now[ticks[-1]] >= least_period(params.piloting):
            ticks.append(index)
    return _Times(stamps, now, ticks)


def _first_at(seconds: float, rate: float, count: int) -> int:
    """Return the first frame at or after a time in s; ``count``, if there is none before it."""
    return bisect_left(range(count), seconds, key=lambda index: index / rate)
