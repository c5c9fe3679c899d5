"""A browser page that only this machine can open: viser bound to 127.0.0.1, with light, camera and background."""

import errno
import importlib
import math
import os
import secrets
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from torchface.errors import TorchfaceError, ValueRangeError
from torchface.files.extra_packages import import_extra
from torchface.mesh import Mesh
from torchface.number_checks import checked_count
from torchface.viz.browser.origin_check import only_this_page

if TYPE_CHECKING:
    import viser

HOST = "127.0.0.1"
SCALE = 0.01
"""Millimetres to the page's units: viser's clipping planes and controls suit things a few units large."""

_FIELD_OF_VIEW = math.radians(26.0)
_BACKGROUND_TOP, _BACKGROUND_BOTTOM = (0.93, 0.94, 0.95), (0.62, 0.66, 0.70)
_BRAND = (46, 92, 138)


def import_viser() -> Any:
    """The ``viser`` package."""
    return import_extra("viser", "viser", "viewer", "the viewer")


def start_server(label: str, token: str, port: int = 8080) -> "viser.ViserServer":
    """A page on ``http://127.0.0.1:PORT/TOKEN/``, or on the next port that is free; 0 is any.

    Other users of this machine do not know the token.
    """
    viser = import_viser()
    port = free_port(HOST, port)
    title = f"{label} – torchface" if label != "torchface" else label
    with _quiet(), only_this_page(title, token):
        server = viser.ViserServer(host=HOST, port=port, label=label, verbose=False)
    # Any page open in the browser could ask viser for a public tunnel to this one; there is none.
    setattr(server, "request_share_url", lambda verbose=True: None)  # noqa: B010
    server.scene.set_up_direction("+y")
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large", brand_color=_BRAND)
    server.gui.main_panel.dock_right()
    server.scene.world_axes.visible = False
    _light(server)
    server.scene.set_background_image(_gradient(), format="png")
    return server


class BrowserPage:
    """A page and its server, on the first free port from ``port``, until it is closed."""

    def __init__(self, label: str, port: int) -> None:
        self._lock = threading.RLock()
        self._stopped = threading.Event()
        self._threads: list[threading.Thread] = []
        self._token = secrets.token_urlsafe(16)
        self.server = start_server(label, self._token, port)

    @property
    def url(self) -> str:
        """Where the page is; who knows the whole of it may use the page."""
        return f"http://{HOST}:{self.server.get_port()}/{self._token}/"

    def stop(self) -> None:
        """Closes the page."""
        self._stopped.set()
        for thread in self._threads:
            thread.join(timeout=5)
        with _quiet():
            self.server.stop()

    def keep_unsaved(self) -> list[Path]:
        """Writes what was changed since the last Save under a name that no file has, and returns the files."""
        return []

    def wait(self) -> None:
        """Returns when the page is closed by :meth:`stop`, or at an interrupt."""
        self._stopped.wait()

    def _start(self, run: Callable[[], None]) -> None:
        """Starts a thread of the page, which :meth:`stop` ends: it returns once ``_stopped`` is set."""
        self._threads.append(threading.Thread(target=run, name="torchface-page", daemon=True))
        self._threads[-1].start()

    def _add_save_button(self, label: str, hint: str, save: Callable[[], str]) -> None:
        """A button that saves and notifies whoever clicked it of the files, or of what went wrong."""

        def clicked(event: "viser.GuiEvent") -> None:
            assert event.client is not None
            try:
                event.client.add_notification("Saved", save(), auto_close_seconds=6.0, color="teal")
            except (TorchfaceError, OSError) as error:
                event.client.add_notification("Not saved", str(error), color="red")

        self.server.gui.add_button(label, icon=icon("DEVICE_FLOPPY"), hint=hint).on_click(clicked)


def icon(name: str) -> Any:
    """One of viser's icons, such as ``"PLAYER_PLAY"``."""
    return getattr(import_viser().Icon, name)


def frame_camera(server: "viser.ViserServer", mesh: Mesh, width: float = 1.0) -> None:
    """Sets the camera before a mesh, looking along -z: round its landmarks where annotated, else the whole,
    ``width`` times as wide."""
    points, room = mesh.vertices.double(), 1.12
    if mesh.annotations is not None and mesh.annotations.landmarks is not None and width == 1.0:
        points, room = points[mesh.annotations.landmarks], 2.1
    low, high = points.amin(0), points.amax(0)
    size, centre = high - low, (low + high) / 2
    if room > 2:  # landmarks end at the brows: leave room for the forehead
        centre = centre + torch.tensor([0.0, 0.14, 0.0]).to(centre) * size[1]
    centre[0] += (width - 1) / 2 * size[0]
    span = room * float(torch.maximum(size[1], size[0] * width))
    distance = float(high[2] - centre[2]) + 0.5 * span / math.tan(_FIELD_OF_VIEW / 2)
    position = centre + torch.tensor([0.0, 0.0, distance]).to(centre)
    camera = server.initial_camera
    camera.position = (position * SCALE).numpy()
    camera.look_at = (centre * SCALE).numpy()
    camera.up = (0.0, 1.0, 0.0)
    camera.fov = _FIELD_OF_VIEW


def _light(server: "viser.ViserServer") -> None:
    """Key from the viewer's upper left, weaker fill, rim from behind: form shows where flat light would hide it."""
    scene = server.scene
    scene.configure_default_lights(enabled=False)
    scene.configure_environment_map(None)
    scene.add_light_hemisphere("/light/sky", sky_color=(235, 240, 248), ground_color=(150, 140, 132), intensity=0.9)
    for name, position, color, strength in (
        ("key", (-3.0, 4.0, 5.0), (255, 247, 238), 2.2),
        ("fill", (5.0, 0.5, 3.5), (225, 235, 250), 0.7),
        ("rim", (2.0, 4.0, -5.0), (255, 255, 255), 1.2),
    ):
        scene.add_light_directional(f"/light/{name}", color=color, intensity=strength, position=position)


def _gradient() -> np.ndarray:
    height = 256
    blend = np.linspace(0.0, 1.0, height)[:, None, None]
    top, bottom = np.array(_BACKGROUND_TOP), np.array(_BACKGROUND_BOTTOM)
    rows = np.broadcast_to(top * (1 - blend) + bottom * blend, (height, 4, 3))
    return (rows * 255).round().astype(np.uint8)


@contextmanager
def _quiet() -> Iterator[None]:
    """viser announces itself on standard output, which belongs to the command."""
    console = importlib.import_module("rich").get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before


_SAME = 5e-4


class SharedInput:
    """A slider, dropdown or checkbox of the page, which distinguishes the user's changes, after which ``act`` is
    called, from the program's."""

    def __init__(self, handle: Any, lock: AbstractContextManager, act: Callable[[Any], Any]) -> None:
        self.handle = handle
        self._lock = lock
        self._act = act
        self._value = handle.value
        handle.on_update(self._changed)

    def push(self, value: Any) -> None:
        """Shows a value, unless the user has just set another that is still to be acted on."""
        if self.handle.value != self._value:
            return
        if isinstance(value, float | int) and abs(value - self._value) < _SAME:
            return
        self._value = value
        self.handle.value = value
        self._value = self.handle.value

    def _changed(self, event: Any) -> None:
        if event.client is None:  # the program's own doing
            return
        with self._lock:
            self._value = event.target.value
            self._act(self._value)


LAST_PORT = 65535
_TRIES = 100


def free_port(host: str, first: int) -> int:
    """The first port from ``first`` that can be listened on; 0 stays, for any.

    A server that looks for one by itself waits for ever where it runs out of them.
    """
    checked_count("port", first, 0, LAST_PORT)
    if first == 0:
        return 0
    last = min(first + _TRIES - 1, LAST_PORT)
    for port in range(first, last + 1):
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as trial:
            if os.name == "posix":  # elsewhere it would take ports that are in use
                trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                trial.bind((host, port))
            except OSError as error:
                if error.errno == errno.EACCES and port < 1024:
                    raise ValueRangeError(
                        f"port: found {port}, which this user may not listen on; expected one from 1024 to {LAST_PORT}"
                    ) from None
                continue
            return port
    raise ValueRangeError(f"port: found {first} to {last} in use, expected a free one among them; try another")
