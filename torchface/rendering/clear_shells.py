"""Shells over eyes that a viewer blends with what lies behind them; drawn as opaque, they would hide the eyes."""

from dataclasses import replace

import torch
from torch import Tensor

from torchface.mesh import Mesh

CLEAR = ("lacrimal", "eye_blend", "eye_occlusion", "eyelash")  # how names of their regions begin


def triangles_of(mesh: Mesh, prefixes: tuple[str, ...]) -> Tensor:
    """The triangles (F,) bool, on the CPU, whose corners all are of regions with names that begin so."""
    inside = torch.zeros(len(mesh.vertices), dtype=torch.bool)
    for name, mask in ({} if mesh.annotations is None else mesh.annotations.regions).items():
        if name.startswith(prefixes):
            inside |= mask.cpu()
    return inside[mesh.faces.cpu()].all(1)


def without_clear_shells(mesh: Mesh) -> Mesh:
    """A mesh without those triangles; the same where it has none."""
    kept = ~triangles_of(mesh, CLEAR).to(mesh.faces.device)
    if bool(kept.all()):
        return mesh
    uv_faces = None if mesh.uv_faces is None else mesh.uv_faces[kept]
    return replace(mesh, faces=mesh.faces[kept], uv_faces=uv_faces, polygons=None)
