"""How a wrong answer behaves where the right one behaves otherwise: what doubles it, where it is right.

Both functions are called again at changed arguments. A difference counts only if it shows at every input, so that what
the student reads is true of the answer, whatever the formula behind it is. A function here takes the arguments of a
trial and returns one value of a result as an array.
"""

import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

Function = Callable[[tuple], NDArray]

FINE = 1e-6
"""Relative difference up to which two results of one function are the same."""

COARSE = 1e-3
"""Relative difference from which two results differ: between the two, nothing is said."""

PROPERTIES: dict[str, Callable[[NDArray], bool]] = {
    "symmetric": lambda x: x.ndim == 2 and x.shape[0] == x.shape[1] > 1 and bool(_same(x, x.T, COARSE).all()),
    "positive definite": lambda x: x.ndim == 2 and x.shape[0] == x.shape[1] > 1 and _definite(x),
    "positive": lambda x: bool((x > 0).all()),
    "zero or positive": lambda x: bool((x >= 0).all()),
    "negative": lambda x: bool((x < 0).all()),
    "at most 1": lambda x: bool((np.abs(x) <= 1 + COARSE).all()),
    "summing to 1": lambda x: x.ndim == 1 and abs(x.sum() - 1) < COARSE,
    "a whole number": lambda x: bool(_same(x, np.round(x), FINE).all()),
}
"""Properties of a result; a sentence is said of one that every right result has, and every wrong one lacks."""

SPECIAL: dict[str, Callable[[Any], Any]] = {
    "is 0": lambda x: 0 * x,
    "is 1": lambda x: 0 * x + 1 if np.ndim(x) == 0 else None,
    "is 1/2": lambda x: 0.5 if isinstance(x, float) else None,
    "is the identity": lambda x: np.zeros_like(x) + np.eye(x.shape[-1]) if _square(x) else None,
    "is diagonal": lambda x: x * np.eye(x.shape[-1]) if _square(x) else None,
    "is symmetric": lambda x: (x + _transposed(x)) / 2 if _square(x) else None,
    "is constant": lambda x: 0 * x + x[:1] if np.ndim(x) else None,
    "is evenly spaced": lambda x: np.linspace(x[0], x[-1], len(x)).astype(x.dtype) if np.ndim(x) == 1 else None,
    "has no negative entry": lambda x: np.abs(x) if np.ndim(x) else None,
    "is in ascending order": lambda x: np.sort(x) if np.ndim(x) == 1 else None,
}
"""Special values of an argument at which a wrong answer may be right."""


@dataclass
class Pair:
    """A wrong answer beside the right one, at the inputs of an exercise.

    Attributes:
        answer: the student's function.
        truth: the right function.
        trials: the arguments of each trial.
        names: the names of the arguments.
        tolerance: the relative error up to which a result is right.
        patience: time in s after which a slow answer is not called at further changed arguments.
    """

    answer: Function
    truth: Function
    trials: Sequence[tuple]
    names: Sequence[str]
    tolerance: float
    patience: float = 5.0

    def __post_init__(self) -> None:
        self._end = time.monotonic() + self.patience

    def at(self, change: Callable[[tuple], tuple]) -> list[tuple[NDArray, NDArray]] | None:
        """Return the given and the right results at changed arguments; None if one is not finite, or late."""
        results = []
        for trial in self.trials:
            if time.monotonic() > self._end:
                return None
            try:
                true = self.truth(change(trial))
                mine = self.answer(change(trial)) if np.isfinite(true).all() else np.array([])
            except Exception:  # changed arguments may make no sense to either function
                return None
            if mine.shape != true.shape or not np.isfinite(mine).all():
                return None
            results.append((mine, true))
        return results


def differences(pair: Pair) -> str | None:
    """Return up to two sentences on how the answer behaves otherwise than the right one; None if nothing shows."""
    with warnings.catch_warnings(action="ignore"):
        base = pair.at(lambda of: of)
        if base is None:
            return None
        found: list[str] = []
        for look in (_by_property, _by_scale, _by_shift, _by_order, _by_entry, _by_direction, _right_where):
            if len(found) < 2 and (words := look(pair, base)):
                found.append(words)
    return "; and ".join(found) or None


def _by_property(_: Pair, base: list[tuple[NDArray, NDArray]]) -> str | None:
    for words, holds in PROPERTIES.items():
        if all(holds(true) for _, true in base) and not any(holds(mine) for mine, _ in base):
            return f"not {words}: the right one is"
    return None


def _by_scale(pair: Pair, base: list[tuple[NDArray, NDArray]]) -> str | None:
    """Doubled arguments, or one with the other sign, multiply the right result by a power of two, or by -1."""
    usable = [k for k, value in enumerate(pair.trials[0]) if np.asarray(value).dtype != bool and not _count(value)]
    for count in (1, 2, 3):
        for places in combinations(usable, count):
            value = pair.trials[0][places[0]]
            signed = (
                count == 1 and np.min(value) < 0 and not (_square(value) and np.allclose(value, _transposed(value)))
            )
            for factor, words in ((2, "doubled"), (-1, "of the other sign"))[: 1 + signed]:
                changed = pair.at(lambda of, p=places, f=factor: _replaced(of, p, lambda x: f * x))
                if changed is None:
                    continue
                ratios = [
                    (_ratio(mine, first), _ratio(true, other))
                    for (mine, true), (first, other) in zip(changed, base, strict=True)
                ]
                if not all(_law(right) and (mine is None or abs(mine / right - 1) > COARSE) for mine, right in ratios):
                    continue
                which = " and ".join(f"`{pair.names[k]}`" for k in places)
                mine, right = ([both[k] for both in ratios] for k in (0, 1))
                return f"{_times(mine)} with {which} {words}: the right one is {_times(right)}"
    return None


def _law(ratio: float | None) -> bool:
    """Whether a number is a power of two, or of its root, or -1: a law of the result, no chance."""
    if ratio is None or not ratio:
        return False
    power = 2 * np.log2(abs(ratio))
    return abs(power - round(power)) < FINE


def _by_shift(pair: Pair, base: list[tuple[NDArray, NDArray]]) -> str | None:
    """The same number added to all of an array leaves the right result as it is."""
    for k, value in enumerate(pair.trials[0]):
        if np.ndim(value) and value.dtype != bool:
            step = np.ptp(value[np.isfinite(value)]) / 3
            added = int(step) if value.dtype.kind == "i" else step
            changed = pair.at(lambda of, k=k, added=added: _replaced(of, (k,), lambda x: x + added))
            if changed and _changes(changed, base, right=False, mine=True):
                return f"changed by a number added to all of `{pair.names[k]}`: the right one is not"
    return None


def _by_order(pair: Pair, base: list[tuple[NDArray, NDArray]]) -> str | None:
    """Samples in the reverse order leave the right result as it is."""
    samples = [k for k, value in enumerate(pair.trials[0]) if np.ndim(value)]
    groups = [tuple(samples), *[(k,) for k in samples]] if len(samples) > 1 else [tuple(samples)]
    for places in filter(None, groups):
        changed = pair.at(lambda of, places=places: _replaced(of, places, lambda x: x[::-1]))
        if changed and _changes(changed, base, right=False, mine=True):
            which = " and ".join(f"`{pair.names[k]}`" for k in places)
            return f"changed by the order of {which}: the right one is not"
    return None


def _by_entry(pair: Pair, base: list[tuple[NDArray, NDArray]]) -> str | None:
    """One entry of an argument has an effect on the answer that it should not have, or none where it should."""
    for k, place, words in _entries(pair):
        changed = pair.at(lambda of, k=k, place=place: _replaced(of, (k,), lambda x: _disturbed(x, place)))
        if changed is None:
            continue
        if _changes(changed, base, right=True, mine=False):
            return f"not changed by {words}: the right one is"
        if _changes(changed, base, right=False, mine=True):
            return f"changed by {words}: the right one is not"
        moved = [
            (~_same(mine, first, COARSE), _same(true, other, FINE))
            for (mine, true), (first, other) in zip(changed, base, strict=True)
        ]
        if all(np.ndim(mine) and (mine & still).any() for mine, still in moved):
            where = np.argwhere(moved[0][0] & moved[0][1])[0].tolist()
            return f"changed by {words} where the right one is not, for example in entry {where}"
    return None


def _by_direction(pair: Pair, base: list[tuple[NDArray, NDArray]]) -> str | None:
    """The answer grows with a number where the right one falls."""
    for k, value in enumerate(pair.trials[0]):
        if np.ndim(value) == 0 and not _count(value) and base[0][0].ndim == 0:
            changed = pair.at(lambda of, k=k: _replaced(of, (k,), lambda x: 1.05 * x))
            if changed is None:
                continue
            signs = np.sign(np.array(changed) - np.array(base))
            if abs(signs.sum(axis=0)).min() == len(base) and signs[0, 0] != signs[0, 1]:
                verbs = ("growing", "falls") if signs[0, 0] > 0 else ("falling", "grows")
                return f"{verbs[0]} as `{pair.names[k]}` grows: the right one {verbs[1]}"
    return None


def _right_where(pair: Pair, _: list[tuple[NDArray, NDArray]]) -> str | None:
    """At a special value of an argument the answer is right, though the right result is not trivial there."""
    for words, change in _specials(pair):
        try:
            changed = pair.at(change)
        except (TypeError, ValueError):
            continue
        if not changed or _trivial([true for _, true in changed], [change(trial) for trial in pair.trials]):
            continue
        if all(bool(_same(mine, true, pair.tolerance).all()) for mine, true in changed):
            also = " (the terms without it are right)" if words.endswith("is 0") else ""
            return f"right where {words}, not elsewhere{also}"
    return None


def _trivial(results: list[NDArray], trials: list[tuple]) -> bool:
    """Whether results are always the same or one of the arguments: then almost any formula gives them."""
    first = results[0]
    others = len(trials[0]) > 1  # the one argument of a function is fixed here, so its result is, too
    if others and all(result.shape == first.shape and bool(_same(result, first, COARSE).all()) for result in results):
        return True
    return any(
        all(
            np.shape(trial[k]) == result.shape and bool(_same(result, np.asarray(trial[k]), COARSE).all())
            for result, trial in zip(results, trials, strict=True)
        )
        for k in range(len(trials[0]))
    )


def _specials(pair: Pair) -> Iterator[tuple[str, Callable[[tuple], tuple]]]:
    for k, m in combinations(range(len(pair.names)), 2):
        if np.shape(pair.trials[0][k]) == np.shape(pair.trials[0][m]):
            words = f"`{pair.names[k]}` equals `{pair.names[m]}`"
            yield words, lambda of, k=k, m=m: (*of[:k], of[m], *of[k + 1 :])
    for k, name in enumerate(pair.names):
        for words, special in SPECIAL.items():
            if special(pair.trials[0][k]) is not None:
                yield f"`{name}` {words}", lambda of, k=k, special=special: _replaced(of, (k,), special)


def of_fitted_argument(pair: Pair) -> str | None:
    """Return by which number an argument is multiplied, or what is added to it, before it is used rightly."""
    given = [pair.answer(trial) for trial in pair.trials]
    for k, name in enumerate(pair.names):
        if np.asarray(pair.trials[0][k]).dtype.kind != "f":
            continue
        for words, change, grid in (
            (
                "{:.4g} times `{}`",
                np.multiply,
                np.concatenate([np.geomspace(0.02, 50, 25), -np.geomspace(0.02, 50, 25)]),
            ),
            ("`{1}` plus {0:.4g}", np.add, np.linspace(-2.0, 2.0, 21)),
        ):
            for number in _solutions(pair, k, change, grid, given[0]):
                changed = lambda of, k=k, number=number, by=change: _replaced(of, (k,), lambda x: by(x, number))  # noqa: E731
                try:
                    images = [pair.truth(changed(trial)) for trial in pair.trials]
                except Exception:  # changed arguments may make no sense to the right function
                    continue
                if all(bool(_same(a, b, pair.tolerance).all()) for a, b in zip(given, images, strict=True)):
                    return f"what comes out with {words.format(number, name)} where `{name}` belongs"
    return None


def _solutions(pair: Pair, k: int, change: Callable, grid: NDArray, given: NDArray) -> Iterator[float]:
    """Numbers with which the sum of the right result at the first input is that of the given one."""

    def excess(number: float) -> float:
        try:
            return float((pair.truth(_replaced(pair.trials[0], (k,), lambda x: change(x, number))) - given).sum().real)
        except Exception:  # as above
            return np.nan

    values = [excess(number) for number in grid]
    for (low, first), (high, second) in zip(zip(grid, values), zip(grid[1:], values[1:])):  # noqa: B905
        if low * high >= 0 and first * second < 0:
            try:
                yield brentq(excess, *sorted((low, high)), xtol=1e-12)
            except (ValueError, RuntimeError):  # not defined all the way
                continue


def of_powers(pair: Pair) -> str | None:
    """Return the powers of scalar arguments by which a scalar result is the right one multiplied, or which it is."""
    base = pair.at(lambda of: of)
    scalars = [k for k, value in enumerate(pair.trials[0]) if np.ndim(value) == 0 and not _count(value)]
    if base is None or base[0][0].ndim or not scalars or len(base) < len(scalars) + 3:
        return None
    mine, true = np.array(base).T
    arguments = np.array([[trial[k] for k in scalars] for trial in pair.trials])
    if (arguments <= 0).any() or not mine.all() or not true.all():
        return None
    matrix = np.hstack([np.log(arguments), np.ones((len(base), 1))])
    for ratio, start in ((mine / true, "the right one times "), (mine, "")):
        if np.ptp(np.sign(ratio)):
            continue
        *powers, rest = np.linalg.lstsq(matrix, np.log(np.abs(ratio)))[0]
        error = matrix @ [*powers, rest] - np.log(np.abs(ratio))
        if (
            np.abs(error).max() < pair.tolerance
            and np.abs(2 * np.array(powers) - np.round(2 * np.array(powers))).max() < 0.01
        ):
            factors = [
                f"`{pair.names[k]}`" + (f" to the power {round(2 * power) / 2:g}" if abs(power - 1) > 0.1 else "")
                for k, power in zip(scalars, powers, strict=True)
                if abs(power) > 0.1
            ]
            if factors:
                number = np.sign(ratio[0]) * np.exp(rest)
                before = "" if abs(number - 1) < pair.tolerance else f"{number:.4g} times "
                return f"{start}{before}{' times '.join(factors)}"
    return None


def _entries(pair: Pair) -> Iterator[tuple[int, tuple, str]]:
    """The first, the middle and the last entry of each argument that is a series, along its axes."""
    for k, (value, name) in enumerate(zip(pair.trials[0], pair.names, strict=True)):
        if np.ndim(value) and not (np.ndim(value) == 2 and _square(value)):
            for index, word in ((-1, "the last"), (0, "the first"), (None, "the middle")):
                yield k, (0, index), f"{word} {'row' if np.ndim(value) == 2 else 'entry'} of `{name}`"
            for index, word in ((-1, "last"), (0, "first")) if np.ndim(value) == 2 else ():
                yield k, (1, index), f"the {word} column of `{name}`"


def _disturbed(x: NDArray, place: tuple[int, int | None]) -> NDArray:
    axis, index = place
    x = np.array(x)
    view = np.moveaxis(x, axis, 0)
    at = len(view) // 2 if index is None else index
    if x.dtype == bool:
        view[at] = ~view[at]
    elif x.dtype.kind == "i":
        view[at] += int(np.median(np.abs(np.diff(x)))) // 2
    elif np.ndim(view[at]) == 2:  # a matrix that is to remain positive definite
        view[at] *= 1.7
    else:
        view[at] += 0.37 * np.abs(view[at]) + 0.1 * np.abs(x[np.isfinite(x)]).max()
    return x


def _changes(changed: list, base: list, right: bool, mine: bool) -> bool:
    """Whether at every input the right result has changed as ``right`` says, and the given one as ``mine`` says."""
    for (given, true), (first, other) in zip(changed, base, strict=True):
        for now, before, wanted in ((given, first, mine), (true, other, right)):
            if now.shape != before.shape:
                return False
            if bool(_same(now, before, COARSE if wanted else FINE).all()) == wanted:
                return False
    return True


def _ratio(after: NDArray, before: NDArray) -> float | None:
    """The number by which all of an array has been multiplied; None if there is none."""
    if after.shape != before.shape or not before.any():
        return None
    top = np.unravel_index(np.abs(before).argmax(), before.shape)
    ratio = (after[top] / before[top]).real
    return ratio if np.isfinite(ratio) and bool(_same(after, ratio * before, FINE).all()) else None


def _times(ratios: list[float | None]) -> str:
    numbers = [ratio for ratio in ratios if ratio is not None]
    if len(numbers) < len(ratios):
        return "not multiplied by one number"
    low, high = min(numbers), max(numbers)
    if high - low > COARSE * abs(high):
        return f"{low:.3g} to {high:.3g} times as large"
    return "the same" if abs(low - 1) < COARSE else f"{low:.4g} times as large"


def _same(one: NDArray, other: NDArray, tolerance: float) -> NDArray:
    """Where two arrays agree, relative to the largest number of the second one."""
    one, other = 1.0 * one, 1.0 * other
    return np.abs(one - other) <= tolerance * np.abs(other).max(initial=0.0)


def _replaced(arguments: tuple, places: Sequence[int], change: Callable[[Any], Any]) -> tuple:
    return tuple(change(value) if k in places else value for k, value in enumerate(arguments))


def _count(value: Any) -> bool:
    return isinstance(value, int | np.integer)


def _transposed(x: NDArray) -> NDArray:
    return x.swapaxes(-1, -2)


def _square(x: Any) -> bool:
    return np.ndim(x) >= 2 and x.shape[-1] == x.shape[-2] > 1


def _definite(x: NDArray) -> bool:
    return bool((np.linalg.eigvalsh((x + x.T) / 2) > 0).all())
