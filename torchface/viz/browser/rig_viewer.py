"""The rig viewer: a slider a shape, playback of a take."""

import re
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchface.errors import NameMismatchError, ValueRangeError
from torchface.geometry.meshes.normal_maps import DetailMaps
from torchface.mesh import Mesh
from torchface.rig import BlendshapeRig
from torchface.shape_names import mirror
from torchface.take import Take
from torchface.viz.browser.browser_page import BrowserPage, SharedInput, frame_camera, icon
from torchface.viz.browser.head_mesh import HeadOnPage
from torchface.viz.browser.html_lists import caption, shape_list
from torchface.viz.browser.playback import Playback

_TICK = 1 / 120
_REST = 0.25
_PANEL_INTERVAL = 0.12
# Heads that a page reads while a take plays: without a graphics card one takes longer than the interval. A hand at a
# slider is not kept waiting.
_READING = 3
_TEXTURE_INTERVAL, _ROUGH_SIDE = 0.2, 512  # seconds in which a page reads a head; texels of its wrinkles in motion
_SPEEDS = ("0.1", "0.25", "0.5", "1", "2")
_OPEN_GROUPS = ("brows", "eyes", "jaw", "mouth")
_ACTIVE = 0.01  # weights that are listed


class RigViewer(BrowserPage):
    """A rig in the browser.

    Args:
        take: weights to play, mapped to the rig's names; one neutral pose if absent.
        detail: wrinkle maps of the rig's shapes, which follow the weights: in motion with few texels, at rest with all.
        port: the first to try, 0 for any.
    """

    def __init__(
        self,
        rig: BlendshapeRig,
        take: Take | None = None,
        detail: DetailMaps | None = None,
        label: str = "torchface",
        port: int = 8080,
    ) -> None:
        if take is not None and take.weights is None:
            raise ValueRangeError("take: found no weights, expected a weight take such as Live Link Face's")
        weights = None if take is None or take.weights is None else rig.weights_from(take.weights)
        self.rig, self.take = rig, take
        self.weights = torch.zeros(1, len(rig.names)) if weights is None else weights.detach().cpu().float()
        if not torch.isfinite(self.weights).all():
            missing = int((~torch.isfinite(self.weights)).sum())
            raise ValueRangeError(f"weights: {missing} are NaN or infinite; expected numbers to show")
        self.low, self.high = self.weights.amin(0).clamp(max=0.0), self.weights.amax(0).clamp(min=1.0)
        self.frame, self.pose = 0, self.weights[0].clone()
        times = None if take is None or take.seconds is None else tuple(take.times.tolist())
        self.playback = Playback(len(self.weights), 60.0 if take is None else take.fps, times=times)
        self._moved_at = self._panel_at = float("-inf")
        self._panel_due = False
        super().__init__(label, port)
        self._detail, self._wrinkled, self._rough, self._settled_at = detail, detail is not None, False, 0.0
        self._few_texels = None if detail is None else detail.reduced(_ROUGH_SIDE)
        self.head = HeadOnPage(self.server, self._posed(), "head", normal_map=self._normal_map if detail else None)
        frame_camera(self.server, rig.neutral)
        if self.take is not None:
            self._add_timeline()
        self._add_pose()
        with self.server.gui.add_folder("Active shapes"):
            self._active = self.server.gui.add_html("")
        self.sliders = self._add_sliders()
        self._refresh_panel()
        self._start(self._run)

    def show_frame(self, frame: int) -> int:
        """Brings a frame into view; returns how many pieces of the head were sent."""
        with self._lock:
            self.frame = min(max(frame, 0), len(self.weights) - 1)
            self.pose = self.weights[self.frame].clone()
            return self._show()

    def set_weight(self, name: str, value: float) -> int:
        """Moves a shape until another frame is shown; returns the pieces sent."""
        if name not in self.rig.names:
            raise NameMismatchError(f"weights: found {name!r}, expected a shape of the rig: {self.rig.names[0]}, ...")
        if not abs(value) < float("inf"):
            raise ValueRangeError(f"weights: found {value} for {name}, expected a number")
        with self._lock:
            if self.playback.playing:
                self._pause()
            self.pose[self.rig.names.index(name)] = value
            return self._show()

    def rest(self) -> None:
        """Shows the head at rest until another frame is shown."""
        with self._lock:
            if self.playback.playing:
                self._pause()
            self.pose = torch.zeros_like(self.pose)
            self._show()

    def _posed(self) -> Mesh:
        return self.rig.neutral.with_vertices(self._vertices())

    def _vertices(self) -> Tensor:
        return self.rig(self.pose[None].to(self.rig.deltas))[0].detach()

    def _normal_map(self) -> Tensor | None:
        detail = self._few_texels if self._rough else self._detail
        return detail.blend(self.rig.names, self.pose) if detail is not None and self._wrinkled else None

    def _show_wrinkles(self, enabled: bool) -> None:
        self._wrinkled = bool(enabled)
        self.head.refresh_texture(self._wrinkled)

    def _show(self) -> int:
        sent = self.head.show(self._vertices())
        if sent:
            self._moved_at = time.monotonic()
        self._panel_due = True
        return sent

    def _run(self) -> None:
        """Plays, keeps the panel up to date at a rate that a browser likes, and shows the texture at rest."""
        while not self._stopped.wait(_TICK):
            with self._lock:
                now = time.monotonic()
                if self.playback.playing:
                    due = self.playback.frame(now)
                    if due != self.frame:
                        self.show_frame(due)
                    if self.playback.ended(now):
                        self._pause()
                if self._panel_due and now - self._panel_at > _PANEL_INTERVAL:
                    self._refresh_panel()
                    self._panel_at, self._panel_due = now, False
                self._draw_texture(now, now - self._moved_at <= _REST)

    def _draw_texture(self, now: float, moving: bool) -> None:
        if self._rough and not moving:
            self._rough = False
            self.head.refresh_texture()
        if not self.head.settled and (self.head.follows or not moving) and now - self._settled_at > _TEXTURE_INTERVAL:
            self._rough = moving
            self.head.settle(_READING if self.playback.playing else 1)
            self._settled_at = time.monotonic()

    def _refresh_panel(self) -> None:
        pose = self.pose.tolist()
        with self.server.atomic():
            self._active.content = shape_list(self._moved())
            for name, value in zip(self.rig.names, pose, strict=True):
                self.sliders[name].push(round(value, 3))
            if self.take is not None:
                self._frame.push(self.frame)
                self._time.content = _time_line(self.frame, len(self.weights), self.take)

    def _add_timeline(self) -> None:
        gui = self.server.gui
        with gui.add_folder("Timeline"):
            self._play = gui.add_button("Play", icon=icon("PLAYER_PLAY"))
            frame = gui.add_slider("Frame", 0, max(len(self.weights) - 1, 1), 1, 0)
            self._time = gui.add_html("")
            speed = gui.add_dropdown("Speed", _SPEEDS, initial_value="1")
            loop = gui.add_checkbox("Loop", True)
        self._play.on_click(lambda _: self._toggle_play())
        self._frame = self._shared(frame, self._seek)
        self._shared(speed, lambda value: self._pace(speed=float(value)))
        self._shared(loop, lambda value: self._pace(loop=bool(value)))

    def _moved(self) -> list[tuple[str, float]]:
        """Shapes that are seen in the pose, the largest weight first."""
        order = self.pose.abs().argsort(descending=True, stable=True).tolist()
        return [(self.rig.names[i], float(self.pose[i])) for i in order if abs(float(self.pose[i])) >= _ACTIVE]

    def _add_pose(self) -> None:
        gui = self.server.gui
        with gui.add_folder("Pose"):
            if self.head.has_texture:
                texture = gui.add_checkbox(
                    "Texture", True, hint="In motion the head shows in plain colours, unless it has wrinkles"
                )
                self._shared(texture, self.head.enable_texture)
            if self._detail is not None:
                self._shared(gui.add_checkbox("Wrinkles", True), self._show_wrinkles)
            gui.add_button("Neutral").on_click(lambda _: self.rest())
            if self.take is not None:
                gui.add_button("Pose of the take").on_click(lambda _: self._seek(self.frame))

    def _add_sliders(self) -> dict[str, SharedInput]:
        gui = self.server.gui
        low, high = self.low.tolist(), self.high.tolist()
        sliders: dict[str, SharedInput] = {}
        for group, rows in grouped(self.rig.names).items():
            with gui.add_folder(group.capitalize(), expand_by_default=group in _OPEN_GROUPS):
                for row in rows:
                    name = self.rig.names[row]
                    slider = gui.add_slider(label_of(name), low[row], high[row], 0.01, 0.0, hint=name)
                    slider.precision = 3
                    sliders[name] = self._shared(slider, partial(self._set, name))
        return sliders

    def _set(self, name: str, value: float) -> None:
        row = self.rig.names.index(name)  # a number that is typed may lie beyond the slider's ends
        self.set_weight(name, min(max(float(value), float(self.low[row])), float(self.high[row])))

    def _shared(self, handle: Any, act: Callable[[Any], Any]) -> SharedInput:
        return SharedInput(handle, self._lock, act)

    def _toggle_play(self) -> None:
        with self._lock:
            if self.playback.playing:
                self._pause()
            else:
                self.playback = self.playback.play(time.monotonic())
                self._play.label = "Pause"

    def _pause(self) -> None:
        self.playback = self.playback.pause(time.monotonic())
        self._play.label = "Play"

    def _pace(self, **change: Any) -> None:
        self.playback = self.playback.paced(time.monotonic(), **change)

    def _seek(self, frame: int) -> None:
        if self.playback.playing:
            self._pause()
        self.playback = self.playback.seek(frame, time.monotonic())
        self.show_frame(self.playback.origin)


def _time_line(frame: int, frames: int, take: Take) -> str:
    code = "" if take.timecode is None else f" · {take.timecode[frame]}"
    return caption(f"{frame} of {frames - 1} · {float(take.times[frame]):.2f} s{code}")


GROUPS = ("brows", "eyes", "jaw", "mouth", "cheeks", "nose", "other")
"""The field's groups, top of the panel first."""

_PREFIXES = {"brow": "brows", "eye": "eyes", "jaw": "jaw", "mouth": "mouth", "cheek": "cheeks", "nose": "nose"}


def group_of(name: str) -> str:
    """The group of one shape.

    Example:
        >>> [group_of(name) for name in ("browInnerUp_L", "EyeBlinkLeft", "tongueOut")]
        ['brows', 'eyes', 'other']
    """
    lowered = name.lower()
    return next((group for prefix, group in _PREFIXES.items() if lowered.startswith(prefix)), "other")


def grouped(names: Sequence[str]) -> dict[str, list[int]]:
    """Rows of ``names`` by group, groups without a shape left out, mirror twins side by side.

    Example:
        >>> grouped(["mouthSmileLeft", "jawOpen", "mouthPucker", "mouthSmileRight"])
        {'jaw': [1], 'mouth': [0, 3, 2]}
    """
    twins = mirror(names).tolist()
    order: dict[int, None] = {}
    for row, twin in enumerate(twins):
        order.setdefault(row)
        order.setdefault(twin)
    members = {group: [row for row in order if group_of(names[row]) == group] for group in GROUPS}
    return {group: rows for group, rows in members.items() if rows}


def label_of(name: str) -> str:
    """A shape's name as it fits beside its slider, inside its group: without the group, sides as one letter.

    Example:
        >>> [label_of(name) for name in ("mouthLowerDownRight", "browInnerUp_L", "jawLeft", "jawOpen", "tongueOut")]
        ['LowerDown R', 'InnerUp L', 'Left', 'Open', 'tongueOut']
    """
    prefix = next((prefix for prefix in _PREFIXES if name.lower().startswith(prefix)), "")
    rest = name[len(prefix) :].lstrip("_") or name
    return re.sub(r"(?<=.)(?:_|(?<=[a-z])(?=[LR]))(L|R)(?:eft|ight)?$", r" \1", rest)
