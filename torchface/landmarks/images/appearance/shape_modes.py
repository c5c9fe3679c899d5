"""Modes of one face's landmarks: a mean shape, modes with their deviations, and similarities apart from both."""

from typing import NamedTuple

import torch
from torch import Tensor

_ITERATIONS = 20


class PlanarPose(NamedTuple):
    """Similarities of the plane as complex numbers (B,): z -> rotation·z + translation; the scale is |rotation|."""

    rotation: Tensor
    translation: Tensor

    def apply(self, shapes: Tensor) -> Tensor:
        """Shapes (B,L,2) or (L,2) moved, (B,L,2)."""
        return torch.view_as_real(self.rotation[:, None] * _complex(shapes) + self.translation[:, None])

    def undo(self, shapes: Tensor) -> Tensor:
        """Shapes (B,L,2) moved back."""
        return torch.view_as_real((_complex(shapes) - self.translation[:, None]) / self.rotation[:, None])

    @property
    def scale(self) -> Tensor:
        """How many times larger things become, (B,)."""
        return self.rotation.abs()


class ShapeModes(NamedTuple):
    """A linear Gaussian model of shapes, similarities removed."""

    mean: Tensor  # (L,2), centred, its root mean square distance from the centre is 1
    modes: Tensor  # orthonormal (K,L,2), orthogonal to what similarities do to the mean
    deviations: Tensor  # standard deviations along them, (K,), the largest first


def planar_pose(mean: Tensor, shapes: Tensor) -> PlanarPose:
    r"""The similarity that moves a centred shape (L,2) onto each of others (B,L,2) with least squared error.

    .. math:: a = \frac{\sum_i \bar z_i w_i}{\sum_i |z_i|^2}, \quad t = \frac1L \sum_i w_i

    Source: Cootes et al. 1995.
    """
    start, end = _complex(mean), _complex(shapes)
    translation = end.mean(1)
    rotation = (start.conj() * (end - translation[:, None])).sum(1) / start.abs().square().sum()
    return PlanarPose(rotation, translation)


def similarity_modes(mean: Tensor) -> Tensor:
    """What small similarities do to a centred shape (L,2): orthonormal (4,L,2), scale, rotation, translations."""
    across = torch.stack([-mean[:, 1], mean[:, 0]], dim=1)
    x, y = torch.zeros_like(mean), torch.zeros_like(mean)
    x[:, 0], y[:, 1] = 1.0, 1.0
    modes = torch.stack([mean, across, x, y])
    return modes / modes.flatten(1).norm(dim=1)[:, None, None]


def learn_shape_modes(
    shapes: Tensor, reach: float = 1.0, flexibility: float = 0.02, variance_kept: float = 0.995
) -> ShapeModes:
    r"""The modes of a few shapes, made more general than the few are.

    .. math:: \Sigma_{ij} = (C_{ij} + \phi^2 I)\, e^{-|\bar x_i - \bar x_j|^2 / 2\ell^2}

    with C the shapes' covariance after Procrustes alignment. What fifteen shapes show of a brow and the chin together
    is chance: with the distance of two landmarks their correlation falls, so that parts of the face move apart from
    one another; :math:`\phi` lets them also move as they were never seen to, neighbours together.

    Args:
        shapes: (M,L,2), M at least 2, in any pose.
        reach: :math:`\ell`, in units of the mean's root mean square distance from its centre; infinite leaves the
            covariance as it is.
        flexibility: :math:`\phi`, in the same units.
        variance_kept: share of the variance that the modes kept carry.

    Source: thesis 4.2.2 (the model); Lüthi et al. 2018 (localised covariances).
    """
    shapes = shapes.double()
    mean, aligned = procrustes_mean(shapes)
    centred = (aligned - aligned.mean(0)).flatten(1)
    covariance = centred.T @ centred / (len(shapes) - 1)
    apart = (mean[:, None] - mean).square().sum(-1)
    locality = torch.exp(-apart / (2 * reach**2)).repeat_interleave(2, 0).repeat_interleave(2, 1)
    axes = torch.eye(2, dtype=mean.dtype).repeat(len(mean), len(mean))
    covariance = (covariance + flexibility**2 * axes) * locality
    rigid = similarity_modes(mean).flatten(1)
    free = torch.eye(mean.numel(), dtype=mean.dtype) - rigid.T @ rigid
    values, vectors = torch.linalg.eigh(free @ covariance @ free)
    values, vectors = values.flip(0).clamp(min=0), vectors.flip(1)
    share = values.cumsum(0) / values.sum()
    count = min(int((share < variance_kept).sum()) + 1, int((values > 1e-9 * values[0]).sum()))
    modes = vectors[:, :count].T
    first = modes.gather(1, modes.abs().argmax(1, keepdim=True))  # an eigenvector's sign is chance
    modes = (modes * first.sign()).reshape(count, -1, 2)
    return ShapeModes(mean.float(), modes.float(), values[:count].sqrt().float())


def procrustes_mean(shapes: Tensor) -> tuple[Tensor, Tensor]:
    """The mean (L,2) of shapes (M,L,2) without their poses, upright as the first is, and they aligned to it (M,L,2)."""
    mean = _unit(shapes[0])
    for _ in range(_ITERATIONS):
        aligned = planar_pose(mean, shapes).undo(shapes)
        mean = _unit(planar_pose(mean, aligned.mean(0)[None]).undo(aligned.mean(0)[None])[0])
    upright = planar_pose(_unit(shapes.mean(0)), mean[None])
    mean = _unit(upright.undo(mean[None])[0])
    return mean, planar_pose(mean, shapes).undo(shapes)


def _unit(shape: Tensor) -> Tensor:
    centred = shape - shape.mean(0)
    return centred / centred.square().sum(1).mean().sqrt()


def _complex(shapes: Tensor) -> Tensor:
    return torch.view_as_complex(shapes.contiguous())
