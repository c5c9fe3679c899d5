"""Normal maps as image files, in the convention of glTF, Blender, Unity and OpenGL: green is up."""

from __future__ import annotations

from pathlib import Path

from torch import Tensor

from torchface.errors import FileFormatError
from torchface.geometry.meshes.normal_maps import decode_normals, encode_normals
from torchface.io.images.image_files import load_image, save_image16


def save_normal_map(normals: Tensor, path: str | Path) -> None:
    """Writes unit vectors in tangent space (3,H,W) as PNG of 16 bits a channel.

    Raises:
        FileFormatError: the folder cannot be written to.
        ShapeError: not (3,H,W).

    Example:
        >>> tilted = torch.tensor([0.6, 0.0, 0.8])[:, None, None].repeat(1, 4, 4)
        >>> save_normal_map(tilted, "normals.png")
        >>> bool((load_normal_map("normals.png") - tilted).abs().max() < 1e-4)
        True
    """
    save_image16(encode_normals(normals), path)


def load_normal_map(path: str | Path) -> Tensor:
    """Unit vectors in tangent space (3,H,W) from an image of 8 or 16 bits; a map whose green is down is not noticed.

    Raises:
        FileFormatError: no image, or one whose directions point into the surface, as no normal map's do.

    Example:
        >>> up = torch.tensor([0.0, 0.0, 1.0])[:, None, None].repeat(1, 4, 4)
        >>> save_normal_map(up, "normals.png")
        >>> load_normal_map("normals.png")[2].min().item()
        1.0
    """
    normals = decode_normals(load_image(path))
    inward = float((normals[2] < 0).double().mean())
    if inward > 0.1:
        raise FileFormatError(f"{path}: found {inward:.0%} of the directions pointing inward, expected a normal map")
    return normals
