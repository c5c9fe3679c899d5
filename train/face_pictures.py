"""The pictures that networks of faces learn from: rendered once, kept in a folder, read by all recipes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor

from torchface.io.rigs.ict_facekit import load_ict_facekit, load_identity_modes
from torchface.progress import Progress
from torchface.synthetic.stages.face_pictures.face_picture import draw_pictures
from torchface.synthetic.stages.face_pictures.head_kind import HeadKind, people_kind, performer_kind
from train.rendered_files import Rendering, rendered_files

PART = 240
"""Pictures in a file: what a killed run loses at most."""
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


def render_pictures(
    folder: Path, count: int, seed: int, ict: Path | None = None, workers: int = 1, progress: Progress | None = None
) -> FacePictures:
    """Renders what a folder does not hold yet, and reads all; how many processes render does not change them.

    Args:
        folder: for the files; pictures of another seed or other heads lie beside each other there.
        count: how many, rounded up to whole files.
        seed: decides them.
        ict: ICT-FaceKit's ``FaceXModel``, whose heads are four in five; embedded performers alone without.
        workers: processes.
        progress: called with each step and how far it is.
    """
    rendering = Rendering(_render, "face pictures/3", "pictures", "faces", PART)
    paths = rendered_files(rendering, folder, count, seed, ict, workers, progress)
    return read_pictures(paths)


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
        for name in ("rgba", "landmarks", "visible"):
            getattr(found, name)[rows] = part[name]
    return found


def _render(first: int, count: int, seed: int, ict: Path | None) -> dict[str, Tensor]:
    pictures = draw_pictures(*head_kinds(ict), first, count, seed)
    return {name: torch.stack([getattr(one, name) for one in pictures]) for name in ("rgba", "landmarks", "visible")}


@lru_cache(maxsize=2)
def head_kinds(ict: Path | None) -> tuple[tuple[HeadKind, ...], tuple[float, ...]]:
    """Kinds of heads and how often each is drawn: embedded performers alone, or with ICT-FaceKit's, four in five."""
    if ict is None:
        return (performer_kind(),), (1.0,)
    return (people_kind(load_ict_facekit(ict), load_identity_modes(ict)), performer_kind()), (_PEOPLE, 1 - _PEOPLE)
