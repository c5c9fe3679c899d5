"""Panoramas of light: Radiance HDR pictures."""

import re
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from torchface.errors import FileFormatError
from torchface.files.whole_files import read_file

_MAGIC = (b"#?RADIANCE", b"#?RGBE")
_SIZE = re.compile(rb"^-Y (\d{1,6}) \+X (\d{1,6})$", re.MULTILINE)
_HEADER_BYTES, _MOST_PIXELS = 65536, 2**27


def load_panorama(path: str | Path) -> Tensor:
    """An equirectangular Radiance picture (``.hdr``), linear, (3,H,W) float32, first row straight up."""
    data = read_file(Path(path))
    if not data.startswith(_MAGIC):
        raise FileFormatError(
            f"{path}: found no Radiance picture, expected a panorama of light (.hdr, beginning with #?RADIANCE); "
            "other programs convert OpenEXR, and a photograph does not hold the strength of its light sources"
        )
    size = _SIZE.search(data[:_HEADER_BYTES])
    if size is None:
        raise FileFormatError(f"{path}: found no size in the header, expected -Y HEIGHT +X WIDTH, top row first")
    height, width = int(size[1]), int(size[2])
    if not 0 < height * width <= _MOST_PIXELS or width != 2 * height:
        raise FileFormatError(
            f"{path}: found {width} x {height} pixels, expected an equirectangular panorama, twice as wide as high, of "
            f"{_MOST_PIXELS:,} pixels at most"
        )
    if len(data) - size.end() < 4 * height:  # the shortest of rows has a header of four bytes
        raise FileFormatError(f"{path}: found {len(data)} bytes for {height} rows, expected more; it is cut off")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise FileFormatError(f"{path}: found a damaged picture, expected a whole one ({error.err})") from error
    if image is None or image.shape != (height, width, 3) or not np.isfinite(image).all():
        raise FileFormatError(f"{path}: found a damaged picture, expected {width} x {height} pixels of light")
    return torch.from_numpy(np.ascontiguousarray(image[..., ::-1].transpose(2, 0, 1))).float()
