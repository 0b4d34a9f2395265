"""CSV files and ROS 1 bags become bags of ours: the poses are the same, and what is not certain is said or refused."""

import argparse
import json
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.typesys import Stores, get_typestore

from fiplib.bags import read
from fiplib.commands import bag as command
from fiplib.recording import BagError, Flight

DATA = Path(__file__).parents[2] / "data" / "estimate-1.4"  # simulated, a uniform rod of 1 m
COUNT = 1200  # frames, 5 s
MAPPED = "time=t,vehicle=x,y,z,qx,qy,qz,qw,pendulum=px,py,pz,pqx,pqy,pqz,pqw"
HEADER = MAPPED.replace("time=", "").replace("vehicle=", "").replace("pendulum=", "")
MOTIVE = """Format Version,1.23,Export Frame Rate,240,Rotation Type,Quaternion,Length Units,Millimeters\
,Coordinate Space,Global

,Type,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body Marker\
,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body
,Name,quad,quad,quad,quad,quad,quad,quad,quad,quad:1,rod,rod,rod,rod,rod,rod,rod
,ID,1,1,1,1,1,1,1,1,2,3,3,3,3,3,3,3
,,Rotation,Rotation,Rotation,Rotation,Position,Position,Position,Mean Marker Error,Position\
,Rotation,Rotation,Rotation,Rotation,Position,Position,Position
Frame,Time (Seconds),X,Y,Z,W,X,Y,Z,,X,X,Y,Z,W,X,Y,Z
"""
VICON = """Objects
240

,,quad:quad,,,,,,,Global Angle rod:rod,,,,,,
Frame,Sub Frame,RX,RY,RZ,RW,TX,TY,TZ,RX,RY,RZ,RW,TX,TY,TZ
,,,,,,mm,mm,mm,,,,,mm,mm,mm
"""


def convert(*arguments: object) -> int:
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    return command.run(parser.parse_args([str(argument) for argument in ("convert", *arguments)]))


@pytest.fixture(scope="module")
def flight() -> Flight:
    return read(DATA)


@pytest.fixture(scope="module")
def seconds(flight: Flight) -> np.ndarray:
    return flight.time(flight.vehicle)[:COUNT]


def poses(flight: Flight, unit: float = 1.0) -> list[np.ndarray]:
    """Positions and quaternions of vehicle and rod, in turn."""
    bodies = (flight.vehicle, flight.pendulum)
    return [array[:COUNT] for body in bodies for array in (body.position / unit, body.orientation)]


def y_up(vectors: np.ndarray) -> np.ndarray:
    """The same vectors, or vector parts of quaternions, in a frame whose y axis points up: its z is our -y."""
    return np.column_stack([vectors[:, 0], vectors[:, 2], -vectors[:, 1], *vectors.T[3:]])


def table(*columns: np.ndarray, fixed: str = "%.9f") -> str:
    return "\n".join(",".join(fixed % number for number in row) for row in np.column_stack(columns)) + "\n"


def motive(flight: Flight, seconds: np.ndarray) -> str:
    x, q, rod_x, rod_q = map(y_up, poses(flight, 1e-3))
    error = np.zeros((len(seconds), 2))
    return MOTIVE + table(np.arange(len(seconds)), seconds, q, x, error, rod_q, rod_x)


def mapped(flight: Flight, seconds: np.ndarray) -> str:
    return HEADER + "\n" + table(seconds, *poses(flight))


def assert_same(found: Flight, flight: Flight) -> None:
    """Equal to the digits of the file; quaternions were recorded in single precision, and are normalised since."""
    for body in ("vehicle", "pendulum"):
        new, old = getattr(found, body), getattr(flight, body)
        np.testing.assert_allclose(new.position, old.position[:COUNT], rtol=0, atol=1e-9)
        np.testing.assert_allclose(new.orientation, old.orientation[:COUNT], rtol=0, atol=6e-8)
        expected = old.stamp[:COUNT] - old.stamp[0]
        np.testing.assert_allclose(new.stamp - new.stamp[0], expected, rtol=0, atol=2)  # ns, rounded twice


def test_an_export_of_motive_is_turned_and_scaled_and_all_that_was_assumed_is_said(tmp_path, flight, seconds, capsys):
    source = tmp_path / "take.csv"
    source.write_text(motive(flight, seconds))
    assert convert(source) == 0
    said = capsys.readouterr().out
    for words in ("Motive", "in mm", "y is up", "quad is taken for the vehicle", "rod is taken for the pendulum"):
        assert words in said
    found = read(tmp_path / "take")
    assert_same(found, flight)
    assert found.metadata["origin"] == "unknown" and found.metadata["converted"]["from"] == "take.csv"


def test_the_length_from_a_converted_export_is_that_of_its_flight(tmp_path, flight, seconds, capsys):
    (tmp_path / "take.csv").write_text(motive(flight, seconds))
    convert(tmp_path / "take.csv")
    capsys.readouterr()
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    assert command.run(parser.parse_args(["length", str(tmp_path / "take"), "--json"])) == 0
    low, high = json.loads(capsys.readouterr().out)["interval"]
    assert low < 1.0 < high and high - low < 0.05


def test_an_export_of_vicon_with_quaternions_is_read_and_one_with_angles_is_refused(tmp_path, flight, seconds):
    x, q, rod_x, rod_q = poses(flight, 1e-3)
    frames = np.rint(seconds * 240) + 17
    source = tmp_path / "take.csv"
    source.write_text(VICON + table(frames, 0 * frames, q, x, rod_q, rod_x) + "\nTrajectories\n240\n")
    convert(source)
    found = read(tmp_path / "take")
    np.testing.assert_allclose(found.pendulum.position, flight.pendulum.position[:COUNT], rtol=0, atol=1e-9)
    np.testing.assert_allclose(np.diff(found.vehicle.stamp), 1e9 / 240, rtol=0, atol=1)
    source.write_text(VICON.replace(",RW", "") + "1,0" + 12 * ",0.0")
    with pytest.raises(BagError, match=r"take\.csv: row 5 names RX, RY, RZ, TX.*quaternions"):
        convert(source, "--output", tmp_path / "angles")


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_any_columns_are_read_by_names(tmp_path, flight, seconds, separator):
    source = tmp_path / "table.csv"
    source.write_text(mapped(flight, seconds).replace(",", separator))
    convert(source, "--columns", MAPPED)
    assert_same(read(tmp_path / "table"), flight)


def test_columns_may_be_numbers_and_a_rate_replaces_the_times(tmp_path, flight, seconds):
    source = tmp_path / "table.csv"
    source.write_text(table(*map(y_up, poses(flight, 1e-3)), fixed="%.12f"))
    columns = "vehicle=1,2,3,4,5,6,7,pendulum=8,9,10,11,12,13,14"
    convert(source, "--columns", columns, "--rate", 240, "--unit", "mm", "--up", "y")
    assert_same(read(tmp_path / "table"), flight)


def test_rows_without_a_pose_are_left_out_and_counted(tmp_path, flight, seconds, capsys):
    lines = mapped(flight, seconds).splitlines()
    for at in range(100, 140):  # the rod is lost: empty cells
        lines[at] = ",".join(lines[at].split(",")[:8]) + 7 * ","
    for at in range(200, 205):  # or a quaternion that is none
        lines[at] = ",".join(lines[at].split(",")[:11]) + 4 * ",0"
    (tmp_path / "table.csv").write_text("\n".join(lines))
    convert(tmp_path / "table.csv", "--columns", MAPPED)
    assert "pendulum: 45 of 1200 rows hold no pose" in capsys.readouterr().out
    found = read(tmp_path / "table")
    assert len(found.vehicle.stamp) == COUNT and len(found.pendulum.stamp) == COUNT - 45


def changed(text: str, row: int, column: int, cell: str) -> str:
    lines = text.splitlines()
    cells = lines[row - 1].split(",")
    cells[column - 1] = cell
    return "\n".join([*lines[: row - 1], ",".join(cells), *lines[row:]])


@pytest.mark.parametrize(
    ("options", "edit", "words"),
    [
        ([], None, "not recognised .* --columns time=T"),
        (["--columns", MAPPED.replace("pqw", "w")], None, "no column w in a header; row 1 has t, x"),
        (["--columns", MAPPED.replace("pqy,", "")], None, "names 6 columns for pendulum, which takes 7"),
        (["--columns", "t"], None, "must begin with what a column is"),
        (["--columns", "time=t"], None, "does not name the columns of the vehicle"),
        (["--columns", MAPPED.replace("time=t,", "")], None, "neither a column of times nor a rate"),
        (["--columns", MAPPED, "--rate", "0"], None, "a rate of 0 Hz"),
        (["--columns", MAPPED, "--vehicle", "quad"], None, "leave --vehicle and --pendulum out"),
        (["--columns", MAPPED], (9, 3, "1.2.3"), "row 9, column 3: '1.2.3' is not a number"),
        (["--columns", MAPPED], (9, 1, ""), "row 9 has no time"),
        (["--columns", MAPPED], (9, 1, "-1"), "row 9 has the time -1 s"),
        (["--columns", MAPPED], (9, 1, "0"), "time of row 9 is not after"),
        (["--columns", MAPPED], (9, 8, "0.1"), "row 9: the quaternion of the vehicle has norm"),
        (["--columns", MAPPED], (1, 3, "x"), "several columns x: give --columns by numbers|no column y"),
    ],
)
def test_what_is_wrong_is_named_in_one_sentence_and_nothing_is_written(tmp_path, flight, seconds, options, edit, words):
    text = mapped(flight, seconds)
    source = tmp_path / "table.csv"
    source.write_text(changed(text, *edit) if edit else text)
    with pytest.raises(BagError, match=rf"table\.csv: .*({words})"):
        convert(source, *options)
    assert list(tmp_path.iterdir()) == [source]


@pytest.mark.parametrize(
    ("old", "new", "options", "words"),
    [
        ("Type,Quaternion", "Type,XYZ", [], "Rotation Type XYZ: export it again"),
        ("Space,Global", "Space,Local", [], "Coordinate Space Local"),
        ("Millimeters", "Inches", [], "Length Units Inches"),
        ("Millimeters", "Millimeters", ["--unit", "m"], "its header says mm, and --unit m"),
        ("Rigid Body", "Bone", [], "without rigid bodies"),
        ("quad", "quad", ["--vehicle", "plane"], r"no body plane \(vehicle\); there are quad, rod"),
        ("rod", "rod", ["--vehicle", "rod", "--pendulum", "rod"], "which body is the vehicle .* quad, rod"),
    ],
)
def test_an_export_that_leaves_something_open_is_refused(tmp_path, flight, seconds, old, new, options, words):
    (tmp_path / "take.csv").write_text(motive(flight, seconds).replace(old, new))
    with pytest.raises(BagError, match=words):
        convert(tmp_path / "take.csv", *options)


def test_times_in_milliseconds_are_refused(tmp_path, flight, seconds):
    (tmp_path / "table.csv").write_text(HEADER + "\n" + table(1e3 * seconds, *poses(flight)))
    with pytest.raises(BagError, match=r"0\.24 frames per second: they must be in s"):
        convert(tmp_path / "table.csv", "--columns", MAPPED)


def test_nothing_is_overwritten_and_what_needs_no_conversion_is_named(tmp_path, flight, seconds):
    source = tmp_path / "take.csv"
    source.write_text(motive(flight, seconds))
    (tmp_path / "take").mkdir()
    with pytest.raises(BagError, match=r"take: exists already; .* fip bag convert .*take\.csv --output NEW"):
        convert(source)
    with pytest.raises(BagError, match=r"without \.bag at its end"):
        convert(source, "--output", tmp_path / "new.bag")
    with pytest.raises(BagError, match="cannot convert"):
        convert(source, "--output", tmp_path / "nowhere" / "new")
    with pytest.raises(BagError, match="read as it is: fip bag info"):
        convert(DATA)
    with pytest.raises(BagError, match="no such file"):
        convert(tmp_path / "nowhere.csv")
    with pytest.raises(BagError, match=r"a CSV file; .* fip bag convert .*take\.csv$"):
        read(source)
    (tmp_path / "noise.csv").write_bytes(bytes(range(256)))
    with pytest.raises(BagError, match=r"noise\.csv: not "):
        convert(tmp_path / "noise.csv")


def test_a_bag_of_ros_1_is_converted(tmp_path, flight):
    store = get_typestore(Stores.ROS1_NOETIC)
    types, kind = store.types, "geometry_msgs/msg/PoseStamped"
    with Ros1Writer(tmp_path / "lab.bag") as writer:
        for topic, body in (("/vicon/quad/pose", flight.vehicle), ("/vicon/rod/pose", flight.pendulum)):
            connection = writer.add_connection(topic, kind, typestore=store)
            for i in range(COUNT):
                stamp = int(body.stamp[i])
                time = types["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9))
                point = types["geometry_msgs/msg/Point"](*body.position[i])
                pose = types["geometry_msgs/msg/Pose"](
                    point, types["geometry_msgs/msg/Quaternion"](*body.orientation[i])
                )
                message = types[kind](types["std_msgs/msg/Header"](i, time, "world"), pose)
                writer.write(connection, stamp, store.serialize_ros1(message, kind))
    convert(tmp_path / "lab.bag", "--output", tmp_path / "new")
    found = read(tmp_path / "new")
    assert np.array_equal(found.pendulum.position, flight.pendulum.position[:COUNT])
    assert np.array_equal(found.vehicle.stamp, flight.vehicle.stamp[:COUNT])
    with pytest.raises(BagError, match="takes none of the options"):
        convert(tmp_path / "lab.bag", "--output", tmp_path / "other", "--unit", "mm")
    (tmp_path / "broken.bag").write_bytes((tmp_path / "lab.bag").read_bytes()[:5000])
    with pytest.raises(BagError, match=r"broken\.bag: a bag of ROS 1 that cannot be converted"):
        convert(tmp_path / "broken.bag")
    assert not (tmp_path / "broken").exists()
