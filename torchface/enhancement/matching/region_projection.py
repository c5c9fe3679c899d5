"""The projection of frames onto a database, region by region: convex combinations of its frames that look alike."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import ShapeError
from torchface.number_checks import checked_number
from torchface.optim.eigenpairs import largest_eigenpairs
from torchface.optim.simplex_qp import SimplexQP

RIDGE = 1e-4  # of the mean squared norm of the database's features

_HELD_OUT = 200  # frames at most that limits are estimated from
_QUANTILE, _MARGIN = 0.95, 2.0
_LEAST_LIMIT, _MOST_LIMIT = 0.1, 0.75  # of the database's spread
_STILL = 1e-4  # of the spread of the region that moves most: one with less does not move
_FAINT = 1e-3  # of a region's largest weight of a patch: fainter patches are left out
_LOST = 1e-8  # of the features' energy, in coordinates of fewer dimensions
# Two gradients are as far apart as the sum of squares of all nine entries says: a rotation by an angle moves two
# entries by it, and shear stands in two entries.
_UNITS = (2**0.5, 2**0.5, 2**0.5, 1.0, 2**0.5, 2**0.5, 1.0, 2**0.5, 1.0)


@dataclass(frozen=True, eq=False)
class Matched:
    """What a projection finds."""

    weights: Tensor  # of the database's frames in each region, (T,R,K), non-negative, of sum 1
    distances: Tensor  # from the combinations, (T,R), in units of the database's spread about its mean
    # How much further from the mean frames go than all of the database's in the same direction, (T,R), in the same
    # units; negative inside, 0 in a region that does not move. None where nobody asked.
    excess: Tensor | None = None


@dataclass(frozen=True, eq=False)
class _Space:
    """One region's features in few coordinates, which keep their distances."""

    patches: Tensor  # that count in it, (p,)
    roots: Tensor  # of their weights times the features' units, (p,9)
    mean: Tensor  # of the database, weighted, (9p,)
    axes: Tensor  # orthonormal, (9p,q)
    known: Tensor  # the database's coordinates, (K,q)

    def centred(self, features: Tensor) -> Tensor:
        """Weighted features (T,9p) about the database's mean, of features (T,P,9)."""
        return (features[:, self.patches] * self.roots.to(features)).flatten(1) - self.mean.to(features)


class RegionProjection:
    r"""Features onto the convex hull of a database's, with an exact quadratic program a region and frame.

    .. math:: \min_{w \ge 0,\; \mathbf 1^\top w = 1} \tfrac12 \sum_p \omega_{rp} \lVert (\tilde D w - \tilde a)_p
        \rVert^2 + \tfrac{\epsilon}{2} \lVert w \rVert^2 + \tfrac{\tau}{2} \lVert w - w^- \rVert^2

    The second term shares the weight among neighbouring frames that look alike, whose matrix is singular; the third
    holds on to the frame before, :math:`w^-`, where several combinations look alike. The regions' features are turned
    into the few coordinates that the database spans, in which all distances are the same.

    Args:
        features: :math:`\tilde D`, (K,P,9), see :func:`~torchface.enhancement.detail.polar_parts.encode_gradients`.
        patch_weights: :math:`\omega`, (R,P), non-negative.
        ridge: :math:`\epsilon`, as a share of the database's mean squared distance from its mean.
        temporal: :math:`\tau`, likewise; frames are then solved one after the other.

    Source: Facial Performance Enhancement Using Dynamic Shape Space Analysis, equations 2 and 3; the last two terms
    are not in it.
    """

    def __init__(self, features: Tensor, patch_weights: Tensor, ridge: float = RIDGE, temporal: float = 0.0) -> None:
        if features.ndim != 3 or features.shape[2] != len(_UNITS) or patch_weights.shape[1:] != features.shape[1:2]:
            raise ShapeError(
                f"projection: found features {tuple(features.shape)} and patch weights {tuple(patch_weights.shape)}, "
                "expected (K,P,9) and (R,P)"
            )
        self.temporal = checked_number("temporal", temporal, 0.0)
        self.patch_count, self.frame_count = features.shape[1], features.shape[0]
        self._spaces = [_space(features, weights) for weights in patch_weights]
        energy = torch.stack([space.known.square().sum(1).mean() for space in self._spaces]).clamp(min=1e-24)
        self.spread = energy.sqrt()
        identity = torch.eye(len(features), dtype=torch.float64, device=features.device)
        ridges = checked_number("ridge", ridge, 0.0) * energy[:, None, None] * identity
        H = torch.stack([space.known @ space.known.T for space in self._spaces]) + ridges
        self._alone = SimplexQP(H)
        self._pull = self.temporal * energy[:, None]
        self._held = SimplexQP(H + self._pull[..., None] * identity) if self.temporal > 0 else None

    def project(self, features: Tensor, previous: Tensor | None = None) -> Matched:
        """The combinations of the database that look most like frames (T,P,9), after the weights (R,K) of the one
        before."""
        if features.ndim != 3 or features.shape[1:] != (self.patch_count, len(_UNITS)):
            raise ShapeError(f"features: found {tuple(features.shape)}, expected (T,{self.patch_count},9)")
        centred = [space.centred(features) for space in self._spaces]
        inside = [(rows @ space.axes.to(rows)).double() for rows, space in zip(centred, self._spaces, strict=True)]
        linear = torch.stack([-rows @ space.known.T for rows, space in zip(inside, self._spaces, strict=True)])
        solved = self._alone(linear) if self._held is None else self._damped(self._held, linear, previous)
        pairs = zip(centred, inside, strict=True)
        beyond = [whole.double().square().sum(1) - rows.square().sum(1) for whole, rows in pairs]
        distances = self._distances(solved, inside, beyond)
        return Matched(solved.transpose(0, 1).to(features), distances.to(features), self._excess(inside).to(features))

    def limits(self, sequences: Tensor) -> Tensor:
        """From what distance on a frame is unlike the database, (R,), in units of the database's spread.

        Twice the distance within which 95 % of the database's frames lie from all its sequences but their own, between
        0.1 and 0.75: sequences that show an expression each say little of one another.
        """
        if len(sequences.unique()) < 2:
            return torch.full((len(self._spaces),), _MOST_LIMIT, dtype=torch.float64)
        chosen = torch.linspace(0, self.frame_count - 1, min(_HELD_OUT, self.frame_count)).long()
        distances = self.project_without(chosen, sequences[chosen][:, None] == sequences).distances
        return (_MARGIN * distances.quantile(_QUANTILE, dim=0)).clamp(_LEAST_LIMIT, _MOST_LIMIT)

    def project_without(self, chosen: Tensor, left_out: Tensor) -> Matched:
        """The combinations that look most like some (T,) of the database's own frames, without others (T,K) of them."""
        rows = [space.known[chosen] for space in self._spaces]
        linear = torch.stack([-own @ space.known.T for own, space in zip(rows, self._spaces, strict=True)])
        # Frames that are left out cost more than any others could: one matrix serves for all.
        most = torch.stack([space.known.square().sum(1).amax() for space in self._spaces])
        weights = self._alone(linear + 20 * most[:, None, None] * left_out)
        distances = self._distances(weights, rows, [torch.zeros(len(chosen), dtype=torch.float64)] * len(rows))
        return Matched(weights.transpose(0, 1), distances)

    def _distances(self, weights: Tensor, inside: list[Tensor], beyond: list[Tensor]) -> Tensor:
        """Of points from combinations (R,T,K), (T,R): points by their coordinates, and squared distance off these."""
        parts = zip(self._spaces, weights, inside, beyond, self.spread, strict=True)
        left = [
            ((own @ space.known - rows).square().sum(1) + off).clamp(min=1e-30).sqrt() / spread
            for space, own, rows, off, spread in parts
        ]
        return torch.stack(left, dim=1)

    def _excess(self, inside: list[Tensor]) -> Tensor:
        """See :class:`Matched`, of points by their coordinates, (T,q) each."""
        parts = zip(inside, self._spaces, self.spread, strict=True)
        further = []
        for rows, space, spread in parts:
            size = rows.norm(dim=1)
            support = (rows / size.clamp(min=1e-12)[:, None] @ space.known.T).amax(1)
            moves = spread > _STILL * self.spread.max()
            further.append(torch.where(moves, (size - support) / spread, 0.0))
        return torch.stack(further, dim=1)

    @property
    def known(self) -> list[Tensor]:
        """The database in each region's coordinates, (K,q) each."""
        return [space.known for space in self._spaces]

    def residuals(self, features: Tensor, weights: Tensor) -> list[Tensor]:
        """What combinations (T,R,K) leave of features (T,P,9) in each region's coordinates, (T,q) each."""
        pairs = zip(self._spaces, weights.double().unbind(1), strict=True)
        return [
            (space.centred(features) @ space.axes.to(features)).double() - own @ space.known for space, own in pairs
        ]

    def _damped(self, solve: SimplexQP, linear: Tensor, previous: Tensor | None) -> Tensor:
        """Weights (R,T,K), each frame from where the one before ends."""
        before = None if previous is None else previous.double()
        blocks = []
        for f in linear.unbind(1):
            before = self._alone(f) if before is None else solve(f - self._pull.to(f) * before, start=before)
            blocks.append(before)
        return torch.stack(blocks, dim=1) if blocks else linear.new_zeros(linear.shape)


def _space(features: Tensor, weights: Tensor) -> _Space:
    patches = (weights > _FAINT * weights.max()).nonzero()[:, 0]
    roots = weights[patches].sqrt()[:, None].to(features) * features.new_tensor(_UNITS)
    rows = (features[:, patches] * roots).flatten(1)
    mean = rows.mean(0)
    rows = rows - mean
    values, vectors = largest_eigenpairs(rows @ rows.T)
    values = values.clamp(min=0)
    left = values.sum() - values.cumsum(0)
    count = max(1, int((left > _LOST * values.sum()).sum()) + 1) if float(values.sum()) > 0 else 1
    vectors = vectors[:, :count].to(rows)
    # Orthonormal again: rounding in the small values would otherwise bend distances.
    axes = torch.linalg.qr(rows.T @ vectors)[0]
    return _Space(patches, roots, mean, axes, (rows @ axes).double())
