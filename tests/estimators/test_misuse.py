"""Misuse of an estimator is a ValueError that says what it takes, and nothing else."""

from dataclasses import fields

import numpy as np
import pytest

from fiplib.estimators import ESTIMATORS
from fiplib.estimators.poses.estimate import estimate
from fiplib.estimators.poses.rows import Body
from fiplib.estimators.windows import RawPoses, RawWindow
from fiplib.kalman import Window
from fiplib.params import Params

COUNT = 40
POSES = {
    "stamp": np.arange(COUNT) * 4_000_000,
    "position": np.tile([0.0, 0.0, 0.5], (COUNT, 1)),
    "axis": np.tile([0.0, 0.0, 1.0], (COUNT, 1)),
}
STATES = {"states": np.zeros((20, 10)), "inputs": np.zeros((20, 2)), "step": 0.1}


def spoiled(array: np.ndarray) -> list:
    """What somebody may give in place of an array."""
    broken = array.astype(float)
    broken.flat[len(broken) // 2] = np.nan
    infinite = array.astype(float)
    infinite.flat[0] = np.inf
    wide = np.concatenate([array, array], axis=-1)
    return [
        None,
        "words",
        3.0,
        [],
        broken,
        infinite,
        array[..., None],
        array[:-1],
        wide,
        array.astype(object)[:0],
        [None],
    ]


@pytest.mark.parametrize("name", POSES)
def test_poses_take_arrays_of_their_shapes_and_nothing_else(name):
    assert len(RawPoses(**POSES).stamp) == COUNT
    for value in spoiled(POSES[name]):
        with pytest.raises(ValueError, match=r"^poses: (stamp|position|axis) "):
            RawPoses(**POSES | {name: value})


def test_poses_are_in_order():
    with pytest.raises(ValueError, match="stamp must not decrease"):
        RawPoses(**POSES | {"stamp": POSES["stamp"][::-1]})


@pytest.mark.parametrize("name", ["states", "inputs"])
def test_a_window_of_states_takes_arrays_of_its_shapes_and_nothing_else(name):
    for value in spoiled(STATES[name]):
        with pytest.raises(ValueError):
            Window(**STATES | {name: value})
    for step in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="step must be positive"):
            Window(**STATES | {"step": step})


@pytest.mark.parametrize("name", ESTIMATORS)
def test_an_estimator_refuses_what_it_does_not_take_before_it_computes(name):
    estimator, rng = ESTIMATORS[name], np.random.default_rng(0)
    windows = {"states": Window(**STATES), "raw": RawWindow(RawPoses(**POSES), RawPoses(**POSES))}
    right, wrong = windows.pop(estimator.kind), next(iter(windows.values()))
    function, name = estimator.function, estimator.path.partition(":")[2]
    for window in (None, wrong, POSES, np.zeros((55, 10)), "window"):
        with pytest.raises(ValueError, match=f"^{name} takes a window of the type"):
            function(window, Params(), rng)
    for params in (None, {}, Params().estimation):
        with pytest.raises(ValueError, match=f"^{name} takes a params of the type Params"):
            function(right, params, rng)
    for seed in (0, np.random):
        with pytest.raises(ValueError, match="takes an rng made by"):
            function(right, Params(), seed)
    answer = function(right, Params(), rng)  # a flight in which nothing moves says nothing: refused, or any length
    assert answer.reason or answer.length > 0


@pytest.mark.parametrize("column", Body._fields)
def test_poses_of_other_shapes_are_refused(column):
    time = np.arange(900) / 240
    bodies = {"vehicle": Body(time, np.zeros((900, 3)), np.tile([0.0, 0.0, 1.0], (900, 1))),
              "rod": Body(time, np.tile([0.0, 0.0, 0.5], (900, 1)), np.tile([0.0, 0.0, 1.0], (900, 1)))}  # fmt: skip
    for body in bodies:
        for value in ("words", 3.0, time[:-1], np.zeros((900, 2)), [None, 1.0]):
            with pytest.raises(ValueError, match="a body takes a time"):
                estimate(**bodies | {body: bodies[body]._replace(**{column: value})})


def test_every_field_of_poses_is_tried():
    assert [field.name for field in fields(RawPoses)] == list(POSES)
