"""The self-test before a real vehicle is flown: it measures what it says, and refuses what it must."""

import itertools

import pytest

from fiplib.bags.live import LiveRecorder
from fiplib.flight import session
from fiplib.flight.limits import Limits
from fiplib.flight.self_test import DeadlineError, Punctuality, measured
from fiplib.flight.session import Session
from fiplib.params import NANO, Params
from fiplib.pilot import Pilot
from fiplib.recording import Measurement, MemoryRecorder
from fiplib.references import Hover
from fiplib.simulate import SCENARIOS

SAFETY = Limits().safety
TICK = NANO // 120


class Machine:
    """Time as a machine passes it that wakes us late, and on which a pilot works for so long at each tick, s."""

    def __init__(self, late, busy):
        self.params, self.reference = Params(), Hover()
        self._now, self._late, self._busy, self._frames = 7 * NANO, itertools.cycle(late), busy, 0

    def clock(self) -> int:
        return self._now

    def sleep(self, seconds: float) -> None:
        self._now += round((seconds + next(self._late)) * NANO)

    def step(self, now: int, measurement: Measurement) -> None:
        """The pilot's: two frames to a tick, after one to begin with."""
        self._frames += 1
        self._now += round(self._busy * NANO / 2) if self._frames > 1 else 0


@pytest.mark.parametrize(
    ("late", "busy", "expected", "kept"),
    [
        ((0.0,), 0.001, (0, 0.001), True),
        ((0.002,), 0.004, (0, 0.006), True),
        ((0.0,), 0.009, (120, 120 * 0.009 - 119 / 120), False),  # each answer delays the next
        ((0.0,) * 59 + (0.01,), 0.001, (1, 0.011), True),  # 2 of 120 may be late
        ((0.0,) * 29 + (0.01,), 0.001, (3, 0.011), False),
        ((0.0,) * 119 + (0.05,), 0.001, (1, 0.051), False),  # by as much no pose may be
    ],
)
def test_ticks_are_late_by_the_wake_up_and_the_work_together(late, busy, expected, kept):
    machine = Machine(late, busy)
    found = measured(machine, SAFETY, machine.clock, machine.sleep)
    assert (found.ticks, found.late) == (120, expected[0])
    assert found.worst == pytest.approx(expected[1], abs=1e-6) and found.kept(SAFETY) is kept


def test_on_this_machine_it_takes_a_second():
    found = measured(Pilot(Params(), Hover()), SAFETY)
    assert found.ticks == 120 and found.worst > 0.0 and f"{found.late} of 120 ticks late" in str(found)


class Closed(session.Link):
    """A link that cannot be opened: it comes after the self-test."""

    name, origin = "closed", "real"

    def __enter__(self):
        raise OSError("opened")


@pytest.fixture
def surroundings(monkeypatch):
    monkeypatch.setattr(session, "LiveRecorder", lambda *_: Recorder())
    monkeypatch.setattr(session, "urgent", lambda level: False)


class Recorder(MemoryRecorder):
    pid = 0

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass


LATE, KEPT = Punctuality(120, 30, 0.04), Punctuality(120, 0, 0.002)


@pytest.mark.parametrize(("tested", "result"), [(True, KEPT), (False, LATE), (None, LATE)])
def test_a_flight_goes_on_to_its_link_where_deadlines_are_kept_or_nobody_asks(
    surroundings, monkeypatch, tmp_path, capsys, tested, result
):
    monkeypatch.setattr(session, "measured", lambda *_: result)
    with pytest.raises(OSError, match="opened"):
        with Session(SCENARIOS["push-hover"], Limits(), Closed(), tmp_path / "bag", real_time=True, tested=tested):
            pytest.fail("entered")
    said = capsys.readouterr().err
    assert "real-time scheduling is refused" in said and (str(result) in said) is (tested is not None)


def test_a_real_vehicle_is_not_flown_where_deadlines_are_missed(surroundings, monkeypatch, tmp_path):
    monkeypatch.setattr(session, "measured", lambda *_: LATE)
    with pytest.raises(DeadlineError, match=r"30 of 120 ticks late, .*40.0 ms.*--ignore-self-test"):
        with Session(SCENARIOS["push-hover"], Limits(), Closed(), tmp_path / "bag", real_time=True, tested=True):
            pytest.fail("entered")
    assert LiveRecorder is not session.LiveRecorder
