"""Images as tensors: (3,H,W) in [0,1], first row on top."""

from __future__ import annotations

import io
import warnings
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from PIL.ImageFile import ImageFile
from torch import Tensor

from torchface.errors import FileFormatError, ShapeError
from torchface.files.whole_files import read_file, write_file

_PIXELS_ALWAYS = 4096 * 4096
_PIXELS_PER_BYTE = 100
_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TGA", "TIFF", "PPM")


def load_image(path: str | Path) -> Tensor:
    """An image file as (3,H,W) float32 in [0,1].

    Raises:
        FileFormatError: the file is missing, no image, or unpacks to far more pixels than its size lets expect.
    """
    return decode_image(read_file(path), str(path))


def save_image(image: Tensor, path: str | Path) -> None:
    """Writes (3,H,W) in [0,1] as PNG."""
    write_file(path, encode_png(image))


def save_image16(image: Tensor, path: str | Path) -> None:
    """Writes (3,H,W) in [0,1] as PNG of 16 bits a channel."""
    write_file(path, encode_png16(image))


def decode_image(data: bytes, source: str) -> Tensor:
    """The image (3,H,W) in ``data``; ``source`` names it in errors.

    An image of more than 4096 x 4096 pixels needs a byte for every hundred of them, so that a file of some
    kilobytes cannot unpack to gigabytes.

    Raises:
        FileFormatError: no image, a broken one, or a decompression bomb.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow's own warning of bombs and odd metadata; the limit here is lower
            with Image.open(io.BytesIO(data), formats=_FORMATS) as image:
                pixels = image.width * image.height
                if pixels > max(_PIXELS_ALWAYS, _PIXELS_PER_BYTE * len(data)):
                    raise FileFormatError(
                        f"{source}: found an image of {image.width} x {image.height} pixels in {len(data)} bytes, "
                        f"expected at most {max(_PIXELS_ALWAYS, _PIXELS_PER_BYTE * len(data))} pixels"
                    )
                if _has_16_bits(image):
                    return _decode_png16(data, source)
                array = np.array(image.convert("RGB"))
    # Pillow's decoders let most kinds of errors escape on broken bytes; whatever they are, it is no image.
    except (OSError, ValueError, SyntaxError, TypeError, IndexError, KeyError, EOFError, ArithmeticError) as error:
        raise FileFormatError(f"{source}: no readable image ({error})") from error
    except (Image.DecompressionBombError, AttributeError, AssertionError, RuntimeError) as error:
        raise FileFormatError(f"{source}: no readable image ({error})") from error
    return torch.from_numpy(array).permute(2, 0, 1).contiguous().float().div_(255)


def encode_png(image: Tensor) -> bytes:
    """(3,H,W), or (4,H,W) with opacity, in [0,1] as the bytes of a PNG, 8 bits a channel.

    Raises:
        ShapeError: the image is not (3,H,W) or (4,H,W) with at least one pixel.
    """
    if image.ndim != 3 or image.shape[0] not in (3, 4) or 0 in image.shape:
        raise ShapeError(f"image: found {tuple(image.shape)}, expected (3,H,W) or (4,H,W) with at least one pixel")
    array = image.detach().clamp(0, 1).mul(255).round().to(torch.uint8).permute(1, 2, 0).cpu().numpy()
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(array)).save(buffer, "PNG")
    return buffer.getvalue()


def encode_png16(image: Tensor) -> bytes:
    """(3,H,W) in [0,1] as the bytes of a PNG, 16 bits a channel: in a normal map 8 bits show as steps in highlights.

    Raises:
        ShapeError: the image is not (3,H,W) with at least one pixel.
    """
    import cv2

    if image.ndim != 3 or image.shape[0] != 3 or 0 in image.shape:
        raise ShapeError(f"image: found {tuple(image.shape)}, expected (3,H,W) with at least one pixel")
    steps = image.detach().cpu().clamp(0, 1).double().mul(65535).round().permute(1, 2, 0).numpy().astype(np.uint16)
    return cv2.imencode(".png", cv2.cvtColor(steps, cv2.COLOR_RGB2BGR))[1].tobytes()


def _has_16_bits(image: Image.Image) -> bool:
    """Whether an image that Pillow has opened, not loaded, is a PNG of 16 bits a channel, of which Pillow keeps 8."""
    return isinstance(image, ImageFile) and image.format == "PNG" and str(image.tile[0][3]).endswith("16B")


def _decode_png16(data: bytes, source: str) -> Tensor:
    import cv2

    try:
        flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
        steps = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise FileFormatError(f"{source}: no readable image ({error})") from error
    if steps is None or steps.dtype != np.uint16:
        raise FileFormatError(f"{source}: found a broken PNG of 16 bits a channel, expected a whole one")
    array = cv2.cvtColor(steps, cv2.COLOR_BGR2RGB).astype(np.float32) / 65535
    return torch.from_numpy(array).permute(2, 0, 1).contiguous()
