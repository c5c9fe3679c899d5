"""The one opener of images: any file that is read as samples, upright, as they are stored."""

import io
import warnings
from dataclasses import dataclass

import numpy as np
import torch
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from torchface.errors import FileFormatError
from torchface.io.images.image_headers import ImageHeader, read_header
from torchface.io.images.ktx2_images import is_ktx2, ktx2_header, ktx2_samples

_PIXELS_ALWAYS, _PIXELS_PER_BYTE = 4096 * 4096, 100
_BYTES_ALWAYS, _BYTES_PER_BYTE = 480 * 2**20, 18
_PHOTOGRAPH_BYTES, _PHOTOGRAPH_PIXELS_PER_BYTE = 1536 * 2**20, 8
_BESIDES = {"JPEG": 3, "WEBP": 3}  # bytes a pixel that a decoder holds while the result is made
_PLAIN_KINDS = ("BMP", "PPM", "TGA")
_HIGHEST = {np.dtype(np.uint8): 255, np.dtype(np.uint16): 65535, np.dtype(np.float32): 1}


@dataclass(frozen=True, eq=False)
class Samples:
    """An upright image as its file stores it."""

    array: np.ndarray  # (H,W,C) of uint8, uint16 or float32: grey, grey and alpha, red green blue, or those and alpha

    def colors(self) -> Tensor:
        """Red, green and blue in [0,1], (3,H,W) float32."""
        return torch.from_numpy(self._planes(3))

    def paint(self) -> Tensor:
        """Red, green, blue and opacity in [0,1], (4,H,W) float32; what has no opacity is opaque."""
        planes = self._planes(4)
        if self.array.shape[2] % 2:
            planes[3] = 1
        else:
            self._scale(self.array[..., -1:], planes[3:])
        return torch.from_numpy(planes)

    def _planes(self, count: int) -> np.ndarray:
        """Room for so many, the first three filled."""
        planes = np.empty((count, *self.array.shape[:2]), np.float32)
        self._scale(self.array[..., : 3 if self.array.shape[2] > 2 else 1], planes[:3])
        return planes

    def _scale(self, part: np.ndarray, planes: np.ndarray) -> None:
        np.divide(part.transpose(2, 0, 1), np.float32(_HIGHEST[part.dtype]), out=planes, dtype=np.float32)


def decode_samples(data: bytes, source: str, planes: int = 3) -> Samples:
    """The image in ``data``, turned as its EXIF orientation says.

    What decoding takes, with the image as float32 after it, is known from the header and kept below 480 MiB or 18 bytes
    for a byte of the file, and below 1.5 GiB where each eight pixels have a byte, as photographs and textures of 30 to
    80 megapixels do; and an image of more than 4096 x 4096 pixels needs a byte for every hundred of them. So no file
    of some kilobytes unpacks to gigabytes.
    """
    if is_ktx2(data):
        _check_memory(ktx2_header(data, source), planes, len(data), source)
        return Samples(ktx2_samples(data, source))
    header = read_header(data, source)
    if header is None:
        return Samples(_decoded(header, data, source, planes))
    _check_memory(header, planes, len(data), source)
    array = _deep_samples(header, source) if header.bits > 8 else _decoded(header, data, source, planes)
    return Samples(_upright(_with_transparent_color(array, header.transparent), header.orientation))


def _check_memory(header: ImageHeader, planes: int, size: int, source: str) -> None:
    pixels = max(header.width * header.height, header.least_pixels)
    if header.width < 1 or header.height < 1:
        raise FileFormatError(f"{source}: no readable image: found {header.width} x {header.height} pixels")
    stored = max(header.samples, 3) * header.bits / 8 * (2 if header.bits == 64 else 1)
    bytes_per_pixel = 4 * planes + stored + _BESIDES.get(header.kind, 1)
    photograph = pixels <= _PHOTOGRAPH_PIXELS_PER_BYTE * size
    room = max(_PHOTOGRAPH_BYTES if photograph else _BYTES_ALWAYS, _BYTES_PER_BYTE * size) / bytes_per_pixel
    allowed = int(min(room, max(_PIXELS_ALWAYS, _PIXELS_PER_BYTE * size)))
    if pixels > allowed:
        raise FileFormatError(
            f"{source}: found an image of {header.width} x {header.height} pixels in {size} bytes, expected at most "
            f"{allowed} pixels; scale it down, or save it as TIFF without compression"
        )


def _decoded(header: ImageHeader | None, data: bytes, source: str, planes: int) -> np.ndarray:
    """The samples of 8 bits that Pillow decodes, and the plain kinds that it alone reads."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of odd metadata
            formats = _PLAIN_KINDS if header is None else [header.kind]
            with Image.open(io.BytesIO(data if header is None else header.data), formats=formats) as image:
                if header is None:
                    plain = ImageHeader(str(image.format), *image.size, len(image.getbands()), 8, 1, 1, data)
                    _check_memory(plain, planes, len(data), source)
                image.load()
                return _of_pillow(image, source)
    except UnidentifiedImageError as error:
        raise FileFormatError(
            f"{source}: no readable image: found no kind that is known, expected PNG or JPEG"
        ) from error
    # Pillow's decoders let most kinds of errors escape on broken bytes; whatever they are, it is no image.
    except (OSError, ValueError, SyntaxError, TypeError, IndexError, KeyError, EOFError, ArithmeticError) as error:
        raise FileFormatError(f"{source}: no readable image ({error})") from error
    except (Image.DecompressionBombError, AttributeError, AssertionError, RuntimeError) as error:
        raise FileFormatError(f"{source}: no readable image ({error})") from error


def _of_pillow(image: Image.Image, source: str) -> np.ndarray:
    """The samples (H,W,C) of a loaded image, palettes and colour spaces resolved."""
    if image.mode == "I" and image.format == "PPM":  # grey of more than 8 bits, which Pillow brings to 16
        return np.asarray(image).astype(np.uint16)[..., None]
    if image.mode == "F":
        return _checked_range(np.asarray(image)[..., None], source)
    if image.mode[0] == "I" or image.mode in ("LAB", "HSV"):
        raise FileFormatError(f"{source}: found pixels of the kind {image.mode}, expected grey or RGB of 8 or 16 bits")
    if image.mode in ("LA", "La"):
        wanted = "LA"
    elif image.mode in ("PA", "RGBA", "RGBa") or "transparency" in image.info:
        wanted = "RGBA"
    else:
        wanted = "L" if image.mode in ("1", "L") else "RGB"
    array = np.asarray(image if image.mode == wanted else image.convert(wanted))
    return array if array.ndim == 3 else array[..., None]


def _deep_samples(header: ImageHeader, source: str) -> np.ndarray:
    """Samples (H,W,C) of 16 bits, or floating-point ones in [0,1], of which Pillow would keep 8 bits or none."""
    # Loaded here: most images have 8 bits.
    import cv2

    what = f"{header.samples} samples a pixel, each {_number_name(header)}"
    if (header.number, header.bits) not in ((1, 16), (3, 32), (3, 64)) or header.samples > 4:
        raise FileFormatError(
            f"{source}: found a {header.kind} of {what}; expected up to 4, unsigned whole numbers of 8 or 16 bits or "
            "floating point of 32 or 64"
        )
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # what matters comes as an error
    try:
        decoded = cv2.imdecode(np.frombuffer(header.data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise FileFormatError(f"{source}: no readable image ({error.err})") from error
    finally:
        cv2.utils.logging.setLogLevel(level)
    expected = {16: np.uint16, 32: np.float32, 64: np.float64}[header.bits]
    if decoded is None or decoded.dtype != expected or decoded.shape[:2] != (header.height, header.width):
        raise FileFormatError(
            f"{source}: found a broken {header.kind} ({what}), or a layout that is not read; expected a whole one"
        )
    if header.number == 3:
        decoded = _checked_range(decoded.astype(np.float32, copy=False), source)
    if decoded.ndim == 3:
        decoded = cv2.cvtColor(decoded, {3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGBA}[decoded.shape[2]], dst=decoded)
    array = decoded if decoded.ndim == 3 else decoded[..., None]
    if header.inverted:
        np.subtract(_HIGHEST[array.dtype], array, out=array)
    return array


def _with_transparent_color(array: np.ndarray, color: tuple[int, ...]) -> np.ndarray:
    """An alpha channel besides, which is 0 where the samples are of this colour."""
    if not color:
        return array
    opacity = np.full(array.shape[:2], _HIGHEST[array.dtype], array.dtype)
    opacity[(array == np.asarray(color, array.dtype)).all(2)] = 0
    return np.dstack([array, opacity])


def _number_name(header: ImageHeader) -> str:
    kinds = {1: "an unsigned whole number", 2: "a signed whole number", 3: "floating point"}
    return f"{kinds.get(header.number, 'of an unknown kind')} of {header.bits} bits"


def _checked_range(array: np.ndarray, source: str) -> np.ndarray:
    low, high = float(array.min()), float(array.max())
    if not (low >= 0 and high <= 1):
        raise FileFormatError(
            f"{source}: found floating-point values from {low:g} to {high:g}, expected 0 (black) to 1 (white): "
            "bring them to that range, or save 16 bits"
        )
    return array


def _upright(array: np.ndarray, orientation: int) -> np.ndarray:
    """Turns and mirrors an image (H,W,C) as EXIF's orientation says. Source: EXIF 2.3, 4.6.4 A, tag 0x0112."""
    if orientation in (5, 6, 7, 8):
        array = array.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        array = array[::-1]
    if orientation in (2, 3, 6, 7):
        array = array[:, ::-1]
    return array
