"""The environment of reinforcement learning: Gymnasium's own checks, seeds, falls, and the MPC as its baseline."""

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from fiplib.params import FipError, Params, X
from fiplib.references import Circle
from fiplib.simulate import Scenario, fly
from fiplib.teaching import environment
from fiplib.teaching.environment import FlyingPendulum


def test_gymnasium_finds_nothing_to_object_to():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # observations without bounds are what they are: a position may be any
        warnings.filterwarnings("ignore", message=".*observation space (min|max)imum value is -?inf.*")
        check_env(FlyingPendulum(), skip_render_check=True)


def test_it_is_made_by_its_name_alone():
    env = gymnasium.make(f"fiplib.teaching.environment:{environment.ID}", seconds=0.1)
    assert isinstance(env.unwrapped, FlyingPendulum)
    env.reset(seed=1)
    ends = [env.step(np.zeros(2))[3] for _ in range(12)]  # 120 Hz
    assert ends == [False] * 11 + [True]


def test_the_mpc_flies_a_whole_episode_and_it_is_the_flight_of_the_simulator():
    env = FlyingPendulum(seconds=10.0)
    observation, info = env.reset(seed=3)
    observations, rewards, terminated, truncated = [observation], [], False, False
    while not (terminated or truncated):
        observation, reward, terminated, truncated, info = env.step(env.mpc_action())
        observations.append(observation)
        rewards.append(reward)
    assert truncated and not terminated and len(rewards) == 1200 and info["seconds"] == 10.0
    # it stays within centimetres, and 25 deg/s of commands cost 0.001
    assert np.mean(rewards) > 0.98
    seed = int(np.random.Generator(np.random.PCG64(np.random.SeedSequence(3))).integers(2**31))
    flight = fly(Scenario("", "", 10.0, env._reference, seed=seed))
    # an action is a share of the rate: its rounding meets that of motion capture, 0.1 um, here and there
    np.testing.assert_allclose(observations[:-1], flight.state.values - flight.reference.values, rtol=0, atol=1e-5)


def test_without_a_policy_the_rod_falls_and_the_episode_terminates():
    env = FlyingPendulum()
    env.reset(seed=1)
    terminated = False
    while not terminated:
        _, reward, terminated, truncated, info = env.step(np.zeros(2))
    # a lean of 3 mm grows by e^(4 t) or so, with sqrt(1.5 g / l) and the reaction on top: to half a metre in 1.3 s
    assert not truncated and reward == 0.0 and 0.5 < info["seconds"] < 3.0


def test_seeds_draw_noise_and_rod_and_parameters_reach_the_plant():
    env = FlyingPendulum(lengths=(0.5, 1.5))
    first, info = env.reset(seed=5)
    again, same = env.reset(seed=5)
    other, different = env.reset(seed=6)
    np.testing.assert_array_equal(first, again)
    assert info == same and 0.5 < info["length"] < 1.5 and info["length"] != different["length"]
    assert (first != other).any()
    windy = FlyingPendulum(Params().replace(simulation__wind=(3.0, 0.0)))
    windy.reset(seed=1)
    off = [windy.step(windy.mpc_action())[0][X] for _ in range(120)]
    assert off[-1] > 0.1, "the wind carries it along"


def test_on_a_circle_the_observation_is_the_error():
    env = FlyingPendulum(reference=Circle(0.4, 8.0))
    observation, _ = env.reset(seed=1)
    assert abs(observation[X]) < 0.005  # and not the radius of 0.4 m


def test_an_action_beyond_its_bounds_is_cut_off():
    one, other = FlyingPendulum(), FlyingPendulum()
    for env in (one, other):
        env.reset(seed=1)
    for _ in range(10):
        found, expected = one.step(np.array([5.0, -5.0])), other.step(np.array([1.0, -1.0]))
    np.testing.assert_array_equal(found[0], expected[0])
    assert found[1] == pytest.approx(expected[1], abs=0)


def test_who_asks_a_baseline_that_remembers_twice_in_a_tick_gets_the_same_flight():
    asked_once, asked_twice = (
        FlyingPendulum(Params().replace(piloting__controller="offset_free_mpc")) for _ in range(2)
    )
    for env in (asked_once, asked_twice):
        env.reset(seed=1)
    for _ in range(50):
        once = asked_once.step(asked_once.mpc_action())[0]
        np.testing.assert_array_equal(asked_twice.mpc_action(), asked_twice.mpc_action())
        twice = asked_twice.step(asked_twice.mpc_action())[0]
    np.testing.assert_array_equal(once, twice)


def test_a_vehicle_that_sinks_to_the_ground_upright_ends_the_episode():
    env = FlyingPendulum(Params().replace(simulation__battery_sag=1.0))
    env.reset(seed=1)
    terminated = truncated = False
    while not (terminated or truncated):
        _, reward, terminated, truncated, info = env.step(env.mpc_action())
    assert terminated and reward == 0.0 and info["seconds"] < 3.0


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"seconds": 0.0}, "seconds of an episode"),
        ({"seconds": np.nan}, "seconds of an episode"),
        ({"seconds": np.inf}, "seconds of an episode"),
        ({"lengths": (1.5, 0.5)}, "shortest and the longest"),
        ({"lengths": (0.5,)}, "shortest and the longest"),
        ({"lengths": 1.0}, "shortest and the longest"),
        ({"lengths": (0.5, np.nan)}, "shortest and the longest"),
    ],
)
def test_arguments_that_make_no_sense_are_refused_at_once(wrong, words):
    with pytest.raises(FipError, match=words):
        FlyingPendulum(**wrong)


@pytest.mark.parametrize("wrong", [np.zeros(3), 0.5, np.array([np.nan, 0.0]), np.array([np.inf, 0.0])])
def test_an_action_that_is_not_two_finite_numbers_is_refused(wrong):
    env = FlyingPendulum()
    env.reset(seed=1)
    with pytest.raises(FipError, match="two finite numbers"):
        env.step(wrong)
