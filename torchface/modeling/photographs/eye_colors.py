"""The colour of a person's irises, as photographs show them between the lids."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from torchface.geometry.cameras.pinhole import Camera
from torchface.geometry.meshes.operators import vertex_normals
from torchface.io.gltf.region_materials import EYEBALL, part_material
from torchface.mesh import Mesh
from torchface.rendering.camera_visibility import shown_in
from torchface.rendering.raycast import RayCaster

_MIN_DIAMETER = 14.0  # across an eyeball; of smaller ones a photograph shows no iris
_SHARE = (0.15, 0.40)
"""Of the eyeball between the lids, the darkest first: lashes and pupil, then the iris, then white and highlights."""
_MIN_PIXELS = 40
_IRIS_COSINE = 0.9  # of the angle between the eye's axis and the border of an iris 11 mm wide


def part_vertices(mesh: Mesh) -> Tensor:
    """The vertices of parts that are no skin, by the names of their regions, (V,) bool."""
    result = torch.zeros(len(mesh.vertices), dtype=torch.bool)
    for name, mask in ({} if mesh.annotations is None else mesh.annotations.regions).items():
        if part_material(name) is not None:
            result |= mask.cpu()
    return result


def iris_color(mesh: Mesh, images: Sequence[Tensor], cameras: Sequence[Camera]) -> Tensor | None:
    """The irises' colour (3,), sRGB, or None where no photograph is large enough to show it.

    Where the eyes look is not known: of what is seen of the eyeballs between the lids, the dark share that is neither
    lash and pupil nor white counts.

    Args:
        mesh: the head as the photographs show it, its eyeballs annotated.
        images: photographs, (3,H,W) each.
        cameras: one each.
    """
    regions = {} if mesh.annotations is None else mesh.annotations.regions
    balls = [mask.cpu() for name, mask in regions.items() if part_material(name) is EYEBALL]
    if not balls:
        return None
    vertices, faces = mesh.vertices.detach().cpu().double(), mesh.faces.cpu()
    clear = torch.zeros(len(vertices), dtype=torch.bool)
    for name, mask in regions.items():
        material = part_material(name)
        clear |= mask.cpu() if material is not None and material.alpha == "BLEND" else torch.zeros_like(clear)
    normals = vertex_normals(vertices, faces)
    caster = RayCaster(vertices, faces[~clear[faces].all(1)])
    seen = []
    for image, camera in zip(images, cameras, strict=True):  # photographs
        shown = shown_in(image.cpu(), camera, caster, vertices, normals)
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
