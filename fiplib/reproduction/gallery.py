"""The paper's six figures as small images, and the page that shows them: ``figures/README.md`` in the repository."""

import io
import re
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from fiplib.reproduction.sources import Product

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NAMES = ("fig1-flight", "fig2-vehicle", "fig3-pushes", "fig4-circle", "fig5-estimation", "fig6-convergence")

DPI, COLOURS = 150, 64
"""Resolution and number of colours of a small image: sharp at the width of a page in a browser, and less than 60 kB."""

PAGE = """# The paper's figures, from our recorded flights

All flights are **simulated**. `make figures` makes this page, these small images and, beside them, every figure as PDF
and PNG and every table as CSV and LaTeX; the other figures and tables are shown in
[notebook 09](../notebooks/09-paper-figures.ipynb).
"""


def small(figure: "Figure") -> bytes:
    """Return a figure as a PNG of ``COLOURS`` colours; the same figure gives the same bytes."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    from fiplib.reproduction.style import styled

    drawn, written = io.BytesIO(), io.BytesIO()
    with styled():
        FigureCanvasAgg(figure)
        figure.savefig(drawn, dpi=DPI, format="png", metadata={"Software": None})
    image = Image.open(drawn).convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)
    image.save(written, format="PNG", optimize=True)
    return written.getvalue()


def page(products: Mapping[str, Product], captions: Mapping[str, str]) -> str:
    """Return the page: each figure with its caption, the commands that make it, and what it is made from."""
    parts = [PAGE]
    for name in NAMES:
        product, number = products[name], name.partition("-")[0].removeprefix("fig")
        module, _, function = product.address.partition(":")
        path = f"{module.replace('.', '/')}.py"
        sources = [f"[data/{bag}](../data/{bag})" for bag in product.bags]
        sources += [f"[data/sweeps/{study}.csv](../data/sweeps/{study}.csv)" for study in product.studies]
        parts.append(
            f"## Figure {number}\n\n"
            f"![{re.split('[:.] ', captions[name])[0]}](small/{name}.png)\n\n"
            f"{textwrap.fill(captions[name], 120, break_long_words=False, break_on_hyphens=False)}\n\n"
            f"- Command: `fip figures {name}`; from the beginning: `{product.command}`\n"
            f"- Source: `{function}` in [{path}](../{path}), {', '.join(sources) or 'parameters only'}\n"
        )
    return "\n".join(parts)


def write(figures: "Mapping[str, Figure]", text: str, folder: Path) -> list[Path]:
    """Write ``README.md`` and ``small/NAME.png`` into a folder; returns the paths."""
    (folder / "small").mkdir(parents=True, exist_ok=True)
    paths = [folder / "README.md", *(folder / "small" / f"{name}.png" for name in figures)]
    for path, content in zip(paths, (text.encode(), *map(small, figures.values())), strict=True):
        path.write_bytes(content)
    return paths
