"""PNG with 16 bits a channel, which Pillow knows only with 8: normal maps show steps in highlights otherwise."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from PIL.ImageFile import ImageFile
from torch import Tensor

from torchface.errors import ShapeError

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_TRUECOLOUR, _UP = 2, 2
_PACKING = 4  # zlib's level; 9 takes five times as long for a few percent


def encode_png16(image: Tensor) -> bytes:
    """(3,H,W) in [0,1] as the bytes of a PNG, 16 bits a channel.

    Raises:
        ShapeError: the image is not (3,H,W) with at least one pixel.

    Source: Portable Network Graphics specification (W3C), chapters 9 and 11.
    """
    if image.ndim != 3 or image.shape[0] != 3 or 0 in image.shape:
        raise ShapeError(f"image: found {tuple(image.shape)}, expected (3,H,W) with at least one pixel")
    height, width = image.shape[1:]
    steps = image.detach().cpu().clamp(0, 1).double().mul(65535).round().permute(1, 2, 0)
    rows = np.ascontiguousarray(steps.numpy().astype(">u2")).view(np.uint8).reshape(height, width * 6)
    lines = np.full((height, 1 + width * 6), _UP, np.uint8)  # each row as its difference to the one above
    lines[0, 1:] = rows[0]
    np.subtract(rows[1:], rows[:-1], out=lines[1:, 1:])
    header = struct.pack(">IIBBBBB", width, height, 16, _TRUECOLOUR, 0, 0, 0)
    packed = zlib.compress(lines.tobytes(), _PACKING)
    return _SIGNATURE + _chunk(b"IHDR", header) + _chunk(b"IDAT", packed) + _chunk(b"IEND", b"")


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def holds_png16(image: Image.Image) -> bool:
    """Whether an image that Pillow has opened, not loaded, is a PNG of 16-bit colours."""
    return isinstance(image, ImageFile) and image.format == "PNG" and [tile[3] for tile in image.tile] == ["RGB;16B"]


def read_png16(high: Image.Image, low: ImageFile) -> NDArray[np.uint16]:
    """All 16 bits of a PNG that Pillow has opened twice, (H,W,3).

    Pillow unpacks one byte of each pair. Told that pairs are the other way round, it unpacks the other.
    """
    low.tile = [low.tile[0]._replace(args="RGB;16L")]
    return np.array(high).astype(np.uint16) << 8 | np.array(low)


def from_steps(array: NDArray[np.uint16]) -> Tensor:
    """(3,H,W) float32 in [0,1] of steps (H,W,3)."""
    return torch.from_numpy(array.astype(np.float32) / 65535).permute(2, 0, 1).contiguous()
