"""The annotation page: a frame with its 68 landmarks, which are dragged to where they belong."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchface.errors import TorchfaceError
from torchface.io.video import to_bytes
from torchface.viz.browser.annotation_session import AnnotationSession
from torchface.viz.browser.browser_page import BrowserPage, icon
from torchface.viz.browser.html_lists import caption, pick_list
from torchface.viz.browser.landmark_sets import IBUG_68

_CORNERS = 20

if TYPE_CHECKING:
    import viser

_VIEW = math.radians(30.0)
_FACE = 1.0  # units of the page that a face's size is shown at
_DOT = 0.024
_LIFT = 0.01  # dots lie this much before the image, lines half of it
_PARTS = (
    (slice(0, 17), (80, 200, 255)),
    (slice(17, 27), (255, 170, 60)),
    (slice(27, 36), (120, 230, 120)),
    (slice(36, 48), (255, 105, 180)),
    (slice(48, 60), (255, 80, 80)),
    (slice(60, 68), (255, 190, 190)),
)
_CHOSEN = (255, 255, 0)
_LINES = (
    (range(0, 17), False),
    (range(17, 22), False),
    (range(22, 27), False),
    (range(27, 31), False),
    (range(31, 36), False),
    (range(36, 42), True),
    (range(42, 48), True),
    (range(48, 60), True),
    (range(60, 68), True),
)


class LandmarkEditor(BrowserPage):
    """Frames in the browser, their landmarks to be dragged.

    A dot is dragged, or chosen by a click; a click on the image brings the chosen one there. *Save* writes the frame's
    files and switches to the next.
    """

    def __init__(self, session: AnnotationSession, label: str = "torchface annotate", port: int = 8080) -> None:
        super().__init__(label, port)
        self.session = session
        self.chosen: int | None = None
        self._offset = torch.zeros(2, dtype=torch.float64)
        self._showing = False
        self.server.scene.remove_by_name("/light")  # it models form; dots have a colour each
        self.server.scene.add_light_ambient("/light/even", intensity=2.0)
        self._dots: Any = None
        self._lines: Any = None
        self._add_panel()
        self._show_frame()
        self.server.scene.on_click()(self._clicked)
        self.server.on_client_connect(self._straighten)

    def to_page(self, pixels: Tensor) -> Tensor:
        """Where pixels (...,2) of the image lie in the page's scene, (...,2) along x and y."""
        return (pixels.double() - self._middle) * torch.tensor([self._unit, -self._unit], dtype=torch.float64)

    def to_pixels(self, origin: Tensor, direction: Tensor) -> Tensor:
        """Where a ray of the scene, origin (3,) and direction (3,), meets the image, (2,) pixels."""
        reached = origin - direction * (origin[2] / direction[2])
        return reached[:2] / torch.tensor([self._unit, -self._unit], dtype=torch.float64) + self._middle

    def save(self) -> str:
        """Writes the frame, switches to the next that is not saved, and returns where to."""
        with self._lock:
            path = self.session.save()
            more = self.session.advance()
            self.chosen = None
            self._show_frame()
            return f"{path}" if more else f"{path}; all frames are saved now"

    def keep_unsaved(self) -> list[Path]:
        """Writes the frames that changed since they were saved into the folder's ``unsaved``."""
        return self.session.keep_unsaved()

    @property
    def _unit(self) -> float:
        return _FACE / self.session.extent

    @property
    def _middle(self) -> Tensor:
        height, width = self.session.frame.image.shape[-2:]
        return torch.tensor([(width - 1) / 2, (height - 1) / 2], dtype=torch.float64)

    def _add_panel(self) -> None:
        gui, session = self.server.gui, self.session
        with gui.add_folder("Frame"):
            self._status = gui.add_html("")
            self._frame: Any = gui.add_dropdown("Frame", [frame.name for frame in session.frames])
            self._add_save_button("Save and next", f"Writes to {session.folder}", self.save)
            undo = gui.add_button("Undo", icon=icon("ARROW_BACK_UP"))
            reset = gui.add_button("As proposed", icon=icon("REFRESH"))
            straight = gui.add_button("Straight view", icon=icon("FOCUS_CENTERED"))
        with gui.add_folder("Landmark"):
            self._name = gui.add_html("")
            self._reach = gui.add_slider(
                "Others follow", 0.0, 1.0, 0.02, 0.0, hint="How far around a dragged landmark the others go along"
            )
        self._frame.on_update(lambda _: self._frame_chosen())
        undo.on_click(lambda _: self._change(self.session.undo))
        reset.on_click(lambda _: self._change(self.session.reset))
        straight.on_click(lambda event: self._straighten(event.client))

    def _change(self, act: Any) -> None:
        with self._lock:
            act()
            self._refresh()

    def _frame_chosen(self) -> None:
        if not self._showing:
            names = [frame.name for frame in self.session.frames]
            with self._lock:
                self.session.show(names.index(self._frame.value))
                self.chosen = None
                self._show_frame()

    def _show_frame(self) -> None:
        session = self.session
        image = to_bytes(session.frame.image).permute(1, 2, 0).contiguous().numpy()
        height, width = image.shape[:2]
        scene = self.server.scene
        with self.server.atomic():
            # Rotated about x: an image's rows run along y, which the page shows upward.
            scene.add_image(
                "/image", image, width * self._unit, height * self._unit,
                wxyz=(0.0, 1.0, 0.0, 0.0), cast_shadow=False, receive_shadow=False,
            )  # fmt: skip
            for handle in (self._dots, self._lines):
                if handle is not None:
                    handle.remove()
            vertices, faces = _disc(_DOT)
            places = self._places()
            self._dots = scene.add_batched_meshes_simple(
                "/landmarks", vertices, faces, np.tile([1.0, 0, 0, 0], (len(places), 1)).astype(np.float32), places,
                batched_colors=self._colors(), side="double", lod="off", cast_shadow=False, receive_shadow=False,
                opacity=0.9,
            )  # fmt: skip
            self._lines = scene.add_line_segments(
                "/outline", self._segments(), (255, 255, 255), thickness=1.2, thickness_units="screen"
            )
            self._dots.on_drag("left")(self._dragged)
            self._dots.on_click(self._dot_clicked)
            self._showing = True
            self._frame.value = session.frame.name
            self._showing = False
            self._refresh()
            for client in self.server.get_clients().values():
                self._straighten(client)

    def _refresh(self) -> None:
        session = self.session
        with self.server.atomic():
            self._dots.batched_positions = self._places()
            self._dots.batched_colors = self._colors()
            self._lines.points = self._segments()
            counts = [("saved", f"{len(session.saved)} of {len(session.frames)}"), (session.frame.name, session.state)]
            self._status.content = pick_list(counts, [])
            name = "Drag a dot, or click one to choose it." if self.chosen is None else IBUG_68.names[self.chosen]
            self._name.content = caption(name)

    def _places(self) -> np.ndarray:
        flat = self.to_page(self.session.landmarks)
        return torch.cat([flat, torch.full((len(flat), 1), _LIFT)], dim=1).numpy().astype(np.float32)

    def _segments(self) -> np.ndarray:
        flat = self._places() - np.array([0, 0, _LIFT / 2], dtype=np.float32)
        pairs = [
            (row, line[i + 1] if i + 1 < len(line) else line[0])
            for line, closed in _LINES
            for i, row in enumerate(line)
            if closed or i + 1 < len(line)
        ]
        return flat[np.array(pairs)]

    def _colors(self) -> np.ndarray:
        colors = np.zeros((68, 3), dtype=np.uint8)
        for rows, color in _PARTS:
            colors[rows] = color
        if self.chosen is not None:
            colors[self.chosen] = _CHOSEN
        return colors

    async def _dragged(self, event: "viser.SceneNodeDragEvent") -> None:  # async: start, updates and end stay in order
        if event.instance_index is None:
            return
        eye = torch.tensor(event.client.camera.position, dtype=torch.float64)
        with self._lock:
            try:
                if event.phase == "start":
                    self.session.grab(event.instance_index)
                    self.chosen = event.instance_index
                    grabbed = self._under(eye, event.start_position)
                    self._offset = self.session.landmarks[self.chosen] - grabbed
                self.session.drag(
                    self._under(eye, event.end_position) + self._offset, self._reach.value * self.session.extent
                )
            except TorchfaceError:  # no such dot, an undo has let it go, or the pointer left the image's plane
                return
            finally:
                if event.phase == "end":
                    self.session.let_go()
            self._refresh()

    def _under(self, eye: Tensor, point: tuple[float, float, float]) -> Tensor:
        return self.to_pixels(eye, torch.tensor(point, dtype=torch.float64) - eye)

    def _dot_clicked(self, event: Any) -> None:
        if event.instance_index in range(len(self.session.landmarks)):
            with self._lock:
                self.chosen = event.instance_index
                self._refresh()

    def _clicked(self, event: "viser.SceneClickEvent") -> None:
        """Brings the chosen landmark to a click on the image; a click on a dot has just chosen it."""
        origin = torch.tensor(event.ray_origin, dtype=torch.float64)
        direction = torch.tensor(event.ray_direction, dtype=torch.float64)
        with self._lock:
            pixels = self.to_pixels(origin, direction)
            near = (self.session.landmarks - pixels).norm(dim=1)
            if self.chosen is None or float(near.min()) * self._unit < _DOT:
                return
            self.session.grab(self.chosen)
            try:
                self.session.drag(pixels, self._reach.value * self.session.extent)
            except TorchfaceError:
                self.session.undo()
            self.session.let_go()
            self._refresh()

    def _straighten(self, client: "viser.ClientHandle | None") -> None:
        """Puts a client's camera straight before the face."""
        if client is None:
            return
        centre = self.to_page(self.session.landmarks).mean(0)
        x, y = centre.tolist()
        distance = 2.1 * _FACE / math.tan(_VIEW / 2)
        with client.atomic():
            client.camera.up_direction = (0.0, 1.0, 0.0)
            client.camera.fov = _VIEW
            client.camera.position = (x, y, distance)
            client.camera.look_at = (x, y, 0.0)


def _disc(radius: float) -> tuple[np.ndarray, np.ndarray]:
    """A round plate in the plane of x and y: vertices and triangles."""
    angle = np.linspace(0, 2 * np.pi, _CORNERS, endpoint=False)
    rim = radius * np.stack([np.cos(angle), np.sin(angle), np.zeros(_CORNERS)], axis=1)
    vertices = np.concatenate([np.zeros((1, 3)), rim]).astype(np.float32)
    following = np.roll(np.arange(_CORNERS), -1)
    faces = np.stack([np.zeros(_CORNERS, dtype=int), 1 + np.arange(_CORNERS), 1 + following], axis=1)
    return vertices, faces.astype(np.uint32)
