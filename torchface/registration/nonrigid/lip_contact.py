"""Lips that touch in the template touch on the scan too, unless the scan shows a gap between them."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.geometry.meshes.contact import ContactFinder
from torchface.geometry.meshes.operators import vertex_normals
from torchface.geometry.meshes.surface_index import SurfaceIndex
from torchface.mesh import Mesh
from torchface.rendering.raycast import RayCaster

_REACH = 1.5
_BEHIND = 0.2
_RELEASE = 0.7
_OUT = 20.0
_SHALLOW, _DEEPER = 1.0, 0.8
_CLOSED = 1.0


@dataclass(frozen=True, eq=False)
class ContactPull:
    """Pairs of template vertices that touch, and how they lie to each other."""

    pairs: Tensor  # (K,2) int64
    offsets: Tensor  # from the first to the second with the template aligned with the scan, (K,3) float64

    def weights(self, current: Tensor, scan: SurfaceIndex, caster: RayCaster) -> Tensor:
        r"""How firmly each pair is to keep together, (K,) in [0,1].

        :math:`(1 + g^2/c^2)^{-2}` (Geman and McClure) with g by how much further apart the two are than at rest and
        c = 0.7 mm: what the scan's surface and landmarks have parted stays apart. And 0 where the scan is open
        between the places that the two are nearest to: where these are more than 1 mm apart and a ray from before
        their middle into the head finds no surface, or one deeper than a crease between closed lips would be.
        """
        ends = [scan.among_nearest_samples(current[self.pairs[:, k]]) for k in (0, 1)]
        first, second = (end.points for end in ends)
        outward = torch.nn.functional.normalize(scan.normals_at(ends[0]) + scan.normals_at(ends[1]), dim=-1)
        apart = (second - first).norm(dim=-1)
        hits = caster.cast((first + second) / 2 + _OUT * outward, -outward)
        depth = torch.where(hits.triangle >= 0, hits.distance.double() - _OUT, torch.inf)
        open_there = (apart > _CLOSED) & (depth > _SHALLOW + _DEEPER * apart)
        grown = (current[self.pairs[:, 1]] - current[self.pairs[:, 0]]).norm(dim=-1) - self.offsets.norm(dim=-1)
        kept = (1 + (grown.clamp(min=0) / _RELEASE).square()).pow(-2)
        return kept.masked_fill(open_there, 0.0)


def contact_pull(aligned: Tensor, template: Mesh) -> ContactPull:
    """The pairs of a template that touch at rest: its annotated contacts, else vertices that face each other."""
    notes = template.annotations
    named = None if notes is None else notes.contacts
    vertices, faces = template.vertices.detach().cpu().double(), template.faces.cpu()
    pairs = ContactFinder(faces, len(vertices), named).find(vertices, _REACH).pairs
    if named is None or not len(named):
        # Both sides of a thin sheet, such as an ear, oppose each other as well, but look away from each other.
        normals, way = vertex_normals(vertices, faces), vertices[pairs[:, 1]] - vertices[pairs[:, 0]]
        facing = (way * normals[pairs[:, 0]]).sum(-1) > -_BEHIND
        facing &= (way * normals[pairs[:, 1]]).sum(-1) < _BEHIND
        pairs = pairs[facing]
    return ContactPull(pairs, aligned[pairs[:, 1]] - aligned[pairs[:, 0]])
