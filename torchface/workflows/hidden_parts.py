"""The skin of a registered face where the scan has shown none: eyeballs behind lids, teeth behind lips."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchface.geometry.meshes.operators import components
from torchface.geometry.meshes.uv_raster import rasterise_uvs
from torchface.mesh import Mesh

_SEEN = 0.05
_SEAM = 4


def hidden_parts(mesh: Mesh, matched: Tensor) -> Tensor:
    """The vertices of parts that share no vertex with the largest and that the scan has not shown, (V,) bool.

    Args:
        mesh: V vertices.
        matched: vertices that the scan shows, (V,) bool.
    """
    label = components(mesh.faces.cpu(), len(mesh.vertices))
    size = label.bincount().double()
    shown = torch.zeros_like(size).index_add_(0, label, matched.cpu().double()) / size.clamp(min=1)
    hidden = shown < _SEEN
    hidden[size.argmax()] = False
    return hidden[label]


def dressed_as(mesh: Mesh, template: Mesh, hidden: Tensor) -> Mesh:
    """A mesh whose hidden parts wear the template's skin; its own where the template has none.

    Args:
        mesh: registered, with the template's topology and texture coordinates.
        template: with a texture or vertex colours.
        hidden: vertices (V,) bool.
    """
    if not hidden.any():
        return mesh
    colors, texture = mesh.colors, mesh.texture
    if colors is not None and template.colors is not None:
        colors = torch.where(hidden[:, None], template.colors.to(colors), colors)
    if texture is not None and template.texture is not None and mesh.uvs is not None and mesh.uv_faces is not None:
        height, width = texture.shape[1:]
        texels = rasterise_uvs(mesh.uvs, mesh.uv_faces, height, width)
        inside = torch.zeros(height * width)
        inside[texels.texels[hidden[mesh.faces].all(1)[texels.triangles]]] = 1
        seam = torch.nn.functional.max_pool2d(inside.view(1, 1, height, width), 2 * _SEAM + 1, 1, _SEAM)[0, 0] > 0
        taken = (inside.view(height, width) > 0) | (seam & ~texels.mask())
        own = torch.nn.functional.interpolate(
            template.texture[None].to(texture), (height, width), mode="bilinear", align_corners=False, antialias=True
        )[0]
        texture = torch.where(taken, own, texture)
    return replace(mesh, colors=colors, texture=texture)
