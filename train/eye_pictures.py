"""The pictures of eyes that the eye network learns from: rendered once, kept in a folder."""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, fields
from multiprocessing import get_context
from pathlib import Path

import torch
from safetensors.torch import load_file, save
from torch import Tensor

from torchface.files.content_keys import content_key
from torchface.files.whole_files import make_folder, write_file
from torchface.landmarks.images.eyes.eye_augmentation import EyeLabels
from torchface.progress import Progress, silent
from torchface.synthetic.stages.face_pictures.eye_picture import draw_eye_pictures
from train.face_pictures import head_kinds

PART = 200
"""Pictures in a file: what a killed run loses at most."""
_METHOD = "eye pictures/1"


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
    progress = progress or silent
    make_folder(folder)
    key = content_key(_METHOD, seed=seed, ict=None if ict is None else ict.name)[:12]
    paths = [folder / f"eyes_{key}_{number:04d}.safetensors" for number in range(-(-count // PART))]
    parts = [(path, number, seed, ict) for number, path in enumerate(paths) if not path.is_file()]
    with ExitStack() as stack:
        done: Iterable[None] = map(_render_part, parts)
        if workers > 1:
            # Spawned: what a process inherits of torch's threads may not survive a fork.
            pool = ProcessPoolExecutor(workers, get_context("spawn"))
            done = stack.enter_context(pool).map(_render_part, parts)
        for number, _ in enumerate(done):
            progress("rendering eyes", PART * (len(paths) - len(parts) + number + 1), PART * len(paths))
    return read_eye_pictures(paths)


def read_eye_pictures(paths: list[Path]) -> EyePictures:
    """The pictures of files, in their order."""
    read = [load_file(path) for path in paths]
    return EyePictures(*(torch.cat([part[field.name] for part in read]) for field in fields(EyePictures)))


def _render_part(part: tuple[Path, int, int, Path | None]) -> None:
    path, number, seed, ict = part
    torch.set_num_threads(1)
    pictures = draw_eye_pictures(*head_kinds(ict), PART * number, PART, seed)
    names = [field.name for field in fields(EyePictures)]
    write_file(path, save({name: torch.stack([getattr(one, name) for one in pictures]) for name in names}))
