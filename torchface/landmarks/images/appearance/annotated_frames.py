"""Annotated frames: chosen so that they show all that a face does, and kept as images with iBUG's PTS beside them."""

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchface.errors import FileFormatError, ShapeError, ValueRangeError
from torchface.files.whole_files import all_or_none, made_folder, visible_files
from torchface.io.images.image_files import IMAGE_ENDINGS, load_image, save_image
from torchface.io.landmarks.landmark_points import load_landmark_points, save_pts
from torchface.landmarks.images.appearance.shape_modes import procrustes_mean


@dataclass(frozen=True, eq=False)
class AnnotatedFrame:
    """An image with landmarks."""

    name: str
    image: Tensor  # (3,H,W), uint8 or in [0,1]
    landmarks: Tensor  # iBUG's 68, (68,2) pixels


def load_annotated_frames(folder: str | Path) -> list[AnnotatedFrame]:
    """Every image of a folder that has a ``.pts`` beside it, by name."""
    folder = Path(folder)
    if not folder.is_dir():
        raise FileFormatError(f"{folder}: found no such folder, expected one with images and .pts files")
    frames = []
    for path in visible_files(folder, [".pts"]):
        image_path = next((image for end in IMAGE_ENDINGS if (image := path.with_suffix(end)).is_file()), None)
        if image_path is None:
            raise FileFormatError(f"{path}: found no image beside it, expected {path.stem}.png or another")
        points = load_landmark_points(path).ibug()
        if points.shape[1] != 2:
            raise FileFormatError(f"{path}: found points in space, expected pixels of the image beside it")
        frames.append(AnnotatedFrame(path.stem, load_image(image_path), points.float()))
    if not frames:
        raise FileFormatError(f"{folder}: found no .pts file, expected images with one beside each")
    return frames


def save_annotated_frame(frame: AnnotatedFrame, folder: str | Path) -> Path:
    """Writes ``name.png`` if there is none, then ``name.pts``; returns the latter's path."""
    folder = Path(folder)
    image_path, points = folder / f"{frame.name}.png", folder / f"{frame.name}.pts"
    with made_folder(folder), all_or_none():
        if not image_path.exists():
            save_image(frame.image / 255 if frame.image.dtype == torch.uint8 else frame.image, image_path)
        save_pts(torch.as_tensor(frame.landmarks), points)
    return points


_PARTS = (slice(0, 17), slice(17, 22), slice(22, 27), slice(27, 36), slice(36, 42), slice(42, 48), slice(48, 68))
_ASTRAY = 6.0
_MIN_DEVIATION = 0.01


def choose_frames(landmarks: Tensor, count: int = 15, confidence: Tensor | None = None) -> Tensor:
    r"""Frames that lie far apart: the face as it mostly is, then again and again the one least like those chosen.

    Shapes are compared without their poses, part by part (jaw, brows, nose, eyes, mouth), each part in units of how
    much it moves in this video, so that a wide mouth does not outvote a brow:

    .. math:: d(a, b)^2 = \sum_p \frac{|a_p - b_p|^2}{s_p^2}

    Farthest points come first where a tracker lost the face too; frames whose shape is none (six times as far from the
    usual one as is usual) are left out.

    Args:
        landmarks: the 68 as tracked, (T,68,2) pixels; NaN where lost.
        count: how many; fewer come back where fewer frames differ.
        confidence: of the tracker, (T,68) in [0,1]: the fifth of the frames with the lowest is left out.

    Returns:
        Frame numbers in the order of choice, the neutral one first, int64.
    """
    if landmarks.ndim != 3 or landmarks.shape[1:] != (68, 2):
        raise ShapeError(f"landmarks: found {tuple(landmarks.shape)}, expected (T,68,2)")
    if count < 1:
        raise ValueRangeError(f"count: found {count}, expected at least 1")
    usable = torch.isfinite(landmarks).flatten(1).all(1)
    if confidence is not None and usable.any():
        sure = torch.nan_to_num(confidence.mean(1))
        usable = usable & (sure >= sure[usable].quantile(0.2))
    frames = torch.nonzero(usable)[:, 0]
    if len(frames) == 0:
        raise ValueRangeError(f"landmarks: found a face in none of {len(landmarks)} frames, expected some")
    _, aligned = procrustes_mean(landmarks[frames].double())
    distance = (aligned - aligned.median(0).values).flatten(1).norm(dim=1)
    sound = distance <= _ASTRAY * distance.median() + 1e-9
    frames, aligned = frames[sound], aligned[sound]
    offset = aligned - aligned.median(0).values
    spread = torch.stack([offset[:, part].square().sum((1, 2)).mean().sqrt() for part in _PARTS])
    weights = 1 / spread.clamp(min=_MIN_DEVIATION)
    scaled = torch.cat([w * offset[:, part].flatten(1) for w, part in zip(weights, _PARTS, strict=True)], dim=1)
    chosen = [int(scaled.norm(dim=1).argmin())]
    nearest = (scaled - scaled[chosen[0]]).norm(dim=1)
    while len(chosen) < min(count, len(frames)) and float(nearest.max()) > 0:
        chosen.append(int(nearest.argmax()))
        nearest = torch.minimum(nearest, (scaled - scaled[chosen[-1]]).norm(dim=1))
    return frames[chosen]
