"""Points of a face's surface that a landmark network finds beside iBUG's 68: close at lids and lips, wide on cheeks."""

from functools import lru_cache

import torch
from torch import Tensor

from torchface.geometry.meshes.operators import vertex_normals
from torchface.synthetic.head.head_annotations import head_annotations
from torchface.synthetic.head.identity import sculpted_vertices
from torchface.synthetic.head.performer import performer

COUNT = 452
"""With iBUG's 68 together 520."""
_FARTHEST = 11.0  # millimetres between points of a cheek
# Landmarks, and how close points lie there, millimetres; a third of a millimetre more for each one away from them.
_CLOSE = ((slice(36, 48), 3.0), (slice(48, 68), 3.2), (slice(17, 27), 5.0), (slice(30, 36), 5.0))
_WIDENING, _FOLD = 0.35, 6.0
_PARTS = ("ear_left", "ear_right", "neck", "mouth_interior", "nostrils", "eye_sockets", "eyeball_left", "eyeball_right")
_LOWEST, _HIGHEST, _WIDEST, _FRONTAL = -121.0, 62.0, 72.0, 0.17
_MIDDLE = 0.2  # millimetres


@lru_cache(maxsize=1)
def dense_vertices() -> tuple[Tensor, Tensor]:
    """Vertices of the embedded performer that are the points, (P,), and of each its mirrored twin, (P,) into them.

    Points are taken one after the other, each the farthest from all before in distances that they may have there.
    """
    mean, notes = sculpted_vertices(), head_annotations()
    assert notes.landmarks is not None
    assert notes.mirror is not None
    regions, marks = notes.regions, mean[notes.landmarks]
    normals = vertex_normals(mean, performer(texture=False).neutral.faces)
    skin = ~torch.stack([regions[name] for name in _PARTS]).any(0) & (normals[:, 2] > _FRONTAL)
    skin &= (mean[:, 1] > _LOWEST) & (mean[:, 1] < _HIGHEST) & (mean[:, 0].abs() < _WIDEST)
    rows = skin.nonzero()[:, 0]
    points = mean[rows]
    spacing = torch.full((len(points),), _FARTHEST).double()
    places = [(marks[group], least) for group, least in _CLOSE] + [(_nasolabial_folds(), _FOLD)]
    for place, least in places:
        spacing = torch.minimum(spacing, least + _WIDENING * torch.cdist(points, place).amin(1))
    half = points[:, 0] > -_MIDDLE
    points, spacing, own = points[half], spacing[half], rows[half]
    middle = points[:, 0].abs() < _MIDDLE
    nearest = torch.full((len(points),), 1e9).double()
    chosen: list[int] = []
    count, current = 0, int((points - marks[62]).norm(dim=1).argmin())
    while count < COUNT:
        if count + 2 - int(middle[current]) > COUNT:  # one is left
            nearest[~middle] = 0
        else:
            chosen.append(current)
            count += 2 - int(middle[current])
            nearest = torch.minimum(nearest, (points - points[current]).norm(dim=1))
        current = int((nearest / spacing).argmax())
    right = own[torch.tensor(chosen)]
    left = notes.mirror[right]
    vertices: list[int] = []
    mirror: list[int] = []
    for one, other in zip(right.tolist(), left.tolist(), strict=True):
        at = len(vertices)
        vertices += [one] if one == other else [one, other]
        mirror += [at] if one == other else [at + 1, at]
    return torch.tensor(vertices), torch.tensor(mirror)


def dense_places() -> tuple[Tensor, Tensor]:
    """Where the points lie on the performer's sculpture, (P,3) millimetres, and of each its mirrored twin, (P,)."""
    vertices, mirror = dense_vertices()
    return sculpted_vertices()[vertices].float(), mirror


def _nasolabial_folds() -> Tensor:
    """Places along both folds between nose and cheek, (12,3)."""
    along = torch.linspace(0, 1, 6)[:, None].double()
    one = torch.tensor([18.0, -33, 88]) + along * torch.tensor([14.0, -40, -8])
    return torch.cat([one * torch.tensor([-1.0, 1, 1]), one])
