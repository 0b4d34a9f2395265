"""The failsafe around the pilot: an explicit state machine without clock, I/O or threads.

``Guard`` judges every frame before the pilot sees it, supervises what the pilot answers, and chooses what to send.
Setpoints are finite and within bounds whatever comes in. The state machine is the table ``transitions.TRANSITIONS``.
Simulated only: none of this has flown on a vehicle.
"""

import math
from numbers import Real

import numpy as np
from numpy.typing import NDArray

from fiplib.dynamics import body_z_of, euler_angles, inclination
from fiplib.estimators.windows import RawWindow
from fiplib.flight.arming import ArmChecks, outside, rod_of
from fiplib.flight.length_gate import LengthGate
from fiplib.flight.limits import Limits
from fiplib.flight.pose_monitor import PoseMonitor
from fiplib.flight.setpoint import Mode, Setpoint, TiltPredictor, disarmed, levelling, weight
from fiplib.flight.solver_watch import SolverWatch
from fiplib.flight.transitions import Condition, Transition, by_mode
from fiplib.kalman import Window
from fiplib.mpc import Status
from fiplib.params import GRAVITY, NANO, X, Y
from fiplib.pilot import Command, Pilot, Tick
from fiplib.recording import Event, Measurement, nanoseconds

NEXT = by_mode()


class Guard:
    """The failsafe state machine around a ``Pilot``.

    Give it every frame (``frame``), call ``tick`` when none has come for a control tick, report how long it took
    (``solve_took``), and send what it answers. ``arm`` once. Times are int ns of one clock that never steps back.

    Args:
        pilot: the controller, new.
        limits: of poses, rod, vehicle and solver: ``safety``.

    Attributes:
        mode: the state.
        monitor, arming, solver: of the poses, the arm checks and the solves.
        transitions: every change of it so far.
        notes: remarks that changed no mode: doubtful clocks, refused estimates.
        ended: why the flight has ended, ``None`` before.
        landed: whether it ended on the ground, below ``safety.floor``.
        accepted: the last frame given to ``frame`` if it was good and in flight: what the pilot saw, and bags hold.
        observed: when the pilot takes it to have arrived, ns; one that comes late counts as of when it was due.
        refused: how many frames were refused, by reason.
        tilt, lean: of vehicle and rod from the vertical at the newest good frame, rad; nan before the first.
    """

    def __init__(self, pilot: Pilot, limits: Limits = Limits()) -> None:  # noqa: B008 - frozen
        if not isinstance(pilot, Pilot) or not isinstance(limits, Limits):
            raise ValueError(f"a Guard takes a Pilot and Limits, not {type(pilot).__name__}, {type(limits).__name__}")
        self.params, self.limits, self.pilot = pilot.params, limits, pilot
        self.mode = Mode.DISARMED
        self.transitions: list[Transition] = []
        self.notes: list[Event] = []
        self.ended: str | None = None
        self.landed = False
        self.accepted: Measurement | None = None
        self.observed = -1
        self.refused: dict[str, int] = {}
        self.tilt = self.lean = math.nan
        self.monitor = PoseMonitor(self.params, limits)
        self.arming = ArmChecks(self.params, limits, pilot.reference.at(np.zeros(1))[0, [X, Y]])
        self.solver = SolverWatch(self.params, limits)
        self._lengths = LengthGate(self.params, limits)
        self._tilt = TiltPredictor(limits.safety.loop_delay)
        self._tick_ns = round(NANO / self.params.piloting.control_rate)
        self._wanted = False  # armed by the operator
        self._given_up = False  # a final transition has happened
        self._now = self._entered = 0  # the newest time, and that of the last change of mode
        self._good = 0  # good frames in a row
        self._reach = 0.0  # from the seat to the rod's COM
        self._last = disarmed(0)

    # --- what its driver calls

    def arm(self, now: int) -> None:
        """Arm: fly as soon as the arm checks pass."""
        self._at(now)
        self._wanted = True

    def frame(self, now: int, measurement: Measurement) -> Setpoint | None:
        """Take a frame that arrived at ``now`` ns; returns what to send, or ``None`` between control ticks."""
        now = self._at(now)
        self.accepted = None
        if self.ended is not None:
            return self._between(now)
        good = self.monitor.take(now, measurement, self._tilt.shown if self._given_up else None)
        self.notes += [Event(now, "warn", remark) for remark in self.monitor.remarks]
        self.monitor.remarks.clear()
        if good is None:
            self._refuse(self.monitor.refusal or "")
            return self._between(now)
        self._good += 1
        rod = rod_of(good, self.params)
        self.tilt, self.lean = inclination(body_z_of(good.vehicle_attitude)), inclination(rod)
        if not self._armed and not self._prepared(now, good):
            return self._between(now)
        self.accepted = good
        roll, pitch, _ = euler_angles(good.vehicle_attitude)
        self._tilt.see(self.monitor.exposed(good.stamp), (roll, pitch))
        self._check_limits(now, good)
        self._check_ages(now)
        if self.ended is not None:
            return self._between(now)
        # when frames come late and many at once, the newest must be answered: each counts as of when it was due
        overdue = round(self.monitor.age(now) * NANO)
        self.observed = max(self.observed + 1, now - overdue if overdue > self._tick_ns else now)
        try:
            tick = self.pilot.observe(self.observed, good)
        except Exception as error:  # a flight must outlive a bug
            failure = f"{type(error).__name__}: {error}"
            return self._levelled(now) if self.mode is Mode.LEVEL else self._without_solution(now, None, failure)
        if self._good >= self.limits.safety.recovery_frames and self._fresh(now):
            if self._happens(now, Condition.POSES_BACK, "poses are back"):
                self.solver.hovering_since = None  # the solver is tried at once
                self.pilot.forget_window()
        if tick is None:
            return None
        return self._levelled(now) if self.mode is Mode.LEVEL else self._controlled(now, tick)

    def tick(self, now: int) -> Setpoint:
        """Let time pass without a frame; returns what to send."""
        self.accepted = None
        return self._tick(self._at(now))

    def solve_took(self, now: int, seconds: float) -> None:
        """Take how long the driver waited for the last setpoint that carries a command; judges whether it was late."""
        now = self._at(now)
        if not isinstance(seconds, Real) or not 0.0 <= seconds < math.inf:
            raise ValueError(f"a solve takes so many seconds, 0 or more, not {seconds!r}")
        late = self.solver.took(seconds)
        if late and self.mode in (Mode.FLYING, Mode.COASTING):
            reason = f"solve took {1e3 * seconds:.0f} ms"
            if late <= self.limits.safety.coast_ticks:
                self._happens(now, Condition.SOLVE_FAILED, reason)
            else:
                self._hover(now, f"{reason}, the {late}th late one in a row")

    def abort(self, now: int, reason: str, disarm: bool = False) -> Setpoint:
        """End the flight: level and descend, or disarm at once; returns what to send."""
        now = self._at(now)
        if not isinstance(reason, str) or not reason:
            raise ValueError(f"an abort has a reason, in words, not {reason!r}")
        self._happens(now, Condition.STOPPED if disarm or not self._armed else Condition.ABORTED, reason)
        return self.tick(now)

    def receive_estimate(self, now: int, length: float, deviation: float = math.nan) -> float:
        """Judge an estimate at ``now`` ns as ``LengthGate.judge`` does, and hand it to the pilot.

        Returns:
            The length in use from now on, m.
        """
        now = self._at(now)
        self._lengths.heard(now)
        usable, remark = self._lengths.judge(length, deviation, self.pilot.length)
        if remark is not None:
            self.notes.append(Event(now, "warn", remark))
        if usable is None:
            return self.pilot.length
        try:
            return self.pilot.receive_estimate(usable, float(deviation))
        except Exception as error:  # a flight must outlive a bug
            self.notes.append(Event(now, "error", f"estimate not taken over ({type(error).__name__}: {error})"))
            return self.pilot.length

    def window_due(self) -> Window | RawWindow | None:
        """Return the estimator's window as ``Pilot.window_due`` does, while the pilot flies."""
        if self.mode is not Mode.FLYING:
            return None
        try:
            return self.pilot.window_due()
        except Exception as error:  # a flight must outlive a bug
            self.notes.append(Event(self._now, "error", f"no window ({type(error).__name__}: {error})"))
            return None

    # --- the conditions

    @property
    def _armed(self) -> bool:
        return self.mode not in (Mode.DISARMED, Mode.READY)

    def _fresh(self, now: int) -> bool:
        return self.monitor.age(now) < self.limits.safety.pose_flag

    def _prepared(self, now: int, good: Measurement) -> bool:
        """Apply the arm checks; returns whether this is the first frame of the flight."""
        speed = float(np.sqrt((self.monitor.velocity**2).sum(1)).max())
        steady = self.monitor.trusted
        if not steady:  # in flight nothing can stand in for the stamps of a clock that has stepped back
            self.arming.failed("stamps are out of order, or their clock has stepped")
        if not steady or not self.arming.passed(now, good, self.lean, self.tilt, speed):
            self._happens(now, Condition.CHECKS_FAILED, self.arming.waiting)
            return False
        self._happens(now, Condition.CHECKS_PASSED, "arm checks passed")
        if not self._wanted:
            return False
        self.monitor.learning = False
        self._reach = float(np.linalg.norm(rod_of(good, self.params)))
        self._lengths.heard(now + round(self.pilot.window_seconds * NANO))
        return self._happens(now, Condition.ARMED, "armed")

    def _check_limits(self, now: int, good: Measurement) -> None:
        """Apply the limits of rod and vehicle; given up, look whether the vehicle has landed."""
        safety = self.limits.safety
        if self._given_up:
            if good.vehicle_position[2] < safety.floor:
                self._happens(now, Condition.LANDED, "landed")
            return
        reach = float(np.linalg.norm(rod_of(good, self.params)))
        if self.lean > safety.fallen_lean:
            self._happens(now, Condition.ROD_FALLEN, f"pendulum fallen: it leans {math.degrees(self.lean):.0f} deg")
        elif abs(reach - self._reach) > safety.seat_play:
            reason = f"pendulum off its seat: COM at {reach:.2f} m, not {self._reach:.2f} m"
            self._happens(now, Condition.ROD_OFF_SEAT, reason)
        elif self.tilt > safety.max_tilt:
            self._happens(now, Condition.TILTED, f"vehicle tilts {math.degrees(self.tilt):.0f} deg")
        elif away := outside(good, safety):
            self._happens(now, Condition.OUTSIDE, away)

    def _check_ages(self, now: int) -> None:
        """Apply the timeouts: the age of the newest good pose, and the time in a mode."""
        safety, age = self.limits.safety, self.monitor.age(now)
        if self.ended is not None:
            return
        if not self._armed:
            if age >= safety.pose_flag and math.isfinite(age):
                self.arming.failed(self._aged(age))
                self._happens(now, Condition.CHECKS_FAILED, self.arming.waiting)
            return
        if self._lengths.falls_silent(now):
            text = f"estimator silent for {safety.estimate_silence:g} s: {self.pilot.length:.3g} m stays in use"
            self.notes.append(Event(now, "warn", text))
        if age >= safety.pose_disarm:
            self._happens(now, Condition.POSE_LOST, self._aged(age))
        elif self.mode is Mode.LEVEL:
            if (now - self._entered) / NANO > safety.level_time:
                self._happens(now, Condition.LEVELLED, f"levelled for {safety.level_time:g} s")
        elif age >= safety.pose_level:
            self._happens(now, Condition.POSE_MISSING, self._aged(age))
            self._good = 0
        elif age >= safety.pose_flag:
            self._happens(now, Condition.POSE_LATE, self._aged(age))
        elif self.solver.hovered(now) > safety.hover_time:
            self._happens(now, Condition.NO_SOLVER, f"no solver for {safety.hover_time:g} s ({self.solver.failure})")

    def _aged(self, age: float) -> str:
        return f"pose {1e3 * age:.0f} ms old" + (f" ({self.monitor.refusal})" if self.monitor.refusal else "")

    def _refuse(self, reason: str) -> None:
        self.refused[reason] = self.refused.get(reason, 0) + 1
        self._good = 0
        if self.mode is Mode.DISARMED:
            self.arming.waiting = reason

    def _happens(self, now: int, condition: Condition, reason: str) -> bool:
        """Make the transition that a condition leads to; returns whether there is one."""
        row = NEXT.get((self.mode, condition))
        if row is None or self.ended is not None or (self._given_up and row.after is not Mode.DISARMED):
            return False
        self.transitions.append(Transition(now, self.mode, row.after, row.level, reason))
        if row.after is not self.mode:
            self.mode, self._entered = row.after, now
        self._given_up = self._given_up or row.final
        if row.final and row.after is Mode.DISARMED:
            self.ended, self.landed = reason, condition is Condition.LANDED
            if self.refused:
                counts = ", ".join(f"{count} {cause}" for cause, count in self.refused.items())
                self.notes.append(Event(now, "info", f"frames refused in all: {counts}"))
        return True

    # --- the answers

    def _controlled(self, now: int, tick: Tick) -> Setpoint:
        """Answer a control tick with a good frame."""
        if self.solver.waits(now):
            self._happens(now, Condition.SOLVER_AWAITED, "poses are back")
            return self._without_solution(now, tick, None)
        self.solver.tries()
        try:
            solution = self.pilot.solve(tick)
            failure = "no solution" if solution.status is Status.FAILED else None
            if np.shape(solution.input) != (2,) or np.shape(solution.inputs)[1:] != (2,) or not len(solution.inputs):
                failure = "solution not of two body rates"
            elif not (np.isfinite(solution.input).all() and np.isfinite(solution.inputs).all()):
                failure = "solution not finite"
        except Exception as error:  # whatever a solver raises must not end the flight
            failure = f"{type(error).__name__}: {error}"
        if failure is not None:
            return self._without_solution(now, tick, failure)
        if self._fresh(now):
            self._happens(now, Condition.SOLVED, "solved" if self.solver.troubled else "poses are back")
        self.solver.solved(now, solution.inputs)
        return self._commanded(now, tick, solution.input, solution.status)

    def _without_solution(self, now: int, tick: Tick | None, failure: str | None) -> Setpoint:
        """Answer a control tick without a solution: the plan's next inputs for a few ticks, then fixed gains."""
        solver = self.solver
        if failure is not None:
            given_up = solver.failed(now, failure)
            if solver.hovering_since is None and given_up is None:
                self._happens(now, Condition.SOLVE_FAILED, f"solve failed ({failure})")
            elif solver.hovering_since is None:
                self._hover(now, given_up)
        if tick is None:
            return self._coasted(now)
        if solver.hovering_since is None:
            return self._commanded(now, tick, solver.planned(now))
        return self._commanded(now, tick, self.pilot.hold(tick, solver.place(tick.state)))

    def _hover(self, now: int, reason: str) -> None:
        self._happens(now, Condition.SOLVER_FAILED, reason)
        self.solver.hover(now, reason)

    def _commanded(self, now: int, tick: Tick, rates: NDArray, status: Status = Status.FAILED) -> Setpoint:
        command = self.pilot.answer(tick, rates, status)
        return self._setpoint(now, command.body_rate, command.thrust, command)

    def _coasted(self, now: int) -> Setpoint:
        return self._setpoint(now, np.array([*self.solver.planned(now), 0.0]), self._last.thrust)

    def _levelled(self, now: int) -> Setpoint:
        """Level by the expected tilt; descend at a given speed while poses are good, else a little under the weight."""
        open_loop = levelling(self.params, self.limits, now, self._tilt.at(now))
        thrust = open_loop.thrust
        if self._fresh(now):
            safety = self.limits.safety
            climb = safety.descent_gain * (-safety.descent - float(self.monitor.velocity[0, 2]))
            upright = max(0.7, math.cos(open_loop.tilt[0]) * math.cos(open_loop.tilt[1]))
            share = max(0.5, min(1.2, 1.0 + climb / GRAVITY)) / upright
            thrust = share * weight(self.params) / self.params.vehicle.max_thrust
        return self._setpoint(now, open_loop.body_rate, thrust)

    def _setpoint(self, now: int, body_rate: NDArray, thrust: float, command: Command | None = None) -> Setpoint:
        """Make the setpoint of an armed mode: finite and within bounds, whatever was asked for."""
        if not (np.isfinite(body_rate).all() and math.isfinite(thrust)):
            self.notes.append(Event(now, "error", "a command was not finite: levelled instead"))
            level = levelling(self.params, self.limits, now, self._tilt.at(now))
            self._last = level._replace(mode=self.mode)
            return self._last
        limit = self.params.vehicle.max_body_rate
        rates, thrust = np.clip(body_rate, -limit, limit), max(0.0, min(self.limits.safety.max_thrust, thrust))
        self._tilt.send(now, rates)
        self._last = Setpoint(now, True, self.mode, rates, thrust, command, self._tilt.at(now))
        return self._last

    def _tick(self, now: int) -> Setpoint:
        self._check_ages(now)
        if not self._armed:
            self._last = disarmed(now)
        elif self.mode is Mode.LEVEL:
            self._levelled(now)
        elif self.mode is Mode.COASTING:
            self._coasted(now)
        return self._last

    def _between(self, now: int) -> Setpoint | None:
        """Do as ``tick``, but at the control rate (frames come more often), and without repeating a setpoint."""
        if now - self._last.stamp < self._tick_ns - self._tick_ns // 4:
            self._check_ages(now)
            return None
        before, setpoint = self._last, self._tick(now)
        return None if setpoint is before else setpoint

    def _at(self, now: int) -> int:
        """Time never runs backwards here, whatever a clock does."""
        self._now = max(self._now, nanoseconds(now))
        return self._now
