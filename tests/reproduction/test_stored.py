"""Damaged tables: one sentence that names the file and the command that makes it again, and never another number."""

import argparse
import random
import shutil
from pathlib import Path

import pytest

from fiplib import studies
from fiplib.commands import figures
from fiplib.reproduction import sources, stored
from fiplib.reproduction.sources import BENCHMARKS
from fiplib.reproduction.stored import SUMS, JournalError
from fiplib.studies.faults import campaign
from fiplib.studies.journal import Journal

DATA = Path(__file__).parents[2] / "data"
TABLES = [*sorted(f"sweeps/{path.name}" for path in (DATA / "sweeps").glob("*.csv")), "faults.csv"]


def mutations(content: bytes, rng: random.Random) -> dict[str, bytes]:
    """Kinds of damage, each with what is left of a table."""
    lines, at = content.splitlines(keepends=True), rng.randrange(len(content) // 2, len(content) - 1)
    digit = next(i for i in range(at, -1, -1) if content[i : i + 1].isdigit())
    row = rng.randrange(1, len(lines))
    other = b"1" if content[digit : digit + 1] != b"1" else b"2"
    return {
        "empty": b"",
        "header only": lines[0],
        "no header": b"".join(lines[1:]),
        "cut": content[:at],
        "cut inside a number": content[:digit],
        "cut at a line": b"".join(lines[:row]),
        "last newline lost": content[:-1],
        "a digit changed": content[:digit] + other + content[digit + 1 :],
        "a digit lost": content[:digit] + content[digit + 1 :],
        "a bit flipped": content[:at] + bytes([content[at] ^ 0x80]) + content[at + 1 :],
        "a row lost": b"".join(lines[:row] + lines[row + 1 :]),
        "a row twice": b"".join([*lines, lines[row]]),
        "rows swapped into the header": b"".join([lines[1], lines[0], *lines[2:]]),
        "a cell lost": b"".join([*lines[:row], lines[row].rpartition(b",")[0] + b"\n", *lines[row + 1 :]]),
        "a word for a number": content[:digit] + b"x" + content[digit + 1 :],
        "zeros": content[:at] + bytes(len(content) - at),
        "a column renamed": content.replace(lines[0].split(b",")[0], b"thing", 1),
        "a quote": content[:at] + b'"' + content[at:],
    }


def read(data: Path, table: str) -> list[dict]:
    if table == "faults.csv":
        return campaign.rows_of(data / table)
    rows = sources.read(Path(table).stem, data)
    studies.check(Path(table).stem, rows)
    return rows


@pytest.mark.parametrize("table", TABLES)
def test_no_damage_of_a_table_passes_and_each_is_one_sentence(table, tmp_path):
    (tmp_path / "sweeps").mkdir()
    shutil.copy(DATA / SUMS, tmp_path)
    content, command = (DATA / table).read_bytes(), "fip faults" if table == "faults.csv" else "make sweep STUDIES="
    (tmp_path / table).write_bytes(content)
    assert read(tmp_path, table)
    for seed in range(3):
        for kind, damaged in mutations(content, random.Random(seed)).items():
            (tmp_path / table).write_bytes(damaged)
            with pytest.raises(JournalError) as raised:
                read(tmp_path, table)
            words = str(raised.value)
            assert table in words and command in words and "\n" not in words, f"{kind}, seed {seed}: {words}"


@pytest.mark.parametrize("table", TABLES[:-1])
def test_without_checksums_what_is_not_a_whole_table_of_the_cases_is_still_refused(table, tmp_path):
    (tmp_path / "sweeps").mkdir()
    for kind, damaged in mutations((DATA / table).read_bytes(), random.Random(0)).items():
        if kind not in ("a digit changed", "a digit lost"):  # another number of the same form: only a checksum knows
            (tmp_path / table).write_bytes(damaged)
            with pytest.raises(JournalError, match="make sweep STUDIES="):
                read(tmp_path, table)


def test_what_is_no_file_is_refused_and_not_waited_for(tmp_path):
    folder = tmp_path / "sweeps"
    folder.mkdir()
    (folder / "survival.csv").symlink_to("/dev/zero")
    with pytest.raises(JournalError, match=r"survival\.csv is damaged"):
        sources.read("survival", tmp_path)


def test_a_finished_table_records_its_checksum_and_a_damaged_one_is_not_continued(tmp_path):
    (tmp_path / SUMS).write_text("0" * 64 + "  other/other.mcap\n")
    path, case = tmp_path / "sweeps/new.csv", {"key": 1}
    journal = Journal(path, ["key"])
    journal.append(case, {"value": 2.5})
    journal.complete([case])
    assert sorted(stored.recorded(tmp_path)) == ["other/other.mcap", "sweeps/new.csv"]
    assert Journal(path, ["key"]).holds([case]) == 1
    path.write_text("key,value\n1,2.6\n")
    with pytest.raises(JournalError, match=r"new\.csv is damaged \(its checksum .*--fresh"):
        Journal(path, ["key"])
    assert Journal(path, ["key"], fresh=True).holds([case]) == 0


@pytest.mark.parametrize("name", BENCHMARKS)
def test_damaged_tables_of_the_benchmarks_name_their_command(name, tmp_path):
    content = (DATA.parent / f"benchmarks/{name}.csv").read_bytes()
    (tmp_path / "benchmarks").mkdir()
    for kind in ("empty", "header only", "last newline lost", "a cell lost", "zeros"):
        (tmp_path / f"benchmarks/{name}.csv").write_bytes(mutations(content, random.Random(1))[kind])
        with pytest.raises(JournalError) as raised:
            sources.measured(name, tmp_path / "data")
        assert f"{name}.csv" in str(raised.value) and BENCHMARKS[name] in str(raised.value), kind


def test_a_figure_of_a_damaged_table_is_refused_and_the_others_are_made(tmp_path, capsys):
    (tmp_path / "sweeps").mkdir()
    shutil.copy(DATA / SUMS, tmp_path)
    (tmp_path / "sweeps/survival.csv").write_bytes((DATA / "sweeps/survival.csv").read_bytes()[:-3])
    parser = argparse.ArgumentParser()
    figures.add_arguments(parser)
    names = ["fig7-survival", "table1-parameters"]
    options = parser.parse_args([*names, "--data", str(tmp_path), "--output", str(tmp_path / "figures")])
    assert figures.run(options) == 1
    printed = capsys.readouterr()
    assert "table1-parameters.csv" in printed.out and printed.err.count("\n") == 1
    assert printed.err.startswith("fip: fig7-survival: ") and "make sweep STUDIES='survival --fresh'" in printed.err


def test_a_column_that_is_missing_is_named_with_its_file_and_the_command(tmp_path):
    table = tmp_path / "study.csv"
    table.write_text("seed,value\n1,2.0\n")
    for read in (stored.rows, stored.numbers):
        [row] = read(table, "make sweep STUDIES=study")
        assert row.get("other") is None
        with pytest.raises(stored.JournalError, match=r"study.csv lacks the column 'other': make it again"):
            row["other"]
