"""Eyelashes on the cards that heads bring for them: hairs that taper from the lid to a tip, clear between them."""

from __future__ import annotations

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.geometry.meshes.operators import components
from torchface.io.gltf.part_colors.painting import Paint, painted
from torchface.io.gltf.region_materials import PartMaterial
from torchface.mesh import Mesh

_SPACING = 1.1  # millimetres between the hairs of one card
# Fractions: of the spacing, the width of a root; of the card, the shortest hair; of the spacing, how far tips lean.
_ROOT, _MIN_LENGTH, _LEAN = 0.34, 0.55, 0.9
_SIDE, _DENSE = 1024, 0.6


def painted_lashes(mesh: Mesh, triangles: Tensor, material: PartMaterial) -> Paint:
    """Hairs for lashes whose cards each begin at a lid.

    Args:
        mesh: the head.
        triangles: rows of its faces that are lashes, (K,).
        material: whose colour they have.
    """
    faces = mesh.faces[triangles]
    ids, local = faces.unique(return_inverse=True)
    card = components(local.reshape(-1, 3), len(ids))
    points = mesh.vertices.detach()[ids].double()
    rest = torch.ones(len(mesh.vertices), dtype=torch.bool)
    rest[ids] = False
    distance = torch.from_numpy(cKDTree(mesh.vertices.detach()[rest].numpy()).query(points.numpy())[0])
    cards = torch.zeros(int(card.max()) + 1, dtype=distance.dtype)
    nearest = cards.scatter_reduce(0, card, distance, "amin", include_self=False)
    longest = cards.scatter_reduce(0, card, distance, "amax", include_self=False) - nearest
    values = torch.zeros(len(mesh.vertices), 3, dtype=torch.float64)
    values[ids, 0] = (distance - nearest[card]) / longest[card].clamp(min=1e-9)
    values[ids, 1] = _along(points, card)
    values[ids, 2] = card.double()
    color = torch.tensor(material.color, dtype=torch.float64)

    def hairs(at: Tensor) -> Tensor:
        return torch.cat([color.expand(len(at), 3), _opacity(at)[:, None]], dim=1)

    paint = painted(mesh, triangles, values, hairs, _SIDE)
    if paint.colors is None:
        return paint
    faded = _DENSE * (1 - values[:, :1])  # vertices are too few for hairs
    return Paint(None, torch.cat([color.expand(len(values), 3), faded], dim=1).float())


def _along(points: Tensor, card: Tensor) -> Tensor:
    """Where on its card each point lies along the lid, millimetres, (K,)."""
    along = torch.zeros(len(points), dtype=points.dtype)
    for number in range(int(card.max()) + 1):  # one card each
        centred = points[card == number]
        centred = centred - centred.mean(0)
        along[card == number] = centred @ torch.linalg.svd(centred, full_matrices=False).Vh[0]
    return along


def _opacity(at: Tensor) -> Tensor:
    """1 on a hair, 0 between, of values (N,3): root to tip, millimetres along the lid, card."""
    tip, along, card = at.unbind(1)
    position = along / _SPACING + _LEAN * (tip * (0.7 + 0.3 * torch.sin(1.7 * along))) + 0.37 * card.round()
    hair = position.floor()
    random = torch.frac(torch.sin(hair * 12.9898 + card.round() * 78.233) * 43758.5453).abs()
    length = _MIN_LENGTH + (1 - _MIN_LENGTH) * random
    width = 0.5 * _ROOT * (1 - tip / length).clamp(0, 1).sqrt()
    offset = (position - hair - 0.5 + 0.2 * (random - 0.5)).abs()
    return ((width - offset) / 0.06 + 0.5).clamp(0, 1) * (tip < length)
