"""A flight behind the failsafe: poses from a link to the guard, setpoints back, everything to a recorder.

The same loop flies in virtual time (``links.sim.VirtualLink``, ``simulate.SimulatedEstimator``) and in real time.
"""

import gc
import math
from collections import deque
from typing import NamedTuple, Protocol

import numpy as np

from fiplib.estimators.base import Estimate
from fiplib.estimators.windows import RawWindow
from fiplib.flight.display import Snapshot, View
from fiplib.flight.failsafe import Guard
from fiplib.flight.links import Link
from fiplib.flight.operator import Operator
from fiplib.flight.setpoint import Mode, Setpoint
from fiplib.kalman import Window
from fiplib.params import NANO
from fiplib.recording import Recorder
from fiplib.simulate import Scenario


class Beside(Protocol):
    """An estimator beside the flight: ``estimator_process.EstimatorProcess`` or the simulator's."""

    def deliver(self, now: int, window: Window | RawWindow | None) -> Estimate | None: ...


class Outcome(NamedTuple):
    """How a flight ended: seconds flown, and whether it flew on until the scenario was over."""

    duration: float
    survived: bool


class Clockwork:
    """How punctual the flight was. Times in s.

    ``late_ours`` counts ticks that were answered later than one tick after their frame had come, or whose frame was
    taken more than half a tick late after we had been busy for that long; ``late_machine`` those whose frame was taken
    that late for other reasons (poses missing or late, the machine busy with something else).
    """

    def __init__(self, tick: float) -> None:
        self.tick = tick
        self.solves: deque[float] = deque(maxlen=120)
        self.worst_solve = math.nan
        self.ticks = self.late_ours = self.late_machine = 0
        self.lateness: list[float] = []
        self.answers: list[float] = []
        self._last: int | None = None
        self._busy = 0.0

    def busy(self, seconds: float) -> None:
        """How long we were busy between two frames."""
        self._busy = max(self._busy, seconds)

    def solved(self, frame: int, seconds: float) -> None:
        """A command that answers the frame that came at ``frame`` ns was on its way ``seconds`` later."""
        self.ticks += 1
        self.solves.append(seconds)
        self.worst_solve = max(seconds, self.worst_solve) if self.ticks > 1 else seconds
        late = (frame - self._last) / NANO - self.tick if self._last is not None else 0.0
        self.lateness.append(late)
        self.answers.append(seconds)
        half = 0.5 * self.tick
        ours = seconds > self.tick or (late > half and self._busy > half)
        self.late_ours += ours
        self.late_machine += late > half and not ours
        self._last, self._busy = frame, 0.0


class FlightLoop:
    """One flight of a scenario through a link.

    Args:
        link: open.
        guard: the failsafe with its pilot.
        recorder: where to; poses are recorded from arming on, and only those that the guard accepted: a bag holds what
            the pilot was given.
        estimator: beside the flight, or ``None``.
        operator, view: for flights in real time.
    """

    def __init__(
        self,
        scenario: Scenario,
        link: Link,
        guard: Guard,
        recorder: Recorder,
        estimator: Beside | None = None,
        operator: Operator | None = None,
        view: View | None = None,
    ) -> None:
        self._scenario, self._link, self.guard, self._recorder = scenario, link, guard, recorder
        self._estimator, self._operator, self._view = estimator, operator or Operator(), view
        self.clockwork = Clockwork(1.0 / scenario.params.piloting.control_rate)
        self._told = deque(scenario.told_lengths)
        self._seen_transitions = self._seen_notes = 0
        self._began: int | None = None
        self._survived = self._stopping = False
        self._frames = 0
        self._recorded = 0
        self._estimate: Estimate | None = None
        self._refusal: str | None = None
        self._drawn = 0

    def run(self) -> Outcome:
        """Fly until the guard has disarmed for good; how it ended.

        The garbage collector rests meanwhile: what it would find is little, and it would cost ticks.
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
        flown = (self._link.now() - self._began) / NANO if self._began is not None else 0.0
        return Outcome(min(flown, self._scenario.duration), self._survived)

    def step(self) -> None:
        """One frame, or one tick without."""
        guard, link = self.guard, self._link
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
        self._record(now, setpoint)
        if guard.mode not in (Mode.DISARMED, Mode.READY):
            self._estimated(now)
        self._report(now)
        self._draw(now)
        self.clockwork.busy((link.now() - began) / NANO)

    def _decide(self, now: int) -> None:
        """Arming, the end of the scenario, the operator, a broken link."""
        guard, operator = self.guard, self._operator
        operator.look(guard.mode is Mode.READY)
        if operator.go and guard.mode in (Mode.DISARMED, Mode.READY):
            guard.arm(now)
        if self._began is None and guard.mode is Mode.FLYING:
            self._began = now
            self._recorder.length(now, guard.pilot.length, math.nan, math.nan)
            if hasattr(self._link, "truth"):  # over ROS, say, the link does not know it
                self._recorder.truth_length(now, self._scenario.params.pendulum.length)
        stop, disarm = operator.reason, operator.cut
        if fault := self._link.fault():
            stop, disarm = fault, True
        elif stop is None and self._began is not None and (now - self._began) / NANO >= self._scenario.duration:
            stop = "end of the scenario"
            self._survived = self._survived or guard.mode is Mode.FLYING
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
            truth = getattr(self._link, "truth", None)
            if truth is not None:
                recorder.truth(accepted.stamp, truth)
        if setpoint is None or setpoint.stamp <= self._recorded:
            return
        self._recorded = setpoint.stamp
        if setpoint.command is not None:
            recorder.state(setpoint.stamp, setpoint.command.state)
            recorder.reference(setpoint.stamp, setpoint.command.reference)
        # the message carries thrust in single precision
        recorder.command(setpoint.stamp, setpoint.body_rate, float(np.float32(setpoint.thrust)))

    def _estimated(self, now: int) -> None:
        guard, recorder = self.guard, self._recorder
        if self._told and self._began is not None and (now - self._began) / NANO >= self._told[0][0]:
            length = self._told.popleft()[1]
            recorder.event(now, "warn", f"pilot is told the length {length:g} m")
            recorder.length(now, guard.receive_estimate(now, length), length, math.nan)
        if self._estimator is None:
            return
        estimate = self._estimator.deliver(now, guard.window_due())
        remarks = getattr(self._estimator, "remarks", [])
        while remarks:  # one at a time: another thread may add to them
            level, text = remarks.pop(0)
            recorder.event(now, level, text)
            self._say(text)
        if estimate is None:
            return
        if estimate.reason is None:
            used = guard.receive_estimate(now, estimate.length, estimate.standard_deviation)
            recorder.length(now, used, estimate.length, estimate.standard_deviation)
            self._estimate = estimate
        elif estimate.reason != self._refusal:
            recorder.event(now, "warn", f"no estimate: {estimate.reason}")
        self._refusal = estimate.reason

    def _report(self, now: int) -> None:
        """Transitions and notes into the bag and onto the terminal."""
        guard = self.guard
        for entry in guard.transitions[self._seen_transitions :]:
            self._recorder.event(entry.stamp, entry.level, entry.text)
            self._say(entry.text)
        for note in guard.notes[self._seen_notes :]:
            self._recorder.event(note.stamp, note.level, note.text)
            self._say(note.text)
        self._seen_transitions, self._seen_notes = len(guard.transitions), len(guard.notes)

    def _say(self, text: str) -> None:
        if self._view is not None:
            self._view.say(text)

    def _draw(self, now: int, last: bool = False) -> None:
        if self._view is None or (now - self._drawn < NANO // 10 and not last):
            return
        self._drawn = now
        guard, clockwork = self.guard, self.clockwork
        estimate = self._estimate or Estimate(math.nan, math.nan)
        self._view.show(
            Snapshot(
                time=(now - self._began) / NANO if self._began is not None else math.nan,
                duration=self._scenario.duration,
                mode=guard.mode.value,
                words=guard.ended or (guard.waiting if self._began is None else guard.transitions[-1].reason),
                position=guard.position,
                tilt=guard.tilt,
                lean=guard.lean,
                length=guard.pilot.length,
                estimate=estimate.length,
                deviation=estimate.standard_deviation,
                run=getattr(self._estimator, "seconds", math.nan),
                solve=float(np.median(clockwork.solves)) if clockwork.solves else math.nan,
                worst_solve=clockwork.worst_solve,
                ticks=clockwork.ticks,
                late_ours=clockwork.late_ours,
                late_machine=clockwork.late_machine,
                frames=self._frames,
                refused=sum(guard.refused.values()),
                recording=getattr(self._recorder, "failed", None) or "",
            )
        )
