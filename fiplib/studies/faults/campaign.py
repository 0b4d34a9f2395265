#!/usr/bin/env python3
"""The fault campaign: inject faults into simulated flights behind the failsafe, and say what happened.

    python fiplib/studies/faults/campaign.py
    python fiplib/studies/faults/campaign.py --list
    python fiplib/studies/faults/campaign.py drop-out-300ms kill-sender --output my-faults.csv

Faults of poses, solver, estimate and operator fly in virtual time: the same rows every time. Those of processes fly in
real time, in processes of their own that are killed or stopped; of these the table keeps what does not depend on
timing. Everything is simulated: nothing here has flown on a vehicle. Rows gather beside the table in .partial.csv;
stopped at any time, the same command goes on from there.
"""

import fiplib  # isort: skip # noqa: F401 - first: it says how many threads NumPy may have

import argparse
import contextlib
import csv
import functools
import json
import math
import os
import re
import select
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from fiplib import bags, console
from fiplib.bags.live import _RESERVE
from fiplib.estimators.base import Estimate
from fiplib.flight.failsafe import Guard
from fiplib.flight.links import simulated
from fiplib.flight.links.simulated import FRAME, LoopbackSink, VirtualLink
from fiplib.flight.loop import FlightLoop
from fiplib.flight.operator import Operator
from fiplib.flight.sender import PATIENCE, DeadMan, decode, encode
from fiplib.flight.setpoint import Mode, Setpoint, disarmed
from fiplib.mpc import Solution, Status
from fiplib.params import NANO, Params
from fiplib.pilot import Circle, Hover, Pilot, Tick
from fiplib.recording import EPOCH, Measurement
from fiplib.reproduction.rows import JournalError
from fiplib.simulate import Push, Scenario, SimulatedEstimator
from fiplib.studies.faults import injection
from fiplib.studies.faults.injection import FrameFault
from fiplib.studies.journal import Journal

ROOT = Path(__file__).resolve().parents[1]
START = 3.0
"""Faults begin at this time after take-off, s."""
LEVEL = math.radians(10.0)
"""A vehicle that is disarmed with less tilt than this came down level: what tests/test_failsafe.py asks for, rad."""
DISARM_SECONDS = 0.5
"""Level-and-disarm frames for at least so long at the end: ExpressLRS and Betaflight need that, s."""
NEVER = (math.inf, math.inf)
BRIDGED = "balanced"
OPERATOR = "the operator"
DEAD = "the death of a process without which nobody flies"
POSES = "the limit of 100 ms without poses"
GONE = "the limit of 500 ms without poses"
PULSE = "the limit of 500 ms without setpoints"
HOVER = Scenario("fault", "hover, pushed 3.5 s after the fault", 9.0, Hover(), (Push(START + 3.5, (0.004, 0.0)),))
PUSHED = replace(HOVER, pushes=(Push(START + 0.02, (0.006, -0.003)),), description="hover, pushed during the fault")
CIRCLE = replace(HOVER, reference=Circle(0.8, 9.0, start=0.5, ramp=2.0), pushes=(), description="circle of 0.8 m")
ESTIMATED = Scenario(
    "fault",
    "circle of 0.4 m, length estimated from 1.2 m",
    10.0,
    Circle(0.4, 8.0),
    params=Params().replace(piloting__initial_length=1.2, piloting__estimate=True),
)

OFF, ROD_OFF = injection.moved("vehicle", (0.5, 0.0, 0.0)), injection.moved("pendulum", (0.0, 0.5, 0.0))
TOLD = Params().replace(estimation__median_length=1)


@dataclass(frozen=True)
class Fault:
    """One row of the table. What is called with a generator or a link makes the fault anew for each flight.

    ``blind`` and ``deaf`` are the (start, end) in s after take-off between which no pose arrives that says anything,
    and no command gets through. ``demanded`` says what gives the rod up by design. ``hit`` makes it a flight in real
    time: it is done to the processes, of ``fly.py`` with ``arguments``, on a disk of so many bytes if not 0.
    """

    group: str
    what: str
    scenario: Scenario = HOVER
    frames: Callable[[np.random.Generator], FrameFault] | None = None
    solver: Callable[["FaultyLink", Pilot], None] | None = None
    estimator: Callable[["FaultyLink"], Callable[[Estimate], Estimate | None]] | None = None
    aborts: tuple[float, ...] = ()
    blind: tuple[float, float] = NEVER
    deaf: tuple[float, float] = NEVER
    demanded: str = ""
    hit: Callable[["Witness"], None] | None = None
    arguments: tuple[str, ...] = ()
    disk: int = 0


# --- flights in virtual time


class FaultyLink(VirtualLink):
    """The simulated vehicle behind damaged poses, with the sender's rules in virtual time on the way out.

    Attributes:
        sent: (time in ns, setpoint) of all that left the sender.
        moments: (time in ns, true state (11,), whether it was commanded with armed motors) at each frame.
    """

    def __init__(self, scenario: Scenario, frames: FrameFault | None, deaf: tuple[float, float]) -> None:
        super().__init__(scenario)
        self._params, self._fault, self._deaf = scenario.params, frames, deaf
        self._arrived: deque[Measurement] = deque()
        self._man, self._due = DeadMan(scenario.params), math.inf
        self.sent: list[tuple[int, Setpoint]] = []
        self.moments: list[tuple[int, NDArray, bool]] = []

    @property
    def at(self) -> float:
        """s since take-off; -1 before."""
        return -1.0 if self.vehicle.flown is None else self.vehicle.flown / self._rate

    def receive(self, timeout: float) -> tuple[int, Measurement] | None:
        left = math.ceil(timeout * self._rate - 1e-6)
        while not self._arrived:
            if left == 0:
                return None
            left -= 1
            self._frame()
        return self._now, self._arrived.popleft()

    def elapse(self, seconds: float) -> None:
        """Time passes while the pilot is busy: frames queue, the sender goes on."""
        for _ in range(round(seconds * self._rate)):
            self._frame()

    def send(self, setpoint: Setpoint) -> None:
        self._man.hear(self._now, setpoint)
        self._out()
        self._due = self._now + round(PATIENCE * NANO / self._params.safety.send_rate)

    def fault(self) -> str | None:
        return self._man.fault

    def leave(self) -> None:
        """What ``sender.Sender.close`` makes of the end."""
        end = self._now + round(self._params.safety.leave_time * NANO)
        self._man.hear(self._now, disarmed(self._now))
        while self._now < end:
            self._frame()

    @property
    def kept_back(self) -> int:
        """Setpoints that the sender refused or cut to bounds: the failsafe must never make one."""
        return self._man.rejected + self._man.clamped

    def _frame(self) -> None:
        came = super().receive(0.0)
        assert came is not None and self.truth is not None
        armed = bool(self.sent) and self.sent[-1][1].armed
        self.moments.append((self._now, self.truth, armed))
        self._arrived.extend(self._fault(self.at, came[1]) if self._fault and self.at >= 0.0 else [came[1]])
        if self._now >= self._due:
            self._due += round(NANO / self._params.safety.send_rate)
            self._out()

    def _out(self) -> None:
        setpoint = self._man.due(self._now)
        self.sent.append((self._now, setpoint))
        if not self._deaf[0] <= self.at < self._deaf[1]:
            self.vehicle.command(setpoint)


class Beside:
    """The simulated estimator with its answers changed on the way."""

    def __init__(self, scenario: Scenario, change: Callable[[Estimate], Estimate | None]) -> None:
        self._estimator, self._change = SimulatedEstimator(scenario.params, scenario.seed), change

    def deliver(self, now: int, window: Any) -> Estimate | None:
        answer = self._estimator.deliver(now, window)
        return answer if answer is None else self._change(answer)


class Aborting(Operator):
    """An operator who asks to land at the first time given, and for motors off at the second."""

    def __init__(self, link: FaultyLink, times: Sequence[float]) -> None:
        super().__init__()
        self._link, self._times = link, times

    def look(self, ready: bool) -> None:
        passed = sum(self._link.at >= at for at in self._times)
        self.reason, self.cut = "operator abort" if passed else None, passed > 1


def fly(fault: Fault) -> dict[str, Any]:
    """Fly a fault in virtual time and judge the flight; a row of the table."""
    scenario, error = fault.scenario, ""
    rng = np.random.default_rng(scenario.seed + 100)
    link = FaultyLink(scenario, fault.frames(rng) if fault.frames else None, fault.deaf)
    guard = Guard(scenario.params, scenario.reference)
    if fault.solver:
        fault.solver(link, guard.pilot)
    estimator = None
    if scenario.params.piloting.estimate:
        estimator = Beside(scenario, fault.estimator(link) if fault.estimator else lambda answer: answer)
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "bag"
        with bags.BagRecorder(bag, {**scenario.metadata(), "params": scenario.params.to_dict()}) as recorder:
            flight = FlightLoop(scenario, link, guard, recorder, estimator, Aborting(link, fault.aborts))
            try:
                flight.run()
            except Exception as raised:
                error = f"{type(raised).__name__}: {raised}"
            link.leave()
        written = state_of(bag)
    return judged(fault, link, guard, error, written)


def state_of(bag: Path) -> str:
    """Whether a bag can be read, and if not, whether it can be recovered."""
    try:
        bags.read(bag)
    except bags.BagError:
        try:
            with tempfile.TemporaryDirectory() as folder:
                bags.read(bags.recover(bag, Path(folder) / "recovered").output)
        except bags.BagError as error:
            return f"lost ({error})"
        return "recovered"
    return "valid"


def judged(fault: Fault, link: FaultyLink, guard: Guard, error: str, bag: str) -> dict[str, Any]:
    """The row of a flight."""
    scenario, took_off = fault.scenario, next(now for now, setpoint in link.sent if setpoint.armed)
    safety, limit = scenario.params.safety, scenario.params.vehicle.max_body_rate
    sent = [(now, setpoint) for now, setpoint in link.sent if now >= took_off]
    numbers = np.array([(*setpoint.body_rate, setpoint.thrust) for _, setpoint in sent])
    within = (np.abs(numbers[:, :3]) <= limit).all(1) & (numbers[:, 3] >= 0.0) & (numbers[:, 3] <= safety.max_thrust)
    not_finite = int((~np.isfinite(numbers)).any(1).sum())
    out = int((~within).sum()) - not_finite + link.kept_back
    times = np.array([now for now, _ in sent])
    last_armed = max(now for now, setpoint in sent if setpoint.armed)
    tail = times[times > last_armed]
    path = [entry for entry in guard.transitions if entry.stamp > took_off]
    end = next((entry for entry in path if entry.reason == "end of the scenario"), None)
    stop = end.stamp if end else None
    final = stop or next((entry.stamp for entry in reversed(path) if entry.before is not Mode.LEVEL), times[-1])
    flown = [(now, truth) for now, truth, _ in link.moments if took_off <= now <= final]
    offsets = np.abs(np.array([truth for _, truth in flown])[:, [4, 6]])
    fallen = bool((np.hypot(*offsets.T) > 0.5 * scenario.params.pendulum.length * math.sin(math.radians(60.0))).any())
    balanced = end is not None and end.before is not Mode.LEVEL and not fallen
    disarm = next((truth for now, truth, _ in link.moments if len(tail) and now >= tail[0]), link.moments[-1][1])
    tilt = float(np.arccos(np.cos(disarm[8]) * np.cos(disarm[9])))
    held = disarm_seconds(tail)
    vehicle = BRIDGED if balanced else f"rod given up, {touched(tilt, disarm[10], safety.floor)}"
    safe = not error and not_finite == 0 and out == 0 and held >= DISARM_SECONDS and bag == "valid"
    perfect = exact(scenario)
    gaps = exact(scenario, fault.blind) if fault.blind != NEVER else None
    if fault.deaf != NEVER:
        gaps = exact_after(scenario, fault.deaf, dict(link.sent))
    return {
        "group": fault.group,
        "what": fault.what,
        "modes": modes_of([entry.after for entry in path if stop is None or entry.stamp < stop]),
        "vehicle": vehicle,
        "ended": ""
        if balanced
        else next((entry.reason for entry in reversed(path) if entry.before is not Mode.LEVEL), ""),
        "largest_a_cm": f"{100 * offsets[:, 0].max():.1f}",
        "largest_b_cm": f"{100 * offsets[:, 1].max():.1f}",
        "commands": len(sent),
        "not_finite": not_finite,
        "out_of_bounds": out,
        "longest_gap_ms": f"{np.diff(times).max() / 1e6:.1f}",
        "disarm_frames": len(tail),
        "disarm_s": f"{held:.2f}",
        "uncaught_exception": error or "no",
        "bag": bag,
        "perfect_information": "balanced" if perfect else "rod lost",
        "exact_with_same_gaps": "" if gaps is None else "balanced" if gaps else "rod lost",
        "verdict": verdict(safe, balanced, tilt < LEVEL, perfect, gaps, fault.demanded),
    }


def disarm_seconds(times: NDArray) -> float:
    """From the first to the last of the level-and-disarm frames, ns to s."""
    return float(times[-1] - times[0]) / NANO if len(times) else 0.0


def touched(tilt: float, height: float, floor: float) -> str:
    """How the motors were stopped."""
    how = "levelled" if tilt < LEVEL else f"tilted {math.degrees(tilt):.0f} deg"
    return f"{how}, {'landed' if height < floor + 0.05 else f'stopped at {height:.1f} m'}, disarmed"


def verdict(safe: bool, balanced: bool, level: bool, perfect: bool, gaps: bool | None, demanded: str) -> str:
    """Whether a flight met the target, and in which way. A flight that did not is named as such."""
    if not safe:
        return "NOT MET: exception, command, disarming or bag"
    if balanced:
        return "met: recovered"
    if not level:
        return "NOT MET: disarmed while tilted"
    if not perfect:
        return "met: ended safely, nobody would have kept the rod"
    if gaps is False:
        return "met: ended safely, exact poses with the same gaps lose the rod too"
    if demanded:
        return f"{'met' if demanded == OPERATOR else 'by design'}: ended safely, as {demanded} demands"
    return "NOT MET: ended safely, but the rod could have been kept"


def modes_of(path: Sequence[Mode]) -> str:
    """The modes after take-off in order; where there are many, how often each was entered, and the last."""
    if len(path) <= 8:
        return " > ".join(["flying", *(mode.value for mode in path)])
    counts = ", ".join(f"{mode.value} {path.count(mode)}x" for mode in Mode if mode in path)
    return f"{counts}; at last {path[-1].value}"


def informed(scenario: Scenario) -> tuple[VirtualLink, Pilot]:
    """A vehicle and a controller with perfect information: true states, without noise, and the true length."""
    params = scenario.params.replace(
        simulation__position_noise=0.0,
        simulation__attitude_noise=0.0,
        piloting__initial_length=scenario.params.pendulum.length,
        piloting__estimate=False,
    )
    return VirtualLink(replace(scenario, params=params)), Pilot(params, scenario.reference)


def lost(link: VirtualLink, scenario: Scenario) -> bool:
    """Whether the rod has fallen or the vehicle has left the fence."""
    outside = np.abs(link.vehicle.plant.x[:3]) > scenario.params.safety.fence
    return link.vehicle.plant.fallen or bool(outside.any())


@functools.cache
def exact(scenario: Scenario, blind: tuple[float, float] = NEVER) -> bool:
    """Whether a controller with perfect information keeps the rod up.

    It is the pilot without failsafe: while it is blind it flies the plan that it had, by time.
    """
    params = scenario.params
    link, pilot = informed(scenario)
    now, frame = link.receive(0.0) or (EPOCH, None)
    plan: tuple[int, NDArray] | None = None
    thrust, told = 0.0, -math.inf
    for index in range(round(scenario.duration * params.piloting.mocap_rate)):
        at, setpoint = index / params.piloting.mocap_rate, None
        tick = None if blind[0] <= at < blind[1] else pilot.observe(now, frame)
        if tick is not None:
            solution = pilot.solve(tick)
            command = pilot.answer(tick, solution.input, solution.status)
            plan, thrust, told = (now, solution.inputs), command.thrust, now
            setpoint = Setpoint(now, True, Mode.FLYING, command.body_rate, command.thrust)
        elif plan is not None and now - told >= NANO / params.piloting.control_rate - 1:
            node = min(int((now - plan[0]) / NANO / params.control.step), len(plan[1]) - 1)
            setpoint, told = Setpoint(now, True, Mode.FLYING, np.array([*plan[1][node], 0.0]), thrust), now
        if setpoint is not None:
            link.send(setpoint)
        now, frame = link.receive(0.0) or (now, frame)
        if lost(link, scenario):
            return False
    return True


def exact_after(scenario: Scenario, deaf: tuple[float, float], sent: Mapping[int, Setpoint]) -> bool:
    """Whether a controller with perfect information keeps the rod that takes over when the vehicle went deaf.

    Until then the vehicle has flown on the setpoints ``sent``, by time in ns; so the one that it holds while no command
    gets through is the one that it held.
    """
    link, pilot = informed(scenario)
    now, frame = link.receive(0.0) or (EPOCH, None)
    while (at := (link.vehicle.flown or 0) / scenario.params.piloting.mocap_rate) < scenario.duration:
        tick = pilot.observe(now, frame)
        if at < deaf[0]:
            setpoint = sent.get(now)
        elif tick is not None:
            solution = pilot.solve(tick)
            command = pilot.answer(tick, solution.input, solution.status)
            setpoint = Setpoint(now, True, Mode.FLYING, command.body_rate, command.thrust)
        else:
            setpoint = None
        if setpoint is not None and not deaf[0] <= at < deaf[1]:
            link.send(setpoint)
        now, frame = link.receive(0.0) or (now, frame)
        if lost(link, scenario):
            return False
    return True


# --- what is injected


def solver(change: Callable[["FaultyLink", Callable[[Tick], Solution], Tick], Solution], start: float, calls: float):
    """The pilot's solver replaced for a number of calls from ``start`` s after take-off on."""

    def install(link: FaultyLink, pilot: Pilot) -> None:
        right, done = pilot.solve, 0

        def solve(tick: Tick) -> Solution:
            nonlocal done
            if link.at < start or done >= calls:
                return right(tick)
            done += 1
            return change(link, right, tick)

        pilot.solve = solve  # type: ignore[method-assign]

    return install


def raising(link: FaultyLink, right: Callable[[Tick], Solution], tick: Tick) -> Solution:
    raise RuntimeError("singular matrix")


def unsolved(link: FaultyLink, right: Callable[[Tick], Solution], tick: Tick) -> Solution:
    return replace(right(tick), status=Status.FAILED)


def numberless(link: FaultyLink, right: Callable[[Tick], Solution], tick: Tick) -> Solution:
    solution = right(tick)
    return replace(solution, inputs=solution.inputs * math.nan)


def taking(seconds: float):
    """A solver that takes so long."""

    def slow(link: FaultyLink, right: Callable[[Tick], Solution], tick: Tick) -> Solution:
        solution = right(tick)
        link.elapse(seconds)
        return solution

    return slow


def answers(change: Callable[[Estimate, int], Estimate | None]):
    """Estimates changed from ``START`` on; ``change`` is given each with its number."""

    def install(link: FaultyLink) -> Callable[[Estimate], Estimate | None]:
        count = 0

        def changed(answer: Estimate) -> Estimate | None:
            nonlocal count
            if link.at < START:
                return answer
            count += 1
            return change(answer, count)

        return changed

    return install


def told(*lengths: float) -> Callable[[Estimate, int], Estimate]:
    """Estimates of these lengths in turn."""
    return lambda answer, count: Estimate(lengths[count % len(lengths)], answer.standard_deviation)


def poses(what: str, frames: Callable[[np.random.Generator], FrameFault], scenario: Scenario = HOVER, **more) -> Fault:
    return Fault("poses", what, scenario, frames, **more)


def change(what: str, made: Callable[[np.random.Generator], injection.Change], seconds: float, every: int = 1, **more):
    """Frames changed for so many seconds from ``START`` on."""
    return poses(what, lambda rng: injection.changed(made(rng), START, seconds, every), **more)


def drop_out(seconds: float, scenario: Scenario = HOVER) -> Fault:
    what = f"no poses for {f'{1e3 * seconds:g} ms' if seconds < 1.0 else f'{seconds:g} s'}"
    if scenario is not HOVER:
        what += ", pushed meanwhile" if scenario is PUSHED else ", on the circle"
    rule = "" if seconds <= 0.1 else POSES if seconds <= 0.5 else GONE
    frames, blind = lambda rng: injection.lost(START, seconds), (START, START + seconds)
    return poses(what, frames, scenario, blind=blind, demanded=rule)


def virtual_faults() -> dict[str, Fault]:
    """The faults that fly in virtual time, by name."""
    blind = functools.partial(lambda seconds: (START, START + seconds))
    found = {
        f"drop-out-{f'{1e3 * seconds:g}ms' if seconds < 1.0 else f'{seconds:g}s'}": drop_out(seconds)
        for seconds in (0.01, 0.03, 0.08, 0.15, 0.3, 0.45, 1.0, 5.0)
    }
    found |= {f"drop-out-{round(1e3 * s)}ms-pushed": drop_out(s, PUSHED) for s in (0.08, 0.15, 0.3)}
    found |= {"drop-out-150ms-circle": drop_out(0.15, CIRCLE)}
    found |= {
        "frames-thinned": poses("half of all frames lost, at random", lambda rng: injection.thinned(START, 0.5, rng)),
        "bursts-20ms": poses("poses in bursts every 20 ms, for 2 s", lambda rng: injection.bursts(START, 2.0, 0.02)),
        "bursts-60ms": poses("poses in bursts every 60 ms, for 1 s", lambda rng: injection.bursts(START, 1.0, 0.06)),
        "bursts-200ms": poses("a burst after 200 ms", lambda rng: injection.bursts(START, 0.2, 0.2)),
        "delay-20ms": poses("poses 20 ms later, for 2 s", lambda rng: injection.late(START, 2.0, 5)),
        "delay-50ms": poses("poses 50 ms later, for 2 s", lambda rng: injection.late(START, 2.0, 12)),
        "stamps-jitter": change("stamps off by up to 150 ms, for 3 s", lambda rng: injection.jittered(0.15, rng), 3.0),
        "stamps-jitter-5ms": change("stamps off by up to 5 ms, for 3 s", lambda rng: injection.jittered(5e-3, rng), 3.0),
        "stamps-duplicated": change("two frames share each stamp, for 3 s", lambda rng: injection.coarse(1 / 120), 3.0),
        "stamps-constant": change("one stamp for all frames, for 1 s",
                                  lambda rng: lambda frame: frame._replace(stamp=EPOCH + NANO), 1.0),
        "frames-reversed": poses("each three frames in reverse order, for 2 s",
                                 lambda rng: injection.turned_about(START, 2.0, 3)),
        "clock-forward": change("stamps' clock steps 2 s forward for good", lambda rng: injection.stepped(2.0), 1e9),
        "clock-backward": change("stamps' clock steps 3 s backward for good", lambda rng: injection.stepped(-3.0), 1e9),
        "clock-forward-30ms": change("stamps' clock steps 30 ms forward", lambda rng: injection.stepped(0.03), 1e9),
        "clock-backward-30ms": change("stamps' clock steps 30 ms backward", lambda rng: injection.stepped(-0.03), 1e9),
        "stamps-zero": change("stamps of zero for 1 s", lambda rng: lambda frame: frame._replace(stamp=0), 1.0),
        "nan-once": change("vehicle at NaN in one frame", lambda rng: injection.without("vehicle"), 0.0),
        "nan-every-other": change("rod at NaN in every other frame", lambda rng: injection.without("pendulum"), 3.0, 2),
        "nan-80ms": change("vehicle at NaN for 80 ms", lambda rng: injection.without("vehicle"), 0.08, blind=blind(0.08)),
        "infinite": change("rod at infinity for 80 ms", lambda rng: injection.without("pendulum", math.inf), 0.08,
                           blind=blind(0.08)),
        "outlier-once": change("vehicle off by 0.5 m in one frame", lambda rng: OFF, 0.0),
        "outlier-rod-once": change("rod off by 0.5 m in one frame", lambda rng: ROD_OFF, 0.0),
        "outlier-tenth": change("vehicle off by 0.5 m in every tenth frame, 3 s",
                                lambda rng: OFF, 3.0, 10),
        "outlier-80ms": change("vehicle off by 0.5 m for 80 ms", lambda rng: OFF, 0.08,
                               blind=blind(0.08)),
        "outlier-for-good": change("vehicle off by 0.5 m from then on",
                                   lambda rng: OFF, 1e9, blind=(START, math.inf)),
        "rod-off-2cm": change("rod off by 2 cm from then on", lambda rng: injection.moved("pendulum", (0.02, 0, 0)), 1e9),
        "attitude-once": change("vehicle's attitude off by 45 deg in one frame", lambda rng: injection.tilted(0.785), 0.0),
        "swap-once": change("bodies swapped in one frame", lambda rng: injection.swapped, 0.0),
        "swap-80ms": change("bodies swapped for 80 ms", lambda rng: injection.swapped, 0.08, blind=blind(0.08)),
        "swap-for-good": change("bodies swapped from then on", lambda rng: injection.swapped, 1e9,
                                blind=(START, math.inf)),
        "frozen-80ms": change("both poses frozen for 80 ms", lambda rng: injection.frozen(), 0.08, blind=blind(0.08)),
        "frozen-for-good": change("both poses frozen from then on", lambda rng: injection.frozen(), 1e9,
                                  blind=(START, math.inf)),
        "frame-repeated": change("one frame again and again, with its stamp, for 80 ms",
                                 lambda rng: injection.frozen(stamps=True), 0.08, blind=blind(0.08)),
        "quaternion-long": change("vehicle's quaternion 1 % long in every third frame, 3 s",
                                  lambda rng: injection.longer("vehicle", 1.01), 3.0, 3),
        "quaternion-zero": change("rod's quaternion zero for 80 ms", lambda rng: injection.longer("pendulum", 0.0), 0.08,
                                  blind=blind(0.08)),
        "quaternion-sign": change("quaternions with the other sign in every other frame", lambda rng: injection.opposite,
                                  3.0, 2),
    }  # fmt: skip
    found |= {
        "solver-raises-once": Fault("solver", "exception, once", solver=solver(raising, START, 1)),
        "solver-raises-pushed": Fault("solver", "exceptions for 0.25 s, pushed meanwhile", PUSHED,
                                      solver=solver(raising, START, 3 + 2)),
        "solver-raises": Fault("solver", "exceptions from then on", solver=solver(raising, START, math.inf),
                               demanded="the limit of 3 s without a solver"),
        "solver-fails": Fault("solver", "no solution, three times", solver=solver(unsolved, START, 3)),
        "solver-nan": Fault("solver", "plan of NaN, once", solver=solver(numberless, START, 1)),
        "solver-late-once": Fault("solver", "takes 25 ms, once", solver=solver(taking(0.025), START, 1)),
        "solver-late": Fault("solver", "takes 12.5 ms, for 60 solves", solver=solver(taking(0.0125), START, 60)),
        "solver-slow": Fault("solver", "takes 80 ms, once", solver=solver(taking(0.08), START, 1)),
        "solver-hangs-250ms": Fault("solver", "hangs for 250 ms", solver=solver(taking(0.25), START, 1),
                                    blind=(START, START + 0.25)),
        "solver-hangs": Fault("solver", "hangs for 2 s", solver=solver(taking(2.0), START, 1),
                              blind=(START, START + 2.0), demanded=PULSE),
        "estimate-silent": Fault("estimator", "no estimate from then on", ESTIMATED,
                                 estimator=answers(lambda answer, count: None)),
        "estimate-nan": Fault("estimator", "estimates of NaN", ESTIMATED, estimator=answers(told(math.nan))),
        "estimate-absurd": Fault("estimator", "estimates of -1, 0 and 1000 m", ESTIMATED,
                                 estimator=answers(told(-1.0, 0.0, 1e3))),
        "estimate-shortest": Fault("estimator", "estimates of 0.1 m, the shortest allowed", ESTIMATED,
                                   estimator=answers(told(0.1))),
        "estimate-longest": Fault("estimator", "estimates of 2.5 m, the longest allowed", ESTIMATED,
                                  estimator=answers(told(2.5))),
        "estimate-wild": Fault("estimator", "estimates of 0.5 and 1.6 m in turn", ESTIMATED,
                               estimator=answers(told(0.5, 1.6))),
        "estimate-fails": Fault("estimator", "exceptions in the estimator", ESTIMATED, estimator=answers(
            lambda answer, count: Estimate(math.nan, math.nan, "ValueError: no fit"))),
        "length-jump-down": Fault("estimator", "told a jump of the length by -0.6 m",
                                  replace(CIRCLE, told_lengths=((START, 0.4),), params=TOLD)),
        "length-jump-up": Fault("estimator", "told a jump of the length by 0.6 m",
                                replace(CIRCLE, told_lengths=((START, 1.6),), params=TOLD)),
        "length-jump-far": Fault("estimator", "told a jump of the length by 0.85 m",
                                 replace(CIRCLE, told_lengths=((START, 1.85),), params=TOLD)),
        "deaf-50ms": Fault("link", "no command gets through for 50 ms", deaf=(START, START + 0.05)),
        "deaf-100ms": Fault("link", "no command gets through for 100 ms, pushed meanwhile", PUSHED,
                            deaf=(START, START + 0.1)),
        "deaf-300ms": Fault("link", "no command gets through for 300 ms", deaf=(START, START + 0.3)),
        "deaf-1s": Fault("link", "no command gets through for 1 s", deaf=(START, START + 1.0)),
        "abort": Fault("operator", "abort", aborts=(START,), demanded=OPERATOR),
        "abort-circle": Fault("operator", "abort on the circle", CIRCLE, aborts=(START,), demanded=OPERATOR),
        "push-far": Fault("vehicle", "push of 60 mN s, beyond saving",
                          replace(HOVER, pushes=(Push(START, (0.06, 0.0)),))),
        "push-strong": Fault("vehicle", "push of 15 mN s", replace(HOVER, pushes=(Push(START, (0.015, 0.0)),))),
    }  # fmt: skip
    return found


# --- flights in real time, whose processes are killed or stopped

FLIGHT_SECONDS = 7.0
HIT = 2.0
"""Processes are hit at this time after take-off, s; push-hover pushes at 5.3 s."""
ENDED = 2.5
"""A flight is over when nothing is heard of it for so long, s."""
WITNESS = struct.Struct("<cq")
"""What goes to the witness: its kind and the monotonic time, ns; a setpoint, a true state or JSON follow."""


class Witness:
    """Hears every command on its way to the vehicle and every true state of it, whatever dies; a context manager."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self.port: int = self._socket.getsockname()[1]
        self.commands: list[tuple[int, Setpoint]] = []
        self.truths: list[tuple[int, NDArray]] = []
        self.pids: dict[str, int] = {}

    def __enter__(self) -> "Witness":
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def listen(self, seconds: float) -> bool:
        """Hear what comes within so many seconds; whether anything did."""
        end, heard = time.monotonic() + seconds, False
        while (left := end - time.monotonic()) > 0 and select.select([self._socket], [], [], left)[0]:
            data = self._socket.recv(65536)
            kind, at = WITNESS.unpack_from(data)
            rest, heard = data[WITNESS.size :], True
            if kind == b"C":
                self.commands.append((at, decode(rest)))
            elif kind == b"T":
                self.truths.append((at, np.array(FRAME.unpack(rest)[15:])))
            else:
                self.pids = json.loads(rest)
        return heard


def tell(port: int, kind: bytes, data: bytes) -> None:
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        out.sendto(WITNESS.pack(kind, time.monotonic_ns()) + data, ("127.0.0.1", port))


class TappedSink(LoopbackSink):
    """The way to the simulated vehicle, with a copy for the witness."""

    def __init__(self, port: int, address: tuple[str, int]) -> None:
        super().__init__(address)
        self._port = port

    def send(self, setpoint: Setpoint) -> None:
        super().send(setpoint)
        tell(self._port, b"C", encode(setpoint))


class TappedSocket:
    """The vehicle's socket, with a copy of its frames for the witness."""

    def __init__(self, port: int, inner: socket.socket) -> None:
        self._port, self._inner = port, inner

    def sendto(self, data: bytes, address: tuple[str, int]) -> int:
        tell(self._port, b"T", data)
        return self._inner.sendto(data, address)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)


def tapped_vehicle(port: int, scenario: Scenario, commands: socket.socket, *rest: Any) -> None:
    """The vehicle's process, with a copy of its frames for the witness."""
    simulated._fly_vehicle(scenario, TappedSocket(port, commands), *rest)  # type: ignore[arg-type]


def fly_tapped(port: int, arguments: list[str]) -> int:
    """``scripts/fly.py`` with these arguments, every command and every true state also told to the witness."""
    from fiplib.flight import command as script

    class Reporting(FlightLoop):
        def step(self) -> None:
            super().step()
            if self.clockwork.ticks % 30 == 1:
                pids = {"pilot": os.getpid(), **self._link.pids, "recorder": self._recorder._process.pid}
                pids["estimator"] = getattr(self._estimator, "pid", None)
                tell(port, b"P", json.dumps(pids).encode())

    script.FlightLoop = Reporting
    simulated.LoopbackSink = functools.partial(TappedSink, port)
    simulated._fly_vehicle = functools.partial(tapped_vehicle, port)
    return script.main(arguments)


def stop(process: str, seconds: float = math.inf):
    """Stop a process, and let it go on after so many seconds."""

    def hit(witness: Witness) -> None:
        pid = witness.pids[process]
        os.kill(pid, signal.SIGSTOP)
        if seconds < math.inf:
            witness.listen(seconds)
            os.kill(pid, signal.SIGCONT)

    return hit


def send(process: str, *names: str, times: int = 1):
    """Send signals to a process, or to those that are started in its place."""

    def hit(witness: Witness) -> None:
        for _ in range(times):
            for name in names:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(witness.pids[process], getattr(signal, name))
                witness.listen(0.2)
            if times > 1:
                witness.listen(3.0)

    return hit


def fly_processes(fault: Fault) -> dict[str, Any]:
    """Fly a fault in real time, with a process of its own for everything; a row of the table."""
    assert fault.hit is not None
    with tempfile.TemporaryDirectory() as folder, Witness() as witness, contextlib.ExitStack() as stack:
        place = Path(folder) / "disk"
        place.mkdir()
        if fault.disk:
            small_disk(place, fault.disk)
            stack.callback(subprocess.run, ["umount", "--lazy", str(place)], check=False)
        arguments = ["--real-time", "--output", str(place / "bag"), *fault.arguments]
        command = [sys.executable, str(Path(__file__).resolve()), "--fly", str(witness.port), "--", *arguments]
        with open(Path(folder) / "words", "w+") as words:
            # a session of its own: signals of the terminal are not meant for it
            process = subprocess.Popen(command, stdout=words, stderr=words, start_new_session=True)
            try:
                began = took_off(witness, process)
                while (time.monotonic_ns() - began) / NANO < HIT:
                    witness.listen(0.05)
                clock = time.time_ns()
                fault.hit(witness)
                until = time.monotonic() + 60.0
                while (witness.listen(ENDED) or process.poll() is None) and time.monotonic() < until:
                    pass
            finally:
                killed = end_all(process, witness)
            words.seek(0)
            said = words.read()
        return judged_processes(
            fault, witness, began, said, process.returncode, killed, bag_after(place / "bag", clock, said)
        )


def took_off(witness: Witness, process: subprocess.Popen) -> int:
    """Wait for the first armed command; when it was sent, ns."""
    end = time.monotonic() + 120.0
    while time.monotonic() < end and process.poll() is None:
        witness.listen(0.1)
        armed = [at for at, setpoint in witness.commands if setpoint.armed]
        if armed and witness.pids:
            return armed[0]
    raise RuntimeError(f"the flight has not begun (exit code {process.poll()})")


def end_all(process: subprocess.Popen, witness: Witness) -> bool:
    """End what is left of a flight; whether its script had to be killed."""
    left = process.poll() is None
    if left:
        process.kill()
    process.wait()
    time.sleep(0.3)
    for name, pid in witness.pids.items():
        if name != "pilot" and pid:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(pid, signal.SIGKILL)
    return left


def small_disk(place: Path, size: int) -> None:
    """A disk with so many bytes; OSError where none can be mounted."""
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "fip", str(place)]
    mounted = subprocess.run(command, capture_output=True, text=True, check=False)
    if mounted.returncode:
        raise OSError(f"no small disk can be mounted here: {mounted.stderr.strip()}")


def bag_after(bag: Path, struck: int, said: str) -> str:
    """What has become of the recording, and what is missing of the time up to the fault."""
    state = state_of(bag)
    if state.startswith("lost"):
        return state
    with tempfile.TemporaryDirectory() as folder:
        flight = bags.read(bag if state == "valid" else bags.recover(bag, Path(folder) / "recovered").output)
        missing = (struck - int(flight.command.stamp[-1])) / NANO
    if missing > 1.0:
        return f"{state}, MORE THAN 1 s LOST"
    state += ", up to the fault" if "recording stopped" in said or state == "recovered" else ""
    return state if missing <= 0.0 or state == "valid" else f"{state} but for 1 s at most"


def judged_processes(
    fault: Fault, witness: Witness, began: int, said: str, code: int | None, killed: bool, bag: str
) -> dict[str, Any]:
    """The row of a flight in real time: what does not depend on its timing."""
    params = Params()
    sent = [(at, setpoint) for at, setpoint in witness.commands if at >= began]
    numbers = np.array([(*setpoint.body_rate, setpoint.thrust) for _, setpoint in sent])
    limit = np.array([params.vehicle.max_body_rate] * 3 + [params.safety.max_thrust])
    not_finite = int((~np.isfinite(numbers)).any(1).sum())
    out = int(((np.abs(numbers) > limit) | (numbers < -limit * (np.arange(4) < 3))).any(1).sum())
    times = np.array([at for at, _ in sent])
    last_armed = max(at for at, setpoint in sent if setpoint.armed)
    tail = times[times > last_armed]
    held = disarm_seconds(tail)
    up = [at for at, setpoint in sent if setpoint.armed and setpoint.mode is not Mode.LEVEL]
    duration = float(fault.arguments[fault.arguments.index("--duration") + 1])
    upright = all(math.hypot(*truth[[4, 6]]) < 0.4 for at, truth in witness.truths if at <= up[-1])
    # the flight's end is told by the arrival of a frame
    balanced = (up[-1] - began) / NANO > duration - 0.1 and upright
    ended = (re.search(r"not balanced to the end \((.*?)\)(?:; wrote|$)", said, re.M) or [None, ""])[1]
    after = [truth for at, truth in witness.truths if at > (tail[0] if len(tail) else last_armed)]
    level = not after or math.acos(math.cos(after[0][8]) * math.cos(after[0][9])) < LEVEL
    if balanced:
        vehicle = BRIDGED
    elif not after:
        vehicle = "gone"
    else:
        tilt, height = math.acos(math.cos(after[0][8]) * math.cos(after[0][9])), after[0][10]
        vehicle = f"rod given up, {touched(tilt, height, params.safety.floor)}"
    error = "yes" if "Traceback" in said else "no"
    safe = error == "no" and not_finite == 0 and out == 0 and held >= DISARM_SECONDS and "LOST" not in bag.upper()
    if killed:
        error, safe = "did not end", False
    gap = float(np.diff(times).max()) / 1e6
    tqdm.write(
        f"{fault.what}: longest gap {gap:.0f} ms, {held:.2f} s disarmed, exit {code}: {said.strip()[-300:]}", sys.stderr
    )
    return {
        "group": fault.group,
        "what": fault.what,
        "modes": "",
        "vehicle": vehicle,
        "ended": re.sub(r"\d+ ms old", "too old", ended),
        "largest_a_cm": "",
        "largest_b_cm": "",
        "commands": "",
        "not_finite": not_finite,
        "out_of_bounds": out,
        "longest_gap_ms": "",
        "disarm_frames": "",
        "disarm_s": f">={DISARM_SECONDS:g}" if held >= DISARM_SECONDS else f"{held:.2f}",
        "uncaught_exception": error,
        "bag": bag,
        "perfect_information": "rod lost" if fault.demanded == DEAD else "balanced",
        "exact_with_same_gaps": "",
        "verdict": verdict(safe, balanced, level, fault.demanded != DEAD, None, fault.demanded),
    }


def process_faults() -> dict[str, Fault]:
    """The faults of processes, by name; each flies in real time."""
    hover = ("--scenario", "push-hover", "--duration", f"{FLIGHT_SECONDS:g}")
    circle = ("--scenario", "estimate-1.2", "--duration", "16", "--set", "safety.estimator_timeout=1.0")

    def real(group: str, what: str, hit: Callable[[Witness], None], arguments=hover, **more: Any) -> Fault:
        return Fault(group, what, hit=hit, arguments=arguments, **more)

    return {
        "kill-pilot": real("process", "kill -9 of the pilot", send("pilot", "SIGKILL"), demanded=DEAD),
        "kill-sender": real("process", "kill -9 of the command sender", send("sender", "SIGKILL"), demanded=DEAD),
        "kill-vehicle": real("process", "kill -9 of the simulated vehicle", send("vehicle", "SIGKILL"), demanded=DEAD),
        "kill-estimator": real("process", "kill -9 of the estimator", send("estimator", "SIGKILL"), circle),
        "kill-estimators": real("process", "kill -9 of each estimator started", send("estimator", "SIGKILL", times=4),
                                  circle),
        "kill-recorder": real("process", "kill -9 of the recorder", send("recorder", "SIGKILL")),
        "kill-pilot-and-recorder": real("process", "kill -9 of pilot and recorder", both, demanded=DEAD),
        "hang-estimator": real("process", "estimator hangs for good", stop("estimator"), circle),
        "hang-recorder": real("process", "recorder hangs for 2 s, as on a stalled disk", stop("recorder", 2.0)),
        "hang-sender-50ms": real("link", "sender blocked for 50 ms", stop("sender", 0.05)),
        "hang-sender-150ms": real("link", "sender blocked for 150 ms", stop("sender", 0.15)),
        "hang-sender": real("link", "sender blocked for good", stop("sender"), demanded=DEAD),
        "hang-pilot-50ms": real("process", "pilot hangs for 50 ms", stop("pilot", 0.05)),
        "hang-pilot-150ms": real("process", "pilot hangs for 150 ms", stop("pilot", 0.15)),
        "hang-pilot-2s": real("process", "pilot hangs for 2 s", stop("pilot", 2.0), demanded=PULSE),
        "disk-full": real("recording", "disk full in flight", lambda witness: None, disk=_RESERVE + (150 << 10)),
        "ctrl-c": real("operator", "Ctrl-C", send("pilot", "SIGINT"), demanded=OPERATOR),
        "ctrl-c-twice": real("operator", "Ctrl-C twice: motors off", send("pilot", "SIGINT", "SIGINT"),
                             demanded=OPERATOR),
        "terminal-lost": real("operator", "terminal lost (SIGHUP)", send("pilot", "SIGHUP"), demanded=OPERATOR),
        "told-to-end": real("operator", "told to end (SIGTERM)", send("pilot", "SIGTERM"), demanded=OPERATOR),
    }  # fmt: skip


def both(witness: Witness) -> None:
    for name in ("recorder", "pilot"):
        os.kill(witness.pids[name], signal.SIGKILL)


# --- the command


def main(arguments: list[str] | None = None) -> int:
    description, _, examples = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        description=description, epilog=examples, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="which faults (default: all)")
    parser.add_argument("--list", action="store_true", help="list the faults")
    parser.add_argument("--output", type=Path, metavar="CSV", help="table to write (default: data/faults.csv)")
    parser.add_argument("--fresh", action="store_true", help="forget the rows that are on disk")
    parser.add_argument("--fly", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.fly is not None:
        return fly_tapped(options.fly, options.names)
    campaign = virtual_faults() | process_faults()
    if options.list:
        for name, fault in campaign.items():
            print(f"{name:24} {fault.group:10} {fault.what}{', in real time' if fault.hit else ''}")
        return 0
    if unknown := [name for name in options.names if name not in campaign]:
        print(f"faults.py: no fault {unknown[0]!r}; --list lists them", file=sys.stderr)
        return 2
    names = options.names or list(campaign)
    if options.names and options.output is None:
        print("faults.py: some faults alone go to a table of their own: give --output CSV", file=sys.stderr)
        return 2
    try:
        journal = Journal(options.output or ROOT / "data/faults.csv", ["fault"], options.fresh)
        with contextlib.closing(journal):
            for name in tqdm(names, unit="fault", disable=None):
                if (name,) not in journal.rows:
                    fault = campaign[name]
                    journal.append({"fault": name}, fly_processes(fault) if fault.hit else fly(fault))
            journal.complete([{"fault": name} for name in names])
    except (JournalError, OSError) as error:
        print(f"faults.py: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("faults.py: interrupted; the same command goes on from here", file=sys.stderr)
        return 130
    if options.output is None:
        page = ROOT / "docs/faults.md"
        page.write_text(with_table(page.read_text(encoding="utf-8"), rows_of(journal.path)), encoding="utf-8")
    return summary(journal.path)


GROUPS = {
    "poses": "Poses and stamps",
    "solver": "The solver",
    "estimator": "The estimator and the length",
    "link": "The way to the vehicle",
    "process": "Processes killed or stopped",
    "recording": "The recording",
    "operator": "The operator",
    "vehicle": "Disturbances",
}
"""The groups of faults in the order of the page, with their titles."""
TABLE_HEAD = r"| injected | modes after take-off | vehicle | \|a\|, \|b\| (cm) | perfect information | verdict |"
MARKS = "<!-- table: written by fiplib/studies/faults/campaign.py -->", "<!-- end of the table -->"


def rows_of(path: Path) -> list[dict[str, str]]:
    """The rows of a finished table."""
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def with_table(page: str, rows: Sequence[dict[str, str]]) -> str:
    """A page in Markdown with the table between its marks made anew."""
    before, _, rest = page.partition(MARKS[0])
    _, _, after = rest.partition(MARKS[1])
    counts = Counter(row["verdict"].partition(":")[0] for row in rows)
    lines = [
        f"{len(rows)} faults: {counts['met']} met the target, {counts['by design']} ended safely by a limit of the "
        f"failsafe where perfect information would have kept the rod, {counts['NOT MET']} did not meet it."
    ]
    for group, title in GROUPS.items():
        lines += ["", f"### {title}", "", TABLE_HEAD, "|---|---|---|---|---|---|"]
        for row in rows:
            if row["group"] == group:
                largest = f"{row['largest_a_cm']}, {row['largest_b_cm']}" if row["largest_a_cm"] else ""
                vehicle = row["vehicle"] + (f" ({row['ended']})" if row["ended"] else "")
                vehicle += "" if row["bag"] == "valid" else f"; bag {row['bag']}"
                cells = (row["what"], row["modes"].replace(">", "→"), vehicle, largest, row["perfect_information"])
                lines.append(f"| {' | '.join(cells)} | {row['verdict']} |")
    return f"{before}{MARKS[0]}\n" + "\n".join(lines) + f"\n{MARKS[1]}{after}"


def summary(path: Path) -> int:
    """Print the table; 1 if a fault did not meet the target."""
    rows = rows_of(path)
    for row in rows:
        print(f"{row['fault']:24} {row['vehicle']:52} {row['verdict']}")
    counts = Counter(row["verdict"].partition(":")[0] for row in rows)
    print(f"{len(rows)} faults: {', '.join(f'{count} {kind}' for kind, count in counts.items())}; wrote {path}")
    return int(counts["NOT MET"] > 0)


if __name__ == "__main__":
    sys.exit(console.run(main))
