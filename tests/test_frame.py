"""The frame around the library: lock, environments, Makefile, README and repository agree with each other."""

import os
import platform
import re
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from ruamel.yaml import YAML

from fiplib import products

ROOT = Path(__file__).parents[1]
MAKEFILE = (ROOT / "Makefile").read_text()
LOCK = (ROOT / "requirements.lock").read_text()
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]

# Bracketed, so that this file does not hold what it looks for.
INDEX_HOST = re.compile(r"py[p]i\.org|python[h]osted\.org|ana[c]onda\.(com|org)|registry\.[n]pmjs|deb[i]an\.org/debian")
HOME_FOLDER = re.compile(r"/(?:home|Users)/\w|C:\\[U]sers")


def make(*arguments: str) -> str:
    """What make prints in this repository, free of the flags of a make that may be running the tests."""
    environment = {k: v for k, v in os.environ.items() if k not in ("MAKEFLAGS", "MFLAGS", "MAKELEVEL", "GNUMAKEFLAGS")}
    return subprocess.run(
        ["make", "--no-print-directory", *arguments],
        cwd=ROOT,
        env=environment,
        check=True,
        capture_output=True,
        text=True,
    ).stdout


def locked_entries() -> list[str]:
    """The lock's entries, each a requirement with its hashes, joined to one line; comments dropped."""
    lines = "\n".join(line for line in LOCK.splitlines() if not line.lstrip().startswith("#"))
    return lines.replace("\\\n", " ").strip().splitlines()


def words(label: str) -> list[str]:
    """The words that follow ``label`` (``VARIABLE :=`` or ``target:``) on its first line of the Makefile."""
    return next(line for line in MAKEFILE.splitlines() if line.startswith(label)).removeprefix(label).split()


def repository_files() -> list[Path]:
    """Files that are tracked, or would be by the next `git add`; skips where there is no git checkout."""
    listing = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    if listing.returncode:
        pytest.skip(f"not a git checkout: {listing.stderr.strip()}")
    return [path for path in (ROOT / name for name in listing.stdout.split("\0") if name) if path.is_file()]


def test_the_lock_pins_every_package_by_name_version_and_hash_alone():
    pinned = re.compile(r"[a-z0-9-]+==[^\s;]+( ; [^\\]+?)?(\s+--hash=sha256:[0-9a-f]{64})+")
    entries = locked_entries()
    assert len(entries) > 100  # jupyter alone brings about a hundred: fewer means that the parsing went wrong
    assert [entry for entry in entries if not pinned.fullmatch(entry)] == []


def test_the_lock_holds_no_address():
    assert "://" not in LOCK
    assert not INDEX_HOST.search(LOCK)


def test_the_lock_satisfies_what_the_library_the_tests_and_the_sweeps_need():
    locked = {}
    for entry in locked_entries():
        requirement = Requirement(entry.split("--hash")[0])
        assert requirement.name not in locked, f"{requirement.name} has one version on every Python, as the bags need"
        locked[canonicalize_name(requirement.name)] = requirement.specifier
    extras = PROJECT["optional-dependencies"]
    for requirement in map(Requirement, [*PROJECT["dependencies"], *extras["dev"], *extras["sweep"]]):
        version = str(locked[canonicalize_name(requirement.name)]).removeprefix("==")
        assert version in requirement.specifier, f"{requirement} is not served by the locked {version}"


def test_the_conda_environment_takes_a_python_that_we_support_and_the_same_packages():
    environment = YAML(typ="safe").load(ROOT / "environment.yml")
    python, pip, packages = environment["dependencies"]
    assert environment["name"] == PROJECT["name"]
    version = re.fullmatch(r"python=(3\.\d+)", python)[1]  # a single one: Binder reads no range
    assert version in Requirement(f"python{PROJECT['requires-python']}").specifier
    assert pip == "pip"
    assert packages == {"pip": ["--requirement requirements.lock"]}


def test_binder_installs_the_library_as_make_does():
    command = "pip install --no-deps --no-build-isolation --editable ."
    assert command in (ROOT / "postBuild").read_text()
    assert command in MAKEFILE.replace("--disable-pip-version-check --quiet ", "")
    compiling = "-c 'from fiplib import kernels; kernels.load()'"
    assert compiling in (ROOT / "postBuild").read_text() and compiling in MAKEFILE
    assert not (ROOT / "binder").exists()  # with such a folder Binder would not look at environment.yml here


def test_the_citation_names_this_package_its_version_and_the_paper():
    import fiplib

    citation = YAML(typ="safe").load(ROOT / "CITATION.cff")
    assert citation["cff-version"] == "1.2.0"
    assert citation["version"] == fiplib.__version__
    assert citation["license"] == PROJECT["license"]
    [paper] = citation["references"]
    assert [author["family-names"] for author in paper["authors"]] == ["Paul", "Torok", "Deghat"]


def test_make_help_is_the_default_and_lists_every_public_target():
    targets = words(".PHONY:")
    *lines, others = [line for line in make("help").splitlines() if line.startswith("  ")]
    assert len(lines) == 10  # what a newcomer needs
    listed = [*(line.split()[0] for line in lines), *others.partition(":")[2].split()]
    assert sorted(listed) == sorted(targets)
    assert make() == make("help")


def test_make_and_the_tests_run_openblas_with_one_thread():
    exported = dict(re.findall(r"^export (\w+) := (.*)$", MAKEFILE, re.MULTILINE))
    assert exported == {"OPENBLAS_NUM_THREADS": "1"}
    assert exported.items() <= os.environ.items()


@pytest.mark.skipif(
    sys.platform != "linux" or platform.machine() != "x86_64", reason="the kernels are pinned by their x86-64 names"
)
def test_numpy_knows_every_kernel_that_is_switched_off_for_sweeps():
    pinned = dict(re.findall(r"^sweep: export (\w+) := (.*)$", MAKEFILE, re.MULTILINE))
    assert pinned.keys() == {"OPENBLAS_CORETYPE", "NPY_DISABLE_CPU_FEATURES"}
    # A name that this NumPy does not dispatch on is only an ImportWarning: the pin would silently do nothing.
    code = "from numpy._core._multiarray_umath import __cpu_features__ as f; print(*(k for k, on in f.items() if on))"
    run = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, env=os.environ | pinned
    )
    assert run.returncode == 0, run.stderr
    assert not set(run.stdout.split()) & set(pinned["NPY_DISABLE_CPU_FEATURES"].split())


@pytest.mark.parametrize(
    "program", ["fiplib.flight.command", "fiplib.studies.betaflight", "fiplib.studies.faults.campaign"]
)
def test_numpy_has_one_thread_without_make_too(program):
    """Beside busy cores, threads that wait for each other make a small QR decomposition many times slower."""
    start = f"import {program}"
    tasks = "import os; print(len(os.listdir('/proc/self/task')) if os.path.isdir('/proc/self/task') else 1)"
    work = "import numpy as np; np.linalg.qr(np.ones((2000, 40)))"
    bare = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    run = subprocess.run(
        [sys.executable, "-c", f"{start}; {work}; {tasks}"], capture_output=True, text=True, env=bare, cwd=ROOT
    )
    assert run.stdout == "1\n", run.stderr


def test_no_file_names_this_machine_or_a_package_index():
    here = {str(path) for path in (ROOT, ROOT.parent, Path.home())} - {"/", tempfile.gettempdir()}
    offences = []
    for path in repository_files():
        text = path.read_bytes().decode(errors="replace")
        found = [folder for folder in here if f"{folder}/" in text]
        found += [match[0] for match in (INDEX_HOST.search(text), HOME_FOLDER.search(text)) if match]
        offences += [f"{path.relative_to(ROOT)}: {what}" for what in found]
    assert offences == []


def test_the_readme_shows_both_commands_and_names_only_what_exists():
    readme = (ROOT / "README.md").read_text()
    assert re.search(r"^make figures\b", readme, re.MULTILINE)
    assert re.search(r"^make test\b", readme, re.MULTILINE)
    commands = set(re.findall(r"(?:^|`)make ([a-z][\w.-]*)", readme, re.MULTILINE))
    assert commands <= {*words(".PHONY:"), *(f"fly-{name}" for name in products.ledger().bags)}
    # Links and paths in code style lead to files of the repository; what make writes is named by its target instead.
    paths = re.findall(r"\]\(([^)#:]+)\)", readme) + re.findall(r"`((?:fiplib|scripts|data|tests)/[\w./-]*)", readme)
    assert [path for path in paths if not (ROOT / path).exists()] == []


def test_the_map_names_every_product_and_only_files_that_exist():
    text = (ROOT / "docs/map.md").read_text()
    paths = re.findall(r"`((?:fiplib|scripts|data|tests|benchmarks)/[\w./-]*)", text)
    assert [path for path in paths if not (ROOT / path).exists()] == []
    assert set(re.findall(r"`((?:fig|table)\d+-[\w-]+)`", text)) == set(products.PRODUCTS)


def test_the_table_of_the_readme_is_that_of_the_ledger():
    from fiplib.reproduction import ledger

    readme = (ROOT / "README.md").read_text()
    table = re.search(r"<!-- headline: .*-->\n(.*?)<!-- end of headline -->", readme, re.DOTALL)
    assert table and table[1].strip() == ledger.headline(ROOT / "data").strip()
