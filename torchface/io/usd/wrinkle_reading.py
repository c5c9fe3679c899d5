"""Wrinkle maps of a USD file."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from torchface.errors import FileFormatError, NameMismatchError, ShapeError
from torchface.geometry.meshes.normal_maps import DetailMaps, decode_normals
from torchface.io.images.image_files import decode_image
from torchface.io.usd.usd_reading import read_stage

_UNPACKED_ALWAYS, _UNPACKED_PER_BYTE = 2**28, 1024  # as of glTF's


def read_usd_detail(path: str | Path) -> DetailMaps | None:
    """The wrinkle maps of a USD file; none where it has neither such maps nor a normal texture.

    Raises:
        MissingExtraError: usd-core is not installed.
        FileFormatError: as of ``read_usd_rig``; images of different sizes, or more of them than the file can hold.

    Example:
        >>> from torchface.io import save_mesh
        >>> from torchface.synthetic import neutral_head
        >>> save_mesh(neutral_head(texture=False), "smooth.usdc")
        >>> read_usd_detail("smooth.usdc") is None
        True
    """
    scene = read_stage(path, "--maps")
    allowed = max(_UNPACKED_ALWAYS, _UNPACKED_PER_BYTE * scene.record["bytes"])
    found: dict[str, Tensor] = {}
    unpacked = 0
    for name, data in scene.arrays.items():
        image = decode_image(data.tobytes(), f"{path}: its wrinkle map {name}")
        unpacked += 4 * image.numel()
        if unpacked > allowed:
            raise FileFormatError(f"{path}: found maps that unpack to {unpacked} bytes, expected at most {allowed}")
        found[name] = decode_normals(image[:3])
    if not found:
        return None
    neutral = found.get("neutral")
    maps = [found[f"{row}"] for row in range(len(scene.record["shapes"]))]
    if len({one.shape for one in found.values()}) > 1:
        sizes = sorted({f"{one.shape[2]}x{one.shape[1]}" for one in found.values()})
        raise FileFormatError(f"{path}: found wrinkle maps of {' and '.join(sizes[:3])} pixels, expected one size")
    stacked = torch.stack(maps) if neutral is None or maps else neutral.new_zeros(0, *neutral.shape)
    try:
        return DetailMaps(tuple(scene.record["shapes"]), stacked, neutral)
    except (NameMismatchError, ShapeError) as error:
        raise FileFormatError(f"{path}: {error}") from error
