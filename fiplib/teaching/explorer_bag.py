"""The part of the page that chooses a bag: its path, its topics, what speaks against it and what mends that."""

import html
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import ipywidgets as widgets

from fiplib import bags
from fiplib.bags.checks import Finding, findings
from fiplib.bags.convert import convert
from fiplib.bags.files import files_of
from fiplib.bags.roles import choices, chosen
from fiplib.bags.sources import opened
from fiplib.recording import Flight
from fiplib.teaching.explorer_widgets import (
    PROBLEMS,
    Progress,
    box,
    button,
    folded,
    free,
    problem,
    row,
    said,
    sized,
    text,
)

RECORDINGS = (".mcap", ".db3", ".zstd", ".bag", ".csv")
"""Endings of the files that the browser of folders offers."""

UP = "↑ folder above"

ROLES = {"vehicle": "vehicle", "pendulum": "rod", "command": "commands"}
"""The menus of topics, and their labels."""

_ORIGINS = {"simulated": "simulated, no real vehicle", "real": "a real flight", "unknown": "of unknown origin"}


class Chooser:
    """Widgets that read a bag, and what they do; a problem is text in the page (``message``).

    ``taken`` is called with each flight that was read and the bar of progress, which is shown until it returns; it
    calls ``show`` when the page has let go of the flight before.
    ``folder`` is browsed first; new bags are written into the folder that ``output`` names. ``flight`` was read last,
    or None, with the keyword arguments ``reading`` of ``bags.read``; ``against`` is what speaks against it.
    """

    def __init__(self, folder: Path, output: widgets.Text, taken: Callable[[Flight, Progress], None]) -> None:
        self.flight: Flight | None = None
        self.reading: dict[str, Any] = {}
        self.against: list[Finding] = []
        self._output, self._taken, self._filling = output, taken, False
        self._path: Path | None = None
        self._request: tuple | None = None
        self.path = text("", "path", "folder of a ROS 2 bag, or an .mcap or .db3 file", "420px")
        self.load = button("Load", width="90px")
        self.browser = widgets.Select(rows=8, layout=widgets.Layout(width="560px", max_width="100%"))
        self.browser.add_class("fip-browser")
        self.topics = {role: widgets.Dropdown(**sized(label, "340px")) for role, label in ROLES.items()}
        self.message, self.written = said("message"), said("written")
        self.found = widgets.VBox()
        self.found.add_class("fip-findings")
        self.recover = button(
            "Recover", False, tooltip="write what is left of a damaged bag into a new one, and load it"
        )
        self.convert = button(
            "Convert", False, tooltip="write a CSV file or a bag of ROS 1 into a new bag, and load it"
        )
        self.progress = Progress()
        folders = widgets.Accordion(children=[self.browser], titles=("Browse folders",))
        names = widgets.Accordion(children=[row(*self.topics.values())], titles=("Topics",))
        paths = row(self.path, self.load, self.recover, self.convert)
        self.parts = paths, folders, names, self.progress, self.message, self.found, self.written
        self.browse(folder)
        self._fill({})
        self.path.observe(self.read, "value")
        self.load.on_click(self.read)
        self.browser.observe(self._browsed, "value")
        self.recover.on_click(lambda _: self._anew("recovered", "recovering", bags.recover))
        self.convert.on_click(lambda _: self._anew("converted", "converting", convert))
        for menu in self.topics.values():
            menu.observe(self._renamed, "value")

    def open(self, path: Path) -> None:
        """Read the bag at a path, as if it had been typed."""
        self.path.value = str(path)
        self.read()

    def read(self, *_: object) -> None:
        """Read the bag of the path as ``reading`` says, unless just that was done last; keep the flight on a problem.

        A page reports that a field was left, and the press of a button that left it: only one of them reads.
        """
        if not (name := self.path.value.strip()):
            self.message.value = problem("Give the path of a bag, or choose one under Browse folders.")
            return
        path = Path(name).expanduser()
        if path != self._path:
            self._path, self.reading, self.written.value = path, {}, ""
        try:
            if path.is_dir() and not _holds_a_bag(path):
                self.browse(path)
                self.message.value = problem(f"{path}: a folder without a bag; choose one under Browse folders.")
                return
            request = path, repr(self.reading), _changed(path)
            if request != self._request:
                self._request = request
                with self.progress:
                    self._read(path)
        except PROBLEMS as error:
            self._refuse(error)

    def apply(self, cure: dict[str, Any]) -> None:
        """Read the bag again, with what mends it."""
        self.reading = self.reading | cure
        self.read()

    def browse(self, folder: Path) -> None:
        """List the folders and recordings in a folder."""
        folder = folder.expanduser().resolve()
        try:
            inside = sorted(path for path in folder.iterdir() if not path.name.startswith("."))
        except OSError as error:
            self._refuse(error)
            return
        shown = [path for path in inside if path.is_dir() or path.suffix in RECORDINGS]
        self._filling = True
        self.browser.options = [
            (f"{UP}: {folder.parent}", folder.parent),
            *((f"{path.name}/" if path.is_dir() and not _holds_a_bag(path) else path.name, path) for path in shown),
        ]
        self.browser.value = None
        self._filling = False

    def cut(self, start: float, end: float) -> None:
        """Write a stretch, in s since the start of the flight, into a new bag, and say where."""
        if self.flight is None:
            return
        path, topics = self.flight.path, chosen(self.flight)
        self._write(lambda: bags.cut(path, self._new(path, "cut"), start, end, topics).describe(), "cutting")

    # --- what happens

    def _read(self, path: Path) -> None:
        self.progress.say(f"looking into {path.name}", 0.05)
        offered: dict[str, list[str]] = {}
        with suppress(Exception), opened(path) as source:  # damage is found, and named, where the bag is read
            offered = choices(source)
        self._fill(offered)
        self.progress.say(f"reading {path.name}", 0.1)
        flight = bags.read(path, **self.reading)
        self.progress.say("checking frames, units and clocks", 0.2)
        self.against = findings(flight)
        self.flight = flight
        self._fill(offered, chosen(flight))
        self._taken(flight, self.progress)

    def _refuse(self, error: Exception) -> None:
        still = "" if self.flight is None else f"\nThe page still shows {self.flight.path.name}."
        self.message.value = problem(f"{error}{still}")

    def show(self, flight: Flight) -> None:
        """Say what was read, and list what speaks against it, each with a button where something mends it."""
        counts = f"{len(flight.vehicle.stamp)} poses of the vehicle, {len(flight.pendulum.stamp)} of the rod"
        commands = "no commands" if flight.command is None else f"{len(flight.command.stamp)} commands"
        self.message.value = box(
            f"<b>{html.escape(flight.path.name)}</b>: {_ORIGINS[flight.metadata['origin']]}; {flight.duration:.1f} s, "
            f"{counts}; {commands}{folded('how it was read', flight.notes)}"
        )
        lines = []
        for finding in self.against:
            words = problem(finding.sentence)
            lines.append(_beside(words, self._button("Apply", finding.cure)) if finding.cure else widgets.HTML(words))
        cures: dict[str, Any] = {}
        for finding in self.against:
            cures |= finding.cure
        if sum(bool(finding.cure) for finding in self.against) > 1:
            lines.append(self._button("Apply all", cures))
        if self.reading:
            back = button("Read as recorded", False, "150px")
            back.on_click(self._as_recorded)
            lines.append(_beside(box(f"Read with {html.escape(_words(self.reading))}."), back))
        self.found.children = lines

    def _button(self, name: str, cure: dict[str, Any]) -> widgets.Button:
        apply = button(name, width="90px", tooltip=f"read the bag again with {_words(cure)}")
        apply.on_click(lambda _: self.apply(cure))
        return apply

    def _as_recorded(self, *_: object) -> None:
        self.reading = {}
        self.read()

    def _fill(self, offered: dict[str, list[str]], taken: dict[str, str] | None = None) -> None:
        """Fill the menus of topics; ``taken`` are chosen there."""
        self._filling = True
        for role, menu in self.topics.items():
            menu.options = [
                ("none" if role == "command" else "choose", ""),
                *((name, name) for name in offered.get(role, ())),
            ]
            now = (taken or {}).get(role, self.reading.get("topics", {}).get(role, ""))
            menu.value = now if now in offered.get(role, ()) else ""
        self._filling = False

    def _renamed(self, *_: object) -> None:
        if not self._filling and self._path is not None:
            names = {role: menu.value for role, menu in self.topics.items() if menu.value}
            # the menus say which body is which: no more to be swapped
            self.reading = {key: value for key, value in self.reading.items() if key != "swap"} | {"topics": names}
            self.read()

    def _browsed(self, *_: object) -> None:
        path = self.browser.value
        if self._filling or path is None:
            return
        if path.is_dir() and not _holds_a_bag(path):
            self.browse(path)
        else:
            self.open(path)

    def _anew(self, suffix: str, doing: str, write: Callable[[Path, Path], Any]) -> None:
        """Write a new bag out of the path's recording, and load it."""
        if not (name := self.path.value.strip()):
            self.message.value = problem("Give the path of a recording first.")
            return
        source = Path(name).expanduser()
        output = self._new(source, suffix)

        def work() -> str:
            made = write(source, output)
            return made if isinstance(made, str) else made.describe()

        if self._write(work, doing):
            words = self.written.value
            self.open(output)
            self.written.value = words

    def _new(self, source: Path, suffix: str) -> Path:
        """Where a new bag is written to."""
        name = source.stem if source.is_file() else source.resolve().name
        return free(Path(self._output.value.strip() or ".").expanduser(), f"{name}-{suffix}")

    def _write(self, work: Callable[[], str], doing: str) -> bool:
        with self.progress:
            self.progress.say(doing, 0.3)
            try:
                Path(self._output.value.strip() or ".").expanduser().mkdir(parents=True, exist_ok=True)
                self.written.value = box(f"<pre style='margin: 0'>{html.escape(work())}</pre>")
            except PROBLEMS as error:
                self.written.value = problem(error)
                return False
        return True


def _holds_a_bag(folder: Path) -> bool:
    """Whether a folder is one recording; without metadata.yaml, its files are of one name."""
    with suppress(*PROBLEMS):
        return (folder / "metadata.yaml").exists() or bool(files_of(folder, {}))
    return False


def _changed(path: Path) -> int:
    """When a recording was changed last, ns; 0 if it is not there."""
    files = [path, *path.iterdir()] if path.is_dir() else [path] if path.exists() else []
    return max((file.stat().st_mtime_ns for file in files), default=0)


def _beside(words: str, press: widgets.Button) -> widgets.HBox:
    """Words that leave room for a button to the right."""
    place = widgets.HTML(words, layout=widgets.Layout(max_width="680px", flex="0 1 auto"))
    return widgets.HBox([place, press], layout=widgets.Layout(align_items="center", grid_gap="14px"))


def _words(reading: dict[str, Any]) -> str:
    """Keyword arguments of ``bags.read`` in words."""

    def one(key: str, value: Any) -> str:
        inner = ", ".join(f"{name} {entry}" for name, entry in value.items()) if isinstance(value, dict) else value
        fixed = {"swap": "bodies swapped", "topics": "topics as chosen in the menus"}
        return fixed.get(key, f"{key} {inner}")

    return "; ".join(one(key, value) for key, value in reading.items())
