"""Betaflight's own firmware as the inner loop of the simulated vehicle, beside the delay-and-lag model.

``fip firmware install`` builds Betaflight 4.6.0 for this computer (SITL), unmodified, into a side environment,
.venv-betaflight; it needs gcc, make and the package index. It is under the GNU GPL, and no part of this package.
Simulated, every flight: a vehicle with motors as fiplib/flight/betaflight/airframe.py models it. Nothing here has flown
on hardware.
"""

import argparse
import contextlib
import dataclasses
import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fiplib import bags, replay, simulate
from fiplib.dynamics import PLANT
from fiplib.estimators import ESTIMATORS
from fiplib.flight.betaflight import airframe as model
from fiplib.flight.betaflight import sitl
from fiplib.flight.betaflight.airframe import Airframe, InnerLoop, MotorPlant
from fiplib.flight.crsf_frames import Encoder
from fiplib.flight.failsafe import Guard
from fiplib.flight.limits import Limits, changed, recorded
from fiplib.flight.links.simulated import HeldVehicle, VirtualLink
from fiplib.flight.loop import FlightLoop
from fiplib.flight.setpoint import Mode, Setpoint, disarmed, weight
from fiplib.params import NANO, Groups, Params, assignment
from fiplib.pilot import Pilot
from fiplib.recording import Measurement, MemoryRecorder
from fiplib.references import Hover
from fiplib.reproduction.measures import rms
from fiplib.simulate import Scenario, SimulatedEstimator
from fiplib.studies.estimators import summarise

REFITS = 0.5
"""A window each so many s is refitted."""
SETTLED = 0.01
"""Lean within which the rod counts as settled, m: three times the lean of a calm hover."""
AXES = ("roll", "pitch", "yaw")
STEP_TIME = 0.25
"""How long a step of the body rate is held, s."""


# --- flights behind the failsafe


class ObservedLink(VirtualLink):
    """The simulated vehicle in virtual time; ``rows`` (n, 17) are true state, body rates and commanded rates."""

    def __init__(self, scenario: Scenario, vehicle: HeldVehicle | None = None) -> None:
        super().__init__(scenario, vehicle)
        self.rows: list[NDArray] = []
        self._command = np.zeros(3)

    def receive(self, timeout: float) -> tuple[int, Measurement] | None:
        came, plant = super().receive(timeout), self.vehicle.plant
        if self.vehicle.flown is not None:
            self.rows.append(np.concatenate([plant.truth(), plant.x[PLANT["body_rate"]], self._command]))
        return came

    def send(self, setpoint: Setpoint) -> None:
        self._command = np.array(setpoint.body_rate)
        if self.rows:
            self.rows[-1][14:] = self._command
        super().send(setpoint)


@dataclasses.dataclass(frozen=True, eq=False)
class Flown:
    """A flight behind the failsafe in virtual time, as seen from outside from where the vehicle flies by itself.

    Attributes:
        scenario, metadata, tape: what was flown, and recorded.
        duration, balanced, ended: in s; whether the rod was up to the end; why the flight ended.
        time, truth: (n,) s, at the rate of motion capture; (n, 11) as ``recording.ROLES["truth_state"]``.
        rates, commands: (n, 3) rad/s, each command at the frame from which on it was sent.
    """

    scenario: Scenario
    metadata: dict[str, Any]
    tape: MemoryRecorder
    duration: float
    balanced: bool
    ended: str
    time: NDArray
    truth: NDArray
    rates: NDArray
    commands: NDArray

    @property
    def within(self) -> NDArray:
        """Return which frames belong to the scenario: what follows is the descent without the rod."""
        return self.time < min(self.scenario.duration, self.duration) - 1.0

    @property
    def lean(self) -> NDArray:
        """Offsets (n,) of the rod's COM, m, at all frames."""
        return np.hypot(self.truth[:, 4], self.truth[:, 6])

    @property
    def height_error(self) -> str:
        """Return the rms error of the height within the scenario, mm."""
        return f"{1e3 * rms(self.truth[self.within, 10] - self.scenario.reference.height):.1f}"

    def after_push(self, start: float, stop: float) -> tuple[float, float, float]:
        """Largest lean and distance from the reference, m, and time in s until the lean stays below ``SETTLED``."""
        rows = (self.time >= start) & (self.time < stop) & self.within
        if not rows.any():
            return math.nan, math.nan, math.inf
        time, truth, leaning = self.time[rows] - start, self.truth[rows], self.lean[rows]
        away = truth[:, [0, 2]] - self.scenario.reference.at(self.time[rows])[:, [0, 2]]
        over = np.flatnonzero(leaning > SETTLED)
        settled = math.inf if len(over) and over[-1] == len(time) - 1 else float(time[over[-1]]) if len(over) else 0.0
        return float(leaning.max()), float(np.hypot(*away.T).max()), settled

    def response(self, axis: int) -> model.Response:
        """The delay and lag that best turn the rates commanded in flight into those flown, from the sending on."""
        rows, params = self.within, self.scenario.params
        best = model.fit(self.commands[rows, axis], self.rates[rows, axis], 1.0 / params.piloting.mocap_rate)
        # commands are noted at the exposure they were computed from
        return best._replace(delay=best.delay - params.simulation.mocap_latency)

    def refitted(self) -> str:
        """Return the recommended estimator's result for the flight, as a sentence."""
        flight = self.tape.flight(self.scenario.name, self.metadata)
        seconds, end = flight.params.estimation.raw_window, flight.start_ns + round(self.scenario.duration * NANO)
        if not (windows := [one for stamp, one in replay.raw_windows(flight, seconds, REFITS) if stamp <= end]):
            return f"too short to estimate the length: it takes {seconds:g} s"
        answers = [ESTIMATORS["poses"].function(window, flight.params) for window in windows]
        found = summarise(answers, flight.params.pendulum.length)
        return (
            f"length from poses: {found['n']} of {len(answers)} windows of {seconds:g} s answered, "
            f"bias {1e3 * found['bias']:.1f} mm, RMS error {1e3 * found['rms']:.1f} mm, "
            f"{found['covered']} of their 95 % intervals cover the rod"
        )


def flown(scenario: Scenario, limits: Limits, link: ObservedLink, bag: Path | None = None, **metadata: Any) -> Flown:
    """Fly a scenario behind the failsafe, and record it into a bag, with more ``metadata``, if asked for."""
    metadata = {**scenario.metadata(), **metadata, "params": recorded(scenario.params, limits)}
    guard = Guard(Pilot(scenario.params, scenario.reference), limits)
    estimator = SimulatedEstimator(scenario.params, scenario.seed)
    with contextlib.ExitStack() as stack:
        tape = MemoryRecorder(stack.enter_context(bags.BagRecorder(bag, metadata)) if bag else None)
        loop = FlightLoop(scenario, link, guard, tape, estimator)
        loop.run()
    rows = np.array(link.rows).reshape(-1, 17)
    time = np.arange(len(rows)) / scenario.params.piloting.mocap_rate
    seen = time, *np.split(rows, (11, 14), axis=1)
    return Flown(scenario, metadata, tape, loop.duration, loop.balanced, guard.ended or "", *seen)


# --- step responses


class Curve(NamedTuple):
    """A step of ``size`` rad/s about ``axis``: the body rate (n,) from its command on, one per exchange."""

    axis: int
    size: float
    response: NDArray


def curves(
    params: Params, limits: Limits, airframe: Airframe, inner: InnerLoop, sizes: Sequence[float]
) -> Iterator[Curve]:
    """Step responses of the inner loop, hovering, frames coming at the control rate; ``sizes`` in rad/s.

    After each step it is stepped back, and put upright at rest. Raises FirmwareError if it does not arm.
    """
    params = params.replace(simulation__mocap_latency=0.0)
    encoder, rows = Encoder(params, limits), list[NDArray]()
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

    hold(sitl.WARM_UP, np.zeros(3), armed=False)
    hold(1.0, np.zeros(3))
    if plant.held:
        raise sitl.FirmwareError("Betaflight did not arm, or its motors do not carry the vehicle")
    for axis in range(3):
        for size in sizes:
            rate = np.zeros(3)
            rate[axis] = size
            plant.x[:16] = upright[:16]
            hold(0.5, np.zeros(3))
            yield Curve(axis, size, hold(STEP_TIME, rate)[:, axis])
            hold(STEP_TIME, -rate)


def fitted(curve: Curve, rate: float) -> model.Response:
    """Delay and lag of a step response, gain and misfit as shares of the step."""
    command = np.concatenate([[0.0], np.ones(len(curve.response) + 1)])
    return model.fit(command, np.concatenate([np.zeros(2), curve.response / curve.size]), 1.0 / rate)


# --- the command


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the commands of ``fip firmware`` and their options."""
    commands = parser.add_subparsers(dest="action", required=True, metavar="COMMAND")
    adding = commands.add_parser("install", help="build Betaflight SITL into .venv-betaflight")
    adding.add_argument("--again", action="store_true", help="throw the side environment away and build anew")
    described = {
        "step": "measure the rate loop's step responses, beside the delay-plus-lag model",
        "push": "fly the push flight on both inner loops and compare",
        "fly": "hover for 20 s, or fly another scenario; the rod stays up, or the exit status is 1",
        "settings": "print what is entered into Betaflight's command line",
    }
    outputs = {"step": "CSV file of the curves", "push": "folder for the bags", "fly": "bag"}
    for name, words in described.items():
        adding = commands.add_parser(name, help=words, description=words)
        add, many = adding.add_argument, {"action": "append", "default": []}
        add("--set", **many, metavar="GROUP.NAME=VALUE", help="change a parameter, as fip fly does")
        if name == "settings":
            continue
        add("--cli", **many, metavar="LINE", help="another line for Betaflight's command line")
        vehicle = "change the modelled vehicle, e.g. motor_lag=0.02 or inertia=1e-3,1e-3,2e-3; see airframe.py"
        add("--airframe", **many, metavar="NAME=VALUE", help=vehicle)
        add("--output", type=Path, metavar="PATH", help=f"{outputs[name]} to write (default: none)")
        if name == "step":
            sizes = [10.0, 30.0, 90.0]
            add("--sizes", type=float, nargs="+", default=sizes, metavar="DEG/S", help="sizes of the steps")
        else:
            add("--seed", type=int, help="seed of the sensors' noise (default: the scenario's)")
        if name == "fly":
            add("--scenario", metavar="NAME", help="one of fip fly --list (default: hover)")
            add("--duration", type=float, metavar="S", help="seconds (default: 20, or the scenario's)")


def run(options: argparse.Namespace) -> int:
    """Do what is asked for; 1 if a rod did not stay up. Raises FirmwareError: Betaflight cannot be built or started."""
    return {"install": install, "step": step, "push": push, "fly": fly, "settings": settings}[options.action](options)


def scenario_of(name: str, changes: Sequence[str], seed: int | None = None) -> tuple[Scenario, Limits]:
    """The scenario and its limits with the changes asked for; the radio knows the motors' curve. Raises ValueError."""
    if name not in simulate.SCENARIOS:
        raise ValueError(f"no scenario {name!r}; there are {', '.join(simulate.SCENARIOS)}")
    scenario, limits = simulate.SCENARIOS[name], Limits().replace(radio__thrust_curve=1.0)
    params, limits = changed(scenario.params, limits, map(assignment, changes))
    return dataclasses.replace(scenario, params=params, seed=scenario.seed if seed is None else seed), limits


@dataclasses.dataclass(frozen=True)
class Modelled(Groups):
    """The airframe as a group of parameters, which are changed and checked as all are."""

    airframe: Airframe = dataclasses.field(default_factory=Airframe)


@contextlib.contextmanager
def betaflight(
    options: argparse.Namespace, params: Params, limits: Limits
) -> Iterator[tuple[sitl.Betaflight, Airframe]]:
    """Betaflight with the settings of docs/firmware.md, then those of --cli; and the airframe that it flies."""
    changes = dict(assignment(f"airframe.{text}") for text in options.airframe)
    airframe = Modelled().replace(**changes).airframe
    *lines, save = model.settings(params, limits)
    with sitl.Betaflight([*lines, *options.cli, save], airframe.exchange_rate) as inner:
        yield inner, airframe


def install(options: argparse.Namespace) -> int:
    print(sitl.install(options.again))
    return 0


def settings(options: argparse.Namespace) -> int:
    scenario, limits = scenario_of("push-hover", options.set)
    print("\n".join(model.settings(scenario.params, limits)))
    return 0


def step(options: argparse.Namespace) -> int:
    scenario, limits = scenario_of("push-hover", options.set)
    params, simulation = scenario.params, scenario.params.simulation
    with betaflight(options, params, limits) as (inner, airframe):
        made = list(curves(params, limits, airframe, inner, np.radians(options.sizes).tolist()))
    rate = airframe.exchange_rate
    print("Rate loop of Betaflight 4.6.0 (SITL) on the modelled vehicle, from the arrival of a command. Simulated.")
    print("                 response, ms          over-  settled  best delay and lag, ms       misfit")
    print("step            10 %   63 %   90 %  shoot  to 5 %   delay    lag   sum   gain    rms")
    command = np.concatenate([[0.0], np.ones(round(STEP_TIME * rate) + 1)])
    unit = model.respond(command, 1.0 / rate, simulation.rate_delay, simulation.rate_lag)[2:]
    time = np.arange(1, len(unit) + 1) / rate
    names = [f"{AXES[curve.axis]:5} {math.degrees(curve.size):4.0f} deg/s" for curve in made]
    for name, curve in zip([*names, "delay and lag"], [*made, Curve(0, 1.0, unit)], strict=True):
        shape, best = model.step_shape(time, curve.response / curve.size), fitted(curve, rate)
        reached = f"{1e3 * shape.t10:6.1f} {1e3 * shape.t63:6.1f} {1e3 * shape.t90:6.1f} {100 * shape.overshoot:5.0f} %"
        print(
            f"{name:14}{reached} {1e3 * shape.settled:7.0f} {1e3 * best.delay:7.1f} {1e3 * best.lag:6.1f}"
            f" {1e3 * (best.delay + best.lag):5.1f} {best.gain:6.2f} {100 * best.residual:5.1f} %"
        )
    lags = f"{1e3 * simulation.rate_delay:g} ms and {1e3 * simulation.rate_lag:g} ms"
    print(f"delay and lag: the inner loop of fiplib/simulate.py, {lags}")
    if options.output is not None:
        header = ["time s", *(f"{AXES[c.axis]} {math.degrees(c.size):g} deg/s" for c in made), "delay and lag"]
        columns = [time, *(c.response / c.size for c in made), unit]
        np.savetxt(options.output, np.column_stack(columns), "%.6g", ",", header=",".join(header), comments="")
        print(f"wrote {options.output}: each response as a share of its step")
    return 0


def fly(options: argparse.Namespace) -> int:
    if options.duration is not None and not 0.0 < options.duration < math.inf:
        raise ValueError(f"--duration {options.duration:g}: give seconds > 0")
    scenario, limits = scenario_of(options.scenario or "push-hover", options.set, options.seed)
    if options.scenario is None:
        hover = {"name": "firmware-hover", "description": "Hover at (0, 0, 1.3) m", "reference": Hover()}
        scenario = dataclasses.replace(scenario, **hover, pushes=(), duration=20.0)
    scenario = dataclasses.replace(scenario, duration=options.duration or scenario.duration)
    with betaflight(options, scenario.params, limits) as (inner, airframe):
        flight, stopped = flown_on_firmware(scenario, limits, inner, airframe, options.output)
    end = "rod still up" if flight.balanced else "NOT UP TO THE END"
    print(f"simulated, Betaflight 4.6.0 as inner loop: {flight.duration:.2f} s, {end} ({flight.ended})")
    if not len(flight.time):
        print("it was never let go: the motors did not carry the vehicle")
    else:
        print(f"rms lean {1e3 * rms(flight.lean[flight.within]):.1f} mm, rms error of height {flight.height_error} mm")
        print(flight.refitted())
    print(f"motors after the disarm frame: {'stopped' if stopped else 'STILL TURNING'}; {inner.exchanges} exchanges")
    return 0 if flight.balanced and stopped else 1


def flown_on_firmware(
    scenario: Scenario, limits: Limits, inner: InnerLoop, airframe: Airframe, bag: Path | None
) -> tuple[Flown, bool]:
    """As ``flown``, on Betaflight; and whether the motors stop after the flight."""
    vehicle = sitl.MotorVehicle(scenario, limits, inner, airframe)
    more = {"inner_loop": "Betaflight 4.6.0 SITL", "airframe": dataclasses.asdict(airframe)}
    return flown(scenario, limits, ObservedLink(scenario, vehicle), bag, **more), vehicle.stopped()


def push(options: argparse.Namespace) -> int:
    scenario, limits = scenario_of("push-hover", options.set, options.seed)
    output = options.output
    if output is not None and output.exists():
        raise bags.BagError(f"{output} exists already; name another folder, or remove it")
    with betaflight(options, scenario.params, limits) as (inner, airframe):
        real, _ = flown_on_firmware(scenario, limits, inner, airframe, output and output / "firmware")
    bag = output and output / "delay-and-lag"
    flights = [real, flown(scenario, limits, ObservedLink(scenario), bag, inner_loop="delay and lag")]

    def row(name: str, values: Iterable[object], form: str = "") -> None:
        print(f"{name:36}" + "".join(f"{value:{form}}".rjust(12) for value in values))

    print(f"{scenario.description}. Simulated, behind the failsafe, on both inner loops.")
    row("", ["Betaflight", "delay+lag"])
    row("rod up to the end", ["yes" if flight.balanced else "NO" for flight in flights])
    stops = [*(one.start for one in scenario.pushes[1:]), scenario.duration]
    for one, stop in zip(scenario.pushes, stops, strict=True):
        lean, distance, settled = zip(*(flight.after_push(one.start, stop) for flight in flights), strict=True)
        size = f"{1e3 * math.hypot(*one.impulse):.1f} mN s at {one.start:g} s"
        row(f"{size}: lean, mm", [1e3 * value for value in lean], ".0f")
        row(f"{size}: distance, mm", [1e3 * value for value in distance], ".0f")
        row(f"{size}: settled in, s", settled, ".2f")
    calm = round(scenario.pushes[0].start * 240)
    row("lean before the pushes, rms mm", [1e3 * rms(flight.lean[flight.within][:calm]) for flight in flights], ".1f")
    row("error of height, rms mm", [flight.height_error for flight in flights])
    for axis, name in enumerate(AXES[:2]):
        best = [flight.response(axis) for flight in flights]
        row(f"{name} rate: best delay, ms", [1e3 * response.delay for response in best], ".1f")
        row(f"{name} rate: best lag, ms", [1e3 * response.lag for response in best], ".1f")
        row(f"{name} rate: gain", [response.gain for response in best], ".2f")
        row(f"{name} rate: misfit, rms deg/s", [math.degrees(response.residual) for response in best], ".1f")
    if output is not None:
        print(f"wrote {output}/firmware and {output}/delay-and-lag")
    return 0 if all(flight.balanced for flight in flights) else 1
