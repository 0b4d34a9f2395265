"""Faults to inject into a simulated flight: of motion capture, of the solver, of the estimates.

A fault of motion capture is called with every frame, in order, and with the time in s since take-off; it returns the
frames that arrive at that moment: none, one or several. A fault of the solver stands in its place, one of the estimates
behind the estimator. No clock and no I/O; randomness comes from a generator that is passed.
"""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from fiplib.estimators.base import Estimate
from fiplib.mpc import Solution, Status
from fiplib.params import NANO
from fiplib.pilot import Tick
from fiplib.recording import Measurement

FrameFault = Callable[[float, Measurement], list[Measurement]]
"""(s since take-off, the true frame) -> the frames that arrive now."""
Change = Callable[[Measurement], Measurement]
"""A fault of a single frame: the true frame -> the frame that is delivered."""
Solve = Callable[[Tick], Solution]
Elapse = Callable[[float], None]
SolverFault = Callable[[Solve, Tick, Elapse], Solution]
"""(the solver, the tick, lets so many s pass) -> what is answered instead."""
EstimateFault = Callable[[Estimate, int], Estimate | None]
"""(an estimate, how many have been changed, with this one) -> what is delivered instead."""


def dropped(start: float, seconds: float) -> FrameFault:
    """No frame from ``start`` on for so many seconds."""
    return lambda at, frame: [] if start <= at < start + seconds else [frame]


def thinned(start: float, share: float, rng: np.random.Generator) -> FrameFault:
    """From ``start`` on each frame is lost with a probability."""
    return lambda at, frame: [] if at >= start and rng.random() < share else [frame]


def bursts(start: float, seconds: float, withheld: float) -> FrameFault:
    """For so many seconds frames are kept back and delivered together, every ``withheld`` s."""
    released = start

    def due(at: float, kept: int) -> int:
        nonlocal released
        if start <= at < start + seconds and at - released < withheld:
            return 0
        released = max(at, start)
        return kept

    return _queued(due)


def _queued(due: Callable[[float, int], int], order: int = 1) -> FrameFault:
    """Frames are queued; of those ``kept``, the first ``due(at, kept)`` are delivered, -1: in reverse order."""
    kept: list[Measurement] = []

    def fault(at: float, frame: Measurement) -> list[Measurement]:
        kept.append(frame)
        out = kept[: due(at, len(kept))]
        del kept[: len(out)]
        return out[::order]

    return fault


def late(start: float, seconds: float, frames: int) -> FrameFault:
    """For so many seconds every frame comes later by a number of frames, stamped with its exposure."""
    return _queued(lambda at, kept: max(0, kept - frames) if start <= at < start + seconds else kept)


def turned_about(start: float, seconds: float, count: int) -> FrameFault:
    """For so many seconds each ``count`` frames are delivered together and in reverse order."""
    return _queued(lambda at, kept: 0 if start <= at < start + seconds and kept < count else kept, order=-1)


def changed(change: Change, start: float, seconds: float, every: int = 1) -> FrameFault:
    """For so many seconds each ``every``-th frame is changed; 0 s is one frame alone."""
    count = 0

    def fault(at: float, frame: Measurement) -> list[Measurement]:
        nonlocal count
        if start <= at < start + seconds or (seconds == 0.0 and at >= start and count == 0):
            count += 1
            return [change(frame) if (count - 1) % every == 0 else frame]
        return [frame]

    return fault


def moved(body: str, x: float = 0.0, y: float = 0.0) -> Change:
    """``vehicle`` or ``pendulum`` displaced, m."""
    field = f"{body}_position"
    return lambda frame: frame._replace(**{field: getattr(frame, field) + np.array((x, y, 0.0))})


def swapped(frame: Measurement) -> Measurement:
    """Each body under the other's name."""
    return Measurement(frame.stamp, *frame[3:], *frame[1:3])


def without(body: str, value: float = np.nan) -> Change:
    """A position of ``vehicle`` or ``pendulum`` that is no number."""
    return lambda frame: frame._replace(**{f"{body}_position": np.full(3, value)})


def longer(body: str, factor: float) -> Change:
    """A quaternion that is not of unit length."""
    field = f"{body}_attitude"
    return lambda frame: frame._replace(**{field: getattr(frame, field) * factor})


def tilted(angle: float) -> Change:
    """The vehicle's attitude off by an angle about its x axis, rad."""
    turn = Rotation.from_euler("x", angle)
    return lambda frame: frame._replace(vehicle_attitude=(Rotation.from_quat(frame.vehicle_attitude) * turn).as_quat())


def opposite(frame: Measurement) -> Measurement:
    """Both quaternions with the other sign: the same attitudes."""
    return frame._replace(vehicle_attitude=-frame.vehicle_attitude, pendulum_attitude=-frame.pendulum_attitude)


def frozen(stamps: bool = False) -> Change:
    """Both poses as they were at the first frame changed; with its stamp, or with stamps that go on."""
    kept: dict[str, Measurement] = {}

    def change(frame: Measurement) -> Measurement:
        first = kept.setdefault("first", frame)
        return first if stamps else first._replace(stamp=frame.stamp)

    return change


def stamped(stamp: int) -> Change:
    """One stamp for all frames, ns."""
    return lambda frame: frame._replace(stamp=stamp)


def stepped(seconds: float) -> Change:
    """Stamps of a clock that has stepped."""
    return lambda frame: frame._replace(stamp=frame.stamp + round(seconds * NANO))


def jittered(seconds: float, rng: np.random.Generator) -> Change:
    """Stamps off by up to so many seconds, uniformly."""
    return lambda frame: frame._replace(stamp=frame.stamp + round(rng.uniform(-seconds, seconds) * NANO))


def coarse(seconds: float) -> Change:
    """Stamps cut to whole multiples of so many seconds: several frames share one."""
    return lambda frame: frame._replace(stamp=frame.stamp // round(seconds * NANO) * round(seconds * NANO))


def raising(solve: Solve, tick: Tick, elapse: Elapse) -> Solution:
    """A solver that raises."""
    raise RuntimeError("singular matrix")


def unsolved(solve: Solve, tick: Tick, elapse: Elapse) -> Solution:
    """A solver that does not converge."""
    return replace(solve(tick), status=Status.FAILED)


def numberless(solve: Solve, tick: Tick, elapse: Elapse) -> Solution:
    """A solver that answers NaN."""
    solution = solve(tick)
    return replace(solution, inputs=solution.inputs * math.nan)


def taking(seconds: float) -> SolverFault:
    """A solver that takes so long."""

    def slow(solve: Solve, tick: Tick, elapse: Elapse) -> Solution:
        solution = solve(tick)
        elapse(seconds)
        return solution

    return slow


def estimated(*lengths: float) -> EstimateFault:
    """Estimates of these lengths in turn."""
    return lambda answer, count: Estimate(lengths[count % len(lengths)], answer.standard_deviation)
