"""Annotated frames as a folder: an image and iBUG's PTS of the same name for each."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchface.errors import FileFormatError
from torchface.files.whole_files import all_or_none, made_folder
from torchface.io.images.image_files import IMAGE_ENDINGS, load_image, save_image
from torchface.io.landmarks.landmark_points import load_landmark_points, save_pts


@dataclass(frozen=True, eq=False)
class AnnotatedFrame:
    """An image with landmarks.

    Args:
        name: of its files, without ending.
        image: (3,H,W), uint8 or in [0,1].
        landmarks: iBUG's 68, (68,2) pixels.
    """

    name: str
    image: Tensor
    landmarks: Tensor


def load_annotated_frames(folder: str | Path) -> list[AnnotatedFrame]:
    """Every image of a folder that has a ``.pts`` beside it, by name.

    Raises:
        FileFormatError: no such folder, none in it, or a file that cannot be read.
        ShapeError: other than 68 landmarks.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileFormatError(f"{folder}: found no such folder, expected one with images and .pts files")
    frames = []
    for path in sorted(folder.glob("*.pts")):
        image_path = next((found for end in IMAGE_ENDINGS if (found := path.with_suffix(end)).is_file()), None)
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
    """Writes ``name.png`` if there is none, then ``name.pts``; returns the latter's path.

    Raises:
        FileFormatError: the folder cannot be written to.
        ValueRangeError: a landmark is NaN.
    """
    folder = Path(folder)
    image_path, points = folder / f"{frame.name}.png", folder / f"{frame.name}.pts"
    with made_folder(folder), all_or_none():
        if not image_path.exists():
            save_image(frame.image / 255 if frame.image.dtype == torch.uint8 else frame.image, image_path)
        save_pts(torch.as_tensor(frame.landmarks), points)
    return points
