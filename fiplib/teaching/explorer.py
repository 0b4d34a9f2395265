"""The page that explores a bag: read any recording, get its rod's length, scrub a window, compare estimators, export.

``Explorer`` holds the widgets and what happens when they are moved; its panels are displayed by the notebook
``07-explore-a-bag``. ``explorer_bag`` reads, ``explorer_fits`` computes, ``explorer_plots`` draws.
"""

import csv
import html
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import ipywidgets as widgets
import numpy as np

from fiplib import bags, kalman, replay
from fiplib.estimators import ESTIMATORS
from fiplib.estimators.poses.knowledge import Knowledge
from fiplib.params import Params
from fiplib.recording import Flight
from fiplib.reproduction import length_figure
from fiplib.teaching.explorer_bag import Chooser
from fiplib.teaching.explorer_fits import compare, fit_window, stated
from fiplib.teaching.explorer_plots import Picture, WindowFit, draw_flight, draw_refit, draw_space, image_of
from fiplib.teaching.explorer_widgets import (
    PROBLEMS,
    Panel,
    Progress,
    box,
    button,
    folded,
    number,
    problem,
    row,
    said,
    sized,
    table,
    text,
)

if TYPE_CHECKING:  # compiled code: half a second to import
    from fiplib.estimators.poses.estimate import PoseEstimate
    from fiplib.estimators.poses.history import History, Stretch

PERIODS = {"1/120": 1 / 120, "1/60": 1 / 60, "1/30": 1 / 30, "0.05": 0.05, "0.1": 0.1, "0.2": 0.2}
"""Sampling periods in s that are offered, all whole numbers of control ticks at 120 Hz."""

STEPS = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
"""Steps of the slider in s; the first is taken of which a flight has at most a thousand."""

RECOMMENDED = "poses"
"""The recommended estimator in the table of results: ``replay.estimate``, which needs the two bodies alone."""

ARRAYS = {"NPZ": ".npz", "CSV": ".csv", "no arrays": ""}
"""What can be exported beside pictures and results."""

STALE = "<div style='color: #666666; padding: 2px 14px'>The settings have changed since: press Refit.</div>"


class Explorer:
    """Widgets, and what they do. Problems with a bag or a setting are text in the page (``message``, ``answer``).

    Folders are browsed from ``data``, whose bag ``first`` is shown first; ``export`` is the folder to write to, unless
    the page says another.

    ``flight`` is shown, or None; ``whole`` is the recommended estimate from all of it, ``windows`` are its estimates
    from parts, ``refits`` the genetic algorithm's of this flight, in order; ``rows`` is the table of results, one
    dictionary per estimate, lengths in m, times in s; ``written`` are the files of the last export by what they show.
    ``choose, look, fit, history, rivals, save`` are panels to be displayed; ``chooser`` reads the bags.
    """

    def __init__(self, data: Path, export: Path, first: str = "estimate-1.4") -> None:
        self.flight: Flight | None = None
        self.whole: PoseEstimate | None = None
        self.refits: list[WindowFit] = []
        self.windows: list[Stretch] = []
        self.rows: list[dict[str, Any]] = []
        self.written: dict[str, Path] = {}
        self._shrunk: History | None = None
        self._window: Stretch | None = None
        self._make_widgets(export)
        self.chooser = Chooser(Path(data), self.folder, self.take)
        self.message = self.chooser.message
        self._make_panels()
        self._connect()
        if (Path(data) / first).exists():
            self.chooser.open(Path(data) / first)
        else:
            self.chooser.read()

    # --- what happens

    def take(self, flight: Flight, progress: Progress) -> None:
        """Show a flight that was read: its length first, then the pictures."""
        self.flight = None  # nothing is drawn while the slider adapts
        self._set_span(flight)
        self.refits, self.rows, self.windows, self._shrunk, self._window = [], [], [], None, None
        self.compared.value = self.exported.value = self.answer.value = self.parts.value = ""
        self.length.value = ""
        self.over_windows.value = b""
        self.over_windows.layout.display = "none"
        self.chooser.show(flight)
        from fiplib.estimators.poses import history

        advance = progress.parts("estimating the length from the whole flight", 0.3, 0.6)
        # as replay.estimate, which shows no progress
        self.whole = history.length_of_flight(flight, Knowledge.of_flight(flight), advance=advance).answer
        self.flight = flight
        self._add_row(RECOMMENDED, self.whole, (0.0, flight.duration))
        self._show_length()
        progress.say("deriving the states", 0.6)
        self.flight = flight = replace(flight, state=replay.states(flight))
        progress.say("drawing", 0.8)
        self.draw()
        progress.say("estimating the length from the window", 0.9)
        self.press_refit()

    def draw(self, *_: object) -> None:
        """Bring the two views of the flight up to date."""
        if self.flight is not None:
            draw_flight(self.over_time.figure, self.flight, self.span.value, self.zoom.value)
            draw_space(self.in_space.figure, self.flight, self.span.value)
            self.over_time.show()
            self.in_space.show()

    def press_refit(self, *_: object) -> None:
        """Estimate the length from the window: from the poses alone, and by the genetic algorithm."""
        if self.flight is None:
            return
        from fiplib.estimators.poses import history

        self._window = history.between(self.flight, *self.span.value, Knowledge.of_flight(self.flight))
        self._add_row(RECOMMENDED, self._window.found, self.span.value)
        why = None
        try:
            window, params = replay.window_between(self.flight, *self.span.value, self._settings())
            result = fit_window(window, params, self.seed.value)
            self.refits.append(result)
            self._add_row("ga", stated(result), self.span.value, params, len(self.refits), result.best)
        except PROBLEMS as error:
            why = str(error).removeprefix(f"{self.flight.path}: ")
        self._show_refits(why)
        self._show_length()

    def press_history(self, *_: object) -> None:
        """Estimate windows that follow each other, and how the interval of the whole flight shrank; draw both."""
        if self.flight is None:
            return
        from fiplib.estimators.poses import history

        flight, knowledge = self.flight, Knowledge.of_flight(self.flight)
        with self.progress:
            advance = self.progress.parts("the whole flight", 0.0, 0.5)
            self._shrunk = history.length_of_flight(flight, knowledge, history.POINTS, advance)
            advance = self.progress.parts("windows", 0.5, 1.0)
            self.windows = list(history.windows(flight, knowledge, advance=advance))
        self.over_windows.value = image_of(length_figure.length_figure(flight, self.windows, self._shrunk))
        self.over_windows.layout.display = None
        for one in self.windows:
            self._add_row(RECOMMENDED, one.found, (one.start, one.end))
        lines = [
            (f"{one.start:.1f} to {one.end:.1f}", *_length_cells(one.found), one.found.reason or "")
            for one in self.windows
        ]
        self.parts.value = table(("window (s)", "length (m)", "95 % interval (m)", ""), lines)

    def press_compare(self, *_: object) -> None:
        """Give the window to every estimator; rows appear as they are done."""
        if self.flight is None:
            return
        try:
            window, params = replay.window_between(self.flight, *self.span.value, self._settings())
        except PROBLEMS as error:
            self.compared.value = problem(error)
            return
        lines: list[tuple[str, ...]] = []
        for name, found, seconds in compare(self.flight, window, *self.span.value, params, self.seed.value):
            sigma = found.standard_deviation
            shown = (number(found.length, ".4f"), number(2 * sigma, ".3f"), f"{1000 * seconds:.0f}")
            lines.append((name, ESTIMATORS[name].kind, *shown, found.reason or ""))
            self._add_row(name, found, self.span.value, params)
            words = f"{self._window_words(params)}; {self._truth_words()}"
            self.compared.value = box(words) + table(("estimator", "takes", "length (m)", "2σ (m)", "ms", ""), lines)

    def press_cut(self, *_: object) -> None:
        """Write the window into a new bag."""
        self.chooser.cut(*self.span.value)

    def press_export(self, *_: object) -> None:
        """Write the pictures, the arrays and the table of results, in place of earlier ones, and say where."""
        if self.flight is None:
            return
        folder, name = Path(self.folder.value.strip() or ".").expanduser(), self.flight.path.name.removesuffix(".mcap")
        try:
            with self.exporting:
                folder.mkdir(parents=True, exist_ok=True)
                self.written = self._written(folder, name)
        except PROBLEMS as error:
            words = f"cannot be written to ({error.strerror})" if isinstance(error, OSError) else error
            self.exported.value = problem(f"{folder}: {words}")
            return
        names = html.escape(", ".join(path.name for path in self.written.values()))
        where = f"<code>{html.escape(str(folder.resolve()))}</code>"
        self.exported.value = box(f"Wrote {names} ({len(self.rows)} estimates) to<br>{where}")

    def _written(self, folder: Path, name: str) -> dict[str, Path]:
        figures = {"flight": self.over_time.figure, "space": self.in_space.figure, "refit": self.found.figure}
        if self._shrunk:
            figures["length"] = length_figure.length_figure(self.flight, self.windows, self._shrunk)
        files = {f"{what}{end}": (what, end) for what in figures for end in length_figure.FORMATS}
        files = {what: folder / f"{name}-{what}" for what in files}
        for at, (what, path) in enumerate(files.items()):
            self.exporting.say(f"writing {path.name}", at / (len(files) + 4))
            path.unlink(missing_ok=True)
            figure = figures[what.partition(".")[0]]
            if what.startswith("length"):
                length_figure.save(figure, path)
            else:
                figure.savefig(path, dpi=200, metadata=length_figure.FORMATS[path.suffix])
        flight = self.flight
        if self.windows:
            from fiplib.estimators.poses import history

            if not history.estimated(flight):
                flight = replace(flight, length=history.series_of(flight, iter(self.windows)))
        kinds = {"poses": True, "states": True, "commands": flight.command, "estimates": flight.length}
        for what in (what for what, there in kinds.items() if there is not None and self.arrays.value):
            path = folder / f"{name}-{what}{self.arrays.value}"
            self.exporting.say(f"writing {path.name}", 0.8)
            path.unlink(missing_ok=True)
            bags.export(flight, path, what)
            files[path.name.removeprefix(f"{name}-")] = path
        files["results.csv"] = folder / f"{name}-results.csv"
        with files["results.csv"].open("w", newline="", encoding="utf-8") as stream:
            writer = csv.DictWriter(stream, self.rows[0] if self.rows else (), lineterminator="\n")
            writer.writeheader()
            writer.writerows(self.rows)
        return files

    # --- words and numbers

    def _settings(self) -> Params:
        """The flight's parameters with the settings of the page."""
        estimation = self.flight.params.estimation
        return self.flight.params.replace(
            estimation__sample_period=self.period.value,
            estimation__fitness=self.reading.value,
            estimation__process_noise=tuple(self.process.value * np.array(estimation.process_noise)),
            estimation__measurement_noise=tuple(self.measurement.value * np.array(estimation.measurement_noise)),
        )

    def _add_row(
        self, name: str, found: Any, span: Sequence[float], params: Params | None = None, refit: int | None = None,
        best: float = math.nan,
    ) -> None:  # fmt: skip
        """Add an estimate to the table; without ``params`` it depends on none of the page's settings."""
        estimation = params.estimation if params else None
        self.rows.append({
            "refit": refit,
            "estimator": name,
            "length_m": number(found.length),
            "standard_deviation_m": number(found.standard_deviation),
            "least_fitness_at_m": number(best),
            "stated_by_bag_m": self._truth(),
            "window_start_s": f"{span[0]:.2f}",
            "window_end_s": f"{span[1]:.2f}",
            "samples": estimation and estimation.window,
            "sample_period_s": estimation and number(estimation.sample_period),
            "reading": estimation and estimation.fitness,
            "process_noise_factor": estimation and number(self.process.value),
            "measurement_noise_factor": estimation and number(self.measurement.value),
            "seed": estimation and self.seed.value,
            "remark": found.reason,
            "bag": self.flight.path.name,
            "origin": self.flight.metadata["origin"],
        })  # fmt: skip

    def _truth(self) -> float | None:
        """The rod's length in m, if the bag states it."""
        if self.flight.truth_length is not None:
            return float(self.flight.truth_length.values[0, 0])
        return self.flight.metadata.get("params", {}).get("pendulum", {}).get("length")

    def _truth_words(self) -> str:
        truth = self._truth()
        return "the bag does not state the rod's length" if truth is None else f"the bag states a rod of {truth:g} m"

    def _window_words(self, params: Params) -> str:
        start, end = self.span.value
        return f"window {start:.2f} to {end:.2f} s, {params.estimation.window} samples"

    def _set_span(self, flight: Flight) -> None:
        """The flight's own window, in the middle of the flight."""
        estimation, end = flight.params.estimation, flight.duration
        seconds = min((estimation.window - 1) * estimation.sample_period + 0.05, end)
        self.span.min, self.span.max = 0.0, max(round(end, 2), 0.1)
        self.span.step = step_for(end)
        start = self.span.step * round((end - seconds) / 2 / self.span.step)
        self.span.value = (round(start, 2), round(start + seconds, 2))

    def _show_length(self) -> None:
        """The headline: the recommended estimate from the whole flight, the genetic algorithm's beside it."""
        whole = self.whole
        if whole.reason is not None:
            listed = whole.reason in [finding.sentence for finding in self.chooser.against]
            why = "what is listed below speaks against it" if listed else whole.reason
            self.length.value = problem(f"{self.flight.path.name}: no length: {why}")
            return
        low, high = whole.interval
        beside = "no answer of the genetic algorithm: it needs commands" if self.flight.command is None else ""
        if self.refits:
            last = stated(self.refits[-1])
            beside = (
                f"the genetic algorithm, from one window with the commands, as set for Refit: {_with_interval(last)}"
            )
            apart = abs(last.length - whole.length) / math.hypot(last.standard_deviation, whole.standard_deviation)
            if last.reason is None and apart > 2.0:
                beside += ". Do not use it: its interval contradicts the length above, and its model has no inertia"
            if seat := replay.assumed_seat(self.flight):
                beside += f"; {seat}"
        assumed = folded("what was assumed, and what was left out", [*whole.assumed, *whole.notes])
        self.length.value = box(
            f"<span style='font-size:170%'>l = <b>{whole.length:.4f}</b> m</span>, 95 % interval "
            f"{low:.4f} to {high:.4f} m<br>from the poses of both bodies over the whole flight "
            f"{html.escape(self.flight.path.name)}; {self._truth_words()}"
            f"<br>{html.escape(beside)}{assumed}"
        )

    def _show_refits(self, why: str | None = None) -> None:
        """What the window says; ``why`` the genetic algorithm has no answer."""
        draw_refit(self.found.figure, self.flight, self.refits, self._truth())
        self.found.show()
        found = self._window.found
        words = f"from the poses alone: <b>{found.length:.4f}</b> m, 95 % interval {_interval(found)} m"
        first = problem(f"From the poses alone, no length: {found.reason}") if found.reason else box(words)
        if why is not None:
            self.answer.value = first + problem(f"The genetic algorithm has no answer: {why}")
            return
        last = self.refits[-1]
        if reason := stated(last).reason:
            self.answer.value = first + problem(f"The genetic algorithm has no answer: {reason}")
            return
        sigma = last.found.standard_deviation
        interval = f" ± {2 * sigma:.3f} m (2σ)" if math.isfinite(sigma) else " m (this reading gives no interval)"
        self.answer.value = first + box(
            f"genetic algorithm: <span style='font-size:130%'>l = <b>{last.found.length:.4f}</b>{interval}</span><br>"
            f"{self._window_words(last.params)}; an exhaustive search finds {last.best:.4f} m; {self._truth_words()}; "
            f"refit {len(self.refits)} took {1000 * last.seconds:.0f} ms"
        )

    def _outdate(self, *_: object) -> None:
        """Settings changed: what is shown was found with others."""
        if self.flight is not None and self._window is not None and STALE not in self.answer.value:
            self.answer.value += STALE

    # --- the widgets

    def _make_widgets(self, export: Path) -> None:
        self.length, self.answer, self.parts, self.compared, self.exported = (
            said(name) for name in ("length", "answer", "parts", "compared", "exported")
        )
        self.span = widgets.FloatRangeSlider(
            value=(0.0, 1.0), min=0.0, max=1.0, step=0.05, readout_format=".2f", continuous_update=False,
            **sized("window (s)", "520px"),
        )  # fmt: skip
        self.zoom = widgets.Checkbox(
            False, description="show the window alone", indent=False, layout=widgets.Layout(width="190px")
        )
        self.period = widgets.Dropdown(options=PERIODS, value=0.1, **sized("sampling (s)", "180px"))
        self.reading = widgets.Dropdown(options=list(kalman.READINGS), **sized("reading", "230px"))
        self.reading.value = "rk4_likelihood"
        self.process, self.measurement = (
            widgets.FloatLogSlider(
                value=1.0, base=10, min=-3, max=3, step=0.1, readout_format=".3g", continuous_update=False,
                **sized(f"{name} times", "330px"),
            )
            for name in ("Qₑ", "Rₑ")
        )  # fmt: skip
        self.seed = widgets.BoundedIntText(value=1, min=0, max=10**6, **sized("seed", "130px"))
        self.press, self.rival, self.export = button("Refit"), button("Compare"), button("Export")
        self.press_cutting = button("Cut", False, "80px", tooltip="write the window into a new bag")
        self.follow = button("Length over time", width="160px")
        self.folder = text(str(export), "folder", width="480px")
        self.arrays = widgets.Dropdown(options=ARRAYS, **sized("arrays", "160px"))
        self.progress, self.exporting = Progress(), Progress()
        self.over_windows = widgets.Image(format="png", layout=widgets.Layout(width="520px", display="none"))
        self.over_time, self.in_space, self.found = Picture(5.0, 4.6), Picture(3.2, 4.6), Picture(8.3, 3.1)

    def _make_panels(self) -> None:
        *reading, findings, written = self.chooser.parts
        self.choose = Panel("choose a bag", *reading, self.length, findings, written)
        views = row(self.over_time.widget, self.in_space.widget)
        self.look = Panel("scrub a window", row(self.span, self.zoom, self.press_cutting), views)
        settings = row(self.period, self.reading, self.seed), row(self.process, self.measurement, self.press)
        self.fit = Panel("refit", self.span, *settings, self.answer, self.found.widget)
        self.history = Panel("length over time", row(self.follow, self.progress), self.over_windows, self.parts)
        self.rivals = Panel("compare estimators", self.rival, self.compared)
        saved = row(self.folder, self.arrays, self.export)
        self.save = Panel("export", saved, self.exporting, self.exported)

    def _connect(self) -> None:
        self.press.on_click(self.press_refit)
        self.press_cutting.on_click(self.press_cut)
        self.follow.on_click(self.press_history)
        self.rival.on_click(self.press_compare)
        self.export.on_click(self.press_export)
        settings = self.span, self.period, self.reading, self.process, self.measurement, self.seed
        for action, moved in ((self.draw, (self.span, self.zoom)), (self._outdate, settings)):
            for widget in moved:
                widget.observe(action, "value")


def step_for(seconds: float) -> float:
    """Return the step of a slider over so many seconds, s."""
    return next((step for step in STEPS if seconds <= 1000 * step), STEPS[-1])


def _interval(found: "PoseEstimate") -> str:
    return f"{found.interval[0]:.4f} to {found.interval[1]:.4f}"


def _length_cells(found: "PoseEstimate") -> tuple[str, str]:
    return ("", "") if found.reason else (f"{found.length:.4f}", _interval(found))


def _with_interval(found: Any) -> str:
    """An estimate of the genetic algorithm in words."""
    if found.reason:
        return f"no length: {found.reason}"
    sigma = found.standard_deviation
    return f"{found.length:.4f}{f' ± {2 * sigma:.3f}' if math.isfinite(sigma) else ''} m"
