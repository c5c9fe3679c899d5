"""The face as one region: patches by place, and a projection onto the convex combinations of a database's frames."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.optim.simplex_qp import simplex_qp


@dataclass(frozen=True, eq=False)
class Regions:
    """One region of all triangles: names, weights (1,F), voluntary (1,)."""

    names: tuple[str, ...]
    weights: Tensor
    voluntary: Tensor

    def patch_weights(self, patches: Tensor, areas: Tensor) -> Tensor:
        """Shares of the patches by area, (1,P)."""
        total = areas.new_zeros(int(patches.max()) + 1).index_add(0, patches, areas)
        return (total / total.sum())[None].float()

    def vertex_weights(self, faces: Tensor, vertex_count: int) -> Tensor:
        """Ones, (1,V)."""
        return self.weights.new_ones(1, vertex_count)


def grow_patches(faces: Tensor, neutral: Tensor, size: int = 100) -> Tensor:
    """Patches (F,) by cells of space that hold about ``size`` vertices."""
    spread = neutral.amax(0) - neutral.amin(0)
    edge = float(spread.prod()) ** (1 / 3) * (size / len(neutral)) ** 0.5
    cells = (neutral[faces].mean(1) / max(edge, 1e-6)).floor().long()
    return cells.unique(dim=0, return_inverse=True)[1]


@dataclass(frozen=True, eq=False)
class Matched:
    """Weights (T,R,K), and distances (T,R) in units of the database's spread."""

    weights: Tensor
    distances: Tensor


class RegionProjection:
    """Features (T,P,9) onto convex combinations of features (K,P,9), weighted by patch, (R,P)."""

    def __init__(self, features: Tensor, patch_weights: Tensor, ridge: float = 1e-4) -> None:
        self._roots = patch_weights.sqrt()[:, None, :, None]
        self._known = (features * self._roots).flatten(2).double()
        self._gram = self._known @ self._known.transpose(1, 2)
        diagonal = self._gram.diagonal(dim1=1, dim2=2)
        self._gram = self._gram + torch.diag_embed(ridge * diagonal.mean(1, keepdim=True).expand_as(diagonal))
        self._spread = (self._known - self._known.mean(1, keepdim=True)).square().sum(2).mean(1).sqrt()

    def project(self, features: Tensor, previous: Tensor | None = None) -> Matched:
        """The weights of the nearest combinations."""
        asked = (features * self._roots.to(features)).flatten(2).double()
        weights = [
            simplex_qp(H, -(own @ known.T)) for H, own, known in zip(self._gram, asked, self._known, strict=True)
        ]
        stacked = torch.stack(weights)
        distances = (stacked @ self._known - asked).square().sum(2).clamp(min=1e-30).sqrt() / self._spread[:, None]
        return Matched(stacked.transpose(0, 1).to(features), distances.T.to(features))
