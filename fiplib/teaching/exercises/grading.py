"""What an exercise is and how an answer is graded.

An exercise asks for a function. ``Exercise.grade`` calls the answer at random inputs, the same ones each time, and
compares its results with the right ones, taken from fiplib where fiplib has them. A wrong answer is compared with the
typical mistakes of the exercise, each of which is a function, too, and then with the right results in general
(``comparison``): the student reads in words what is wrong.

An answer that never returns is not graded: interrupt the kernel, as with any endless loop in a notebook.
"""

import contextlib
import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fiplib.teaching.exercises import behaviour, comparison
from fiplib.teaching.exercises.comparison import agree
from fiplib.teaching.exercises.results import (
    Answer,
    NotYet,
    Parts,
    beside,
    called,
    described,
    input_in_words,
    names_of,
    parts_of,
    without_exit,
)

DRAWS = 6
"""Number of random inputs at which an answer is tried, unless the exercise says otherwise."""

TOLERANCE = 5e-4
"""Relative to the largest number of a value: four correct digits, so that g = 9.807 and rounded results are right.
Half a unit of the fourth digit is 5e-4 of 1.000. The effect of every listed mistake is larger: a test checks it."""

ORDINALS = ("first", "second", "third", "fourth")


@dataclass
class Exercise:
    """A function that a student is asked to write, with what is needed to grade the answer.

    Attributes:
        truth: the function asked for; returns a number, an array, or a tuple of these.
        draw: draws the arguments of one trial from a random generator.
        mistakes: typical mistakes: the sentence that a student reads, and the function that makes the mistake.
        hint: the sentence for any other wrong answer: where to look, not the formula.
        formula: the formula nearly written out, printed from the third wrong answer on.
        praise: the sentence for a right answer.
        kind: names the kind of an input, from its arguments, where the exercise has several: "rods of equal length".
        tolerance: the relative error up to which a result is right.
        draws: number of inputs at which an answer is tried: more where few results are possible, for chance hits few.
        terms: quantities by name of which the right result is the sum, where it is one, and others that are mistaken
            for them; from the arguments.
        tries: number of wrong answers so far; a right one sets it back.
    """

    truth: Answer = field(repr=False)
    draw: Callable[[np.random.Generator], tuple] = field(repr=False)
    mistakes: Mapping[str, Answer] = field(repr=False)
    hint: str
    formula: str = field(repr=False)
    praise: str = field(repr=False)
    kind: Callable[..., str] | None = field(default=None, repr=False, kw_only=True)
    tolerance: float = field(default=TOLERANCE, kw_only=True)
    draws: int = field(default=DRAWS, kw_only=True)
    terms: Callable[..., Mapping[str, Any]] | None = field(default=None, repr=False, kw_only=True)
    tries: int = field(default=0, init=False)

    def inputs(self) -> list[tuple]:
        """Return the arguments at which answers are tried, one tuple for each trial: the same ones each time."""
        rng = np.random.default_rng(0)
        return [self.draw(rng) for _ in range(self.draws)]

    def check(self, answer: Answer) -> None:
        """Print whether the answer is right, and what is wrong with it; raises nothing, so that a notebook runs on.

        The second wrong answer also gets one input with the expected and the given result, the third the formula.
        """
        try:
            self.grade(answer)
        except NotYet as refusal:
            self.tries += not refusal.empty
            print(f"not yet: {refusal}")
            if self.tries >= 2 and refusal.evidence:
                print(refusal.evidence)
            if self.tries >= 3:
                print(f"the formula, nearly: {self.formula}")
        else:
            self.tries = 0
            print(f"right: {self.praise}")

    @np.errstate(all="ignore")
    def grade(self, answer: Answer) -> None:
        """Compare an answer with the truth at the random inputs. Raises NotYet: says what is wrong with it."""
        trials = self.inputs()
        expected = [parts_of(called(self.truth, trial), None) for trial in trials]
        given = self._results(answer, trials, expected)
        right = [self._right(mine, true) for mine, true in zip(given, expected, strict=True)]
        if all(right):
            return
        names = names_of(answer, len(trials[0]))
        wrong = right.index(False)
        place = f"input {wrong + 1} of {self.draws}, inputs()[{wrong}] of the exercise"
        evidence = f"{place}: {input_in_words(trials[wrong], names)}: {beside(given[wrong], expected[wrong])}"
        numbers = np.concatenate([part.ravel() for mine in given for part in mine])
        empty = bool(np.isnan(numbers).all() or not numbers.any())
        for words, mistake in self.mistakes.items():
            if all(map(self._right, given, self._results(mistake, trials, expected))):
                raise NotYet(words, evidence, empty)
        words = (
            self._of_shapes(given, expected)
            or _of_numbers(given, expected, trials, names)
            or self._of_values(answer, given, expected, trials, names)
        )
        raise NotYet(words or self._general(given, expected), evidence, empty)

    def _general(self, given: list[Parts], expected: list[Parts]) -> str:
        """The hint, after whether a single value is too large or too small."""
        if len(expected[0]) > 1:
            return self.hint
        size = comparison.by_size([part for [part] in given], [part for [part] in expected])
        return f"{size}{self.hint}"

    def _results(self, answer: Answer, trials: list[tuple], expected: list[Parts]) -> list[Parts]:
        """The results of an answer in the shapes of the right ones, where they differ in axes of length one only."""
        safe, names = without_exit(answer), names_of(answer, len(trials[0]))
        results = []
        for trial, true in zip(trials, expected, strict=True):
            try:
                results.append(parts_of(called(safe, trial), true))
            except NotYet as refusal:
                after = f"; it ran at {len(results)} inputs before" if results else ""
                at = f" (at {input_in_words(trial, names)}{after})" if not refusal.empty else ""
                raise NotYet(f"{refusal}{at}", empty=refusal.empty) from None
        return results

    def _right(self, mine: Parts, true: Parts) -> bool:
        return len(mine) == len(true) and agree(mine, true, self.tolerance)

    def _of_shapes(self, given: list[Parts], expected: list[Parts]) -> str | None:
        for mine, true in zip(given, expected, strict=True):
            if [part.shape for part in mine] != [part.shape for part in true]:
                break
        else:
            return None
        words = f"your function should return {described(true)}, not {described(mine)}"
        if len(mine) == 1:
            for k, ordinal in enumerate(ORDINALS[: len(true)] if len(true) > 1 else ()):
                if agree([part for [part] in given], [parts[k] for parts in expected], self.tolerance):
                    return f"{words}: that is the {ordinal} value alone"
        related = None
        if len(mine) == len(true) == 1:
            related = comparison.of_shapes([part for [part] in given], [part for [part] in expected], self.tolerance)
        return f"{words}: {related}" if related else words

    def _of_values(
        self, answer: Answer, given: list[Parts], expected: list[Parts], trials: list[tuple], names: list[str]
    ) -> str | None:
        count = len(expected[0])
        columns = [[[parts[k] for parts in results] for k in range(count)] for results in (given, expected)]
        if count > 1 and (words := comparison.of_order(*columns, self.tolerance)):
            return words
        for k, (mine, true) in enumerate(zip(*columns, strict=True)):
            if not agree(mine, true, self.tolerance):
                what = "your result is" if count == 1 else f"the {ordinal(k)} of your {count} values is"
                words = (
                    self._of_value(k, mine, true, trials, names)
                    or self._ignored(answer, k, trials, names)
                    or comparison.of_parts(mine, true, self.tolerance)
                    or comparison.of_inputs(self._value(k), mine, trials, names, self.tolerance, multiple=True)
                    or self._of_behaviour(answer, k, trials, names)
                )
                return words and f"{what} {words}"
        return None

    def _value(self, k: int) -> Callable[[tuple], NDArray]:
        return lambda arguments: parts_of(self.truth(*arguments), None)[k]

    def _of_behaviour(self, answer: Answer, k: int, trials: list[tuple], names: list[str]) -> str | None:
        """How the answer behaves at other arguments, where the right one behaves otherwise."""
        safe = without_exit(answer)
        like = parts_of(self.truth(*trials[0]), None)
        given = lambda arguments: parts_of(called(safe, arguments), like)[k]  # noqa: E731
        pair = behaviour.Pair(given, self._value(k), trials, names, self.tolerance)
        with contextlib.redirect_stdout(io.StringIO()):  # it is called hundreds of times, and may print
            return behaviour.of_fitted_argument(pair) or behaviour.of_powers(pair) or behaviour.differences(pair)

    def _of_value(self, k: int, mine: Parts, true: Parts, trials: list[tuple], names: list[str]) -> str | None:
        tolerance = self.tolerance
        return (
            comparison.relation(mine, true, tolerance)
            or self._of_some(mine, true, trials, names)
            or comparison.of_constants(mine, true, tolerance)
            or (self.kind and comparison.of_kinds(mine, [self.kind(*trial) for trial in trials]))
            or (self.terms and comparison.of_sum(mine, true, [self.terms(*trial) for trial in trials], tolerance))
            or comparison.of_inputs(self._value(k), mine, trials, names, tolerance)
            or comparison.of_terms(mine, true, trials, names, tolerance)
            or comparison.nearly(mine, true)
        )

    def _of_some(self, mine: Parts, true: Parts, trials: list[tuple], names: list[str]) -> str | None:
        """That the results are right at some inputs, at which kind of input they are not, and what they are there."""
        right = [agree([one], [other], self.tolerance) for one, other in zip(mine, true, strict=True)]
        if not any(right):
            return None
        wrong = [k for k in range(len(trials)) if not right[k]]
        where = f"for example at {input_in_words(trials[wrong[0]], names)}"
        if self.kind is not None:
            kinds = [self.kind(*trial) for trial in trials]
            if not {kinds[k] for k in wrong} & {kinds[k] for k in range(len(trials)) if right[k]}:
                where = "for " + " and for ".join(sorted({kinds[k] for k in wrong}))
        words = f"right at {sum(right)} of {len(trials)} inputs, wrong {where}"
        related = comparison.relation([mine[k] for k in wrong], [true[k] for k in wrong], self.tolerance)
        return f"{words}: there it is {related}" if related else words

    def _ignored(self, answer: Answer, k: int, trials: list[tuple], names: list[str]) -> str | None:
        """That an argument has no effect on the answer's result, though it has on the right one."""
        safe, others = without_exit(answer), [*trials[1:], trials[0]]
        for place, name in enumerate(names):
            changed = [(*a[:place], b[place], *a[place + 1 :]) for a, b in zip(trials, others, strict=True)]
            try:
                before, after = ([parts_of(called(safe, of), None)[k] for of in calls] for calls in (trials, changed))
                right = [[parts_of(called(self.truth, of), None)[k] for of in calls] for calls in (trials, changed)]
            except (NotYet, IndexError):
                continue
            if agree(before, after, 1e-12) and not agree(*right, self.tolerance):
                return f"not changed by `{name}`: it should be"
        return None


def ordinal(k: int) -> str:
    """Return the word for a place counted from zero."""
    return ORDINALS[k] if k < len(ORDINALS) else f"{k + 1}th"


def _of_numbers(given: list[Parts], expected: list[Parts], trials: list[tuple], names: list[str]) -> str | None:
    """At which inputs a result is nan, or infinite where it should not be."""
    for what, asked, found in (
        ("nan", "is it filled in? is a root negative, or 0/0 taken?", lambda a, b: np.isnan(a) & ~np.isnan(b)),
        ("infinity", "is something divided by zero?", lambda a, b: np.isinf(a) & np.isfinite(b)),
    ):
        pairs = [list(zip(mine, true, strict=True)) for mine, true in zip(given, expected, strict=True)]
        at = [k for k, pair in enumerate(pairs) if any(found(*parts).any() for parts in pair)]
        if at:
            where = "every input" if len(at) == len(given) else f"{len(at)} of {len(given)} inputs"
            example = input_in_words(trials[at[0]], names)
            return f"your function returns {what} at {where}, for example at {example}: {asked}"
    return None


def positive_definite(rng: np.random.Generator, size: int) -> NDArray:
    """Draw a positive definite matrix, shape (size, size)."""
    root = rng.normal(size=(size, size))
    return root @ root.T + np.eye(size)
