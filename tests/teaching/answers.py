"""Answers of students, made from the right ones: typical wrong ones, and right ones in other forms.

Each maker takes the right function and the number of its values, and returns answers by name. A wrong answer that
happens to be right for an exercise (the square root of True, a symmetric matrix transposed) is left out by ``differs``.
"""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from fiplib.teaching.exercises.grading import Exercise

Answer = Callable[..., Any]

OF_RESULTS: dict[str, Callable[[Any], Any]] = {
    "twice": lambda x: 2 * x,
    "half": lambda x: x / 2,
    "a third": lambda x: x / 3,
    "2.5 times": lambda x: 2.5 * x,
    "wrong sign": lambda x: -x,
    "reciprocal": lambda x: 1 / x,
    "square": lambda x: x**2,
    "root": lambda x: np.sqrt(np.abs(x)),
    "degrees": lambda x: np.degrees(x),
    "radians": lambda x: np.radians(x),
    "one more": lambda x: x + 1,
    "offset": lambda x: x - 0.3,
    "without sign": np.abs,
    "transposed": lambda x: x.T,
    "other order": lambda x: x[::-1],
    "off by one": lambda x: np.roll(x, 1, axis=0),
    "nearly": lambda x: x * 9.8 / 9.81 * 0.999,
    "constant": lambda x: 0 * x + 0.7,
    "zero": lambda x: 0 * x,
    "nan": lambda x: x * np.nan,
    "too short": lambda x: x[:-1],
    "too short at the start": lambda x: x[1:],
    "too long": lambda x: np.append(x, 0.0),
    "sum": np.sum,
    "first": lambda x: x[0],
    "mean of several": lambda x: np.mean(x, axis=-1),
    "row of it": lambda x: x[None, :, None] * np.ones(2),
    "one entry wrong": lambda x: np.where(np.arange(x.size).reshape(x.shape) == x.size // 2, -2 * x - 1, x),
    "first row missing": lambda x: np.where(np.arange(len(x)).reshape(-1, *[1] * (x.ndim - 1)) == 0, 0.0, x),
}

OF_ARGUMENTS: dict[str, Callable[[Any], Any]] = {
    "twice": lambda x: 2 * x,
    "half": lambda x: x / 2,
    "zero": lambda x: 0 * x,
    "square": lambda x: x * x,
    "negative": lambda x: -x,
    "transposed": lambda x: x.T,
    "the other way round": lambda x: x[::-1],
    "in degrees": lambda x: np.degrees(x),
    "always 1.3": lambda x: 0 * x + 1.3,
}


def values_of(result: Any) -> list[np.ndarray]:
    """The values of a right result as arrays of numbers."""
    return [np.asarray(value) * 1.0 for value in (result if isinstance(result, tuple) else (result,))]


def differs(exercise: Exercise, answer: Answer) -> bool:
    """Whether an answer is a wrong one: it runs, and differs from the truth by more than rounding at some input."""
    for trial in exercise.inputs():
        true = values_of(exercise.truth(*trial))
        try:
            with np.errstate(all="ignore"):
                mine = values_of(answer(*trial))
        except Exception:  # the right function makes nothing of such arguments
            return False
        if len(mine) != len(true):
            return True
        for one, other in zip(mine, true, strict=True):
            if np.squeeze(one).shape != np.squeeze(other).shape:
                return True
            if not np.allclose(np.squeeze(one), np.squeeze(other), rtol=1e-9, atol=0, equal_nan=True):
                return True
    return False


def wrong_answers(exercise: Exercise) -> Iterator[tuple[str, Answer]]:
    """Typical wrong answers, made by one change to the results or the arguments of the right function."""
    count = len(values_of(exercise.truth(*exercise.inputs()[0])))
    for name, answer in _changed(exercise.truth, count, len(exercise.inputs()[0])):
        if differs(exercise, answer):
            yield name, answer


def _changed(truth: Answer, count: int, arguments: int) -> Iterator[tuple[str, Answer]]:
    for name, change in OF_RESULTS.items():
        for place in range(count):

            def answer(*of, place=place, change=change):
                values = values_of(truth(*of))
                values[place] = change(values[place])
                return tuple(values) if count > 1 else values[0]

            yield f"{name}, value {place}", answer
    if count > 1:
        yield "exchanged", lambda *of: truth(*of)[::-1]
        yield "the first alone", lambda *of: truth(*of)[0]
        yield "one too many", lambda *of: (*truth(*of), 0.0)
    for name, change in OF_ARGUMENTS.items():
        for place in range(arguments):
            yield (
                f"{name}, argument {place}",
                lambda *of, place=place, change=change: truth(*of[:place], change(of[place]), *of[place + 1 :]),
            )
    for place in range(1, arguments):
        yield (
            f"arguments {place - 1} and {place} exchanged",
            lambda *of, k=place: truth(*of[: k - 1], of[k], of[k - 1], *of[k + 1 :]),
        )


OTHER_FORMS: dict[str, Callable[[np.ndarray], Any]] = {
    "as a list": lambda x: x.tolist(),
    "with an axis more": lambda x: x[..., None],
    "with an axis before": lambda x: x[None],
    "as a tuple of rows": lambda x: tuple(x.tolist()) if x.ndim else (x.item(),),
    "to four digits": lambda x: np.vectorize(lambda number: float(f"{number:.4g}"))(x),
    "as complex numbers": lambda x: x + 0j,
    "in single precision": lambda x: x.astype(np.float32),
    "as objects": lambda x: x.astype(object),
}


def right_answers(exercise: Exercise) -> Iterator[tuple[str, Answer]]:
    """The right function, with its result in other forms."""
    for name, form in OTHER_FORMS.items():
        if exercise.tolerance < 1e-5 and name in ("to four digits",):
            continue  # a code of the genetic algorithm does not survive rounding

        def answer(*of, form=form):
            values = [form(value) for value in values_of(exercise.truth(*of))]
            return tuple(values) if len(values) > 1 else values[0]

        yield name, answer
    if len(values_of(exercise.truth(*exercise.inputs()[0]))) > 1:
        yield "values in a list", lambda *of: list(exercise.truth(*of))
        yield "values in an array", lambda *of: np.array(exercise.truth(*of))
        yield "values in nested tuples", lambda *of: (tuple((value,) for value in exercise.truth(*of)),)
        yield "values in a column", lambda *of: np.array(exercise.truth(*of))[:, None]
