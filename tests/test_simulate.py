"""The simulated vehicle: its plant, its inner loop, its sensors, its flights."""

import dataclasses
import hashlib
import math
import os
import subprocess
import sys
from collections import deque
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fiplib.dynamics import PLANT
from fiplib.estimators.base import Estimate
from fiplib.mpc import Status
from fiplib.params import AXES, GRAVITY, PHI, THETA, A, B, Params, X, Y
from fiplib.pilot import Command
from fiplib.recording import EPOCH, Event, Flight, MemoryRecorder, Poses, Series
from fiplib.references import Circle, Hover, Multisine
from fiplib.simulate import SCENARIOS, LengthUpdates, Mocap, Plant, Push, Scenario, SimulatedVehicle, fly
from fiplib.studies.step_errors import one_step_errors, true_states

PARAMS = Params()
FIELDS = {Poses: ("stamp", "received", "position", "orientation"), Series: ("stamp", "values")}
SERIES = ("state", "command", "reference", "length", "truth_state", "truth_length")
QUIET = PARAMS.replace(simulation__position_noise=0.0, simulation__attitude_noise=0.0, simulation__initial_lean=0.0)


def flown(**changes) -> Flight:
    return fly(dataclasses.replace(Scenario("test", "", 4.0, Hover()), **changes))


def same(one: Flight, other: Flight) -> bool:
    """Whether every number of two flights is the same, to the last bit."""
    roles = ("vehicle", "pendulum", *SERIES)
    pairs = [(getattr(one, role), getattr(other, role)) for role in roles]
    arrays = [(getattr(a, name), getattr(b, name)) for a, b in pairs for name in FIELDS[type(a)]]
    return all(a.shape == b.shape and a.tobytes() == b.tobytes() for a, b in arrays)


def test_the_same_seed_gives_the_same_flight_and_another_seed_another():
    first, again, other = flown(duration=1.0), flown(duration=1.0), flown(duration=1.0, seed=2)
    assert same(first, again)
    for role in ("state", "command", "truth_state"):
        assert (getattr(first, role).values != getattr(other, role).values).any()
    assert (first.vehicle.position != other.vehicle.position).all(axis=1).any()


def test_the_noise_of_motion_capture_is_one_stream_however_much_is_drawn_at_once():
    """A frame's noise does not depend on how long the flight is: 1.5 s are 360 frames, more than one chunk."""
    short, long = flown(duration=1.2), flown(duration=1.5)
    count = len(short.vehicle.stamp)
    np.testing.assert_array_equal(long.vehicle.position[:count], short.vehicle.position)
    rng = np.random.default_rng(1)
    rng.normal(size=2)  # the lean at the start
    noise = rng.normal(size=(count, 12))[:, :3] * PARAMS.simulation.position_noise
    truth = short.truth_state.values
    turned = Rotation.from_euler("XYZ", np.column_stack([truth[:, [PHI, THETA]], np.zeros(count)]))  # it does not yaw
    frame = truth[:, [X, Y, 10]] - PARAMS.vehicle.seat_height * turned.as_matrix()[:, :, 2]
    # single precision rounds numbers of 1 to 2 m to 0.12 um
    np.testing.assert_allclose(short.vehicle.position, frame + noise, rtol=0, atol=1e-7)
    at_seat = flown(duration=0.1, params=PARAMS.replace(simulation__vehicle_origin="seat"))
    np.testing.assert_array_equal(
        at_seat.vehicle.position,
        (at_seat.truth_state.values[:, [X, Y, 10]] + noise[:24]).astype(np.float32),
    )
    with pytest.raises(ValueError, match="vehicle_origin must be 'frame' or 'seat', not 'tail'"):
        flown(params=PARAMS.replace(simulation__vehicle_origin="tail"))


def test_without_a_raised_seat_a_flight_is_to_the_bit_what_it_was_before_the_plant_had_one():
    params = PARAMS.replace(vehicle__seat_height=0.0, piloting__seat_height=0.0)
    reference, pushes = Circle(0.4, 4.0, start=0.2, ramp=1.0), (Push(1.0, (0.006, -0.004)),)
    flight = flown(duration=3.0, reference=reference, pushes=pushes, told_lengths=((2.0, 0.8),), params=params)
    digest = hashlib.sha256()
    for body in (flight.vehicle, flight.pendulum):
        digest.update(body.position.tobytes() + body.orientation.tobytes())
    for series in (flight.truth_state, flight.state, flight.command):
        digest.update(series.values.tobytes())
    # of the same flight by the code of the last commit without a seat, 3e5f445
    assert digest.hexdigest() == "d5fd8b704b38b896261caea9420674504fe53d4260bff24fb604ba96330ed7ca"


def test_rod_and_attitude_stay_of_unit_length_over_ten_violent_seconds():
    plant, rng = Plant(PARAMS, (0, 0, 5.0), lean=(0.3, -0.2)), np.random.default_rng(1)
    worst = 0.0
    for index in range(2400):
        if index % 24 == 0:
            plant.command(rng.uniform(-3, 3, size=3), rng.uniform(0, 12))
        plant.advance(0.2 * rng.normal(size=3))
        lengths = [np.linalg.norm(plant.x[PLANT[name]]) for name in ("attitude", "direction")]
        along = plant.x[PLANT["direction"]] @ plant.x[PLANT["direction_rate"]]
        worst = max(worst, np.abs(np.subtract(lengths, 1)).max(), abs(along))
    assert np.abs(plant.x[PLANT["direction_rate"]]).max() > 1, "the rod was really swinging"
    assert worst < 1e-9


def test_the_inner_loop_answers_after_latency_and_delay_as_a_first_order_lag():
    simulation = PARAMS.simulation
    plant, rate = Plant(PARAMS, (0, 0, 1.3)), 240.0
    plant.command((0.0, 1.0, 0.0), 5.9)
    times, answers = [], []
    for index in range(1, 25):
        plant.advance()
        times.append(index / rate)
        answers.append(plant.x[PLANT["body_rate"]][1])
    since = np.array(times) - simulation.mocap_latency - simulation.rate_delay
    expected = np.where(since > 0, 1 - np.exp(-since / simulation.rate_lag), 0)
    # RK4 at 1/960 s on a lag of 15 ms: (step/lag)^5/120 a step, 1e-8 over the response
    np.testing.assert_allclose(answers, expected, atol=1e-7)


def test_a_push_brings_its_impulse_into_the_pair_of_bodies():
    weight = (PARAMS.vehicle.mass + PARAMS.pendulum.mass) * GRAVITY
    plant = Plant(PARAMS, (0, 0, 1.3))
    for _ in range(12):  # 50 ms; level vehicle, so no other horizontal force
        plant.command((0, 0, 0), weight)
        plant.advance(np.array([0.008, 0.002, 0.0]) / 0.05)
    momentum = PARAMS.vehicle.mass * plant.x[3:5] + PARAMS.pendulum.mass * (plant.x[3:5] + 0.5 * plant.x[13:15])
    np.testing.assert_allclose(momentum, [0.008, 0.002], rtol=1e-9)


def test_motion_capture_has_the_stated_noise_in_single_precision():
    frames = 4000
    mocap, x = Mocap(PARAMS, frames, np.random.default_rng(3)), Plant(PARAMS, (0.4, -0.2, 1.3), (0.02, 0.01)).x
    seen = [mocap.frame(index, EPOCH, x) for index in range(frames)]
    positions = np.array([frame.vehicle_position for frame in seen])
    tilts = 2 * np.array([frame.vehicle_attitude[:3] for frame in seen])
    # the standard deviation of 4000 samples has itself one of 1.1 %: 5 of those
    np.testing.assert_allclose(positions.std(0), PARAMS.simulation.position_noise, rtol=0.056)
    np.testing.assert_allclose(tilts.std(0), PARAMS.simulation.attitude_noise, rtol=0.056)
    np.testing.assert_array_equal(positions, positions.astype(np.float32))
    offset = np.mean([frame.pendulum_position - frame.vehicle_position for frame in seen], axis=0)
    np.testing.assert_allclose(offset[:2], [0.02, 0.01], atol=5 * 0.28e-3 / math.sqrt(frames))


@pytest.mark.parametrize("gyration_ratio", [0.0, 1 / 12])
def test_on_a_steady_circle_the_rod_leans_inwards_as_the_linear_model_says(gyration_ratio):
    """|a| = R w^2 / (w^2/lambda + 2 g/l), with the R that was really flown."""
    params = QUIET.replace(pendulum__gyration_ratio=gyration_ratio)
    truth = flown(duration=16.0, reference=Circle(0.4, 8.0), params=params).truth_state.values
    lap = truth[8 * 240 :]
    radius = np.hypot(lap[:, X], lap[:, Y]).mean()
    lean = np.hypot(lap[:, A], lap[:, B]).mean()
    speed = 2 * math.pi / 8.0
    expected = radius * speed**2 / (speed**2 / params.pendulum.inertia_factor + 2 * GRAVITY / params.pendulum.length)
    assert lean == pytest.approx(expected, rel=0.01)  # the remaining drift of the radius over the lap
    assert (lap[:, X] * lap[:, A] < 0).mean() > 0.9, "inwards"


def test_without_noise_the_rod_stands_still_in_hover():
    flight = flown(params=QUIET)
    assert flight.survived and flight.duration == pytest.approx(4.0 - 1 / 240, abs=1e-9)  # to the last frame
    assert np.abs(flight.truth_state.values[:, A]).max() < 1e-6  # what single precision leaves of zero, times the gains


def test_a_hopeless_push_ends_the_flight_and_is_recorded():
    tape = MemoryRecorder()
    push = Push(1.0, (0.05, 0.0))
    flight = fly(Scenario("test", "", 4.0, Hover(), pushes=(push,)), tape)
    assert not flight.survived and 1.0 < flight.duration < 4.0
    pushed, fell = (next(event for event in flight.events if event.kind == kind) for kind in ("push", "fall"))
    data = {"impulse": [0.05, 0.0], "duration": 0.05}
    assert pushed[1:] == ("info", "push of 50 mN s on the rod's COM", "push", data)
    assert flight.time(pushed) == pytest.approx(1.0, abs=1 / 240 + 1e-9)
    assert flight.events[-1] == fell and fell[1:3] == ("error", "rod or vehicle fell: flight ended")
    assert flight.time(flight.command)[-1] == pytest.approx(flight.duration, abs=0.02)
    written = tape.flight("test", flight.metadata)
    assert same(written, flight) and written.events == flight.events, "the recorder was given all that is returned"


def test_the_vehicle_is_held_until_it_is_commanded_and_its_pushes_count_from_then():
    push = Push(0.1, (0.008, 0.0))
    vehicle = SimulatedVehicle(Scenario("test", "", 1.0, Hover(), pushes=(push,)))
    held = vehicle.plant.x.copy()
    assert [vehicle.advance() for _ in range(50)] == [None] * 50
    np.testing.assert_array_equal(vehicle.plant.x, held)
    hover = (PARAMS.vehicle.mass + PARAMS.pendulum.mass) * GRAVITY / PARAMS.vehicle.max_thrust
    vehicle.command(Command(0, np.zeros(3), hover, np.zeros(10), np.zeros(10), 1.0, Status.OPTIMAL))
    begun = [vehicle.advance() for _ in range(50)]
    assert [index for index, one in enumerate(begun) if one] == [24] and begun[24] is push
    assert push.event(7) == Event(
        7, "info", "push of 8 mN s on the rod's COM", "push", {"impulse": [0.008, 0.0], "duration": 0.05}
    )


def test_estimates_remarks_and_prescribed_lengths_take_one_way_to_pilot_and_recorder():
    class Answering:
        seconds = 0.1
        answers = (Estimate(0.9, 0.1), None, Estimate(math.nan, math.nan, "no"), Estimate(math.nan, math.nan, "no"))

        def __init__(self):
            self.remarks, self.left = deque([("warn", "started again")]), deque(self.answers)

        def deliver(self, now, window):
            return self.left.popleft() if self.left else None

    tape, given, said = MemoryRecorder(), [], []

    def receive(now, length, deviation):
        given.append((now, length))
        return length / 2

    scenario = Scenario("test", "", 1.0, Hover(), told_lengths=((2.0, 0.4),))
    updates = LengthUpdates(scenario, Answering(), receive, tape, said.append)
    for now, seconds in enumerate((math.nan, 0.0, 1.0, 2.0, 3.0)):
        updates.update(now, seconds, None)
    assert given == [(0, 0.9), (3, 0.4)] and said == ["started again"] and updates.latest == Estimate(0.9, 0.1)
    assert [(event.stamp, event.kind, event.data) for event in tape.events] == [
        (0, "note", {}),
        (2, "refusal", {"reason": "no"}),
        (3, "length", {"length": 0.4}),
    ]


def test_every_recorded_scenario_describes_itself_completely():
    for name, scenario in SCENARIOS.items():
        metadata = scenario.metadata()
        assert metadata["scenario"] == name and metadata["origin"] == "simulated"
        assert Params.from_dict(metadata["params"]) == scenario.params


def test_the_noise_levels_of_the_filter_are_those_measured_in_the_simulator():
    """Q_e and R_e are not tuned to an answer: they are the errors of model and measurement on a flight of known truth.

    The diagonal is given to one digit, and one flight of 25 s tells a variance to about 10 %: within a factor of 2.
    """
    # the model's own error, not that of the rod's inertia or of its seat
    params = PARAMS.replace(pendulum__gyration_ratio=0.0, vehicle__seat_height=0.0, piloting__seat_height=0.0)
    flight = flown(duration=25.0, reference=Circle(0.4, 8.0), params=params)
    measured = (flight.state.values - true_states(flight)).var(axis=0)
    for chosen, found in (
        (params.estimation.measurement_noise, measured),
        (params.estimation.process_noise, one_step_errors(flight).var(axis=0)),
    ):
        ratio = found / np.array(chosen)
        assert (ratio > 0.5).all() and (ratio < 2.0).all(), ratio
    for axis, other in zip(AXES[0].states, AXES[1].states, strict=True):
        assert params.estimation.process_noise[axis] == params.estimation.process_noise[other]


FLOWN = """
import dataclasses, sys
import numpy as np
from fiplib.simulate import SCENARIOS, fly
from tests.test_simulate import digest
print(digest(fly(dataclasses.replace(SCENARIOS[sys.argv[1]], duration=float(sys.argv[2])))))
"""


def digest(flight: Flight) -> str:
    """A digest of every number that a flight has recorded."""
    parts = [flight.vehicle.position, flight.vehicle.orientation, flight.pendulum.position]
    parts += [getattr(flight, name).values for name in ("state", "command", "reference", "length", "truth_state")]
    return hashlib.sha256(b"".join(part.tobytes() for part in parts)).hexdigest()


# what a user's machine or script may choose; the kernels are named as on x86-64, and elsewhere the names do nothing
SURROUNDINGS = {
    "numpy imported first, nothing pinned": {},
    "kernels of an old CPU": {"OPENBLAS_CORETYPE": "Nehalem", "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4"},
    "kernels of a new CPU, four threads": {"OPENBLAS_CORETYPE": "SkylakeX", "OPENBLAS_NUM_THREADS": "4"},
}


@pytest.mark.parametrize("name", SURROUNDINGS)
def test_a_flight_is_the_same_to_the_bit_whatever_numpy_chooses_for_the_cpu(name):
    pinned = ("OPENBLAS_CORETYPE", "OPENBLAS_NUM_THREADS", "NPY_DISABLE_CPU_FEATURES")
    environment = {key: value for key, value in os.environ.items() if key not in pinned} | SURROUNDINGS[name]
    # a bounded tick, a circle, an estimate by the genetic algorithm
    for scenario, seconds in (("push-hover", 6.0), ("estimate-1.4", 8.0)):
        run = subprocess.run(
            [sys.executable, "-c", FLOWN, scenario, str(seconds)],
            capture_output=True, text=True, env=environment, cwd=Path(__file__).parents[1],
        )  # fmt: skip
        assert run.returncode == 0, run.stderr
        here = fly(dataclasses.replace(SCENARIOS[scenario], duration=seconds))
        assert run.stdout.strip() == digest(here)


@pytest.mark.parametrize(
    ("wrong", "needed"),
    [
        ({"duration": 0.0}, "duration"),
        ({"duration": math.nan}, "duration"),
        ({"seed": -1}, "seed"),
        ({"seed": 1.5}, "seed"),
        ({"pushes": (Push(1.0, (math.nan, 0.0)),)}, "impulses"),
        ({"pushes": (Push(1.0, (0.01, 0.0), 0.0),)}, "last longer"),
        ({"pushes": (Push(-1.0, (0.01, 0.0)),)}, "from 0 s on"),
        ({"pushes": (Push(math.nan, (0.01, 0.0)),)}, "from 0 s on"),
        ({"pushes": (Push(2.0, (0.01, 0.0)), Push(1.0, (0.01, 0.0)))}, "after the end"),
        ({"pushes": (Push(1.0, (0.01, 0.0), 0.5), Push(1.2, (0.01, 0.0)))}, "after the end"),
        ({"told_lengths": ((2.0, 0.8), (1.0, 0.9))}, "order of time"),
        ({"told_lengths": ((math.nan, 0.8),)}, "order of time"),
    ],
)
def test_a_scenario_of_which_a_part_would_silently_not_be_flown_is_refused(wrong, needed):
    with pytest.raises(ValueError, match=f"scenario 'odd' needs .*{needed}"):
        Scenario(**{"name": "odd", "description": "", "duration": 3.0, "reference": Hover()} | wrong)


@pytest.mark.parametrize("wrong", [{"ramp": -1.0}, {"ramp": 0.0}, {"period": 0.0}, {"period": math.nan}])
def test_a_circle_that_would_run_away_is_refused(wrong):
    with pytest.raises(ValueError, match="of a circle must be a number above 0"):
        Circle(**{"radius": 0.4, "period": 8.0} | wrong)


@pytest.mark.parametrize("wrong", [{"frequency": 0.0}, {"ramp": -1.0}, {"fade": 0.0}, {"fade": math.inf}])
def test_a_multisine_that_would_stand_still_is_refused(wrong):
    with pytest.raises(ValueError, match="of a multisine must be a number above 0"):
        Multisine(**{"frequency": 0.2, "x": (0.1, 0.0), "y": (0.0, 0.1)} | wrong)
