"""The projection of frames onto a database, region by region: convex combinations of its frames that look alike."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import ShapeError
from torchface.number_checks import checked_number
from torchface.optim.simplex_qp import simplex_qp

RIDGE = 1e-4
"""Of the mean squared norm of the database's features."""

_FAINT = 1e-3  # of a region's largest weight of a patch: fainter patches are left out
_LOST = 1e-8  # of the features' energy, in coordinates of fewer dimensions
# Two gradients are as far apart as the sum of squares of all nine entries says: a rotation by an angle moves two
# entries by it, and shear stands in two entries.
_UNITS = (2**0.5, 2**0.5, 2**0.5, 1.0, 2**0.5, 2**0.5, 1.0, 2**0.5, 1.0)


@dataclass(frozen=True, eq=False)
class Matched:
    """What a projection finds.

    Args:
        weights: of the database's frames in each region, (T,R,K), non-negative, of sum 1.
        distances: from the combinations, (T,R), in units of the database's spread about its mean.
    """

    weights: Tensor
    distances: Tensor


@dataclass(frozen=True, eq=False)
class _Space:
    """One region's features in few coordinates, which keep their distances.

    Args:
        patches: that count in it, (p,).
        roots: of their weights times the features' units, (p,9).
        mean: of the database, weighted, (9p,).
        axes: orthonormal, (9p,q).
        known: the database's coordinates, (K,q).
    """

    patches: Tensor
    roots: Tensor
    mean: Tensor
    axes: Tensor
    known: Tensor

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
        features: :math:`\tilde D`, (K,P,9), see :func:`~torchface.enhancement.polar_parts.encode_gradients`.
        patch_weights: :math:`\omega`, (R,P), non-negative.
        ridge: :math:`\epsilon`, as a share of the database's mean squared distance from its mean.
        temporal: :math:`\tau`, likewise; frames are then solved one after the other.

    Raises:
        ShapeError: the shapes do not fit each other.

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
        identity = torch.eye(len(features), dtype=torch.float64)
        self._unit = energy
        ridges = checked_number("ridge", ridge, 0.0) * energy[:, None, None] * identity
        self._H = torch.stack([space.known @ space.known.T for space in self._spaces]) + ridges

    def project(self, features: Tensor, previous: Tensor | None = None) -> Matched:
        """The combinations of the database that look most like frames.

        Args:
            features: of the frames, (T,P,9); differentiable.
            previous: weights of the frame before the first, (R,K).

        Raises:
            ShapeError: the features are of other patches.
        """
        if features.ndim != 3 or features.shape[1:] != (self.patch_count, len(_UNITS)):
            raise ShapeError(f"features: found {tuple(features.shape)}, expected (T,{self.patch_count},9)")
        centred = [space.centred(features) for space in self._spaces]
        inside = [(rows @ space.axes.to(rows)).double() for rows, space in zip(centred, self._spaces, strict=True)]
        linear = torch.stack([-rows @ space.known.T for rows, space in zip(inside, self._spaces, strict=True)], dim=1)
        weights = self._damped(linear, previous) if self.temporal > 0 else self._each_alone(linear)
        distances = []
        for row, (space, rows, all_of_it) in enumerate(zip(self._spaces, inside, centred, strict=True)):
            beyond = all_of_it.double().square().sum(1) - rows.square().sum(1)
            left = (weights[:, row] @ space.known - rows).square().sum(1) + beyond
            distances.append(left.clamp(min=1e-30).sqrt() / self.spread[row])
        return Matched(weights.to(features), torch.stack(distances, dim=1).to(features))

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

    def _each_alone(self, linear: Tensor) -> Tensor:
        rows = [simplex_qp(H, f.contiguous()) for H, f in zip(self._H, linear.unbind(1), strict=True)]
        return torch.stack(rows, dim=1)

    def _damped(self, linear: Tensor, previous: Tensor | None) -> Tensor:
        pull = self.temporal * self._unit[:, None]
        H = self._H + torch.diag_embed(pull.expand(-1, self.frame_count))
        before = None if previous is None else previous.double()
        found = []
        for f in linear:  # each frame begins where the one before ends
            if before is None:
                before = torch.stack([simplex_qp(A, b[None])[0] for A, b in zip(self._H, f, strict=True)])
            else:
                before = simplex_qp(H, f - pull * before, start=before)
            found.append(before)
        return torch.stack(found) if found else linear.new_zeros(linear.shape)


def _space(features: Tensor, weights: Tensor) -> _Space:
    patches = (weights > _FAINT * weights.max()).nonzero()[:, 0]
    roots = weights[patches].sqrt()[:, None].float() * features.new_tensor(_UNITS)
    rows = (features[:, patches] * roots).flatten(1)
    mean = rows.mean(0)
    rows = rows - mean
    values, vectors = torch.linalg.eigh((rows @ rows.T).double())
    values, vectors = values.clamp(min=0).flip(0), vectors.flip(1)
    left = values.sum() - values.cumsum(0)
    count = max(1, int((left > _LOST * values.sum()).sum()) + 1) if float(values.sum()) > 0 else 1
    vectors = vectors[:, :count].float()
    # Orthonormal again: rounding in the small values would otherwise bend distances.
    axes = torch.linalg.qr(rows.T @ vectors)[0]
    return _Space(patches, roots, mean, axes, (rows @ axes).double())
