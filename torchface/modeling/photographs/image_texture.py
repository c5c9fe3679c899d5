"""Texture and colours of a fitted head from the photographs that it was fitted to: its skin and its irises."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchface.geometry.cameras.pinhole import Camera
from torchface.geometry.meshes.operators import vertex_normals
from torchface.io.gltf.region_materials import EYEBALL, part_material
from torchface.mesh import Mesh
from torchface.modeling.morphable.morphable_model import MorphableModel
from torchface.modeling.photographs.landmark_view import LANDMARKS
from torchface.modeling.photographs.skin_mask import skin_shares
from torchface.modeling.photographs.texture_fit import ColorFit, fit_colors
from torchface.modeling.photographs.texture_projection import photo_texture
from torchface.rendering.camera_visibility import shown_in
from torchface.rendering.clay_shading import sample_texture
from torchface.rendering.raycast import RayCaster

_MIN_DIAMETER = 14.0  # across an eyeball; of smaller ones a photograph shows no iris
_SHARE = (0.15, 0.40)
"""Of the eyeball between the lids, the darkest first: lashes and pupil, then the iris, then white and highlights."""

_MIN_PIXELS = 40
_IRIS_COSINE = 0.9  # of the angle between the eye's axis and the border of an iris 11 mm wide


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
    posed: Sequence[Mesh],
    color: MorphableModel | None,
    images: Sequence[Tensor],
    cameras: Sequence[Camera],
    size: int = 1024,
    masked: bool = True,
) -> Skin:
    """A head's skin from photographs and a colour model.

    Args:
        posed: the head as each photograph shows it; its own skin is the template's.
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
    mesh = posed[0]
    base = _own_colors(mesh) if fit is None else fit.colors
    if mesh.uvs is None or size == 0:
        return Skin(base, None, fit)
    confidence = skin_shares(posed, images, cameras) if masked and _has_landmarks(mesh) else None
    if base is not None:
        texture = photo_texture(posed, images, cameras, size, base, confidence)
        return Skin(texture.colors, texture.image, fit)
    parts = part_vertices(mesh)
    if parts.any() and not parts.all():
        confidence = torch.ones(len(images), len(parts)) if confidence is None else confidence
        confidence = torch.where(parts, 0.0, confidence)
    texture = photo_texture(posed, images, cameras, size, base, confidence)
    colored = with_part_colors(replace(mesh, colors=texture.colors), iris_color(posed, images, cameras))
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


def part_vertices(mesh: Mesh) -> Tensor:
    """The vertices of parts that are no skin, by the names of their regions, (V,) bool."""
    result = torch.zeros(len(mesh.vertices), dtype=torch.bool)
    for name, mask in ({} if mesh.annotations is None else mesh.annotations.regions).items():
        if part_material(name) is not None:
            result |= mask.cpu()
    return result


def iris_color(posed: Mesh | Sequence[Mesh], images: Sequence[Tensor], cameras: Sequence[Camera]) -> Tensor | None:
    """The irises' colour (3,), sRGB, or None where no photograph is large enough to show it.

    Where the eyes look is not known: of what is seen of the eyeballs between the lids, the dark share that is neither
    lash and pupil nor white counts.

    Args:
        posed: the head as the photographs show it, or as each of them does, its eyeballs annotated.
        images: photographs, (3,H,W) each.
        cameras: one each.
    """
    meshes = [posed] * len(images) if isinstance(posed, Mesh) else posed
    regions = {} if meshes[0].annotations is None else meshes[0].annotations.regions
    balls = [mask.cpu() for name, mask in regions.items() if part_material(name) is EYEBALL and bool(mask.any())]
    if not balls:
        return None
    clear = torch.zeros(len(meshes[0].vertices), dtype=torch.bool)
    for name, mask in regions.items():
        material = part_material(name)
        clear |= mask.cpu() if material is not None and material.alpha == "BLEND" else torch.zeros_like(clear)
    seen = []
    for mesh, image, camera in zip(meshes, images, cameras, strict=True):  # photographs
        vertices, faces = mesh.vertices.detach().cpu().double(), mesh.faces.cpu()
        caster = RayCaster(vertices, faces[~clear[faces].all(1)])
        shown = shown_in(image.cpu(), camera, caster, vertices, vertex_normals(vertices, faces))
        for ball in balls:
            pixels = camera.project(vertices[ball])
            if float((pixels.amax(0) - pixels.amin(0)).amin()) >= _MIN_DIAMETER:
                seen.append(shown.colors[ball & (shown.cosine > 0.3)].double())
    colors = torch.cat(seen) if seen else torch.zeros(0, 3, dtype=torch.float64)
    if len(colors) < _MIN_PIXELS:
        return None
    order = colors.mean(1).argsort()
    first, last = (round(share * len(order)) for share in _SHARE)
    return colors[order[first : max(last, first + 1)]].median(0).values.clamp(0.03, 0.9).float()


def with_part_colors(mesh: Mesh, iris: Tensor | None) -> Mesh:
    """A mesh with vertex colours whose parts have those of their materials, and whose eyeballs have the iris in front.

    Args:
        mesh: a head with colours.
        iris: sRGB (3,); the eyeballs' own if absent.
    """
    if mesh.colors is None or mesh.annotations is None:
        return mesh
    colors = mesh.colors.clone()
    for name, mask in mesh.annotations.regions.items():
        material = part_material(name)
        if material is None or not bool(mask.any()):
            continue
        colors[mask] = colors.new_tensor(material.color)
        if material is EYEBALL and iris is not None:
            ball = mesh.vertices[mask]
            ahead = torch.nn.functional.normalize(ball - (ball.amin(0) + ball.amax(0)) / 2, dim=1)[:, 2]
            colors[mask.nonzero()[:, 0][ahead > _IRIS_COSINE]] = iris.to(colors)
    return replace(mesh, colors=colors)
