"""The same flight, byte for byte, however it is started and whichever kernels a CPU makes NumPy and OpenBLAS choose.

Neither ``make`` nor a variable of the environment is needed for it. The maximum-likelihood estimator is the exception:
it solves least squares by LAPACK, and its lengths agree within a millionth only.
"""

import hashlib
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import nbformat
import numpy as np
import pytest
from nbclient import NotebookClient

from fiplib import bags
from fiplib.simulate import SCENARIOS, fly

ROOT = Path(__file__).parents[1]

VARIABLES = ("OPENBLAS_CORETYPE", "OPENBLAS_NUM_THREADS", "NPY_DISABLE_CPU_FEATURES", "OMP_NUM_THREADS")
BARE = {name: value for name, value in os.environ.items() if name not in VARIABLES} | {"PYTHONPATH": str(ROOT)}
OLD = {"OPENBLAS_CORETYPE": "Prescott", "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL AVX512_SPR"}
"""A CPU without AVX: OpenBLAS's kernels for SSE3, NumPy's baseline."""
FLIGHT = {"scenario": "estimate-1.2", "seconds": 6.5}
"""Long enough for the first runs of the genetic algorithm, whose lengths are flown."""
CODE = """
import dataclasses
from fiplib import bags
from fiplib.simulate import SCENARIOS, fly

scenario = dataclasses.replace(SCENARIOS[{scenario!r}], duration={seconds})
with bags.BagRecorder({bag!r}, scenario.metadata()) as recorder:
    fly(scenario, recorder)
"""
BUSY = "import numpy as np\nnp.linalg.inv(np.random.default_rng(0).random((300, 300)))\n"


def digest(bag: Path) -> str:
    """The bytes of the messages; the name of the bag stands in the metadata alone."""
    [file] = bag.glob("*.mcap")
    return hashlib.sha256(file.read_bytes()).hexdigest()


def scripted(folder: Path, before: str = "", **environment: str) -> str:
    code = before + CODE.format(bag=str(folder / "flight"), **FLIGHT)
    subprocess.run([sys.executable, "-c", code], env=BARE | environment, cwd=folder, check=True)
    return digest(folder / "flight")


@pytest.fixture(scope="module")
def plain(tmp_path_factory) -> str:
    """A flight from a script in a bare environment."""
    return scripted(tmp_path_factory.mktemp("plain"))


@pytest.mark.parametrize(
    "environment",
    [OLD, {"OPENBLAS_CORETYPE": "Haswell", "OPENBLAS_NUM_THREADS": "1"}, {"OPENBLAS_NUM_THREADS": "4"}],
    ids=["without AVX", "as make sweep", "four threads"],
)
def test_a_flight_does_not_depend_on_the_kernels_that_a_cpu_chooses(environment, plain, tmp_path):
    assert scripted(tmp_path, **environment) == plain


def test_a_script_that_has_used_numpy_before_flies_the_same(plain, tmp_path):
    assert scripted(tmp_path, before=BUSY) == plain


def test_the_command_flies_the_same_as_a_script(plain, tmp_path):
    command = [sys.executable, "-m", "fiplib", "fly", "--scenario", FLIGHT["scenario"]]
    command += ["--duration", str(FLIGHT["seconds"]), "--output", str(tmp_path / "flight")]
    subprocess.run(command, env=BARE, cwd=tmp_path, check=True, capture_output=True)
    assert digest(tmp_path / "flight") == plain


def test_the_process_of_the_tests_flies_the_same(plain, tmp_path):
    scenario = replace(SCENARIOS[FLIGHT["scenario"]], duration=FLIGHT["seconds"])
    with bags.BagRecorder(tmp_path / "flight", scenario.metadata()) as recorder:
        fly(scenario, recorder)
    assert digest(tmp_path / "flight") == plain


def test_the_kernel_of_a_notebook_flies_the_same(plain, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    code = BUSY + "import matplotlib.pyplot\n" + CODE.format(bag=str(tmp_path / "flight"), **FLIGHT)
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(code)])
    NotebookClient(
        notebook, timeout=600, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}}
    ).execute()
    assert digest(tmp_path / "flight") == plain


def test_lengths_by_the_pose_estimator_agree_on_all_cpus_within_a_millionth():
    code = (
        "import json; from fiplib import bags, replay; from fiplib.estimators import ESTIMATORS\n"
        "flight = bags.read('data/estimate-1.4')\n"
        "function = ESTIMATORS['poses'].function\n"
        "windows = replay.raw_windows(flight, 2.5, 2.5, 4.0, 12.0)\n"
        "print(json.dumps([function(window, flight.params).length for _, window in windows]))"
    )
    found = [
        json.loads(subprocess.check_output([sys.executable, "-c", code], env=BARE | environment, cwd=ROOT, text=True))
        for environment in ({}, OLD)
    ]
    assert len(found[0]) >= 2
    np.testing.assert_allclose(found[0], found[1], rtol=1e-6)  # measured: 1e-9
