"""The page that explores a bag: choose a flight, scrub a window, refit its length, compare estimators, export.

``Explorer`` holds the widgets and what happens when they are moved; its panels are displayed by the notebook
``07-explore-a-bag``. ``fit_window`` and ``compare`` compute, ``explorer_plots`` draws.
"""

import csv
import html
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import ipywidgets as widgets
import numpy as np

from fiplib import bags, ga, kalman, replay
from fiplib.estimators import ESTIMATORS
from fiplib.estimators.base import Estimate
from fiplib.estimators.checks import checked
from fiplib.kalman import Window
from fiplib.params import FipError, Params
from fiplib.recording import TOPICS, Flight
from fiplib.reproduction.style import BLUE, ORANGE
from fiplib.teaching.explorer_plots import Picture, WindowFit, draw_flight, draw_refit, draw_space

CONVENTIONS = {
    "fip": "/mocap/{}/pose",
    "vrpn_mocap": "/vrpn_mocap/{}/pose",
    "natnet_ros2": "/natnet_ros/{}/pose",
    "mocap_optitrack": "/{}/pose",
}
"""Names that the usual motion-capture drivers give to the pose of a body."""

PERIODS = {"1/120": 1 / 120, "1/60": 1 / 60, "1/30": 1 / 30, "0.05": 0.05, "0.1": 0.1, "0.2": 0.2}
"""Sampling periods in s that are offered, all whole numbers of control ticks at 120 Hz."""

LANDSCAPE_SAMPLES = 90_000
"""Lengths times samples of the landscape that is drawn: about 0.1 s."""

PROBLEMS = (FipError, ValueError, OSError)
"""What is the user's to mend, and so is said in the page."""

STALE = "<div style='color: #666666; padding: 2px 14px'>The settings have changed since: press Refit.</div>"


def fit_window(window: Window, params: Params, seed: int) -> WindowFit:
    """Landscape, genetic algorithm and best length of a window.

    Raises ValueError as ``kalman.fitness``, or if the filter overflows at every length.
    """
    began, estimation = time.perf_counter(), params.estimation
    chromosome = ga.Chromosome.of(estimation)
    count = min(chromosome.codes, LANDSCAPE_SAMPLES // len(window.states))
    codes = np.unique(np.linspace(0, chromosome.codes - 1, count).round().astype(int))
    lengths = chromosome.length(codes)
    fitness = kalman.fitness(lengths, window, estimation)
    if not np.isfinite(fitness).any():
        raise ValueError("the filter overflows at every length: take a shorter window or another reading")
    coarse = int(fitness.argmin())
    near = chromosome.length(np.arange(codes[max(coarse - 1, 0)], codes[min(coarse + 1, len(codes) - 1)] + 1))
    best = float(near[kalman.fitness(near, window, estimation).argmin()])
    # settings change with every run here: a table of all gains would take ten times as long as it saves
    found = ga.estimate(window, params, np.random.default_rng(seed))
    return WindowFit(window, params, lengths, fitness, best, found, time.perf_counter() - began)


def stated(fit: WindowFit) -> Estimate:
    """What may be stated of the genetic algorithm's length: refused at an end of the interval, or by its residuals."""
    return checked(Estimate(fit.found.length, fit.found.standard_deviation), fit.window, fit.params)


def compare(
    flight: Flight, window: Window, start: float, end: float, params: Params, seed: int
) -> Iterator[tuple[str, Estimate, float]]:
    """Every estimator on the same stretch of flight: name, estimate (with its reason if refused), seconds taken."""
    for name, estimator in ESTIMATORS.items():
        began = time.perf_counter()
        try:
            data = window if estimator.kind == "states" else replay.raw_window_between(flight, start, end)
            found = estimator.answer(data, params, np.random.default_rng(seed))
        except (*PROBLEMS, RuntimeError) as error:  # the latter is CasADi's
            found = Estimate(math.nan, math.nan, str(error))
        yield name, found, time.perf_counter() - began


class Panel(widgets.VBox):
    """A box of widgets; where no page can show it, one line says what it is."""

    def __init__(self, what: str, *children: widgets.Widget) -> None:
        super().__init__(children, layout=widgets.Layout(margin="4px 0 8px 0", overflow="hidden"))
        self._what = what

    def __repr__(self) -> str:
        return f"[{self._what}: widgets, to be used in JupyterLab]"


class Explorer:
    """Widgets, and what they do. Problems with a bag or a setting are text in the page (``message``, ``answer``).

    Bags of the folder ``data`` are offered, ``first`` is shown first; ``export`` is the folder to write to, unless the
    page says another.

    ``flight`` is shown, or None; ``refits`` are those of this flight, in order; ``rows`` is the table of results, one
    dictionary per estimate, lengths in m, times in s. ``choose, look, fit, rivals, save`` are panels to be displayed.
    """

    def __init__(self, data: Path, export: Path, first: str = "estimate-1.4") -> None:
        self.data, self.flight = Path(data), None
        self.refits: list[WindowFit] = []
        self.rows: list[dict[str, Any]] = []
        self._make_widgets(export, first)
        self._make_panels()
        self._connect()
        self.load_bag()

    # --- what happens

    def load_bag(self, *_: object) -> None:
        """Read the bag of the path, else the one chosen; on a problem, say it and keep the flight that is shown."""
        if self.path.value.strip():
            self.bag.value = ""
        elif not self.bag.value:
            self.message.value = _problem("Choose a bag from the list, or give the path of one.")
            return
        path = self.data / self.bag.value if self.bag.value else Path(self.path.value.strip()).expanduser()
        topics = {role: entry.value.strip() for role, entry in self.topics.items()}
        try:
            flight = bags.read(path, {role: name for role, name in topics.items() if name != TOPICS[role]})
            flight, _ = replace(flight, state=replay.states(flight)), flight.params
        except PROBLEMS as error:
            still = "" if self.flight is None else f"\nThe page still shows {self.flight.path.name}."
            self.message.value = _problem(f"{error}{still}")
            return
        self.flight = None  # nothing is drawn while the slider adapts
        self._set_span(flight)
        self.flight, self.refits, self.rows = flight, [], []
        self._describe()
        self.compared.value = self.exported.value = ""
        self.draw()
        self._show_refits()

    def take_bag(self, *_: object) -> None:
        """Load a bag of the list, whose topics have our names."""
        if self.bag.value:
            self.path.value = ""
            self.convention.value, self.vehicle_name.value, self.pendulum_name.value = "fip", "quad", "pendulum"
            for role, entry in self.topics.items():
                entry.value = TOPICS[role]
            self.load_bag()

    def take_own(self, *_: object) -> None:
        """Load a bag by its path when path or topics change: a page may deliver the press of *Load* before the text."""
        if self.path.value.strip():
            self.load_bag()

    def draw(self, *_: object) -> None:
        """Bring the two views of the flight up to date."""
        if self.flight is not None:
            draw_flight(self.over_time.figure, self.flight, self.span.value, self.zoom.value)
            draw_space(self.in_space.figure, self.flight, self.span.value)
            self.over_time.show()
            self.in_space.show()

    def press_refit(self, *_: object) -> None:
        """Refit the window with the settings of the page."""
        if self.flight is None:
            return
        try:
            window, params = replay.window_between(self.flight, *self.span.value, self._settings())
            result = fit_window(window, params, self.seed.value)
        except PROBLEMS as error:
            self.answer.value = _problem(error)
            return
        self.refits.append(result)
        self._add_row("ga", stated(result), params, len(self.refits), result.best)
        self._show_refits()

    def press_compare(self, *_: object) -> None:
        """Give the window to every estimator; rows appear as they are done."""
        if self.flight is None:
            return
        try:
            window, params = replay.window_between(self.flight, *self.span.value, self._settings())
        except PROBLEMS as error:
            self.compared.value = _problem(error)
            return
        lines: list[tuple[str, ...]] = []
        for name, found, seconds in compare(self.flight, window, *self.span.value, params, self.seed.value):
            sigma = found.standard_deviation
            shown = (_number(found.length, ".4f"), _number(2 * sigma, ".3f"), f"{1000 * seconds:.0f}")
            lines.append((name, ESTIMATORS[name].kind, *shown, found.reason or ""))
            self._add_row(name, found, params)
            words = f"{self._window_words(params)}; {self._truth_words()}"
            self.compared.value = _box(words) + _table(("estimator", "takes", "length (m)", "2σ (m)", "ms", ""), lines)

    def press_export(self, *_: object) -> None:
        """Write the pictures and the table of results, and say where."""
        if self.flight is None:
            return
        folder, name = Path(self.folder.value.strip() or ".").expanduser(), self.flight.path.name.removesuffix(".mcap")
        try:
            folder.mkdir(parents=True, exist_ok=True)
            written = [folder / f"{name}-{what}.png" for what in ("flight", "space", "refit")]
            for path, picture in zip(written, (self.over_time, self.in_space, self.found), strict=True):
                picture.figure.savefig(path, dpi=200, metadata={"Software": None})
            written.append(folder / f"{name}-results.csv")
            with written[-1].open("w", newline="", encoding="utf-8") as stream:
                table = csv.DictWriter(stream, self.rows[0] if self.rows else (), lineterminator="\n")
                table.writeheader()
                table.writerows(self.rows)
        except OSError as error:
            self.exported.value = _problem(f"{folder}: cannot be written to ({error.strerror})")
            return
        names = html.escape(", ".join(path.name for path in written))
        where = f"<code>{html.escape(str(folder.resolve()))}</code>"
        self.exported.value = _box(f"Wrote {names} ({len(self.rows)} estimates) to<br>{where}")

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

    def _add_row(self, name: str, found: Any, params: Params, refit: int | None = None, best: float = math.nan) -> None:
        estimation = params.estimation
        self.rows.append({
            "refit": refit,
            "estimator": name,
            "length_m": _number(found.length),
            "standard_deviation_m": _number(found.standard_deviation),
            "least_fitness_at_m": _number(best),
            "stated_by_bag_m": self._truth(),
            "window_start_s": f"{self.span.value[0]:.2f}",
            "window_end_s": f"{self.span.value[1]:.2f}",
            "samples": estimation.window,
            "sample_period_s": _number(estimation.sample_period),
            "reading": estimation.fitness,
            "process_noise_factor": _number(self.process.value),
            "measurement_noise_factor": _number(self.measurement.value),
            "seed": self.seed.value,
            "remark": getattr(found, "reason", None),
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

    def _describe(self) -> None:
        flight, why = self.flight, replay.why_not_refit(self.flight)
        made = {"simulated": "simulated, no real vehicle", "real": "a real flight", "unknown": "of unknown origin"}
        words = (
            f"<b>{html.escape(flight.path.name)}</b>: {made[flight.metadata['origin']]}; {flight.duration:.1f} s, "
            f"{len(flight.vehicle.stamp)} poses of the vehicle, {len(flight.pendulum.stamp)} of the rod; "
            + ("no commands" if flight.command is None else f"{len(flight.command.stamp)} commands")
        )
        self.press.disabled = self.rival.disabled = flight.command is None
        self.message.value = _box(words + (f"<br>{html.escape(why)}" if why else ""))

    def _set_span(self, flight: Flight) -> None:
        """The flight's own window, in the middle of the flight."""
        estimation, end = flight.params.estimation, flight.duration
        seconds = min((estimation.window - 1) * estimation.sample_period + 0.05, end)
        self.span.min, self.span.max = 0.0, max(round(end, 2), 0.1)
        start = self.span.step * round((end - seconds) / 2 / self.span.step)
        self.span.value = (round(start, 2), round(start + seconds, 2))

    def _show_refits(self) -> None:
        draw_refit(self.found.figure, self.flight, self.refits, self._truth())
        self.found.show()
        if not self.refits:
            why = replay.why_not_refit(self.flight) if self.flight.command is None else None
            self.answer.value = _box(f"This flight cannot be refitted. {html.escape(why)}" if why else "No refit yet.")
            return
        last = self.refits[-1]
        if reason := stated(last).reason:
            self.answer.value = _problem(f"No length: {reason}")
            return
        sigma = last.found.standard_deviation
        interval = f" ± {2 * sigma:.3f} m (2σ)" if math.isfinite(sigma) else " m (this reading gives no interval)"
        self.answer.value = _box(
            f"<span style='font-size:150%'>l = <b>{last.found.length:.4f}</b>{interval}</span><br>"
            f"{self._window_words(last.params)}; an exhaustive search finds {last.best:.4f} m; {self._truth_words()}; "
            f"refit {len(self.refits)} took {1000 * last.seconds:.0f} ms"
        )

    def _outdate(self, *_: object) -> None:
        """Settings changed: what is shown was found with others."""
        if self.refits and STALE not in self.answer.value:
            self.answer.value += STALE

    def _name_topics(self, *_: object) -> None:
        for role, body in (("vehicle", self.vehicle_name), ("pendulum", self.pendulum_name)):
            self.topics[role].value = CONVENTIONS[self.convention.value].format(body.value.strip().strip("/"))

    # --- the widgets

    def _make_widgets(self, export: Path, first: str) -> None:
        names = sorted(path.parent.name for path in self.data.glob("*/metadata.yaml"))
        options = [*((name, name) for name in names), ("by its path:", "")]
        self.bag = widgets.Dropdown(options=options, value=first if first in names else "", **_say("bag"))
        self.path = _text("", "path", "directory of a ROS 2 bag, or an .mcap file", "400px")
        self.load = widgets.Button(description="Load", button_style="primary", layout=widgets.Layout(width="90px"))
        self.convention = widgets.Dropdown(options=list(CONVENTIONS), **_say("convention"))
        self.vehicle_name, self.pendulum_name = _text("quad", "vehicle is"), _text("pendulum", "rod is")
        roles = "vehicle", "pendulum", "command"
        self.topics = {role: _text(TOPICS[role], f"{role} topic", width="330px") for role in roles}
        self.message, self.answer, self.compared, self.exported = (widgets.HTML() for _ in range(4))
        for name in ("message", "answer", "compared", "exported"):  # for who styles the page, or reads it by program
            getattr(self, name).add_class(f"fip-{name}")
        self.span = widgets.FloatRangeSlider(
            value=(0.0, 1.0), min=0.0, max=1.0, step=0.05, readout_format=".2f", continuous_update=False,
            **_say("window (s)", "620px"),
        )  # fmt: skip
        narrow, wide = widgets.Layout(width="120px"), widgets.Layout(width="190px")
        self.zoom = widgets.Checkbox(False, description="show the window alone", indent=False, layout=wide)
        self.period = widgets.Dropdown(options=PERIODS, value=0.1, **_say("sampling (s)", "180px"))
        self.reading = widgets.Dropdown(options=list(kalman.READINGS), **_say("reading", "230px"))
        self.reading.value = "rk4_likelihood"
        self.process, self.measurement = (
            widgets.FloatLogSlider(
                value=1.0, base=10, min=-3, max=3, step=0.1, readout_format=".3g", continuous_update=False,
                **_say(f"{name} times", "330px"),
            )
            for name in ("Qₑ", "Rₑ")
        )  # fmt: skip
        self.seed = widgets.BoundedIntText(value=1, min=0, max=10**6, **_say("seed", "130px"))
        self.press = widgets.Button(description="Refit", button_style="primary", layout=narrow)
        self.rival = widgets.Button(description="Compare", button_style="primary", layout=narrow)
        self.folder = _text(str(export), "folder", width="560px")
        self.export = widgets.Button(description="Export", button_style="primary", layout=narrow)
        self.over_time, self.in_space, self.found = Picture(5.0, 4.6), Picture(3.2, 4.6), Picture(8.3, 3.1)

    def _make_panels(self) -> None:
        words = "Names in another lab: take its driver's convention and the bodies' names there, or edit the topics."
        other = _row(self.convention, self.vehicle_name, self.pendulum_name)
        names = Panel("topics", widgets.HTML(words), other, _row(*self.topics.values()))
        remap = widgets.Accordion(children=[names], titles=("Topics",))
        self.choose = Panel("choose a bag", _row(self.bag, self.path, self.load), remap, self.message)
        views = _row(self.over_time.widget, self.in_space.widget)
        self.look = Panel("scrub a window", _row(self.span, self.zoom), views)
        settings = _row(self.period, self.reading, self.seed), _row(self.process, self.measurement, self.press)
        self.fit = Panel("refit", self.span, *settings, self.answer, self.found.widget)
        self.rivals = Panel("compare estimators", self.rival, self.compared)
        self.save = Panel("export", _row(self.folder, self.export), self.exported)

    def _connect(self) -> None:
        self.load.on_click(self.load_bag)
        self.press.on_click(self.press_refit)
        self.rival.on_click(self.press_compare)
        self.export.on_click(self.press_export)
        settings = self.span, self.period, self.reading, self.process, self.measurement, self.seed
        for action, moved in (
            (self._name_topics, (self.convention, self.vehicle_name, self.pendulum_name)),
            (self.take_bag, (self.bag,)),
            (self.take_own, (self.path, *self.topics.values())),
            (self.draw, (self.span, self.zoom)),
            (self._outdate, settings),
        ):
            for widget in moved:
                widget.observe(action, "value")


def _say(words: str, width: str = "220px") -> dict[str, Any]:
    """A description that takes the room it needs, and the width of the whole."""
    layout = widgets.Layout(width=width, max_width="100%")
    return {"description": words, "style": {"description_width": "initial"}, "layout": layout}


def _text(value: str, words: str, placeholder: str = "", width: str = "220px") -> widgets.Text:
    return widgets.Text(value, placeholder=placeholder, continuous_update=False, **_say(words, width))


def _row(*children: widgets.Widget) -> widgets.HBox:
    return widgets.HBox(children, layout={"flex_flow": "row wrap", "align_items": "center", "grid_gap": "2px 14px"})


def _box(words: str, colour: str = BLUE) -> str:
    style = f"border-left: 4px solid {colour}; padding: 2px 10px; line-height: 1.5; max-width: 860px"
    return f"<div style='{style}'>{words}</div>"


def _problem(what: object) -> str:
    return _box(html.escape(str(what)).replace("\n", "<br>"), ORANGE)


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    def line(kind: str, words: Sequence[str]) -> str:
        cell = f"<{kind} style='padding: 1px 12px; text-align: left; vertical-align: top'>{{}}</{kind}>"
        return f"<tr>{''.join(cell.format(html.escape(word)) for word in words)}</tr>"

    return f"<table style='line-height: 1.4'>{line('th', head)}{''.join(line('td', row) for row in rows)}</table>"


def _number(value: float, form: str = ".6g") -> str:
    return f"{value:{form}}" if math.isfinite(value) else ""
