"""The pictures of eyes that the eye network learns from: rendered once, kept in a folder."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor

from torchface.landmarks.images.eyes.eye_augmentation import EyeLabels
from torchface.progress import Progress
from torchface.synthetic.stages.face_pictures.eye_picture import draw_eye_pictures

from .face_pictures import head_kinds
from .rendered_files import Rendering, rendered_files

PART = 200
"""Pictures in a file: what a killed run loses at most."""


@dataclass(frozen=True, eq=False)
class EyePictures:
    """Pictures in memory, see :class:`~torchface.synthetic.stages.face_pictures.eye_picture.EyePicture`.

    Args:
        rgba: uint8 (M,4,H,W).
        landmarks: (M,68,2) pixels.
        visible: of landmarks 36 to 47, (M,12) bool.
        iris: (M,2,2) pixels.
        openness: (M,2).
        bare: (M,2) square millimetres.
        gaze: (M,2,2) radians.
    """

    rgba: Tensor
    landmarks: Tensor
    visible: Tensor
    iris: Tensor
    openness: Tensor
    bare: Tensor
    gaze: Tensor

    def __len__(self) -> int:
        return len(self.rgba)

    @property
    def labels(self) -> EyeLabels:
        """What is known of them."""
        return EyeLabels(self.landmarks, self.visible, self.iris, self.openness, self.bare)

    def rows(self, rows: slice | Tensor) -> EyePictures:
        """Some of them."""
        return EyePictures(*(getattr(self, field.name)[rows] for field in fields(self)))


def render_eye_pictures(
    folder: Path, count: int, seed: int, ict: Path | None = None, workers: int = 1, progress: Progress | None = None
) -> EyePictures:
    """Renders what a folder does not hold yet, and reads all; how many processes render does not change them.

    Args:
        folder: for the files; pictures of another seed or other heads lie beside each other there.
        count: how many, rounded up to whole files.
        seed: decides them.
        ict: ICT-FaceKit's ``FaceXModel``, whose heads are four in five; embedded performers alone without.
        workers: processes.
        progress: called with each step and how far it is.
    """
    rendering = Rendering(_render, "eye pictures/1", "eyes", "eyes", PART)
    paths = rendered_files(rendering, folder, count, seed, ict, workers, progress)
    return read_eye_pictures(paths)


def read_eye_pictures(paths: list[Path]) -> EyePictures:
    """The pictures of files, in their order."""
    read = [load_file(path) for path in paths]
    return EyePictures(*(torch.cat([part[field.name] for part in read]) for field in fields(EyePictures)))


def _render(first: int, count: int, seed: int, ict: Path | None) -> dict[str, Tensor]:
    pictures = draw_eye_pictures(*head_kinds(ict), first, count, seed)
    names = [field.name for field in fields(EyePictures)]
    return {name: torch.stack([getattr(one, name) for one in pictures]) for name in names}
