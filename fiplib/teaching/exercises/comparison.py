"""How a wrong result is related to the right one, in words: twice it, its reciprocal, transposed, one entry wrong.

Results are compared over all trials at once: a relation counts only if it holds at every input. One value of a result
is a list of arrays, one array for each trial, of the same shapes as the right ones.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fiplib.params import GRAVITY

Values = Sequence[NDArray]
"""One value of a result at all trials."""

NEAR = 0.01
"""Relative error below which a wrong value is called nearly right: a rounded constant, a small term left out."""

FACTORS = {
    -1.0: "the right one with the wrong sign",
    2.0: "twice the right one",
    math.sqrt(2.0): "the root of 2 times the right one",
    math.sqrt(0.5): "the right one divided by the root of 2",
    0.5: "half the right one",
    math.degrees(1.0): "in degrees, where radians are asked for",
    math.radians(1.0): "too small by pi/180, as if an angle in radians were converted once more",
    math.pi: "pi times the right one",
    1 / math.pi: "the right one divided by pi",
    2 * math.pi: "2 pi times the right one",
    1 / (2 * math.pi): "the right one divided by 2 pi",
    GRAVITY: "g times the right one",
    1 / GRAVITY: "the right one divided by g",
    1e9: "1e9 times the right one: look at the units",
    1e-9: "1e-9 times the right one: look at the units",
    1e3: "1000 times the right one: look at the units",
    1e-3: "a thousandth of the right one: look at the units",
}

RELATIONS: dict[str, Callable[[NDArray], NDArray]] = {
    "the right one transposed": lambda x: x.T,
    "the absolute value of the right one": np.abs,
    "the reciprocal of the right one": lambda x: 1 / x,
    "the square of the right one": lambda x: x**2,
    "the square root of the right one": lambda x: np.sqrt(np.abs(x)),
    "the reciprocal of the square of the right one": lambda x: 1 / x**2,
    "the reciprocal of the root of the right one": lambda x: 1 / np.sqrt(np.abs(x)),
    "the logarithm of the right one": lambda x: np.log(np.abs(x)),
    "the exponential of the right one": np.exp,
    "the sine of the right one": np.sin,
    "the cosine of the right one": np.cos,
    "the right one with True and False exchanged": lambda x: 1 - x,
    "one minus the right one": lambda x: 1 - x,
    "the inverse matrix of the right one": np.linalg.inv,
    "the right one in the reverse order": lambda x: x[::-1],
    "the right one with its columns in the reverse order": lambda x: x[:, ::-1],
    "the right one shifted by one place, too late": lambda x: np.roll(x, 1, axis=0),
    "the right one shifted by one place, too early": lambda x: np.roll(x, -1, axis=0),
    "the right one sorted": lambda x: np.sort(x, axis=0),
    "the running sum of the right one": lambda x: np.cumsum(x, axis=0),
    "the mean of the right one, everywhere": lambda x: 0 * x + x.mean(),
    "the sum of the right one, everywhere": lambda x: 0 * x + x.sum(),
    "the largest of the right one, everywhere": lambda x: 0 * x + x.max(),
    "the right one less its mean": lambda x: x - x.mean(),
    "the right one divided by its sum: it is not to be normalised": lambda x: x / x.sum(),
    "the right one divided by its largest: it is not to be normalised": lambda x: x / x.max(),
    "the right one divided by its norm: it is not to be normalised": lambda x: x / np.linalg.norm(x),
    "the right one with its negative values set to zero": lambda x: np.maximum(x, 0) if x.ndim < 2 else x,
    "the right one with its positive values set to zero": lambda x: np.minimum(x, 0) if x.ndim < 2 else x,
    "the right one, at most 1": lambda x: np.minimum(x, 1),
    "the right one rounded to whole numbers": np.round,
    "the right one rounded down": np.floor,
    "the right one rounded up": np.ceil,
    "the cube of the right one": lambda x: x**3,
    "the tangent of the right one": np.tan,
    "the exponential of the right one, less one": np.expm1,
    "the logarithm of one plus the right one": lambda x: np.log1p(np.abs(x)),
    "the diagonal of the right one, the rest is zero": lambda x: np.diag(np.diag(x)) if x.ndim == 2 else x,
    "the upper triangle of the right one": np.triu,
    "the lower triangle of the right one": np.tril,
    "the symmetric part of the right one": lambda x: (x + x.T) / 2,
}
"""What typical mistakes make of a right value, of any of its shapes for which the function makes sense."""

REDUCTIONS: dict[str, Callable[[NDArray], NDArray]] = {
    "all but the first": lambda x: x[1:],
    "all but the last": lambda x: x[:-1],
    "the transposed": np.transpose,
    "the sum": np.sum,
    "the mean": np.mean,
    "the largest": np.max,
    "the smallest": np.min,
    "the first": lambda x: x[0],
    "the last": lambda x: x[-1],
    "the diagonal": np.diagonal,
    "the sums along the first axis": lambda x: x.sum(axis=0),
    "the sums along the last axis": lambda x: x.sum(axis=-1),
}
"""What makes a value of another shape out of a right one."""

CHANGES: dict[str, Callable[[Any], Any]] = {
    "twice {}": lambda x: 2 * x,
    "half of {}": lambda x: x / 2,
    "a quarter of {}": lambda x: x / 4,
    "four times {}": lambda x: 4 * x,
    "minus {}": lambda x: -x,
    "the square of {}": lambda x: x * x,
    "the root of {}": lambda x: np.sqrt(x),
    "the reciprocal of {}": lambda x: 1 / x,
    "{} transposed": lambda x: x.swapaxes(-1, -2),
    "{} inverted": lambda x: np.linalg.inv(x),
    "{} in the reverse order": lambda x: x[::-1],
    "{} with its columns in the reverse order": lambda x: x[:, ::-1],
    "{} shifted by one place": lambda x: np.roll(x, 1, axis=0),
    "{} shifted back by one place": lambda x: np.roll(x, -1, axis=0),
    "the first of {} for all": lambda x: 0 * x + x[:1],
    "the mean of {} for all": lambda x: 0 * x + x.mean(axis=0),
    "the running sum of {}": lambda x: np.cumsum(x, axis=0),
    "{} less its mean": lambda x: x - x.mean(axis=0),
    "{} sorted": lambda x: np.sort(x, axis=0),
    "{} rounded": np.round,
    "the diagonal of {} alone": lambda x: x * np.eye(x.shape[-1]) if np.ndim(x) >= 2 else None,
    "the identity for {}": lambda x: 0 * x + np.eye(x.shape[-1]) if np.ndim(x) >= 2 else None,
    "the positive values of {} alone": lambda x: np.maximum(x, 0),
    "zero for {} (is a term missing?)": lambda x: 0 * x,
    "one for {} (is a factor missing?)": lambda x: x / x,
    "{} in degrees": lambda x: np.degrees(x),
    "{} in radians": lambda x: np.radians(x),
    "the absolute value of {}": lambda x: np.abs(x),
    "the negative values of {} alone": lambda x: np.minimum(x, 0),
    "True and False exchanged in {}": lambda x: np.logical_not(x) if x.dtype == bool else None,
    "all but the last of {}": lambda x: x[:-1],
    "all but the first of {}": lambda x: x[1:],
    "one more zero after {}": lambda x: np.concatenate([x, 0 * x[:1]]),
    "{} plus one": lambda x: x + 1,
    "{} minus one": lambda x: x - 1,
    "one minus {}": lambda x: 1 - x,
}
"""What typical mistakes make of an argument before they use it rightly."""


def agree(given: Values, expected: Values, tolerance: float) -> bool:
    """Whether the values agree at all trials, each within ``tolerance`` of the largest number in it."""
    if [value.shape for value in given] != [value.shape for value in expected]:
        return False
    return all(_close(mine, true, tolerance) for mine, true in zip(given, expected, strict=True))


def _close(mine: NDArray, true: NDArray, tolerance: float) -> bool:
    scale = np.max(np.abs(true), initial=0.0, where=np.isfinite(true))
    return np.allclose(mine, true, rtol=0.0, atol=tolerance * scale, equal_nan=True)


def relation(given: Values, expected: Values, tolerance: float) -> str | None:
    """Return how a wrong value follows from the right one: "half the right one", "too large by 1"; None if not."""
    if not np.any(_flat(given)):
        return "zero"
    if (factor := _factor(given, expected, tolerance)) is not None and abs(factor - 1) > NEAR:
        return _times(factor, tolerance)
    for words, made in RELATIONS.items():
        try:
            images = [made(true) for true in expected]
        except (np.linalg.LinAlgError, IndexError, TypeError, ValueError):
            continue
        if not _several(images) or (factor := _factor(given, images, tolerance)) is None:
            continue
        if abs(factor - 1) <= tolerance:
            return words
        if abs(factor + 1) <= tolerance:
            return f"minus {words}"
    return _of_offset(given, expected, tolerance)


def _of_offset(given: Values, expected: Values, tolerance: float) -> str | None:
    """A number added to the right value, or to a multiple of it."""
    if [value.shape for value in given] != [value.shape for value in expected]:
        return None
    mine, true = _flat(given), _flat(expected)
    if not np.isfinite(mine).all() or not np.isfinite(true).all() or not _several(expected):
        return None
    offset = (mine - true).mean()
    if agree(given, [value + offset for value in expected], tolerance):
        return f"too {'large' if offset > 0 else 'small'} by {abs(offset):.4g} everywhere"
    if agree(given, expected, NEAR) or not _several(given):
        return None
    factor, offset = np.polyfit(true, mine, 1)
    if len(np.unique(true)) > 2 and agree(given, [factor * value + offset for value in expected], tolerance):
        return f"{factor:.4g} times the right one {'plus' if offset > 0 else 'minus'} {abs(offset):.4g}"
    return None


def _flat(values: Values) -> NDArray:
    return np.concatenate([value.ravel() for value in values])


def _several(values: Values) -> bool:
    """Whether values are not all the same number: a factor found from one number alone says nothing."""
    return len(np.unique(np.round(_flat(values), 12))) > 1


def _factor(given: Values, images: Values, tolerance: float) -> float | None:
    """The one number by which all images are to be multiplied for the given values."""
    if [value.shape for value in given] != [value.shape for value in images]:
        return None
    mine, theirs = _flat(given), _flat(images)
    usable = np.isfinite(mine) & np.isfinite(theirs)
    if not usable.any() or not theirs[usable].any():
        return None
    top = np.flatnonzero(usable)[np.abs(theirs[usable]).argmax()]
    factor = (mine[top] / theirs[top]).real
    known = any(abs(factor / name - 1) <= tolerance for name in (*FACTORS, 1.0))
    if not np.isfinite(factor) or not factor or not (known or _several(images)):
        return None
    scaled = [factor * image for image in images]
    return factor if agree(given, scaled, tolerance) else None


def _times(factor: float, tolerance: float) -> str:
    for sign, before in ((1, ""), (-1, ", and its sign is wrong")):
        for number, words in FACTORS.items():
            if abs(sign * factor / number - 1) <= tolerance:
                return words + before
    return f"{factor:.4g} times the right one"


def of_shapes(given: Values, expected: Values, tolerance: float) -> str | None:
    """Return which part or summary of the right value has the wrong shape that was given; None if none fits."""
    for words, reduced in REDUCTIONS.items():
        for whole, part, sentence in (
            (expected, given, "that is {} of what is asked for"),
            (given, expected, "take {}"),
        ):
            try:
                images = [np.asarray(reduced(value)) for value in whole]
            except (IndexError, ValueError):
                continue
            if agree(part, images, tolerance):
                return sentence.format(words)
    return None


def of_order(given: Sequence[Values], expected: Sequence[Values], tolerance: float) -> str | None:
    """Return that the values of a tuple are right but in another order."""
    for order in permutations(range(len(expected))):
        if all(agree(given[place], expected[k], tolerance) for place, k in enumerate(order)):
            return "the values are right, their order is not: they are exchanged"
    return None


def of_constants(given: Values, expected: Values, tolerance: float) -> str | None:
    """Return that a value is the same at every input, though the right one is not."""
    if any(mine.shape != given[0].shape for mine in given):
        return None
    if all(np.array_equal(mine, given[0]) for mine in given) and not agree(
        expected, [expected[0]] * len(given), tolerance
    ):
        values = np.unique(given[0])
        return f"{f'{values[0].real:.4g}' if values.size == 1 else 'the same'} at every input, whatever the arguments"
    return None


def of_kinds(given: Values, kinds: Sequence[str]) -> str | None:
    """Return which number a value is at each kind of input, if it is one number at each."""
    if any(mine.ndim for mine in given):
        return None
    numbers = {kind: {float(mine.real) for mine, of in zip(given, kinds, strict=True) if of == kind} for kind in kinds}
    if any(len(values) > 1 for values in numbers.values()) or min(map(list(kinds).count, numbers)) < 2:
        return None
    return " and ".join(f"{values.pop():.4g} for {kind}" for kind, values in sorted(numbers.items()))


def nearly(given: Values, expected: Values) -> str | None:
    """Return that a value is nearly right at every input."""
    near = agree(given, expected, NEAR)
    return "nearly right, within 1 %: is a constant rounded (g is 9.81), or a small term left out?" if near else None


def of_inputs(truth: Callable[[tuple], NDArray], given: Values, trials: Sequence[tuple], names: Sequence[str],
              tolerance: float, multiple: bool = False) -> str | None:  # fmt: skip
    """Return with which wrong argument the right function would give this value: "half of `length`".

    ``truth`` returns the right value at changed arguments; with ``multiple`` the value may be a multiple of that.
    """
    for words, changed in _changes(trials[0], names):
        images: list[NDArray] = []
        for trial in trials:
            try:
                images.append(truth(changed(trial)))
            except Exception:  # changed arguments may make no sense to the right function
                break
            so_far = given[: len(images)]
            if not agree(so_far, images, tolerance) and not multiple:
                break
            if multiple and len(images) > 1 and _factor(so_far, images, tolerance) is None:
                break
        else:
            factor = _factor(given, images, tolerance) if multiple else 1.0
            if factor is not None:
                return f"what comes out with {words}" + (f", and then {_times(factor, tolerance)}" if multiple else "")
    return None


def _changes(trial: tuple, names: Sequence[str]) -> Iterator[tuple[str, Callable[[tuple], tuple]]]:
    """Changes of one argument, then of one by another one, then of all arrays."""

    def replaced(k: int, by: Callable[[tuple], Any]) -> Callable[[tuple], tuple]:
        return lambda of: (*of[:k], by(of), *of[k + 1 :])

    quoted = [f"`{name}`" for name in names]
    for k, name in enumerate(quoted):
        for words, change in CHANGES.items():
            yield (
                f"{words.format(name)} where {name} belongs",
                replaced(k, lambda of, k=k, change=change: change(of[k])),
            )
    for k, m in permutations(range(len(names)), 2):
        first, second = quoted[k], quoted[m]
        if np.shape(trial[k]) == np.shape(trial[m]):
            yield f"{second} where {first} belongs", replaced(k, lambda of, m=m: of[m])
            if k < m:
                order = {k: m, m: k}
                yield (
                    f"{first} and {second} exchanged",
                    lambda of, to=order: tuple(of[to.get(n, n)] for n in range(len(of))),
                )
        if np.ndim(trial[m]) == 0:
            for words, power in (("times {}", 1), ("divided by {}", -1), ("divided by the square of {}", -2)):
                phrase = f"{first} {words.format(second)} where {first} belongs"
                yield phrase, replaced(k, lambda of, k=k, m=m, power=power: of[k] * float(of[m]) ** power)
    for words, part in (("the last sample", slice(None, -1)), ("the first sample", slice(1, None))):
        yield (
            f"{words} left out of all arrays",
            lambda of, part=part: tuple(value[part] if np.ndim(value) else value for value in of),
        )


def of_terms(
    given: Values, expected: Values, trials: Sequence[tuple], names: Sequence[str], tolerance: float
) -> str | None:
    """Return which argument is a factor or a term too much or too few, or is returned as it came."""
    difference = [mine - true for mine, true in zip(given, expected, strict=True)]
    for k, name in enumerate(names):
        argument = [np.asarray(trial[k]) * 1.0 for trial in trials]
        argument = [x if x.ndim else np.full_like(d, x) for x, d in zip(argument, difference, strict=True)]
        if abs((_factor(given, argument, tolerance) or 0.0) - 1) <= tolerance:
            return f"`{name}` as it came"
        term = _factor(difference, argument, tolerance)
        if term is not None and min(abs(abs(term) - times) for times in (0.5, 1.0, 2.0)) <= 10 * tolerance:
            times = "" if abs(abs(term) - 1) <= 10 * tolerance else f"{abs(term):.2g} times "
            return f"the right one {'plus' if term > 0 else 'minus'} {times}`{name}`"
    for name, size in _sizes(trials, names):
        for power, words in ((1, "{}"), (2, "{} squared"), (0.5, "the root of {}")):
            for sign, verdict in ((1, "too much"), (-1, "missing")):
                images = [true * number ** (sign * power) for true, number in zip(expected, size, strict=True)]
                if (factor := _factor(given, images, tolerance)) is not None:
                    also = "" if abs(factor - 1) <= tolerance else f", and the rest is {_times(factor, tolerance)}"
                    return f"right but for a factor: {words.format(name)} is {verdict}{also}"
    return None


def of_sum(given: Values, expected: Values, terms: Sequence[Mapping[str, Any]], tolerance: float) -> str | None:
    """Return which terms are counted wrongly, if the value is a sum of named ones: "Q counts 0 times instead of 1"."""
    if any(mine.shape != true.shape for mine, true in zip(given, expected, strict=True)):
        return None
    matrix = np.transpose(
        [
            _flat([np.full(true.shape, these[name]) for these, true in zip(terms, expected, strict=True)])
            for name in terms[0]
        ]
    )
    mine, true = _flat(given), _flat(expected)
    if not np.isfinite(mine).all() or len(mine) < len(terms[0]) + 2:
        return None
    fits = [np.linalg.lstsq(matrix, values)[0] for values in (mine, true)]
    if np.abs(matrix @ fits[0] - mine).max() > tolerance * np.abs(mine).max():
        return None
    sizes = np.abs(matrix).max(axis=0) / np.abs(mine).max()
    wrong = [
        (name, a, b)
        for name, a, b, size in zip(terms[0], *fits, sizes, strict=True)
        if abs(a - b) > 0.01 or abs(a - b) * size > tolerance
    ]
    texts = []
    for name, a, b in wrong:
        shown = round(a, 3) + 0 if abs(a - b) > 0.01 else a  # a small number of a large term
        texts.append(f"{name} counts {shown:.3g} times instead of {abs(round(b))}")
    more = [f"{len(texts) - 3} other terms are counted wrongly, too"] if len(texts) > 4 else []
    return "the right one, but " + " and ".join(texts[:3] + more if more else texts)


def by_size(given: Values, expected: Values) -> str:
    """Return by how much a wrong value is too large at every input, or too small; empty if it is neither."""
    sizes = [[np.sqrt(np.mean(np.abs(value) ** 2)) for value in values] for values in (given, expected)]
    if not np.isfinite(sizes).all() or min(sizes[1]) == 0:
        return ""
    ratios = np.divide(*sizes)
    if ratios.min() > 1 + NEAR or ratios.max() < 1 - NEAR:
        words = "too large" if ratios.min() > 1 else "too small"
        return f"{words} at every input, {ratios.min():.2g} to {ratios.max():.2g} times the right one; "
    return ""


def _sizes(trials: Sequence[tuple], names: Sequence[str]) -> Iterator[tuple[str, list[float]]]:
    """Positive numbers that may be a factor: scalar arguments, and lengths of array arguments, where they vary."""
    for k, name in enumerate(names):
        values = [trial[k] for trial in trials]
        if all(np.ndim(value) == 0 for value in values):
            numbers = {f"`{name}`": values}
        else:
            n = [len(value) for value in values]
            count = f"len({name})"
            numbers = {
                count: n,
                f"{count} - 1": [k - 1 for k in n],
                f"{count} / ({count} - 1)": [k / max(k - 1, 0.5) for k in n],
            }
        for words, sizes in numbers.items():
            if min(sizes) > 0 and len(set(sizes)) > 1:
                yield words, [float(size) for size in sizes]


def of_parts(given: Values, expected: Values, tolerance: float) -> str | None:
    """Return which entries of an array are wrong, if others are right, and what is wrong with them."""
    if expected[0].ndim == 0:
        return None
    pairs = list(zip(given, expected, strict=True))
    factors = [_factor([mine], [true], tolerance) for mine, true in pairs]
    if all(factor is not None for factor in factors):
        return "right but for a factor that differs from input to input: is the result to be normalised, or multiplied?"
    if all(true.size > 1 and _close(mine - mine.flat[0], true - true.flat[0], tolerance) for mine, true in pairs):
        return "right but for a number added, which differs from input to input"
    wrong = [np.abs(mine - true) > tolerance * np.abs(true).max() for mine, true in pairs]
    count, size = sum(map(np.sum, wrong)), sum(true.size for true in expected)
    if set(np.unique(_flat([*given, *expected]))) <= {0.0, 1.0}:
        excess = sum(int((mine > true).sum()) for mine, true in pairs)
        texts = {"True {} times where False belongs": excess, "False {} times where True belongs": count - excess}
        return " and ".join(text.format(times) for text, times in texts.items() if times) + f", of {size} values"
    if len({true.shape for true in expected}) == 1 and not np.all(some := np.any(wrong, axis=0)):
        words = relation([mine[some] for mine, _ in pairs], [true[some] for _, true in pairs], tolerance)
        if words is None and 2 * some.sum() > some.size:
            return None
        return f"wrong in {_place(some)} and right elsewhere" + (f": there it is {words}" if words else "")
    return f"right in {size - count} of {size} entries" if 2 * count <= size else None


def _place(some: NDArray) -> str:
    where = np.argwhere(some)
    if len(where) == 1:
        return f"entry {where[0].tolist()}"
    for axis, name in enumerate(("row", "column")[: some.ndim]):
        if some.ndim == 2 and len(set(where[:, axis])) == 1:
            return f"{name} {where[0, axis]}"
    if some.ndim == 2 and (where[:, 0] == where[:, 1]).all():
        return "the diagonal"
    return f"{len(where)} of {some.size} entries, {where[0].tolist()} the first of them"
