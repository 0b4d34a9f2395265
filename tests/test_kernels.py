"""Compiled loops: compiled once and for fixed types, on disk where that is possible."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import casadi as ca
import numba
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from fiplib import kernels
from fiplib.dynamics import PLANT, coupled_plant, euler_angles, rk4
from fiplib.kernels import compiling, control, filtering, flight, observing, piloting, poses, vehicle
from fiplib.params import Params


def test_every_kernel_that_python_calls_is_compiled_at_import_and_for_one_signature_only():
    called = (control.riccati, control.solve, filtering.fitness, vehicle.advance, observing.observe, piloting.answer)
    for kernel in (*called, piloting.circle, poses.expose, poses.true_state, vehicle.fallen, flight.fly):
        assert len(kernel.signatures) == 1
        # else an argument of another type would be compiled for within a control tick; here it is refused
        assert not kernel._can_compile
        assert kernel.targetoptions["error_model"] == "numpy" and "fastmath" not in kernel.targetoptions


def test_set_up_compiles_every_module_that_holds_kernels():
    files = {path.stem for path in compiling.HERE.glob("*.py")}
    # helpers of others, compiled with them; and what happens once a frame, which is not compiled
    assert set(kernels.MODULES) == files - {"__init__", "compiling", "model", "disturbance"}


def test_an_edit_of_any_kernel_file_makes_all_compilations_stale(tmp_path):
    """Numba looks at the file of the function itself, not at the files of those that it calls."""
    room = tmp_path / "fiplib" / "kernels"
    room.mkdir(parents=True)
    for name in ("__init__", "params"):
        shutil.copy(compiling.HERE.parent / f"{name}.py", room.parent)
    shutil.copy(compiling.HERE / "compiling.py", room)
    (room / "__init__.py").touch()
    (room / "above.py").write_text(ABOVE)
    (room / "below.py").write_text(BELOW)
    assert answer(tmp_path) == "3.0 False"
    assert answer(tmp_path) == "3.0 True"  # from disk
    (room / "below.py").write_text(BELOW.replace("+ 1.0", "+ 2.0"))
    assert answer(tmp_path) == "4.0 False"
    assert len(list(room.glob("__pycache__/fiplib-*"))) == 1  # what is stale is removed
    # a constant from outside the room is compiled in, too
    params = room.parent / "params.py"
    params.write_text(params.read_text().replace("GRAVITY = 9.81", "GRAVITY = 1.62"))
    assert answer(tmp_path) == "4.0 False"


BELOW = """
from fiplib.kernels.compiling import compiled
@compiled()
def more(x):
    return x + 1.0
"""
ABOVE = """
from fiplib.kernels.below import more
from fiplib.kernels.compiling import compiled
@compiled("f8(f8)")
def kernel(x):
    return more(x)
"""


def answer(directory: Path) -> str:
    """What the kernel above makes of 2, and whether its compilation came from disk; in a process of its own."""
    code = "from fiplib.kernels.above import kernel as k; print(k(2.0), bool(k.stats.cache_hits))"
    environment = {**os.environ, "PYTHONPATH": str(directory)}
    environment.pop("NUMBA_CACHE_DIR", None)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, cwd=directory)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_where_no_compilation_can_be_kept_one_line_says_so(tmp_path, monkeypatch, capsys):
    (tmp_path / "file").touch()  # in whose place no directory can be made
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "file"))
    monkeypatch.setattr(compiling, "DIRECTORY", compiling.directory())
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "NUMBA_CACHE_DIR" in said

    @compiling.compiled("f8(f8)")
    def twice(x):
        return 2 * x

    assert twice(2.0) == 4.0
    assert capsys.readouterr().err == ""


def test_sums_are_neither_reordered_nor_fused():
    # each of these would give another number: ((1e16 + 1) - 1e16) in real arithmetic is 1; a fused a * a - b is not 0
    @numba.njit("f8(f8[::1])", **compiling.OPTIONS)
    def total(values):
        result = 0.0
        for value in values:
            result += value
        return result

    @numba.njit("f8(f8, f8)", **compiling.OPTIONS)
    def square_minus(a, b):
        return a * a - b

    assert total(np.array([1e16] + [1.0] * 64 + [-1e16])) == 0.0
    assert square_minus(1.0 + 2.0**-30, (1.0 + 2.0**-30) ** 2) == 0.0


def plant_step(params: Params) -> ca.Function:
    """One step of the simulated plant: RK4, then the projection onto unit quaternion and direction."""
    x = ca.SX.sym("x", 20)
    attitude, direction, rate = (x[PLANT[name]] for name in ("attitude", "direction", "direction_rate"))
    q = direction / ca.norm_2(direction)
    unit = ca.vertcat(x[:6], attitude / ca.norm_2(attitude), q, rate - q * ca.dot(q, rate), x[16:])
    step = rk4(coupled_plant(params), 1.0 / params.simulation.plant_rate)
    arguments = step.sx_in()
    return ca.Function("step", arguments, [ca.substitute(unit, x, step(*arguments))])


RODS = [
    Params().replace(pendulum__length=0.8, pendulum__gyration_ratio=1 / 12, vehicle__seat_height=height)
    for height in (0.0, 0.08)
]
STEPS = {rod: plant_step(rod) for rod in RODS}


@given(st.sampled_from(RODS), st.integers(0, 2**32), st.floats(0.1, 10.0))
def test_the_compiled_plant_is_the_coupled_plant(rod, seed, size):
    rng = np.random.default_rng(seed)
    x, commands, force = rng.normal(size=20), size * rng.normal(size=(3, 4)), 0.1 * size * rng.normal(size=3)
    for name in ("attitude", "direction"):
        x[PLANT[name]] /= np.linalg.norm(x[PLANT[name]])
    expected = x
    for command in commands:
        expected = STEPS[rod](expected, command, force).full().ravel()
    vehicle.advance(x, commands, force, vehicle.plant_constants(rod))
    # nearly the same operations in the same order; what the seat adds is 50 times larger than it: rounding of that
    np.testing.assert_allclose(x, expected, rtol=1e-13, atol=1e-13 if rod is RODS[0] else 1e-12)


@given(st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1))
def test_compiled_angles_are_those_of_the_quaternion(q):
    x, truth = np.zeros(20), np.empty(11)
    x[6:10] = np.array(q) / np.linalg.norm(q)
    poses.true_state(x, 0.5, truth)
    np.testing.assert_allclose(truth[8:10], euler_angles(x[6:10])[:2], atol=1e-15)  # rounding of one operation
