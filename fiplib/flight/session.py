"""The surroundings of a flight behind the failsafe: operator, recorder, estimator, display, link."""

import contextlib
import os
import shutil
import tempfile
from pathlib import Path
from typing import Any, Self

from fiplib import bags, kernels
from fiplib.bags.live import LiveRecorder
from fiplib.flight.display import View
from fiplib.flight.estimator import EstimatorProcess
from fiplib.flight.limits import Limits, recorded
from fiplib.flight.links import Link
from fiplib.flight.operator_input import OperatorInput
from fiplib.flight.sender import urgent
from fiplib.recording import Recorder
from fiplib.simulate import ParallelEstimator, Scenario, SimulatedEstimator


class NewBag:
    """Makes room for a bag at ``path``; a context manager.

    With ``force`` a bag that is there already is put aside, and deleted when the flight is over. A flight that does not
    begin (``begun``) brings it back, and leaves no bag of its own. Anything but a bag is left alone.
    """

    def __init__(self, path: Path, force: bool) -> None:
        self._path, self._force = path, force
        self._aside: Path | None = None
        self.begun = False

    def __enter__(self) -> Self:
        path = self._path
        if self._force and path.is_dir() and {entry.suffix for entry in path.iterdir()} <= {".mcap", ".yaml"}:
            self._aside = Path(tempfile.mkdtemp(prefix=f".{path.name}-", dir=path.parent)) / path.name
            path.rename(self._aside)
        self._absent = not path.exists()
        return self

    def __exit__(self, *_: object) -> None:
        if not self.begun and self._absent:
            shutil.rmtree(self._path, ignore_errors=True)
        if self._aside is not None:
            if not self.begun:
                self._aside.rename(self._path)
            shutil.rmtree(self._aside.parent)


class Session:
    """Opens operator, recorder, estimator, display and link, and closes them in reverse; a context manager.

    Args:
        link: not yet open.
        output: folder of the bag to write.
        real_time: with processes of their own for recorder and estimator, and a display; else in virtual time.
        ask: whether the operator arms by the Enter key.
        force: replace a bag that is there already.

    Attributes:
        operator, recorder, estimator, view: to be given to ``FlightLoop``; the last two may be ``None``.
        metadata: of the bag.

    Raises:
        BagError: on entering, the recording cannot begin; on leaving, it does not hold the whole flight.
        LinkError: on entering, the link cannot be opened.
    """

    recorder: Recorder
    estimator: ParallelEstimator | None = None
    view: View | None = None

    def __init__(
        self,
        scenario: Scenario,
        limits: Limits,
        link: Link,
        output: Path,
        real_time: bool,
        ask: bool = False,
        force: bool = False,
    ) -> None:
        self.scenario, self.link, self.output, self.real_time = scenario, link, output, real_time
        self._limits, self._ask = limits, ask
        self.operator = OperatorInput(ask)
        self._bag = NewBag(output, force)
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
            stack.enter_context(self._bag)
            stack.enter_context(self.operator)
            if self.real_time:
                kernels.load()  # here, and never within a tick
                self._open_beside(stack)
            else:
                self.recorder = stack.enter_context(bags.BagRecorder(self.output, self.metadata))
                self.estimator = SimulatedEstimator(self.scenario.params, self.scenario.seed)
            stack.enter_context(self.link)
            self._bag.begun = True
            self._stack = stack.pop_all()
        if self.real_time:
            urgent(1)
        return self

    def __exit__(self, *raised: Any) -> bool | None:
        return self._stack.__exit__(*raised)

    def _open_beside(self, stack: contextlib.ExitStack) -> None:
        params = self.scenario.params
        self.recorder = self._processes["recorder"] = stack.enter_context(LiveRecorder(self.output, self.metadata))
        if params.piloting.estimate:
            process = EstimatorProcess(params, self.scenario.seed, self._limits)
            self.estimator = self._processes["estimator"] = stack.enter_context(process)
        self.view = stack.enter_context(View())
        self.view.say("starting; Ctrl-C lands, a second one stops the motors")
        if self._ask:
            self.view.say("Enter arms once the vehicle is ready, Enter again lands")
