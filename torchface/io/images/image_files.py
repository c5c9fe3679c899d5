"""Images as tensors: (3,H,W) in [0,1], first row on top."""

import io
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from torchface.errors import ShapeError
from torchface.files.whole_files import read_file, write_file
from torchface.geometry.meshes.normal_maps import encode_normals
from torchface.io.images.color_profiles import in_srgb
from torchface.io.images.image_samples import Samples, decode_samples

IMAGE_ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".webp", ".tif", ".tiff", ".ppm", ".pgm")
"""What photographs are called; :func:`load_image` goes by their content."""


def load_image(path: str | Path) -> Tensor:
    """An image file as (3,H,W) float32 in [0,1], upright: turned as its EXIF orientation says, as viewers show it.

    Grey or RGB of 1 to 16 bits, palettes and CMYK; floating-point TIFF where its values lie in [0,1]. Transparency is
    left out. Colours in another space than sRGB, by a profile in the file or a PNG's gAMA, are converted to it.

    Raises:
        FileFormatError: the file is missing, no image, of a kind that is not read, or unpacks to far more pixels than
            its size lets expect.

    Example:
        >>> save_image(torch.rand(3, 4, 6), "photo.png")
        >>> load_image("photo.png").shape
        torch.Size([3, 4, 6])
    """
    return _samples(read_file(path), str(path)).colors()


def save_image(image: Tensor, path: str | Path) -> None:
    """Writes (3,H,W) in [0,1] as PNG.

    Example:
        >>> grey = torch.full((3, 2, 2), 0.5)
        >>> save_image(grey, "grey.png")
        >>> bool((load_image("grey.png") - 0.5).abs().max() < 1 / 255)
        True
    """
    write_file(path, encode_png(image))


def save_image16(image: Tensor, path: str | Path) -> None:
    """Writes (3,H,W) in [0,1] as PNG of 16 bits a channel.

    Example:
        >>> grey = torch.full((3, 2, 2), 0.5)
        >>> save_image16(grey, "grey.png")
        >>> bool((load_image("grey.png") - 0.5).abs().max() < 1 / 65535)
        True
    """
    write_file(path, encode_png16(image))


def decode_image(data: bytes, source: str) -> Tensor:
    """The image (3,H,W) in ``data``, colour profiles left out, as glTF 2.0 (3.8.2) and USD say; ``source`` names it in
    errors."""
    return decode_samples(data, source).colors()


def encode_png(image: Tensor) -> bytes:
    """(3,H,W), or (4,H,W) with opacity, in [0,1] as the bytes of a PNG, 8 bits a channel."""
    if image.ndim != 3 or image.shape[0] not in (3, 4) or 0 in image.shape:
        raise ShapeError(f"image: found {tuple(image.shape)}, expected (3,H,W) or (4,H,W) with at least one pixel")
    array = image.detach().clamp(0, 1).mul(255).round().to(torch.uint8).permute(1, 2, 0).cpu().numpy()
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(array)).save(buffer, "PNG")
    return buffer.getvalue()


def encode_jpeg(image: Tensor) -> bytes:
    """(3,H,W) in [0,1] as the bytes of a JPEG with colours as fine as the light."""
    array = image.detach().clamp(0, 1).mul(255).round().to(torch.uint8).permute(1, 2, 0).cpu().numpy()
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(array)).save(buffer, "JPEG", quality=90, subsampling=0)
    return buffer.getvalue()


def encode_png16(image: Tensor) -> bytes:
    """(3,H,W) in [0,1] as the bytes of a PNG, 16 bits a channel: in a normal map 8 bits show as steps in highlights."""
    import cv2

    if image.ndim != 3 or image.shape[0] != 3 or 0 in image.shape:
        raise ShapeError(f"image: found {tuple(image.shape)}, expected (3,H,W) with at least one pixel")
    steps = image.detach().cpu().clamp(0, 1).double().mul(65535).round().permute(1, 2, 0).numpy().astype(np.uint16)
    return cv2.imencode(".png", cv2.cvtColor(steps, cv2.COLOR_RGB2BGR))[1].tobytes()


def save_normal_map(normals: Tensor, path: str | Path) -> None:
    """Writes unit vectors in tangent space (3,H,W) as PNG of 16 bits a channel.

    Raises:
        FileFormatError: the folder cannot be written to.
        ShapeError: not (3,H,W).

    Example:
        >>> from torchface.geometry.meshes.normal_maps import decode_normals
        >>> tilted = torch.tensor([0.6, 0.0, 0.8])[:, None, None].repeat(1, 4, 4)
        >>> save_normal_map(tilted, "normals.png")
        >>> bool((decode_normals(load_image("normals.png")) - tilted).abs().max() < 1e-4)
        True
    """
    save_image16(encode_normals(normals), path)


def load_paint(path: str | Path) -> Tensor:
    """An image file as red, green, blue and alpha, (4,H,W) float32 in [0,1]; one without transparency is opaque."""
    return _samples(read_file(path), str(path), planes=4).paint()


def _samples(data: bytes, source: str, planes: int = 3) -> Samples:
    """Of a file by itself: what its profile says counts."""
    stored = decode_samples(data, source, planes)
    return Samples(in_srgb(stored.array, data, source))
