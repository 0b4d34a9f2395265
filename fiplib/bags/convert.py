"""Recordings of other kinds -> a new ROS 2 bag: CSV files of motion capture, and bags of ROS 1."""

import contextlib
import io
import tempfile
from collections.abc import Sequence
from pathlib import Path

from rosbags.convert import ConverterError
from rosbags.convert import convert as convert_ros1

from fiplib.bags import guards
from fiplib.bags.csv_files import NOTHING, Stated, from_csv
from fiplib.bags.files import is_ros1, suggestion
from fiplib.recording import BagError


def convert(source: Path, output: Path | None = None, stated: Stated = NOTHING) -> str:
    """Convert a recording into a new bag, and return what was done, in lines. The source is only read.

    Args:
        source: a CSV file, or a bag of ROS 1.
        output: directory of the new bag; None is the source without its suffix.
        stated: what is known of a CSV file.

    Raises:
        BagError: the source cannot be converted, or the output exists; nothing is left behind then.
    """
    guards.recording(source)
    if source.is_dir() or source.suffix in (".mcap", ".db3", ".zstd"):
        raise BagError(
            f"{source}: not a CSV file nor a bag of ROS 1; a ROS 2 bag is read as it is: fip bag info {source}"
        )
    output = source.with_suffix("") if output is None else output
    if output.exists() or output.suffix == ".bag":
        why = "exists already" if output.exists() else "a ROS 2 bag is a directory, without .bag at its end"
        raise BagError(f"{output}: {why}; choose another path: {suggestion(source)} --output NEW")
    ros1 = is_ros1(source)
    if ros1 and any(value is not None for value in stated):
        raise BagError(f"{source}: a bag of ROS 1 takes none of the options for CSV files")
    try:
        with tempfile.TemporaryDirectory(prefix=".converting-", dir=output.parent) as folder:
            bag = Path(folder) / output.name  # the bag appears whole, or not at all
            notes = _from_ros1(source, bag) if ros1 else from_csv(source, bag, stated)
            bag.rename(output)
    except OSError as error:
        raise BagError(f"{output}: cannot convert {source} ({error.strerror or error})") from error
    lines = [f"{'bag':<10} {output}", f"{'from':<10} {source} (unchanged)", f"{'origin':<10} unknown"]
    lines += [f"{'' if index else 'assumed':<10} {note}" for index, note in enumerate(notes)]
    return "\n".join([*lines, f"{'next':<10} fip bag length {output}"])


def _from_ros1(source: Path, bag: Path) -> Sequence[str]:
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # the library reports every type that it migrates
            convert_ros1([source], bag, "mcap", 8, "zstd", "storage", None, None, (), (), (), ())
    except (ConverterError, AssertionError) as error:
        words = " ".join(str(error).split())[:300] or "its messages do not fit their types"
        raise BagError(f"{source}: a bag of ROS 1 that cannot be converted ({words})") from error
    return ()
