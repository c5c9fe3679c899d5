"""How the separate parts of a head hang together: lashes on lids, teeth in gums, gums behind the face."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.geometry.meshes.operators import components
from torchface.mesh import Mesh


@dataclass(frozen=True, eq=False)
class PartLinks:
    """Ties between a mesh's connected parts.

    Args:
        pairs: a vertex of a part and one that it may hang on, (K,2) int64.
        part: the connected part of every vertex, (V,) int64.
    """

    pairs: Tensor
    part: Tensor

    def strength(self, deltas: Tensor, tolerance: float) -> Tensor:
        r"""How firmly each tie holds in a shape, (K,), from 1 (the offset is kept) toward 0 (it changes).

        .. math:: 1 / (1 + \lVert \delta_a - \delta_b \rVert^2 / \tau^2)

        It never gets to 0: a part that follows nothing exactly still follows what it follows best.

        Args:
            deltas: the shape's deltas, (V,3), millimetres.
            tolerance: :math:`\tau`, millimetres.
        """
        change = deltas[self.pairs[:, 0]] - deltas[self.pairs[:, 1]]
        return 1 / (1 + change.square().sum(-1) / tolerance**2)


def part_links(mesh: Mesh) -> PartLinks:
    """Ties every vertex outside the largest part to its nearest vertex there, and to its nearest in any other part."""
    part = components(mesh.faces.cpu(), len(mesh.vertices))
    labels, points = part.numpy(), mesh.vertices.detach().double().cpu().numpy()
    sizes = np.bincount(labels)
    if len(sizes) == 1:
        return PartLinks(torch.zeros(0, 2, dtype=torch.int64), part)
    body = np.flatnonzero(labels == sizes.argmax())
    rest = np.flatnonzero(labels != sizes.argmax())
    pairs = [np.stack([rest, body[cKDTree(points[body]).query(points[rest])[1]]], axis=1)]
    for label in np.unique(labels[rest]):  # a head has tens of parts, each with a tree of its own to leave out
        own, others = np.flatnonzero(labels == label), rest[labels[rest] != label]
        if len(others) == 0:
            continue
        distance, nearest = cKDTree(points[others]).query(points[own])
        pairs.append(np.stack([own, others[nearest]], axis=1)[np.isfinite(distance)])
    return PartLinks(torch.from_numpy(np.concatenate(pairs)), part)
