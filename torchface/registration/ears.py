"""Where a template's ears are: thin folded sheets beside and behind the ends of the jaw."""

from __future__ import annotations

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.geometry.meshes.operators import components, vertex_normals
from torchface.mesh import Mesh
from torchface.rendering.raycast import RayCaster

_JAW_ENDS = (0, 16)
_REACH, _ASIDE, _BEFORE = 0.5, 0.12, 0.05
_THIN = 0.1
_LIFT = 0.05
_MARGIN = 0.08
_MIN_COUNT = 20


def find_ears(template: Mesh) -> list[Tensor]:
    """Masks (V,) of the ears, one each; none without 68 landmarks, or where the template has no ears.

    A vertex belongs to one where a ray into the sheet leaves it after a few millimetres; lengths go by the distance
    between the jaw's ends, about 150 mm on an adult.

    Args:
        template: upright, looking along z.
    """
    notes = template.annotations
    if notes is None or notes.landmarks is None or len(notes.landmarks) != 68:
        return []
    vertices, faces = template.vertices.detach().cpu().double(), template.faces.cpu()
    landmarks = vertices[notes.landmarks.cpu()]
    width = float((landmarks[_JAW_ENDS[0]] - landmarks[_JAW_ENDS[1]]).norm())
    middle = landmarks[list(_JAW_ENDS)].mean(0)
    normals = vertex_normals(vertices, faces)
    caster = RayCaster(vertices, faces)
    part = components(faces, len(vertices))
    largest = part == part.bincount().argmax()
    ears = []
    for end in _JAW_ENDS:  # the two sides
        at = landmarks[end]
        outward = torch.sign(at[0] - middle[0])
        near = (vertices - at).norm(dim=-1) < _REACH * width
        near &= (vertices[:, 0] - at[0]) * outward > -_ASIDE * width
        near &= vertices[:, 2] - at[2] < _BEFORE * width
        near &= largest
        ids = near.nonzero()[:, 0]
        hits = caster.cast(vertices[ids] - _LIFT * normals[ids], -normals[ids])
        thin = torch.zeros_like(near)
        thin[ids] = hits.distance < _THIN * width
        sheet = _largest(thin, faces)
        ear = torch.zeros_like(near)
        if sheet.any():
            gap, _ = cKDTree(vertices[sheet].numpy()).query(vertices[ids].numpy())
            ear[ids] = torch.from_numpy(gap) < _MARGIN * width
        if int(ear.sum()) >= _MIN_COUNT:
            ears.append(ear)
    return ears


def _largest(mask: Tensor, faces: Tensor) -> Tensor:
    """The largest connected piece of a mask (V,)."""
    inside = faces[mask[faces].all(-1)]
    if not len(inside):
        return torch.zeros_like(mask)
    label = components(inside, len(mask))
    kept = torch.zeros_like(mask)
    kept[inside.flatten()] = True
    count = label[kept].bincount()
    return kept & (label == count.argmax())
