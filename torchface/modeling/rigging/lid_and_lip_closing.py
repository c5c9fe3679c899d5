"""The seams of a rig: lines along which its surface closes, found from its shapes, whatever their names."""

from dataclasses import dataclass

import numpy as np
import torch
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from torchface.geometry.meshes.contact import ContactFinder, ContactPairs
from torchface.geometry.meshes.operators import edges, vertex_normals
from torchface.rig import BlendshapeRig

REST_REACH = 1.5
"""How close vertices of a seam that is closed at rest are, millimetres."""

POSE_REACH = 3.0
"""How close vertices come, in millimetres, where a shape closes a seam; closeness decreases to zero there."""

_CLOSED_SHARE = 0.1
"""A seam is closed at rest when this share of its vertices has a partner at rest: 0.3 for lips, 0.03 for lids."""

_MAX_OVERLAP = 10.0
"""A shape that drives a closed seam further than this through itself, in millimetres, is meant to undo another."""

_CANCELLED = 0.2
"""Two shapes undo each other when the sum moves a seam's sides apart by less than this share, squared."""


@dataclass(frozen=True, eq=False)
class Seams:
    """Pairs of vertices that touch, by when they do."""

    closed: Tensor  # pairs of seams that are closed at rest, such as lips, (K,2) int64
    # one entry a shape: the pairs of other seams, such as lids, that its pose brings together
    closing: list[ContactPairs]
    # for a shape that makes sense only on top of another, because alone it would drive a closed seam far through itself
    # (closing lips over an open jaw), the index of that other shape
    undoes: dict[int, int]


def find_seams(rig: BlendshapeRig, moving: Tensor) -> Seams:
    """The seams of a rig; ``moving`` (N,V) says which vertices each shape moves."""
    neutral = rig.neutral
    vertices, deltas = neutral.vertices.detach().double().cpu(), rig.deltas.detach().double().cpu()
    named = None if neutral.annotations is None else neutral.annotations.contacts
    finder = ContactFinder(neutral.faces, len(vertices), named)
    rest = finder.find(vertices, REST_REACH)
    # Across the corner of an eye the two lids are only a few edges apart.
    posed = [
        finder.find(vertices + delta, POSE_REACH, moved, rings=1)
        for delta, moved in zip(deltas, moving.cpu(), strict=True)
    ]
    is_closed = _closed_at_rest(neutral.faces.cpu(), len(vertices), rest.pairs, [pose.pairs for pose in posed])
    # Lips slide: a vertex is held to every one near it, up to the corners of the mouth.
    rest = finder.find(vertices, REST_REACH, rings=1, nearest=False)
    closed = rest.pairs[is_closed[rest.pairs].all(1)]
    closing = []
    for pose in posed:
        kept = ~is_closed[pose.pairs].any(1)
        closing.append(ContactPairs(pose.pairs[kept], pose.closeness[kept]))
    normals = vertex_normals(vertices, neutral.faces.cpu())
    return Seams(closed, closing, _undone_shapes(deltas, closed, normals))


def _closed_at_rest(faces: Tensor, count: int, rest: Tensor, posed: list[Tensor]) -> Tensor:
    """Mask (V,) of the vertices on seams that are closed at rest; a seam is what pairs and mesh edges join."""
    pairs = torch.cat([rest, *posed])
    touching = torch.zeros(count, dtype=torch.bool)
    touching[pairs.flatten()] = True
    at_rest = torch.zeros(count, dtype=torch.bool)
    at_rest[rest.flatten()] = True
    along = edges(faces)
    joined = torch.cat([along[touching[along].all(1)], pairs]).numpy()
    graph = sparse.coo_array((np.ones(len(joined)), (joined[:, 0], joined[:, 1])), (count, count))
    _, seam = connected_components(graph, directed=False)
    share = np.bincount(seam, at_rest.numpy()) / np.maximum(np.bincount(seam, touching.numpy()), 1)
    return torch.from_numpy((share >= _CLOSED_SHARE)[seam]) & touching


def _undone_shapes(deltas: Tensor, closed: Tensor, normals: Tensor) -> dict[int, int]:
    if len(closed) == 0:
        return {}
    first, second = closed.T
    apart = deltas[:, second] - deltas[:, first]
    across = torch.nn.functional.normalize(normals[first] - normals[second], dim=-1)
    deepest = -(apart * across).sum(-1).amin(1)
    flat = apart.flatten(1)
    gram = flat @ flat.T
    square = gram.diagonal()
    undoes = {}
    for shape in (deepest > _MAX_OVERLAP).nonzero()[:, 0].tolist():
        left = (square + 2 * gram[shape] + square[shape]) / square[shape]
        left[shape] = torch.inf
        other = int(left.argmin())
        if left[other] < _CANCELLED and deepest[other] <= _MAX_OVERLAP:
            undoes[shape] = other
    return undoes
