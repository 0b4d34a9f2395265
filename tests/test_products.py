"""The registry is complete, and make remakes exactly what an edit can change."""

import argparse
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from fiplib import products
from fiplib.commands import figures as command
from fiplib.params import FipError
from fiplib.products import GALLERY, LEDGER, PRODUCTS
from fiplib.reproduction import dependencies, gallery, making
from fiplib.reproduction.sources import BENCHMARKS
from fiplib.simulate import SCENARIOS
from fiplib.studies import STUDIES

ROOT = Path(__file__).parents[1]
FROM_PUSHES = {GALLERY, LEDGER, *(name for name, product in PRODUCTS.items() if "push-hover" in product.bags)}


def figures(*arguments: str | Path) -> int:
    """``fip figures`` with these arguments."""
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    return command.run(parser.parse_args(list(map(str, arguments))))


def test_every_name_of_the_registry_leads_somewhere():
    for product in PRODUCTS.values():
        assert product.load().__doc__
    everything = [*PRODUCTS.values(), products.page(), products.ledger()]
    assert {bag for product in everything for bag in product.bags} == set(SCENARIOS)
    assert {study for product in everything for study in product.studies} == set(STUDIES)
    assert {table for product in everything for table in product.benchmarks} == set(BENCHMARKS)
    assert all((ROOT / "benchmarks" / f"{table}.csv").exists() for table in BENCHMARKS)


def test_the_command_of_a_product_begins_with_what_it_is_made_from():
    assert PRODUCTS["fig3-pushes"].command == "make bags; make figures"
    assert PRODUCTS["table6-readings"].command == "make sweep STUDIES='ledger_seeds ledger_readings'; make figures"
    assert PRODUCTS["table10-rates"].command == "python benchmarks/bench_sweep.py --save; make figures"


def test_list_names_each_product_with_its_sources(capsys):
    assert figures("--list") == 0
    listed = {line.split()[0]: line for line in capsys.readouterr().out.splitlines()}
    assert list(listed) == [*PRODUCTS, GALLERY, LEDGER]
    assert "push-hover" in listed["fig3-pushes"] and "sweeps/bounds" in listed["fig12-bound"]


def test_a_wrong_name_is_refused_before_anything_is_made(tmp_path):
    with pytest.raises(FipError, match="no figure 'fig9-moon'; there are fig1-flight"):
        figures("fig2-vehicle", "fig9-moon", "--output", tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_a_missing_bag_is_named(tmp_path):
    with pytest.raises(FipError, match="nowhere"):
        figures("fig3-pushes", "--data", "nowhere", "--output", tmp_path)


def test_the_registry_is_read_without_what_makes_the_products():
    code = "import sys, fiplib.products; print(*{'numpy', 'matplotlib', 'casadi', 'rosbags'} & set(sys.modules))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert run.stdout.strip() == ""


# --- what an edit can change


def made_of(name: str) -> set[str]:
    return {str(path) for path in dependencies.files(PRODUCTS[name].address)}


def test_a_product_is_made_of_what_its_function_refers_to_and_no_more():
    assert made_of("fig2-vehicle") == {
        "fiplib/params.py", "fiplib/reproduction/figures.py", "fiplib/reproduction/style.py",
    }  # fmt: skip
    # through a function of another study, an attribute of a module, an import inside a function
    assert "fiplib/studies/estimators.py" in made_of("table11-imperfections")
    assert {"fiplib/reproduction/measures.py", "fiplib/estimators/poses/in_flight.py"} <= made_of("fig10-intervals")
    assert {"fiplib/kalman.py", "fiplib/ga.py"} <= made_of("table5-seeds")
    assert "fiplib/simulate.py" not in made_of("fig7-survival")


def test_no_product_is_made_of_what_flies_a_vehicle():
    ledger = dependencies.files("fiplib.reproduction.ledger:evaluate", "fiplib.reproduction.ledger:write")
    assert not [file for file in set(map(str, ledger)).union(*map(made_of, PRODUCTS)) if "flight/" in file]


# --- make


class Checkout:
    """A copy of what make looks at, in which everything has been made."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        shutil.copytree(ROOT / "fiplib", folder / "fiplib", ignore=shutil.ignore_patterns("__pycache__"))
        for name in ("Makefile", "requirements.lock", "pyproject.toml"):
            shutil.copy(ROOT / name, folder)
        python = folder / ".venv/bin/python"
        python.parent.mkdir(parents=True)
        python.write_text(f'#!/bin/sh\nPYTHONPATH=. exec {sys.executable} "$@"\n')
        python.chmod(0o755)
        sources = {path for product in (*PRODUCTS.values(), products.ledger()) for path in product.files()}
        self.touch(1, *sources, *(path for path in folder.rglob("*") if path.is_file()))
        self.touch(2, ".venv/locked")
        self.touch(3, ".venv/installed")
        self.files = [f"figures/{name}{suffix}" for name in PRODUCTS for suffix in making.suffixes(name)]
        self.files += ["figures/README.md", *(f"figures/small/{name}.png" for name in gallery.NAMES)]
        self.files += ["figures/claims.csv", "figures/claims.txt"]
        self.files += ["paper/generated/numbers.tex", "paper/generated/claims-table.tex"]
        self.make(".make/products.mk")
        self.touch(5, *self.files, ".make/figures", ".make/gallery", ".make/claims")

    def touch(self, second: int, *names: str | Path) -> None:
        """Let files have been written at a second after another."""
        for name in names:
            (self.folder / name).parent.mkdir(parents=True, exist_ok=True)
            (self.folder / name).touch()
            os.utime(self.folder / name, (1e9 + second,) * 2)

    def make(self, *arguments: str) -> subprocess.CompletedProcess:
        """Run make, free of the flags of a make that may be running the tests."""
        flags = ("MAKEFLAGS", "MFLAGS", "MAKELEVEL", "GNUMAKEFLAGS")
        environment = {name: value for name, value in os.environ.items() if name not in flags}
        command = ["make", "--no-print-directory", *arguments]
        return subprocess.run(command, cwd=self.folder, env=environment, capture_output=True, text=True)

    def would_make(self) -> list[str]:
        """The products that ``make figures`` would write, the ledger as "claims"."""
        lines = self.make("--dry-run", "figures").stdout.splitlines()
        commands = [line.split()[3:] for line in lines if "-m fiplib" in line]
        return [name for command in commands for name in command[1:]]


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Checkout:
    return Checkout(tmp_path_factory.mktemp("checkout"))


@pytest.fixture
def checkout(original: Checkout) -> Iterator[Checkout]:
    """The checkout; after the test it is as before."""
    kept = {path: path.read_bytes() for path in original.folder.glob("fiplib/**/*.py")}
    registry = (original.folder / ".make/products.mk").read_text()
    yield original
    for path, content in kept.items():
        path.write_bytes(content)
    (original.folder / ".make/products.mk").write_text(registry)
    original.touch(1, *kept, *products.ledger().files(), "benchmarks/sweep_rates.csv")
    original.touch(4, ".make/products.mk")
    original.touch(5, *original.files, ".make/figures", ".make/gallery", ".make/claims")


def test_what_has_been_made_is_not_made_again(checkout):
    assert checkout.would_make() == []
    assert checkout.make("--question", *checkout.files).returncode == 0


@pytest.mark.parametrize(
    ("edited", "made"),
    [
        ("fiplib/flight/failsafe.py", []),
        ("fiplib/studies/survival.py", ["fig7-survival"]),
        ("fiplib/studies/imperfections.py", ["table11-imperfections", "claims"]),
        ("data/push-hover/push-hover.mcap", [name for name in [*PRODUCTS, "gallery", "claims"] if name in FROM_PUSHES]),
        ("benchmarks/sweep_rates.csv", ["table10-rates"]),
        ("fiplib/products.py", [*PRODUCTS, "gallery", "claims"]),
    ],
)
def test_an_edit_remakes_what_it_can_change_and_nothing_else(checkout, edited, made):
    checkout.touch(6, edited)
    assert checkout.would_make() == made


def test_a_file_that_is_gone_is_made_again(checkout):
    (checkout.folder / "figures/table7-weights.tex").unlink()
    assert checkout.would_make() == ["table7-weights"]
    checkout.touch(5, "figures/table7-weights.tex")
    (checkout.folder / "figures/small/fig3-pushes.png").unlink()
    assert checkout.would_make() == ["gallery"]
    checkout.touch(5, "figures/small/fig3-pushes.png")


def test_cleaning_keeps_the_page_of_the_figures_that_the_repository_holds(checkout):
    removed = " ".join(line for line in checkout.make("--dry-run", "clean").stdout.splitlines() if "rm " in line)
    assert "figures/*.pdf" in removed and "figures/small" not in removed
    assert not re.search(r"figures(/|/\*|/\*\.md)?( |$)", removed)


def test_a_new_reference_counts_from_then_on(checkout):
    study = checkout.folder / "fiplib/studies/survival.py"
    study.write_text(study.read_text().replace("def fig7_survival(", "@failsafe\ndef fig7_survival(", 1))
    study.write_text(f"from fiplib.flight import failsafe\n{study.read_text()}")
    checkout.touch(6, "fiplib/studies/survival.py")
    assert checkout.would_make() == ["fig7-survival"]
    checkout.touch(7, *checkout.files, ".make/figures", ".make/gallery", ".make/claims")
    checkout.touch(8, "fiplib/flight/failsafe.py")
    assert checkout.would_make() == ["fig7-survival"]


def test_a_source_that_is_removed_does_not_stop_make(checkout):
    (checkout.folder / "fiplib/studies/benchmarks.py").rename(checkout.folder / "fiplib/studies/timing.py")
    registry = checkout.folder / "fiplib/products.py"
    registry.write_text(registry.read_text().replace("studies.benchmarks:", "studies.timing:"))
    assert "fig13-deadlines" in checkout.would_make()


def test_the_first_command_sets_up_the_environment(checkout):
    (checkout.folder / ".venv/locked").unlink()
    (checkout.folder / "python").write_text("#!/bin/sh\necho set up: $*\nexit 9\n")
    (checkout.folder / "python").chmod(0o755)
    assert checkout.make("help", "PYTHON=./python").returncode == 0
    run = checkout.make("figures", "PYTHON=./python")
    checkout.touch(2, ".venv/locked")
    assert run.returncode != 0 and "fip needs Python 3.11" in run.stderr
