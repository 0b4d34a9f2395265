"""The failsafe around the pilot: an explicit state machine without clock, I/O or threads.

``Guard`` judges every frame before the pilot sees it, watches what the pilot answers, and says what to send. Setpoints
are finite and within bounds whatever comes in. Every transition is kept with its reason, for the bag.

    DISARMED -> READY        the arm checks have passed for ``arm_time``
    READY -> FLYING          armed by the operator
    FLYING -> COASTING       no good pose for ``pose_flag``, or a solve late or failed: the plan's next inputs
    COASTING -> HOVER_ONLY   the solver has not recovered within ``coast_ticks``: fixed gains
    any -> LEVEL             no good pose for ``pose_level``; rod fallen, fence, tilt, no solver, abort: down for good
    any -> DISARMED          no good pose for ``pose_disarm``; landed; levelled for ``level_time``: off for good

COASTING, HOVER_ONLY, and a LEVEL that only missing poses caused, go back to FLYING once their cause is gone. Simulated
only: none of this has flown on a vehicle.
"""

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from fiplib.dynamics import euler_angles
from fiplib.estimators.windows import RawWindow
from fiplib.flight.pose_monitor import PoseMonitor
from fiplib.flight.setpoint import Mode, Note, Setpoint, TiltPredictor, Transition, disarmed, levelling, weight
from fiplib.kalman import Window
from fiplib.mpc import Status
from fiplib.params import GRAVITY, NANO, STATES, Params, X, Y
from fiplib.pilot import Command, Pilot, Reference, Tick
from fiplib.recording import Measurement


class Guard:
    """The failsafe state machine around a ``Pilot``.

    Give it every frame (``frame``), call ``tick`` when none has come for a control tick, tell it how long it took
    (``solve_took``), and send what it answers. ``arm`` once. Times are int ns of one clock that never steps back.

    Args:
        params: all parameters; the limits are those of ``params.safety``.
        reference: the trajectory; its time starts with the first command.
        pilot: the controller; by default a ``Pilot`` for these.

    Attributes:
        pilot: the controller.
        mode: the state.
        transitions: every change of it so far.
        notes: what changed no state: doubtful clocks, refused estimates.
        ended: why the flight has ended for good, ``None`` before.
        waiting: what the arm checks wait for, before the flight.
        accepted: the last frame given to ``frame`` if it was good and in flight: what the pilot saw, and bags hold.
        refused: how many frames were refused, by reason.
        tilt, lean: of vehicle and rod from the vertical at the newest good frame, rad; nan before the first.
        solver_failure: what the solver failed with last, ``None`` if it never did.
    """

    def __init__(self, params: Params, reference: Reference, pilot: Pilot | None = None) -> None:
        self.params, self.pilot = params, pilot or Pilot(params, reference)
        self.mode = Mode.DISARMED
        self.transitions: list[Transition] = []
        self.notes: list[Note] = []
        self.ended: str | None = None
        self.waiting = "no poses yet"
        self.accepted: Measurement | None = None
        self.refused: dict[str, int] = {}
        self.tilt = self.lean = math.nan
        self.solver_failure: str | None = None
        self._check = PoseMonitor(params)
        self._tilt = TiltPredictor(params.safety.loop_delay)
        self._tick_ns = round(NANO / params.piloting.control_rate)
        self._start = reference.at(np.zeros(1))[0, [X, Y]]
        self._wanted = False
        self._final = False
        self._now = 0
        self._entered = 0
        self._steady_since: int | None = None
        self._arrivals: deque[int] = deque()
        self._good = 0
        self._reach = 0.0
        self._failures = 0
        self._late = 0
        self._tried = False
        self._plan: tuple[int, NDArray] | None = None
        self._place: NDArray | None = None
        self._hovering_since: int | None = None
        self._retry = 0
        self._last = disarmed(0)
        self._estimated = 0
        self._silent = False
        self._far = 0

    # --- what its driver calls

    def arm(self, now: int) -> None:
        """The operator's word: fly as soon as the arm checks pass."""
        self._wanted = True

    def frame(self, now: int, measurement: Measurement) -> Setpoint | None:
        """Take a frame that arrived at ``now`` ns; what to send, or ``None`` between control ticks."""
        now = self._at(now)
        self.accepted = None
        if self.ended is not None:
            return self._between(now)
        good = self._check.take(now, measurement)
        for remark in self._check.remarks:
            self.notes.append(Note(now, "warn", remark))
        self._check.remarks.clear()
        if good is None:
            self._refuse(now, self._check.refusal or "")
            return self._between(now)
        self._good += 1
        rod = good.pendulum_position - good.vehicle_position
        self.tilt, self.lean = _lean(_up(good.vehicle_attitude)), _lean(rod)
        if not self._armed:
            self._prepare(now, good)
            if not self._armed:
                return self._between(now)
        self.accepted = good
        roll, pitch, _ = euler_angles(good.vehicle_attitude)
        self._tilt.see(good.stamp, (roll, pitch))
        self._limits(now, good)
        if self.ended is not None:
            return self._between(now)
        self._ages(now)
        if self.ended is not None:
            return self._between(now)
        # when frames come late and many at once, the newest must be answered: each counts as of when it was due
        overdue = round(self._check.age(now) * NANO)
        try:
            tick = self.pilot.observe(now - overdue if overdue > self._tick_ns else now, good)
        except Exception as error:  # a flight must outlive a bug
            failure = f"{type(error).__name__}: {error}"
            return self._levelled(now) if self.mode is Mode.LEVEL else self._without_solution(now, None, failure)
        if self.mode is Mode.LEVEL and not self._final and self._good >= self.params.safety.recovery_frames:
            if self._check.age(now) < self.params.safety.pose_flag:
                self._go(now, Mode.FLYING, "poses are back")
                self._hovering_since = None
                self.pilot.forget_window()
        if tick is None:
            return None
        return self._levelled(now) if self.mode is Mode.LEVEL else self._controlled(now, tick)

    def tick(self, now: int) -> Setpoint:
        """Time passes without a frame; what to send."""
        self.accepted = None
        return self._tick(self._at(now))

    def solve_took(self, now: int, seconds: float) -> None:
        """How long the driver waited for the last setpoint that carries a command; judges whether it came late."""
        tried, self._tried = self._tried, False
        if not tried:
            return
        if seconds <= self.params.safety.solve_limit:
            self._late = 0
            return
        self._late += 1
        if self.mode in (Mode.FLYING, Mode.COASTING):
            now = self._at(now)
            reason = f"solve took {1e3 * seconds:.0f} ms"
            if self._late <= self.params.safety.coast_ticks:
                self._go(now, Mode.COASTING, reason)
            else:
                self._hover(now, f"{reason}, the {self._late}th late one in a row")

    def abort(self, now: int, reason: str, disarm: bool = False) -> Setpoint:
        """Level and descend, or disarm at once, for good; what to send."""
        now = self._at(now)
        if self.ended is None:
            if disarm or not self._armed:
                self._end(now, reason)
            else:
                self._give_up(now, reason)
        return self.tick(now)

    def receive_estimate(self, now: int, length: float, deviation: float = math.nan) -> float:
        """Judge an estimate and hand it to the pilot.

        Args:
            now: ns.
            length: m; not finite or outside [l_min, l_max] it is refused. One that is further than ``estimate_jump``
                from the length in use is refused too, unless it is the third such in a row: then it is approached.
            deviation: its standard deviation, m; nan if it has none.

        Returns:
            The length in use from now on, m.
        """
        now = self._at(now)
        self._estimated, self._silent = now, False
        estimation, used, jump = self.params.estimation, self.pilot.length, self.params.safety.estimate_jump
        slack = estimation.resolution
        if not (estimation.length_min - slack <= length <= estimation.length_max + slack) or deviation < 0.0:
            self.notes.append(Note(now, "warn", f"absurd estimate refused: {length:g} m +- {deviation:g} m"))
            return used
        if abs(length - used) > jump + slack:
            self._far += 1
            if self._far < 3:
                self.notes.append(Note(now, "warn", f"estimate refused: {length:.3g} m after {used:.3g} m is a jump"))
                return used
            length = used + math.copysign(jump, length - used)
            self.notes.append(Note(now, "warn", f"three estimates far away: length approached, {length:.3g} m"))
        self._far = 0
        try:
            return self.pilot.receive_estimate(float(length), float(deviation))
        except Exception as error:  # a flight must outlive a bug
            self.notes.append(Note(now, "error", f"estimate not taken over ({type(error).__name__}: {error})"))
            return self.pilot.length

    def window_due(self) -> Window | RawWindow | None:
        """As ``Pilot.window_due``, while the pilot flies."""
        if self.mode is not Mode.FLYING:
            return None
        try:
            return self.pilot.window_due()
        except Exception as error:  # a flight must outlive a bug
            self.notes.append(Note(self._now, "error", f"no window ({type(error).__name__}: {error})"))
            return None

    @property
    def position(self) -> tuple[float, float, float]:
        """Of the vehicle at the newest good frame, m; nan before the first."""
        x, y, z = self._check.vehicle_position
        return x, y, z

    # --- before the flight

    @property
    def _armed(self) -> bool:
        return self.mode not in (Mode.DISARMED, Mode.READY)

    def _prepare(self, now: int, good: Measurement) -> None:
        """Arm checks."""
        safety, rate = self.params.safety, self.params.piloting.mocap_rate
        self._arrivals.append(now)
        while now - self._arrivals[0] > safety.arm_time * NANO:
            self._arrivals.popleft()
        self._steady_since = now if self._steady_since is None else self._steady_since
        if reason := self._why_not_arm(good):
            self._unready(now, reason)
            return
        if now - self._steady_since < safety.arm_time * NANO:
            self.waiting = "arm checks under way"
            return
        if len(self._arrivals) < safety.arm_rate * safety.arm_time * rate:
            reason = f"{len(self._arrivals) / safety.arm_time:.0f} good frames/s of {rate:.0f}"
            since = self._steady_since
            self._unready(now, reason)
            self._steady_since = since
            return
        self.waiting = ""
        if self.mode is Mode.DISARMED:
            self._go(now, Mode.READY, "arm checks passed")
        if self._wanted:
            self._check.learning = False
            self._reach = math.dist(good.pendulum_position, good.vehicle_position)
            self._go(now, Mode.FLYING, "armed")
            self._estimated = now + round(self.pilot.window_seconds * NANO)

    def _unready(self, now: int, reason: str) -> None:
        self.waiting, self._steady_since = reason, None
        if self.mode is Mode.READY:
            self._go(now, Mode.DISARMED, reason)

    def _why_not_arm(self, good: Measurement) -> str | None:
        safety, estimation = self.params.safety, self.params.estimation
        rod = good.pendulum_position - good.vehicle_position
        reach, lean, tilt = float(np.linalg.norm(rod)), self.lean, self.tilt
        if not 0.5 * estimation.length_min <= reach <= 0.5 * estimation.length_max + 0.1:
            return f"pendulum not placed: its COM is {reach:.2f} m from the vehicle"
        if rod[2] < 0.0:
            return "pendulum below the vehicle: bodies swapped, or not placed"
        if lean > safety.arm_lean:
            return f"pendulum leans {math.degrees(lean):.0f} deg"
        if _angle(rod, _up(good.pendulum_attitude)) > safety.seat_tolerance:
            return "pendulum's axis does not point from the vehicle to its COM: wrong body or wrong axes"
        if tilt > safety.arm_tilt:
            return f"vehicle tilts {math.degrees(tilt):.0f} deg"
        if reason := self._outside(good):
            return reason
        away = math.dist(good.vehicle_position[:2], self._start)
        if away > safety.arm_distance:
            return f"vehicle is {away:.2f} m from where the trajectory starts"
        speed = float(np.sqrt((self._check.velocity**2).sum(1)).max())
        if speed > safety.arm_speed:
            return f"vehicle or pendulum moves at {speed:.2f} m/s"
        return None

    # --- in flight

    def _outside(self, good: Measurement) -> str | None:
        x, y, z = good.vehicle_position
        far_x, far_y, ceiling = self.params.safety.fence
        if abs(x) > far_x or abs(y) > far_y or z > ceiling:
            return f"outside the fence at ({x:.2f}, {y:.2f}, {z:.2f}) m"
        if z < self.params.safety.floor:
            return f"below the floor of {self.params.safety.floor:g} m"
        return None

    def _limits(self, now: int, good: Measurement) -> None:
        """What gives the flight up at once: rod fallen or off its seat, tilt, fence."""
        if self._final:
            if good.vehicle_position[2] < self.params.safety.floor:
                self._end(now, "landed")
            return
        safety = self.params.safety
        rod = good.pendulum_position - good.vehicle_position
        lean, tilt = self.lean, self.tilt
        if lean > safety.fallen_lean:
            self._give_up(now, f"pendulum fallen: it leans {math.degrees(lean):.0f} deg")
        elif abs(math.sqrt(rod @ rod) - self._reach) > safety.seat_play:
            self._give_up(now, f"pendulum off its seat: COM at {math.sqrt(rod @ rod):.2f} m, not {self._reach:.2f} m")
        elif tilt > safety.max_tilt:
            self._give_up(now, f"vehicle tilts {math.degrees(tilt):.0f} deg")
        elif reason := self._outside(good):
            self._give_up(now, reason)

    def _ages(self, now: int) -> None:
        """What the age of poses and the time in a mode demand."""
        safety, age = self.params.safety, self._check.age(now)
        if not self._armed:
            if age >= safety.pose_flag and math.isfinite(age):
                self._unready(now, self._aged(age))
            return
        if self.params.piloting.estimate and not self._silent:
            if (now - self._estimated) / NANO > safety.estimate_silence:
                self._silent = True
                text = f"estimator silent for {safety.estimate_silence:g} s: {self.pilot.length:.3g} m stays in use"
                self.notes.append(Note(now, "warn", text))
        if age >= safety.pose_disarm:
            self._end(now, self._aged(age))
        elif self.mode is Mode.LEVEL:
            if (now - self._entered) / NANO > safety.level_time:
                self._end(now, f"levelled for {safety.level_time:g} s")
        elif age >= safety.pose_level:
            self._go(now, Mode.LEVEL, self._aged(age))
            self._good = 0
        elif age >= safety.pose_flag:
            if self.mode is not Mode.COASTING:
                self._go(now, Mode.COASTING, self._aged(age))
        elif self._hovering_since is not None and (now - self._hovering_since) / NANO > safety.hover_time:
            self._give_up(now, f"no solver for {safety.hover_time:g} s ({self.solver_failure})")

    def _aged(self, age: float) -> str:
        cause = f" ({self._check.refusal})" if self._check.refusal else ""
        return f"pose {1e3 * age:.0f} ms old{cause}"

    def _refuse(self, now: int, reason: str) -> None:
        self.refused[reason] = self.refused.get(reason, 0) + 1
        self._good = 0
        if not self._armed and self.mode is Mode.DISARMED:
            self.waiting = reason

    def _controlled(self, now: int, tick: Tick) -> Setpoint:
        """The answer at a control tick with a good frame."""
        if self._hovering_since is not None and now < self._retry:
            if self.mode is Mode.COASTING:
                self._go(now, Mode.HOVER_ONLY, "poses are back")
            return self._without_solution(now, tick, None)
        self._tried = True
        try:
            solution = self.pilot.solve(tick)
            failure = "no solution" if solution.status is Status.FAILED else None
            if not np.isfinite(solution.inputs).all():
                failure = "solution not finite"
        except Exception as error:  # whatever a solver raises must not end the flight
            failure = f"{type(error).__name__}: {error}"
        if failure is not None:
            return self._without_solution(now, tick, failure)
        fresh = self._check.age(now) < self.params.safety.pose_flag
        if self.mode in (Mode.COASTING, Mode.HOVER_ONLY) and fresh:
            self._go(now, Mode.FLYING, "solved" if self._failures or self._late else "poses are back")
        self._failures, self._hovering_since = 0, None
        self._plan = (now, solution.inputs)
        return self._commanded(now, tick, solution.input, solution.status)

    def _without_solution(self, now: int, tick: Tick | None, failure: str | None) -> Setpoint:
        """A control tick without a solver's answer: the plan's next inputs for a few ticks, then fixed gains."""
        if failure is not None:
            self.solver_failure = failure
            self._failures += 1
            if self._failures <= self.params.safety.coast_ticks and self._plan and self._hovering_since is None:
                if self.mode is not Mode.COASTING:
                    self._go(now, Mode.COASTING, f"solve failed ({failure})")
            elif self._hovering_since is None:
                self._hover(now, f"solve failed {self._failures} times in a row ({failure})")
            self._retry = now + round(self.params.safety.solver_retry * NANO)
        if tick is None:
            return self._coasted(now)
        if self._hovering_since is None:
            return self._commanded(now, tick, self._planned(now), Status.FAILED)
        if self._place is None:
            self._place = np.zeros(len(STATES))
            self._place[[X, Y]] = tick.state[[X, Y]]
        return self._commanded(now, tick, self.pilot.hold(tick, self._place), Status.FAILED)

    def _hover(self, now: int, reason: str) -> None:
        self._go(now, Mode.HOVER_ONLY, reason)
        self._hovering_since, self._place = now, None
        self._retry = now + round(self.params.safety.solver_retry * NANO)
        self.solver_failure = reason

    def _planned(self, now: int) -> NDArray:
        """The plan's input (2,) for this moment; none (the tilt is held) once the plan is too old to be believed."""
        since, inputs = self._plan or (0, np.zeros((1, 2)))
        if (now - since) / NANO > 2.0 * self.params.safety.pose_level:
            return np.zeros(2)
        node = int((now - since) / NANO / self.params.control.step)
        return inputs[max(0, min(len(inputs) - 1, node))]

    def _commanded(self, now: int, tick: Tick, rates: NDArray, status: Status) -> Setpoint:
        command = self.pilot.answer(tick, rates, status)
        return self._setpoint(now, command.body_rate, command.thrust, command)

    def _coasted(self, now: int) -> Setpoint:
        return self._setpoint(now, np.array([*self._planned(now), 0.0]), self._last.thrust)

    def _levelled(self, now: int) -> Setpoint:
        """Level by the expected tilt; descend at a given speed while poses are good, else a little under the weight."""
        open_loop = levelling(self.params, now, self._tilt.at(now))
        thrust = open_loop.thrust
        if self._check.age(now) < self.params.safety.pose_flag:
            safety = self.params.safety
            climb = safety.descent_gain * (-safety.descent - float(self._check.velocity[0, 2]))
            upright = max(0.7, math.cos(open_loop.tilt[0]) * math.cos(open_loop.tilt[1]))
            share = max(0.5, min(1.2, 1.0 + climb / GRAVITY)) / upright
            thrust = share * weight(self.params) / self.params.vehicle.max_thrust
        return self._setpoint(now, open_loop.body_rate, thrust)

    # --- the last step

    def _setpoint(self, now: int, body_rate: NDArray, thrust: float, command: Command | None = None) -> Setpoint:
        """The setpoint of an armed mode: finite and within bounds, whatever was asked for."""
        if not (np.isfinite(body_rate).all() and math.isfinite(thrust)):
            self.notes.append(Note(now, "error", "a command was not finite: levelled instead"))
            return self._keep(levelling(self.params, now, self._tilt.at(now))._replace(mode=self.mode))
        limit = self.params.vehicle.max_body_rate
        rates, thrust = np.clip(body_rate, -limit, limit), max(0.0, min(self.params.safety.max_thrust, thrust))
        self._tilt.send(now, rates)
        return self._keep(Setpoint(now, True, self.mode, rates, thrust, command, self._tilt.at(now)))

    def _keep(self, setpoint: Setpoint) -> Setpoint:
        self._last = setpoint
        return setpoint

    def _tick(self, now: int) -> Setpoint:
        self._ages(now)
        if not self._armed:
            return self._keep(disarmed(now))
        if self.mode is Mode.LEVEL:
            return self._levelled(now)
        if self.mode is Mode.COASTING:
            return self._coasted(now)
        return self._last

    def _between(self, now: int) -> Setpoint | None:
        """As ``tick``, but at the control rate (frames come more often), and without repeating a setpoint."""
        if now - self._last.stamp < self._tick_ns - self._tick_ns // 4:
            self._ages(now)
            return None
        before, setpoint = self._last, self._tick(now)
        return None if setpoint is before else setpoint

    def _at(self, now: int) -> int:
        """Time never runs backwards here, whatever a clock does."""
        self._now = max(self._now, int(now))
        return self._now

    def _go(self, now: int, mode: Mode, reason: str) -> None:
        if mode is not self.mode:
            self.transitions.append(Transition(now, self.mode, mode, reason))
            self.mode, self._entered = mode, now

    def _give_up(self, now: int, reason: str) -> None:
        """Level and descend for good."""
        if not self._final:
            self._final = True
            if self.mode is Mode.LEVEL:
                self.transitions.append(Transition(now, self.mode, Mode.LEVEL, reason))
            self._go(now, Mode.LEVEL, reason)

    def _end(self, now: int, reason: str) -> None:
        """Disarm for good."""
        if self.ended is None:
            self.ended = reason
            if self.mode is Mode.DISARMED:
                self.transitions.append(Transition(now, self.mode, Mode.DISARMED, reason))
            self._go(now, Mode.DISARMED, reason)
            if self.refused:
                counts = ", ".join(f"{count} {cause}" for cause, count in self.refused.items())
                self.notes.append(Note(now, "info", f"frames refused in all: {counts}"))


def _up(attitude: NDArray) -> NDArray:
    """The body's z axis in the world, (3,), of a unit quaternion (x, y, z, w)."""
    x, y, z, w = attitude
    return np.array((2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)))


def _lean(direction: NDArray) -> float:
    """Angle from the vertical, rad."""
    x, y, z = (float(value) for value in direction)
    return math.atan2(math.hypot(x, y), z)


def _angle(one: NDArray, other: NDArray) -> float:
    norms = math.sqrt(float(one @ one) * float(other @ other))
    return math.acos(max(-1.0, min(1.0, float(one @ other) / norms))) if norms > 0.0 else math.pi
