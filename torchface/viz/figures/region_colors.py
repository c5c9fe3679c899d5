"""Colours for a mesh that brings none, by the names of its regions."""

from dataclasses import replace

import torch
from torch import Tensor

from torchface.io.gltf.part_textures.head_primitives import parts_without_texels
from torchface.io.gltf.region_materials import EYEBALL, IRIS, part_material
from torchface.mesh import Mesh
from torchface.rendering.clay_shading import CLAY

_BEYOND = 7.5
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
    """A mesh whose parts without an image of their own have the colours of their regions; others as they are.

    That is all of it where the mesh has neither texture nor colours, and beside a texture the eyes, teeth and gums that
    have no texels of their own in it: what colours a scan or a photograph gave them are those of the skin before them.
    Clear shells and lashes among them, which hide the eyes, are left out.
    """
    if not _regions(mesh) or (mesh.texture is None and mesh.colors is not None):
        return mesh
    if mesh.texture is None or mesh.uvs is None or mesh.uv_faces is None:
        faces = mesh.faces[drawn_triangles(mesh).to(mesh.faces.device)]
        return replace(mesh, faces=faces, polygons=None, uvs=None, uv_faces=None, colors=region_colors(mesh))
    bare = parts_without_texels(mesh)
    if not bool(bare.any()):
        return mesh
    skin = torch.tensor(CLAY).expand(len(mesh.vertices), 3) if mesh.colors is None else mesh.colors.cpu()
    inside = torch.zeros(len(mesh.vertices), dtype=torch.bool)
    inside[mesh.faces[bare].flatten().cpu()] = True
    # A place beyond the texture has the vertices' colours.
    uvs = torch.cat([mesh.uvs.cpu(), mesh.uvs.new_full((1, 2), _BEYOND).cpu()])
    uv_faces = torch.where(bare[:, None], len(uvs) - 1, mesh.uv_faces.cpu())
    keep = drawn_triangles(mesh) | ~bare
    colors = torch.where(inside[:, None], region_colors(mesh), skin)
    return replace(mesh, faces=mesh.faces.cpu()[keep], uvs=uvs, uv_faces=uv_faces[keep], polygons=None, colors=colors)


def drawn_triangles(mesh: Mesh) -> Tensor:
    """Which triangles are drawn, (F,) bool: all but those of clear shells over the eye and of lashes."""
    drawn = torch.ones(len(mesh.faces), dtype=torch.bool)
    for name, mask in _regions(mesh).items():
        material = part_material(name)
        if material is not None and material.alpha == "BLEND":
            drawn &= ~mask[mesh.faces].all(1).cpu()
    return drawn


def _regions(mesh: Mesh) -> dict[str, Tensor]:
    return {} if mesh.annotations is None else mesh.annotations.regions
