"""Faults of poses, solver, estimate, way and operator: flights in virtual time, the same rows every time."""

import functools
import math
import tempfile
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fiplib import bags
from fiplib.estimators.base import Estimate
from fiplib.flight.failsafe import Guard
from fiplib.flight.limits import Limits, recorded
from fiplib.flight.links.simulated import VirtualLink
from fiplib.flight.loop import FlightLoop
from fiplib.flight.operator_input import OperatorInput
from fiplib.flight.sender import PATIENCE, DeadMan
from fiplib.flight.setpoint import Mode, Setpoint, disarmed
from fiplib.mpc import Solution
from fiplib.params import NANO, Params
from fiplib.pilot import Pilot, Tick
from fiplib.recording import EPOCH, Measurement
from fiplib.references import Circle, Hover
from fiplib.simulate import Push, Scenario, SimulatedEstimator
from fiplib.studies.faults import injection as inject
from fiplib.studies.faults import judging
from fiplib.studies.faults.injection import Change, EstimateFault, FrameFault, SolverFault
from fiplib.studies.faults.judging import Commands, Fault
from fiplib.studies.faults.perfect_information import NEVER, balances

LIMITS = Limits()
"""Limits of the failsafe and the command sender, in every flight."""
START = 2.0
"""Faults in flight begin at this time after take-off, s."""
POSES = "the limit of 100 ms without poses"
GONE = "the limit of 500 ms without poses"
OLD = "the rule that poses with old stamps are not used"
HOVER = Scenario("fault", "hover, pushed 3.2 s after the fault", 6.5, Hover(), (Push(START + 3.2, (0.004, 0.0)),))
PUSHED = replace(HOVER, pushes=(Push(START + 0.02, (0.006, -0.003)),), description="hover, pushed during the fault")
CIRCLE = replace(HOVER, reference=Circle(0.8, 9.0, start=0.2, ramp=1.5), pushes=(), description="circle of 0.8 m")
SHORT = replace(HOVER, duration=3.0, pushes=(Push(1.5, (0.004, 0.0)),), description="hover, pushed after 1.5 s")
UNKNOWN = Params().replace(piloting__initial_length=1.2, piloting__estimate=True)
ESTIMATED = Scenario("fault", "circle of 0.4 m, length estimated from 1.2 m", 10.0, Circle(0.4, 8.0), params=UNKNOWN)
PRESCRIBED = replace(CIRCLE, params=Params().replace(estimation__median_length=1))
"""The circle on which the pilot is given a length, without the median of its estimates."""


class Phase(NamedTuple):
    """A part of a flight in which faults begin, at each of the ``starts`` in a flight of its own.

    Starts are s after take-off, or with ``grounded`` s after the first frame.
    """

    scenario: Scenario
    starts: tuple[float, ...]
    grounded: bool = False


PHASES = {
    "arming": Phase(SHORT, (0.3,), grounded=True),
    "hover": Phase(HOVER, (START,)),
    "circle": Phase(CIRCLE, (START,)),
    # the rod falls between 0.5 and 2 s after it is given up, at the end of the scenario
    "landing": Phase(replace(CIRCLE, duration=1.0), (1.1, 1.8, 2.3)),
}
"""The phases of a flight, in its order; the checks before arming take 0.5 s."""
EVERYWHERE, AIRBORNE, HOVERING, CIRCLING = tuple(PHASES), ("hover", "circle"), ("hover",), ("circle",)
PATIENT = 6.0
"""The operator waits so long for a vehicle to become ready, and then leaves it, s."""


@dataclass(frozen=True)
class VirtualFault(Fault):
    """A fault that is injected into simulated flights in virtual time, one for each start of a phase.

    Attributes:
        phases: in which it is injected.
        scenario: a flight of its own instead of the phase's.
        frames: makes the fault of motion capture anew for each flight, from its start in s and a generator.
        solver, estimates: the fault of the solver, for so many ``calls`` of it; of the estimates.
        aborts: how long after the start the operator asks to land, and again for motors off, s.
        blind, deaf: for how long no usable pose arrives; no command gets through, s.
    """

    phases: tuple[str, ...] = EVERYWHERE
    scenario: Scenario | None = None
    frames: Callable[[float, np.random.Generator], FrameFault] | None = None
    solver: SolverFault | None = None
    calls: float = math.inf
    estimates: EstimateFault | None = None
    aborts: tuple[float, ...] = ()
    blind: float = 0.0
    deaf: float = 0.0

    def fly(self, phase: str) -> dict[str, Any]:
        rows = [self.flown(phase, start) for start in PHASES[phase].starts]
        return max(rows, key=lambda row: (judging.severity(row["verdict"]), float(row["largest_tilt_deg"])))

    def flown(self, phase: str, start: float) -> dict[str, Any]:
        """Inject it at one time; return the row of that flight."""
        scenario, error = self.scenario or PHASES[phase].scenario, ""
        params = scenario.params
        link = FaultyLink(scenario, self, phase, start)
        guard = Guard(FaultyPilot(link), LIMITS)
        estimator = FaultyEstimator(link) if params.piloting.estimate else None
        with tempfile.TemporaryDirectory() as folder:
            bag = Path(folder) / "bag"
            with bags.BagRecorder(bag, {**scenario.metadata(), "params": recorded(params, LIMITS)}) as recorder:
                flight = FlightLoop(scenario, link, guard, recorder, estimator, Operator(link))
                try:
                    flight.run()
                except Exception as raised:
                    error = f"{type(raised).__name__}: {raised}"
                link.leave()
            if not any(setpoint.armed for _, setpoint in link.sent):
                return self._grounded(link, guard, error)
            return self._judged(link, guard, error, judging.read_back(bag)[0])

    def _grounded(self, link: "FaultyLink", guard: Guard, error: str) -> dict[str, Any]:
        """Return the row of a flight that has not begun."""
        commands = Commands.of(link.sent, link.scenario.params, LIMITS)
        safe = not error and commands.not_finite == commands.out_of_bounds == link.kept_back == 0
        return self.row(
            vehicle=judging.NOT_ARMED,
            ended=guard.arming.waiting,
            largest_tilt_deg="0.0",
            commands=commands.count,
            not_finite=commands.not_finite,
            out_of_bounds=commands.out_of_bounds + link.kept_back,
            uncaught_exception=error or "no",
            verdict="met: not armed" if safe else judging.UNSAFE,
        )

    def _judged(self, link: "FaultyLink", guard: Guard, error: str, bag: str) -> dict[str, Any]:
        scenario, params = link.scenario, link.scenario.params
        took_off = next(now for now, setpoint in link.sent if setpoint.armed)
        commands = Commands.of([entry for entry in link.sent if entry[0] >= took_off], params, LIMITS)
        path = [entry for entry in guard.transitions if entry.stamp > took_off]
        ended = next((entry for entry in path if entry.reason == "end of the scenario"), None)
        levelled = next((entry for entry in reversed(path) if entry.before is not Mode.LEVEL), None)
        last = ended or levelled
        final = last.stamp if last else link.sent[-1][0]
        offsets = np.abs([truth[[4, 6]] for now, truth in link.truths if took_off <= now <= final])
        fallen = (np.hypot(*offsets.T) > 0.5 * params.pendulum.length * math.sin(math.radians(60.0))).any()
        balanced = ended is not None and ended.before is not Mode.LEVEL and not fallen
        off = commands.disarming[0] if len(commands.disarming) else math.inf
        stopped = next((truth for now, truth in link.truths if now >= off), link.truths[-1][1])
        tilt = max(judging.tilt_of(truth) for now, truth in link.truths if took_off <= now <= off)
        perfect, gaps = yardstick(scenario, link.blind, link.deaf, dict(link.sent) if link.deaf != NEVER else None)
        safe = not error and commands.safe and link.kept_back == 0 and bag == "valid"
        landing = link.phase == "landing"
        level = judging.tilt_of(stopped) < judging.LEVEL
        level = level and tilt < (judging.DANGER if landing else judging.ON_ITS_SIDE)
        verdict = judging.judge(safe, balanced, level, perfect, gaps, self.demanded)
        if landing:
            low = stopped[10] - judging.SEAT < judging.LOW
            verdict = judging.judge_landing(safe, level, low, guard.ended or "", link.deaf != NEVER, self.demanded)
        reason = guard.ended if landing else levelled.reason if levelled and not balanced else ""
        until = math.inf if landing or ended is None else ended.stamp
        return self.row(
            modes=judging.modes_of([entry.after for entry in path if entry.stamp < until]),
            vehicle=judging.BALANCED if balanced and not landing else judging.given_up(stopped),
            ended=reason or "",
            largest_a_cm=f"{100 * offsets[:, 0].max():.1f}",
            largest_b_cm=f"{100 * offsets[:, 1].max():.1f}",
            largest_tilt_deg=f"{math.degrees(tilt):.1f}",
            commands=commands.count,
            not_finite=commands.not_finite,
            out_of_bounds=commands.out_of_bounds + link.kept_back,
            longest_gap_ms=f"{commands.longest_gap:.1f}",
            disarm_frames=len(commands.disarming),
            disarm_s=f"{commands.disarm_seconds:.2f}",
            uncaught_exception=error or "no",
            bag=bag,
            perfect_information=judging.BALANCED if perfect else "rod lost",
            exact_with_same_gaps="" if gaps is None else judging.BALANCED if gaps else "rod lost",
            verdict=verdict,
        )


def yardstick(
    scenario: Scenario, blind: tuple[float, float], deaf: tuple[float, float], sent: Mapping[int, Setpoint] | None
) -> tuple[bool, bool | None]:
    """Return whether perfect information keeps the rod, and with the same gaps; ``None`` where there are none."""
    perfect = keeps(scenario)
    if sent is not None:
        return perfect, balances(scenario, blind, deaf, sent)
    return perfect, None if blind == NEVER else keeps(scenario, blind)


@functools.cache
def keeps(scenario: Scenario, blind: tuple[float, float] = NEVER) -> bool:
    """Return ``balances`` of a scenario, flown once."""
    return balances(scenario, blind)


class FaultyLink(VirtualLink):
    """The simulated vehicle behind damaged poses, with the sender's rules in virtual time on the way out.

    ``sent``: (time in ns, setpoint) of all that left the sender; ``truths``: (time in ns, true state (11,)) a frame.
    """

    def __init__(self, scenario: Scenario, fault: VirtualFault, phase: str, start: float) -> None:
        super().__init__(scenario)
        self.scenario, self.injected, self.phase, self.start = scenario, fault, phase, start
        self._grounded = PHASES[phase].grounded
        self._damage = fault.frames(start, np.random.default_rng(scenario.seed + 100)) if fault.frames else None
        self._deaf = (start, start + fault.deaf)
        self._arrived: deque[Measurement] = deque()
        self._period = NANO / LIMITS.safety.send_rate
        self._man, self._due = DeadMan(scenario.params, LIMITS), math.inf
        self.sent: list[tuple[int, Setpoint]] = []
        self.truths: list[tuple[int, NDArray]] = []

    @property
    def blind(self) -> tuple[float, float]:
        """(start, end) in s after take-off between which no usable pose arrives."""
        return self._gap(self.injected.blind)

    @property
    def deaf(self) -> tuple[float, float]:
        """(start, end) in s after take-off between which no command gets through."""
        return self._gap(self.injected.deaf)

    def _gap(self, seconds: float) -> tuple[float, float]:
        return NEVER if self._grounded or not seconds else (self.start, self.start + seconds)

    @property
    def seconds(self) -> float:
        """s since the first frame."""
        return (len(self.truths) - 1) / self.vehicle.rate

    @property
    def at(self) -> float:
        """The time of the phase, s: since the first frame on the ground, else since take-off, and -1 before that."""
        if self._grounded:
            return self.seconds
        return -1.0 if self.vehicle.flown is None else self.vehicle.flown / self.vehicle.rate

    @property
    def kept_back(self) -> int:
        """Setpoints that the sender refused or cut to bounds: the failsafe must never make one."""
        return self._man.rejected + self._man.clamped

    def receive(self, timeout: float) -> tuple[int, Measurement] | None:
        left = math.ceil(timeout * self.vehicle.rate - 1e-6)
        while not self._arrived:
            if left == 0:
                return None
            left -= 1
            self._frame()
        return self.now(), self._arrived.popleft()

    def elapse(self, seconds: float) -> None:
        """Let time pass while the pilot is busy: frames queue, the sender goes on."""
        for _ in range(round(seconds * self.vehicle.rate)):
            self._frame()

    def send(self, setpoint: Setpoint) -> None:
        self._man.hear(self.now(), setpoint)
        self._out()
        self._due = self.now() + round(PATIENCE * self._period)

    def fault(self) -> str | None:
        return self._man.fault

    def leave(self) -> None:
        """End as ``sender.Sender.close`` does."""
        self._man.hear(self.now(), disarmed(self.now()))
        self.elapse(LIMITS.safety.leave_time)

    def _frame(self) -> None:
        came = super().receive(0.0)
        assert came is not None and self.truth is not None
        self.truths.append((self.now(), self.truth))
        self._arrived.extend(self._damage(self.at, came[1]) if self._damage and self.at >= 0.0 else [came[1]])
        if self.now() >= self._due:
            self._due += round(self._period)
            self._out()

    def _out(self) -> None:
        setpoint = self._man.due(self.now())
        self.sent.append((self.now(), setpoint))
        if not self._deaf[0] <= self.at < self._deaf[1]:
            super().send(setpoint)


class FaultyPilot(Pilot):
    """The pilot with a faulty solver."""

    def __init__(self, link: FaultyLink) -> None:
        super().__init__(link.scenario.params, link.scenario.reference)
        self._link, self._fault, self._left = link, link.injected.solver, link.injected.calls

    def solve(self, tick: Tick) -> Solution:
        if self._fault is None or self._link.at < self._link.start or self._left <= 0:
            return super().solve(tick)
        self._left -= 1
        return self._fault(super().solve, tick, self._link.elapse)


class FaultyEstimator(SimulatedEstimator):
    """The simulated estimator with its answers changed on the way."""

    def __init__(self, link: FaultyLink) -> None:
        super().__init__(link.scenario.params, link.scenario.seed)
        self._link, self._fault, self._count = link, link.injected.estimates, 0

    def deliver(self, now: int, window: Any) -> Estimate | None:
        answer = super().deliver(now, window)
        if answer is None or self._fault is None or self._link.at < self._link.start:
            return answer
        self._count += 1
        return self._fault(answer, self._count)


class Operator(OperatorInput):
    """An operator who aborts when the fault says so, and who leaves a vehicle that does not become ready."""

    def __init__(self, link: FaultyLink) -> None:
        super().__init__()
        self._link = link

    def look(self, ready: bool) -> None:
        link = self._link
        passed = sum(link.at >= link.start + after for after in link.injected.aborts)
        if link.seconds > PATIENT and link.vehicle.flown is None:
            self.reason = "not ready"
        self.reason, self.cut = "operator abort" if passed else self.reason, passed > 1


# --- the faults


def _poses(what: str, frames: Callable[[float, np.random.Generator], FrameFault], **more: Any) -> VirtualFault:
    return VirtualFault("poses", what, frames=frames, **more)


def _change(
    what: str, change: Change, seconds: float, every: int = 1, blind: bool = False, **more: Any
) -> VirtualFault:
    """Frames changed for so many seconds; ``blind``: none that can be used arrives meanwhile."""
    gap = seconds if blind else 0.0
    return _poses(what, lambda start, rng: inject.changed(change, start, seconds, every), blind=gap, **more)


def _frozen(what: str, seconds: float, stamps: bool = False) -> VirtualFault:
    return _poses(what, lambda start, rng: inject.changed(inject.frozen(stamps), start, seconds), blind=seconds)


def _drop_out(seconds: float, words: str = "", **more: Any) -> VirtualFault:
    rule = "" if seconds <= 0.1 else POSES if seconds <= 0.5 else GONE
    what, frames = f"no poses for {_duration(seconds)}{words}", lambda start, rng: inject.dropped(start, seconds)
    return _poses(what, frames, blind=seconds, demanded=rule, **more)


def _duration(seconds: float) -> str:
    return f"{1e3 * seconds:g} ms" if seconds < 1.0 else f"{seconds:g} s"


def _solver(what: str, fault: SolverFault, calls: float = 1, **more: Any) -> VirtualFault:
    return VirtualFault("solver", what, solver=fault, calls=calls, **{"phases": AIRBORNE, **more})


def _estimates(what: str, fault: EstimateFault) -> VirtualFault:
    return VirtualFault("estimator", what, CIRCLING, ESTIMATED, estimates=fault)


def _given(what: str, length: float) -> VirtualFault:
    return VirtualFault("estimator", what, CIRCLING, replace(PRESCRIBED, told_lengths=((START, length),)))


def _deaf(what: str, seconds: float, **more: Any) -> VirtualFault:
    return VirtualFault("link", what, deaf=seconds, **more)


def _pushed(what: str, impulse: float) -> VirtualFault:
    return VirtualFault("vehicle", what, HOVERING, replace(HOVER, pushes=(Push(START, (impulse, 0.0)),)))


ALWAYS = 1e9
"""From then on, s."""
WHILE_PUSHED: dict[str, Any] = {"phases": HOVERING, "scenario": PUSHED}
VIRTUAL_FAULTS = {
    **{
        f"drop-out-{_duration(seconds).replace(' ', '')}": _drop_out(seconds)
        for seconds in (0.01, 0.03, 0.08, 0.15, 0.3, 0.45, 1.0, 5.0)
    },
    **{
        f"drop-out-{1e3 * seconds:.0f}ms-pushed": _drop_out(seconds, ", pushed meanwhile", **WHILE_PUSHED)
        for seconds in (0.08, 0.15, 0.3)
    },
    "frames-thinned": _poses("half of all frames lost, at random", lambda start, rng: inject.thinned(start, 0.5, rng)),
    "bursts-20ms": _poses("poses in bursts every 20 ms, for 2 s", lambda start, rng: inject.bursts(start, 2.0, 0.02)),
    "bursts-60ms": _poses("poses in bursts every 60 ms, for 1 s", lambda start, rng: inject.bursts(start, 1.0, 0.06)),
    "bursts-200ms": _poses("a burst after 200 ms", lambda start, rng: inject.bursts(start, 0.2, 0.2)),
    "delay-20ms": _poses("poses 20 ms later, for 2 s", lambda start, rng: inject.late(start, 2.0, 5)),
    "delay-50ms": _poses("poses 50 ms later, for 2 s", lambda start, rng: inject.late(start, 2.0, 12)),
    "stamps-jitter": _poses("stamps off by up to 150 ms, for 3 s",
                            lambda start, rng: inject.changed(inject.jittered(0.15, rng), start, 3.0)),
    "stamps-jitter-5ms": _poses("stamps off by up to 5 ms, for 3 s",
                                lambda start, rng: inject.changed(inject.jittered(5e-3, rng), start, 3.0)),
    "stamps-duplicated": _change("two frames share each stamp, for 3 s", inject.coarse(1 / 120), 3.0),
    "stamps-constant": _change("one stamp for all frames, for 1 s", inject.stamped(EPOCH + NANO), 1.0, demanded=OLD),
    "frames-reversed": _poses("each three frames in reverse order, for 2 s",
                              lambda start, rng: inject.turned_about(start, 2.0, 3)),
    "clock-forward": _change("stamps' clock steps 2 s forward and stays", inject.stepped(2.0), ALWAYS),
    "clock-backward": _change("stamps' clock steps 3 s backward and stays", inject.stepped(-3.0), ALWAYS, demanded=OLD),
    "clock-forward-30ms": _change("stamps' clock steps 30 ms forward", inject.stepped(0.03), ALWAYS),
    "clock-backward-30ms": _change("stamps' clock steps 30 ms backward", inject.stepped(-0.03), ALWAYS),
    "stamps-zero": _change("stamps of zero for 1 s", inject.stamped(0), 1.0, demanded=OLD),
    "nan-once": _change("vehicle at NaN in one frame", inject.without("vehicle"), 0.0),
    "nan-every-other": _change("rod at NaN in every other frame", inject.without("pendulum"), 3.0, 2),
    "nan-80ms": _change("vehicle at NaN for 80 ms", inject.without("vehicle"), 0.08, blind=True),
    "infinite": _change("rod at infinity for 80 ms", inject.without("pendulum", math.inf), 0.08, blind=True),
    "outlier-once": _change("vehicle off by 0.5 m in one frame", inject.moved("vehicle", 0.5), 0.0),
    "outlier-rod-once": _change("rod off by 0.5 m in one frame", inject.moved("pendulum", 0.0, 0.5), 0.0),
    "outlier-tenth": _change("vehicle off by 0.5 m in every tenth frame, 3 s", inject.moved("vehicle", 0.5), 3.0, 10),
    "outlier-80ms": _change("vehicle off by 0.5 m for 80 ms", inject.moved("vehicle", 0.5), 0.08, blind=True),
    "outlier-for-good": _change("vehicle off by 0.5 m from then on", inject.moved("vehicle", 0.5), ALWAYS, blind=True),
    "rod-off-2cm": _change("rod off by 2 cm from then on", inject.moved("pendulum", 0.02), ALWAYS),
    "attitude-once": _change("vehicle's attitude off by 45 deg in one frame", inject.tilted(0.785), 0.0),
    "swap-once": _change("bodies swapped in one frame", inject.swapped, 0.0),
    "swap-80ms": _change("bodies swapped for 80 ms", inject.swapped, 0.08, blind=True),
    "swap-for-good": _change("bodies swapped from then on", inject.swapped, ALWAYS, blind=True),
    "frozen-80ms": _frozen("both poses frozen for 80 ms", 0.08),
    "frozen-for-good": _frozen("both poses frozen from then on", ALWAYS),
    "frame-repeated": _frozen("one frame again and again, with its stamp, for 80 ms", 0.08, stamps=True),
    "quaternion-long": _change("vehicle's quaternion 1 % long in every third frame, 3 s",
                               inject.longer("vehicle", 1.01), 3.0, 3),
    "quaternion-zero": _change("rod's quaternion zero for 80 ms", inject.longer("pendulum", 0.0), 0.08, blind=True),
    "quaternion-sign": _change("quaternions with the other sign in every other frame", inject.opposite, 3.0, 2),
    "solver-raises-once": _solver("exception, once", inject.raising),
    "solver-raises-pushed": _solver("exceptions for 0.25 s, pushed meanwhile", inject.raising, 3 + 2, **WHILE_PUSHED),
    "solver-raises": _solver("exceptions from then on", inject.raising, math.inf,
                             demanded="the limit of 3 s without a solver"),
    "solver-fails": _solver("no solution, three times", inject.unsolved, 3),
    "solver-nan": _solver("plan of NaN, once", inject.numberless),
    "solver-late-once": _solver("takes 25 ms, once", inject.taking(0.025)),
    "solver-late": _solver("takes 12.5 ms, for 60 solves", inject.taking(0.0125), 60),
    "solver-slow": _solver("takes 80 ms, once", inject.taking(0.08)),
    "solver-hangs-250ms": _solver("hangs for 250 ms", inject.taking(0.25), blind=0.25),
    "solver-hangs": _solver("hangs for 2 s", inject.taking(2.0), blind=2.0, demanded=judging.PULSE),
    "estimate-silent": _estimates("no estimate from then on", lambda answer, count: None),
    "estimate-nan": _estimates("estimates of NaN", inject.estimated(math.nan)),
    "estimate-absurd": _estimates("estimates of -1, 0 and 1000 m", inject.estimated(-1.0, 0.0, 1e3)),
    "estimate-shortest": _estimates("estimates of 0.1 m, the shortest allowed", inject.estimated(0.1)),
    "estimate-longest": _estimates("estimates of 2.5 m, the longest allowed", inject.estimated(2.5)),
    "estimate-wild": _estimates("estimates of 0.5 and 1.6 m in turn", inject.estimated(0.5, 1.6)),
    "estimate-fails": _estimates("exceptions in the estimator",
                                 lambda answer, count: Estimate(math.nan, math.nan, "ValueError: no fit")),
    "length-jump-down": _given("the length given to the pilot jumps by -0.6 m", 0.4),
    "length-jump-up": _given("the length given to the pilot jumps by 0.6 m", 1.6),
    "length-jump-far": _given("the length given to the pilot jumps by 0.85 m", 1.85),
    "deaf-50ms": _deaf("no command gets through for 50 ms", 0.05),
    "deaf-100ms-pushed": _deaf("no command gets through for 100 ms, pushed meanwhile", 0.1, **WHILE_PUSHED),
    "deaf-100ms": _deaf("no command gets through for 100 ms", 0.1),
    "deaf-300ms": _deaf("no command gets through for 300 ms", 0.3),
    "deaf-1s": _deaf("no command gets through for 1 s", 1.0),
    "abort": VirtualFault("operator", "abort", aborts=(0.0,), demanded=judging.OPERATOR),
    "motors-off": VirtualFault("operator", "abort, and motors off 0.2 s later", aborts=(0.0, 0.2),
                               demanded=judging.OPERATOR),
    "push-far": _pushed("push of 60 mN s, beyond saving", 0.06),
    "push-strong": _pushed("push of 15 mN s", 0.015),
}  # fmt: skip
"""The faults that fly in virtual time, by name."""
