"""The failsafe's state machine as data: every transition between modes, its condition and its severity.

``failsafe.Guard`` detects the conditions and looks the transitions up here; docs/safety.md shows the same table.
"""

from collections.abc import Iterable
from enum import Enum, auto
from typing import NamedTuple

from fiplib.flight.setpoint import Mode


class Condition(Enum):
    """The events that the failsafe detects; the rows of ``TRANSITIONS`` say what each means and what follows."""

    CHECKS_PASSED = auto()
    CHECKS_FAILED = auto()
    ARMED = auto()
    POSE_LATE = auto()
    POSE_MISSING = auto()
    POSE_LOST = auto()
    POSES_BACK = auto()
    SOLVE_FAILED = auto()
    SOLVER_FAILED = auto()
    SOLVER_AWAITED = auto()
    SOLVED = auto()
    NO_SOLVER = auto()
    ROD_FALLEN = auto()
    ROD_OFF_SEAT = auto()
    TILTED = auto()
    OUTSIDE = auto()
    ABORTED = auto()
    LANDED = auto()
    LEVELLED = auto()
    STOPPED = auto()


class Row(NamedTuple):
    """One row of the table: in one of the modes ``before``, ``condition`` leads to ``after``.

    ``level`` is the severity of its event in a bag, ``words`` describe the condition. After a ``final`` row the flight
    is given up: only a row to ``DISARMED`` can follow, and after that none.
    """

    before: tuple[Mode, ...]
    condition: Condition
    after: Mode
    level: str
    words: str
    final: bool = False


DISARMED, READY, FLYING, COASTING, HOVER_ONLY, LEVEL = Mode
ARMED = (FLYING, COASTING, HOVER_ONLY, LEVEL)

# fmt: off
TRANSITIONS = (
    Row((DISARMED,), Condition.CHECKS_PASSED, READY, "info", "the arm checks have passed for `arm_time`"),
    Row((READY,), Condition.CHECKS_FAILED, DISARMED, "info", "an arm check fails, or no good pose for `pose_flag`"),
    Row((READY,), Condition.ARMED, FLYING, "info", "armed by the operator"),
    Row((FLYING, HOVER_ONLY), Condition.POSE_LATE, COASTING, "warn", "no good pose for `pose_flag`"),
    Row((FLYING,), Condition.SOLVE_FAILED, COASTING, "warn", "a solve late or failed, at most `coast_ticks` in a row"),
    Row((FLYING, COASTING), Condition.SOLVER_FAILED, HOVER_ONLY, "error", "more than `coast_ticks` in a row"),
    Row((COASTING,), Condition.SOLVER_AWAITED, HOVER_ONLY, "error", "poses are back, and the solver has failed before"),
    Row((COASTING, HOVER_ONLY), Condition.SOLVED, FLYING, "info", "solved, and poses are fresh"),
    Row((FLYING, COASTING, HOVER_ONLY), Condition.POSE_MISSING, LEVEL, "error", "no good pose for `pose_level`"),
    Row((LEVEL,), Condition.POSES_BACK, FLYING, "info", "`recovery_frames` good poses, unless given up"),
    Row((FLYING, COASTING, HOVER_ONLY), Condition.NO_SOLVER, LEVEL, "error", "no solver for `hover_time`", final=True),
    Row(ARMED, Condition.ROD_FALLEN, LEVEL, "error", "the rod leans beyond `fallen_lean`", final=True),
    Row(ARMED, Condition.ROD_OFF_SEAT, LEVEL, "error", "the rod is off its seat by `seat_play`", final=True),
    Row(ARMED, Condition.TILTED, LEVEL, "error", "the vehicle tilts beyond `max_tilt`", final=True),
    Row(ARMED, Condition.OUTSIDE, LEVEL, "error", "outside `fence`, or below `floor`", final=True),
    Row(ARMED, Condition.ABORTED, LEVEL, "error", "the operator lands, or the scenario is over", final=True),
    Row(ARMED, Condition.POSE_LOST, DISARMED, "info", "no good pose for `pose_disarm`", final=True),
    Row((LEVEL,), Condition.LANDED, DISARMED, "info", "below `floor`, once given up", final=True),
    Row((LEVEL,), Condition.LEVELLED, DISARMED, "info", "levelled for `level_time`", final=True),
    Row(tuple(Mode), Condition.STOPPED, DISARMED, "info", "motors off: the operator, a broken link", final=True),
)
# fmt: on
"""Every transition there is. In a mode that a condition does not name, it changes nothing."""


def by_mode(rows: Iterable[Row] = TRANSITIONS) -> dict[tuple[Mode, Condition], Row]:
    """Return the rows by mode and condition. Raises ValueError if two rows contradict each other."""
    found: dict[tuple[Mode, Condition], Row] = {}
    for row in rows:
        for mode in row.before:
            if found.setdefault((mode, row.condition), row) is not row:
                raise ValueError(f"two transitions for {mode.name} and {row.condition.name}")
    return found


class Transition(NamedTuple):
    """A change of mode at ``stamp`` ns, and its reason with the numbers measured; ``level`` is that of its row."""

    stamp: int
    before: Mode
    after: Mode
    level: str
    reason: str

    @property
    def text(self) -> str:
        """Return the words of its event in a bag."""
        return f"failsafe: {self.before.value} -> {self.after.value}: {self.reason}"

    @property
    def data(self) -> dict[str, str]:
        """Return the data of its event in a bag."""
        return {"from": self.before.value, "to": self.after.value, "reason": self.reason}
