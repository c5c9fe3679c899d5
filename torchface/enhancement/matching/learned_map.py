"""Linear map, region by region, of the detail that frames beyond the database have."""

import torch
from torch import Tensor

from torchface.enhancement.matching.region_projection import Matched, RegionProjection

_COMPONENTS = 60
_RIDGE = 1e-4  # of the mean variance of a component
_TURNS, _TRIED = 4, 400  # parts of the sequences; frames at most


class LearnedMap:
    r"""Detail for frames that no convex combination of the database meets.

    .. math:: c = w^\top C + \beta\, (z - w^\top Z)\, L

    The projection's blend of the database's coefficients C, and what a linear map L makes of the part of the features z
    that the blend of the database's, :math:`w^\top Z`, does not hold. L is learned on the database by ridge regression
    on principal components. In the database's convex hull nothing is added. From a distance :math:`\delta` on it is
    multiplied by :math:`(\delta / d)^2` of the frame's distance d, and so fades: far away the nearest detail alone is
    left. How much of it counts, :math:`\beta`, see :func:`map_shares`.
    """

    def __init__(self, projection: RegionProjection, coefficients: Tensor) -> None:
        self._projection = projection
        # The projection's coordinates are principal components about the mean, the largest first.
        self._maps = [_ridge_regression(known[:, :_COMPONENTS], coefficients) for known in projection.known]

    def corrections(self, features: Tensor, matched: Matched, reach: Tensor, shares: Tensor) -> Tensor:
        r"""What to add to the blend's coefficients, (T,R,r), by each region's :math:`\delta` (R,) and :math:`\beta`
        (R,)."""
        beyond = self._projection.residuals(features, matched.weights)
        share = shares.to(features) * _faded(reach.to(features), matched.distances.to(features))
        pairs = zip(beyond, self._maps, strict=True)
        added = [(rows[:, : len(learned)] @ learned).to(features) for rows, learned in pairs]
        return torch.stack(added, dim=1) * share[..., None]


def map_shares(
    projection: RegionProjection, coefficients: Tensor, reach: Tensor, products: Tensor, sequences: Tensor
) -> Tensor:
    r"""How much of a learned map helps with sequences that a database does not hold, by region, (R,) in [0,1].

    A quarter of the sequences is left out in turn, so that the map and the blend are of the others alone:
    :math:`\beta` is what least squares over all these frames say, in displacements of the region's vertices. Where the
    animation lacks much motion that goes on linearly it is near 1; of wrinkles alone, which saturate, it is less.

    Args:
        products: of the details' components with each other over each region, (R,r,r).
        sequences: the number of each frame's sequence, (K,) int64.
    """
    shares = torch.ones(len(products), dtype=torch.float64)
    numbers = sequences.unique()
    turns = min(_TURNS, len(numbers))
    if turns < 2:
        return shares
    # Neighbouring sequences are often of one take, and alike.
    turn = (torch.arange(len(numbers)) * turns // len(numbers))[torch.searchsorted(numbers, sequences)]
    coefficients, products = coefficients.double(), products.double()
    chosen = torch.linspace(0, len(turn) - 1, min(_TRIED, len(turn))).long()
    matched = projection.project_without(chosen, turn[chosen][:, None] == turn)
    lacks = coefficients[chosen][:, None] - matched.weights @ coefficients
    added = torch.zeros_like(lacks)
    faded = _faded(reach.double(), matched.distances)
    for region, known in enumerate(projection.known):
        beyond = (known[chosen] - matched.weights[:, region] @ known)[:, :_COMPONENTS]
        for left_out in range(turns):
            others, own = turn != left_out, turn[chosen] == left_out
            learned = _ridge_regression(known[others, :_COMPONENTS], coefficients[others])
            added[own, region] = (beyond[own] @ learned) * faded[own, region, None]
    helps = torch.einsum("tri,rij,trj->r", added, products, lacks)
    whole = torch.einsum("tri,rij,trj->r", added, products, added)
    return torch.where(whole > 0, helps / whole.clamp(min=1e-30), 1.0).clamp(0, 1)


def _faded(reach: Tensor, distances: Tensor) -> Tensor:
    """What is left of a correction at distances (T,R)."""
    return (reach / distances).clamp(max=1).square()


def _ridge_regression(scores: Tensor, target: Tensor) -> Tensor:
    """The map (q,r) from scores (K,q) to targets (K,r), both less their means."""
    scores, target = scores - scores.mean(0), target.double() - target.double().mean(0)
    gram = scores.T @ scores
    weight = max(_RIDGE * float(gram.diagonal().mean()), 1e-30)
    return torch.linalg.solve(gram + weight * torch.eye(len(gram)).to(gram), scores.T @ target)
