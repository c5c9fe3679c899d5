"""The pictures that the network of a face's parts learns from: rendered once, kept in a folder."""

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor
from torch.utils.data import Dataset

from .face_pictures import head_kinds
from .rendered_files import Rendering
from .rendered_people.part_picture import PartPicture, draw_part_pictures
from .tensor_shards import Shards

PART, EACH, SCENES = 240, 4, 3
"""Pictures in a file, of one person, and of them with one pose in different surroundings."""
_NAMES = tuple(PartPicture.__annotations__)


class StoredPartPictures(Dataset[tuple[Tensor, ...]]):
    """Pictures ``begin`` to ``end`` of files, in their order, of which none is in memory but those that are asked
    for."""

    def __init__(self, paths: Sequence[Path], begin: int = 0, end: int | None = None) -> None:
        self._shards = Shards(paths, _NAMES)
        self._begin, self._end = begin, len(self._shards) if end is None else end

    def __len__(self) -> int:
        return self._end - self._begin

    def __getitem__(self, numbers: Tensor) -> tuple[Tensor, ...]:
        """Pictures uint8 (B,3,S,S), parts uint8 (B,S,S), boxes (B,4), of numbers (B,)."""
        rows = self._shards.rows(numbers + self._begin)
        return tuple(rows[name] for name in _NAMES)


def _render(first: int, count: int, seed: int, ict: Path | None) -> dict[str, Tensor]:
    pictures = draw_part_pictures(*head_kinds(ict), first, count, seed, EACH, SCENES)
    return {name: torch.stack([getattr(picture, name) for picture in pictures]) for name in _NAMES}


PARTS_OF_FACES = Rendering(_render, "part pictures/3", "pictures", "faces and their parts", PART)
"""How they are rendered, see ``rendered_files``."""
