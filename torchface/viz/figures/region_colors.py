"""Meshes with colours for the parts that bring none, by the names of their regions."""

from dataclasses import replace

import torch

from torchface.io.gltf.part_textures.head_primitives import parts_without_texels
from torchface.mesh import Mesh
from torchface.rendering.part_colors import CLAY, clear_triangles, region_colors, without_clear_shells

_BEYOND = 7.5


def as_seen(mesh: Mesh) -> Mesh:
    """A mesh whose parts without an image of their own have the colours of their regions; others as they are.

    That is all of it where the mesh has neither texture nor colours, and beside a texture the eyes, teeth and gums that
    have no texels of their own in it: what colours a scan or a photograph gave them are those of the skin before them.
    Clear shells and lashes among them, which hide the eyes, are left out.
    """
    if not mesh.regions or (mesh.texture is None and mesh.colors is not None):
        return mesh
    if mesh.texture is None or mesh.uvs is None or mesh.uv_faces is None:
        shown = without_clear_shells(mesh)
        return replace(shown, polygons=None, uvs=None, uv_faces=None, colors=region_colors(mesh))
    bare = parts_without_texels(mesh)
    if not bool(bare.any()):
        return mesh
    skin = torch.tensor(CLAY).expand(len(mesh.vertices), 3) if mesh.colors is None else mesh.colors.cpu()
    inside = torch.zeros(len(mesh.vertices), dtype=torch.bool)
    inside[mesh.faces[bare].flatten().cpu()] = True
    # A place beyond the texture has the vertices' colours.
    uvs = torch.cat([mesh.uvs.cpu(), mesh.uvs.new_full((1, 2), _BEYOND).cpu()])
    uv_faces = torch.where(bare[:, None], len(uvs) - 1, mesh.uv_faces.cpu())
    keep = ~(clear_triangles(mesh) & bare)
    colors = torch.where(inside[:, None], region_colors(mesh), skin)
    return replace(mesh, faces=mesh.faces.cpu()[keep], uvs=uvs, uv_faces=uv_faces[keep], polygons=None, colors=colors)
