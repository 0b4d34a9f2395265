"""A bag takes the place of an old one when it is whole, and of nothing but a bag."""

from pathlib import Path

import pytest

from fiplib import bags
from fiplib.bags.replacing import NewBag, is_finished_bag
from fiplib.recording import BagError

METADATA = {"origin": "simulated"}


def recorded(path: Path, length: float = 1.0) -> Path:
    with bags.BagRecorder(path, METADATA) as recorder:
        recorder.numbers("truth_length", 1, [length])
    return path


def contents(folder: Path) -> dict[str, bytes | None]:
    return {str(p.relative_to(folder)): p.read_bytes() if p.is_file() else None for p in folder.rglob("*")}


def unfinished(path: Path) -> None:
    (recorded(path) / "metadata.yaml").unlink()


def with_a_file_more(path: Path) -> None:
    (recorded(path) / "notes.yaml").write_text("mine")


def with_a_folder_more(path: Path) -> None:
    (recorded(path) / "x.yaml").mkdir()


def without_its_file(path: Path) -> None:
    (recorded(path) / f"{path.name}.mcap").rename(path / "renamed.mcap")


def with_a_link(path: Path) -> None:
    recorded(path)
    (path / f"{path.name}.mcap").rename(path.parent / "elsewhere.mcap")
    (path / f"{path.name}.mcap").symlink_to(path.parent / "elsewhere.mcap")


def a_link(path: Path) -> None:
    path.symlink_to(recorded(path.parent / "elsewhere"))


def a_broken_link(path: Path) -> None:
    path.symlink_to(path.parent / "nowhere")


def a_file(path: Path) -> None:
    path.write_text("mine")


def an_empty_folder(path: Path) -> None:
    path.mkdir()


def yaml_files_alone(path: Path) -> None:
    path.mkdir()
    (path / "settings.yaml").write_text("mine: true")
    (path / "x.yaml").mkdir()


def other_metadata(path: Path) -> None:
    path.mkdir()
    (path / "metadata.yaml").write_text("author: me")
    (path / "film.mcap").write_text("mine")


def damaged_metadata(path: Path) -> None:
    (recorded(path) / "metadata.yaml").write_text("]")


def metadata_that_names_files_elsewhere(path: Path) -> None:
    metadata = recorded(path) / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace(f"{path.name}.mcap", "../thesis.mcap"))
    (path.parent / "thesis.mcap").write_text("years of work")


NO_BAGS = (
    unfinished, with_a_file_more, with_a_folder_more, without_its_file, with_a_link, a_link, a_broken_link, a_file,
    an_empty_folder, yaml_files_alone, other_metadata, damaged_metadata, metadata_that_names_files_elsewhere,
)  # fmt: skip


@pytest.mark.parametrize("make", NO_BAGS)
def test_what_is_no_finished_bag_alone_in_its_folder_is_not_replaced(tmp_path, make):
    make(tmp_path / "mine")
    before = contents(tmp_path)
    with pytest.raises(BagError, match="mine exists and is not a finished bag"), NewBag(tmp_path / "mine", force=True):
        pytest.fail("entered")
    assert contents(tmp_path) == before


def test_a_finished_bag_is_replaced_at_the_end_and_not_before(tmp_path):
    old = contents(recorded(tmp_path / "mine"))
    assert is_finished_bag(tmp_path / "mine")
    with NewBag(tmp_path / "mine", force=True) as bag:
        recorded(bag.path, 2.0)
        bag.begun = bag.flown = True
        assert contents(tmp_path / "mine") == old and bag.path.name == "mine"
    assert bag.left == "" and [entry.name for entry in tmp_path.iterdir()] == ["mine"]
    new = contents(tmp_path / "mine")
    assert new.keys() == old.keys() and new["mine.mcap"] != old["mine.mcap"] and is_finished_bag(tmp_path / "mine")


def test_a_flight_that_fails_leaves_the_old_bag_and_says_where_the_new_one_is(tmp_path):
    old = contents(recorded(tmp_path / "mine"))
    bag = NewBag(tmp_path / "mine", force=True)
    with pytest.raises(RuntimeError, match="crash"), bag:
        recorded(bag.path)
        bag.begun = bag.flown = True
        raise RuntimeError("crash")
    assert contents(tmp_path / "mine") == old and is_finished_bag(bag.path)
    assert bag.left == f"{tmp_path / 'mine'} stays as it was; what was recorded of this flight is in {bag.path}"


@pytest.mark.parametrize("begun", [False, True])
def test_where_nothing_was_flown_the_old_bag_stays_and_nothing_else(tmp_path, begun):
    old = contents(recorded(tmp_path / "mine"))
    with NewBag(tmp_path / "mine", force=True) as bag:
        recorded(bag.path)
        bag.begun = begun
    assert contents(tmp_path / "mine") == old and [entry.name for entry in tmp_path.iterdir()] == ["mine"]
    assert bag.left == f"{tmp_path / 'mine'} stays as it was: nothing was flown"


def test_without_an_old_bag_one_that_has_begun_stays_and_one_that_has_not_goes(tmp_path):
    for begun in (False, True):
        with NewBag(tmp_path / "mine", force=begun) as bag:
            recorded(bag.path)
            bag.begun = begun
        assert bag.path == tmp_path / "mine" and bag.path.exists() is begun


def test_a_folder_that_cannot_be_written_is_named(tmp_path, monkeypatch):
    recorded(tmp_path / "mine")

    def refused(*_: object, **__: object) -> str:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("tempfile.mkdtemp", refused)
    with pytest.raises(BagError, match="cannot record beside it"), NewBag(tmp_path / "mine", force=True):
        pytest.fail("entered")
