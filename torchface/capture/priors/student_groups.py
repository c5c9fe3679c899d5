"""A shape prior of Student's distributions as tensors of one size, for solvers that are exported."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.capture.priors.shape_prior import ShapePrior
from torchface.capture.priors.student_t import StudentDensity
from torchface.errors import ValueRangeError


@dataclass(frozen=True, eq=False)
class StudentGroups:
    """What the energy of a prior of G groups needs.

    Args:
        precisions: inverse scale matrices over all N shapes, zero beyond the group's, (G,N,N).
        freedoms: degrees of freedom, (G,).
        sizes: how many shapes, (G,).
    """

    precisions: Tensor
    freedoms: Tensor
    sizes: Tensor

    @staticmethod
    def of(prior: ShapePrior | None, shapes: int, like: Tensor) -> StudentGroups:
        """Those of a prior, in the dtype of ``like``; no groups without a prior.

        Raises:
            ValueRangeError: the prior is none of Student's distributions.
        """
        parts = [] if prior is None else list(zip(prior.groups, prior.densities, strict=True))
        precisions, freedoms = like.new_zeros(len(parts), shapes, shapes), like.new_zeros(len(parts))
        for i, (group, density) in enumerate(parts):
            if type(prior) is not ShapePrior or not isinstance(density, StudentDensity):
                raise ValueRangeError(
                    f"shape prior: found a {type(prior).__name__} of {type(density).__name__}, expected one of "
                    "Student's distributions, as ShapePrior.fit learns"
                )
            rows, factor = torch.tensor(group), density.factor.to(like)
            precisions[i, rows[:, None], rows] = factor @ factor.T
            freedoms[i] = density.degrees_of_freedom
        return StudentGroups(precisions, freedoms, like.new_tensor([len(group) for group, _ in parts]))

    def bound(self, weights: Tensor) -> Tensor:
        """H (N,N) of the quadratic ``w H w / 2`` that touches the negative log density at weights (N,) from above."""
        distance = (self.precisions @ weights) @ weights
        factors = (self.freedoms + self.sizes) / (self.freedoms + distance)
        return (factors[:, None, None] * self.precisions).sum(0)
