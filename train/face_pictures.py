"""The pictures that networks of faces learn from: rendered once, kept in a folder, read by all recipes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor

from torchface.errors import FileFormatError
from torchface.files.shards import Shards
from torchface.io.rigs.ict_facekit import load_ict_facekit, load_identity_modes
from torchface.progress import Progress
from torchface.synthetic.stages.face_pictures.face_picture import draw_pictures
from torchface.synthetic.stages.face_pictures.head_kind import HeadKind, people_kind, performer_kind

from .rendered_files import Rendering, rendered_files

PART = 240
"""Pictures in a file: what a killed run loses at most."""
_TENSORS = ("rgba", "landmarks", "visible")
_PEOPLE = 0.8  # of the pictures show ICT-FaceKit's heads, where there are some


@dataclass(frozen=True, eq=False)
class FacePictures:
    """Pictures in memory.

    Args:
        rgba: uint8 (M,4,S,S); the fourth channel is 0 on the background.
        landmarks: iBUG's 68, (M,68,2) pixels.
        visible: which of them nothing hides, (M,68) bool.
    """

    rgba: Tensor
    landmarks: Tensor
    visible: Tensor

    def __len__(self) -> int:
        return len(self.rgba)


class StoredPictures:
    """Pictures of files, of which none is in memory but those that are asked for.

    Args:
        paths: of the files, in their order.
        count: how many of the pictures, the first; all if absent.

    Raises:
        FileFormatError: a file is missing or holds something else.
    """

    def __init__(self, paths: Sequence[Path], count: int | None = None) -> None:
        self._shards = Shards(paths, _TENSORS)
        forms = [self._shards.forms[name] for name in _TENSORS]
        right = [(torch.uint8, (4, *forms[0][1][1:])), (torch.float32, (68, 2)), (torch.bool, (68,))]
        if forms != right or len(forms[0][1]) != 3:
            raise FileFormatError(
                f"{paths[0]}: found {self._shards.forms}, expected {dict(zip(_TENSORS, right, strict=True))}"
            )
        self._count = len(self._shards) if count is None else count

    def __len__(self) -> int:
        return self._count

    def rows(self, numbers: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Pictures, landmarks and which are visible; see ``network_training.LabelledPictures``."""
        found = self._shards.rows(numbers)
        return found["rgba"], found["landmarks"], found["visible"]


def picture_files(
    folder: Path, count: int, seed: int, ict: Path | None = None, workers: int = 1, progress: Progress | None = None
) -> list[Path]:
    """Renders what a folder does not hold yet; how many processes render does not change the pictures.

    Args:
        folder: for the files; pictures of another seed or other heads lie beside each other there.
        count: how many, rounded up to whole files.
        seed: decides them.
        ict: ICT-FaceKit's ``FaceXModel``, whose heads are four in five; embedded performers alone without.
        workers: processes.
        progress: called with each step and how far it is.

    Returns:
        The files, in order, of :data:`PART` pictures each.
    """
    rendering = Rendering(_render, "face pictures/3", "pictures", "faces", PART)
    return rendered_files(rendering, folder, count, seed, ict, workers, progress)


def render_pictures(
    folder: Path, count: int, seed: int, ict: Path | None = None, workers: int = 1, progress: Progress | None = None
) -> FacePictures:
    """The pictures of :func:`picture_files`, in memory."""
    return read_pictures(picture_files(folder, count, seed, ict, workers, progress))


def read_pictures(paths: list[Path]) -> FacePictures:
    """The pictures of files, in their order."""
    size = load_file(paths[0])["rgba"].shape[1:]
    total = PART * len(paths)
    found = FacePictures(
        torch.empty(total, *size, dtype=torch.uint8),
        torch.empty(total, 68, 2),
        torch.empty(total, 68, dtype=torch.bool),
    )
    for number, path in enumerate(paths):  # one at a time: together they take gigabytes twice
        part, rows = load_file(path), slice(PART * number, PART * (number + 1))
        for name in _TENSORS:
            getattr(found, name)[rows] = part[name]
    return found


def _render(first: int, count: int, seed: int, ict: Path | None) -> dict[str, Tensor]:
    pictures = draw_pictures(*head_kinds(ict), first, count, seed)
    return {name: torch.stack([getattr(one, name) for one in pictures]) for name in _TENSORS}


@lru_cache(maxsize=2)
def head_kinds(ict: Path | None) -> tuple[tuple[HeadKind, ...], tuple[float, ...]]:
    """Kinds of heads and how often each is drawn: embedded performers alone, or with ICT-FaceKit's, four in five."""
    if ict is None:
        return (performer_kind(),), (1.0,)
    return (people_kind(load_ict_facekit(ict), load_identity_modes(ict)), performer_kind()), (_PEOPLE, 1 - _PEOPLE)
