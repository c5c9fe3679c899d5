"""How a video is tracked."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from torchface.workflows.track.overlay_video import Overlay
from torchface.workflows.track.track_models import (
    DEFAULT_LANDMARKS,
    DEFAULT_PRIOR,
)


@dataclass(frozen=True)
class TrackSettings:
    """How a video is tracked.

    Args:
        landmarks: what finds them, see :func:`~torchface.workflows.named_finders.load_finder`; or a table that gives
            them, see :func:`~torchface.io.landmarks.landmark_tables.load_landmark_table`.
        appearance, prior, dynamics: models by name or folder; ``prior`` may be "none".
        camera: a calibration; a focal length is assumed without.
        face: which of several, from 0, the largest first.
        whole_take: landmarks smoothed by all frames, those after each too; weights as well where there is a dynamics
            prior.
        part: keep this region of the rig only.
        texture: an image to put on the face in the overlay, in the rig's texture coordinates.
        overlay: the rig in a video "side" by side with the picture, "over" it half through, or "none"; a texture
            goes over the face.
        fps: frames a second of a table of landmarks without a video; by its times if absent.
        size: width and height of the pictures that such landmarks were found in; the camera's if absent.
        offsets: a file of fixed offsets between this rig's landmarks and this finder's; those in the folder of results,
            or estimated with the take, if absent.
    """

    landmarks: str | Path = DEFAULT_LANDMARKS
    appearance: str | Path | None = None
    prior: str | Path | None = DEFAULT_PRIOR
    dynamics: str | Path | None = None
    camera: Path | None = None
    face: int = 0
    whole_take: bool = False
    part: str | None = None
    texture: Path | None = None
    overlay: Overlay = "side"
    fps: float | None = None
    size: tuple[int, int] | None = None
    offsets: Path | None = None
