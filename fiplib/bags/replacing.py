"""A new bag in the place of an old one, which stays until the new one is whole."""

import shutil
import tempfile
from pathlib import Path
from typing import Any, Self

from fiplib.bags.files import information_of, named_files
from fiplib.recording import BagError


class NewBag:
    """Makes room for a bag at ``output``; a context manager.

    Where ``force`` allows it and a finished bag is there already, the flight is recorded beside it, to ``path``; the
    new bag takes the old one's place on leaving, if the vehicle has ``flown`` and nothing was raised. Otherwise the old
    bag stays as it was, and the new one, if a flight has ``begun``, beside it: ``left`` says so.

    Raises:
        BagError: on entering, there is something at ``output`` that may not be replaced. Nothing is deleted.
    """

    def __init__(self, output: Path, force: bool) -> None:
        self.output = self.path = output
        self._force = force
        self._beside: Path | None = None
        self.begun = self.flown = False
        self.left = ""

    def __enter__(self) -> Self:
        output = self.output
        self._absent = not (output.exists() or output.is_symlink())
        if self._force and not self._absent:
            if not is_finished_bag(output):
                raise BagError(
                    f"{output} exists and is not a finished bag alone in its folder: choose another path, or move it "
                    "away (nothing was deleted)"
                )
            try:
                self._beside = Path(
                    tempfile.mkdtemp(prefix=f"{output.resolve().name}.new-", dir=output.resolve().parent)
                )
            except OSError as error:
                raise BagError(f"{output}: cannot record beside it ({error.strerror}); choose another path") from error
            self.path = self._beside / output.resolve().name
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: Any) -> None:
        if self._beside is None:
            if not self.begun and self._absent:
                shutil.rmtree(self.output, ignore_errors=True)
        elif self.flown and kind is None:
            old = self._beside / "replaced"
            self.output.rename(old)
            self.path.rename(self.output)
            shutil.rmtree(self._beside)
        elif self.flown and self.path.exists():
            self.left = f"{self.output} stays as it was; what was recorded of this flight is in {self.path}"
        else:
            self.left = f"{self.output} stays as it was: nothing was flown"
            shutil.rmtree(self._beside)


def is_finished_bag(path: Path) -> bool:
    """Return whether a path is a folder with a bag and nothing else: a metadata.yaml, and the files that it names."""
    if path.is_symlink() or not path.is_dir():
        return False
    try:
        named = named_files(information_of(path))
    except Exception:  # whatever YAML raises where metadata.yaml is damaged, or is none
        return False
    entries = list(path.iterdir())
    files = all(entry.is_file() and not entry.is_symlink() for entry in entries)
    return files and bool(named) and {entry.name for entry in entries} == {"metadata.yaml", *named}
