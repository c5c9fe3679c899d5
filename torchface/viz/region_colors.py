"""Colours for a mesh that brings none, by the names of its regions."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchface.io.region_materials import EYEBALL, IRIS, part_material
from torchface.mesh import Mesh
from torchface.rendering.shading import CLAY

_PUPIL = (0.05, 0.04, 0.04)
# An iris 11 mm wide and a pupil of 4 mm on an eyeball of 25 mm.
_IRIS_COSINE, _PUPIL_COSINE = 0.9, 0.988


def region_colors(mesh: Mesh) -> Tensor:
    """Vertex colours (V,3) of a mesh that has none; eyes look ahead with iris and pupil, so that a glance shows."""
    colors = torch.tensor(CLAY).repeat(len(mesh.vertices), 1)
    for name, mask in _regions(mesh).items():
        material = part_material(name)
        if material is None or material.alpha == "BLEND":
            continue
        colors[mask] = torch.tensor(material.color)
        if material is EYEBALL and bool(mask.any()):
            ball = mesh.vertices[mask].cpu()
            ahead = torch.nn.functional.normalize(ball - (ball.amin(0) + ball.amax(0)) / 2, dim=1)[:, 2]
            inside = mask.nonzero()[:, 0]
            colors[inside[ahead > _IRIS_COSINE]] = torch.tensor(IRIS.color)
            colors[inside[ahead > _PUPIL_COSINE]] = torch.tensor(_PUPIL)
    return colors


def as_seen(mesh: Mesh) -> Mesh:
    """A mesh without texture and colours with those of its regions, and without what hides its eyes; others as are."""
    if mesh.texture is not None or mesh.colors is not None or not _regions(mesh):
        return mesh
    faces = mesh.faces[drawn_triangles(mesh).to(mesh.faces.device)]
    return replace(mesh, faces=faces, polygons=None, uvs=None, uv_faces=None, colors=region_colors(mesh))


def drawn_triangles(mesh: Mesh) -> Tensor:
    """Which triangles are drawn, (F,) bool: all but those of clear shells over the eye and of lashes."""
    shown = torch.ones(len(mesh.faces), dtype=torch.bool)
    for name, mask in _regions(mesh).items():
        material = part_material(name)
        if material is not None and material.alpha == "BLEND":
            shown &= ~mask[mesh.faces].all(1).cpu()
    return shown


def _regions(mesh: Mesh) -> dict[str, Tensor]:
    return {} if mesh.annotations is None else mesh.annotations.regions
