"""The vehicle with motors and the packets of Betaflight SITL; and, where asked for, Betaflight itself as inner loop.

What needs Betaflight is skipped unless FIP_FIRMWARE=1 is set: it builds the firmware with gcc into .venv-betaflight,
which takes a minute or two and the package index, once.
"""

import argparse
import dataclasses
import math
import os
import platform
import re
import shutil
import struct
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fiplib import bags
from fiplib.dynamics import PLANT, coupled_plant
from fiplib.flight.betaflight import airframe as model
from fiplib.flight.betaflight import sitl
from fiplib.flight.betaflight.airframe import (
    SPEEDS,
    Airframe,
    InnerLoop,
    MotorPlant,
    fit,
    mixing,
    motor_plant,
    respond,
    settings,
    step_shape,
)
from fiplib.flight.crsf_frames import Encoder, count, pack
from fiplib.flight.limits import Limits
from fiplib.flight.setpoint import Mode, Setpoint, disarmed
from fiplib.params import GRAVITY, Params
from fiplib.references import Hover
from fiplib.simulate import SCENARIOS
from fiplib.studies import betaflight as study

ROOT = Path(__file__).parents[2]

RUN = "FIP_FIRMWARE=1 python -m pytest tests/studies/test_firmware.py"
betaflight = pytest.mark.skipif(
    os.environ.get("FIP_FIRMWARE") != "1",
    reason=f"firmware in the loop is run where asked for: {RUN} (builds Betaflight once, a minute or two)",
)

PARAMS, LIMITS = Params(), Limits().replace(radio__thrust_curve=1.0)
AIRFRAME = Airframe()
WEIGHT = (PARAMS.vehicle.mass + PARAMS.pendulum.mass) * GRAVITY
HOVERING = math.sqrt(WEIGHT / PARAMS.vehicle.max_thrust)
"""Speed of a motor that carries a quarter of the weight."""
IDLE = Encoder(PARAMS, LIMITS).channels(0, disarmed(0))
CENTRED = count(1500.0)


class Steady:
    """A firmware whose motors always get the same, and which notes what it was shown."""

    def __init__(self, outputs: Sequence[float]) -> None:
        self.outputs = np.array(outputs, dtype=float)
        self.forces: list[NDArray] = []
        self.frames: list[tuple[int, Sequence[int]]] = []
        self.exchanges = 0

    def exchange(
        self, body_rate: NDArray, specific_force: NDArray, attitude: NDArray, channels: Sequence[int] | None
    ) -> NDArray:
        self.forces.append(specific_force.copy())
        if channels is not None:
            self.frames.append((self.exchanges, channels))
        self.exchanges += 1
        return self.outputs


class Plain:
    """A stand-in for Betaflight: body rates in proportion to their error, motors linearised, arms at once."""

    def __init__(self, params: Params) -> None:
        self._params = params
        self._unmix = np.linalg.inv(mixing(params, AIRFRAME))
        self._sticks, self._armed = np.zeros(4), False

    def exchange(
        self, body_rate: NDArray, specific_force: NDArray, attitude: NDArray, channels: Sequence[int] | None
    ) -> NDArray:
        if channels is not None:
            roll, pitch, throttle, yaw, arm = model.microseconds(channels)[:5]
            low = LIMITS.radio.throttle_low
            self._armed = arm > 1700
            self._sticks = np.array([roll - 1500, pitch - 1500, 1500 - yaw, (throttle - low) / (2000 - low)])
        if not self._armed:
            return np.zeros(4)
        idle, wanted = LIMITS.radio.motor_idle, self._sticks[:3] / 500 * self._params.vehicle.max_body_rate
        drive = idle + (1.0 - idle) * max(self._sticks[3], 0.0)
        torque = np.array(AIRFRAME.inertia) * 40.0 * (wanted - body_rate)
        thrusts = self._unmix @ np.array([self._params.vehicle.max_thrust * drive**2, *torque])
        return np.sqrt(np.clip(thrusts * 4 / self._params.vehicle.max_thrust, idle**2, 1.0))


def plant_of(inner: InnerLoop, params: Params = PARAMS) -> MotorPlant:
    return MotorPlant(params, (0.0, 0.0, 1.3), (0.0, 0.0), inner, AIRFRAME, IDLE)


def state(body_rate: Sequence[float] = (0.0, 0.0, 0.0), speeds: Sequence[float] = (HOVERING,) * 4) -> NDArray:
    x = np.zeros(23)
    x[2], x[9], x[12] = 1.3, 1.0, 1.0
    x[PLANT["body_rate"]], x[SPEEDS] = body_rate, speeds
    return x


# --- packets


def test_the_state_packet_is_forward_right_down_with_a_constant_stamp():
    packet = model.sensors((0.1, 0.2, 0.3), (1.0, 2.0, 9.81), (0.5, 0.6, 0.7, 0.8))
    values = struct.unpack("<18d", packet)
    assert values[0] == 0.0
    assert values[1:4] == (0.1, -0.2, -0.3)
    # SITL negates the acceleration again on reading: +1 g upwards at rest
    assert values[4:7] == (-1.0, -2.0, -9.81)
    assert values[7:11] == (0.8, 0.5, 0.6, 0.7), "w first"


def test_the_radio_packet_carries_what_betaflight_reads_from_crsf():
    packet = model.radio([CENTRED, 172, 1811, 0, 2047] + [CENTRED] * 11)
    assert len(packet) == 40
    stamp, *channels = struct.unpack("<d16H", packet)
    # 0.62477 times the value + 881, rounded to whole us
    assert (stamp, channels[:5]) == (0.0, [1500, 988, 2012, 881, 2160])


def test_the_motors_packet_comes_as_two_three_four_one():
    assert model.motors(struct.pack("<4f", 0.25, 0.5, 0.75, 1.0)).tolist() == [1.0, 0.25, 0.5, 0.75]
    with pytest.raises(ValueError, match="16 bytes, not 12"):
        model.motors(b"\0" * 12)


@given(st.lists(st.integers(0, 2047), min_size=16, max_size=16))
def test_whatever_the_encoder_can_send_fits_the_radio_packet_within_half_a_microsecond(channels):
    pack(channels)  # a valid CRSF frame
    exact = [0.62477 * channel + 881 for channel in channels]
    sent = struct.unpack("<d16H", model.radio(channels))[1:]
    # rounding, and the five digits of 0.62477
    assert np.abs(np.subtract(sent, exact)).max() <= 0.51


def test_the_settings_are_those_of_the_radio_without_what_sitl_lacks():
    lines = settings(PARAMS, LIMITS)
    assert not [line for line in lines if "serialrx" in line]
    assert lines[-1] == "save" and lines.count("save") == 1 and len(set(lines)) == len(lines)
    for line in ("set rates_type = ACTUAL", "set roll_rc_rate = 10", "set roll_srate = 10", "map AETR1234"):
        assert line in lines
    assert {"set rc_smoothing = OFF", "set simplified_feedforward_gain = 0"} < set(lines)


# --- the vehicle with motors


def test_motors_turn_the_vehicle_as_in_betaflights_quad_x():
    wrench = mixing(PARAMS, AIRFRAME)
    rear_right, front_right, rear_left, front_left = np.sign(wrench.T).tolist()
    # thrust, roll right side down, pitch nose down, yaw left (that is against the propeller's turn)
    assert rear_right == [1.0, -1.0, 1.0, 1.0]
    assert front_right == [1.0, -1.0, -1.0, -1.0]
    assert rear_left == [1.0, 1.0, 1.0, -1.0]
    assert front_left == [1.0, 1.0, -1.0, 1.0]
    # exact: sums of numbers that differ in sign alone
    assert (wrench @ np.ones(4)).tolist() == [4.0, 0.0, 0.0, 0.0]


def test_vehicle_and_rod_move_as_in_the_coupled_plant_under_the_same_thrust():
    rng = np.random.default_rng(5)
    x = state(rng.normal(size=3), 0.4 + 0.05 * rng.normal(size=4))
    x[:10] = rng.normal(size=10)
    x[6:10] /= np.linalg.norm(x[6:10])
    x[10:13] = (0.1, -0.2, math.sqrt(0.95))
    x[13:16] = (0.3, 0.1, 0.0)
    force, command = rng.normal(size=3), rng.uniform(size=4)
    thrust = PARAMS.vehicle.max_thrust / 4 * float(np.sum(x[SPEEDS] ** 2))
    ours = np.array(motor_plant(PARAMS, AIRFRAME)(x, command, force)).ravel()
    # the lag's command under which the plant's rates change as the motors' torques make them
    commanded = [*(x[16:19] + PARAMS.simulation.rate_lag * ours[16:19]), thrust]
    theirs = np.array(coupled_plant(PARAMS)([*x[:19], thrust], commanded, force)).ravel()
    # the same expressions, up to the rounding of the thrust
    np.testing.assert_allclose(ours[:16], theirs[:16], rtol=1e-12, atol=1e-12)


def test_vehicle_and_rod_change_momentum_and_angular_momentum_by_the_forces_on_them():
    """Newton and Euler for both bodies together, about the world's origin: what the seat transmits cancels."""
    rng, m, rod = np.random.default_rng(8), PARAMS.vehicle.mass, PARAMS.pendulum
    r, h, turn = rod.length / 2, PARAMS.vehicle.seat_height, rod.mass * rod.gyration_ratio * rod.length**2
    plant, inertia = motor_plant(PARAMS, AIRFRAME), np.array(AIRFRAME.inertia)
    for _ in range(20):
        x = state(rng.normal(size=3), 0.4 + 0.05 * rng.normal(size=4))
        x[:10] = rng.normal(size=10)
        x[6:10] /= np.linalg.norm(x[6:10])
        q = rng.normal(size=3)
        x[10:13] = q / np.linalg.norm(q)
        x[13:16] = np.cross(rng.normal(size=3), x[10:13])
        force = rng.normal(size=3)
        # motors that keep their speed: no reaction to their acceleration
        x_dot = np.array(plant(x, x[SPEEDS], force)).ravel()

        def momenta(x: np.ndarray) -> np.ndarray:
            turned = Rotation.from_quat(x[6:10])
            omega = turned.apply(x[16:19])
            place, velocity = x[:3] - h * turned.apply([0, 0, 1]), x[3:6] - h * np.cross(omega, turned.apply([0, 0, 1]))
            com, com_velocity = x[:3] + r * x[10:13], x[3:6] + r * x[13:16]
            own = turned.apply(inertia * x[16:19]) + turn * np.cross(x[10:13], x[13:16])
            linear = m * velocity + rod.mass * com_velocity
            return np.r_[linear, own + m * np.cross(place, velocity) + rod.mass * np.cross(com, com_velocity)]

        step = 1e-6
        change = (momenta(x + step * x_dot) - momenta(x - step * x_dot)) / (2 * step)
        turned, wrench = Rotation.from_quat(x[6:10]), mixing(PARAMS, AIRFRAME) @ (8.0 * x[SPEEDS] ** 2)
        e, com = turned.apply([0, 0, 1]), x[:3] + r * x[10:13]
        lift, fall = wrench[0] * e, np.array([0, 0, -GRAVITY])
        place = x[:3] - h * e
        about = np.cross(place, lift + m * fall) + turned.apply(wrench[1:]) + np.cross(com, force + rod.mass * fall)
        # rounding of momenta of about 10 over 2 us
        np.testing.assert_allclose(change, np.r_[lift + force + (m + rod.mass) * fall, about], atol=1e-7)


def test_a_hovering_vehicle_stays():
    still = np.array(motor_plant(PARAMS, AIRFRAME)(state(), np.full(4, HOVERING), np.zeros(3))).ravel()
    # the root's rounding, times 9.81
    np.testing.assert_allclose(still, 0.0, atol=1e-13)


def test_without_torque_angular_momentum_and_energy_of_the_rotation_are_kept():
    # a seat at the centre of mass, where the rod exerts no torque
    plant = plant_of(Steady([0.0] * 4), PARAMS.replace(vehicle__seat_height=0.0))
    plant.held = False
    plant.x[PLANT["body_rate"]] = (4.0, 0.5, 3.0)
    inertia = np.array(AIRFRAME.inertia)

    def kept() -> tuple[float, float]:
        momentum = inertia * plant.x[PLANT["body_rate"]]
        return float(np.linalg.norm(momentum)), float(momentum @ plant.x[PLANT["body_rate"]])

    before = kept()
    for _ in range(240):
        plant.advance()
    # RK4 at 1920 Hz of a motion at 5 rad/s: relative error (5 / 1920)^4 a step at most, 1920 steps
    np.testing.assert_allclose(kept(), before, rtol=1e-7)
    turned = np.abs(plant.x[PLANT["body_rate"]] - (4.0, 0.5, 3.0))
    assert turned.max() > 0.5, "a body with three different moments of inertia does not keep its rates"


def test_a_motor_follows_its_command_with_its_lag():
    x_dot = np.array(motor_plant(PARAMS, AIRFRAME)(state(speeds=(0.2,) * 4), (0.5, 0.2, 0.2, 0.2), np.zeros(3))).ravel()
    # (0.5 - 0.2) / 30 ms, to rounding
    np.testing.assert_allclose(x_dot[SPEEDS], [10.0, 0.0, 0.0, 0.0], rtol=1e-12, atol=1e-12)
    # motor 1 turns clockwise: sped up, it turns the vehicle left at once, before its drag has changed
    assert x_dot[18] == pytest.approx(AIRFRAME.spin * 10.0 / AIRFRAME.inertia[2], rel=1e-12)


def test_it_is_held_until_the_motors_carry_it():
    weak, strong = plant_of(Steady([0.9 * HOVERING] * 4)), plant_of(Steady([HOVERING] * 4))
    before = weak.x[:19].copy()
    for _ in range(120):
        weak.advance()
        strong.advance()
    assert weak.held and (weak.x[:19] == before).all()
    assert weak.thrust == pytest.approx(0.81 * WEIGHT, rel=1e-6), "speeds settle within half a second: 17 lags"
    assert not strong.held
    # it is let go at 95 % of the weight and sinks until the motors have caught up, over some lags
    assert 1.28 < strong.x[2] < 1.3


def test_an_accelerometer_shows_thrust_alone():
    falling = Steady([0.0] * 4)
    plant = plant_of(falling)
    plant.held = False
    for _ in range(4):
        plant.advance()
    assert falling.forces[0].tolist() == [0.0, 0.0, GRAVITY], "held: as on a table"
    # in free fall nothing is felt; to the rounding of 9.81 - 9.81
    np.testing.assert_allclose(falling.forces[-1], 0.0, atol=1e-12)
    tilted = Steady([HOVERING] * 4)
    plant = plant_of(tilted, PARAMS.replace(pendulum__mass=1e-9))
    plant.held = False
    plant.x[6:10] = (0.0, math.sin(0.2), 0.0, math.cos(0.2))
    plant.x[SPEEDS] = HOVERING
    plant.advance()
    # along the body's z axis at any tilt; a rod of 1e-9 kg pushes back by less than 1e-7 m/s^2
    mass = PARAMS.vehicle.mass + 1e-9
    np.testing.assert_allclose(tilted.forces[-1], [0.0, 0.0, WEIGHT / mass], atol=1e-6)


def test_channels_arrive_after_the_latency_of_motion_capture():
    inner = Steady([0.0] * 4)
    plant = plant_of(inner)
    plant.advance()
    marked = [CENTRED] * 16
    plant.channels(marked)
    plant.advance()
    plant.advance()
    # the idle frame at the start; then one frame, 8 exchanges, after the one in which it was sent at exchange 8
    assert [(at, frame is marked) for at, frame in inner.frames] == [(0, False), (16, True)]


def test_the_rod_stays_up_over_a_plain_rate_loop_through_failsafe_and_radio():
    scenario = dataclasses.replace(SCENARIOS["push-hover"], params=PARAMS, duration=8.0)
    # without a derivative the loop needs quick motors to be as fast as Betaflight's
    vehicle = sitl.MotorVehicle(scenario, LIMITS, Plain(PARAMS), dataclasses.replace(AIRFRAME, motor_lag=5e-3))
    flight = study.flown(scenario, LIMITS, study.ObservedLink(scenario, vehicle))
    assert [event.data["impulse"] for event in flight.tape.events if event.kind == "push"] == [[0.008, 0.0]]
    assert flight.balanced and flight.ended == "landed", flight.tape.events
    # the push of 8 mN s at 5.3 s leans the rod by 5 cm on the delay-plus-lag loop
    lean = np.hypot(flight.truth[:, 4], flight.truth[:, 6])[flight.time < 7.0]
    assert lean[flight.time[: len(lean)] < 5.3].max() < 0.02 and 0.03 < lean.max() < 0.1
    assert vehicle.stopped()


# --- what is measured


@pytest.mark.parametrize("delay", [0.0, 0.0021, 0.0125, 0.03])
def test_delay_and_lag_respond_as_an_integration_in_small_steps(delay):
    rng = np.random.default_rng(3)
    period, lag, fine = 1 / 240, 0.015, 1000
    command = np.repeat(rng.normal(size=60), 2)
    command[0] = 0.0
    value, expected = 0.0, []
    for index in range(len(command) * fine):
        if index % fine == 0:
            expected.append(value)
        source = math.floor(index / fine - delay / period + 1e-9)
        value += (command[max(source, 0)] - value) * period / fine / lag
    # Euler's method at 4 us: relative error 4 us / 15 ms a lag
    np.testing.assert_allclose(respond(command, period, delay, lag), expected, atol=2e-3)


@pytest.mark.parametrize(("delay", "lag", "gain"), [(0.0125, 0.015, 1.0), (0.004, 0.02, 1.1), (0.02, 0.005, 0.9)])
def test_delay_lag_and_gain_are_found_again(delay, lag, gain):
    command = np.repeat(np.random.default_rng(7).normal(size=300), 2)
    found = fit(command, gain * respond(command, 1 / 240, delay, lag), 1 / 240)
    # nothing but the optimiser's tolerance between them
    assert found.delay == pytest.approx(delay, abs=1e-5) and found.lag == pytest.approx(lag, abs=1e-5)
    assert found.gain == pytest.approx(gain, abs=1e-4) and found.residual < 1e-4


def test_on_the_delay_and_lag_loop_a_flight_shows_just_these():
    scenario = dataclasses.replace(SCENARIOS["push-hover"], duration=7.0)
    flight = study.flown(scenario, LIMITS, study.ObservedLink(scenario))
    for axis in (0, 1):
        found = flight.response(axis)
        # the plant rounds the delay to substeps of 1/960 s: half of it is 0.5 ms
        assert found.delay == pytest.approx(scenario.params.simulation.rate_delay, abs=6e-4)
        assert found.lag == pytest.approx(scenario.params.simulation.rate_lag, abs=6e-4)


def test_the_shape_of_a_step_is_read_off():
    time = np.arange(1, 1000) / 1000.0
    damping, frequency = 0.5, 50.0
    damped = frequency * math.sqrt(1 - damping**2)
    envelope = np.exp(-damping * frequency * time)
    response = 1 - envelope * (np.cos(damped * time) + damping * frequency / damped * np.sin(damped * time))
    shape = step_shape(time, response)
    # textbook overshoot of a second-order system; sampling it at 1 kHz costs less than 0.1 %
    assert shape.overshoot == pytest.approx(math.exp(-math.pi * damping / math.sqrt(1 - damping**2)), abs=1e-3)
    assert shape.t10 < shape.t63 < shape.t90 < shape.settled < 6.0 / (damping * frequency)
    assert math.isnan(step_shape(time, 0.5 * np.ones(999)).t63)
    assert step_shape(time, np.ones(999)) == (0.001, 0.001, 0.001, 0.0, 0.0)


# --- the command


def asked(*arguments: object) -> int:
    """What `fip firmware` does with these arguments."""
    parser = argparse.ArgumentParser()
    study.add_arguments(parser)
    return study.run(parser.parse_args(list(map(str, arguments))))


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "fiplib", "firmware", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True)


def test_the_settings_are_printed_line_by_line(capsys):
    assert asked("settings") == 0
    assert capsys.readouterr().out.splitlines() == settings(PARAMS, LIMITS)


def test_a_users_mistakes_are_refused_in_one_sentence(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where no Betaflight is built
    with pytest.raises(sitl.FirmwareError, match="Betaflight is not built here; run: fip firmware install"):
        asked("fly")
    with pytest.raises(ValueError, match="no scenario 'loop'; there are push-hover"):
        asked("fly", "--scenario", "loop")
    with pytest.raises(ValueError, match="--duration -1: give seconds > 0"):
        asked("fly", "--duration", "-1")
    with pytest.raises(ValueError, match=r"airframe.spin must be a number from 1e-12 to 1e[+]12"):
        asked("step", "--airframe", "spin=x")
    with pytest.raises(bags.BagError, match="exists already"):
        asked("push", "--output", tmp_path)
    monkeypatch.setenv("PATH", "")
    with pytest.raises(sitl.FirmwareError, match="gcc and make not found; install a C compiler"):
        asked("install")


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the preloaded clock is for Linux")
@pytest.mark.skipif(
    shutil.which("gcc") is None, reason="no gcc on this computer to compile fiplib/flight/betaflight/lockstep.c"
)
def test_the_preloaded_clock_stands_until_it_is_looked_at_and_ports_stay_on_loopback(tmp_path):
    library = tmp_path / "lockstep.so"
    warnings = ["-Wall", "-Wextra", "-Werror"]
    subprocess.run(["gcc", "-O2", *warnings, "-shared", "-fPIC", "-o", library, sitl.CLOCK, "-ldl"], check=True)
    program = (
        "import socket, time\n"
        "one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM); one.bind(('', 9003))\n"
        "before = time.monotonic_ns(); sum(range(10**6)); after = time.monotonic_ns()\n"
        "print(*one.getsockname(), after - before)\n"
    )
    with sitl.free_ports()[0] as motors:
        offset = motors.getsockname()[1] - sitl.MOTORS_OUT
    environment = {**os.environ, "LD_PRELOAD": str(library), "FIP_OFFSET": str(offset)}
    environment |= {"FIP_STEP": "1", "FIP_START": "1000000000000"}
    ran = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True)
    # a look at the clock takes 500 ns, whatever was computed before it
    assert ran.stdout.split() == ["127.0.0.1", str(9003 + offset), "500"]


# --- Betaflight itself


@pytest.fixture(scope="module")
def built() -> Path:
    return sitl.install()


@pytest.fixture(scope="module")
def pushed(built: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """What `push` prints, and its bags."""
    folder = tmp_path_factory.mktemp("firmware") / "push"
    ran = run("push", "--output", folder)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    print(ran.stdout)
    return ran.stdout, folder


@betaflight
def test_the_rod_stays_up_for_20_s_over_betaflight_and_the_motors_stop_at_the_end(built):
    ran = run("fly")
    print(ran.stdout)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert "20.00 s, rod still up (landed)" in ran.stdout and "motors after the disarm frame: stopped" in ran.stdout
    lean, height = map(float, re.findall(r"(?:lean|height) ([\d.]+) mm", ran.stdout))
    # the noise of motion capture alone makes 3 mm and 1 mm on the delay-plus-lag loop; twice that
    assert lean < 6.0 and height < 2.5


@betaflight
def test_the_step_response_of_the_rate_loop_lies_beside_the_delay_and_lag_model(built):
    with sitl.Betaflight(settings(PARAMS, LIMITS), AIRFRAME.exchange_rate) as inner:
        curves = list(study.curves(PARAMS, LIMITS, AIRFRAME, inner, [math.radians(30.0)]))
    assert len(curves) == 3
    simulation = PARAMS.simulation
    for curve in curves:
        best = study.fitted(curve, AIRFRAME.exchange_rate)
        print(curve.axis, best)
        # measured 17.5 to 22 ms against 27.5; the model must not promise a faster loop than the firmware has
        assert 0.012 < best.delay + best.lag < simulation.rate_delay + simulation.rate_lag
        # no steady error: the fit weighs the overshoot of 12 to 27 %
        assert 1.0 < best.gain < 1.15
        assert curve.response[-1] == pytest.approx(curve.size, rel=0.08)


@betaflight
@pytest.mark.skipif(platform.machine() != "x86_64", reason="docs/firmware.md was written with the arithmetic of x86-64")
def test_the_documentation_holds_what_the_commands_print(pushed):
    text = (ROOT / "docs" / "firmware.md").read_text()
    stepped, hovered = run("step"), run("fly")
    assert stepped.returncode == hovered.returncode == 0, stepped.stderr + hovered.stderr
    assert hovered.stdout in text and stepped.stdout in text and "\n".join(settings(PARAMS, LIMITS)) in text
    assert pushed[0][: pushed[0].index("wrote")] in text


@betaflight
def test_the_push_flight_survives_on_both_inner_loops_and_alike(pushed):
    text, folder = pushed
    pushes = [
        "push of 8 mN s on the rod's COM",
        "push of 7 mN s on the rod's COM",
        "push of 7.07107 mN s on the rod's COM",
    ]
    flights = [bags.read(folder / name) for name in ("firmware", "delay-and-lag")]
    assert all(flight.simulated for flight in flights)
    assert [flight.metadata["inner_loop"] for flight in flights] == ["Betaflight 4.6.0 SITL", "delay and lag"]
    assert all([event.text for event in flight.events if event.kind == "push"] == pushes for flight in flights)
    truths = [flight.truth_state.values[flight.time(flight.truth_state) < 25.0] for flight in flights]
    leans = [float(np.hypot(truth[:, 4], truth[:, 6]).max()) for truth in truths]
    # 58 mm and 52 mm as measured: the first push falls into different tremors of the two hovers
    assert leans[0] == pytest.approx(leans[1], rel=0.25)
    assert text.count("yes") == 2


@betaflight
def test_the_length_of_the_rod_is_found_on_betaflight(tmp_path):
    flown = run("fly", "--scenario", "circle-0.8", "--output", tmp_path / "bag")
    assert flown.returncode == 0, flown.stderr
    found = re.search(r"(\d+) of (\d+) windows .* bias (\S+) mm, RMS error (\S+) mm, (\d+) of", flown.stdout)
    answered, given, bias, error, covered = map(float, found.groups())
    assert answered == given > 40
    # stated deviations are about 3 mm; with 95 % of 47 windows that overlap by four fifths, 40 is rarely missed
    assert abs(bias) < 3 and error < 6 and covered >= 40


@betaflight
def test_a_flight_over_betaflight_is_the_same_to_the_last_bit_however_busy_the_computer_is(pushed, tmp_path):
    _, folder = pushed
    burner = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        assert run("fly", "--scenario", "push-hover", "--output", tmp_path / "again").returncode == 0
    finally:
        burner.kill()
        burner.wait()
    first, again = bags.read(folder / "firmware"), bags.read(tmp_path / "again")
    for role in ("truth_state", "command", "state"):
        assert (getattr(first, role).values == getattr(again, role).values).all(), role


@betaflight
def test_a_firmware_that_dies_or_refuses_a_setting_is_reported_in_one_line(built):
    scenario = dataclasses.replace(SCENARIOS["push-hover"], params=PARAMS, pushes=(), reference=Hover())
    with (
        sitl.Betaflight(settings(PARAMS, LIMITS), AIRFRAME.exchange_rate) as inner,
        pytest.raises(sitl.FirmwareError, match="Betaflight ended or lost step"),
    ):
        link = study.ObservedLink(scenario, sitl.MotorVehicle(scenario, LIMITS, inner, AIRFRAME))
        inner.process.kill()
        study.flown(scenario, LIMITS, link)
    with pytest.raises(sitl.FirmwareError, match="Betaflight refuses 'set nonsense = 1'"):
        asked("fly", "--cli", "set nonsense = 1")


@betaflight
def test_betaflight_arms_after_the_encoders_pause_only_and_thrust_is_the_share_of_the_motors_range(built):
    limits = Limits()  # the default curve: thrust proportional to the command; held, as 0.2 of the range carries little
    setpoint = Setpoint(0, True, Mode.FLYING, np.zeros(3), 0.2)

    def held(pause: bool) -> NDArray:
        """The motors' commands half a second after arming, with the throttle low at first or not."""
        encoder = Encoder(PARAMS, limits)  # a new one takes an armed setpoint for one in flight, and pauses not
        if pause:
            encoder.channels(0, disarmed(0))
        with sitl.Betaflight(settings(PARAMS, limits), AIRFRAME.exchange_rate) as inner:
            plant = plant_of(inner)
            for _ in range(round(sitl.WARM_UP * 240)):
                plant.advance()
            for frame in range(120):
                plant.channels(encoder.channels(round(frame * 1e9 / 240), setpoint))
                plant.advance()
        assert plant.held
        return plant.outputs.copy()

    assert held(pause=False).tolist() == [0.0] * 4
    # whole microseconds, at the throttle and at the motors: 1.5 of 1000
    np.testing.assert_allclose(held(pause=True), 0.2, atol=2e-3)


@betaflight
def test_the_firmware_does_not_outlive_a_simulation_that_is_killed(built):
    program = (
        "import time\n"
        "from fiplib.flight.betaflight.sitl import Betaflight\n"
        "with Betaflight(['save'], 1920.0) as inner:\n"
        "    print(inner.process.pid, flush=True); time.sleep(600)\n"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as simulation:
        pid = int(simulation.stdout.readline())
        assert Path(f"/proc/{pid}").exists()
        simulation.kill()
    deadline = time.monotonic() + 60.0
    while running(pid) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not running(pid)


def running(pid: int) -> bool:
    """Whether there is such a process that is not just waiting to be reaped."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


@betaflight
def test_two_of_them_run_side_by_side(built):
    with (
        sitl.Betaflight(settings(PARAMS, LIMITS), AIRFRAME.exchange_rate) as one,
        sitl.Betaflight(settings(PARAMS, LIMITS), AIRFRAME.exchange_rate) as two,
    ):
        plants = [plant_of(one), plant_of(two)]
        for _ in range(24):
            for plant in plants:
                plant.advance()
    assert one.exchanges == two.exchanges == 192
