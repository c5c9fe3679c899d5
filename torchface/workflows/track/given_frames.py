"""Frames whose landmarks a table gives, instead of a tracker that looks for them."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from itertools import islice
from pathlib import Path

import torch
from torch import Tensor

from torchface.errors import ValueRangeError
from torchface.io.landmarks.landmark_tables import LandmarkTable, load_landmark_table
from torchface.io.video import VideoFile
from torchface.io.video.blank_video import BlankVideo
from torchface.landmarks import find_faces
from torchface.landmarks.images.boxes.face_box import overlaps
from torchface.landmarks.images.face_mesh_478 import landmarks_of_mesh
from torchface.landmarks.images.ibug_68 import box_around
from torchface.landmarks.images.landmark_finder import COUNT
from torchface.workflows.track.track_state import TrackedFrames

_LOOKED_AT, _APART = 5, 10
_SIDES = (1, 2**16)


def is_table(landmarks: str | Path | None) -> bool:
    """Whether what a user names is a table of landmarks rather than what finds them."""
    return landmarks is not None and Path(landmarks).suffix.lower() == ".csv"


def given_frames(path: Path, clip: VideoFile) -> TrackedFrames:
    """A table's landmarks as a tracker of the video would have found them.

    Args:
        path: the table; see :func:`~torchface.io.landmarks.landmark_tables.load_landmark_table`.
        clip: the video that they are of.

    Raises:
        FileFormatError: no such table.
        ValueRangeError: another number of frames than the video has, or landmarks outside of its pictures.
    """
    table = load_landmark_table(path)
    if len(table.points) != clip.count:
        raise ValueRangeError(
            f"{path}: found landmarks of {len(table.points)} frames, expected the {clip.count} of {clip.path.name}"
        )
    frames = _frames(table, clip.width, clip.height)
    _check_inside(frames.landmarks, clip, path)
    if not isinstance(clip, BlankVideo):
        _compare_with_pictures(frames.boxes, clip, path)
    return frames


def blank_clip(path: Path, fps: float | None, size: tuple[int, int] | None) -> BlankVideo:
    """What stands for the video of a table of landmarks, where there is none.

    Args:
        path: the table.
        fps: frames a second; by the table's times if absent.
        size: width and height of the pictures that the landmarks were found in.

    Raises:
        FileFormatError: no such table.
        ValueRangeError: rate or size are not given, or absurd.
    """
    table = load_landmark_table(path)
    rate = fps or table.fps
    if rate is None:
        raise ValueRangeError(f"{path}: found no times, expected --fps RATE, the frames a second")
    if not 1 <= rate <= 1000:
        raise ValueRangeError(f"{path}: found {rate:g} frames a second, expected 1 to 1000")
    if size is None:
        raise ValueRangeError(
            f"{path}: found no video, expected --size WIDTHxHEIGHT of the pictures that the landmarks were found in, "
            "or the --camera that took them"
        )
    if not all(_SIDES[0] <= side <= _SIDES[1] for side in size):
        raise ValueRangeError(f"--size: found {size[0]}x{size[1]}, expected {_SIDES[0]} to {_SIDES[1]} pixels a side")
    return BlankVideo(path, rate, *size, len(table.points))


def _frames(table: LandmarkTable, width: int, height: int) -> TrackedFrames:
    landmarks, confidence, visibility = table.pixels(width, height), table.confidence, table.visibility
    if landmarks.shape[1] != COUNT:
        landmarks = landmarks_of_mesh(landmarks)
        confidence, visibility = (landmarks_of_mesh(one[..., None])[..., 0] for one in (confidence, visibility))
    return TrackedFrames(landmarks, confidence, box_around(landmarks), visibility, table.presence)


def _check_inside(landmarks: Tensor, clip: VideoFile, path: Path) -> None:
    seen = landmarks[torch.isfinite(landmarks).all(2)]
    inside = ((seen >= -0.5) & (seen <= seen.new_tensor([clip.width, clip.height]) - 0.5)).all(1)
    if len(seen) and float(inside.float().mean()) < 0.5:
        x, y = seen.median(0).values.tolist()
        raise ValueRangeError(
            f"{path}: found landmarks round ({x:.0f}, {y:.0f}), expected most of them in the {clip.width} x "
            f"{clip.height} pixels of {clip.path.name}: were they found in pictures of another size?"
        )


def _compare_with_pictures(boxes: Tensor, clip: VideoFile, path: Path) -> None:
    """Warns where early frames show faces, and none of them where the landmarks are (T,4): of a smaller copy, say."""
    apart = []
    numbers = range(0, min(len(boxes), _LOOKED_AT * _APART), _APART)
    for number, frame in zip(numbers, _every(clip.frames(), _APART), strict=False):
        if not bool(torch.isfinite(boxes[number]).all()):
            continue
        faces = find_faces(frame).boxes
        if len(faces):
            apart.append((float(overlaps(faces, boxes[number][None]).max()) < 0.1, faces[0], boxes[number]))
    if len(apart) > 1 and all(one[0] for one in apart):
        _, face, box = apart[0]
        warnings.warn(
            f"{path}: the landmarks lie round ({_middle(box)}), {float(box[2]):.0f} pixels wide, where "
            f"{clip.path.name} shows no face; it shows one at ({_middle(face)}), {float(face[2]):.0f} pixels wide: "
            "were they found in this video, and at its size?",
            stacklevel=2,
        )


def _every(frames: Iterable[Tensor], step: int) -> Iterable[Tensor]:
    return islice(frames, 0, None, step)


def _middle(box: Tensor) -> str:
    return ", ".join(f"{float(value):.0f}" for value in box[:2] + box[2:] / 2)
