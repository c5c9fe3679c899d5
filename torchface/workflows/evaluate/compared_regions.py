"""Regions of a face to compare in."""

from __future__ import annotations

import torch
from torch import Tensor

from torchface.mesh import Annotations, Mesh

_REACH = 0.4
_GROUPS = ("round the jaw", "round the brows", "round the nose", "round the eyes", "round the mouth")
_GROUP_OF_LANDMARK = (*[0] * 17, *[1] * 10, *[2] * 9, *[3] * 12, *[4] * 20)


def compared_regions(mesh: Mesh) -> dict[str, Tensor]:
    """Regions (V,) of a mesh to compare in: those it is annotated with, and those round its landmarks.

    With 68 landmarks, the face's vertices are given to the brows, eyes, nose, mouth or jaw by the nearest landmark,
    where that is nearer than two fifths of the distance between the outer corners of the eyes.
    """
    notes = mesh.annotations or Annotations()
    regions = {name: mask.clone() for name, mask in notes.regions.items()}
    if notes.landmarks is None or len(notes.landmarks) != len(_GROUP_OF_LANDMARK):
        return regions
    points = mesh.vertices[notes.landmarks].double()
    nearest = torch.cdist(mesh.vertices.double(), points).min(1)
    reach = _REACH * float((points[36] - points[45]).norm())
    inside = (nearest.values <= reach) & notes.regions.get("face", torch.ones_like(nearest.indices, dtype=torch.bool))
    group = torch.tensor(_GROUP_OF_LANDMARK)[nearest.indices]
    for number, name in enumerate(_GROUPS):
        regions.setdefault(name, inside & (group == number))
    return regions
