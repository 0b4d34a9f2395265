"""Vehicle, rod and target as a scene in 3-D, in a browser: what the live view and a recorded flight both show."""

import contextlib
import io
import socket

import numpy as np
import viser
from numpy.typing import ArrayLike, NDArray

from fiplib.dynamics import z_axis
from fiplib.params import Params
from fiplib.teaching.lean import ENLARGED, upright

LOOPBACK = "127.0.0.1"
"""The only address served: the view is for the person at this machine."""

BLUE, ORANGE, GREEN, BLACK, GREY = (0, 114, 178), (213, 94, 0), (0, 158, 115), (30, 30, 30), (150, 150, 150)
"""The colours of Okabe and Ito."""

BESIDE = np.array([0.6, 0.0, 0.0])
"""Where the second picture stands, from the first, m."""

TRAIL = 60
"""Points of the track that stay visible."""


def quiet() -> contextlib.redirect_stdout[io.StringIO]:
    """Return a context in which the viewer's own announcements are not printed."""
    return contextlib.redirect_stdout(io.StringIO())


class LocalServer(viser.ViserServer):
    """A server that never opens its tunnel to a server of others, whatever a page asks for."""

    def request_share_url(self, verbose: bool = True) -> None:
        """Share nothing."""


def open_server(label: str) -> viser.ViserServer:
    """Serve an empty scene on a free port of the loopback interface; the caller stops it."""
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        port = probe.getsockname()[1]
    with quiet():
        server = LocalServer(host=LOOPBACK, port=port, label=label, verbose=False)
    server.gui.configure_theme(show_logo=False, show_share_button=False, brand_color=BLUE)
    server.initial_camera.position, server.initial_camera.look_at = (0.8, -1.8, 2.0), (0.2, 0.0, 1.55)
    return server


class Scene:
    """Vehicle, rod, track and target to scale; and, where asked, both once more with lean and tilt enlarged.

    Args:
        server: where the scene is shown.
        params: sizes of vehicle and rod.
    """

    def __init__(self, server: viser.ViserServer, params: Params) -> None:
        self._scene, self._params = server.scene, params
        self._trail: list[NDArray] = []
        self._scene.add_grid("/floor", 6.0, 6.0, cell_size=0.1, section_size=1.0, plane_color=(255, 255, 255),
                             plane_opacity=1.0, shadow_opacity=0.3, cell_color=(235, 235, 235),
                             section_color=(200, 200, 200))  # fmt: skip
        self._words = self._scene.add_label("/enlarged", f"lean and tilt {ENLARGED:g} times enlarged")
        self._target = self._scene.add_icosphere("/target", 0.02, GREEN, cast_shadow=False)
        self._track = self._scene.add_line_segments("/track", np.zeros((1, 2, 3)), BLUE, thickness=0.004)
        self._vehicles = [self._body("/vehicle", BLUE, None), self._body("/enlarged-vehicle", ORANGE, 0.7)]
        self.length = params.pendulum.length
        self._rods = [self._scene.add_frame(name, show_axes=False) for name in ("/rod", "/enlarged-rod")]
        self.rod(params.pendulum.length)
        self.enlarge(False)

    def rod(self, length: float) -> None:
        """Draw a rod of this length in m, with its centre of mass."""
        self.length = length
        for name, colour, opacity in (("/rod", BLACK, None), ("/enlarged-rod", ORANGE, 0.7)):
            middle = (0.0, 0.0, length / 2)
            self._scene.add_cylinder(f"{name}/stick", 0.006, length, colour, opacity=opacity, position=middle)
            self._scene.add_icosphere(f"{name}/com", 0.014, ORANGE, opacity=opacity, position=middle)
        self._trail.clear()

    def enlarge(self, shown: bool) -> None:
        """Show or hide the second picture, in which lean and tilt are ``ENLARGED``."""
        self._vehicles[1].visible = self._rods[1].visible = self._words.visible = shown

    def show(self, seat: ArrayLike, attitude: ArrayLike, rod: ArrayLike, target: ArrayLike) -> None:
        """Move everything.

        Args:
            seat: (3,) m, where the rod stands.
            attitude: of the vehicle, quaternion (4,) as x, y, z, w.
            rod: unit vector (3,) along the rod.
            target: (3,) m, where the seat should be.
        """
        seat, x, y, z, w = np.asarray(seat, dtype=float), *map(float, attitude)
        up, below = np.array(z_axis(x, y, z, w)), self._params.vehicle.seat_height
        turns = (x, y, z, w), upright(up, ENLARGED)
        places = (seat, 1.0), (seat + BESIDE, ENLARGED)
        for vehicle, stick, turn, (seat, lean) in zip(self._vehicles, self._rods, turns, places, strict=True):
            vehicle.wxyz, vehicle.position = _scalar_first(turn), seat - below * np.array(z_axis(*turn))
            stick.wxyz, stick.position = _scalar_first(upright(rod, lean)), seat
        self._words.position = seat - [0.0, 0.0, 0.25]
        self._target.position = np.asarray(target, dtype=float)

    def extend_track(self, seat: ArrayLike) -> None:
        """Add a point (3,) m to the track, whose oldest are forgotten."""
        self._trail = [*self._trail[-TRAIL:], np.array(seat, dtype=float)]
        if len(self._trail) > 1:
            self._track.points = np.stack([self._trail[:-1], self._trail[1:]], axis=1)

    def _body(self, name: str, colour: tuple[int, int, int], opacity: float | None) -> viser.FrameHandle:
        """A quadcopter to scale, its centre at the frame's origin: two arms, four propellers, a stand for the rod."""
        vehicle = self._params.vehicle
        frame = self._scene.add_frame(name, show_axes=False)
        reach, size = vehicle.wheelbase / np.sqrt(8), vehicle.wheelbase
        for number, angle in enumerate((np.pi / 4, -np.pi / 4)):
            turn = (float(np.cos(angle / 2)), 0.0, 0.0, float(np.sin(angle / 2)))
            self._scene.add_box(f"{name}/arm{number}", colour, (size, 0.012, 0.008), wxyz=turn, opacity=opacity)
        for number, (x, y) in enumerate(((1, 1), (1, -1), (-1, -1), (-1, 1))):
            self._scene.add_cylinder(f"{name}/propeller{number}", vehicle.propeller_diameter / 2, 0.006, colour,
                                     opacity=opacity or 0.5, position=(x * reach, y * reach, 0.014))  # fmt: skip
        stand = vehicle.seat_height
        if stand > 0.0:
            self._scene.add_cylinder(f"{name}/stand", 0.004, stand, GREY, opacity=opacity, position=(0, 0, stand / 2))
        return frame


def _scalar_first(quaternion: tuple[float, ...]) -> tuple[float, float, float, float]:
    x, y, z, w = quaternion
    return w, x, y, z
