"""Colours of images with an embedded profile or a PNG's own exponent, as sRGB."""

import io
import re
import struct
import warnings
import zlib
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from torchface.color_space import to_srgb
from torchface.errors import FileFormatError
from torchface.io.images.tiff_tags import ICC_PROFILE, tag_bytes

_MOST_BYTES = 2**23  # of a profile; those of printers have some megabytes
_OF_SRGB, _LIKE_SRGB = 1 / 2.2, 0.05  # what a PNG of sRGB says, and how much otherwise makes no difference
_SAME = 2  # of 255: by how much profiles of sRGB differ
_JPEG_PROFILE = re.compile(rb"ICC_PROFILE\0(.).", re.DOTALL)
_JPEG_PICTURE = (0xD9, 0xDA)  # markers of its end and of its pixels, which no profile follows
_LEVELS = np.linspace(0, 255, 6).round().astype(np.uint8)
_ROWS = 256


def in_srgb(samples: NDArray[Any], data: bytes, source: str) -> NDArray[Any]:
    """The samples (H,W,C) of a file as sRGB, where it says that they are in another space.

    What is converted by a profile keeps 8 bits. A profile that is broken, or of another kind than the samples (ink,
    say), is left out with a ``UserWarning``.
    """
    # Loaded here: few images have a profile.
    from PIL import ImageCms

    try:
        profile, exponent = _embedded(data, source)
        if not profile:
            return samples if not exponent else _with_exponent(samples, exponent)
        own = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        kind = own.profile.xcolor_space.strip()
        mode = {"RGB": "RGB", "GRAY": "L"}.get(kind)
        if mode is None or (mode == "L" and samples.shape[2] > 2):
            raise ValueError(f"it is of {kind}, the image of {'grey' if samples.shape[2] < 3 else 'RGB'}")
        way = ImageCms.Intent.RELATIVE_COLORIMETRIC
        change = ImageCms.buildTransform(own, ImageCms.createProfile("sRGB"), mode, "RGB", way)
    except (ImageCms.PyCMSError, FileFormatError, OSError, ValueError, zlib.error, struct.error) as error:
        warnings.warn(f"{source}: its colour profile was left out: {str(error)[:200]}", stacklevel=4)
        return samples

    def converted(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        image = Image.fromarray(pixels[..., 0] if mode == "L" else np.broadcast_to(pixels, (*pixels.shape[:2], 3)))
        return np.asarray(ImageCms.applyTransform(image, change))

    colors = 3 if samples.shape[2] > 2 else 1
    cube = np.stack(np.meshgrid(*[_LEVELS] * colors, indexing="ij"), -1).reshape(1, -1, colors)
    if np.abs(converted(cube).astype(int) - cube).max() <= _SAME:
        return samples
    highest = 1 if samples.dtype == np.float32 else np.iinfo(samples.dtype).max
    result = samples.copy()
    for first in range(0, len(samples), _ROWS):  # so that no second copy of a large photograph is made
        part = samples[first : first + _ROWS, :, :colors]
        fine = part if part.dtype == np.uint8 else np.rint(part * (255 / highest)).astype(np.uint8)
        result[first : first + _ROWS, :, :colors] = converted(fine)[..., :colors] * (highest / 255)
    return result


def _with_exponent(samples: NDArray[Any], exponent: float) -> NDArray[Any]:
    """Samples that are light to this power; PNG has whole numbers alone."""
    colors, highest = 3 if samples.shape[2] > 2 else 1, np.iinfo(samples.dtype).max
    light = torch.linspace(0, 1, highest + 1, dtype=torch.float64).pow(1 / exponent)
    table = to_srgb(light).mul(highest).round().numpy().astype(samples.dtype)
    return np.concatenate([table[samples[..., :colors]], samples[..., colors:]], axis=2)


def _embedded(data: bytes, source: str) -> tuple[bytes, float]:
    """A file's profile, and the exponent of its values; empty and 0 where it says nothing, or that it is sRGB."""
    if data.startswith(b"\x89PNG"):
        return _of_png(data)
    if data.startswith(b"\xff\xd8"):
        return _of_jpeg(data), 0.0
    if data[:4] == b"RIFF" and data[30:34] == b"ICCP":
        return data[38 : 38 + int.from_bytes(data[34:38], "little")], 0.0
    if data[:2] in (b"II", b"MM"):
        return tag_bytes(data, source, ICC_PROFILE), 0.0
    return b"", 0.0


def _of_jpeg(data: bytes) -> bytes:
    at, parts = 2, dict[bytes, bytes]()
    # Segments have to be walked: a thumbnail in one of them, and a second picture behind the first, have profiles too.
    while at + 4 <= len(data) and data[at] == 0xFF and (kind := data[at + 1]) not in _JPEG_PICTURE:
        end = at + 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        if kind == 0xE2 and (match := _JPEG_PROFILE.match(data, at + 4, end)):
            parts[match[1]] = data[match.end() : end]
        at = at + 1 if kind == 0xFF else end
    return b"".join(parts[number] for number in sorted(parts))


def _of_png(data: bytes) -> tuple[bytes, float]:
    at, exponent = 8, 0.0
    while at + 8 <= len(data):  # chunks have to be walked one after the other
        (length,), kind, content = struct.unpack_from(">I", data, at), data[at + 4 : at + 8], at + 8
        if kind in (b"sRGB", b"IDAT"):
            return b"", 0.0 if kind == b"sRGB" else exponent
        if kind == b"iCCP":
            _, _, packed = data[content : content + length].partition(b"\0")
            return zlib.decompressobj().decompress(packed[1:], _MOST_BYTES), 0.0
        if kind == b"gAMA":
            found = struct.unpack_from(">I", data, content)[0] / 100_000
            likely = 0.1 < found < 10 and abs(found / _OF_SRGB - 1) > _LIKE_SRGB
            exponent = found if likely else 0.0
        at += 12 + length
    return b"", 0.0
