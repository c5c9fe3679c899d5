"""KTX2 images, as glTF's ``KHR_texture_basisu`` has them, unpacked by Basis Universal's own transcoder."""

from typing import Any

import numpy as np

from torchface.errors import FileFormatError
from torchface.files.extra_packages import import_extra
from torchface.io.images.image_headers import ImageHeader

_IDENTIFIER = b"\xabKTX 20\xbb\r\n\x1a\n"
_SIZE_AT, _HEADER = 20, 80  # bytes: of width and height; of what stands before the levels


def is_ktx2(data: bytes | memoryview) -> bool:
    """Whether these are the bytes of a KTX2 image."""
    return bytes(data[: len(_IDENTIFIER)]) == _IDENTIFIER


def ktx2_header(data: bytes, source: str) -> ImageHeader:
    """The image as its file describes it."""
    if len(data) < _HEADER:
        raise FileFormatError(f"{source}: no readable image: found {len(data)} bytes, expected those of a KTX2 image")
    width, height = np.frombuffer(data, "<u4", 2, _SIZE_AT).tolist()
    return ImageHeader("KTX2", width, height, 4, 8, 1, 1, data)


def ktx2_reader(source: str) -> Any:
    """The package that unpacks them."""
    return import_extra("opengl_basisu", "opengl-basisu", "compressed", f"{source}: a KTX2 image")


def ktx2_samples(data: bytes, source: str) -> np.ndarray:
    """The largest level as uint8 (H,W,3), or (H,W,4) with opacity, first row on top."""
    basis = ktx2_reader(source)
    try:
        texture = basis.open(data)
        samples: np.ndarray = texture.transcode("rgba8").data
    except (basis.BasisuError, ValueError) as error:
        raise FileFormatError(f"{source}: no readable image ({str(error)[:80]})") from error
    return samples if texture.has_alpha else samples[..., :3]
