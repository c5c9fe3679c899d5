"""Rigid and similarity alignment of corresponding points."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import AlignmentError, ShapeError, ValueRangeError
from torchface.geometry.rotations import cross_matrix
from torchface.number_checks import as_real

__all__ = ["Similarity", "similarity_transform"]

MIN_HEAD_SCALE, MAX_HEAD_SCALE = 0.8, 1.25
"""Two heads in the same unit, a child's and a large man's included, do not differ by more in size."""
_COINCIDENT = 1e-12  # a share of the distance from the origin that rounding leaves of none


@dataclass(frozen=True, eq=False)
class Similarity:
    """:math:`x \\mapsto s R x + t` for a batch: scale (B,), rotation (B,3,3), translation (B,3).

    Example:
        >>> larger = Similarity(torch.tensor([2.0]), torch.eye(3)[None], torch.ones(1, 3))
        >>> larger.inverse().apply(larger.apply(torch.eye(3))).tolist() == torch.eye(3)[None].tolist()
        True
    """

    scale: Tensor
    rotation: Tensor
    translation: Tensor

    def apply(self, points: Tensor) -> Tensor:
        """Moved points (B,N,3); points (N,3) go through each of the B similarities."""
        points = as_real(points, "points")
        rotated = points @ self.rotation.transpose(-1, -2).to(points)
        return self.scale.to(points)[:, None, None] * rotated + self.translation.to(points)[:, None, :]

    def apply_vectors(self, vectors: Tensor) -> Tensor:
        """Rotated and scaled, not translated: for deltas (..., B,N,3)."""
        vectors = as_real(vectors, "vectors")
        return self.scale.to(vectors)[:, None, None] * (vectors @ self.rotation.transpose(-1, -2).to(vectors))

    def __getitem__(self, rows: Tensor | slice) -> "Similarity":
        """Some of the batch."""
        return Similarity(self.scale[rows], self.rotation[rows], self.translation[rows])

    def moved(self, turn: Tensor, growth: Tensor, shift: Tensor, centre: Tensor) -> "Similarity":
        r"""Followed by a small motion: turned and grown about a centre, then shifted.

        .. math:: x \mapsto c + g\, e^{[\omega]} (s R x + t - c) + d

        Args:
            turn: :math:`\omega`, axis times angle, (B,3).
            growth: :math:`g`, (B,).
            shift: :math:`d`, (B,3).
            centre: :math:`c`, (B,3).
        """
        rotation = torch.linalg.matrix_exp(cross_matrix(turn))
        arm = growth[:, None] * (rotation @ (self.translation - centre)[..., None])[..., 0]
        return Similarity(self.scale * growth, rotation @ self.rotation, centre + arm + shift)

    def inverse(self) -> "Similarity":
        """The similarity that undoes this one."""
        rotation = self.rotation.transpose(-1, -2)
        scale = 1 / self.scale
        translation = -scale[:, None] * (rotation @ self.translation[..., None])[..., 0]
        return Similarity(scale, rotation, translation)


def similarity_transform(
    source: Tensor, target: Tensor, weights: Tensor | None = None, scale: bool = True
) -> Similarity:
    r"""The similarity that moves ``source`` onto ``target`` with least squared error.

    .. math:: \min_{s,R,t} \sum_i w_i \lVert s R x_i + t - y_i \rVert^2, \quad R \in SO(3)

    Args:
        source: points :math:`x`, (B,N,3), millimetres.
        target: points :math:`y`, (B,N,3); a NaN row, here or in ``source``, counts as missing.
        weights: non-negative, (B,N); equal if absent.
        scale: estimate :math:`s`; otherwise it stays 1.

    Returns:
        ``Similarity(scale (B,), rotation (B,3,3), translation (B,3))``, solved in float64.

    Raises:
        ShapeError: the shapes differ, or fewer than three points are present.
        ValueRangeError: a weight is negative or not finite.
        AlignmentError: all points of a set coincide, and a scale is asked for.

    Source: Horn 1987; thesis 3.2.3 and 4.1.2.

    Example:
        >>> points = torch.tensor([[[0.0, 0, 0], [9, 0, 0], [0, 5, 0], [0, 0, 2]]])
        >>> found = similarity_transform(points, 10 * points + 3.0)
        >>> round(found.scale.item(), 3), found.translation.round(decimals=3).tolist()
        (10.0, [[3.0, 3.0, 3.0]])
    """
    source, target = as_real(source, "source"), as_real(target, "target")
    if source.shape != target.shape or source.ndim != 3 or source.shape[-1] != 3:
        raise ShapeError(
            f"similarity_transform: found {tuple(source.shape)} and {tuple(target.shape)}, expected (B,N,3) twice"
        )
    x, y = source.double(), target.double()
    seen = torch.isfinite(x).all(-1) & torch.isfinite(y).all(-1)
    w = seen.double() if weights is None else weights.double() * seen
    checked = not torch.compiler.is_compiling()  # a graph cannot ask for numbers
    if checked and not bool(((w >= 0) & (w < torch.inf)).all()):
        raise ValueRangeError("weights: found a negative, infinite or NaN one, expected finite ones of at least 0")
    if checked and len(x) and int((w > 0).sum(-1).min()) < 3:
        raise ShapeError(
            f"similarity_transform: found {int((w > 0).sum(-1).min())} points present, expected at least 3"
        )
    x, y = torch.where(seen[..., None], x, 0.0), torch.where(seen[..., None], y, 0.0)
    w = (w / w.sum(-1, keepdim=True))[..., None]
    mean_x, mean_y = (w * x).sum(-2, keepdim=True), (w * y).sum(-2, keepdim=True)
    x, y = x - mean_x, y - mean_y
    for points, mean in ((x, mean_x), (y, mean_y)) if checked and scale else ():
        together = (w * points.square()).sum((-1, -2)) <= _COINCIDENT**2 * mean.square().sum((-1, -2))
        if bool(together.any()):
            rows = together.nonzero()[:5, 0].tolist()
            raise AlignmentError(f"similarity_transform: points coincide in rows {rows}, expected some apart")
    covariance = (w * y).transpose(-1, -2) @ x
    u, singular, vh = torch.linalg.svd(covariance)
    # Without the guard a mirrored or flat point set would come back as a reflection.
    sign = torch.ones_like(singular)
    sign[..., -1] = torch.where(torch.linalg.det(u @ vh) < 0, -1.0, 1.0)
    rotation = (u * sign[..., None, :]) @ vh
    s = (sign * singular).sum(-1) / (w * x.square()).sum((-1, -2)) if scale else torch.ones_like(singular[..., 0])
    translation = mean_y[..., 0, :] - s[..., None] * (rotation @ mean_x.transpose(-1, -2))[..., 0]
    return Similarity(*(found.to(source) for found in (s, rotation, translation)))
