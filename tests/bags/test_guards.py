"""Hostile recordings: pipes, devices, links out of the bag, YAML that explodes, data that unpack to too much.

Each is refused in one sentence, within bounded time and memory.
"""

import io
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import tarfile
from pathlib import Path

import pytest

from fiplib import bags
from fiplib.bags import guards
from fiplib.bags.convert import convert
from fiplib.bags.messages import unpacked, zstd
from fiplib.recording import BagError

ROOT = Path(__file__).parents[2]
BAG = ROOT / "data/push-hover"
LAUGHS = "a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + "".join(
    f"{after}: &{after} [{', '.join([f'*{before}'] * 10)}]\n"
    for before, after in zip("abcdefgh", "bcdefghi", strict=True)
)
MERGES = "a: &a {k: 1}\n" + "".join(f"m{i}: &m{i} {{<<: [*a, *a], n{i}: *a}}\n" for i in range(40))


def limited() -> None:
    """In a child process: 2 GB of memory, of which the interpreter with its libraries takes half a gigabyte."""
    resource.setrlimit(resource.RLIMIT_AS, (2 << 30, 2 << 30))


def fip(*arguments: object) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "fiplib", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=60, preexec_fn=limited)


@pytest.fixture(autouse=True)
def impatient():
    """A minute at most: what waits for a pipe waits for ever."""
    signal.signal(signal.SIGALRM, signal.default_int_handler)
    signal.alarm(60)
    yield
    signal.alarm(0)


def refused(path: Path, *words: str) -> None:
    """Each way to read a recording refuses one in one sentence with these words."""
    for way in (bags.read, bags.recover):
        with pytest.raises(BagError) as raised:
            way(path)
        assert all(word in str(raised.value) for word in words), raised.value
        assert "\n" not in str(raised.value)


@pytest.fixture
def bag(tmp_path) -> Path:
    return shutil.copytree(BAG, tmp_path / "push-hover")


def test_a_pipe_or_device_in_place_of_a_recording_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe.mcap")
    (tmp_path / "zeros.csv").symlink_to("/dev/zero")
    for file in ("pipe.mcap", "zeros.csv"):
        refused(tmp_path / file, file, "a device, pipe or socket")
        with pytest.raises(BagError, match="a device, pipe or socket"):
            convert(tmp_path / file, tmp_path / "new")


@pytest.mark.parametrize("name", ["metadata.yaml", "push-hover.mcap", "recording.yaml"])
def test_a_pipe_or_device_within_a_bag_is_not_waited_for(bag, name):
    (bag / name).unlink(missing_ok=True)
    os.mkfifo(bag / name)
    refused(bag, name, "a device, pipe or socket")
    (bag / name).unlink()
    (bag / name).symlink_to("/dev/zero")
    refused(bag, name, "a device, pipe or socket")


@pytest.mark.parametrize(
    ("yaml", "words"),
    [
        (LAUGHS, "aliases make explode"),
        ("a: " + "[" * 100_000, "nested too deep"),
        ("a: " + "{b: " * 100_000, "nested too deep"),
        ("- " * 100_000, "nested too deep"),
        ("a: &a [*a]", "an alias of nothing, or of itself"),
        ("a: " + "x" * (guards.WORDS + 1), "more than 4 MB of YAML"),
        ("a: !!python/object/apply:os.system ['touch hacked']", "damaged"),
        ("\x00" * 100, "damaged"),
    ],
    ids=["laughs", "brackets", "braces", "dashes", "itself", "large", "code", "zeros"],
)
def test_hostile_yaml_is_one_sentence(bag, yaml, words):
    (bag / "metadata.yaml").write_text(yaml)
    with pytest.raises(BagError) as raised:
        bags.read(bag)
    assert words in str(raised.value) and "\n" not in str(raised.value)
    assert not Path("hacked").exists()


def test_yaml_with_harmless_aliases_is_read():
    assert guards.words("a: &a {k: [1, 2]}\nb: *a\n") == {"a": {"k": [1, 2]}, "b": {"k": [1, 2]}}
    assert guards.words(MERGES)["m39"]["n39"] == {"k": 1}


@pytest.mark.parametrize("value", ["[" * 100_000, '{"a":' * 100_000, "1" * 100_000, '"' + "\\u0000" * 10])
def test_hostile_json_in_the_metadata_is_read_as_words_or_refused(bag, value):
    head = (bag / "metadata.yaml").read_text().partition("  custom_data:")[0]
    (bag / "metadata.yaml").write_text(f"{head}  custom_data:\n    scenario: {json.dumps(value)}\n")
    try:
        assert bags.read(bag).metadata["scenario"] == value
    except BagError as error:
        assert "\n" not in str(error) and len(str(error)) < 1000


def test_paths_in_the_metadata_are_never_followed_out_of_the_bag(bag, tmp_path):
    yaml = (bag / "metadata.yaml").read_text()
    outside = shutil.move(bag / "push-hover.mcap", tmp_path / "outside.mcap")
    for name in ("../outside.mcap", str(outside), "sub/../../outside.mcap"):
        (bag / "metadata.yaml").write_text(yaml.replace("push-hover.mcap", name))
        with pytest.raises(BagError, match=r"no \.mcap and no \.db3 file is in it"):
            bags.read(bag)
    (bag / "metadata.yaml").write_text(yaml)
    (bag / "push-hover.mcap").symlink_to(outside)
    with pytest.raises(
        BagError, match=r"a link that leads out of the bag, which is not followed: give the file itself"
    ):
        bags.read(bag)
    (bag / "push-hover.mcap").unlink()
    shutil.move(outside, bag / "whole.mcap")
    (bag / "push-hover.mcap").symlink_to("whole.mcap")  # within the bag it is
    (bag / "link").symlink_to(bag)
    assert bags.read(bag / "link").duration > 20


def test_compressed_data_that_unpack_to_too_much_are_refused(tmp_path, monkeypatch):
    bomb = zstd.compress(bytes(1 << 24))
    monkeypatch.setattr(guards, "UNPACKED", 1 << 20)
    with pytest.raises(ValueError, match="unpack to more than 1 MB"):
        unpacked(bomb)
    assert unpacked(zstd.compress(b"one") + zstd.compress(b"two")) == b"onetwo"
    monkeypatch.setattr(guards, "ROOM", 1 << 22)
    (tmp_path / "bomb.mcap.zstd").write_bytes(bomb)
    with pytest.raises(BagError, match="compressed data that unpack to more than"):
        bags.read(tmp_path / "bomb.mcap.zstd")


def test_a_table_that_is_one_endless_line_is_refused(tmp_path):
    (tmp_path / "line.csv").write_text("time," + "[" * (guards.LINE + 1))
    with pytest.raises(BagError, match="a line of more than 1 MB"):
        convert(tmp_path / "line.csv", tmp_path / "bag")
    assert not (tmp_path / "bag").exists()


def test_a_file_of_other_kinds_is_no_bag_whatever_its_name(tmp_path):
    with tarfile.open(tmp_path / "archive.mcap", "w") as archive:
        archive.addfile(tarfile.TarInfo("../../escaped"), io.BytesIO())
    (tmp_path / "text.db3").write_text("not a database")
    (tmp_path / "sparse.mcap").touch()
    os.truncate(tmp_path / "sparse.mcap", 5 << 29)  # gigabytes of zeros
    for name in ("archive.mcap", "text.db3"):
        refused(tmp_path / name, name)
    done = fip("bag", "info", tmp_path / "sparse.mcap")
    assert done.returncode == 2 and done.stderr.count("\n") == 1, done.stderr
    assert done.stderr.startswith("fip: ") and "sparse.mcap" in done.stderr
