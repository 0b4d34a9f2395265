"""A recorded flight as one page that plays in 3-D, without a server and without the network."""

import html
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fiplib.recording import Flight
from fiplib.teaching.animation import joined
from fiplib.teaching.scene import Scene, open_server, quiet

PICTURES = 30
"""Pictures a second."""

CAPTIONS = 3
"""Pictures to a caption and to a point of the track: ten of each a second."""


def page(flight: Flight) -> str:
    """Return a flight as an HTML page, 1 to 2 MB; its lean and tilt are shown once more, five times enlarged.

    Only the two motion-capture poses are needed; the reference and the length are shown where the flight carries them.
    The player and all that it loads are in the page.
    """
    times, seats, coms = joined(flight)
    length = flight.params.pendulum.length
    rods = (coms - seats) / np.linalg.norm(coms - seats, axis=1, keepdims=True)
    server = open_server(flight.path.name)
    try:
        scene = Scene(server, flight.params)
        scene.rod(length)
        scene.enlarge(True)
        caption = server.scene.add_label("/caption", "", position=(0.0, 0.0, 0.3))
        recording = server.get_scene_serializer()
        for number, time in enumerate(np.arange(0.0, times[-1], 1.0 / PICTURES)):
            index = min(int(np.searchsorted(times, time)), len(times) - 1)
            attitude = flight.vehicle.orientation[index]
            scene.show(seats[index], attitude, rods[index], _target(flight, time, seats[index]))
            if number % CAPTIONS == 0:
                scene.extend_track(seats[index])
                caption.text = _caption(flight, time)
            recording.insert_sleep(1.0 / PICTURES)
        text = recording.as_html()
    finally:
        with quiet():
            server.stop()
    title = f"<title>{html.escape(flight.path.name)}, {html.escape(str(flight.metadata['origin']))}</title>"
    return text.replace("<title>Viser</title>", title)


def _target(flight: Flight, time: float, seat: NDArray) -> NDArray:
    """Where the seat should be at a time in s, (3,) m; where it is, if the flight carries no reference."""
    if flight.reference is None:
        return seat
    at = min(int(np.searchsorted(flight.time(flight.reference), time)), len(flight.reference.stamp) - 1)
    x, y = (flight.reference.column(name)[at] for name in ("x", "y"))
    return np.array([x, y, flight.metadata.get("reference", {}).get("height", seat[2])])


def _caption(flight: Flight, time: float) -> str:
    words = f"{flight.metadata['origin']}, {time:.1f} s"
    if flight.length is not None:
        at = int(np.searchsorted(flight.time(flight.length), time, side="right")) - 1
        words += f", length in use {flight.length.column('used')[max(at, 0)]:.3f} m"
    return words


def write_page(flight: Flight, path: Path) -> None:
    """Write ``page`` to a file, with the folders above it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(page(flight), encoding="utf-8")
