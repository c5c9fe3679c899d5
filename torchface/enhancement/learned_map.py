"""What a database's detail changes by where frames lie beyond it: a linear map, region by region."""

from __future__ import annotations

import torch
from torch import Tensor

from torchface.enhancement.projection import Matched, RegionProjection
from torchface.number_checks import checked_count, checked_number

COMPONENTS = 60
RIDGE = 1e-4
"""Of the mean variance of a component."""


class LearnedMap:
    r"""Detail for frames that no convex combination of the database meets.

    .. math:: c = w^\top C + (z - w^\top Z)\, L

    The projection's blend of the database's coefficients C, and what a linear map L makes of the part of the features z
    that the blend of the database's, :math:`w^\top Z`, does not hold. L is learned on the database by ridge regression
    on principal components. In the database's convex hull nothing is added. From a distance :math:`\delta` on it is
    multiplied by :math:`(\delta / d)^2` of the frame's distance d, and so fades: far away the nearest detail alone is
    left.

    Args:
        projection: of the same database.
        coefficients: C, (K,r).
        reach: :math:`\delta` of each region, (R,), in units of the database's spread.
        components: principal components of each region's features.
        ridge: as a share of their mean variance.
    """

    def __init__(
        self,
        projection: RegionProjection,
        coefficients: Tensor,
        reach: Tensor,
        components: int = COMPONENTS,
        ridge: float = RIDGE,
    ) -> None:
        checked_count("components", components, 1)
        checked_number("ridge", ridge, above=True)
        self._projection = projection
        self._reach = reach
        target = coefficients.double() - coefficients.double().mean(0)
        # The projection's coordinates are principal components about the mean, the largest first.
        self._maps = [_ridge_regression(known[:, :components], target, ridge) for known in projection.known]

    def corrections(self, features: Tensor, matched: Matched) -> Tensor:
        """What to add to the blend's coefficients, (T,R,r).

        Args:
            features: (T,P,9); differentiable.
            matched: the projection of the same frames.
        """
        beyond = self._projection.residuals(features, matched.weights)
        share = (self._reach.to(features) / matched.distances.to(features)).clamp(max=1).square()
        pairs = zip(beyond, self._maps, strict=True)
        added = [(rows[:, : len(learned)] @ learned).to(features) for rows, learned in pairs]
        return torch.stack(added, dim=1) * share[..., None]


def _ridge_regression(scores: Tensor, target: Tensor, ridge: float) -> Tensor:
    """The map (q,r) from scores (K,q) to targets (K,r), both about their means."""
    gram = scores.T @ scores
    weight = max(ridge * float(gram.diagonal().mean()), 1e-30)
    return torch.linalg.solve(gram + weight * torch.eye(len(gram)).to(gram), scores.T @ target)
