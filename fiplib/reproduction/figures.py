"""Every figure of the paper, from recorded flights: flights in, ``Figure`` out. Nothing is simulated here.

A new figure is one function and one line in ``products.PRODUCTS``; ``fip figures NAME`` writes it. The function's
docstring is the caption (``products.caption``): plain text, without markup.
"""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from scipy.spatial.transform import Rotation

from fiplib.dynamics import seat_position
from fiplib.params import STATES, Params
from fiplib.recording import BagError, Flight
from fiplib.reproduction import bands, claims, measures
from fiplib.reproduction.sources import Rows
from fiplib.reproduction.style import BLUE, COLUMN, GREEN, GREY, LIGHT, ORANGE, origin

RMS_SECONDS = 0.25
"""Span of the running RMS of the rate commands, s: 30 commands."""


def fig1_flight(flight: Flight) -> Figure:
    """Fig. 1: the flight in space on the circle of 0.8 m radius: one simulated flight, its last lap of 9 s.

    Vehicle and rod are drawn once a second. The rod leans inwards, as a cyclist does, so its centre of mass makes the
    smaller circle; along y, whose weights are light, the vehicle stays inside its reference.
    """
    figure = Figure(figsize=(COLUMN, 2.9))
    axes = figure.add_axes((-0.05, -0.04, 1.02, 1.13), projection="3d")
    time, (radius, height, period) = flight.time(flight.vehicle), measures.circling(flight)
    if not np.array_equal(flight.vehicle.stamp, flight.pendulum.stamp):
        raise BagError(f"{flight.path}: its two bodies do not have the same stamps, one for one")
    lap = time > flight.duration - period
    axes.plot(*flight.vehicle.position[lap].T, color=BLUE, label="vehicle")
    axes.plot(*flight.pendulum.position[lap].T, color=ORANGE, label="rod's centre of mass")
    angle = np.linspace(0, 2 * np.pi, 200)
    circle = radius * np.cos(angle), radius * np.sin(angle), np.full(200, height)
    axes.plot(*circle, "--", color=GREY, lw=0.7, label="reference")
    vehicle = flight.params.vehicle
    arms = vehicle.wheelbase / 2 * np.array([[1, 1, 0], [-1, -1, 0], [0, 0, 0], [1, -1, 0], [-1, 1, 0]]) / np.sqrt(2)
    for index in np.nonzero(lap)[0][:: round(flight.params.piloting.mocap_rate)]:
        frame, turn = flight.vehicle.position[index], flight.vehicle.orientation[index]
        seat, com = seat_position(frame, turn, flight.params.piloting.seat_height), flight.pendulum.position[index]
        tip = seat + (com - seat) * flight.params.pendulum.length / np.linalg.norm(com - seat)
        axes.plot(*np.array([seat, tip]).T, color="black", lw=0.8)
        axes.plot(*(frame + Rotation.from_quat(turn).apply(arms)).T, color=BLUE, lw=1.1)
    axes.set(xlabel="$x$ (m)", ylabel="$y$ (m)", zlabel="$z$ (m)", xlim=(-1, 1), ylim=(-1, 1), zlim=(1, 2.4))
    axes.set(xticks=(-1, 0, 1), yticks=(-1, 0, 1), zticks=(1.0, 1.5, 2.0))
    axes.set_box_aspect((2, 2, 1.4), zoom=0.95)
    axes.view_init(elev=18, azim=-62)
    axes.tick_params(pad=-2)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.labelpad = -6
        axis.pane.set_facecolor("white")
        axis._axinfo["grid"]["linewidth"] = 0.3
    figure.legend(*axes.get_legend_handles_labels(), loc="lower center", ncols=3)
    _origin(figure, flight, y=0.99)
    return figure


def fig2_vehicle() -> Figure:
    """Fig. 2: vehicle and rod to scale, with the paper's parameters (Table 1), and the vehicle enlarged.

    The seat is 8 cm above the frame's centre. The rod of 1 m is six times as long as the vehicle is wide.
    """
    params = Params()
    vehicle, rod = params.vehicle, params.pendulum
    figure = Figure(figsize=(COLUMN, 3.3))
    whole, close = figure.add_axes((0.0, 0.05, 0.45, 0.89)), figure.add_axes((0.45, 0.05, 0.55, 0.89))
    for axes in (whole, close):
        _draw_vehicle(axes, params)
        axes.set_aspect("equal")
        axes.axis("off")
    top = vehicle.seat_height + rod.length
    whole.plot(0, vehicle.seat_height + rod.length / 2, "o", ms=4, mfc="white", mec="black", mew=0.8)
    whole.set(xlim=(-0.3, 0.36), ylim=(-0.06, top + 0.04))
    _dimension(whole, (0.3, vehicle.seat_height), (0.3, top), f"$l$ = {rod.length:g} m", rotation=90)
    com = vehicle.seat_height, vehicle.seat_height + rod.length / 2
    _dimension(whole, (0.13, com[0]), (0.13, com[1]), "$l/2$", rotation=90)
    whole.text(-0.04, com[1], f"$m_p$ =\n{rod.mass:g} kg", ha="right", va="center")
    whole.set_title("to scale", pad=2)

    close.set(xlim=(-0.15, 0.18), ylim=(-0.19, 0.33))
    half = vehicle.wheelbase / 2
    _dimension(close, (0.155, 0.0), (0.155, vehicle.seat_height), f"{100 * vehicle.seat_height:g} cm", rotation=90)
    _dimension(close, (-half, -0.055), (half, -0.055), f"{100 * vehicle.wheelbase:g} cm*")
    close.text(0, -0.1, f"$m$ = {vehicle.mass:g} kg", ha="center", va="top")
    close.text(0, -0.128, rf"$|\omega| \leq$ {np.degrees(vehicle.max_body_rate):g} deg/s", ha="center", va="top")
    close.set_title("vehicle, enlarged", pad=2)
    figure.text(0.02, 0.015, "* our choice; the rest: Table 1 and section 3 of the paper", fontsize=7)
    return figure


def fig3_pushes(flight: Flight) -> Figure:
    """Fig. 3: three pushes of the rod in hover (dotted lines): one simulated flight with a rod of 1 m.

    From above: the position of the seat, the offsets of the rod's centre of mass, the vehicle's tilt, and the running
    RMS over 0.25 s of the commanded body rates. Dashed: the largest offset that the paper reports, 5.8 cm, and the
    bound of the rates, 100 deg/s; grey: the 2 s in which the paper's rod settles after a push. Our pushes were chosen
    to give about the paper's largest offset. The rod takes half a second to a second more than the paper's to settle;
    the vehicle takes up to 5 s, since the weight of its position is small.
    """
    figure, panels = _panels(flight, 4, 3.9)
    _plot_states(panels[0], flight, ("x", "y"), "position", scale=100, unit="cm")
    _plot_states(panels[1], flight, ("a", "b"), "pendulum", scale=100, unit="cm")
    _band(panels[1], 100 * claims.PAPER["D2"], "paper's largest")
    _plot_states(panels[2], flight, ("phi", "theta"), "tilt", scale=np.degrees(1), unit="deg")
    panels[2].set_ylim(top=1.6 * panels[2].get_ylim()[1])  # the legend has a strip of its own
    _plot_rates(panels[3], flight)
    for number, start in enumerate(measures.push_times(flight)):
        for axes in panels:
            axes.axvline(start, color=GREY, lw=0.6, ls=":")
        label = None if number else "paper settles"
        panels[1].axvspan(start, start + claims.PAPER["D3"], ymax=0.78, color=LIGHT, lw=0, zorder=0, label=label)
    panels[1].legend(loc="upper right", ncols=4)
    return figure


def fig4_circle(flight: Flight) -> Figure:
    """Fig. 4: the circle of 0.8 m radius and 9 s: one simulated flight with a rod of 1 m, whose length is known.

    Dashed black: the paper's largest error of y, 0.2 m, and its largest offset of the rod, 2.5 cm. As in the paper x
    follows its reference and y, whose weights are light, falls short of its own; the offsets stay below the paper's.
    """
    figure, panels = _panels(flight, 4, 3.9)
    for axes, name in zip(panels, "xy", strict=False):
        _plot_tracking(axes, flight, name)
    _plot_errors(panels[2], flight)
    _band(panels[2], 100 * claims.PAPER["C2.y"], "paper's $y$")
    _plot_states(panels[3], flight, ("a", "b"), "pendulum", scale=100, unit="cm")
    _band(panels[3], 100 * claims.PAPER["C1"], "paper's largest")
    return figure


def fig5_estimation(flight: Flight, spread: Rows = ()) -> Figure:
    """Fig. 5: the 0.4 m circle (8 s) while the length is estimated from l0 = 1.4 m; the rod has 1 m.

    Lines: the recorded flight (simulated), with the result of each run of the genetic algorithm (dots) and the length
    in use, their median. Bands: 5 to 95 % of 20 simulated flights, which differ in noise only and include the recorded
    one. Dashed: time and value at which the paper's length converged, 12.43 s and 1.0 m.
    Nothing is known before the first window of 55 samples is full, at 5.5 s. The first answers are 6 to 16 cm short;
    from 12 s on the length in use lies between 0.93 and 1.04 m, and x is tracked as it is with the true length.
    """
    figure, panels = _panels(flight, 4, 4.3)
    known = bands.flights(spread, flight.path.name)
    for axes, name in zip(panels, "xy", strict=False):
        _plot_tracking(axes, flight, name)
    _plot_errors(panels[2], flight, known)
    measures.need(flight, "length")
    time, used = measures.used_length(flight)
    axes = panels[3]
    if known:
        _plot_band(axes, bands.band(bands.values(known, "used")), ORANGE, f"{len(known)} flights", step="post")
    axes.plot(time, flight.length.values[:, 1], ".", ms=2, color=BLUE, label="GA run")
    axes.step(time, used, where="post", color=ORANGE, label="used")
    axes.axhline(measures.true_length(flight), color="black", lw=0.6, label="true")
    axes.axvline(claims.PAPER["G3.time"], color=GREY, ls="--", lw=0.7, label="paper converged")
    axes.set(ylabel="length (m)", ylim=(0.7, 1.75))
    axes.legend(loc="upper right", ncols=2)
    return figure


def fig6_convergence(*sources: Flight | Rows) -> Figure:
    """Fig. 6: the length in use from three first lengths; the rod has 1 m and the vehicle is on the 0.4 m circle.

    Lines: the recorded flights (simulated). Bands: 5 to 95 % of 20 simulated flights from each first length, of the
    same 20 seeds; the recorded one is among them. Crosses with dashed lines: time and length at which the paper's
    flights converged (its Table 3), in the colour of the same first length. With the first full window of 55 samples,
    at 5.5 s, the length in use comes within 16 cm of the true one, from 1.4 m less closely than from 0.8 m, since the
    flight until then was less accurate; from 12 s on the three bands coincide, 0.93 to 1.04 m: the spread is due to
    noise, not to the first length. The paper's 3.99 s from 1.2 m lies before our first window is full.
    """
    *flights, last = sources
    spread: Rows = [] if isinstance(last, Flight) else last
    flights += [last] if isinstance(last, Flight) else []
    figure, (axes,) = _panels(flights[0], 1, 2.8)
    _origin(figure, *flights)
    for flight, claim, colour in zip(flights, ("G1", "G2", "G3"), (BLUE, ORANGE, GREEN), strict=True):
        time, used = measures.used_length(flight)
        if known := bands.flights(spread, flight.path.name):
            _plot_band(axes, bands.band(bands.values(known, "used")), colour, None, step="post")
        axes.step(
            np.r_[time, flight.duration], np.r_[used, used[-1]], where="post", color=colour, lw=1.1,
            label=f"$l_0$ = {used[0]:g} m",
        )  # fmt: skip
        axes.axvline(claims.PAPER[f"{claim}.time"], color=colour, ls="--", lw=0.6)
        axes.plot(claims.PAPER[f"{claim}.time"], claims.PAPER[f"{claim}.length"], "X", color=colour, mec="black",
                  mew=0.4, ms=5.5, zorder=3)  # fmt: skip
    axes.plot([], [], "X", color="white", mec="black", mew=0.6, ms=5.5, label="paper, same colour")
    axes.axhline(measures.true_length(flights[0]), color="black", lw=0.6)
    axes.set(ylabel="length used, $l$ (m)", xlabel="time (s)")
    axes.legend(ncols=2, loc="upper right")
    return figure


# --- pieces shared by the figures


def _panels(flight: Flight, count: int, height: float) -> tuple[Figure, Sequence[Axes]]:
    """Panels over a common time axis; the first carries the origin of the data."""
    figure = Figure(figsize=(COLUMN, height), layout="constrained")
    panels = figure.subplots(count, 1, sharex=True, squeeze=False)[:, 0]
    panels[-1].set_xlabel("time (s)")
    panels[-1].set_xlim(0, flight.duration)
    figure.align_ylabels(panels)
    _origin(figure, flight)
    return figure, panels


def _origin(figure: Figure, *flights: Flight, y: float | None = None) -> None:
    origins = " and ".join(sorted({flight.metadata["origin"] for flight in flights}))
    origin(figure, f"{origins}, {', '.join(flight.path.name for flight in flights)}", y)


def _plot_states(
    axes: Axes, flight: Flight, names: tuple[str, str], what: str, scale: float = 1.0, unit: str = "m"
) -> None:
    measures.need(flight, "state")
    labels = {signal.name: signal.label for signal in STATES}
    time = flight.time(flight.state)
    for name, colour in zip(names, (BLUE, ORANGE), strict=True):
        axes.plot(time, scale * flight.state.column(name), color=colour, label=labels[name])
    axes.set_ylabel(f"{what} ({unit})")
    axes.legend(loc="upper right", ncols=2)


def _plot_tracking(axes: Axes, flight: Flight, name: str) -> None:
    measures.states(flight)
    axes.plot(flight.time(flight.reference), flight.reference.column(name), "--", color=GREY, lw=0.8, label="reference")
    axes.plot(flight.time(flight.state), flight.state.column(name), color=BLUE, label="flown")
    axes.set_ylabel(f"${name}$ (m)")
    top = 1.9 * max(np.abs(flight.reference.column(name)).max(), 1e-3)
    axes.set_ylim(-top / 1.5, top)
    axes.legend(loc="upper right", ncols=2)


def _plot_band(axes: Axes, band: bands.Band, colour: str, label: str | None, **how: str) -> None:
    """Draw the spread over flights behind a recorded one."""
    axes.fill_between(band.time, band.low, band.high, color=colour, alpha=0.16, lw=0, label=label, **how)
    for edge in (band.low, band.high):
        axes.plot(band.time, edge, color=colour, lw=0.35, drawstyle="steps-post" if how else "default")


def _plot_errors(axes: Axes, flight: Flight, spread: Rows = ()) -> None:
    for name, colour in zip("xy", (BLUE, ORANGE), strict=True):
        if spread:
            _plot_band(axes, bands.band(100 * bands.values(spread, f"{name}_error")), colour, None)
        error = flight.state.column(name) - flight.reference.column(name)
        axes.plot(flight.time(flight.state), 100 * error, color=colour, label=f"${name} - {name}_\\mathrm{{ref}}$")
    axes.set_ylabel("error (cm)")
    largest = 100 * np.abs(measures.tracking_error(flight)).max()
    axes.set_ylim(-1.25 * largest, 2.1 * largest)
    axes.legend(loc="upper right", ncols=2)


def _plot_rates(axes: Axes, flight: Flight) -> None:
    """Draw the running RMS of the commanded rates: the commands themselves are noise that fills the panel."""
    measures.need(flight, "command")
    time = flight.time(flight.command)
    span = max(1, round(RMS_SECONDS * (len(time) - 1) / (time[-1] - time[0])))
    for name, label, colour in (("omega_x", r"$\omega_x$", BLUE), ("omega_y", r"$\omega_y$", ORANGE)):
        square = np.degrees(flight.command.column(name)) ** 2
        mean = np.convolve(square, np.full(span, 1.0 / span), mode="valid")
        middle = time[span // 2 :][: len(mean)]
        axes.plot(middle, np.sqrt(np.maximum(mean, 0.0)), color=colour, label=label)
    axes.set_ylabel("rate, RMS\n(deg/s)")
    limit = np.degrees(flight.params.vehicle.max_body_rate)
    axes.axhline(limit, color="black", lw=0.6, ls="--", label="bound")
    axes.set_ylim(0.0, 1.65 * limit)
    axes.legend(loc="upper right", ncols=3)


def _band(axes: Axes, value: float, label: str) -> None:
    """Draw the paper's largest magnitude on both sides, and leave room above for the legend."""
    for side in (-value, value):
        axes.axhline(side, color="black", lw=0.6, ls="--", label=label if side > 0 else None)
    axes.set_ylim(-1.25 * value, 2.1 * value)
    axes.legend(loc="upper right", ncols=3)


def _draw_vehicle(axes: Axes, params: Params) -> None:
    """Side view of vehicle and rod; origin at the frame's centre, metres."""
    vehicle = params.vehicle
    half, radius, seat = vehicle.wheelbase / 2, vehicle.propeller_diameter / 2, vehicle.seat_height
    axes.add_patch(Rectangle((-half, -0.006), 2 * half, 0.012, fc=GREY, ec="black", lw=0.5))
    axes.add_patch(Rectangle((-0.02, 0.006), 0.04, seat - 0.006, fc="#DDDDDD", ec="black", lw=0.5))
    for side in (-half, half):
        axes.add_patch(Rectangle((side - 0.012, 0.006), 0.024, 0.016, fc=GREY, ec="black", lw=0.5))
        axes.plot([side - radius, side + radius], [0.026, 0.026], color=BLUE, lw=1.6, solid_capstyle="round")
    axes.plot([0, 0], [seat, seat + params.pendulum.length], color="black", lw=1.6, solid_capstyle="round")


def _dimension(
    axes: Axes, start: tuple[float, float], end: tuple[float, float], text: str, rotation: float = 0
) -> None:
    axes.annotate("", start, end, arrowprops={"arrowstyle": "<->", "lw": 0.6, "shrinkA": 0, "shrinkB": 0})
    middle = np.mean([start, end], axis=0)
    axes.text(*middle, text, ha="center", va="center", rotation=rotation, bbox={"fc": "white", "ec": "none", "pad": 1})
