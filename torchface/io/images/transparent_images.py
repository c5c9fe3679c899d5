"""Images with transparency: what is laid over something else."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from torchface.files.whole_files import read_file
from torchface.io.images.image_files import decode_image


def load_paint(path: str | Path) -> Tensor:
    """An image file as red, green, blue and alpha, (4,H,W) float32 in [0,1]; one without transparency is opaque.

    Raises:
        FileFormatError: the file is missing, no image, or unpacks to far more pixels than its size lets expect.
    """
    data = read_file(path)
    colors = decode_image(data, str(path))  # which checks the file before anything else reads it
    with Image.open(io.BytesIO(data)) as image:
        if "A" not in image.getbands() and "transparency" not in image.info:
            return torch.cat([colors, torch.ones(1, *colors.shape[1:])])
        alpha = np.array(image.convert("RGBA"))[..., 3]
    return torch.cat([colors, torch.from_numpy(alpha)[None].float() / 255])
