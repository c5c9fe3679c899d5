"""Landmarks and regions of a head, taken over from a template that lies on it."""

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.geometry.similarity import Similarity
from torchface.mesh import Annotations
from torchface.modeling.rigging.eyelid_closure import BLINKS
from torchface.modeling.rigging.joined_vertices import joined_vertices
from torchface.registration import Registration
from torchface.rig import BlendshapeRig

_BESIDE = 4.0  # millimetres at the template's size
_EYEBALL, _MOST = "eyeball", 0.4  # of a part's vertices
_MOUTH, _TEETH = "mouth_interior", "teeth"
_TOOTH, _NEXT_TOOTH = 15.0, 3.0  # millimetres at the template's size: a tooth's width at most, and the gap to the next
_TELLING = ("jawOpen", *BLINKS)  # which of lips and lids that touch a vertex is of, its motion says


def annotations_on(head: BlendshapeRig, template: BlendshapeRig, pose: Similarity) -> Annotations:
    """The head's annotations, with those that it lacks of the template, which ``pose`` takes onto its face."""
    own, given = head.neutral.annotations or Annotations(), template.neutral.annotations or Annotations()
    back = pose.inverse()
    names = [name for name in _TELLING if name in head.names and name in template.names]
    rest = back.apply(head.vertices.detach().cpu().double())[0]
    ours = [rest, *back.apply_vectors(_deltas(head, names))]
    known = template.vertices.detach().cpu().double()
    landmarks, regions = own.landmarks, dict(own.regions)
    joined = joined_vertices(rest, head.neutral.faces.cpu())
    part = joined.part[joined.of]
    skin = int(part.mode().values)
    if (landmarks is None or len(landmarks) != 68) and given.landmarks is not None:
        ids = given.landmarks.cpu()
        skin = int(part[torch.from_numpy(cKDTree(rest.numpy()).query(known[ids].numpy())[1])].mode().values)
        rows = (part == skin).nonzero()[:, 0]
        tree = cKDTree(torch.cat([one[rows] for one in ours], 1).numpy())
        wanted = torch.cat([one[ids] for one in (known, *_deltas(template, names))], 1)
        landmarks = rows[torch.from_numpy(tree.query(wanted.numpy())[1])]
    distance, nearest = cKDTree(known.numpy()).query(rest.numpy())
    close = torch.from_numpy(distance) < _BESIDE
    for name, mask in given.regions.items():
        if name not in regions:
            inside = mask.cpu()[torch.from_numpy(nearest)] & close
            if name.startswith(_EYEBALL):  # an eye of its own is one from front to back
                share = part.bincount(inside.double()) / part.bincount()
                inside = torch.where(part == skin, inside, share[part] > _MOST)
            if name == _MOUTH and not any(_TEETH in known for known in regions):
                teeth = _teeth(rest, part, inside & (part != skin))
                inside &= ~teeth
                regions |= {_TEETH: teeth} if teeth.any() else {}
            regions[name] = inside
    return Annotations(landmarks, regions, own.mirror, own.contacts)


def _teeth(rest: Tensor, part: Tensor, inside: Tensor) -> Tensor:
    """Vertices (V,) of loose parts as narrow as a tooth that lie mostly in the mouth, and of those next to them."""
    count = int(part.max()) + 1
    low, high = (
        rest.new_full((count, 3), size).scatter_reduce(0, part[:, None].expand(-1, 3), rest, way)
        for size, way in ((torch.inf, "amin"), (-torch.inf, "amax"))
    )
    narrow = ((high - low)[:, ::2].amax(1) < _TOOTH)[part]  # across and in depth: some have roots
    found = narrow & ((part.bincount(inside.double(), count) / part.bincount(minlength=count)) > _MOST)[part]
    while found.any():
        others = (narrow & ~found).nonzero()[:, 0]
        gaps = torch.from_numpy(cKDTree(rest[found].numpy()).query(rest[others].numpy())[0])
        near = others[gaps < _NEXT_TOOTH]
        if not len(near):
            break
        found |= torch.isin(part, part[near])
    return found


def on_face(template: BlendshapeRig, registration: Registration) -> BlendshapeRig:
    """A registered template in its own place and size, with its own deltas."""
    vertices = registration.pose.inverse().apply(registration.mesh.vertices.detach().cpu().double())[0]
    fitted = template.neutral.with_vertices(vertices.to(template.vertices))
    return BlendshapeRig(fitted, template.deltas, template.names)


def _deltas(rig: BlendshapeRig, names: list[str]) -> Tensor:
    return rig.deltas[[rig.names.index(name) for name in names]].detach().cpu().double()
