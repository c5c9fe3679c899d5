"""Wrinkle maps by region in a ``.glb``: the neutral's normals as the material's normal texture, where every viewer
shows them; the rest as textures that ``mesh.extras.torchface.wrinkleRegions`` lists::

    {"regions": [names], "normals": [texture, one a map], "heights": [texture, ...], "heightRange": [low, high],
     "masks": [texture, ...]}

Heights and masks come three a texture, in red, green and blue, all values linear. A height is ``low + value * (high -
low)`` millimetres; normals are as in ``wrinkleMaps``. A texel shows map m by the sum over regions of mask times weight;
slopes of normals and heights add up so.
"""

import math
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchface.geometry.meshes.normal_maps import decode_normals, encode_normals
from torchface.geometry.meshes.region_maps import RegionMaps
from torchface.io.gltf.buffers import BufferWriter
from torchface.io.gltf.detail_textures import TextureReader, normal_texture
from torchface.io.gltf.gltf_document import Document, read_document
from torchface.io.images.image_files import encode_png

_KEY = "wrinkleRegions"
_LEAST_RANGE = 1e-3  # millimetres


def write_region_maps(maps: RegionMaps, root: dict[str, Any], buffers: BufferWriter) -> None:
    """Adds maps to a document under construction whose first mesh and material are the face's."""

    def texture(image: Tensor, name: str) -> int:
        return buffers.texture(root, encode_png(image), name=name)

    neutral = texture(encode_normals(maps.neutral), "neutral_normals")
    root["materials"][0]["normalTexture"] = {"index": neutral}
    low, high = float(maps.heights.min()), float(maps.heights.max())
    high = max(high, low + _LEAST_RANGE)
    levels = (maps.heights - low) / (high - low)
    root["meshes"][0]["extras"]["torchface"][_KEY] = {
        "regions": list(maps.regions),
        "normals": [texture(encode_normals(image), f"wrinkle_{i}_normals") for i, image in enumerate(maps.normals)],
        "heights": [texture(image, f"wrinkle_heights_{i}") for i, image in enumerate(_packed(levels))],
        "heightRange": [low, high],
        "masks": [texture(image, f"region_masks_{i}") for i, image in enumerate(_packed(maps.masks))],
    }


def load_region_maps(path: str | Path) -> RegionMaps | None:
    """The wrinkle maps by region of a ``.glb``; none where it has none.

    Raises:
        FileFormatError: not glTF 2, a broken list, images of different sizes, or more of them than the file can hold.

    Example:
        >>> from torchface.io import save_mesh
        >>> from torchface.synthetic import neutral_head
        >>> save_mesh(neutral_head(texture=False), "smooth.glb")
        >>> load_region_maps("smooth.glb") is None
        True
    """
    document = read_document(path)
    found = document.first_extras(_KEY)
    if found is None:
        return None
    mesh, location = found[0], f"{found[1]}.{_KEY}"
    listed = document.record(mesh["extras"]["torchface"][_KEY], location)
    regions = document.array(listed, "regions", location)
    if not regions or not all(isinstance(name, str) and name for name in regions) or len(set(regions)) < len(regions):
        raise document.error(f"{location}.regions", regions, "names, each once")
    reader = TextureReader(document, path)
    neutral = normal_texture(document, mesh)
    if neutral is None:
        raise document.error(location, "a material without a normal texture", "the normals of the face at rest in it")
    normals = reader.stacked([neutral, *document.array(listed, "normals", location)], f"{location}.normals")
    count = len(normals) - 1
    if count < 1:
        raise document.error(f"{location}.normals", "no map", "one or more")
    heights = reader.stacked(_textures(document, listed, "heights", count, location), f"{location}.heights")
    masks = reader.stacked(_textures(document, listed, "masks", len(regions), location), f"{location}.masks")
    if heights.shape[2:] != normals.shape[2:]:
        raise document.error(
            location, f"maps of {tuple(normals.shape[2:])} and heights of {tuple(heights.shape[2:])}", "one size"
        )
    low, high = _range(document, listed, location)
    decoded = torch.stack([decode_normals(image) for image in normals])
    return RegionMaps(
        tuple(regions),
        decoded[1:],
        low + (high - low) * heights.flatten(0, 1)[:count],
        masks.flatten(0, 1)[: len(regions)],
        decoded[0],
    )


def _packed(channels: Tensor) -> list[Tensor]:
    """Channels (C,H,W) as images (3,H,W), the last filled up with zeros."""
    missing = -len(channels) % 3
    return list(torch.cat([channels, channels.new_zeros(missing, *channels.shape[1:])]).unflatten(0, (-1, 3)))


def _textures(document: Document, listed: dict[str, Any], key: str, channels: int, location: str) -> list[Any]:
    """As many textures as hold the channels."""
    indices = document.array(listed, key, location)
    wanted = math.ceil(channels / 3)
    if len(indices) != wanted:
        raise document.error(f"{location}.{key}", f"{len(indices)} textures", f"{wanted}, three channels each")
    return indices


def _range(document: Document, listed: dict[str, Any], location: str) -> tuple[float, float]:
    ends = document.numbers(listed, "heightRange", location, 2)
    if ends is None or not ends[0] < ends[1]:
        raise document.error(f"{location}.heightRange", ends, "two numbers, the lower first, millimetres")
    return float(ends[0]), float(ends[1])
