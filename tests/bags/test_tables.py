"""Tables of a flight: every number comes back from the file, names carry units, nothing is overwritten."""

import csv
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from fiplib.bags import read
from fiplib.bags.tables import TABLES, columns, export, to_dataframe
from fiplib.recording import BagError
from tests.bags.test_bags import FRAMES, MOCAP, Numbers, foreign, write

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    return read(write(tmp_path_factory.mktemp("bags") / "flight", Numbers()))


@pytest.mark.parametrize("what", TABLES)
def test_csv_and_npz_give_every_number_back(flight, tmp_path, what):
    table = columns(flight, what)
    assert all(name == "body" or name.endswith("]") for name in table)
    for suffix in (".csv", ".npz"):
        said = export(flight, tmp_path / f"table{suffix}", what)
        assert f"{len(table['time [s]'])} {what}" in said
    with np.load(tmp_path / "table.npz") as archive:
        assert list(archive) == list(table)
        for name, column in table.items():
            np.testing.assert_array_equal(archive[name], column)
    with (tmp_path / "table.csv").open(newline="") as stream:
        head, *rows = csv.reader(stream)
    assert head == list(table) and len(rows) == len(table["time [s]"])
    for name, text in zip(head, zip(*rows, strict=True), strict=True):
        if name == "body":
            assert list(text) == table[name].tolist()
        else:  # the shortest digits that give the same number back; empty where it is not known
            kind = table[name].dtype
            np.testing.assert_array_equal([kind.type(word) if word else np.nan for word in text], table[name])


def test_poses_are_one_row_each_with_the_name_of_the_body(flight):
    table = columns(flight, "poses")
    assert len(table["time [s]"]) == 2 * FRAMES and (np.diff(table["stamp [ns]"]) >= 0).all()
    rod = table["body"] == "pendulum"
    np.testing.assert_array_equal(table["z [m]"][rod], flight.pendulum.position[:, 2])
    np.testing.assert_array_equal(table["qw [1]"][~rod], flight.vehicle.orientation[:, 3])
    np.testing.assert_array_equal(table["time [s]"][rod], flight.time(flight.pendulum))


def test_what_cannot_be_written_says_so_and_leaves_nothing_behind(flight, tmp_path):
    taken = tmp_path / "taken.csv"
    taken.write_text("mine")
    stranger = read(foreign(tmp_path / "lab", MOCAP))
    for one, file, what, words in (
        (flight, taken, "states", "exists already"),
        (flight, tmp_path / "table.xlsx", "states", r"none of \.csv, \.parquet, \.npz"),
        (flight, tmp_path / "nowhere" / "table.csv", "states", "cannot be written"),
        (flight, tmp_path / "table.csv", "nonsense", "no such table"),
        (stranger, tmp_path / "table.csv", "commands", "holds no commands"),
    ):
        with pytest.raises(BagError, match=words):
            export(one, file, what)
    assert taken.read_text() == "mine" and not list(tmp_path.glob("table*"))


def test_parquet_without_its_packages_names_the_extra_in_one_line(tmp_path):
    code = "import sys; sys.modules['pandas'] = None; from fiplib.__main__ import main; sys.exit(main(sys.argv[1:]))"
    file = tmp_path / "table.parquet"
    arguments = "bag", "export", str(ROOT / "data/push-hover"), "--to", str(file)
    done = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 2 and done.stderr == "fip: this needs the package pandas: pip install 'fip[tables]'\n"
    assert not file.exists()


def test_a_data_frame_is_one_call_and_parquet_gives_it_back(flight, tmp_path):
    pandas = pytest.importorskip("pandas")
    frame = to_dataframe(flight, "commands")
    assert list(frame) == list(columns(flight, "commands"))
    np.testing.assert_array_equal(frame["thrust [1]"], flight.command.column("thrust"))
    pytest.importorskip("pyarrow")
    export(flight, tmp_path / "table.parquet", "commands")
    pandas.testing.assert_frame_equal(pandas.read_parquet(tmp_path / "table.parquet"), frame)


def test_the_command_derives_states_and_estimates_where_none_are_recorded(tmp_path):
    """Of a stranger's bag, whose only topics are the two bodies."""
    source = ROOT / "data" / "estimate-0.8"
    stranger = tmp_path / "lab"
    code = f"""
from fiplib.bags import read
from fiplib.bags.writer import BagRecorder
flight = read({str(source)!r})
with BagRecorder({str(stranger)!r}, {{"origin": "unknown"}}) as bag:
    for i in range(1800):
        for name in ("vehicle", "pendulum"):
            body = getattr(flight, name)
            bag.pose(name, body.stamp[i], body.received[i], body.position[i], body.orientation[i])
from fiplib.__main__ import main
for what in ("states", "estimates"):
    assert main(["bag", "export", {str(stranger)!r}, "--what", what, "--to", {str(tmp_path)!r} + f"/{{what}}.npz"]) == 0
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, env=os.environ)
    assert done.returncode == 0, done.stderr
    with np.load(tmp_path / "states.npz") as states, np.load(tmp_path / "estimates.npz") as estimates:
        assert len(states["x [m]"]) > 800 and np.isfinite(states["phi [rad]"]).all()
        assert len(estimates["estimate [m]"]) == 2  # 7.5 s less a frame: two windows of at least 2.5 s
        sure = np.abs(estimates["estimate [m]"] - 1.0) < 4 * estimates["standard_deviation [m]"]
        assert sure.all() and (estimates["standard_deviation [m]"] < 0.1).all()
