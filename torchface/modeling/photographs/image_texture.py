"""The skin of a fitted head from the photographs that it was fitted to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchface.geometry.cameras.pinhole import Camera
from torchface.mesh import Mesh
from torchface.modeling.morphable.morphable_model import MorphableModel
from torchface.modeling.photographs.eye_colors import iris_color, part_vertices, with_part_colors
from torchface.modeling.photographs.landmark_view import LANDMARKS
from torchface.modeling.photographs.skin_mask import skin_shares
from torchface.modeling.photographs.texture_fit import ColorFit, fit_colors
from torchface.modeling.photographs.texture_projection import photo_texture
from torchface.rendering.clay_shading import sample_texture


@dataclass(frozen=True, eq=False)
class Skin:
    """Colours of the vertices (V,3), a texture (3,size,size) where there is a layout, and the colour model's answer."""

    colors: Tensor | None
    texture: Tensor | None
    fit: ColorFit | None

    def on(self, mesh: Mesh) -> Mesh:
        """A mesh with it; one without a layout or a colour model keeps its own."""
        colors = mesh.colors if self.colors is None else self.colors
        return replace(mesh, colors=colors, texture=mesh.texture if self.texture is None else self.texture)


def photographed_skin(
    posed: Mesh,
    color: MorphableModel | None,
    images: Sequence[Tensor],
    cameras: Sequence[Camera],
    size: int = 1024,
    masked: bool = True,
) -> Skin:
    """A head's skin from photographs and a colour model.

    Args:
        posed: the head as the photographs show it; its own skin is the template's.
        color: model of vertex colours, if there is one.
        images: photographs, (3,H,W) each.
        cameras: one each.
        size: of the texture, texels a side; 0 makes none.
        masked: project only skin and the face's features onto the head; else also hair, clothes and what stands behind.

    Returns:
        With texture coordinates: the photographs projected onto the head, where none shows it the colour model, else
        the template's skin; of a template without colours, parts such as teeth have their material's, and the irises
        their colour in the photographs. Without: the colour model's colours.
    """
    fit = None if color is None else fit_colors(color, posed, images, cameras)
    base = _own_colors(posed) if fit is None else fit.colors
    if posed.uvs is None or size == 0:
        return Skin(base, None, fit)
    confidence = skin_shares(posed, images, cameras) if masked and _has_landmarks(posed) else None
    if base is not None:
        texture = photo_texture(posed, images, cameras, size, base, confidence)
        return Skin(texture.colors, texture.image, fit)
    parts = part_vertices(posed)
    if parts.any() and not parts.all():
        confidence = torch.ones(len(images), len(parts)) if confidence is None else confidence
        confidence = torch.where(parts, 0.0, confidence)
    texture = photo_texture(posed, images, cameras, size, base, confidence)
    colored = with_part_colors(replace(posed, colors=texture.colors), iris_color(posed, images, cameras))
    return Skin(colored.colors, texture.image, fit)


def _has_landmarks(mesh: Mesh) -> bool:
    annotations = mesh.annotations
    return annotations is not None and annotations.landmarks is not None and len(annotations.landmarks) == LANDMARKS


def _own_colors(mesh: Mesh) -> Tensor | None:
    """Vertex colours (V,3) of a mesh: its own, else those of its texture."""
    if mesh.colors is not None:
        return mesh.colors.cpu().float()
    if mesh.texture is None or mesh.uvs is None or mesh.uv_faces is None:
        return None
    row = torch.zeros(len(mesh.vertices), dtype=torch.int64)
    row[mesh.faces.cpu().flatten()] = mesh.uv_faces.cpu().flatten()
    return sample_texture(mesh.texture.cpu(), mesh.uvs.cpu()[row])
