"""Marker sites that are wrong by a known distance along the skin, as a first guess by eye would be."""

import torch
from torch import Tensor

from torchface import Attachment, BlendshapeRig
from torchface.geometry.meshes.operators import vertex_normals
from torchface.geometry.meshes.surface_index import SurfaceIndex

_STEPS = 12


def misplaced(
    rig: BlendshapeRig, attachment: Attachment, generator: torch.Generator, least: float = 2.0, most: float = 8.0
) -> Attachment:
    """Sites moved along the skin in random directions, each by its own distance; labels kept.

    Args:
        rig: whose neutral carries the sites.
        attachment: the true sites.
        generator: where the randomness comes from.
        least, most: millimetres between a true site and its moved one; the distance is uniform between them.
    """
    faces, vertices = rig.neutral.faces, rig.vertices.double()
    points = attachment.on(faces, vertices)
    normals = torch.nn.functional.normalize(attachment.on(faces, vertex_normals(vertices, faces)), dim=-1)
    wanted = least + (most - least) * torch.rand(len(points), generator=generator).double()
    way = torch.randn(points.shape, generator=generator).double()
    way = torch.nn.functional.normalize(way - (way * normals).sum(-1, keepdim=True) * normals, dim=-1)
    index = SurfaceIndex(vertices, faces)
    step, residual = wanted.clone(), torch.full_like(wanted, torch.inf)
    triangles, barycentric = attachment.triangles.clone(), attachment.barycentric.double()
    for _ in range(_STEPS):  # the skin bends: the step that ends at the wanted distance is found by trying
        found = index.nearest(points + step[:, None] * way)
        reached = (found.points - points).norm(dim=-1)
        better = (reached - wanted).abs() < residual
        residual = torch.where(better, (reached - wanted).abs(), residual)
        triangles = torch.where(better, found.triangle, triangles)
        barycentric = torch.where(better[:, None], found.barycentric, barycentric)
        step = step * (wanted / reached.clamp(min=0.1)).clamp(0.7, 1.5)
    return Attachment(triangles, barycentric.float(), attachment.labels, fingerprint=rig.neutral.fingerprint())


def site_distances(rig: BlendshapeRig, found: Attachment, true: Attachment) -> Tensor:
    """How far sites are from the true ones on the neutral, (M,), millimetres; markers match by label."""
    faces, vertices = rig.neutral.faces, rig.vertices.double()
    here = found.select(true.labels or ()).on(faces, vertices)
    return (here - true.on(faces, vertices)).norm(dim=-1)
