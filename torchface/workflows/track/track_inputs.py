"""What tracking starts from, checked: the actor, the clip, its camera, and the solver of these."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from torchface.capture.own_rig import VideoSettings, VideoSolver
from torchface.errors import ValueRangeError
from torchface.geometry.cameras.calibration import CameraCalibration, assumed_calibration
from torchface.io import load_rig
from torchface.io.camera_files import load_calibration
from torchface.io.images.transparent_images import load_paint
from torchface.io.video import VideoFile, open_video
from torchface.rig import BlendshapeRig
from torchface.workflows.track.given_frames import blank_clip, is_table
from torchface.workflows.track.track_models import (
    TrackModels,
)
from torchface.workflows.track.track_settings import TrackSettings


def load_actor(rig: Path, part: str | None) -> BlendshapeRig:
    """The actor's rig, with its 68 landmarks.

    Raises:
        ValueRangeError: it has no such landmarks.
        TorchfaceError: it cannot be read.
    """
    actor = load_rig(rig, part=part)
    notes = actor.neutral.annotations
    found = 0 if notes is None or notes.landmarks is None else len(notes.landmarks)
    if found != 68:
        what = "no landmark vertices" if found == 0 else f"{found} landmark vertices"
        raise ValueRangeError(
            f"{rig}: found {what}, expected the 68 of iBUG (torchface pick annotates them on the rig)"
        )
    return actor


def video_clip(video: Path | None, settings: TrackSettings) -> VideoFile:
    """The video; or what stands for it, where a table gives the landmarks and there is none."""
    if video is not None:
        if settings.fps is not None or settings.size is not None:
            raise ValueRangeError(f"{video}: found --fps or --size beside a video, expected them without one alone")
        return replace(open_video(video), even=False)
    if not is_table(settings.landmarks):
        raise ValueRangeError("track: found neither a video nor a table of landmarks, expected one at least")
    if settings.texture is not None:
        raise ValueRangeError(f"{settings.texture}: found no video, expected one whose light falls on the texture")
    calibration = None if settings.camera is None else load_calibration(settings.camera)
    size = settings.size or (None if calibration is None else (calibration.width, calibration.height))
    return blank_clip(Path(settings.landmarks), settings.fps, size)


def camera_of(clip: VideoFile, camera: Path | None) -> CameraCalibration:
    """The video's camera: as calibrated, brought to its resolution, or assumed.

    Raises:
        FileFormatError: the calibration is broken.
        ValueRangeError: it was made for another aspect.
    """
    if camera is None:
        return assumed_calibration(clip.width, clip.height)
    try:
        return load_calibration(camera).resized(clip.width, clip.height)
    except ValueRangeError as error:
        raise ValueRangeError(f"{camera}: {error}") from error


def check_length(frames: int, models: TrackModels, path: Path) -> None:
    """Raises a ``ValueRangeError`` where a take is too short for the dynamics prior's window."""
    if models.dynamics is not None and frames <= models.dynamics.window:
        raise ValueRangeError(
            f"{path}: found {frames} frames, expected more than the {models.dynamics.window} that the dynamics prior "
            "looks back"
        )


def check_texture(rig: BlendshapeRig, texture: Path) -> None:
    """Raises where the rig cannot wear a texture, or the image cannot be read."""
    load_paint(texture)
    if rig.neutral.uvs is None:
        raise ValueRangeError(f"{texture}: found a rig without texture coordinates, expected some to put it on")


def solver_for(
    rig: BlendshapeRig, models: TrackModels, calibration: CameraCalibration, fps: float | None = None
) -> VideoSolver:
    """The solver of a rig, for landmarks that the models find, at a frame rate."""
    settings = VideoSettings.of_found_landmarks(models.dynamics is not None, models.appearance is not None, fps)
    return VideoSolver(rig, None, calibration.intrinsics, models.prior, models.dynamics, settings)
