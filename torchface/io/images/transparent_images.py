"""Images with transparency: what is laid over something else."""

from __future__ import annotations

from pathlib import Path

from torch import Tensor

from torchface.files.whole_files import read_file
from torchface.io.images.image_samples import decode_samples


def load_paint(path: str | Path) -> Tensor:
    """An image file as red, green, blue and alpha, (4,H,W) float32 in [0,1]; one without transparency is opaque.

    Raises:
        FileFormatError: the file is missing, no image, or unpacks to far more pixels than its size lets expect.
    """
    return decode_samples(read_file(path), str(path), planes=4).paint()
