"""The block diagram of the closed loop, as notebook 06 shows it."""

from itertools import pairwise

import matplotlib.pyplot as plt
from matplotlib.axes import Axes

from fiplib.params import Params
from fiplib.reproduction.style import BLUE, GREY, ORANGE

BLOCKS = {
    "vehicle and rod": (5.6, 2.0, GREY),
    "motion capture": (3.0, 3.2, GREY),
    "MPC": (3.0, 2.0, BLUE),
    "state from poses": (0.5, 2.0, BLUE),
    "estimator": (0.5, 0.5, ORANGE),
    "hand-over": (3.0, 0.5, ORANGE),
}
"""Name, centre and colour of each block: grey is the world, blue runs at every tick, orange beside it."""

WIDTH, HEIGHT = 1.7, 0.6


def _arrow(axes: Axes, path: list[tuple[float, float]], words: str, at: tuple[float, float]) -> None:
    """A line along corners with an arrowhead at its end, and words on it."""
    for start, end in pairwise(path):
        last = end == path[-1]
        style = {"arrowstyle": "-|>" if last else "-", "shrinkA": 0, "shrinkB": 0, "lw": 1.0, "color": "black"}
        axes.annotate("", xy=end, xytext=start, arrowprops=style)
    axes.text(*at, words, ha="center", va="center", fontsize=7, linespacing=1.1)


def closed_loop(params: Params | None = None) -> Axes:
    """Draw controller, vehicle, estimator and hand-over with the rates at which they exchange values.

    The rates are those of ``params``, by default the paper's system.
    """
    params = params or Params()
    piloting, estimation = params.piloting, params.estimation
    _, axes = plt.subplots(figsize=(5.8, 2.9))
    for name, (x, y, colour) in BLOCKS.items():
        box = plt.Rectangle((x - WIDTH / 2, y - HEIGHT / 2), WIDTH, HEIGHT, fc="white", ec=colour, lw=1.4)
        axes.add_patch(box)
        axes.text(x, y, name, ha="center", va="center", fontsize=8)
    half, up = WIDTH / 2, HEIGHT / 2
    _arrow(axes, [(3 + half, 2), (5.6 - half, 2)], f"body rates,\nthrust\n{piloting.control_rate:g} Hz", (4.3, 2.42))
    _arrow(axes, [(5.6, 2 + up), (5.6, 3.2), (3 + half, 3.2)], "motion", (4.75, 3.35))
    _arrow(axes, [(3 - half, 3.2), (0.5, 3.2), (0.5, 2 + up)], f"poses, {piloting.mocap_rate:g} Hz", (1.3, 3.37))
    _arrow(axes, [(0.5 + half, 2), (3 - half, 2)], "state", (1.75, 2.15))
    _arrow(axes, [(0.5, 2 - up), (0.5, 0.5 + up)], f"window of {estimation.window} states", (1.38, 1.25))
    _arrow(axes, [(0.5 + half, 0.5), (3 - half, 0.5)], f"length\n{1 / estimation.run_period:g} Hz", (1.75, 0.75))
    _arrow(axes, [(3, 0.5 + up), (3, 2 - up)], "length used", (3.5, 1.25))
    axes.set(xlim=(-0.5, 6.6), ylim=(0.1, 3.6))
    axes.axis("off")
    return axes
