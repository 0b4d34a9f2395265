"""A fuzzer of the failsafe: scripts of calls, true and damaged, and what must hold whatever comes in.

FIP_FUZZ_SECONDS is its budget (a few seconds by default), FIP_FUZZ_SEED its first seed. A script that fails is made
shorter, and printed as the lines of Python that repeat it.
"""

import itertools
import math
import os
import time

import numpy as np
import pytest

from fiplib.flight.failsafe import Guard
from fiplib.flight.limits import Limits
from fiplib.flight.setpoint import Mode
from fiplib.flight.transitions import by_mode
from fiplib.params import NANO, Params
from fiplib.pilot import Pilot
from fiplib.recording import EPOCH, Measurement
from fiplib.references import Circle, Hover

BUDGET = float(os.environ.get("FIP_FUZZ_SECONDS", "4"))
SEED = int(os.environ.get("FIP_FUZZ_SEED", "0"))
PARAMS, SAFETY = Params(), Limits().safety
UPRIGHT = np.array((0.0, 0.0, 0.0, 1.0))
NONSENSE = (
    None, math.nan, math.inf, -math.inf, -1, 0, True, 1.5, 2**63, 10**40, -(10**40), 1e308, 1e-308, "", "lost", b"\\0",
    (), [], {}, object(), np.nan, np.int64(3), np.array([]), np.zeros(2), np.zeros((3, 1)), np.zeros((2, 7)),
    np.full(3, np.nan), np.full(4, np.inf), np.array(["a", "b", "c"]), np.array([None, None, None]),
    np.array([1j, 0, 0]), [[1], [2, 3]],
)  # fmt: skip
"""What is neither a time nor a frame nor a number, or only nearly."""
Call = tuple[str, tuple]
TRANSITIONS = {(mode, row.after, row.level) for (mode, _), row in by_mode().items()}


def script(seed: int) -> list[Call]:
    """Calls as a seed has them; numbers and places in ``NONSENSE``, so that a script can be printed."""
    rng = np.random.default_rng(seed)
    calls: list[Call] = [("feed", (150,))] * int(rng.integers(0, 2)) + [("arm", ())] * int(rng.integers(0, 2))
    names = (
        "feed",
        "feed",
        "feed",
        "bad",
        "bad",
        "old",
        "swap",
        "silence",
        "lean",
        "tilt",
        "move",
        "step_clock",
        "arm",
    )
    names += ("abort", "disarm", "estimate", "late", "nonsense", "nonsense", "breaks")
    for name in rng.choice(names, size=int(rng.integers(3, 40))).tolist():
        count, kind, size = int(rng.integers(1, 60)), int(rng.integers(len(NONSENSE))), round(float(rng.normal()), 3)
        if name in ("abort", "disarm") and rng.random() < 0.7:
            continue
        calls.append((name, (count, kind, size)))
    return calls


class Flight:
    """A vehicle that a script flies; the checks are in ``took``."""

    def __init__(self, seed: int) -> None:
        self.guard = Guard(Pilot(PARAMS, Hover() if seed % 2 else Circle(0.4, 8.0)))
        self.start = 0.4 * (seed % 2 == 0)
        self.now, self.last, self.sent = EPOCH, 0, 0
        self.lean = self.tilt = self.x = 0.0
        self.rng = np.random.default_rng(seed)

    def frame(self) -> Measurement:
        self.now += NANO // 240
        at = np.array((self.start + self.x, 0.0, 1.3)) + self.rng.normal(size=3) * 2e-4
        rod = 0.5 * np.array((math.sin(self.lean), 0.0, math.cos(self.lean))) + self.rng.normal(size=3) * 2e-4
        seat = PARAMS.piloting.seat_height * np.array((math.sin(self.tilt), 0.0, math.cos(self.tilt)))
        return Measurement(self.now - 5_000_000, at, turned(self.tilt), at + seat + rod, turned(self.lean))

    def took(self, setpoint) -> None:
        """Check what was answered: finite, within bounds, not before the last one; nothing armed after the end."""
        if setpoint is None:
            return
        numbers = np.array((*setpoint.body_rate, setpoint.thrust, *setpoint.tilt), dtype=float)
        assert numbers.shape == (6,) and np.isfinite(numbers).all(), "a setpoint that is not finite"
        assert np.abs(numbers[:3]).max() <= PARAMS.vehicle.max_body_rate, "body rate out of bounds"
        assert 0.0 <= setpoint.thrust <= SAFETY.max_thrust, "thrust out of bounds"
        assert setpoint.stamp >= self.last, "time runs backwards"
        guard = self.guard
        assert setpoint.armed is (guard.mode not in (Mode.DISARMED, Mode.READY)) or guard.ended is None, (
            "armed after all"
        )
        if not setpoint.armed:
            assert not numbers[:4].any(), "commands of a disarmed vehicle"
        self.last = setpoint.stamp

    def call(self, name: str, count: int = 0, kind: int = 0, size: float = 0.0) -> None:
        """One step of a script."""
        guard, value = self.guard, NONSENSE[kind]
        if name in ("feed", "bad", "old", "swap"):
            for index in range(count):
                frame = self.frame()
                if name == "bad":
                    field = Measurement._fields[(kind + index) % 5]
                    frame = value if kind % 7 == 6 else frame._replace(**{field: value})
                elif name == "old":
                    frame = frame._replace(stamp=frame.stamp - round(abs(size) * NANO))
                elif name == "swap":
                    frame = Measurement(frame.stamp, *frame[3:], *frame[1:3])
                self.took(guard.frame(self.now, frame))
                assert guard.accepted is None or np.isfinite(np.concatenate(guard.accepted[1:])).all(), "bad frame used"
        elif name == "silence":
            for _ in range(count):
                self.now += NANO // 120
                self.took(guard.tick(self.now))
        elif name in ("lean", "tilt", "move"):
            attribute = {"lean": "lean", "tilt": "tilt", "move": "x"}[name]
            for share in np.linspace(getattr(self, attribute), size, count).tolist():
                setattr(self, attribute, share)
                self.took(guard.frame(self.now, self.frame()))
        elif name == "step_clock":
            self.now = max(0, self.now + round(size * NANO))
        elif name == "arm":
            guard.arm(self.now)
        elif name in ("abort", "disarm"):
            self.took(guard.abort(self.now, "operator abort", disarm=name == "disarm"))
        elif name == "estimate":
            used = guard.receive_estimate(self.now, value if count % 2 else abs(size), 0.1 if count % 3 else value)
            low, high = PARAMS.estimation.length_min, PARAMS.estimation.length_max
            assert low <= used <= high, "a length out of range is used"
        elif name == "late":
            guard.solve_took(self.now, abs(size) / 10)
        elif name == "breaks":
            self.broken = Broken(guard.pilot, count % 6)
        elif name == "nonsense":
            self.nonsense(count % 7, value)

    def nonsense(self, which: int, value: object) -> None:
        """A call that makes no sense: answered, or one ValueError."""
        guard, mode = self.guard, self.guard.mode
        calls = (
            lambda: guard.frame(value, self.frame()),  # a time from the future is one: see below
            lambda: guard.tick(value),
            lambda: guard.arm(value),
            lambda: guard.solve_took(self.now, value),
            lambda: guard.abort(value, "operator abort"),
            lambda: guard.abort(self.now, value),
            lambda: guard.receive_estimate(value, 1.0),
        )
        time_like = isinstance(value, int | np.integer) and not isinstance(value, bool) and value >= 0
        if (which == 5 and isinstance(value, str) and value) or (which == 4 and time_like):
            return  # that one ends the flight, as it should
        try:
            answer = calls[which]()
        except ValueError as error:
            assert str(error), "an error without words"
            assert guard.mode is mode, "a refused call has changed the mode"
        else:
            self.took(answer) if which in (0, 1) else None


class Broken:
    """A solver that fails in a few ways, for five calls."""

    def __init__(self, pilot: Pilot, how: int) -> None:
        self._solve, self._how, self._left = pilot.solve, how, 5
        pilot.solve = self  # type: ignore[method-assign]

    def __call__(self, tick):
        solution = self._solve(tick)
        self._left -= 1
        if self._left < 0:
            return solution
        if self._how == 0:
            raise RuntimeError("singular")
        fields = {
            "inputs": (solution.inputs * math.nan, None, np.zeros((0, 2)), "none", solution.inputs)[self._how - 1]
        }
        return type(solution)(**{**vars(solution), **fields})


def turned(angle: float) -> np.ndarray:
    return np.array((0.0, math.sin(angle / 2), 0.0, math.cos(angle / 2)))


def failure(seed: int, calls: list[Call]) -> str | None:
    """What is wrong with a script, ``None`` if nothing is."""
    flight = Flight(seed)
    for name, arguments in calls:
        ended = flight.guard.ended
        try:
            flight.call(name, *arguments)
        except Exception as error:  # whatever it is, it is what is looked for
            return f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''} in {name}{arguments}"
        if ended is not None and (flight.guard.ended != ended or flight.guard.mode is not Mode.DISARMED):
            return f"the end was not final after {name}{arguments}"
    path = flight.guard.transitions
    if any(one.after is not two.before for one, two in itertools.pairwise(path)):
        return "transitions do not follow one another"
    if not all((entry.before, entry.after, entry.level) in TRANSITIONS for entry in path):
        return "a transition that is not in the table"
    return None


def shortened(seed: int, calls: list[Call]) -> list[Call]:
    """The script without the calls that its failure does not need."""
    for index in reversed(range(len(calls))):
        fewer = calls[:index] + calls[index + 1 :]
        if failure(seed, fewer):
            calls = fewer
    return calls


@pytest.mark.fuzz
def test_whatever_is_called_the_failsafe_answers_finite_bounded_setpoints_or_one_value_error():
    end, seed = time.monotonic() + BUDGET, SEED
    while seed < SEED + 3 or time.monotonic() < end:
        calls = script(seed)
        if why := failure(seed, calls):
            calls = shortened(seed, calls)
            pytest.fail(
                f"{why}\nseed {seed}; to repeat:\n"
                "    from tests.flight.test_guard_fuzz import Flight\n"
                f"    flight = Flight({seed})\n" + "".join(f"    flight.call({name!r}, *{a!r})\n" for name, a in calls)
            )
        seed += 1
    print(f"{seed - SEED} scripts from seed {SEED} on")


def test_a_failing_script_is_found_shortened_and_printed(monkeypatch):
    monkeypatch.setattr(Guard, "tick", lambda guard, now: 1 / 0)
    monkeypatch.setattr(
        "tests.flight.test_guard_fuzz.script", lambda seed: [("feed", (2,)), ("silence", (1,)), ("arm", ())]
    )
    with pytest.raises(pytest.fail.Exception) as caught:
        test_whatever_is_called_the_failsafe_answers_finite_bounded_setpoints_or_one_value_error()
    assert "ZeroDivisionError" in str(caught.value) and "flight.call('silence', *(1,))" in str(caught.value)
    assert "flight.call('feed'" not in str(caught.value)
