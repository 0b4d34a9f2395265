"""The small parts of the page of ``fiplib.teaching.explorer``: fields, rows, boxes of words, tables, progress."""

import html
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

import ipywidgets as widgets

from fiplib.params import FipError
from fiplib.reproduction.style import BLUE, ORANGE

PROBLEMS = (FipError, ValueError, OSError)
"""What is the user's to mend, and so is said in the page."""


class Panel(widgets.VBox):
    """A box of widgets; where no page can show it, one line says what it is."""

    def __init__(self, what: str, *children: widgets.Widget) -> None:
        super().__init__(children, layout=widgets.Layout(margin="4px 0 8px 0", overflow="hidden"))
        self._what = what

    def __repr__(self) -> str:
        return f"[{self._what}: widgets, to be used in JupyterLab]"


class Progress(widgets.HBox):
    """A bar and what is being done; seen within its ``with`` block only."""

    def __init__(self) -> None:
        self.bar = widgets.FloatProgress(min=0.0, max=1.0, layout=widgets.Layout(width="200px"))
        self.words = widgets.HTML()
        super().__init__([self.bar, self.words], layout=widgets.Layout(align_items="center", display="none"))
        self.add_class("fip-progress")

    def __enter__(self) -> Self:
        self.layout.display = None
        return self

    def __exit__(self, *_: object) -> None:
        self.layout.display = "none"

    def say(self, words: str, done: float) -> None:
        """Show what is being done, and how much of it is done, 0 to 1."""
        self.bar.value, self.words.value = done, html.escape(words)


def sized(words: str, width: str = "220px") -> dict[str, Any]:
    """Return a description that takes the room it needs, and the width of the whole."""
    layout = widgets.Layout(width=width, max_width="100%")
    return {"description": words, "style": {"description_width": "initial"}, "layout": layout}


def text(value: str, words: str, placeholder: str = "", width: str = "220px") -> widgets.Text:
    """Return a field of text that reports a change when Enter is pressed or the field is left."""
    return widgets.Text(value, placeholder=placeholder, continuous_update=False, **sized(words, width))


def button(words: str, main: bool = True, width: str = "120px", tooltip: str = "") -> widgets.Button:
    """Return a button, coloured if it is the main one of its panel."""
    layout = widgets.Layout(width=width, flex="0 0 auto")
    return widgets.Button(description=words, button_style="primary" if main else "", tooltip=tooltip, layout=layout)


def said(name: str) -> widgets.HTML:
    """Return a place for words, with a class of the page's style by which it is found there."""
    place = widgets.HTML()
    place.add_class(f"fip-{name}")
    return place


def row(*children: widgets.Widget) -> widgets.HBox:
    """Return widgets side by side, in further lines where the page is narrow."""
    return widgets.HBox(children, layout={"flex_flow": "row wrap", "align_items": "center", "grid_gap": "2px 14px"})


def box(words: str, colour: str = BLUE) -> str:
    """Return words (HTML) with a bar beside them."""
    style = f"border-left: 4px solid {colour}; padding: 2px 10px; line-height: 1.5; max-width: 860px"
    return f"<div style='{style}; overflow-wrap: anywhere'>{words}</div>"


def problem(what: object) -> str:
    """Return words (plain) about what is wrong."""
    return box(html.escape(str(what)).replace("\n", "<br>"), ORANGE)


def folded(title: str, lines: Sequence[str]) -> str:
    """Return plain lines that are shown when their title is pressed; nothing if there are none."""
    items = "".join(f"<li>{html.escape(line)}</li>" for line in lines)
    style = "margin: 0; padding-left: 20px; line-height: 1.4"
    return f"<details><summary>{title}</summary><ul style='{style}'>{items}</ul></details>" if lines else ""


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table of plain words."""

    def line(kind: str, words: Sequence[str]) -> str:
        cell = f"<{kind} style='padding: 1px 12px; text-align: left; vertical-align: top'>{{}}</{kind}>"
        return f"<tr>{''.join(cell.format(html.escape(word)) for word in words)}</tr>"

    return f"<table style='line-height: 1.4'>{line('th', head)}{''.join(line('td', one) for one in rows)}</table>"


def number(value: float, form: str = ".6g") -> str:
    """Return a number in words; nothing if it is not known."""
    return f"{value:{form}}" if math.isfinite(value) else ""


def free(folder: Path, name: str) -> Path:
    """Return the first path in a folder that does not exist: the name, or the name with a number."""
    numbered = (folder / (f"{name}-{count}" if count > 1 else name) for count in range(1, 10_000))
    return next(path for path in numbered if not path.exists())
