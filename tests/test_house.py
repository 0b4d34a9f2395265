"""The house: which module may import which, how large the core is, and that a small installation suffices."""

import ast
import functools
import os
import subprocess
import sys
import zipfile
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LIBRARY = ROOT / "fiplib"

# A module imports only from lower levels, and from its own room.
LEVELS = [
    {"params"},
    {"recording", "dynamics", "kernels"},
    {"mpc", "kalman"},
    {"ga"},
    {"observers", "references"},
    {"estimators", "controllers"},
    {"pilot"},
    {"simulate", "replay"},
    {"reproduction", "flight"},
    {"studies", "teaching"},
    {"products"},
    {"commands"},
    {"__main__"},
]
# What a level does not say: a bag is a recording and nothing else, and nobody depends on what flies a real vehicle.
ONLY = {"recording": {"params"}, "bags": {"params", "recording"}, "dynamics": {"params"}, "kernels": {"params"}}
MAY_IMPORT_FLIGHT = {"flight", "studies", "__main__"}


def level(room: str) -> int:
    """The level of a room or core module; a bag is read above the recording that it holds."""
    return 2 if room == "bags" else next(number for number, rooms in enumerate(LEVELS) if room in rooms)


def room(module: str) -> str:
    """``fiplib.bags.reader`` -> ``bags``, ``fiplib.params`` -> ``params``."""
    return module.split(".")[1]


def modules() -> dict[str, Path]:
    """Every module of the library by its dotted name; the package's own face aside, which imports nothing at once."""
    found = {}
    for path in LIBRARY.rglob("*.py"):
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        if name != "fiplib":
            found[name] = path
    return found


@functools.cache
def imports() -> dict[str, set[str]]:
    """What each module imports from the library, also within functions."""
    known = modules()
    found: dict[str, set[str]] = {}
    for name, path in known.items():
        found[name] = set()
        for node in ast.walk(ast.parse(path.read_text())):
            wanted = []
            if isinstance(node, ast.ImportFrom):
                assert node.level == 0, f"{path}: imports are absolute here"
                wanted = [f"{node.module}.{alias.name}" for alias in node.names]
            elif isinstance(node, ast.Import):
                wanted = [alias.name for alias in node.names]
            for target in wanted:
                while target and target not in known:
                    target = target.rpartition(".")[0]
                if target:
                    found[name].add(target)
    return found


def test_arrows_only_point_down():
    wrong = [
        f"{module} imports {target}"
        for module, targets in imports().items()
        for target in targets
        if room(target) != room(module)
        and (
            level(room(target)) >= level(room(module))
            or room(target) not in ONLY.get(room(module), {room(target)})
            or (room(target) == "flight" and room(module) not in MAY_IMPORT_FLIGHT)
        )
    ]
    assert wrong == []


def test_the_core_imports_only_the_rooms_that_fly():
    # kernels are the core's own loops, in a room because a file for each concept reads better than one of 900 lines
    core = {name for name in modules() if (LIBRARY / f"{name.split('.')[1]}.py").exists()}
    wrong = [
        f"{module} imports {target}"
        for module in core - {"fiplib.products", "fiplib.__main__"}
        for target in imports()[module] - core
        if room(target) not in ("kernels", "observers", "references", "estimators", "controllers")
    ]
    assert wrong == []


def test_no_modules_import_each_other_in_a_circle():
    # a package's face imports its modules, and they may name it to reach each other: it is no module of its own here
    graph = {
        module: {target for target in targets if target != module and not module.startswith(f"{target}.")}
        for module, targets in imports().items()
    }
    list(TopologicalSorter(graph).static_order())  # raises CycleError, which names the circle


def test_the_core_is_thin_and_no_module_outgrows_its_concept():
    lines = {name: len(path.read_text().splitlines()) for name, path in modules().items()}
    core = sum(count for name, count in lines.items() if modules()[name].parent == LIBRARY)
    assert core <= 3000  # the paper: what a reader takes in within a day
    # no file of ours needs more for one concept; the longest are the parameters and the two halves of a bag's life
    assert {name: count for name, count in lines.items() if count > 520} == {}
    assert len((ROOT / "scripts/fly.py").read_text().splitlines()) < 100


def test_no_module_reaches_into_another_or_patches_the_import_path():
    private = []
    for name, path in modules().items():
        tree = ast.parse(path.read_text())
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("fiplib"):
                private += [f"{name}: {node.module}.{alias.name}" for alias in node.names if alias.name[0] == "_"]
    private = [line for line in private if not line.endswith(".__version__")]
    assert private == []
    files = [path for folder in ("fiplib", "scripts", "benchmarks") for path in (ROOT / folder).rglob("*.py")]
    assert [str(path) for path in files if "sys.path." in path.read_text()] == []


def run(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *arguments], capture_output=True, text=True, cwd=ROOT, env={**os.environ, **environment}
    )


def test_importing_the_package_loads_no_numerical_library():
    heavy = "{'numpy', 'scipy', 'casadi', 'matplotlib', 'numba', 'rosbags'}"
    done = run("-c", f"import sys, fiplib; print(sorted({heavy} & set(sys.modules)), *fiplib.__all__)")
    assert done.stdout.split(maxsplit=1)[0] == "[]"
    assert set(done.stdout.split()[1:]) == {"MPC", "Params", "Pilot", "SCENARIOS", "estimate", "fly", "read", "refit"}


def test_importing_core_and_estimators_compiles_nothing_and_loads_no_part_of_scipy():
    # each of these takes longer than all of ours together: they are imported where they are used. The pose estimator
    # is compiled; the core imports the two of its modules that are not, the others when it is asked for a length
    heavy = "{'numba', 'scipy.signal', 'scipy.optimize', 'scipy.linalg', 'matplotlib'}"
    ours = [name for name, path in modules().items() if path.parent == LIBRARY or room(name) == "estimators"]
    light = ("knowledge", "report")
    ours = [name for name in ours if ".poses." not in name or name.endswith(light)]
    done = run("-c", f"import sys, {', '.join(ours)}; print(sorted({heavy} & set(sys.modules)))")
    assert done.stdout == "[]\n", done.stderr


def test_every_name_of_the_public_face_is_there():
    import fiplib

    for name in fiplib.__all__:
        assert getattr(fiplib, name) is not None
    with pytest.raises(AttributeError, match="nonsense"):
        fiplib.nonsense  # noqa: B018


def test_the_eight_lines_of_the_readme_fly_and_find_the_length(tmp_path):
    readme = (ROOT / "README.md").read_text()
    example = readme.split("```python\n", 1)[1].split("```", 1)[0]
    assert len(example.strip().splitlines()) <= 8
    done = run("-c", example)
    assert done.returncode == 0, done.stderr
    length, deviation = map(float, done.stdout.split()[:2])
    assert abs(length - 1.0) < 4 * deviation < 0.1  # the rod of the example is 1 m long


# Packages of the extras: a wheel alone must not need them.
EXTRAS = (
    "IPython gymnasium ipykernel ipympl ipywidgets jupyter sympy serial dask distributed sphinx pytest hypothesis mcap"
)


def test_a_wheel_gives_the_command_and_reads_a_bag_without_the_extras(tmp_path):
    built = run("-m", "hatchling", "build", "--target", "wheel", "--directory", str(tmp_path))
    assert built.returncode == 0, built.stderr
    [wheel] = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path / "installed")
        entry_points = next(name for name in archive.namelist() if name.endswith("entry_points.txt"))
        assert "fip = fiplib.__main__:main" in archive.read(entry_points).decode()
        assert any(name.endswith("lockstep.c") for name in archive.namelist())
    code = (
        f"import sys; sys.modules.update(dict.fromkeys({EXTRAS.split()!r})); sys.path.insert(0, sys.argv.pop(1))\n"
        "import fiplib.__main__ as command; assert 'installed' in command.__file__\n"
        "sys.exit(command.main(sys.argv[1:]))"
    )
    done = run("-c", code, str(tmp_path / "installed"), "bag", "info", "data/circle-0.8")
    assert done.returncode == 0, done.stderr
    assert "SIMULATED" in done.stdout
    missing = run("-c", code, str(tmp_path / "installed"), "sweep", "--list")
    assert missing.returncode in (0, 2) and "Traceback" not in missing.stderr
