"""A flight behind the failsafe: poses from a link to the guard, setpoints back, everything to a recorder.

The same loop flies in virtual time (``links.simulated.VirtualLink``, ``simulate.SimulatedEstimator``) and in real time.
"""

import gc
import math
from collections import deque
from collections.abc import Callable

import numpy as np

from fiplib.flight.display import View
from fiplib.flight.failsafe import Guard
from fiplib.flight.links import Link
from fiplib.flight.operator_input import OperatorInput
from fiplib.flight.setpoint import Mode, Setpoint
from fiplib.params import NANO
from fiplib.recording import Recorder
from fiplib.simulate import LengthUpdates, ParallelEstimator, Scenario


class Clockwork:
    """Measures how punctual the flight was. Times in s.

    ``late_ours`` counts ticks answered later than one tick after their frame had come, or whose frame was taken more
    than half a tick late after we had been busy for that long; ``late_machine`` those taken that late otherwise.
    """

    def __init__(self, tick: float) -> None:
        self.tick = tick
        self.solves: deque[float] = deque(maxlen=120)
        self.worst_solve = math.nan
        self.ticks = self.late_ours = self.late_machine = 0
        self._last: int | None = None
        self._busy = 0.0

    def busy(self, seconds: float) -> None:
        """Take how long we were busy between two frames, s."""
        self._busy = max(self._busy, seconds)

    def solved(self, frame: int, seconds: float) -> None:
        """A command that answers the frame that came at ``frame`` ns was on its way ``seconds`` later."""
        self.ticks += 1
        self.solves.append(seconds)
        self.worst_solve = max(seconds, self.worst_solve) if self.ticks > 1 else seconds
        late = (frame - self._last) / NANO - self.tick if self._last is not None else 0.0
        half = 0.5 * self.tick
        ours = seconds > self.tick or (late > half and self._busy > half)
        self.late_ours += ours
        self.late_machine += late > half and not ours
        self._last, self._busy = frame, 0.0


class FlightLoop:
    """One flight of a scenario through a link.

    Args:
        link: open.
        recorder: where to; poses are recorded from arming on, and only those that the guard accepted: a bag holds what
            the pilot was given.
        estimator: beside the flight, or ``None``.
        operator, view: for flights in real time.
        observer: called with the loop at the end of each step.

    Attributes:
        clockwork: how punctual the flight is.
        duration: how long it was flown, s; at most that of the scenario.
        balanced: whether it flew on until the scenario was over.
    """

    def __init__(
        self,
        scenario: Scenario,
        link: Link,
        guard: Guard,
        recorder: Recorder,
        estimator: ParallelEstimator | None = None,
        operator: OperatorInput | None = None,
        view: View | None = None,
        observer: "Callable[[FlightLoop], None] | None" = None,
    ) -> None:
        self._scenario, self._link, self.guard, self._recorder = scenario, link, guard, recorder
        self._estimator, self._operator, self._view = estimator, operator or OperatorInput(), view
        self._observer = observer
        self.clockwork = Clockwork(1.0 / scenario.params.piloting.control_rate)
        self.duration, self.balanced = 0.0, False
        self._lengths = LengthUpdates(scenario, estimator, guard.receive_estimate, recorder, self._say)
        self._seen_transitions = self._seen_notes = 0
        self._began: int | None = None
        self._stopping = False
        self._frames = self._recorded = self._drawn = 0  # frames received; ns of what was recorded and drawn last

    @property
    def flown(self) -> bool:
        """Return whether the vehicle was armed."""
        return self._began is not None

    def run(self) -> None:
        """Fly until the guard has ended the flight.

        The garbage collector is off meanwhile: it would free little, and cost ticks.
        """
        collecting = gc.isenabled()
        gc.collect()
        gc.disable()
        try:
            while self.guard.ended is None:
                self.step()
            last = self.guard.tick(self._link.now())
            self._link.send(last)
            self._record(last.stamp, last._replace(stamp=max(last.stamp, self._recorded + 1)))
            self._report(last.stamp)
            self._draw(last.stamp, last=True)
        finally:
            if collecting:
                gc.enable()
        self.duration = min(self._elapsed(self._link.now()), self._scenario.duration)

    def _elapsed(self, now: int) -> float:
        """Return the time since the flight began, s; 0 before."""
        return (now - self._began) / NANO if self._began is not None else 0.0

    def step(self) -> None:
        """Take one frame, or let one tick pass without."""
        guard, link = self.guard, self._link
        guard.arming.doubt = link.doubt()
        came = link.receive(self.clockwork.tick)
        began = link.now()  # in virtual time a solve takes none: the flight is the same every time
        setpoint = guard.frame(*came) if came is not None else guard.tick(link.now())
        if setpoint is not None:
            link.send(setpoint)
            seconds = (link.now() - began) / NANO
            if came is not None and setpoint.command is not None:
                guard.solve_took(came[0], seconds)
                self.clockwork.solved(came[0], seconds)
        now = came[0] if came is not None else link.now()
        self._frames += came is not None
        self._decide(now)
        # frames and lengths are recorded with the times that the pilot was given: with these a replay does the same
        at = now if guard.observed < 0 else guard.observed
        self._record(at, setpoint)
        if guard.mode not in (Mode.DISARMED, Mode.READY):
            self._lengths.update(at, self._elapsed(now) if self._began is not None else math.nan, guard.window_due())
        self._report(now)
        self._draw(now)
        self.clockwork.busy((link.now() - began) / NANO)
        if self._observer is not None:
            self._observer(self)

    def _decide(self, now: int) -> None:
        """Arm, or end the flight: the end of the scenario, the operator, a broken link."""
        guard, operator = self.guard, self._operator
        operator.look(guard.mode is Mode.READY)
        if operator.go and guard.mode in (Mode.DISARMED, Mode.READY):
            guard.arm(now)
        if self._began is None and guard.mode is Mode.FLYING:
            self._began = now
            self._recorder.length(now, guard.pilot.length, math.nan, math.nan)
            if self._link.truth is not None:
                self._recorder.numbers("truth_length", now, [self._scenario.params.pendulum.length])
        stop, disarm = operator.reason, operator.cut
        if fault := self._link.fault():
            stop, disarm = fault, True
        elif stop is None and self._elapsed(now) >= self._scenario.duration:
            stop = "end of the scenario"
            self.balanced = self.balanced or guard.mode is Mode.FLYING
        if stop is not None and (disarm or not self._stopping):
            self._stopping = True
            self._link.send(guard.abort(now, stop, disarm))

    def _record(self, now: int, setpoint: Setpoint | None) -> None:
        recorder, accepted = self._recorder, self.guard.accepted
        if self._began is None:
            return
        if accepted is not None:
            recorder.pose("vehicle", accepted.stamp, now, accepted.vehicle_position, accepted.vehicle_attitude)
            recorder.pose("pendulum", accepted.stamp, now, accepted.pendulum_position, accepted.pendulum_attitude)
            if self._link.truth is not None:
                recorder.numbers("truth_state", accepted.stamp, self._link.truth)
        if setpoint is None or setpoint.stamp <= self._recorded:
            return
        self._recorded = setpoint.stamp
        if setpoint.command is not None:
            recorder.numbers("state", setpoint.stamp, setpoint.command.state)
            recorder.numbers("reference", setpoint.stamp, setpoint.command.reference)
        # the message carries thrust in single precision
        recorder.command(setpoint.stamp, setpoint.body_rate, float(np.float32(setpoint.thrust)))

    def _report(self, now: int) -> None:
        """Put transitions, notes and what happened to the vehicle into the bag, and the former onto the terminal."""
        guard, recorder, events = self.guard, self._recorder, self._link.events
        while events:
            event = events.popleft()
            recorder.event(*event)
            if event.level != "info":
                self._say(event.text)
        for entry in guard.transitions[self._seen_transitions :]:
            recorder.event(entry.stamp, entry.level, entry.text, "mode", entry.data)
            self._say(entry.text)
        for note in guard.notes[self._seen_notes :]:
            recorder.event(note.stamp, note.level, note.text)
            self._say(note.text)
        self._seen_transitions, self._seen_notes = len(guard.transitions), len(guard.notes)

    def _say(self, text: str) -> None:
        if self._view is not None:
            self._view.say(text)

    def _draw(self, now: int, last: bool = False) -> None:
        if self._view is None or (now - self._drawn < NANO // 10 and not last):
            return
        self._drawn = now
        guard, clock, estimate = self.guard, self.clockwork, self._lengths.latest
        time, mode, words = "not armed", guard.mode.value, guard.ended or guard.arming.waiting
        if self._began is not None:
            time = f"{self._elapsed(now):.1f} of {self._scenario.duration:g} s"
            words = guard.ended or guard.transitions[-1].reason
        where = ", ".join(f"{value:+.2f}" for value in guard.monitor.vehicle_position)
        tilt, lean = (f"{math.degrees(angle):.1f} deg" for angle in (guard.tilt, guard.lean))
        found = "no estimate yet"
        if math.isfinite(estimate.length):
            found, two = f"estimate {estimate.length:.3f} m", 2.0 * estimate.standard_deviation
            if math.isfinite(two):
                found += f", two deviations {estimate.length - two:.3f} to {estimate.length + two:.3f} m"
            found += f", run took {self._estimator.seconds if self._estimator is not None else math.nan:.2f} s"
        length = f"length {guard.pilot.length:.3f} m"
        solve = f"solve {1e3 * (np.median(clock.solves) if clock.solves else math.nan):.2f} ms"
        lines = (
            f"{time}   {mode.upper()}   {words}",
            f"vehicle at ({where}) m, tilt {tilt}, rod leans {lean}",
            f"{length} in use, {found}",
            f"{solve}, worst {1e3 * clock.worst_solve:.2f} ms",
            f"ticks {clock.ticks}, late by us {clock.late_ours}, by poses or machine {clock.late_machine}",
            f"poses {self._frames}, refused {sum(guard.refused.values())}   {self._recorder.failed or ''}",
        )
        line = f"{time} {mode}: {words}, tilt {tilt}, rod {lean}, {length}, {solve}, late {clock.late_ours}"
        self._view.show(lines, line)
