"""The rig viewer: a slider a shape, symmetric editing, playback of a take, saving what was edited."""

import re
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchface.errors import ValueRangeError
from torchface.files.whole_files import make_folder, unused
from torchface.geometry.meshes.normal_maps import DetailMaps
from torchface.io import save_take
from torchface.rig import BlendshapeRig
from torchface.shape_names import arkit_name, mirror, read_as_arkit
from torchface.take import Take
from torchface.viz.browser.browser_page import BrowserPage, SharedInput, frame_camera, icon
from torchface.viz.browser.head_mesh import HeadOnPage
from torchface.viz.browser.html_lists import caption, shape_list
from torchface.viz.browser.playback import Playback
from torchface.viz.browser.weight_editor import WeightEditor

_TICK = 1 / 120
_REST = 0.25
_PANEL_INTERVAL = 0.12
# Heads that a page reads while a take plays: without a graphics card one takes longer than the interval. A hand at a
# slider is not kept waiting.
_READING = 3
_TEXTURE_INTERVAL, _ROUGH_SIDE = 0.2, 512  # seconds in which a page reads a head; texels of its wrinkles in motion
_SPEEDS = ("0.1", "0.25", "0.5", "1", "2")
_OPEN_GROUPS = ("brows", "eyes", "jaw", "mouth")
_SPREAD = 6


class RigViewer(BrowserPage):
    """A rig in the browser, neutral or with a take mapped to its names, and wrinkle maps of its shapes, which follow
    the weights: in motion with few texels, at rest with all."""

    def __init__(
        self,
        rig: BlendshapeRig,
        take: Take | None = None,
        out: str | Path = "edited_weights.csv",
        detail: DetailMaps | None = None,
        label: str = "torchface",
        port: int = 8080,
    ) -> None:
        if take is not None and take.weights is None:
            raise ValueRangeError("take: found no weights, expected a weight take such as Live Link Face's")
        weights = None if take is None or take.weights is None else rig.weights_from(take.weights)
        self.rig, self.take, self.out = rig, take, Path(out)
        self.editor = WeightEditor(rig.names, weights, spread=0 if weights is None else _SPREAD, symmetric=True)
        self._saved = self.editor.weights.clone()
        times = None if take is None or take.seconds is None else tuple(take.times.tolist())
        self.playback = Playback(len(self.editor), 60.0 if take is None else take.fps, times=times)
        self._moved_at = self._panel_at = float("-inf")
        self._panel_due = False
        super().__init__(label, port)
        self._detail, self._wrinkled, self._rough, self._settled_at = detail, detail is not None, False, 0.0
        self._few_texels = None if detail is None else detail.reduced(_ROUGH_SIDE)
        posed = rig.neutral.with_vertices(self._vertices())
        self.head = HeadOnPage(self.server, posed, "head", normal_map=self._normal_map if detail else None)
        frame_camera(self.server, rig.neutral)
        if self.take is not None:
            self._add_timeline()
        self._add_editing()
        with self.server.gui.add_folder("Active shapes"):
            self._active = self.server.gui.add_html("")
        self.sliders = self._add_sliders()
        self._refresh_panel()
        self._start(self._run)

    def show_frame(self, frame: int) -> int:
        """Brings a frame into view; returns how many pieces of the head were sent."""
        with self._lock:
            self.editor.frame = frame
            return self._show()

    def set_weight(self, name: str, value: float) -> int:
        """Moves a shape in the frame in view, with symmetric editing its twin too; returns the pieces sent."""
        return self._edit(partial(self.editor.set, name, value))

    def save(self) -> Path:
        """Writes the weights as they stand now."""
        with self._lock:
            written, self._saved = self._write(self.out), self.editor.weights.clone()
            return written

    def keep_unsaved(self) -> list[Path]:
        """Writes the weights beside the file, as ``NAME_unsaved.csv``, if they changed since the last save."""
        if torch.equal(self.editor.weights, self._saved):
            return []
        return [self._write(unused(self.out.with_name(f"{self.out.stem}_unsaved.csv")))]

    def _write(self, path: Path) -> Path:
        make_folder(path.parent)
        save_take(self.editor.to_take(self.take), path)
        return path

    def _vertices(self) -> Tensor:
        return self.rig(self.editor.pose[None].to(self.rig.deltas))[0].detach()

    def _normal_map(self) -> Tensor | None:
        detail = self._few_texels if self._rough else self._detail
        return detail.blend(self.rig.names, self.editor.pose) if detail is not None and self._wrinkled else None

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
                    if due != self.editor.frame:
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
        pose = self.editor.pose.tolist()
        with self.server.atomic():
            self._active.content = shape_list(self.editor.active())
            for name, value in zip(self.rig.names, pose, strict=True):
                self.sliders[name].push(round(value, 3))
            if self.take is not None:
                self._frame.push(self.editor.frame)
                code = "" if self.take.timecode is None else f" · {self.take.timecode[self.editor.frame]}"
                seconds = float(self.take.times[self.editor.frame])
                self._time.content = caption(f"{self.editor.frame} of {len(self.editor) - 1} · {seconds:.2f} s{code}")

    def _add_timeline(self) -> None:
        gui = self.server.gui
        with gui.add_folder("Timeline"):
            self._play = gui.add_button("Play", icon=icon("PLAYER_PLAY"))
            frame = gui.add_slider("Frame", 0, max(len(self.editor) - 1, 1), 1, 0)
            self._time = gui.add_html("")
            speed = gui.add_dropdown("Speed", _SPEEDS, initial_value="1")
            loop = gui.add_checkbox("Loop", True)
        self._play.on_click(lambda _: self._toggle_play())
        self._frame = self._shared(frame, self._seek)
        self._shared(speed, lambda value: self._pace(speed=float(value)))
        self._shared(loop, lambda value: self._pace(loop=bool(value)))

    def _add_editing(self) -> None:
        gui = self.server.gui
        with gui.add_folder("Editing"):
            symmetric = gui.add_checkbox("Symmetric", True, hint="A slider moves its mirror twin too")
            self._shared(symmetric, lambda value: setattr(self.editor, "symmetric", bool(value)))
            if self.take is not None:
                spread = gui.add_slider("Spread", 0, 60, 1, _SPREAD, hint="Frames beside that an edit takes along")
                self._shared(spread, lambda value: setattr(self.editor, "spread", int(value)))
            if self.head.has_texture:
                texture = gui.add_checkbox(
                    "Texture", True, hint="In motion the head shows in plain colours, unless it has wrinkles"
                )
                self._shared(texture, self.head.enable_texture)
            if self._detail is not None:
                self._shared(gui.add_checkbox("Wrinkles", True), self._show_wrinkles)
            actions: dict[str, Callable[[], None]] = {"Reset": self.editor.reset}
            if self.take is not None:
                actions = {"Neutral": self.editor.rest, "Reset frame": self.editor.reset_frame}
                actions["Reset all"] = self.editor.reset
            buttons: Any = gui.add_button_group("Pose", tuple(actions))
            buttons.on_click(lambda event: self._edit(actions[event.target.value]))
            self._add_save_button("Save weights", f"Writes {self.out}", lambda: str(self.save()))

    def _add_sliders(self) -> dict[str, SharedInput]:
        gui, editor = self.server.gui, self.editor
        low, high = editor.low.tolist(), editor.high.tolist()
        sliders: dict[str, SharedInput] = {}
        groups = grouped(self.rig.names)
        for group, rows in groups.items():
            with gui.add_folder(group.capitalize(), expand_by_default=group in _OPEN_GROUPS or len(groups) == 1):
                for row in rows:
                    name = self.rig.names[row]
                    slider = gui.add_slider(label_of(name), low[row], high[row], 0.01, 0.0, hint=name)
                    slider.precision = 3
                    sliders[name] = self._shared(slider, partial(self._set, name))
        return sliders

    def _set(self, name: str, value: float) -> None:
        row = self.rig.names.index(name)  # a number that is typed may lie beyond the slider's ends
        self.set_weight(name, min(max(float(value), float(self.editor.low[row])), float(self.editor.high[row])))

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

    def _edit(self, action: Callable[[], object]) -> int:
        with self._lock:
            if self.playback.playing:
                self._pause()
            action()
            return self._show()


GROUPS = ("brows", "eyes", "jaw", "mouth", "cheeks", "nose", "other")
"""The field's groups, top of the panel first."""

_PREFIXES = {"brow": "brows", "eye": "eyes", "jaw": "jaw", "mouth": "mouth", "cheek": "cheeks", "nose": "nose"}


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
    lowered = [name.lower() for name in read_as_arkit(names)]
    called = [
        next((group for prefix, group in _PREFIXES.items() if name.startswith(prefix)), "other") for name in lowered
    ]
    members = {group: [row for row in order if called[row] == group] for group in GROUPS}
    return {group: rows for group, rows in members.items() if rows}


def label_of(name: str) -> str:
    """A shape's name as it fits beside its slider, inside its group: without the group, sides as one letter.

    Example:
        >>> [label_of(name) for name in ("mouthLowerDownRight", "browInnerUp_L", "jawLeft", "jawOpen", "tongueOut")]
        ['LowerDown R', 'InnerUp L', 'Left', 'Open', 'tongueOut']
    """
    name = arkit_name(name) or name
    prefix = next((prefix for prefix in _PREFIXES if name.lower().startswith(prefix)), "")
    rest = name[len(prefix) :].lstrip("_") or name
    return re.sub(r"(?<=.)(?:_|(?<=[a-z])(?=[LR]))(L|R)(?:eft|ight)?$", r" \1", rest)
