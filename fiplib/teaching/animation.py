"""A recorded flight as an animation: vehicle and rod in space, and beside them what the instruments show."""

import base64
import hashlib
import json
from collections.abc import Callable, Sequence
from io import BytesIO
from string import Template
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.animation import FuncAnimation
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from mpl_toolkits.mplot3d import Axes3D
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from fiplib.dynamics import seat_position, z_axis
from fiplib.params import Vehicle
from fiplib.recording import Flight
from fiplib.reproduction.style import BLUE, GREEN, GREY, ORANGE, STYLE, origin
from fiplib.teaching.lean import ENLARGED, upright

LOOK = STYLE | {"figure.constrained_layout.use": False}
"""The style of the figures; the panels of an animation have fixed places."""

TRAIL = 2.0
"""Seconds of the flown track that stay visible behind the vehicle."""


def animation(flight: Flight, frames_per_second: float = 10.0) -> FuncAnimation:
    """Vehicle, rod and track in space; beside it with lean and tilt enlarged; offset of the rod and length over time.

    Only the two motion-capture poses are needed; the length is drawn where the flight carries one. The animation runs
    in real time; its ``save`` makes a film. Raises ValueError: ``frames_per_second`` is not a positive number.
    """
    figure, show, times = staged(flight, frames_per_second)
    return FuncAnimation(figure, show, frames=times, interval=1e3 / frames_per_second, cache_frame_data=False)


def staged(flight: Flight, frames_per_second: float) -> tuple[Figure, Callable[[float], list], NDArray]:
    """The figure, what moves it to a time, and the times (n,) of its frames, s."""
    if not 0 < frames_per_second < np.inf:
        raise ValueError(f"frames_per_second must be a number > 0, not {frames_per_second!r}")
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(8.0, 3.2), dpi=100)
        FigureCanvasAgg(figure)
        move = _scene(figure.add_axes((-0.02, 0.02, 0.43, 0.94), projection="3d"), flight)
        lean = _enlarged(figure.add_axes((0.385, 0.02, 0.28, 0.94), projection="3d"), flight)
        grow = _instruments([figure.add_axes((0.71, low, 0.28, 0.36)) for low in (0.56, 0.13)], flight)
        origin(figure, f"{flight.metadata['origin']}, {flight.path.name}", y=0.995)

    def show(time: float) -> list:
        return [*move(time), *lean(time), *grow(time)]

    return figure, show, np.arange(0.0, flight.duration + 1e-9, 1.0 / frames_per_second)


def player(flight: Flight, frames_per_second: float = 10.0, dots_per_inch: float = 90.0) -> str:
    """``animation`` as a piece of HTML with a button and a slider, which plays by itself.

    Everything is inside: no film codec, and no icons from the network, which matplotlib's own player fetches. A frame
    takes about 15 kB: few colours, a quarter of the size. Raises ValueError as ``animation``.
    """
    (figure, show, times), frames = staged(flight, frames_per_second), list[str]()
    for time in times:
        show(time)
        whole, small = BytesIO(), BytesIO()
        with mpl.rc_context(LOOK):
            figure.savefig(whole, dpi=dots_per_inch)
        Image.open(whole).convert("RGB").quantize(64, dither=Image.Dither.NONE).save(small, "PNG", optimize=True)
        frames.append(base64.b64encode(small.getvalue()).decode())
    name = "flight-" + hashlib.sha256("".join(frames).encode()).hexdigest()[:12]
    return PLAYER.substitute(NAME=name, FRAMES=json.dumps(frames), LAST=len(frames) - 1, FPS=frames_per_second)


PLAYER = Template("""<div id="$NAME" style="max-width: 100%">
<img alt="animation of the flight" style="max-width: 100%; display: block">
<button type="button" style="width: 5em">pause</button>
<input type="range" min="0" max="$LAST" value="0" aria-label="time" style="width: 60%; vertical-align: middle">
</div>
<script>
(function start(tries) {
  const frames = $FRAMES, place = document.getElementById("$NAME");
  // JupyterLab runs this before it puts the picture on the page
  if (!place) { if (tries) setTimeout(start, 100, tries - 1); return; }
  const [picture, button, slider] = ["img", "button", "input"].map(tag => place.querySelector(tag));
  let playing = true;
  const show = () => { picture.src = "data:image/png;base64," + frames[slider.value]; };
  const play = (yes) => { playing = yes; button.textContent = yes ? "pause" : "play"; };
  button.onclick = () => play(!playing);
  slider.oninput = () => { play(false); show(); };
  const timer = setInterval(() => {
    if (!place.isConnected) { clearInterval(timer); return; }
    if (playing) { slider.value = (+slider.value + 1) % frames.length; show(); }
  }, 1000 / $FPS);
  show();
})(50);
</script>
""")


def vehicle_lines(position: NDArray, orientation: NDArray, vehicle: Vehicle, scale: float = 1.0) -> list[NDArray]:
    """Two arms and four propeller circles in the world, to scale or enlarged: lines, each (n, 3) in m.

    ``position`` (3,) in m is the centre of the vehicle, ``orientation`` its quaternion as x, y, z, w.
    """
    motors = vehicle.wheelbase / np.sqrt(8) * np.array([[1, 1, 0], [1, -1, 0], [-1, -1, 0], [-1, 1, 0]])
    angle = np.linspace(0, 2 * np.pi, 25)
    circle = vehicle.propeller_diameter / 2 * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    body = [motors[[0, 2]], motors[[1, 3]], *(motor + circle for motor in motors)]
    turn = Rotation.from_quat(orientation)
    return [position + turn.apply(scale * line) for line in body]


def _scene(axes: Axes3D, flight: Flight) -> Callable[[float], list]:
    """Vehicle, its shadow on the floor, and rod in 3-D axes; returns what moves them to a time in s."""
    times, seats, coms = joined(flight)
    frames = flight.vehicle.position
    floor = _frame(axes, np.concatenate([frames, 2 * coms - seats]))
    axes.plot(*frames[:, :2].T, floor, color=GREY, lw=0.4, alpha=0.6)
    if flight.reference is not None:
        path = [flight.reference.column(name) for name in ("x", "y")]
        axes.plot(*path, np.median(frames[:, 2]), "--", color=GREEN, lw=0.7, label="reference")
    (trail,) = axes.plot([], [], [], color=BLUE, lw=0.8, label="track")
    (shadow,) = axes.plot([], [], [], "o", color=GREY, ms=3)
    (rod,) = axes.plot([], [], [], color="black", lw=1.8, solid_capstyle="round", label="rod")
    (dot,) = axes.plot([], [], [], "o", color=ORANGE, ms=3.5, label="centre of mass")
    body = [axes.plot([], [], [], color=BLUE, lw=1.2)[0] for _ in range(6)]
    clock = axes.text2D(0.03, 0.95, "", transform=axes.transAxes)
    axes.legend(loc="upper right", ncols=2, bbox_to_anchor=(1.05, 1.02))

    def show(time: float) -> list:
        index = min(int(np.searchsorted(times, time)), len(times) - 1)
        frame, seat, com = frames[index], seats[index], coms[index]
        trail.set_data_3d(*frames[(times > time - TRAIL) & (times <= time)].T)
        shadow.set_data_3d([frame[0]], [frame[1]], [floor])
        rod.set_data_3d(*np.array([seat, 2 * com - seat]).T)
        dot.set_data_3d(*com[:, None])
        lines = vehicle_lines(frame, flight.vehicle.orientation[index], flight.params.vehicle)
        for artist, line in zip(body, lines, strict=True):
            artist.set_data_3d(*line.T)
        clock.set_text(f"{time:4.1f} s")
        return [trail, shadow, rod, dot, *body, clock]

    return show


def joined(flight: Flight) -> tuple[NDArray, NDArray, NDArray]:
    """Times (n,) s, positions (n, 3) m of the rod's seat, and of its centre of mass at the same times."""
    times, others = flight.time(flight.vehicle), flight.time(flight.pendulum)
    com = np.column_stack([np.interp(times, others, column) for column in flight.pendulum.position.T])
    vehicle, height = flight.vehicle, flight.params.piloting.seat_height
    return times, seat_position(vehicle.position, vehicle.orientation, height), com


def _frame(axes: Axes3D, points: NDArray) -> float:
    """Limits around the points (n, 3) with equal scales; returns the height of the floor."""
    low, high = points.min(axis=0), points.max(axis=0)
    half = max(*(high - low)[:2], 0.6) / 2 + 0.1
    middle, floor, top = (low + high) / 2, low[2] - 0.15, high[2] + 0.05
    axes.set(xlim=middle[0] + [-half, half], ylim=middle[1] + [-half, half], zlim=(floor, top))
    axes.set(xlabel="$x$ (m)", ylabel="$y$ (m)", zlabel="$z$ (m)")
    axes.set_box_aspect((2 * half, 2 * half, top - floor), zoom=0.95)
    axes.view_init(elev=16, azim=-62)
    axes.tick_params(pad=-2)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_major_locator(mpl.ticker.MaxNLocator(3))
        axis.labelpad = -4
        axis.pane.set_facecolor("white")
    return float(floor)


def _enlarged(axes: Axes3D, flight: Flight) -> Callable[[float], list]:
    """Vehicle and rod about the seat, lean and tilt ``ENLARGED``, beside a plumb line; returns what moves them."""
    times, seats, coms = joined(flight)
    length, below = flight.params.pendulum.length, flight.params.piloting.seat_height
    half, low, high = 0.5 * length, -0.2 * length, 1.05 * length
    axes.set(xlim=(-half, half), ylim=(-half, half), zlim=(low, high))
    axes.set_box_aspect((2 * half, 2 * half, high - low), zoom=1.42)
    axes.view_init(elev=16, azim=-62)
    axes.set_axis_off()
    axes.text2D(0.5, 0.985, f"lean and tilt {ENLARGED:g} times enlarged", transform=axes.transAxes, ha="center")
    axes.plot([0, 0], [0, 0], [0, length], "--", color=GREY, lw=0.6)
    (rod,) = axes.plot([], [], [], color="black", lw=2.2, solid_capstyle="round")
    (dot,) = axes.plot([], [], [], "o", color=ORANGE, ms=4)
    body = [axes.plot([], [], [], color=BLUE, lw=1.4)[0] for _ in range(6)]

    def show(time: float) -> list:
        index = min(int(np.searchsorted(times, time)), len(times) - 1)
        up = np.array(z_axis(*flight.vehicle.orientation[index]))
        turn, along = upright(up, ENLARGED), coms[index] - seats[index]
        tip = length * np.array(z_axis(*upright(along / np.linalg.norm(along), ENLARGED)))
        rod.set_data_3d(*np.array([0 * tip, tip]).T)
        dot.set_data_3d(*tip[:, None] / 2)
        lines = vehicle_lines(-below * np.array(z_axis(*turn)), np.array(turn), flight.params.vehicle)
        for artist, line in zip(body, lines, strict=True):
            artist.set_data_3d(*line.T)
        return [rod, dot, *body]

    return show


def _instruments(panels: Sequence[Axes], flight: Flight) -> Callable[[float], list]:
    """Offset of the rod above, length in use below; returns what colours them up to a time in s."""
    above, below = panels
    times, seat, com = joined(flight)
    growing: list[tuple[Line2D, NDArray, NDArray]] = []

    def add(axes: Axes, x: NDArray, y: NDArray, label: str, colour: str, **style: Any) -> None:
        axes.plot(x, y, color=colour, lw=0.6, alpha=0.25, **style)
        (line,) = axes.plot([], [], color=colour, lw=1.2, label=label, **style)
        growing.append((line, x, y))

    for column, (label, colour) in enumerate((("$a$", BLUE), ("$b$", ORANGE))):
        add(above, times, 100 * (com - seat)[:, column], label, colour)
    above.set_ylabel("rod's offset (cm)")
    above.legend(ncols=2, loc="upper left")
    above.margins(y=0.25)
    if flight.length is not None:
        used = flight.length.column("used")
        # a point at the end of each step, so that a line up to a time ends at that time
        at = np.arange(0.0, flight.duration, 0.05)
        rows = np.searchsorted(flight.time(flight.length), at, side="right") - 1
        add(below, at, used[np.maximum(rows, 0)], "length in use", GREEN, drawstyle="steps-post")
        if flight.truth_length is not None:
            below.axhline(flight.truth_length.values[-1, 0], color="black", lw=0.6, label="true length")
        below.set_ylabel("length (m)")
    else:
        add(below, times, flight.vehicle.position[:, 2], "height of the vehicle", GREEN)
        below.set_ylabel("$z$ (m)")
    below.margins(y=0.35)
    below.legend(loc="upper right")
    below.set_xlabel("time (s)")
    for axes in panels:
        axes.set_xlim(0, flight.duration)
    cursors = [axes.axvline(0.0, color=GREY, lw=0.8) for axes in panels]

    def show(time: float) -> list:
        for line, x, y in growing:
            known = x <= time
            line.set_data(x[known], y[known])
        for cursor in cursors:
            cursor.set_xdata([time, time])
        return [*(line for line, _, _ in growing), *cursors]

    return show
