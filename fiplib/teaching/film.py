"""The film of the README: a recorded flight as a small animated picture that loops, made by ``make film``."""

import argparse
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from PIL import Image
from tqdm import tqdm

from fiplib import bags
from fiplib.recording import Flight
from fiplib.teaching.animation import staged

PICTURES = 20.0
"""Pictures a second."""

SPEED = 2.0
"""Seconds of flight in a second of film."""

COLOURS = 64
"""Colours of the film: lines and letters need no more, and it takes a fifth of the space."""

NEARLY_WHITE = 250
"""From here on a colour is white, as the page is: the palette holds a mean of white and of the lightest grey."""

DOTS_PER_INCH = 140
"""1120 x 448 pixels: sharp on a screen with more than one dot to a pixel of the page."""


def pictures(flight: Flight, numbers: Iterable[int] | None = None) -> Iterator[Image.Image]:
    """Draw pictures of the film: all of them, or those of some ``numbers``.

    They have the palette of the one in the middle of the flight, which shows every line.
    """
    figure, show, times = staged(flight, PICTURES / SPEED)
    figure.set_dpi(DOTS_PER_INCH)
    figure.text(0.01, 0.965, f"{SPEED:g} times real time", fontsize=7, color="#666666")

    def drawn(number: int) -> Image.Image:
        show(times[number])
        figure.canvas.draw()
        return Image.fromarray(np.asarray(figure.canvas.buffer_rgba())[..., :3].copy())

    palette = drawn(len(times) // 2).quantize(COLOURS, dither=Image.Dither.NONE)
    for number in range(len(times)) if numbers is None else numbers:
        few = drawn(number).quantize(palette=palette, dither=Image.Dither.NONE).convert("RGB")
        yield few.point(lambda value: 255 if value >= NEARLY_WHITE else value)


def count(flight: Flight) -> int:
    """Number of pictures of the film."""
    return int(flight.duration * PICTURES / SPEED + 1e-6) + 1


def write(flight: Flight, path: Path) -> None:
    """Write the film of a flight, an animated WebP without loss, which every browser shows."""
    first, *others = tqdm(pictures(flight), "film", count(flight), file=sys.stderr)
    path.parent.mkdir(parents=True, exist_ok=True)
    duration = round(1000 / PICTURES)
    first.save(path, "WEBP", save_all=True, append_images=others, duration=duration, loop=0, lossless=True,
               minimize_size=True)  # fmt: skip


def main() -> int:
    """``python -m fiplib.teaching.film BAG FILM``. Returns the exit status."""
    parser = argparse.ArgumentParser(description="Make an animated picture of a recorded flight.")
    parser.add_argument("bag", type=Path, help="the recorded flight")
    parser.add_argument("film", type=Path, help="the file to write, .webp")
    options = parser.parse_args()
    write(bags.read(options.bag), options.film)
    print(f"wrote {options.film}: {options.film.stat().st_size / 1e6:.2f} MB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
