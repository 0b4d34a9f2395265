"""Call a student's function, and read what it returns: in any form that holds the right numbers.

A number may come as an array of one element, an array as a list or with axes of length one, several values as a tuple,
list or array. An exception, a text or an unfilled stub becomes a sentence.
"""

import copy
import inspect
import types
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Answer = Callable[..., Any]
"""The function that a student has written."""

Parts = list[NDArray]
"""A result: one array for each value that is returned."""


class NotYet(Exception):
    """An answer is not right yet; the message says why, in words.

    Attributes:
        evidence: one input with the expected and the given result; empty if the answer has none to compare.
        empty: whether the answer is a stub that is still to be filled in.
    """

    def __init__(self, words: str, evidence: str = "", empty: bool = False) -> None:
        super().__init__(words)
        self.evidence, self.empty = evidence, empty


def _leave(*_: object) -> None:
    raise SystemExit("it asks Python to exit")


def without_exit(answer: Answer) -> Answer:
    """Return the function with an ``exit`` and ``quit`` that only stop it: a notebook's own ones end the kernel."""
    if not inspect.isfunction(answer):
        return answer
    names = answer.__globals__ | {"exit": _leave, "quit": _leave}
    safe = types.FunctionType(answer.__code__, names, answer.__name__, answer.__defaults__, answer.__closure__)
    safe.__kwdefaults__ = answer.__kwdefaults__
    return safe


def called(function: Answer, trial: tuple) -> Any:
    """Return the result of a function at a copy of the arguments. Raises NotYet: says where it stops, and with what."""
    try:
        with np.errstate(all="ignore"):
            return function(*copy.deepcopy(trial))
    except (Exception, SystemExit) as error:
        inside = error.__traceback__.tb_next  # none if the function could not be called
        where = f" in line {inside.tb_lineno} of its cell" if inside else ""
        raise NotYet(f"your function stops{where} with {type(error).__name__}: {error}") from None


def parts_of(result: Any, like: Parts | None) -> Parts:
    """Return the values of a result as arrays, in the shapes of ``like`` if they differ in axes of length one only.

    Without ``like`` a tuple holds several values, anything else is one. Raises NotYet: there are no numbers in it.
    """
    many = isinstance(result, tuple) if like is None else len(like) > 1
    values = _unpacked(result) if many else [result]
    if any(value is None or value is ... for value in values):
        raise NotYet("your function returns nothing yet: fill it in", empty=True)
    parts = [_array(value) for value in values]
    if like is None or len(parts) != len(like):
        return parts
    return [
        part.reshape(true.shape) if np.squeeze(part).shape == np.squeeze(true).shape else part
        for part, true in zip(parts, like, strict=True)
    ]


def _unpacked(result: Any) -> list:
    """The values of a tuple, list or array, without an outer one that holds nothing else."""
    if isinstance(result, np.ndarray):
        return list(np.squeeze(result)) if result.size > 1 else [result]
    if not isinstance(result, tuple | list):
        return [result]
    return _unpacked(result[0]) if len(result) == 1 else list(result)


def _array(value: Any) -> NDArray:
    try:
        array = np.asarray(value)
        if array.dtype.kind in "US":
            raise TypeError("text")
        array = array.astype(complex if array.dtype.kind in "cO" else float)
    except (TypeError, ValueError, OverflowError):
        raise NotYet("your function returns neither numbers nor a tuple of them") from None
    return array.real if np.all(np.abs(array.imag) <= 1e-12 * np.abs(array)) else array


def described(parts: Parts) -> str:
    """Return the shapes of a result in words."""
    return " and ".join(f"an array of shape {part.shape}" if part.ndim else "a number" for part in parts)


def names_of(answer: Answer, count: int) -> list[str]:
    """Return the names of the first ``count`` arguments in the student's own function."""
    try:
        parameters = list(inspect.signature(answer).parameters.values())
    except (TypeError, ValueError):
        parameters = []
    plain = [parameter.name for parameter in parameters if parameter.kind <= parameter.POSITIONAL_OR_KEYWORD]
    return plain[:count] if len(plain) >= count else [f"argument {k + 1}" for k in range(count)]


def input_in_words(trial: Sequence, names: Sequence[str]) -> str:
    """Return the arguments of a trial as "length = 1.2, band = 0.5"."""
    return ", ".join(f"{name} = {_number(value)}" for name, value in zip(names, trial, strict=True))


def _number(value: Any) -> str:
    array = np.asarray(value)
    if array.ndim == 0:
        return f"{value:.4g}" if array.dtype.kind in "fc" else str(value)
    if array.size > 6:
        return f"array {array.shape}"
    return np.array2string(array, precision=4, separator=", ").replace("\n", "")


def beside(mine: Parts, true: Parts) -> str:
    """Return the expected and the given result in words; of a large array, the entry that differs most."""
    if [part.shape for part in mine] != [part.shape for part in true]:
        return f"expected {described(true)}, got {described(mine)}"
    texts = []
    for one, other in zip(mine, true, strict=True):
        if one.size <= 6:
            texts.append(f"expected {_number(other)}, got {_number(one)}")
        else:
            worst = np.unravel_index(np.nanargmax(np.nan_to_num(np.abs(one - other), nan=np.inf)), one.shape)
            place = list(map(int, worst))
            texts.append(f"expected {_number(other[worst])} in entry {place}, got {_number(one[worst])}")
    return "; ".join(texts)
