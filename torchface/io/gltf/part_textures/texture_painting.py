"""Colours made for parts that bring none: computed at points of the part, laid out by its texture coordinates."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from torchface.geometry.meshes.rasterization import rasterise_uvs
from torchface.mesh import Mesh

_SIDE = 512


@dataclass(frozen=True, eq=False)
class Paint:
    """Colours of a part, sRGB and opacity.

    Args:
        image: in the mesh's own layout, (4,S,S); or
        colors: of its vertices, (V,4), where it has none.
    """

    image: Tensor | None
    colors: Tensor | None


def painted(mesh: Mesh, rows: Tensor, values: Tensor, color: Callable[[Tensor], Tensor], side: int = _SIDE) -> Paint:
    """Colours by values at the vertices, as an image where one tile holds the part's texture coordinates.

    Args:
        mesh: V vertices.
        rows: the part's triangles, (K,).
        values: of the vertices, (V,C).
        color: sRGB and opacity (N,4) of values (N,C).
        side: texels a side of the image.
    """
    if mesh.uvs is None or mesh.uv_faces is None:
        return Paint(None, color(values).float())
    corners = mesh.uvs[mesh.uv_faces[rows]].double()
    tile = corners.reshape(-1, 2).mean(0).floor()
    if not bool(((corners >= tile) & (corners <= tile + 1)).all()):
        return Paint(None, color(values).float())
    texels = rasterise_uvs(mesh.uvs.double() - tile, mesh.uv_faces[rows], side, side)
    return Paint(texels.image(color(texels.interpolate(values, mesh.faces[rows]))), None)
