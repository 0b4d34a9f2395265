"""The simulated vehicle in a browser, in real time, under its user's hand; and a recorded flight as a page that plays.

``fip view`` serves the live view on the loopback interface until Ctrl-C; ``fip view BAG`` writes the page. In a
notebook, ``Viewer().show()`` embeds the live view in a cell.
"""

import argparse
import math
import queue
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fiplib import bags
from fiplib.controllers import CONTROLLERS, Controller
from fiplib.dynamics import PLANT
from fiplib.params import FipError, Params
from fiplib.teaching.by_hand import NO_ESTIMATE, WEIGHTS, HandFlight
from fiplib.teaching.scene import LOOPBACK, Scene, open_server, quiet

if TYPE_CHECKING:
    from IPython.display import IFrame

PICTURES = 30
"""Pictures a second."""

LATE = 0.25
"""Seconds that the flight may fall behind the clock before it gives them up, and flies slower than real time."""

PATIENCE = 10.0
"""Seconds within which the flight's thread must answer."""

CHOICES = (NO_ESTIMATE, "poses", "ga")
"""Estimators offered: none, the recommended one, and the paper's."""

OWN = "my own"
"""The choice of the user's own controller."""

PUSHES = {"+x": ("L", 1, 0), "-x": ("J", -1, 0), "+y": ("I", 0, 1), "-y": ("K", 0, -1)}
"""Directions of a push, with the key of each."""

STEPS = {"+x": ("H", 1, 0), "-x": ("F", -1, 0), "+y": ("T", 0, 1), "-y": ("G", 0, -1)}
"""Directions in which keys move the target, with the key of each."""

KEYS = "Keys, after a click into the scene: J L K I push, F H G T move the target, P pauses, R resets."


class Viewer:
    """A live view: a server on the loopback interface, and a thread that flies and draws.

    Args:
        own: a controller (params) -> Controller that is offered beside those of the library.
        seed: of noise and first lean; each reset takes the next.
    """

    def __init__(self, own: Callable[[Params], Controller] | None = None, seed: int = 1) -> None:
        self._own, self._seed = own, seed
        self._tasks: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._closing, self._paused, self._trouble = threading.Event(), False, ""
        self.server = open_server("fly it yourself")
        self._scene = Scene(self.server, Params())
        self._build()
        try:
            self.flight_by_hand = self._new_flight()
        except BaseException:
            with quiet():
                self.server.stop()
            raise
        self._thread = threading.Thread(target=self._run, name="viewer", daemon=True)
        self._thread.start()

    # --- for notebooks and tests ----------------------------------------------------------------------------------

    @property
    def address(self) -> str:
        """Where the view is served."""
        return f"http://{LOOPBACK}:{self.server.get_port()}"

    def show(self, height: int = 640) -> "IFrame":
        """Return the view as a frame of the notebook; the browser must run on this machine."""
        from IPython.display import IFrame

        return IFrame(self.address, width="100%", height=height)

    def do(self, task: Callable[[HandFlight], Any]) -> Any:
        """Run a task on the flight between two pictures, and return what it returns or raise what it raises.

        Raises FipError: the view is closed, or does not answer within ``PATIENCE``.
        """
        answer: Future[Any] = Future()

        def run() -> None:
            try:
                answer.set_result(task(self.flight_by_hand))
            except Exception as error:
                answer.set_exception(error)

        self._tasks.put(run)
        try:
            return answer.result(0.0 if self._closing.is_set() else PATIENCE)
        except TimeoutError:
            raise FipError("the view is closed: make a new Viewer()") from None

    def push(self, x: float, y: float) -> None:
        """Push the rod with an impulse (x, y) in N s."""
        self.do(lambda flight: flight.push(x, y))

    def choose(self, **choices: Any) -> None:
        """Begin a new flight with what is named of rod_length, used_length (m), estimator, controller and weights."""
        controls = {
            "rod_length": self._rod, "used_length": self._used, "estimator": self._estimator,
            "controller": self._controller, "weights": self._weights,
        }  # fmt: skip
        if unknown := choices.keys() - controls.keys():
            raise FipError(f"{', '.join(sorted(unknown))} cannot be chosen: {', '.join(controls)} can")

        def set_all() -> None:
            before = {name: controls[name].value for name in choices}
            try:
                for name, value in choices.items():
                    controls[name].value = value
                self._reset()
            except Exception:  # what is no choice must not stay chosen
                for name, value in before.items():
                    controls[name].value = value
                raise

        self.do(lambda flight: set_all())

    def pause(self, paused: bool = True) -> None:
        """Stop or continue time."""
        self._paused = paused

    def reset(self) -> None:
        """Begin a new flight with the rod, first length and estimator that are set."""
        self.do(lambda flight: self._reset())

    @property
    def status(self) -> str:
        """What the view says of the flight, as Markdown."""
        return self._status.content

    def close(self) -> None:
        """End flight, thread and server. A second call does nothing."""
        if not self._closing.is_set():
            self._closing.set()
            self._thread.join(PATIENCE)
            self.flight_by_hand.close()
            with quiet():
                self.server.stop()

    def __enter__(self) -> "Viewer":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    # --- controls -------------------------------------------------------------------------------------------------

    def _build(self) -> None:
        """Everything in the panel. A callback runs in a thread of the server: it leaves its task to the flight's."""
        gui, truth = self.server.gui, Params().pendulum.length
        self._status = gui.add_markdown("")
        with gui.add_folder("Push the rod"):
            self._impulse = gui.add_slider(
                "impulse (mN s)", 1.0, 40.0, 0.5, 5.0, hint="on its centre of mass, in 0.05 s"
            )
            directions = gui.add_button_group("direction", tuple(PUSHES))
            directions.on_click(lambda event: self._later(lambda: self._push(*PUSHES[directions.value][1:])))
        with gui.add_folder("Target"):
            self._target = [gui.add_slider(f"{axis} (m)", -1.0, 1.0, 0.05, 0.0) for axis in "xy"]
            self._circle = gui.add_checkbox("fly a circle", False)
        with gui.add_folder("Length"):
            self._used = gui.add_slider("used by the controller (m)", 0.2, 2.0, 0.01, truth)
            self._estimator = gui.add_dropdown(
                "estimator", CHOICES, initial_value=NO_ESTIMATE, hint="begins a new flight"
            )
            self._rod = gui.add_slider(
                "true length of the rod (m)", 0.3, 2.0, 0.05, truth, hint="from the next reset on"
            )
        with gui.add_folder("Controller"):
            names = (*CONTROLLERS, OWN) if self._own else tuple(CONTROLLERS)
            self._controller = gui.add_dropdown("controller", names, initial_value=OWN if self._own else "mpc")
            self._weights = gui.add_dropdown("weights", tuple(WEIGHTS))
        self._ghost = gui.add_checkbox("beside it: lean and tilt five times enlarged", False)
        buttons = gui.add_button("pause"), gui.add_button("reset")
        gui.add_markdown(KEYS)
        buttons[0].on_click(lambda event: self._toggle())
        buttons[1].on_click(lambda event: self._later(self._reset))
        for slider in self._target:
            slider.on_update(lambda event: self._later(self._go))
        self._circle.on_update(lambda event: self._later(self._go))
        self._used.on_update(lambda event: self._later(self._use_length))
        self._estimator.on_update(lambda event: self._later(self._reset))
        self._controller.on_update(lambda event: self._later(self._use_controller))
        self._weights.on_update(lambda event: self._later(lambda: self.flight_by_hand.use_weights(self._weights.value)))
        self._ghost.on_update(lambda event: self._scene.enlarge(self._ghost.value))
        self._pause_button = buttons[0]
        self._add_keys()

    def _add_keys(self) -> None:
        add = self.server.gui.add_command
        for direction, (key, x, y) in PUSHES.items():
            command = add(f"push the rod to {direction}", hotkey=key)
            command.on_trigger(lambda event, x=x, y=y: self._later(lambda: self._push(x, y)))
        for direction, (key, x, y) in STEPS.items():
            command = add(f"move the target to {direction}", hotkey=key)
            command.on_trigger(lambda event, x=x, y=y: self._step(x, y))
        add("pause or go on", hotkey="P").on_trigger(lambda event: self._toggle())
        add("reset", hotkey="R").on_trigger(lambda event: self._later(self._reset))

    def _later(self, task: Callable[[], None]) -> None:
        self._tasks.put(task)

    def _toggle(self) -> None:
        self.pause(not self._paused)
        self._pause_button.label = "go on" if self._paused else "pause"

    def _step(self, x: int, y: int) -> None:
        for slider, step in zip(self._target, (x, y), strict=True):
            slider.value = min(1.0, max(-1.0, slider.value + 0.1 * step))  # its callback moves the target

    def _push(self, x: int, y: int) -> None:
        size = 1e-3 * self._impulse.value
        self.flight_by_hand.push(size * x, size * y)

    def _go(self) -> None:
        flight = self.flight_by_hand
        place = self._target[0].value, self._target[1].value
        flight.target.circle(flight.seconds, self._circle.value)
        if flight.target.place != place:
            flight.target.go(flight.seconds, *place)

    def _use_length(self) -> None:
        if self._estimator.value == NO_ESTIMATE:
            self.flight_by_hand.use_length(self._used.value)

    def _use_controller(self) -> None:
        if self._controller.value == OWN and self._own:
            self.flight_by_hand.use_own(self._own)
        else:
            self.flight_by_hand.use_controller(self._controller.value)

    def _new_flight(self) -> HandFlight:
        name = self._controller.value
        own, name = (self._own, "mpc") if name == OWN else (None, name)
        flight = HandFlight(
            self._rod.value, self._used.value, self._estimator.value, name, self._weights.value, own, self._seed
        )
        self._seed += 1
        return flight

    def _reset(self) -> None:
        begun, ended = self._new_flight(), self.flight_by_hand
        ended.close()
        self._trouble = ""
        for slider in self._target:
            slider.value = 0.0
        self._circle.value = False
        self.flight_by_hand = begun
        self._scene.rod(self.flight_by_hand.params.pendulum.length)

    # --- the loop -------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        """Fly and draw, ``PICTURES`` times a second, asleep between the pictures."""
        period, picture, begun = 1.0 / PICTURES, 0, time.monotonic()
        while not self._closing.is_set():
            self._work()
            if not self._paused and not self._trouble:
                self._fly(round(self.flight_by_hand.vehicle.rate / PICTURES))
            with self.server.atomic():
                self._draw(picture)
            picture += 1
            ahead = begun + picture * period - time.monotonic()
            if ahead < -LATE:
                begun -= ahead
            self._closing.wait(max(ahead, 0.0))

    def _work(self) -> None:
        """What was asked for since the last picture."""
        while True:
            try:
                task = self._tasks.get_nowait()
            except queue.Empty:
                return
            self._guarded(task)

    def _fly(self, count: int) -> None:
        self._guarded(lambda: self.flight_by_hand.advance(count))

    def _guarded(self, task: Callable[[], None]) -> None:
        """Run a task of the user's, or with the user's controller in it: its failure is a sentence of the view."""
        try:
            task()
        except Exception as error:
            self._trouble = f"{error}" or type(error).__name__

    def _draw(self, picture: int) -> None:
        flight = self.flight_by_hand
        x = flight.vehicle.plant.x
        seat = x[PLANT["position"]]
        goal = flight.target.at([flight.seconds])[0]
        self._scene.show(seat, x[PLANT["attitude"]], x[PLANT["direction"]], (goal[0], goal[2], flight.target.height))
        if picture % 3 == 0 and not self._paused:
            self._scene.extend_track(seat)
        if picture % 6 == 0 and (words := self._words()) != self._status.content:
            self._status.content = words

    def _words(self) -> str:
        flight = self.flight_by_hand
        estimate, used = flight.estimate, flight.pilot.length
        if self._trouble:
            state = f"**stopped:** {self._trouble} Press reset."
        elif flight.fallen:
            state = "**fallen:** press reset."
        elif flight.over:
            state = "**the flight is over:** press reset."
        else:
            state = "paused" if self._paused else "standing"
        words = f"{state}  \ntime {flight.seconds:.1f} s, simulated  \nlength in use {used:.3f} m"
        if math.isfinite(estimate.length):
            half = 1.96 * estimate.standard_deviation
            words += f"  \nestimate {estimate.length:.3f} m"
            if math.isfinite(half):
                words += f", 95 % interval {estimate.length - half:.3f} to {estimate.length + half:.3f} m"
        return words


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``fip view``."""
    parser.add_argument("bag", nargs="?", type=Path, help="a recorded flight, to be written as a page that plays it")
    parser.add_argument("--output", type=Path, help="the page (default: the name of the bag with .html)")


def run(options: argparse.Namespace) -> int:
    """Serve the live view until Ctrl-C, or write a recorded flight as a page. Returns the exit status."""
    if options.bag is not None:
        from fiplib.teaching.recorded import write_page

        path = options.output or Path(f"{options.bag.resolve().stem}.html")
        write_page(bags.read(options.bag), path)
        print(f"wrote {path} ({path.stat().st_size / 1e6:.1f} MB): open it in a browser, no server is needed")
        return 0
    with Viewer() as viewer:
        print(f"{viewer.address} in a browser on this machine; Ctrl-C ends it", flush=True)
        threading.Event().wait()
    return 0
