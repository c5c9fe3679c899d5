"""The pictures of eyes that the eye network learns from: rendered once, kept in a folder."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import torch
from torch import Tensor
from torch.utils.data import Dataset

from torchface.landmarks.images.networks.eye_augmentation import EyeLabels

from .face_pictures import head_kinds
from .rendered_files import Rendering
from .rendered_people.eye_picture import draw_eye_pictures
from .tensor_shards import Shards

PART = 200
"""Pictures in a file: what a killed run loses at most."""
EACH = 5
"""Pictures of one person, in a row."""


@dataclass(frozen=True, eq=False)
class EyePictures:
    """Pictures in memory, see :class:`~train.rendered_people.eye_picture.EyePicture`."""

    rgba: Tensor  # uint8 (M,4,H,W)
    landmarks: Tensor  # (M,68,2) pixels
    visible: Tensor  # of landmarks 36 to 47, (M,12) bool
    iris: Tensor  # (M,2,2) pixels
    openness: Tensor  # (M,2)
    bare: Tensor  # (M,2) square millimetres
    gaze: Tensor  # (M,2,2) radians

    def __len__(self) -> int:
        return len(self.rgba)

    @property
    def labels(self) -> EyeLabels:
        """What is known of them."""
        return EyeLabels(self.landmarks, self.visible, self.iris, self.openness, self.bare)


class StoredEyePictures(Dataset[tuple[Tensor, ...]]):
    """Pictures ``begin`` to ``end`` of files, in their order, of which none is in memory but those that are asked
    for."""

    def __init__(self, paths: Sequence[Path], begin: int = 0, end: int | None = None) -> None:
        self._shards = Shards(paths, [field.name for field in fields(EyePictures)])
        self._begin, self._end = begin, len(self._shards) if end is None else end

    def __len__(self) -> int:
        return self._end - self._begin

    def some(self, numbers: Tensor) -> EyePictures:
        """The pictures of these numbers (B,), from 0."""
        return EyePictures(**self._shards.rows(numbers + self._begin))

    def __getitem__(self, numbers: Tensor) -> tuple[Tensor, ...]:
        """Pictures uint8 (B,4,H,W) and their ``EyeLabels``, of numbers (B,)."""
        some = self.some(numbers)
        return some.rgba, *vars(some.labels).values()


def _render(first: int, count: int, seed: int, ict: Path | None) -> dict[str, Tensor]:
    pictures = draw_eye_pictures(*head_kinds(ict), first, count, seed, EACH)
    names = [field.name for field in fields(EyePictures)]
    return {name: torch.stack([getattr(picture, name) for picture in pictures]) for name in names}


EYES = Rendering(_render, "eye pictures/4", "eyes", "eyes", PART)
"""How they are rendered, see ``rendered_files``."""
