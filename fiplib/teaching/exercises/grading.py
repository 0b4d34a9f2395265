"""What an exercise is and how an answer is graded.

An exercise asks for a function. ``Exercise.grade`` calls the answer at random inputs, the same ones each time, and
compares its results with the correct ones, taken from fiplib where fiplib has them. A wrong answer is compared with the
typical mistakes, each of which is a function, too: a student who made one of them reads which one.
"""

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Answer = Callable[..., Any]
"""The function that a student has written."""

DRAWS = 6
"""Number of random inputs at which an answer is tried."""

TOLERANCE = 1e-6
"""Relative to the largest value of a result: far above rounding, far below the effect of any listed mistake."""


class NotYet(Exception):
    """An answer is not right yet; the message says why, in words."""


@dataclass(frozen=True)
class Exercise:
    """A function that a student is asked to write, with what is needed to grade the answer.

    Attributes:
        truth: the function asked for; returns a number, an array, or a tuple of these.
        draw: draws the arguments of one trial from a random generator.
        mistakes: typical mistakes: the sentence that a student reads, and the function that makes the mistake.
        hint: the sentence for any other wrong answer.
        praise: the sentence for a right answer.
    """

    truth: Answer = field(repr=False)
    draw: Callable[[np.random.Generator], tuple] = field(repr=False)
    mistakes: Mapping[str, Answer] = field(repr=False)
    hint: str
    praise: str = field(repr=False)

    def check(self, answer: Answer) -> None:
        """Print whether the answer is right, and what is wrong with it; raises nothing, so that a notebook runs on."""
        try:
            self.grade(answer)
            print(f"right: {self.praise}")
        except NotYet as refusal:
            print(f"not yet: {refusal}")

    def grade(self, answer: Answer) -> None:
        """Compare an answer with the truth at ``DRAWS`` random inputs. Raises NotYet: says what is wrong with it."""
        rng = np.random.default_rng(0)
        trials = [self.draw(rng) for _ in range(DRAWS)]
        given, expected = _results(answer, trials), _results(self.truth, trials)
        if all(map(_agree, given, expected)):
            return
        for words, mistake in self.mistakes.items():
            if all(map(_agree, given, _results(mistake, trials))):
                raise NotYet(words)
        for mine, true in zip(given, expected, strict=True):
            if [part.shape for part in mine] != [part.shape for part in true]:
                raise NotYet(f"your function should return {_described(true)}, not {_described(mine)}")
            if any(np.isnan(part).any() for part in mine):
                raise NotYet("your function returns nan: is it filled in? is a root negative, or 0/0 taken?")
        raise NotYet(self.hint)


def _results(function: Answer, trials: list[tuple]) -> list[list[NDArray]]:
    return [_parts(_called(function, trial)) for trial in trials]


def _called(function: Answer, trial: tuple) -> Any:
    """The result of a function at a copy of the arguments; an exception in it becomes a sentence."""
    try:
        with np.errstate(all="ignore"):
            return function(*copy.deepcopy(trial))
    except Exception as error:
        inside = error.__traceback__.tb_next  # none if the function could not be called
        where = f" in line {inside.tb_lineno} of its cell" if inside else ""
        raise NotYet(f"your function stops{where} with {type(error).__name__}: {error}") from None


def _parts(result: Any) -> list[NDArray]:
    """The values of a result as arrays of numbers."""
    values = list(result) if isinstance(result, tuple) else [result]
    if any(value is None or value is ... for value in values):
        raise NotYet("your function returns nothing yet: fill it in")
    try:
        parts = [np.asarray(value) for value in values]
        return [part.astype(complex if np.iscomplexobj(part) else float) for part in parts]
    except (TypeError, ValueError):
        raise NotYet("your function returns neither numbers nor a tuple of them") from None


def _agree(first: list[NDArray], second: list[NDArray]) -> bool:
    """Whether two results are equal up to rounding; nan equals nan, because a typical mistake may return nan."""
    if [part.shape for part in first] != [part.shape for part in second]:
        return False
    scales = (np.max(np.abs(part), initial=0.0, where=np.isfinite(part)) for part in second)
    return all(
        np.allclose(a, b, rtol=0.0, atol=TOLERANCE * scale, equal_nan=True)
        for a, b, scale in zip(first, second, scales, strict=True)
    )


def _described(parts: list[NDArray]) -> str:
    return " and ".join(f"an array of shape {part.shape}" if part.ndim else "a number" for part in parts)


def positive_definite(rng: np.random.Generator, size: int) -> NDArray:
    """Draw a positive definite matrix, shape (size, size)."""
    root = rng.normal(size=(size, size))
    return root @ root.T + np.eye(size)
