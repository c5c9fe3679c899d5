"""A shape prior of Student's distributions with its products prepared, for solvers that are exported."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torchface.capture.energy import Quadratic
from torchface.capture.priors.shape_prior import ShapePrior
from torchface.capture.priors.student_t import StudentDensity
from torchface.errors import ValueRangeError


class StudentGroups(nn.Module):
    """The energy of a prior of G groups of N shapes.

    Args:
        prior: ``ShapePrior`` as ``ShapePrior.fit`` learns it.
        strength: in place of the prior's own.

    Raises:
        ValueRangeError: the prior is none of Student's distributions.
    """

    precisions: Tensor
    freedoms: Tensor
    sizes: Tensor

    def __init__(self, prior: ShapePrior, strength: float | None = None) -> None:
        super().__init__()
        self.strength = prior.strength if strength is None else strength
        count, shapes = len(prior.groups), len(prior.names)
        precisions, freedoms = torch.zeros(count, shapes, shapes).double(), torch.zeros(count).double()
        for i, (group, density) in enumerate(zip(prior.groups, prior.densities, strict=True)):
            if type(prior) is not ShapePrior or not isinstance(density, StudentDensity):
                raise ValueRangeError(
                    f"shape prior: found a {type(prior).__name__} of {type(density).__name__}, expected one of "
                    "Student's distributions, as ShapePrior.fit learns"
                )
            rows, factor = torch.tensor(group), density.factor.double().cpu()
            precisions[i, rows[:, None], rows] = factor @ factor.T
            freedoms[i] = density.degrees_of_freedom
        sizes = torch.tensor([float(len(group)) for group in prior.groups]).double()
        for name, value in {"precisions": precisions, "freedoms": freedoms, "sizes": sizes}.items():
            self.register_buffer(name, value.to(next(prior.buffers()).device))

    def energy(self, weights: Tensor) -> Quadratic:
        """As of ``ShapePrior.energy``, at weights (1,N) float64."""
        distance = (self.precisions @ weights[0]) @ weights[0]
        factors = self.strength * (self.freedoms + self.sizes) / (self.freedoms + distance)
        return Quadratic((factors[:, None, None] * self.precisions).sum(0)[None], torch.zeros_like(weights))
