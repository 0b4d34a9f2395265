"""The grader says how a wrong answer behaves otherwise than the right one, and nothing that holds for both."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from fiplib.teaching.exercises import bags, closed_loop, ga, kalman, mpc
from fiplib.teaching.exercises.behaviour import Pair, differences, of_fitted_argument, of_powers
from fiplib.teaching.exercises.grading import Exercise
from tests.teaching.test_exercises import EXERCISES


def first_value(function: Callable) -> Callable[[tuple], np.ndarray]:
    def value(arguments: tuple) -> np.ndarray:
        result = function(*arguments)
        return np.asarray(result[0] if isinstance(result, tuple) else result)

    return value


def said_of(pair: Pair) -> list[str]:
    """The sentences, without the one that says where both are the same: they are everywhere if both are right."""
    with np.errstate(all="ignore"):
        sentences = (differences(pair) or "").split("; and ")
    return [sentence for sentence in sentences if sentence and not sentence.startswith("right where")]


def pair(exercise: Exercise, answer: Callable) -> Pair:
    trials = exercise.inputs()
    names = [f"x{k}" for k in range(len(trials[0]))]
    return Pair(first_value(answer), first_value(exercise.truth), trials, names, exercise.tolerance)


@pytest.mark.parametrize("name", EXERCISES)
def test_nothing_is_said_of_the_right_function(name: str) -> None:
    assert said_of(pair(EXERCISES[name], EXERCISES[name].truth)) == []


@pytest.mark.parametrize("name", EXERCISES)
def test_nothing_is_said_of_the_right_function_with_rounding_errors(name: str) -> None:
    """A relative error of 1e-12, another one at each call: a property is a property to within rounding."""
    rng = np.random.default_rng(1)

    def rounded(*arguments):
        value = first_value(EXERCISES[name].truth)(arguments)
        return value * (1 + 1e-12 * rng.normal(size=value.shape)) if value.dtype.kind == "f" else value

    assert said_of(pair(EXERCISES[name], rounded)) == []


@pytest.mark.parametrize(
    ("exercise", "answer", "sentence"),
    [
        (mpc.riccati_step, lambda a, b, q, r, p: q + a.T @ p, "not symmetric: the right one is"),
        (closed_loop.cautious_length, lambda l, s, c: l / (1 + c * s), "`x0` and `x1` doubled: the right one is 2"),
        (closed_loop.cautious_length, lambda l, s, c: l * (1 + s / l), "growing as `x1` grows: the right one falls"),
        (bags.velocities, lambda t, p: p[1:] / np.diff(t)[:, None] * 1e9, "a number added to all of `x1`"),
        (bags.length_from_lean, lambda d, tilt: 2 * d[0] / tilt[0], "changed by the order of `x0` and `x1`"),
        (bags.velocities, lambda t, p: np.diff(p, axis=0) / np.ptp(t) * 1e9, "changed by the last entry of `x0` where"),
        (kalman.log_likelihood, lambda y, s: kalman.log_likelihood.truth(y[1:], s[1:]), "the first row of `x0`"),
        (mpc.riccati_step, lambda a, b, q, r, p: mpc.riccati_step.truth(a, b, q, r, p @ p), "right where `x4` is the"),
        (ga.roulette_probabilities, lambda f: (w := np.where(np.isfinite(f), 1e3 - f, 0)) / w.sum(), "added to all of"),
    ],
)  # fmt: skip
def test_a_difference_is_named(exercise: Exercise, answer: Callable, sentence: str) -> None:
    with np.errstate(all="ignore"):
        assert sentence in str(differences(pair(exercise, answer)))


def test_an_argument_multiplied_by_any_number_is_found_and_a_product_of_powers() -> None:
    lean = EXERCISES["steady_lean"]
    assert of_fitted_argument(pair(lean, lambda r, t, l: lean.truth(r, 1.234 * t, l))) == (
        "what comes out with 1.234 times `x1` where `x1` belongs"
    )
    assert of_powers(pair(lean, lambda r, t, l: 3 * r / t**2)) == "3 times `x0` times `x1` to the power -2"
    assert of_powers(pair(lean, lambda r, t, l: lean.truth(r, t, l) * l / t)) == (
        "the right one times `x1` to the power -1 times `x2`"
    )
    assert of_fitted_argument(pair(lean, lambda r, t, l: r + t)) is None
    assert of_powers(pair(lean, lambda r, t, l: r + t)) is None


def test_limits_in_which_almost_any_formula_is_right_are_not_named() -> None:
    """Every mean of two equal lengths is right, and every cautious length without an uncertainty."""
    mean = pair(closed_loop.fuse, lambda l1, s1, l2, s2, w: (l1 * s2 + l2 * s1) / (s1 + s2))
    assert "equals" not in str(differences(mean))
    short = pair(closed_loop.cautious_length, lambda l, s, c: l - c * s**2 / l)
    assert "is 0" not in str(differences(short))


def test_a_slow_answer_is_not_called_for_long_and_a_printing_one_does_not_fill_the_page(
    capsys: pytest.CaptureFixture,
) -> None:
    calls = []

    def prints(length, deviation, caution):
        calls.append(length)
        print("length", length)
        return length - caution * deviation**2 / length

    replace(closed_loop.cautious_length).check(prints)
    assert len(calls) > 100
    assert capsys.readouterr().out.count("length ") < 50
    assert differences(replace(pair(closed_loop.cautious_length, prints), patience=-1.0)) is None
