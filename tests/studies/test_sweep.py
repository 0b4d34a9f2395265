"""Sweeps: no flight is lost to a dead worker, an interrupt or a torn line, and the table is the same bytes always."""

import argparse
import ast
import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from dask import config as dask_config

from fiplib.params import FipError
from fiplib.reproduction.sources import JournalError
from fiplib.studies import STUDIES, sweep
from fiplib.studies.cluster import ClusterError
from fiplib.studies.journal import Journal, text
from tests.studies import sweep_study

ROOT = Path(__file__).parents[2]
NAME = "short"
PATIENCE = 60.0  # s; what takes a second when the machine is free must not fail when it is not


def within(condition: Callable[[], object], patience: float = PATIENCE) -> bool:
    """Whether the condition comes true in time."""
    end = time.monotonic() + patience
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.02)
    return True


def lines(path: Path) -> list[str]:
    """The lines of a file that may not exist yet, without a torn last one."""
    return path.read_text().split("\n")[:-1] if path.exists() else []


def dask(*arguments: str) -> subprocess.Popen:
    """A scheduler or worker process, as a user starts it; workers find the study beside this file."""
    return subprocess.Popen(
        [
            sys.executable,
            "-m",
            "dask",
            *arguments,
            "--no-dashboard",
            "--dashboard-address",
            "127.0.0.1:0",
            "--host",
            "127.0.0.1",
        ],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


class Cluster:
    """A real scheduler and its workers over TCP."""

    def __init__(self, folder: Path, workers: int) -> None:
        file = folder / "scheduler.json"
        self.scheduler = dask("scheduler", "--port", "0", "--scheduler-file", str(file))
        assert within(lambda: file.exists() and "address" in file.read_text()), "the scheduler did not start"
        self.address = ast.literal_eval(file.read_text().replace("null", "None"))["address"]
        self.workers = [
            dask("worker", self.address, "--nthreads", "1", "--no-nanny", "--local-directory", str(folder))
            for _ in range(workers)
        ]

    def close(self) -> None:
        for process in (*self.workers, self.scheduler):
            process.kill()
            process.wait()


KNOWN = {NAME: "tests.studies.sweep_study"}


def swept(*arguments: str | Path) -> int:
    """``fip sweep`` with these arguments, where the small study is the only one."""
    parser = argparse.ArgumentParser()
    sweep.add_arguments(parser, KNOWN)
    return sweep.run(parser.parse_args(list(map(str, arguments))), KNOWN)


@pytest.fixture
def study(monkeypatch: pytest.MonkeyPatch) -> str:
    """The small study, and no cluster from the environment."""
    monkeypatch.delenv("DASK_SCHEDULER_ADDRESS", raising=False)
    return NAME


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    """A scheduler with two workers, or with one from the test on that kills the other."""
    started = Cluster(tmp_path_factory.mktemp("cluster"), 2)
    yield started
    started.close()


@pytest.fixture(scope="module")
def serial() -> dict[tuple[str, ...], dict]:
    """What the study gives in this process, without Dask, by key."""
    return {tuple(text(case[key]) for key in sweep_study.KEYS): sweep_study.run(case) for case in sweep_study.cases()}


@pytest.fixture(scope="module")
def expected(serial: dict[tuple[str, ...], dict]) -> bytes:
    """The table that every sweep of the study must end with."""
    rows = [
        ",".join((*key, *map(text, serial[key].values()))) for key in sorted(serial, key=lambda k: [*map(float, k)])
    ]
    return ("\n".join([",".join((*sweep_study.KEYS, *next(iter(serial.values())))), *rows]) + "\n").encode()


def test_a_killed_worker_loses_no_flight(study, cluster, tmp_path, serial, expected):
    first, second = cluster.workers
    partial, seen = tmp_path / f"{NAME}.partial.csv", []

    def strike() -> None:
        within(lambda: len(lines(partial)) > 4)
        seen.append(len(lines(partial)) - 1)
        first.send_signal(signal.SIGKILL)

    threading.Thread(target=strike).start()
    assert swept(study, "--scheduler", cluster.address, "--data", tmp_path) == 0
    assert first.wait(PATIENCE) == -signal.SIGKILL
    assert second.poll() is None
    assert 4 <= seen[0] < len(serial), "the worker was to die while flights were still to be flown"
    assert (tmp_path / f"{NAME}.csv").read_bytes() == expected
    # the table rounds to nine digits, but for this column, which holds every bit
    rows = lines(tmp_path / f"{NAME}.csv")[1:]
    assert {tuple(row.split(",")[:2]): row.split(",")[-1] for row in rows} == {
        key: result["lean_bits"] for key, result in serial.items()
    }


def test_an_interrupted_sweep_leaves_no_process_and_goes_on_where_it_was(
    study, cluster, tmp_path, expected, capfd, monkeypatch
):
    code = "import sys\nfrom tests.studies.test_sweep import swept\n"
    code += "try:\n    swept(*sys.argv[1:])\nexcept KeyboardInterrupt:\n    sys.exit(130)\n"
    run = subprocess.Popen(
        [sys.executable, "-c", code, NAME, "--workers", "1", "--data", tmp_path],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    partial = tmp_path / f"{NAME}.partial.csv"
    try:
        assert within(lambda: len(lines(partial)) > 3)
        os.killpg(run.pid, signal.SIGINT)  # as Ctrl-C in a terminal: the workers get it too
        _, errors = run.communicate(timeout=PATIENCE)
    finally:
        run.kill()
    kept = lines(partial)
    assert run.returncode == 130
    assert "Traceback" not in errors
    assert f"{len(kept) - 1} of 15 cases are kept; the same command goes on from there" in errors
    assert within(lambda: not _group_lives(run.pid))

    # A kept row is marked: it would lose its mark if it were flown again.
    marked = kept[1].rsplit(",", 1)[0] + ",kept"
    partial.write_text("\n".join([kept[0], marked, *kept[2:]]) + "\n")
    monkeypatch.setenv("DASK_SCHEDULER_ADDRESS", cluster.address)
    assert swept(study, "--data", tmp_path) == 0
    assert (tmp_path / f"{NAME}.csv").read_bytes() == expected.replace(kept[1].encode(), marked.encode())
    assert not partial.exists()
    # Nothing is left to do: no cluster is asked for, and the file is left alone.
    before = (tmp_path / f"{NAME}.csv").stat().st_mtime_ns
    assert swept(study, "--data", tmp_path, "--scheduler", "tcp://127.0.0.1:1") == 0
    assert (tmp_path / f"{NAME}.csv").stat().st_mtime_ns == before
    assert "complete, 15 cases" in capfd.readouterr().err


def _group_lives(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


def test_a_trial_and_a_torn_line_cost_nothing_but_the_torn_row(study, cluster, tmp_path, expected, capfd):
    arguments = [study, "--scheduler", cluster.address, "--data", tmp_path]
    assert swept(*arguments, "--limit", "5") == 0
    partial = tmp_path / f"{NAME}.partial.csv"
    rows = lines(partial)[1:]
    assert len(rows) == 5
    assert {row.encode() for row in rows} <= set(expected.splitlines())
    assert "5 of 15 cases are kept" in capfd.readouterr().err
    content = partial.read_bytes()
    partial.write_bytes(content[:-7])
    assert swept(*arguments, "--limit", "1") == 0
    assert len(lines(partial)) == 6
    assert {row.encode() for row in lines(partial)} <= set(expected.splitlines())
    assert swept(*arguments) == 0
    assert (tmp_path / f"{NAME}.csv").read_bytes() == expected


def test_a_failing_case_is_named_and_stops_no_other(study, cluster, tmp_path, monkeypatch, capfd):
    good = sweep_study.cases()[:2]
    monkeypatch.setattr(sweep_study, "cases", lambda: [{"length": -1.0, "seed": 3}, *good])
    assert swept(study, "--scheduler", cluster.address, "--data", tmp_path) == 1
    errors = capfd.readouterr().err
    assert "case length=-1 seed=3 failed: ValueError('pendulum.length must be" in errors
    assert "params.py:" in errors
    assert "2 of 3 cases are kept" in errors
    assert len(lines(tmp_path / f"{NAME}.partial.csv")) == 3
    assert not (tmp_path / f"{NAME}.csv").exists()
    # Once the case can be flown, it alone is flown: the table is complete.
    monkeypatch.setattr(sweep_study, "cases", lambda: [{"length": 1.0, "seed": 0}, *good])
    assert swept(study, "--scheduler", cluster.address, "--data", tmp_path) == 0
    assert [row[:8] for row in lines(tmp_path / f"{NAME}.csv")[1:]] == ["0.75,0,1", "1,0,1,1,", "1.25,0,1"]


def test_a_case_that_kills_its_workers_takes_no_other_with_it(study, tmp_path, monkeypatch, capfd):
    good = sweep_study.cases()[:2]
    monkeypatch.setattr(sweep_study, "cases", lambda: [{"length": 1.0, "seed": -1}, *good])
    # Dask gives up on all that a dying worker held, after three deaths; after one, the neighbours are surely among it
    with dask_config.set({"distributed.scheduler.allowed-failures": 0}):
        assert swept(study, "--workers", "1", "--data", tmp_path) == 1
    errors = capfd.readouterr().err
    assert "case length=1 seed=-1 failed: every worker that ran it died" in errors
    assert errors.count("failed:") == 1
    assert "2 of 3 cases are kept" in errors


def test_a_lost_scheduler_ends_the_sweep_with_what_is_kept(study, tmp_path, monkeypatch, capfd):
    started = Cluster(tmp_path, 1)
    try:
        partial = tmp_path / f"{NAME}.partial.csv"
        many = [{"length": 1.0, "seed": seed} for seed in range(500)]
        monkeypatch.setattr(sweep_study, "cases", lambda: many)
        strike = threading.Thread(target=lambda: within(lambda: len(lines(partial)) > 2) and started.scheduler.kill())
        strike.start()
        with pytest.raises(ClusterError, match=f"{NAME}: the scheduler is gone"):
            swept(study, "--scheduler", started.address, "--data", tmp_path)
        strike.join()
    finally:
        started.close()
    last = capfd.readouterr().err.splitlines()[-1]
    assert f"{len(lines(partial)) - 1} of 500 cases are kept" in last


def test_the_table_does_not_depend_on_the_order_of_arrival(serial, tmp_path, expected):
    cases = sorted(sweep_study.cases(), key=lambda case: [case[key] for key in sweep_study.KEYS])
    arrivals = cases.copy()
    for seed in range(3):
        random.Random(seed).shuffle(arrivals)
        journal = Journal(tmp_path / f"{seed}.csv", sweep_study.KEYS)
        for case in arrivals:
            journal.append(case, serial[journal.key(case)])
        journal.complete(cases)
        assert (tmp_path / f"{seed}.csv").read_bytes() == expected


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ("length,lean\n1,2\n", "has the columns length, lean where the study has length, seed"),
        ("length,seed,lean\n1,2\n", r"is damaged \(row 2 has not 3 cells\)"),
        ("length,seed,lean\n1,2,3\n\n1,3,3\n", "is damaged"),
        ("\0\0\0\n", r"is damaged \(control characters\)"),
    ],
    ids=["other columns", "short row", "empty line", "not a table"],
)
def test_a_table_that_does_not_fit_the_study_is_refused(study, tmp_path, content, complaint):
    (tmp_path / f"{NAME}.csv").write_text(content)
    with pytest.raises(JournalError, match=f"{complaint}.*--fresh"):
        swept(study, "--data", tmp_path)
    assert (tmp_path / f"{NAME}.csv").read_text() == content


def test_a_result_with_other_columns_is_refused_and_fresh_forgets_the_rows(tmp_path):
    case = {"length": 1.0, "seed": 0}
    Journal(tmp_path / "x.csv", ["seed"]).append(case, {"lean": 0.5})
    journal = Journal(tmp_path / "x.csv", ["seed"])
    assert journal.holds([case]) == 1
    with pytest.raises(JournalError, match="result of case length=1 seed=0 has the columns seed, tilt where"):
        journal.append(case, {"tilt": 0.5})
    assert Journal(tmp_path / "x.csv", ["seed"], fresh=True).holds([case]) == 0
    assert not (tmp_path / "x.partial.csv").exists()


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["nothing"], f"unknown study nothing; there are {NAME}"),
        ([], f"name a study \\({NAME}\\), or --all"),
        ([NAME, "--limit", "0"], "--limit must be at least 1"),
        ([NAME, "--scheduler", "tcp://127.0.0.1:1"], "no Dask scheduler answers at tcp://127.0.0.1:1"),
        ([NAME, "--scheduler", "carrier-pigeon://x"], "no Dask scheduler answers at carrier-pigeon://x"),
    ],
    ids=["unknown study", "no study", "no cases", "nobody answers", "no address"],
)
def test_a_mistake_on_the_command_line_is_said_in_one_sentence(study, tmp_path, monkeypatch, arguments, complaint):
    monkeypatch.setattr("fiplib.studies.cluster.CONNECT_TIMEOUT", 0.5)
    with pytest.raises(FipError, match=complaint):
        swept(*arguments, "--data", tmp_path)


def test_list_names_each_study_with_its_cases(study, capsys):
    assert swept("--list") == 0
    assert capsys.readouterr().out.startswith(f"{NAME:18}    15 cases  A small study")


@pytest.mark.parametrize("name", STUDIES)
def test_a_registered_study_keeps_to_the_contract(name):
    study, cases = sweep.load(name, STUDIES[name])  # that it checks the keys is shown below
    assert study.cases() == study.cases()
    assert cases
    assert callable(study.run)
    assert study.__doc__
    assert {type(value) for case in cases for value in case.values()} <= {str, int, float}
    assert all(set(study.KEYS) <= set(case) for case in cases)


@pytest.mark.parametrize(
    ("cases", "complaint"),
    [
        ([{"length": 1.0}], "lacks its key seed"),
        ([{"length": 1.0, "seed": 1}] * 2, "two cases have the same length, seed"),
    ],
    ids=["no key", "same key"],
)
def test_cases_that_their_keys_do_not_tell_apart_are_refused(study, monkeypatch, cases, complaint):
    monkeypatch.setattr(sweep_study, "cases", lambda: cases)
    with pytest.raises(FipError, match=complaint):
        sweep.load(study, KNOWN[study])
