"""Linear equations of blendshape weights from 68 landmarks, a frame each, and their weighted least squares."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from torchface.capture.energy import Quadratic


@dataclass(frozen=True)
class Unknowns:
    """Weights (B,N), and what of the placement was unknown, (B,F); F may be 0."""

    weights: Tensor
    free: Tensor


@dataclass(frozen=True, eq=False)
class LandmarkEquations:
    r"""Residuals of landmarks that are linear in the weights and in what of the placement is unknown.

    .. math:: r_i(w, \delta) = g \circ (o_i + E_i w + \Phi_i \delta)

    They are distances in the picture over that of the eyes, whatever the units of what is inside the brackets.
    """

    neutral: Tensor  # e_0, (68,2), pixels of the examples
    basis: Tensor  # E, (68,2,N)
    offset: Tensor  # o, (B,68,2), finite; what it is where a landmark is not seen does not count
    scale: Tensor  # g, of x and y, (B,2)
    seen: Tensor  # (B,68) bool
    free: Tensor  # \Phi, (B,68,2,F)

    @cached_property
    def share(self) -> Tensor:
        """What each landmark counts in the mean over those that are seen, (B,68)."""
        return self.seen.to(self.offset) / self.seen.sum(1, keepdim=True).clamp(min=1)

    def with_basis(self, basis: Tensor) -> LandmarkEquations:
        """The same of other shapes."""
        return replace(self, basis=basis)

    def of_model(self, mean: Tensor, components: Tensor, eyes: Tensor) -> LandmarkEquations:
        """The same of a mean (68,2) and components (68,2,K) for neutral and shapes, x and y counting alike."""
        offset = self.offset + (mean - self.neutral)
        return replace(self, basis=components, offset=offset, scale=(1 / eyes).expand_as(self.scale))

    def among(self, rows: Tensor) -> LandmarkEquations:
        """The same where some landmarks only (68,) bool count; where a frame shows none of them, none counts."""
        return replace(self, seen=self.seen & rows)

    def moved(self, columns: Tensor, unknowns: Unknowns) -> LandmarkEquations:
        """What is left when weights of some shapes, columns (68,2,M), and the placement are known."""
        moved = self.offset + _along(columns, unknowns.weights)
        if self.free.shape[-1]:
            moved = moved + _along(self.free, unknowns.free)
        return replace(self, offset=moved, free=self.free[..., :0])

    def columns(self) -> Tensor:
        """The derivative of :math:`r` in weights and placement, (B,68,2,N+F)."""
        shared = self.basis.expand(len(self.offset), -1, -1, -1)
        columns = self.scale[:, None, :, None] * torch.cat([shared, self.free], dim=-1)
        return torch.where(self.seen[..., None, None], columns, 0.0)

    def least_squares(self) -> ReducedSquares:
        """The mean of :math:`\\lVert r_i \\rVert^2` over the landmarks seen, the best placement put in for every w."""
        factor = (self.share[..., None] * self.scale[:, None].square()).flatten(1)  # (B,136)
        rows, offset = self.basis.flatten(0, 1), self.offset.flatten(1)
        shapes = rows.shape[1]
        pairs = (rows[:, :, None] * rows[:, None, :]).flatten(1)
        H = 2 * (factor @ pairs).unflatten(1, (shapes, shapes))
        f = 2 * ((factor * offset) @ rows)
        if not self.free.shape[-1]:
            return ReducedSquares(Quadratic(H, f), f[:, :0, None], f[:, :0, None].expand(-1, -1, shapes))
        free = self.free.flatten(1, 2).transpose(1, 2)  # (B,F,136)
        counted = 2 * factor[:, None] * free
        information = counted @ free.transpose(1, 2)
        cross = (counted.flatten(0, 1) @ rows).unflatten(0, counted.shape[:2])  # (B,F,N)
        pull = counted @ offset[..., None]
        # A frame with too few landmarks leaves part of its placement open: that part stays as it was guessed.
        information = information + torch.diag_embed(information.detach().diagonal(dim1=1, dim2=2) * 1e-12 + 1e-30)
        system, count = torch.cat([information, pull, cross], dim=-1), free.shape[1]
        for k in range(count):  # Gauss and Jordan's elimination: ONNX has no factorisation
            row = system[:, k : k + 1] / system[:, k : k + 1, k : k + 1]
            others = system - system[:, :, k : k + 1] * row
            system = torch.cat([others[:, :k], row, others[:, k + 1 :]], dim=1)
        start, slope = -system[..., count : count + 1], -system[..., count + 1 :]
        H = H + cross.transpose(1, 2) @ slope
        return ReducedSquares(
            Quadratic(0.5 * (H + H.transpose(1, 2)), f + (cross.transpose(1, 2) @ start)[..., 0]), start, slope
        )


@dataclass(frozen=True, eq=False)
class ReducedSquares:
    """A sum of squares in which the placement is the best one for the weights."""

    energy: Quadratic  # of the weights alone
    start: Tensor  # the placement at weights of 0, (B,F,1)
    slope: Tensor  # what each weight adds, (B,F,N)

    def unknowns(self, weights: Tensor) -> Unknowns:
        """Weights and their placement."""
        return Unknowns(weights, (self.start + self.slope @ weights[..., None])[..., 0])


def _along(columns: Tensor, values: Tensor) -> Tensor:
    """Columns (68,2,K) or (B,68,2,K) times values (B,K): (B,68,2)."""
    if columns.ndim == 3:
        return (values @ columns.flatten(0, 1).T).unflatten(1, columns.shape[:2])
    return (columns @ values[:, None, :, None])[..., 0]
