"""The exercises of the notebooks refuse stubs and typical wrong answers, in words, and accept the solutions."""

import inspect
import re
import runpy
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import nbformat
import numpy as np
import pytest

from fiplib.params import GRAVITY
from fiplib.teaching.exercises import bags, closed_loop, ga, kalman, lagrangian, linearisation, mpc
from fiplib.teaching.exercises.grading import Exercise
from fiplib.teaching.exercises.results import NotYet

NOTEBOOKS = Path(__file__).parents[2] / "notebooks"
TEACHING = {
    "01-lagrangian": lagrangian,
    "02-linearisation": linearisation,
    "03-mpc": mpc,
    "04-kalman-filter": kalman,
    "05-genetic-algorithm": ga,
    "06-closed-loop": closed_loop,
    "07-explore-a-bag": bags,
}


def exercises_of(module: ModuleType) -> dict[str, Exercise]:
    return {name: value for name, value in vars(module).items() if isinstance(value, Exercise)}


HOME = {name: notebook for notebook, module in TEACHING.items() for name in exercises_of(module)}
EXERCISES = {name: exercise for module in TEACHING.values() for name, exercise in exercises_of(module).items()}


@cache
def section(notebook: str) -> list[dict[str, Any]]:
    """The cells of the exercises of a notebook."""
    cells = nbformat.read(NOTEBOOKS / f"{notebook}.ipynb", as_version=4).cells
    starts = [k for k, cell in enumerate(cells) if cell.source.startswith("## Exercises")]
    assert len(starts) == 1, f"{notebook} has {len(starts)} sections of exercises"
    return cells[starts[0] :]


def tagged(notebook: str, tag: str) -> list[str]:
    return [cell.source for cell in section(notebook) if tag in cell.metadata.get("tags", ())]


@cache
def stubs(notebook: str) -> dict[str, Callable]:
    """The functions of the cells tagged ``exercise``, by name."""
    names: dict[str, Any] = {}
    for cell in section(notebook):
        if cell.cell_type == "code" and "grader" not in cell.metadata.get("tags", ()):
            exec(cell.source, names)
    wanted = [re.match(r"def (\w+)\(", source)[1] for source in tagged(notebook, "exercise")]
    return {name: names[name] for name in wanted}


@cache
def solutions(notebook: str) -> dict[str, Callable]:
    names = runpy.run_path(str(NOTEBOOKS / "solutions" / f"{notebook}.py"))
    return {name: value for name, value in names.items() if inspect.isfunction(value)}


def words(name: str, answer: Callable) -> str:
    """The sentence with which the exercise refuses a wrong answer."""
    with pytest.raises(NotYet) as refusal:
        EXERCISES[name].grade(answer)
    return str(refusal.value)


@pytest.mark.parametrize("notebook", TEACHING)
def test_a_notebook_asks_each_exercise_of_its_module_once_and_at_least_three(notebook: str) -> None:
    names = list(exercises_of(TEACHING[notebook]))
    assert len(names) >= 3
    assert tagged(notebook, "grader") == [f"exercises.{name}.check({name})" for name in names]
    module = TEACHING[notebook].__name__.rpartition(".")[2]
    imports = [
        f"from fiplib.teaching.exercises import {module} as exercises" in cell.source for cell in section(notebook)
    ]
    assert imports.count(True) == 1
    assert f"](solutions/{notebook}.py)" in section(notebook)[-1].source


@pytest.mark.parametrize("notebook", TEACHING)
def test_stub_and_solution_are_the_same_function_but_for_what_is_to_be_filled_in(notebook: str) -> None:
    asked = list(exercises_of(TEACHING[notebook]))
    assert list(stubs(notebook)) == asked
    assert list(solutions(notebook)) == asked
    for name, stub in stubs(notebook).items():
        assert inspect.signature(stub) == inspect.signature(solutions(notebook)[name])


@pytest.mark.parametrize("notebook", TEACHING)
def test_solutions_fill_in_ten_lines_at_most_as_the_exercises_promise(notebook: str) -> None:
    for name, solution in solutions(notebook).items():
        assert len(inspect.getsource(solution).strip().splitlines()) <= 11, name  # ten and the def


@pytest.mark.parametrize("name", EXERCISES)
def test_the_stub_as_it_stands_in_the_notebook_is_not_right_and_does_not_stop_a_run_of_all_cells(
    name: str, capsys: pytest.CaptureFixture
) -> None:
    stub = stubs(HOME[name])[name]
    EXERCISES[name].check(stub)
    assert capsys.readouterr().out == f"not yet: {words(name, stub)}\n"


@pytest.mark.parametrize("name", EXERCISES)
def test_the_solution_is_praised(name: str, capsys: pytest.CaptureFixture) -> None:
    EXERCISES[name].check(solutions(HOME[name])[name])
    assert capsys.readouterr().out == f"right: {EXERCISES[name].praise}\n"


@pytest.mark.parametrize("name", EXERCISES)
def test_every_listed_mistake_is_refused_with_its_own_sentence(name: str) -> None:
    assert len(EXERCISES[name].mistakes) >= 2
    for sentence, mistake in EXERCISES[name].mistakes.items():
        assert words(name, mistake) == sentence


# Wrong answers as students write them, with a part of the sentence that should refuse them


def elementwise_controllable(first, second, g=GRAVITY):
    a, b = np.zeros((7, 7)), np.eye(7)[:, 6:]
    a[0, 1] = a[2, 3] = a[4, 5] = 1
    a[1, 6], a[3, 6], a[5, 6] = g, -g, -g
    a[3, 2], a[5, 4] = 2 * g / first, 2 * g / second
    return np.linalg.matrix_rank(np.hstack([a**n @ b for n in range(7)]))


def without_lambda(length, inertia_factor, g=GRAVITY):
    return np.array([[0, 1, 0, 0, 0], [0, 0, 0, 0, g], [0, 0, 0, 1, 0], [0, 0, 2 * g / length, 0, -g], [0, 0, 0, 0, 0]])


def falling_back(length, inertia_factor, g=GRAVITY):
    f = inertia_factor
    return [[0, 1, 0, 0, 0], [0, 0, 0, 0, g], [0, 0, 0, 1, 0], [0, 0, -2 * f * g / length, 0, -f * g], [0] * 5]


def riccati_with_plus(a, b, q, r, p):
    return q + a.T @ p @ a + a.T @ p @ b @ np.linalg.inv(r + b.T @ p @ b) @ b.T @ p @ a


def riccati_without_stage(a, b, q, r, p):
    return a.T @ p @ a - a.T @ p @ b @ np.linalg.inv(r + b.T @ p @ b) @ b.T @ p @ a


def newest_first(a, b, x, sent):
    for u in reversed(sent):
        x = a @ x + b @ u
    return x


def likelihood_without_determinant(y, s):
    nis = sum(row @ np.linalg.inv(covariance) @ row for row, covariance in zip(y, s, strict=True))
    return -(nis + y.size * np.log(2 * np.pi)) / 2


def least_significant_first(bits, length_min, resolution):
    return [length_min + resolution * sum(int(bit) << k for k, bit in enumerate(row)) for row in bits]


def with_itself(bits):
    return np.mean([[np.sum(first != second) for first in bits] for second in bits])


def first_inside(time, offset, band):
    return next(t for t, d in zip(time, offset, strict=True) if abs(d) <= band)


def one_sided(time, offset, band):
    settled = time[0]
    for k, d in enumerate(offset):
        if d > band:
            settled = time[k + 1] if k + 1 < len(time) else np.inf
    return settled


def all_coordinates(stamp, position):
    moved = np.all(position[1:] != position[:-1], axis=1)
    return np.append(True, (stamp[1:] > stamp[:-1]) & moved)


def falls_from_rest(a, b, a_rate, b_rate, seat_acceleration, length, g=GRAVITY):
    q = np.array([a, b, np.sqrt((length / 2) ** 2 - a**2 - b**2)]) / (length / 2)
    alpha = seat_acceleration + np.array([0, 0, g])
    return (q * (q @ alpha) - alpha)[:2]


def small_angles(a, b, a_rate, b_rate, seat_acceleration, length, g=GRAVITY):
    return 2 * g / length * np.array([a, b]) - seat_acceleration[:2]


WRONG: dict[str, list[tuple[Callable, str]]] = {
    "height_rate": [
        (lambda a, b, va, vb, l: (a * va + b * vb) / np.sqrt(l**2 / 4 - a**2 - b**2), "the height falls"),
        (lambda a, b, va, vb, l: -(a * va + b * vb) / np.sqrt(l**2 - a**2 - b**2), "the radius is l/2"),
    ],
    "mass_matrix": [
        (lambda a, b, l: [[1, 0], [0, 1]], "the upright rod"),
        (lambda a, b, l: np.eye(2) + np.diag([a**2, b**2]) / (l**2 / 4 - a**2 - b**2), "the product a b is missing"),
    ],
    "accelerations": [
        (falls_from_rest, "the sphere's term is missing"),
        (small_angles, "not changed by `a_rate`"),
    ],
    "inertia_factor": [
        (lambda ratio: 3 / 4, "the uniform rod"),
        (lambda ratio: (0.5 + ratio) ** 2 / (1 / 12 + ratio) / (1 + ratio), "about the seat it is 1/3"),
    ],
    "growth_rate": [
        (lambda l, k2: np.sqrt(2 * GRAVITY / l), "the rod's inertia is missing"),
        (lambda l, k2: np.sqrt(GRAVITY / l / (1 + 4 * k2)), "the centre of mass lies at l/2"),
        (lambda l, k2: np.sqrt(-2 * GRAVITY / l / (1 + 4 * k2)), "a rod that leans falls further"),
        (lambda l, k2: 2 * GRAVITY / l / (1 + 4 * k2), "take the root"),
    ],
    "axis_matrix": [(without_lambda, "lambda is missing"), (falling_back, "a rod that leans falls further")],
    "steady_lean": [
        (lambda r, t, l: r * (w := 2 * np.pi / t) ** 2 / (w**2 + 2 * GRAVITY / l), "leans inwards"),
        (lambda r, t, l: -r / t**2 / (1 / t**2 + 2 * GRAVITY / l), "2 pi / period"),
        (lambda r, t, l: -r * (2 * np.pi / t) ** 2 * l / 2 / GRAVITY, "the slow limit"),
        (lambda r, t, l: r * (w := 2 * np.pi / t) ** 2 / (2 * GRAVITY / l - w**2), "the sign of g/l is wrong"),
    ],
    "controllable_states": [
        (lambda first, second: 7, "rods of equal length"),
        (elementwise_controllable, "matrix_power"),
    ],
    "riccati_step": [(riccati_with_plus, "sign of the last term"), (riccati_without_stage, "add Q")],
    "growths": [
        (lambda a, b, k, n: (np.linalg.norm(a**n, 2), np.linalg.norm((a - b @ k) ** n, 2)), "matrix_power"),
        (
            lambda a, b, k, n: tuple(np.linalg.svd(np.linalg.matrix_power(m, n))[1][0] for m in (a, a + b @ k)),
            "sign of the feedback",
        ),
    ],
    "state_when_it_acts": [(newest_first, "the oldest first"), (lambda a, b, x, sent: x, "the state as measured")],
    "predict_covariance": [
        (lambda j, p, q, step: j @ p @ j.T + q, "the printed form"),
        (lambda j, p, q, step: (np.eye(4) + j * step) @ p @ (np.eye(4) + j * step).T, "Q_e is missing"),
    ],
    "normalised_innovations": [
        (lambda y, s: np.linalg.norm(y, axis=1) ** 2, "nothing is normalised"),
        (lambda y, s: [np.sum(row**2 / np.diag(c)) for row, c in zip(y, s, strict=True)], "only the diagonal"),
    ],
    "log_likelihood": [
        (likelihood_without_determinant, "log det S is missing"),
        (lambda y, s: -EXERCISES["log_likelihood"].truth(y, s), "the sign is wrong"),
    ],
    "decode": [
        (least_significant_first, "you read backwards"),
        (lambda bits, low, step: step * (bits @ 2 ** np.arange(14, -1, -1)), "l_min is missing"),
    ],
    "roulette_probabilities": [
        (lambda f: np.where(np.isfinite(f), f - f.min(), 0) / (f - f.min())[np.isfinite(f)].sum(), "favours the worst"),
        (lambda f: (f.max() - f) / np.sum(f.max() - f), "the worst of the finite ones"),
        (lambda f: (1 / f) / sum(1 / f), "1 / fitness is no weight"),
    ],
    "diversity": [
        (with_itself, "compared with themselves"),
        (lambda bits: EXERCISES["diversity"].truth(bits) / 15, "the share of the bits"),
    ],
    "settling_time": [(first_inside, "swings through"), (one_sided, "the other side")],
    "fuse": [
        (
            lambda l1, s1, l2, s2, w: ((l1 * s2**2 + l2 * s1**2) / (s1**2 + s2**2), s1 * s2 / np.hypot(s1, s2)),
            "counted twice",
        ),
        (
            lambda l1, s1, l2, s2, w: (
                ((1 - w) * l1 / s1 + w * l2 / s2) / ((1 - w) / s1 + w / s2),
                1 / ((1 - w) / s1 + w / s2),
            ),
            "1 / deviation^2",
        ),
    ],
    "cautious_length": [
        (lambda length, deviation, caution: length + caution * deviation, "the wrong side"),
        (lambda length, deviation, caution: length - caution * deviation, "may fall below zero"),
        (lambda length, deviation, caution: 1 / (1 / length + caution * deviation), "deviation / length^2"),
    ],
    "velocities": [
        (lambda t, p: np.diff(p, axis=0) / np.diff(t)[:, None], "nanoseconds"),
        (lambda t, p: np.diff(p, axis=0) / np.mean(np.diff(t / 1e9)), "not by the mean"),
        (lambda t, p: np.diff(p, axis=0) * 240, "240 Hz"),
    ],
    "length_from_lean": [
        (lambda d, tilt: np.linalg.lstsq(tilt[:, None], d)[0][0], "half the length"),
        (lambda d, tilt: 2 * np.mean(d / tilt), "mean of ratios"),
    ],
    "fresh": [
        (lambda t, p: np.append(True, np.diff(t) > 0), "a frozen tracker"),
        (all_coordinates, "by chance"),
        (lambda t, p: np.append(True, (p[1:] != p[:-1]).any(axis=1)), "a frame sent again"),
    ],
}


@pytest.mark.parametrize("name", EXERCISES)
def test_a_wrong_answer_is_refused_with_its_mistake(name: str) -> None:
    assert len(WRONG[name]) >= 2
    for answer, expected in WRONG[name]:
        assert expected in words(name, answer)


@pytest.mark.parametrize(
    ("answer", "expected"),
    [
        (lambda l, k2: None, "returns nothing yet"),
        (lambda l, k2: "long", "neither numbers nor a tuple"),
        (lambda l: l, "stops with TypeError"),
        (lambda l, k2: np.nan * l, "nan"),
        (lambda l, k2: np.ones(2), "a number, not an array of shape (2,)"),
        (lambda l, k2: (l, l), "a number, not an array of shape (2,)"),
        (4.43, "not callable"),
    ],
)
def test_an_answer_that_is_no_answer_is_refused_as_such(answer: Any, expected: str) -> None:
    exercise = replace(linearisation.growth_rate, mistakes={})  # one of its mistakes returns nan
    with pytest.raises(NotYet, match=re.escape(expected)):
        exercise.grade(answer)


def test_an_answer_that_nothing_explains_gets_the_hint() -> None:
    wheel = ga.roulette_probabilities.truth
    sentence = words("roulette_probabilities", lambda f: (w := wheel(f) ** 0.7) / w.sum())
    assert ga.roulette_probabilities.hint in sentence


def test_an_answer_that_stops_is_refused_with_the_line_in_its_cell() -> None:
    names: dict[str, Any] = {}
    exec("def rate(length, gyration_ratio):\n    half = length / 2\n    return half.size", names)
    sentence = "your function stops in line 3 of its cell with AttributeError: 'float' object has no attribute 'size'"
    sentence += " (at length = 1.347, gyration_ratio = 0.06856)"
    assert words("growth_rate", names["rate"]) == sentence


def test_an_answer_that_changes_its_arguments_is_judged_by_what_it_returns() -> None:
    def in_place(a, b, x, sent):
        for u in sent:
            x[:] = a @ x + b @ u
        sent[:] = 0
        return x

    mpc.state_when_it_acts.grade(in_place)
