"""The judgement of a faulty flight: its commands, how its motors were stopped, its recording; one row of the table."""

import math
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fiplib import bags
from fiplib.flight.limits import Limits
from fiplib.flight.setpoint import Mode, Setpoint
from fiplib.params import NANO, Params
from fiplib.recording import Flight

LEVEL = math.radians(10.0)
"""A vehicle that is disarmed with less tilt than this came down level, as tests/flight/test_failsafe.py asks, rad."""
DISARM_SECONDS = 0.5
"""Level-and-disarm frames must last that long at the end of a flight: ExpressLRS and Betaflight need that, s."""
DANGER = math.radians(30.0)
"""A vehicle that tilts further while it lands is in danger, rad."""
ON_ITS_SIDE = Limits().safety.max_tilt + 0.1
"""In flight, one that tilts further: the failsafe's own limit, and what the vehicle turns until it levels, rad."""
LOW = Limits().safety.floor + 0.05
"""A vehicle that is disarmed below has landed, m."""
SEAT = Params().seat_above_tracked
"""Height of the seat, whose place is in a true state, above the point that motion capture gives, m."""
BALANCED, NOT_ARMED = "balanced", "not armed"
TILTED = "NOT MET: in danger, or disarmed while tilted"
UNSAFE = "NOT MET: exception, command, disarming or bag"
OPERATOR = "the operator"
DEAD = "the death of a process without which nobody flies"
PULSE = "the limit of 500 ms without setpoints"
COLUMNS = (
    *("group", "what", "modes", "vehicle", "ended", "largest_a_cm", "largest_b_cm", "largest_tilt_deg", "commands"),
    *("not_finite", "out_of_bounds", "longest_gap_ms", "disarm_frames", "disarm_s", "uncaught_exception", "bag"),
    *("perfect_information", "exact_with_same_gaps", "verdict"),
)
"""Columns of the table after the fault's name and the phase."""


@dataclass(frozen=True)
class Fault:
    """One row of the table, in a ``group`` of the page; ``what`` is injected, in words.

    ``demanded``: the limit, or the person, that demands to give the rod up; empty if nothing does. ``phases``: those of
    a flight in which it is injected, a row each.
    """

    group: str
    what: str
    phases: tuple[str, ...] = ("hover",)
    demanded: str = field(default="", kw_only=True)

    def fly(self, phase: str) -> dict[str, Any]:
        """Inject it into a phase of a flight; return the row of the table, by ``COLUMNS``."""
        raise NotImplementedError

    def row(self, **values: Any) -> dict[str, Any]:
        """Return the row with these values; the other columns stay empty."""
        return {**dict.fromkeys(COLUMNS, ""), "group": self.group, "what": self.what, **values}


class Commands(NamedTuple):
    """The commands of a flight from take-off on.

    ``not_finite`` and ``out_of_bounds`` count them; ``last_armed`` is the time of the last with armed motors, ns, and
    ``disarming`` are those (n,) of the level-and-disarm frames after it; ``longest_gap`` between two commands, ms.
    """

    count: int
    not_finite: int
    out_of_bounds: int
    last_armed: int
    disarming: NDArray
    longest_gap: float

    @classmethod
    def of(cls, sent: Sequence[tuple[int, Setpoint]], params: Params, limits: Limits) -> "Commands":
        """Check setpoints, each with the time in ns at which it was sent, against the bounds."""
        numbers = np.array([(*setpoint.body_rate, setpoint.thrust) for _, setpoint in sent])
        times = np.array([now for now, _ in sent])
        rates, thrust = np.abs(numbers[:, :3]), numbers[:, 3]
        within = (rates <= params.vehicle.max_body_rate).all(1) & (thrust >= 0.0) & (thrust <= limits.safety.max_thrust)
        not_finite = int((~np.isfinite(numbers)).any(1).sum())
        beyond = int((~within).sum()) - not_finite
        last_armed = max((now for now, setpoint in sent if setpoint.armed), default=-1)
        gap = float(np.diff(times).max()) / 1e6
        return cls(len(sent), not_finite, beyond, last_armed, times[times > last_armed], gap)

    @property
    def disarm_seconds(self) -> float:
        """Time from the first to the last of the level-and-disarm frames, s."""
        return float(self.disarming[-1] - self.disarming[0]) / NANO if len(self.disarming) else 0.0

    @property
    def safe(self) -> bool:
        """Whether all of them are finite and within bounds, and the motors are disarmed for long enough at the end."""
        return self.not_finite == self.out_of_bounds == 0 and self.disarm_seconds >= DISARM_SECONDS


def tilt_of(truth: NDArray) -> float:
    """Return the angle in rad between the vehicle's z axis and the vertical, from a true state (11,)."""
    return math.acos(math.cos(truth[8]) * math.cos(truth[9]))


def given_up(truth: NDArray) -> str:
    """Say how the motors were stopped, from the true state (11,) at the first disarm frame."""
    tilt, height = tilt_of(truth), truth[10] - SEAT
    how = "levelled" if tilt < LEVEL else f"tilted {math.degrees(tilt):.0f} deg"
    where = "landed" if height < LOW else f"stopped at {height:.1f} m"
    return f"rod given up, {how}, {where}, disarmed"


def judge(safe: bool, balanced: bool, level: bool, perfect: bool, gaps: bool | None, demanded: str) -> str:
    """Say whether a flight met the target, and in which way. A flight that did not is named as such.

    ``safe``: no exception, all commands within bounds, disarmed at the end, the bag readable; ``balanced``: the rod
    stood to the end; ``level``: the motors were stopped with less than ``LEVEL`` of tilt, and it never was in
    ``DANGER``; ``perfect``: a controller
    with perfect information keeps the rod, and with the same ``gaps`` in its poses or commands (``None``: there were
    none); ``demanded``: who or what demands to give the rod up, if anything.
    """
    if not safe:
        return UNSAFE
    if balanced:
        return "met: recovered"
    if not level:
        return TILTED
    if not perfect:
        return "met: ended safely, nobody would have kept the rod"
    if gaps is False:
        return "met: ended safely, exact poses with the same gaps lose the rod too"
    if demanded:
        return f"{'met' if demanded == OPERATOR else 'by design'}: ended safely, as {demanded} demands"
    return "NOT MET: ended safely, but the rod could have been kept"


def judge_landing(safe: bool, level: bool, low: bool, ended: str, deaf: bool, demanded: str) -> str:
    """Say whether a landing met the target, the rod being given up: down to the floor, level all the time.

    ``low``: the motors were stopped when it was down; ``ended``: why they were; ``deaf``: commands did not get through;
    the others as in ``judge``.
    """
    if not safe:
        return UNSAFE
    if not level:
        return "met: ended disarmed, no command got through to level it" if deaf else TILTED
    if low:
        return "met: landed"
    if demanded == OPERATOR:
        return f"met: ended safely, as {demanded} demands"
    for reason, limit in (("pose ", "500 ms without poses"), ("levelled ", "6 s of descent")):
        if ended.startswith(reason):
            return f"by design: disarmed level in the air, as the limit of {limit} demands"
    return f"NOT MET: disarmed in the air: {ended}"


def severity(verdict: str) -> int:
    """Return how bad a verdict is: 0 met, 1 by design, 2 not met."""
    return ("met", "by design", "NOT MET").index(verdict.partition(":")[0])


def modes_of(path: Sequence[Mode]) -> str:
    """Return the modes after take-off in order; where there are many, how often each was entered, and the last."""
    if len(path) <= 8:
        return " > ".join(["flying", *(mode.value for mode in path)])
    counts = ", ".join(f"{mode.value} {path.count(mode)}x" for mode in Mode if mode in path)
    return f"{counts}; at last {path[-1].value}"


def read_back(bag: Path) -> tuple[str, Flight | None]:
    """Read a bag, or what can be recovered of it; returns "valid", "recovered" or "lost (why)", and the flight."""
    with suppress(bags.BagError):
        return "valid", bags.read(bag)
    try:
        with tempfile.TemporaryDirectory() as folder:
            return "recovered", bags.read(bags.recover(bag, Path(folder) / "recovered").output)
    except bags.BagError as error:
        return f"lost ({error})", None
