"""Wrinkle maps by path: glTF and USD."""

from __future__ import annotations

from pathlib import Path

from torchface.geometry.meshes.normal_maps import DetailMaps
from torchface.io.gltf import read_gltf_detail
from torchface.io.usd import USD_ENDINGS, read_usd_detail


def load_detail_maps(path: str | Path) -> DetailMaps | None:
    """The wrinkle maps of a rig's file; none where it has neither such maps nor a normal texture.

    Args:
        path: a ``.glb``, ``.gltf`` or USD file.

    Raises:
        FileFormatError: another kind of file, a broken list, images of different sizes, or more of them than the file
            can hold.
        MissingExtraError: USD, and usd-core is not installed.

    Example:
        >>> from torchface.io import save_mesh
        >>> from torchface.synthetic import neutral_head
        >>> save_mesh(neutral_head(texture=False), "smooth.glb")
        >>> load_detail_maps("smooth.glb") is None
        True
    """
    if Path(path).suffix.lower() in USD_ENDINGS:
        return read_usd_detail(path)
    return read_gltf_detail(path)
