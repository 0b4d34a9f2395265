"""The simulated vehicle: its plant, its inner loop, its sensors, its flights."""

import dataclasses
import math

import numpy as np
import pytest

from fiplib.dynamics import PLANT, prediction_model, rk4
from fiplib.params import AXES, GRAVITY, A, B, Params
from fiplib.pilot import Circle, Hover
from fiplib.recording import EPOCH, MemoryRecorder
from fiplib.simulate import SCENARIOS, Mocap, Plant, Push, Scenario, fly

PARAMS = Params()
QUIET = PARAMS.replace(simulation__position_noise=0.0, simulation__attitude_noise=0.0, simulation__initial_lean=0.0)


def flown(**changes) -> tuple[MemoryRecorder, object]:
    scenario = Scenario("test", "", 4.0, Hover())
    tape = MemoryRecorder()
    return tape, fly(dataclasses.replace(scenario, **changes), tape)


def test_the_same_seed_gives_the_same_flight_and_another_seed_another():
    (first, _), (again, _), (other, _) = flown(duration=1.0), flown(duration=1.0), flown(duration=1.0, seed=2)
    for topic in ("vehicle", "pendulum", "state", "command", "truth_state"):
        np.testing.assert_array_equal(first[topic], again[topic])
        assert (first[topic] != other[topic]).any()


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
    tape, _ = flown(duration=16.0, reference=Circle(0.4, 8.0), params=params)
    truth = tape["truth_state"]
    lap = truth[:, 0] > 8.0
    radius = np.hypot(truth[lap, 1], truth[lap, 3]).mean()
    lean = np.hypot(truth[lap, 1 + A], truth[lap, 1 + B]).mean()
    speed = 2 * math.pi / 8.0
    expected = radius * speed**2 / (speed**2 / params.pendulum.inertia_factor + 2 * GRAVITY / params.pendulum.length)
    assert lean == pytest.approx(expected, rel=0.01)  # the remaining drift of the radius over the lap
    assert (truth[lap, 1] * truth[lap, 1 + A] < 0).mean() > 0.9, "inwards"


def test_without_noise_the_rod_stands_still_in_hover():
    tape, outcome = flown(params=QUIET)
    assert outcome.survived and outcome.duration == 4.0
    assert np.abs(tape["truth_state"][:, 1 + A]).max() < 1e-6  # what single precision leaves of zero, times the gains


def test_a_hopeless_push_ends_the_flight_and_is_recorded():
    tape, outcome = flown(pushes=(Push(1.0, (0.05, 0.0)),))
    assert not outcome.survived and 1.0 < outcome.duration < 4.0
    levels_and_texts = [event[1:] for event in tape.events]
    assert ("info", "push of 50 mN s on the rod's COM") in levels_and_texts
    assert levels_and_texts[-1] == ("error", "rod or vehicle fell: flight ended")
    assert tape["command"][-1, 0] == pytest.approx(outcome.duration, abs=0.02)


def test_every_recorded_scenario_describes_itself_completely():
    for name, scenario in SCENARIOS.items():
        metadata = scenario.metadata()
        assert metadata["scenario"] == name and metadata["origin"] == "simulated"
        assert Params.from_dict(metadata["params"]) == scenario.params


def test_the_noise_levels_of_the_filter_are_those_measured_in_the_simulator():
    """Q_e and R_e are not tuned to an answer: they are the errors of model and measurement on a flight of known truth.

    The diagonal is given to one digit, and one flight of 25 s tells a variance to about 10 %: within a factor of 2.
    """
    params = PARAMS.replace(pendulum__gyration_ratio=0.0)  # the model's own error, not that of the rod's inertia
    tape, _ = flown(duration=25.0, reference=Circle(0.4, 8.0), params=params)
    truth, states, commands = tape["truth_state"], tape["state"], tape["command"]
    at = np.searchsorted(truth[:, 0], states[:, 0] - params.simulation.mocap_latency - 1e-6)
    true_states = truth[at, 1:11]
    measured = (states[:, 1:] - true_states).var(axis=0)
    ticks = round(params.estimation.sample_period * params.piloting.control_rate)
    model = rk4(prediction_model(), params.estimation.sample_period)
    errors = [
        true_states[start + ticks]
        - np.array(model(true_states[start], commands[start : start + ticks, 1:3].mean(0), 1.0)).ravel()
        for start in range(0, len(states) - ticks, ticks)
    ]
    for chosen, found in (
        (params.estimation.measurement_noise, measured),
        (params.estimation.process_noise, np.var(errors, axis=0)),
    ):
        ratio = found / np.array(chosen)
        assert (ratio > 0.5).all() and (ratio < 2.0).all(), ratio
    for axis, other in zip(AXES[0].states, AXES[1].states, strict=True):
        assert params.estimation.process_noise[axis] == params.estimation.process_noise[other]
