"""What a range of motion leaves open: how surely it tells each marker's site and each shape's level."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.capture.markers.attachment.site_curvature import TakeCurvature

# What is known without the take: a first guess is right to this distance in each direction along the skin, and the
# mean weight of a shape over a take to this much.
SITE_PRIOR, LEVEL_PRIOR = 4.0, 0.3
# Beyond these a site or a shape is named.
UNCERTAIN_SITE, UNCERTAIN_LEVEL = 1.0, 0.08
# What a rig gets wrong lasts: frames that are nearer in time tell the same.
INDEPENDENT_SECONDS = 0.1
# Millimetres: keeps all definite where a take is exact.
_LEAST_NOISE = 0.01


@dataclass(frozen=True, eq=False)
class SiteUncertainty:
    """How far off what a range of motion told may be: noise, a rough first guess and the fit's own ridge considered.

    A shape's level is its mean weight over the take: a shape that hardly moves may be on all the time, its markers'
    sites shifted to match.

    Args:
        names: of the N shapes.
        labels: of the M markers.
        sites: of each marker's site along the skin, (M,), millimetres.
        levels: of each shape's mean weight, (N,).
        layout: of each shape's mean weight if the sites were known, (N,): what these markers can tell at best.
        noise: of a marker's coordinate, as left by the fit, millimetres.
    """

    names: tuple[str, ...]
    labels: tuple[str, ...]
    sites: Tensor
    levels: Tensor
    layout: Tensor
    noise: float

    @property
    def shapes(self) -> tuple[str, ...]:
        """Shapes that the take leaves uncertain although the markers see them, worst first."""
        return self._named(self.names, torch.where(self._unseen, 0.0, self.levels), UNCERTAIN_LEVEL)

    @property
    def unseen(self) -> tuple[str, ...]:
        """Shapes that these markers could not tell wherever they sat."""
        return tuple(name for name, blind in zip(self.names, self._unseen.tolist(), strict=True) if blind)

    @property
    def markers(self) -> tuple[str, ...]:
        """Markers whose sites the take leaves uncertain, worst first."""
        return self._named(self.labels, self.sites, UNCERTAIN_SITE)

    @property
    def mostly_uncertain(self) -> bool:
        """Most of the sites, or most of the shapes that the markers see."""
        seen = len(self.names) - len(self.unseen)
        return 2 * len(self.markers) > len(self.labels) or 2 * len(self.shapes) > max(seen, 1)

    @property
    def _unseen(self) -> Tensor:
        return self.layout > UNCERTAIN_LEVEL

    @staticmethod
    def _named(names: Sequence[str], deviations: Tensor, limit: float) -> tuple[str, ...]:
        order = deviations.argsort(descending=True).tolist()
        return tuple(names[i] for i in order if float(deviations[i]) > limit)


def site_uncertainty(
    here: Tensor,
    tangents: Tensor,
    moved: Tensor,
    weights: Tensor,
    pose_columns: Tensor,
    seconds: float,
    names: Sequence[str],
    labels: Sequence[str],
    slips: bool = False,
) -> SiteUncertainty:
    r"""The posterior covariance of sites and shapes' levels, from the curvature of the fit.

    With :math:`\sigma` what is left of a coordinate, :math:`\Sigma = (S / \sigma^2 + P)^{-1}` is that of sites and
    pose, P the prior of the first guess. A shift of them moves the mean weights by
    :math:`A = -\overline{G_t^{-1} C_t}`; their covariance is
    :math:`A \Sigma A^\top + \sigma^2 \overline{G_t^{-1}} / T`. Weights are not held at their bounds, where a wrong fit
    leaves them too. T counts frames a tenth of a second apart, and fewer where markers stay off their sites all the
    time, which more frames would not mend. The fit's ridge pulls all weights to zero; how far levels move in one Newton
    step without it is added in quadrature.

    Args:
        here, tangents, moved, weights, pose_columns, slips: as in ``TakeCurvature.of``, spread over the take.
        seconds: how long the take is.
        names: of the shapes.
        labels: of the markers.
    """
    left = moved - torch.einsum("mcn,tn->tmc", here[..., 1:], weights) - here[..., 0]
    # The median marker's: one that is not on the skin makes the others no noisier.
    noise = float(left.square().nanmean((0, 2)).nanmedian().sqrt().clamp(min=_LEAST_NOISE))
    # What lasts over the whole take is no noise that more frames would average: the rig is not exact, or the fit.
    lasting = float(left.nanmean(0).square().mean(1).nanmedian())
    count = min(float(len(moved)), max(seconds / INDEPENDENT_SECONDS, 1.0))
    count = noise**2 / (noise**2 / count + lasting)
    markers, shapes = len(here), len(names)
    ridge = noise**2 / (LEVEL_PRIOR**2 * count * markers)
    curvature = TakeCurvature.of(here, tangents, moved, weights, pose_columns, ridge, slips, bounded=False)
    stiffness = here.new_zeros(len(curvature.gradient))
    stiffness[: 2 * markers] = SITE_PRIOR**-2
    stiffness[2 * markers :] = 1e-6  # a metre: nothing
    share = count / len(moved) / noise**2
    covariance = torch.linalg.inv(share * curvature.information + torch.diag(stiffness))
    inverse = torch.cholesky_inverse(curvature.factor)
    follows = (inverse @ curvature.cross).mean(0)[:shapes]
    alone = noise**2 / count * inverse.mean(0).diagonal()[:shapes]
    levels = ((follows @ covariance) * follows).sum(1) + alone
    released = TakeCurvature.of(here, tangents, moved, weights, pose_columns, ridge, slips)
    change = released.step(noise**2 * stiffness, torch.zeros_like(stiffness))[1][:, :shapes]
    levels = levels + ((weights + change).clamp(0, 1) - weights).mean(0).square()
    sites = covariance.diagonal()[: 2 * markers].unflatten(0, (markers, 2)).sum(1)
    return SiteUncertainty(
        tuple(names), tuple(labels), sites.clamp(min=0).sqrt(), levels.clamp(min=0).sqrt(), alone.sqrt(), noise
    )
