"""What is left of a damaged recording comes back, all of it and nothing else, and the original stays as it was."""

import subprocess
import sys
import tempfile
from collections import Counter
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import CompressionMode, Reader, StoragePlugin

from fiplib import recording
from fiplib.bags import live, writer
from fiplib.bags import messages as layouts
from fiplib.bags.reader import read
from fiplib.bags.recovery import recover
from fiplib.recording import BagError
from tests.bags.test_bags import METADATA, Numbers, copy, foreign, mcap, poses, run, same, write

Found = tuple[str, int, bytes]  # topic, log time in ns, message


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bag of two dozen chunks, as a live recording has them; no test changes it."""
    numbers = Numbers(frames=240)
    path = tmp_path_factory.mktemp("bags") / "flight"
    return write(path, numbers, recorder=Chunked)


class Chunked(live._Bag):
    """The live recorder's writing end, with a chunk for every 64 messages whatever the clock says."""

    def _put(self, role: str, log_time: int, data: bytes) -> None:
        super()._put(role, log_time, data)
        if len(self._pending) >= 64:
            self.commit()


def messages(bag: Path) -> list[Found]:
    """All messages of a sound bag in the order of its file, as the independent reader finds them."""
    with mcap(bag).open("rb") as stream:
        found = make_reader(stream, validate_crcs=True).iter_messages(log_time_order=False)
        return [(channel.topic, message.log_time, message.data) for _, channel, message in found]


def before_the_damage(data: bytes, folder: Path) -> list[Found]:
    """What the independent reader gets out of a file from its beginning until it fails."""
    (folder / "judged").write_bytes(data)
    topics, found = {}, []
    with (folder / "judged").open("rb") as stream:
        try:
            for record in StreamReader(stream, record_size_limit=None).records:
                if isinstance(record, Channel):
                    topics[record.id] = record.topic
                elif isinstance(record, Message):
                    found.append((topics[record.channel_id], record.log_time, record.data))
        except Exception:  # the damage
            pass
    return found


def damaged(folder: Path, data: bytes) -> Path:
    """A bag of these bytes alone: its metadata.yaml is lost."""
    path = folder / "flight"
    path.mkdir()
    mcap(path).write_bytes(data)
    return path


# --- what comes back -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["ordinary", "live"])
def test_a_sound_bag_comes_back_whole(tmp_path: Path, kind: str) -> None:
    numbers = Numbers(frames=240)
    source = write(tmp_path / "flight", numbers, recorder=Chunked if kind == "live" else writer.BagRecorder)
    before = {file.name: file.read_bytes() for file in source.iterdir()}
    recovery = recover(source)
    assert recovery.gaps == () and recovery.nameless == 0 and recovery.finished
    assert all(topic.lost == 0 for topic in recovery.saved)
    assert recovery.seconds == pytest.approx(239 / 240 + 1 / 240)  # 240 frames, and the latency of the last pose
    again = read(recovery.output)
    assert same(read(source), again)
    assert again.metadata["recovered"] == {"from": "flight", "finished": True, "damaged_bytes": 0}
    assert {file.name: file.read_bytes() for file in source.iterdir()} == before
    assert "lost       nothing" in recovery.describe()


@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(part=st.floats(0.0, 1.0), zeros=st.booleans())
def test_a_file_cut_or_zeroed_anywhere_gives_all_that_came_before(bag: Path, part: float, zeros: bool) -> None:
    whole, data = messages(bag), mcap(bag).read_bytes()
    kept = int(part * len(data))
    data = data[:kept] + (bytes(len(data) - kept) if zeros else b"")
    with tempfile.TemporaryDirectory() as folder:
        source = damaged(Path(folder), data)
        left = before_the_damage(data, Path(folder))
        assert left == whole[: len(left)]
        if not left:
            with pytest.raises(BagError, match="nothing to recover" if data else "an empty file"):
                recover(source)
            assert not (Path(folder) / "flight-recovered").exists()
            return
        recovery = recover(source)
        assert messages(recovery.output) == left
        assert mcap(source).read_bytes() == data
        with Reader(recovery.output) as reader:
            assert sum(1 for _ in reader.messages()) == len(left)
        if len(left) < len(whole):
            assert not recovery.finished and "the file ends before its recording did" in recovery.describe()


@settings(max_examples=120, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_damage_anywhere_takes_the_chunks_that_it_hits_and_no_others(bag: Path, data: st.DataObject) -> None:
    whole, content = messages(bag), mcap(bag).read_bytes()
    with mcap(bag).open("rb") as stream:
        chunks = make_reader(stream).get_summary().chunk_indexes
    faults = data.draw(st.integers(1, 3), label="faults")
    places = sorted({data.draw(st.integers(8, len(content) - 1), label="at") for _ in range(faults)}, reverse=True)
    broken, hit = bytearray(content), set()
    for at in places:  # from the back, so that the places before keep theirs
        size = data.draw(st.integers(1, 64), label="size")
        match data.draw(st.sampled_from(["flip", "zero", "insert", "drop"]), label="fault"):
            case "flip":
                size = 1
                broken[at] ^= data.draw(st.integers(1, 255), label="xor")
            case "zero":
                broken[at : at + size] = bytes(len(broken[at : at + size]))
            case "insert":
                broken[at:at] = data.draw(st.binary(min_size=size, max_size=size), label="bytes")
            case "drop":
                del broken[at : at + size]
        for index, chunk in enumerate(chunks):
            if chunk.chunk_start_offset < at + size and at < chunk.chunk_start_offset + chunk.chunk_length:
                hit.add(index)
    counts = [sum(size // 16 for size in chunk_sizes(content, chunk)) for chunk in chunks]
    starts = np.concatenate([[0], np.cumsum(counts)])
    assert starts[-1] == len(whole)
    expected = [found for i in range(len(chunks)) if i not in hit for found in whole[starts[i] : starts[i + 1]]]
    with tempfile.TemporaryDirectory() as folder:
        source = damaged(Path(folder), bytes(broken))
        recovery = recover(source)
        found = messages(recovery.output)
        # A fault that changes nothing (a zero over a zero), or no byte that is read, spares the chunk that it hits.
        assert not Counter(expected) - Counter(found)
        assert not Counter(found) - Counter(whole)
        order = {found: index for index, found in enumerate(whole)}
        assert all(order[one] <= order[other] for one, other in pairwise(found))
        if len(found) < len(whole):
            assert recovery.gaps and all(gap.size for gap in recovery.gaps)


def chunk_sizes(content: bytes, chunk: object) -> list[int]:
    """Bytes of each index of messages behind a chunk: 16 for every message."""
    sizes, at = [], chunk.chunk_start_offset + chunk.chunk_length
    end = at + chunk.message_index_length
    while at < end:
        length = int.from_bytes(content[at + 1 : at + 9], "little")
        sizes.append(length - 6)
        at += 9 + length
    return sizes


def test_the_report_says_what_was_lost_and_when(bag: Path, tmp_path: Path) -> None:
    source = copy(bag, tmp_path)
    with mcap(bag).open("rb") as stream:
        chunk = make_reader(stream).get_summary().chunk_indexes[8]
    content = bytearray(mcap(source).read_bytes())
    content[chunk.chunk_start_offset + 200] ^= 0xFF
    mcap(source).write_bytes(content)
    recovery = recover(source)
    [gap] = recovery.gaps
    # from the damaged chunk to the next one: its bytes, and its index
    assert gap.size == chunk.chunk_length + chunk.message_index_length and not gap.index
    whole = messages(bag)
    assert gap.start == max(time for _, time, _ in whole[: 8 * 64]) and gap.end == whole[9 * 64][1]
    # metadata.yaml knows how many there were
    assert sum(topic.lost for topic in recovery.saved) == 64
    counts = Counter(topic for topic, _, _ in whole)
    assert {topic.topic: topic.count + topic.lost for topic in recovery.saved} == counts
    first = min(time for _, time, _ in whole)
    between = f"between {(gap.start - first) / 1e9:.3f} and {(gap.end - first) / 1e9:.3f} s"
    assert f"lost       {gap.size} damaged bytes {between}" in recovery.describe()
    flight = read(recovery.output)
    assert flight.metadata["recovered"]["damaged_bytes"] == gap.size and flight.simulated


def test_an_ordinary_bag_whose_first_chunk_is_damaged_finds_its_topics_in_the_index(tmp_path: Path) -> None:
    # as the library writes it: 14 000 messages in several chunks of 1 MiB, of which the first alone names the topics
    source = recover(write(tmp_path / "written", Numbers(frames=3000)), tmp_path / "flight").output
    content = bytearray(mcap(source).read_bytes())
    content[5000] ^= 0xFF
    mcap(source).write_bytes(content)
    recovery = recover(source)
    assert recovery.nameless == 0 and recovery.gaps[0].start is None
    assert "damaged bytes at the beginning" in recovery.describe()
    assert len(messages(recovery.output)) > 5000
    # Without the index at the end they are lost: said, and counted.
    mcap(source).write_bytes(content[: int(0.9 * len(content))])
    with pytest.raises(BagError, match="nothing to recover"):
        recover(source, tmp_path / "again")


# --- metadata ------------------------------------------------------------------------------------------------------


def test_without_metadata_yaml_the_copy_inside_the_file_speaks(bag: Path, tmp_path: Path) -> None:
    source = damaged(tmp_path, mcap(bag).read_bytes())
    for place in (source, mcap(source)):
        output = recover(place, tmp_path / f"again-{place.suffix}").output
        assert {**read(output).metadata, "recovered": None} == {**METADATA, "recovered": None}


def test_an_edited_origin_is_not_carried_over(bag: Path, tmp_path: Path) -> None:
    source = copy(bag, tmp_path)
    text = (source / "metadata.yaml").read_text()
    assert text.count('"simulated"') == 1
    (source / "metadata.yaml").write_text(text.replace('"simulated"', '"real"'))
    assert read(recover(source).output).simulated  # by the copy inside the file
    content = mcap(source).read_bytes()
    mcap(source).write_bytes(content[: content.index(b"serialized_metadata")])  # the copy is gone
    recovery = recover(source, tmp_path / "again")
    assert read(recovery.output).metadata["origin"] == "unknown"
    assert "origin     unknown" in recovery.describe()


def test_recovering_twice_keeps_the_history(bag: Path, tmp_path: Path) -> None:
    once = recover(bag, tmp_path / "once").output
    twice = read(recover(once, tmp_path / "twice").output)
    assert twice.metadata["recovered"]["from"] == "once"
    assert twice.metadata["recovered"]["before"]["from"] == "flight"
    assert same(read(bag), twice)


# --- bags of others ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("chunking", [True, False])
@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD])
def test_files_of_another_writer_come_back_too(tmp_path: Path, chunking: bool, compression: CompressionType) -> None:
    """Chunks of each compression, or none at all: messages that lie bare in the file."""
    source = tmp_path / "theirs.mcap"
    definition, _ = layouts.typestore().generate_msgdef(recording.POSE, ros_version=2)
    layout = layouts.Layout.of(recording.POSE, "world")
    with source.open("wb") as stream:
        writer = McapWriter(stream, chunk_size=2000, compression=compression, use_chunking=chunking)
        writer.start(profile="ros2", library="theirs")
        schema = writer.register_schema(recording.POSE, "ros2msg", definition.encode())
        other = writer.register_schema("custom/msg/Blob", "ros2msg", b"uint8[] data\nfloat64 level")
        channel = writer.register_channel("/quad", "cdr", schema)
        blob = writer.register_channel("/blob", "cdr", other)
        for i in range(200):
            row = (0.001 * i, 0, 1, 0, 0, 0, 1)
            writer.add_message(channel, log_time=i, publish_time=i, data=layout.encode(i, row))
            writer.add_message(blob, log_time=i, publish_time=i, data=bytes([0, 1, 0, 0]) + bytes(12))
        writer.finish()
    content = bytearray(source.read_bytes())
    assert recover(source, tmp_path / "whole").saved == (
        ("/blob", "custom/msg/Blob", 200, None),
        ("/quad", recording.POSE, 200, None),
    )
    if chunking:
        with source.open("rb") as stream:
            at = make_reader(stream).get_summary().chunk_indexes[4].chunk_start_offset + 60
    else:
        at = content.index(layout.encode(100, (0.1, 0, 1, 0, 0, 0, 1))) - 20  # in the head of the message
    content[at : at + 20] = bytes([0xFF]) * 20
    source.write_bytes(content)
    recovery = recover(source)
    # A chunk holds 2000 bytes: fewer than 20 messages of each kind.
    lost = {topic.topic: 200 - topic.count for topic in recovery.saved}
    assert 1 <= lost["/quad"] < 20 and lost["/blob"] < 20 if chunking else lost == {"/quad": 1, "/blob": 0}
    with Reader(recovery.output) as reader:
        for connection, time, data in reader.messages():
            if connection.topic == "/quad":
                assert data == layout.encode(time, (0.001 * time, 0, 1, 0, 0, 0, 1))
    assert len(recovery.gaps) == 1


def test_messages_of_an_uncompressed_chunk_before_the_damage_are_not_found_twice(tmp_path: Path) -> None:
    source = foreign(tmp_path / "theirs", poses("/quad", count=40))  # the library compresses nothing
    content = mcap(source).read_bytes()
    with mcap(source).open("rb") as stream:
        chunk = make_reader(stream).get_summary().chunk_indexes[0]
    end = chunk.chunk_start_offset + chunk.chunk_length
    mcap(source).write_bytes(content[:end] + bytes(3 << 20) + content[end:])
    recovery = recover(source)
    assert [topic.count for topic in recovery.saved] == [40] and recovery.gaps[0].size >= 3 << 20


def test_a_chunk_without_messages_is_no_damage(tmp_path: Path) -> None:
    with (tmp_path / "theirs.mcap").open("wb") as stream:
        writer = McapWriter(stream, compression=CompressionType.ZSTD)
        writer.start(profile="ros2", library="theirs")
        definition, _ = layouts.typestore().generate_msgdef(recording.POSE, ros_version=2)
        channel = writer.register_channel(
            "/quad", "cdr", writer.register_schema(recording.POSE, "ros2msg", definition.encode())
        )
        for i in range(3):
            writer.add_message(
                channel, i, layouts.Layout.of(recording.POSE, "world").encode(i, (0, 0, 1, 0, 0, 0, 1)), i
            )
        writer.finish()
    content = (tmp_path / "theirs.mcap").read_bytes()
    with (tmp_path / "theirs.mcap").open("rb") as stream:
        at = make_reader(stream).get_summary().chunk_indexes[0].chunk_start_offset
    empty = b"\x06" + (40).to_bytes(8, "little") + bytes(40)
    (tmp_path / "theirs.mcap").write_bytes(content[:at] + empty + content[at:])
    recovery = recover(tmp_path / "theirs.mcap")
    assert recovery.gaps == () and recovery.saved[0].count == 3


def test_a_bag_in_several_files_becomes_one(tmp_path: Path) -> None:
    early = foreign(tmp_path / "early", poses("/mocap/quad/pose") + poses("/mocap/pendulum/pose"))
    late = [(topic, kind, time + 10**9, data) for topic, kind, time, data in poses("/mocap/quad/pose")]
    late = foreign(tmp_path / "late", late)
    both = tmp_path / "both"
    both.mkdir()
    (both / "lab_0.mcap").write_bytes(mcap(early).read_bytes())
    (both / "lab_1.mcap").write_bytes(mcap(late).read_bytes()[:-50])
    recovery = recover(both)
    assert [(topic.topic, topic.count) for topic in recovery.saved] == [
        ("/mocap/pendulum/pose", 5),
        ("/mocap/quad/pose", 10),
    ]
    times = [time for _, time, _ in messages(recovery.output)]
    assert times[:10] != times[10:] and max(times[:10]) < min(times[10:])
    assert "unknown" in recovery.describe()


# --- errors and the command line -----------------------------------------------------------------------------------


def test_what_is_no_recording_is_one_clear_error(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("not a bag, whatever its name\n" * 1000)
    (tmp_path / "empty.mcap").write_bytes(b"")
    (tmp_path / "notes.mcap").write_text("not a bag either\n" * 1000)
    (tmp_path / "header.mcap").write_bytes(b"\x89MCAP0\r\n")
    for name, words in (
        ("notes.txt", "a text file, not a bag"),
        ("notes.mcap", "a text file, not a bag"),
        ("empty.mcap", "an empty file"),
        ("header.mcap", "no complete message"),
        ("gone", "no such file"),
    ):
        with pytest.raises(BagError, match=words) as caught:
            recover(tmp_path / name)
        assert str(tmp_path / name) in str(caught.value) and "\n" not in str(caught.value)
    (tmp_path / "folder").mkdir()
    with pytest.raises(BagError, match=r"no \.mcap and no \.db3 file"):
        recover(tmp_path / "folder")
    assert not list(tmp_path.glob("*-recovered"))


def test_nothing_is_overwritten_and_nothing_added_to_the_original(bag: Path, tmp_path: Path) -> None:
    source = copy(bag, tmp_path)
    (tmp_path / "taken").mkdir()
    with pytest.raises(BagError, match="exists already"):
        recover(source, tmp_path / "taken")
    with pytest.raises(BagError, match="lies inside"):
        recover(source, source / "new")
    assert sorted(file.name for file in source.iterdir()) == ["flight.mcap", "metadata.yaml"]
    assert list((tmp_path / "taken").iterdir()) == []


def test_the_command_recovers_and_reports(bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = damaged(tmp_path, mcap(bag).read_bytes()[:-9000])
    with pytest.raises(BagError, match=f"fip bag recover {source}"):
        run("info", source)
    assert run("recover", source, "--output", tmp_path / "new") == 0
    printed = capsys.readouterr().out
    assert f"recovered  {tmp_path / 'new'}" in printed and f"from       {source} (unchanged)" in printed
    assert run("info", tmp_path / "new") == 0
    assert "recovered  from flight" in capsys.readouterr().out
    with pytest.raises(BagError, match="exists already"):
        run("recover", source, "--output", tmp_path / "new")


def test_a_disk_that_is_full_while_recovering_leaves_no_half_bag(bag: Path, tmp_path: Path) -> None:
    code = "import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (20000, 20000))\n"
    code += "from fiplib import bags; bags.recover(*sys.argv[1:])"
    done = subprocess.run(
        [sys.executable, "-c", code, str(bag), str(tmp_path / "new")],
        capture_output=True,
        text=True,
        cwd=Path(__file__).parents[2],
    )
    said = done.stderr.splitlines()[-1]
    assert said.startswith("fiplib.recording.BagError: ") and "File too large" in said
    assert not (tmp_path / "new").exists()


# --- what is no damage, and damage of other kinds ----------------------------------------------------------------


def test_a_chunk_that_is_there_twice_is_saved_once(bag: Path, tmp_path: Path) -> None:
    content = mcap(bag).read_bytes()
    with mcap(bag).open("rb") as stream:
        chunk = make_reader(stream).get_summary().chunk_indexes[5]
    end = chunk.chunk_start_offset + chunk.chunk_length
    source = damaged(tmp_path, content[:end] + content[chunk.chunk_start_offset : end] + content[end:])
    recovery = recover(source)
    assert messages(recovery.output) == messages(bag)
    assert recovery.repeated == 64 and "64 messages that were there twice" in recovery.describe()
    assert not recovery.undamaged


def test_a_copy_of_a_file_beside_it_is_not_of_the_recording(bag: Path, tmp_path: Path) -> None:
    source = copy(bag, tmp_path)
    for name in ("flight (copy).mcap", "other_0.mcap"):
        (source / name).write_bytes(mcap(source).read_bytes())
    assert messages(recover(source).output) == messages(bag)
    (source / "metadata.yaml").unlink()
    assert messages(recover(source, tmp_path / "again").output) == messages(bag)


def test_messages_compressed_one_by_one_come_back_but_the_damaged_ones(tmp_path: Path) -> None:
    sent = poses("/mocap/quad/pose", count=200)
    source = foreign(tmp_path / "lab", sent, compression=CompressionMode.MESSAGE)
    content = bytearray(mcap(source).read_bytes())
    at = content.index(layouts.ZSTD, len(content) // 3)
    content[at + 5] ^= 0xFF  # the chunk around it carries no checksum
    mcap(source).write_bytes(content)
    recovery = recover(source)
    assert {data for _, _, data in messages(recovery.output)} <= {data for *_, data in sent}
    assert sum(topic.count for topic in recovery.saved) == 199 and recovery.unreadable == 1
    assert "1 messages that were compressed one by one and are damaged" in recovery.describe()


def test_a_file_compressed_as_a_whole_and_cut_gives_what_came_before(tmp_path: Path) -> None:
    source = foreign(tmp_path / "lab", poses("/mocap/quad/pose", count=20000), compression=CompressionMode.FILE)
    [file] = source.glob("*.mcap.zstd")
    file.write_bytes(file.read_bytes()[:-1000])
    (source / "metadata.yaml").unlink()
    recovery = recover(source)
    assert 5000 < recovery.saved[0].count < 20000 and not recovery.finished


def other_profile(path: Path, profile: str, encoding: str, message: str = "json") -> Path:
    with path.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start(profile=profile, library="theirs")
        channel = writer.register_channel("/pose", message, writer.register_schema("Pose", encoding, b"{}"))
        for i in range(3):
            writer.add_message(channel, i, b"{}", i)
        writer.finish()
    return path


def test_damaged_is_said_of_what_is_damaged_alone(bag: Path, tmp_path: Path) -> None:
    """Sound files of other kinds are named for what they are, by info and by recover."""
    (tmp_path / "lab.bag").write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    (tmp_path / "state.json").write_text('{"length": 1.0}')
    (tmp_path / "table.mcap").write_text("time,x,y\n0,1,2\n")
    (tmp_path / "log.ulg").write_bytes(b"ULog\x01\x12\x35\x01" + bytes(100))
    other_profile(tmp_path / "foxglove.mcap", "", "jsonschema")
    other_profile(tmp_path / "ros1.mcap", "ros1", "ros1msg", "ros1")
    database = foreign(tmp_path / "database", poses("/quad"), StoragePlugin.SQLITE3)
    for path, read_says, recover_says in (
        ("lab.bag", "a bag of ROS 1; convert it", "a bag of ROS 1; convert it"),
        ("state.json", "a JSON file, not a bag", "a JSON file, not a bag"),
        ("table.mcap", "a text file, not a bag", "a text file, not a bag"),
        ("log.ulg", r"a PX4 log \(ULog\), not a bag", r"a PX4 log \(ULog\), not a bag"),
        ("foxglove.mcap", "an MCAP file of no profile, not of ROS 2", "its messages are json, not ROS 2"),
        ("ros1.mcap", "an MCAP file of the profile 'ros1', not of ROS 2", "its messages are ros1, not ROS 2"),
        (database.name, "no topic", "a sqlite3 bag, and recover mends MCAP alone.*fip bag info"),
    ):
        for task, words in ((read, read_says), (recover, recover_says)):
            with pytest.raises(BagError, match=words) as caught:
                task(tmp_path / path)
            said = str(caught.value).replace(str(tmp_path), "")
            assert "damaged" not in said and "\n" not in said, (path, task)
    assert not list(tmp_path.glob("*-recovered"))


def test_ros_2_topics_beside_others_are_saved_and_the_others_named(tmp_path: Path) -> None:
    definition, _ = layouts.typestore().generate_msgdef(recording.POSE, ros_version=2)
    layout = layouts.Layout.of(recording.POSE, "world")
    source = tmp_path / "mixed.mcap"
    with source.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start(profile="ros2", library="theirs")
        quad = writer.register_channel(
            "/q", "cdr", writer.register_schema(recording.POSE, "ros2msg", definition.encode())
        )
        note = writer.register_channel("/note", "json", writer.register_schema("Note", "jsonschema", b"{}"))
        for i in range(10):
            writer.add_message(quad, i, layout.encode(i, (0, 0, 1, 0, 0, 0, 1)), i)
            writer.add_message(note, i, b"{}", i)
        writer.finish()
    with pytest.raises(BagError, match=r"some of its topics are no ROS 2 messages \(jsonschema\).*fip bag recover"):
        read(source)
    recovery = recover(source)
    assert recovery.nameless == 10 and [tuple(topic[::2]) for topic in recovery.saved] == [("/q", 10)]


def test_a_users_mistake_is_one_line_and_overwrites_nothing(bag: Path, tmp_path: Path) -> None:
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken.png").write_text("mine")
    for arguments in (
        ("cut", bag, "--output", tmp_path / "taken"),
        ("cut", bag, "--from", "nan"),
        ("cut", bag, "--to", "inf"),
        ("cut", tmp_path / "gone"),
        ("recover", bag, "--output", tmp_path / "taken"),
        ("recover", tmp_path / "taken"),
        ("export", bag, "--to", tmp_path / "taken.png"),
        ("length", bag, "--plot", tmp_path / "taken.png"),
        ("length", bag, "--plot", tmp_path / "new.gif"),
        ("length", bag, "--plot", tmp_path / "nowhere" / "new.png"),
    ):
        done = subprocess.run(
            [sys.executable, "-m", "fiplib", "bag", *map(str, arguments)],
            capture_output=True,
            text=True,
            cwd=Path(__file__).parents[2],
        )
        assert done.returncode == 2 and done.stdout == "", arguments
        assert done.stderr.startswith("fip: ") and done.stderr.count("\n") == 1, (arguments, done.stderr)
    assert (tmp_path / "taken.png").read_text() == "mine" and not list((tmp_path / "taken").iterdir())
    assert {path.name for path in tmp_path.iterdir()} == {"taken", "taken.png"}
