"""The surroundings of a flight behind the failsafe: operator, recorder, estimator, display, link."""

import contextlib
import os
from pathlib import Path
from typing import Any, Self

from fiplib import bags, kernels
from fiplib.bags.live import LiveRecorder
from fiplib.bags.replacing import NewBag
from fiplib.flight.display import View
from fiplib.flight.estimator import EstimatorProcess
from fiplib.flight.limits import Limits, recorded
from fiplib.flight.links import Link
from fiplib.flight.operator_input import OperatorInput
from fiplib.flight.self_test import DeadlineError, measured
from fiplib.flight.sender import urgent
from fiplib.pilot import Pilot
from fiplib.recording import Recorder
from fiplib.simulate import ParallelEstimator, Scenario, SimulatedEstimator

REFUSED = "real-time scheduling is refused: what else runs on this machine can delay the flight (root or CAP_SYS_NICE)"


class Session:
    """Opens operator, recorder, estimator, display and link, and closes them in reverse; a context manager.

    Args:
        link: not yet open.
        output: folder of the bag to write.
        real_time: with processes of their own for recorder and estimator, and a display; else in virtual time.
        ask: whether the operator arms by the Enter key.
        tested: refuse to fly where the machine fails a self-test of its deadlines, for a second before the link is
            opened; with ``False`` its result is said alone, and with ``None`` there is no test.
        force: replace a bag that is there already, once this flight has been recorded.

    Attributes:
        operator, recorder, estimator, view: to be given to ``FlightLoop``; the last two may be ``None``.
        scheduled: whether real-time scheduling was allowed; in virtual time it is not requested.
        metadata: of the bag.
        bag: where it is recorded; its ``flown`` is to be set once the vehicle has flown.

    Raises:
        BagError: on entering, the recording cannot begin; on leaving, it does not hold the whole flight.
        LinkError: on entering, the link cannot be opened.
        DeadlineError: on entering, the machine does not keep the deadlines.
    """

    recorder: Recorder
    estimator: ParallelEstimator | None = None
    view: View | None = None
    scheduled = True

    def __init__(
        self,
        scenario: Scenario,
        limits: Limits,
        link: Link,
        output: Path,
        real_time: bool,
        ask: bool = False,
        force: bool = False,
        tested: bool | None = None,
    ) -> None:
        self.scenario, self.link, self.output, self.real_time = scenario, link, output, real_time
        self._limits, self._ask, self._tested = limits, ask, tested
        self.operator = OperatorInput(ask)
        self.bag = NewBag(output, force)
        origin = {"origin": link.origin, "link": link.name, "real_time": real_time}
        self.metadata = {**scenario.metadata(), **origin, "params": recorded(scenario.params, limits)}
        self._processes: dict[str, LiveRecorder | EstimatorProcess] = {}

    @property
    def pids(self) -> dict[str, int]:
        """The ids of the processes of the flight, by name; that of the estimator changes when it is restarted."""
        beside = {name: process.pid for name, process in self._processes.items() if process.pid}
        return {"pilot": os.getpid(), **beside, **self.link.pids}

    def __enter__(self) -> Self:
        # left in reverse order: the commands end first, then the rest
        with contextlib.ExitStack() as stack:
            stack.enter_context(self.bag)
            stack.enter_context(self.operator)
            if self.real_time:
                kernels.load()  # here, and never within a tick
                self._open_beside(stack)
                self._be_punctual()
            else:
                self.recorder = stack.enter_context(bags.BagRecorder(self.bag.path, self.metadata))
                self.estimator = SimulatedEstimator(self.scenario.params, self.scenario.seed)
            stack.enter_context(self.link)
            self.bag.begun = True
            self._stack = stack.pop_all()
        if not self.scheduled:
            self.recorder.event(self.link.now(), "warn", REFUSED)
        return self

    def _be_punctual(self) -> None:
        """Ask for real-time scheduling, and test the machine. Raises DeadlineError."""
        self.scheduled = urgent(1)
        if not self.scheduled and self.view is not None:
            self.view.say(REFUSED)
        if self._tested is None:
            return
        result = measured(Pilot(self.scenario.params, self.scenario.reference), self._limits.safety)
        if self._tested and not result.kept(self._limits.safety):
            scheduling = "with real-time scheduling" if self.scheduled else f"and {REFUSED}"
            raise DeadlineError(
                f"this machine does not keep the deadlines, {scheduling} ({result}): stop what else runs here, or take "
                "another one; --ignore-self-test flies all the same"
            )
        if self.view is not None:
            self.view.say(str(result))

    def __exit__(self, *raised: Any) -> bool | None:
        return self._stack.__exit__(*raised)

    def _open_beside(self, stack: contextlib.ExitStack) -> None:
        params = self.scenario.params
        self.recorder = self._processes["recorder"] = stack.enter_context(LiveRecorder(self.bag.path, self.metadata))
        if params.piloting.estimate:
            process = EstimatorProcess(params, self.scenario.seed, self._limits)
            self.estimator = self._processes["estimator"] = stack.enter_context(process)
        self.view = stack.enter_context(View())
        self.view.say("starting; Ctrl-C lands, a second one stops the motors")
        if self._ask:
            self.view.say("Enter arms once the vehicle is ready, Enter again lands")
