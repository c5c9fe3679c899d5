"""The page of a live session: the character, the camera beside it, and what can be set."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from torchface.errors import TorchfaceError
from torchface.rig import BlendshapeRig
from torchface.shape_names import ARKIT, mirror
from torchface.viz.browser.browser_page import SCALE, BrowserPage, SharedInput, frame_camera, icon
from torchface.viz.browser.head_mesh import HeadOnPage
from torchface.viz.browser.html_lists import big_line, caption, figures_line, shape_list
from torchface.viz.browser.live_view import LiveDesk, LiveView

_RATE, _LEAST_RATE = 25.0, 2.0  # updates a second
_LIGHT = 12_000  # vertices that a browser moves at that rate
_PANEL_INTERVAL = 0.2
_COLORS = 16  # the texture is never shown: in motion a browser gets positions alone
_SHOWN_NOTES = 3
_NO_PICTURE = np.full((360, 480, 3), 60, np.uint8)


class LivePage(BrowserPage):
    """Shows a live session's newest moment again and again.

    Args:
        rig: the character.
        weights: from ARKit's weights (T,52) to the character's.
        desk: the session.
        label: heads the panel.
        port: the first to try, 0 for any.
    """

    def __init__(
        self,
        rig: BlendshapeRig,
        weights: Callable[[Tensor], Tensor],
        desk: LiveDesk,
        label: str = "torchface",
        port: int = 8080,
    ) -> None:
        self._rig, self._weights, self._desk = rig, weights, desk
        self._twins, self._mirrored = mirror(ARKIT), True
        self._shown: LiveView | None = None
        self._panel_at = float("-inf")
        self._messages: tuple[str, ...] = ()
        self.updates = 0
        super().__init__(label, port)
        self._frame = self.server.scene.add_frame("/head", show_axes=False)
        self.head = HeadOnPage(self.server, rig.neutral, "head", most_colors=_COLORS)
        self.head.enable_texture(False)  # it would follow at rest alone
        vertices = rig.neutral.vertices
        self._pivot = ((vertices.amin(0) + vertices.amax(0)) / 2).double().numpy()
        frame_camera(self.server, rig.neutral)
        self._add_panel()
        self._start(self._run)

    @property
    def rate(self) -> float:
        """How often the character is shown, times a second at most: heavy ones more rarely."""
        return max(_LEAST_RATE, min(_RATE, _RATE * _LIGHT / len(self._rig.neutral.vertices)))

    def _add_panel(self) -> None:
        gui, desk = self.server.gui, self._desk
        self._prompt = gui.add_html(big_line("Waiting for the camera", ""))
        self._picture = gui.add_image(_NO_PICTURE, format="jpeg", jpeg_quality=80)
        self._figures = gui.add_html(figures_line([]))
        calibrate = gui.add_button("Calibrate (10 seconds)", icon=icon("TARGET"), hint="Five faces, one after another")
        calibrate.on_click(lambda _: desk.calibrate())
        self._record = gui.add_button("Start recording", icon=icon("PLAYER_RECORD"), color="red")
        self._record.on_click(self._toggle_recording)
        gain = gui.add_slider("Gain", 0.0, 2.0, 0.05, desk.gain, hint="How large expressions become; 1 is usual")
        smoothing = gui.add_slider("Smoothing", 0.0, 1.0, 0.05, desk.smoothing, hint="Calmer, and a little later")
        view = gui.add_checkbox(
            "As in a mirror", self._mirrored, hint="On this page alone; what is sent stays as it is"
        )
        SharedInput(gain, self._lock, lambda value: setattr(desk, "gain", float(value)))
        SharedInput(smoothing, self._lock, lambda value: setattr(desk, "smoothing", float(value)))
        SharedInput(view, self._lock, self._set_mirror)
        reset = gui.add_button("Forget this person", icon=icon("USER_X"), hint="For the next one before the camera")
        reset.on_click(lambda _: desk.reset())
        with gui.add_folder("Active shapes"):
            self._active = gui.add_html(shape_list([]))
        self._notes = gui.add_html("")
        if self.rate < _RATE:
            count = len(self._rig.neutral.vertices)
            self._messages = (f"{count:,} vertices: the page shows them {self.rate:.0f} times a second at most",)

    def _set_mirror(self, mirrored: bool) -> None:
        self._mirrored = bool(mirrored)
        self._shown = None  # shown anew, whatever the camera gives

    def _toggle_recording(self, event: Any) -> None:
        view = self._desk.view()
        try:
            words = self._desk.record(view is None or view.recording is None)
            event.client.add_notification("Recording", words, auto_close_seconds=6.0, color="teal")
        except (TorchfaceError, OSError) as error:
            event.client.add_notification("Not recorded", str(error), color="red")

    def _run(self) -> None:
        due = time.monotonic()
        while not self._stopped.wait(max(0.0, due - time.monotonic())):
            due = max(due + 1 / self.rate, time.monotonic())
            view = self._desk.view()
            if view is not None and view is not self._shown:
                self._shown = view
                self._show(view)

    def _show(self, view: LiveView) -> None:
        """Sends one moment to the page."""
        now = time.monotonic()
        arkit = view.weights[self._twins] if self._mirrored else view.weights
        pose = self._weights(arkit[None])
        vertices = self._rig(pose.to(self._rig.deltas))[0].detach()
        rotation = _upright(view.rotation, self._mirrored)
        with self.server.atomic():
            self.head.show(vertices)
            turn = Rotation.from_matrix(rotation)
            self._frame.wxyz = turn.as_quat(scalar_first=True)
            self._frame.position = SCALE * (self._pivot - rotation @ self._pivot)
            self._picture.image = camera_drawing(view, self._mirrored)
            if now - self._panel_at > _PANEL_INTERVAL:
                self._panel_at = now
                self._show_panel(view)
        self.updates += 1

    def _show_panel(self, view: LiveView) -> None:
        prompt = f"{view.prompt} · {view.left:.0f}" if view.prompt else view.words
        kind = "ask" if view.prompt else ("good" if view.seen else "bad")
        self._prompt.content = big_line(prompt, kind)
        self._figures.content = figures_line([
            ("frames a second", f"{view.fps:.0f}"),
            ("ms latency", f"{view.latency:.0f}"),
            ("of you learned", f"{100 * view.calibrated:.0f} %"),
            ("recorded", "no" if view.recording is None else f"{view.recording:.0f} s"),
        ])  # fmt: skip
        label = "Start recording" if view.recording is None else "Stop recording"
        if self._record.label != label:
            self._record.label = label
        active = sorted(zip(ARKIT, view.weights.tolist(), strict=True), key=lambda shape: -shape[1])
        self._active.content = shape_list([(name, weight) for name, weight in active if weight >= 0.01])
        notes = (*self._messages, *view.notes[-_SHOWN_NOTES:])
        self._notes.content = "".join(caption(note) for note in notes)


def _upright(rotation: Tensor, mirrored: bool) -> np.ndarray:
    """A head's rotation in the page's axes, (3,3): of one that looks into the lens the identity, as before a face."""
    if not bool(torch.isfinite(rotation).all()):
        return np.eye(3)
    upright = np.diag([1.0, -1.0, -1.0]) @ rotation.detach().cpu().double().numpy()
    flip = np.diag([-1.0, 1.0, 1.0])
    return flip @ upright @ flip if mirrored else upright


_WIDTH = 480
_SHIFT = 4  # OpenCV draws at sixteenths of a pixel
_POINT, _IRIS, _EDGE = (120, 225, 255), (255, 190, 60), (20, 40, 60)
_BAND, _LATE = (46, 92, 138), 0.75


def camera_drawing(view: LiveView, mirrored: bool) -> np.ndarray:
    """The picture (h,480,3) with landmarks, irises and, while a calibration runs, how long each face is still held."""
    height, width = view.picture.shape[:2]
    scale = _WIDTH / width
    size = (_WIDTH, max(1, round(height * scale)))
    drawn = cv2.resize(view.picture, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    if mirrored:
        drawn = np.ascontiguousarray(drawn[:, ::-1])
        view = replace(view, landmarks=_flipped(view.landmarks, width), iris=_flipped(view.iris, width))
    for points, radius, color in ((view.landmarks, 1.6, _POINT), (view.iris, 3.2, _IRIS)):
        visible = points[torch.isfinite(points).all(1)]
        places = (((visible.double() + 0.5) * scale - 0.5).clamp(-1e3, 1e4) * 2**_SHIFT).round().int().tolist()
        for x, y in places:
            at = (x, y)
            cv2.circle(drawn, at, round((radius + 0.8) * 2**_SHIFT), _EDGE, -1, cv2.LINE_AA, _SHIFT)
            cv2.circle(drawn, at, round(radius * 2**_SHIFT), color, -1, cv2.LINE_AA, _SHIFT)
    if not view.seen:
        drawn = (drawn * _LATE).astype(np.uint8)
    if view.prompt:
        cv2.rectangle(drawn, (0, 0), (_WIDTH - 1, size[1] - 1), _BAND, 8)
    return drawn


def _flipped(points: torch.Tensor, width: int) -> torch.Tensor:
    return torch.stack([width - 1 - points[:, 0], points[:, 1]], 1)
