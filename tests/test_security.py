"""What nothing in this package does: run code that data bring, listen to the network, hold a known hole."""

import ast
import json
import multiprocessing
import re
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
from jupyter_server.serverapp import ServerApp
from packaging.version import Version

from fiplib.studies import cluster

ROOT = Path(__file__).parents[1]

MODULES = {"pickle", "cPickle", "dill", "cloudpickle", "joblib", "shelve", "marshal", "telnetlib", "ftplib"}
"""Modules that run code out of data, or speak without encryption. What ``multiprocessing`` and Dask send between our
own processes is pickled by these libraries; both are closed to others (below)."""
CALLS = {"eval", "exec", "compile", "__import__", "system", "popen", "mktemp", "extractall", "unsafe_load", "full_load"}
"""Names of functions that must not be called, as names or as attributes, but for those of ``HARMLESS``."""
HARMLESS = {"re.compile", "platform.system"}


def sources() -> Iterator[tuple[str, ast.Module]]:
    """Every module, and the code of every notebook."""
    for folder in ("fiplib", "scripts", "benchmarks", "docs"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            yield str(path.relative_to(ROOT)), ast.parse(path.read_text(encoding="utf-8"))
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        for number, cell in enumerate(json.loads(path.read_text(encoding="utf-8"))["cells"]):
            if cell["cell_type"] == "code":
                code = re.sub(r"^\s*[%!].*$", "", "".join(cell["source"]), flags=re.MULTILINE)
                yield f"{path.name} cell {number}", ast.parse(code)


def dangers(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else [node.module or ""]
            yield from (name for name in names if name.partition(".")[0] in MODULES)
        elif isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            if called.rpartition(".")[2] in CALLS and called not in HARMLESS:
                yield f"{called}()"
            for keyword in node.keywords:
                word = ast.unparse(keyword.value)
                if (keyword.arg, word) in (("shell", "True"), ("allow_pickle", "True"), ("verify", "False")):
                    yield f"{called}({keyword.arg}={word})"
            if called.endswith("YAML") and ast.unparse(node) not in ("YAML(typ='safe')", "YAML(typ='rt')"):
                yield ast.unparse(node)
            if called in ("yaml.load", "yaml.load_all"):
                yield f"{called}()"


def test_nothing_runs_code_out_of_data():
    found = [f"{name}: {danger}" for name, tree in sources() for danger in dangers(tree)]
    assert found == []


@pytest.mark.parametrize(
    "code",
    [
        "import pickle",
        "from dill import loads",
        "eval(x)",
        "subprocess.run(x, shell=True)",
        "os.system(x)",
        "YAML(typ='unsafe').load(x)",
        "YAML().load(x)",
        "yaml.load(x)",
        "np.load(x, allow_pickle=True)",
        "archive.extractall(x)",
    ],
)
def test_the_search_finds_what_it_looks_for(code):
    assert list(dangers(ast.parse(code)))


def listening(process: psutil.Process) -> list[str]:
    """The addresses at which a process and its children listen."""
    family = [process, *process.children(recursive=True)]
    return [
        link.laddr.ip
        for one in family
        for link in one.net_connections("inet")
        if link.status == psutil.CONN_LISTEN or link.type.name == "SOCK_DGRAM"
    ]


def test_a_local_cluster_listens_on_this_machine_alone():
    with cluster.connect(None, workers=2) as client:
        assert client.submit(int, "7").result() == 7
        found = listening(psutil.Process())
    assert len(found) >= 3  # the scheduler and two workers
    assert set(found) == {"127.0.0.1"}


def test_jupyter_listens_on_this_machine_alone_and_asks_for_a_token():
    server = ServerApp()
    assert server.ip in ("localhost", "127.0.0.1") and not server.allow_remote_access
    assert server.identity_provider_class.__name__ == "PasswordIdentityProvider"
    for path in ("Makefile", "postBuild", "README.md"):
        text = (ROOT / path).read_text(encoding="utf-8")
        assert not re.search(r"--(ServerApp\.)?(ip|token|password|allow_remote)|0\.0\.0\.0", text), path


def test_processes_of_ours_speak_through_pipes_that_others_cannot_open():
    assert len(multiprocessing.current_process().authkey) >= 32
    for name, tree in sources():
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "bind":
                assert "127.0.0.1" in ast.unparse(node) or "LOOPBACK" in ast.unparse(node), (
                    f"{name}: {ast.unparse(node)}"
                )


# Versions from which a published hole is closed, of what our locks may hold. The list was written by hand and not
# compared with an advisory database: make audit asks one.
CLOSED = {
    "bleach": "3.3.0",  # CVE-2021-23980
    "certifi": "2024.7.4",  # CVE-2024-39689
    "distributed": "2021.10.0",  # CVE-2021-42343: listened beyond this machine
    "fonttools": "4.60.2",  # CVE-2025-66034
    "h11": "0.16.0",  # CVE-2025-43859
    "idna": "3.7",  # CVE-2024-3651
    "jinja2": "3.1.6",  # CVE-2025-27516
    "jupyter-core": "5.8.1",  # CVE-2025-30167
    "jupyter-server": "2.14.1",  # CVE-2024-35178
    "jupyterlab": "4.4.8",  # CVE-2025-59842
    "lz4": "3.1.1",  # CVE-2021-3520 in the library within
    "mistune": "2.0.3",  # CVE-2022-34749
    "nbconvert": "6.5.1",  # CVE-2021-32862
    "notebook": "7.2.2",  # CVE-2024-43805
    "numpy": "1.22.2",  # CVE-2021-41495
    "pillow": "11.3.0",  # CVE-2025-48379
    "playwright": "1.55.1",  # CVE-2025-59288
    "pygments": "2.15.0",  # CVE-2022-40896
    "pyyaml": "5.4",  # CVE-2020-14343
    "requests": "2.32.4",  # CVE-2024-47081
    "tornado": "6.5",  # CVE-2025-47287
    "tqdm": "4.66.3",  # CVE-2024-34062
    "urllib3": "2.6.0",  # CVE-2025-66418, CVE-2025-66471
    "zipp": "3.19.1",  # CVE-2024-5569
}


@pytest.mark.parametrize("lock", ["requirements.lock", "benchmarks/requirements.lock"])
def test_no_locked_version_has_a_hole_that_we_know_of(lock):
    locked = dict(re.findall(r"^([a-z0-9-]+)==(\S+)", (ROOT / lock).read_text(), re.MULTILINE))
    assert {
        name: locked[name] for name, safe in CLOSED.items() if name in locked and Version(locked[name]) < Version(safe)
    } == {}
    if lock == "requirements.lock":
        assert len(CLOSED.keys() & locked.keys()) > 20
