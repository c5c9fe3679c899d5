"""The pictures that networks of faces learn from: rendered once, kept in a folder, read by all recipes."""

from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from torchface.errors import FileFormatError
from torchface.io import load_ict_facekit, load_identity_modes
from torchface.shape_names import ARKIT

from .rendered_files import Rendering
from .rendered_people.dense_points import COUNT as POINTS
from .rendered_people.face_picture import draw_pictures
from .rendered_people.face_scenes import cut_out, upright_faces
from .rendered_people.head_kind import HeadKind, people_kind, performer_kind
from .tensor_shards import Shards

PART = 240
"""Pictures in a file: what a killed run loses at most."""
EACH = 4
"""Pictures of one person, in a row."""
_TENSORS = ("rgba", "landmarks", "visible")
_POINTS = ("points", "point_visible", "weights")
_PEOPLE = 0.5  # of the pictures show ICT-FaceKit's heads, where there are some


class StoredPictures(Dataset[tuple[Tensor, ...]]):
    """The first ``count`` pictures, or all, of files, in their order; in memory are none but those that are asked
    for."""

    def __init__(self, paths: Sequence[Path], count: int | None = None) -> None:
        right = [(torch.uint8, (4,)), (torch.float32, (68, 2)), (torch.bool, (68,))]
        self._shards = _shards(paths, dict(zip(_TENSORS, right, strict=True)))
        self._count = len(self._shards) if count is None else count

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, numbers: Tensor) -> tuple[Tensor, ...]:
        """Pictures uint8 (B,4,H,W), landmarks (B,68,2) and which are visible (B,68), of numbers (B,)."""
        rows = self._shards.rows(numbers)
        return tuple(rows[name] for name in self._shards.names)


class StoredExpressions(StoredPictures):
    """The same pictures with points of the surface, which are visible, and weights beside."""

    def __init__(self, paths: Sequence[Path], count: int | None = None) -> None:
        super().__init__(paths, count)
        more = [(torch.float32, (POINTS, 2)), (torch.bool, (POINTS,)), (torch.float32, (len(ARKIT),))]
        self._shards = _shards(paths, {**self._shards.forms, **dict(zip(_POINTS, more, strict=True))})


def _shards(paths: Sequence[Path], right: Mapping[str, tuple[torch.dtype, tuple[int, ...]]]) -> Shards:
    """Rows of files that have these tensors; of pictures the channels alone are checked."""
    shards = Shards(paths, list(right))
    forms = {name: (dtype, size[:1] if name == "rgba" else size) for name, (dtype, size) in shards.forms.items()}
    expected = {name: (dtype, size[:1] if name == "rgba" else size) for name, (dtype, size) in right.items()}
    if forms != expected or len(shards.forms["rgba"][1]) != 3:
        raise FileFormatError(f"{paths[0]}: found {shards.forms}, expected {expected}")
    return shards


class StoredCutOuts:
    """People to put into scenes, ``begin`` to ``end`` of files: their landmarks are in memory, of their pictures the
    one that is asked for."""

    def __init__(self, paths: Sequence[Path], begin: int = 0, end: int | None = None) -> None:
        self._pictures, self._begin = StoredPictures(paths), begin
        marks = Shards(paths, ["landmarks"])
        self.landmarks = marks.read(begin, len(marks) if end is None else end)["landmarks"]
        self.faces = upright_faces(self.landmarks)

    def __len__(self) -> int:
        return len(self.landmarks)

    def person(self, number: int) -> np.ndarray:
        """One picture, (S,S,4), black where nobody is."""
        return cut_out(self._pictures[torch.tensor([self._begin + number])][0][0])


def _render(first: int, count: int, seed: int, ict: Path | None) -> dict[str, Tensor]:
    pictures = draw_pictures(*head_kinds(ict), first, count, seed, EACH)
    return {name: torch.stack([getattr(picture, name) for picture in pictures]) for name in _TENSORS + _POINTS}


FACES = Rendering(_render, "face pictures/7", "pictures", "faces", PART)
"""How they are rendered, see ``rendered_files``."""


@lru_cache(maxsize=2)
def head_kinds(ict: Path | None) -> tuple[tuple[HeadKind, ...], tuple[float, ...]]:
    """Kinds of heads and how often each is drawn: embedded performers alone, or with ICT-FaceKit's, in equal parts."""
    if ict is None:
        return (performer_kind(),), (1.0,)
    return (people_kind(load_ict_facekit(ict), load_identity_modes(ict)), performer_kind()), (_PEOPLE, 1 - _PEOPLE)
