"""The video that shows what was solved: beside the camera's picture, or over it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from torch import Tensor

from torchface.io.video import write_video
from torchface.progress import Progress, silent
from torchface.workflows.track.side_by_side import side_by_side_drawer
from torchface.workflows.track.track_overlay import mesh_drawer, paint_drawer
from torchface.workflows.track.track_result import Tracked

Overlay = Literal["side", "over", "none"]
"""The opaque rig beside the picture, the mesh half through over it, or no video."""

_CHUNK = 8


def write_overlay(
    tracked: Tracked, path: Path, texture: Path | None, progress: Progress | None = None, kind: Overlay = "side"
) -> None:
    """Writes the overlay of a whole video; it appears when it is complete.

    Args:
        tracked: what was solved.
        path: of the video to write.
        texture: an image to put on the face in the picture; ``kind`` says nothing then.
        progress: called with each step and how far it is.
        kind: the rig beside the picture, or over it.
    """
    progress = progress or silent
    if texture is not None:
        draw = paint_drawer(tracked, texture)
    else:
        draw = mesh_drawer(tracked) if kind == "over" else side_by_side_drawer(tracked)

    def drawn() -> Iterator[Tensor]:
        at = 0
        for chunk in tracked.video.color_chunks(_CHUNK):
            for frame in chunk[: len(tracked.frames) - at]:  # each frame has a surface of its own
                yield draw(at, frame)[None]
                at += 1
                progress("drawing the overlay", at, len(tracked.frames))

    write_video(drawn(), path, tracked.video.fps)
