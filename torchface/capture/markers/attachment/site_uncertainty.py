"""The uncertainty of a fit: standard deviations of each marker's site and each shape's level."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.capture.markers.attachment.site_curvature import SitesOnTake, TakeCurvature

# Prior standard deviations: of a site about its initial guess in each direction along the skin, mm, and of a shape's
# mean weight over a take.
SITE_PRIOR, LEVEL_PRIOR = 4.0, 0.3
# Beyond these a site or a shape is named.
UNCERTAIN_SITE, UNCERTAIN_LEVEL = 1.0, 0.08
# Errors of a rig are correlated in time: nearer frames are not independent.
INDEPENDENT_SECONDS = 0.1
# Millimetres: keeps the problem definite where a take is exact.
_MIN_NOISE = 0.01


@dataclass(frozen=True, eq=False)
class SiteUncertainty:
    """Standard deviations of a fit to a range of motion: noise, the initial guess and the fit's ridge considered.

    A shape's level is its mean weight over the take: a shape that hardly moves may be on all the time, its markers'
    sites shifted to match.

    Args:
        names: of the N shapes.
        labels: of the M markers.
        sites: of each marker's site along the skin, (M,), millimetres.
        levels: of each shape's mean weight, (N,).
        layout: of each shape's mean weight for known sites, (N,): the limit of the marker layout.
        noise: of a marker's coordinate, the residual of the fit, millimetres.

    Example:
        >>> sure = torch.full((2,), 0.1)
        >>> places = torch.tensor([0.2, 9.0])
        >>> SiteUncertainty(("jawOpen", "cheekPuff"), ("chin", "ear"), places, sure, sure, noise=0.3).markers
        ('ear',)
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
        """Shapes that these markers cannot observe wherever they sit."""
        return tuple(name for name, hidden in zip(self.names, self._unseen.tolist(), strict=True) if hidden)

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


def site_uncertainty(fit: SitesOnTake, seconds: float, names: Sequence[str], labels: Sequence[str]) -> SiteUncertainty:
    r"""The posterior covariance of sites and shapes' levels, from the curvature of the fit.

    With :math:`\sigma` the residual of a coordinate, :math:`\Sigma = (S / \sigma^2 + P)^{-1}` is that of sites and
    pose, P the prior of the initial guess. A shift of them moves the mean weights by
    :math:`A = -\overline{G_t^{-1} C_t}`; their covariance is
    :math:`A \Sigma A^\top + \sigma^2 \overline{G_t^{-1}} / T`. No weight is in the active set here, since a wrong fit
    reaches bounds too. T counts frames a tenth of a second apart, and fewer where markers keep an offset from their
    sites, which more frames would not average out. The fit's ridge
    pulls all weights to zero; how far levels move in one Newton step without it is added in quadrature.
    """
    affine, moved, weights = fit.affine, fit.moved, fit.weights
    residual = moved - torch.einsum("mcn,tn->tmc", affine[..., 1:], weights) - affine[..., 0]
    # The median over markers is robust to one that is not on the skin.
    noise = float(residual.square().nanmean((0, 2)).nanmedian().sqrt().clamp(min=_MIN_NOISE))
    # A bias over the whole take is not averaged out by more frames: rig or fit are not exact.
    bias = float(residual.nanmean(0).square().mean(1).nanmedian())
    count = min(float(len(moved)), max(seconds / INDEPENDENT_SECONDS, 1.0))
    count = noise**2 / (noise**2 / count + bias)
    markers, shapes = len(affine), len(names)
    ridge = noise**2 / (LEVEL_PRIOR**2 * count * markers)
    curvature = TakeCurvature.of(fit, ridge, bounded=False)
    precision = affine.new_zeros(len(curvature.gradient))
    precision[: 2 * markers] = SITE_PRIOR**-2
    precision[2 * markers :] = 1e-6  # a metre: no prior
    scale = count / len(moved) / noise**2
    covariance = torch.linalg.inv(scale * curvature.information + torch.diag(precision))
    inverse = torch.cholesky_inverse(curvature.factor)
    sensitivity = (inverse @ curvature.cross).mean(0)[:shapes]
    weight_variance = noise**2 / count * inverse.mean(0).diagonal()[:shapes]
    levels = ((sensitivity @ covariance) * sensitivity).sum(1) + weight_variance
    bounded = TakeCurvature.of(fit, ridge)
    change = bounded.step(noise**2 * precision, torch.zeros_like(precision))[1][:, :shapes]
    levels = levels + ((weights + change).clamp(0, 1) - weights).mean(0).square()
    sites = covariance.diagonal()[: 2 * markers].unflatten(0, (markers, 2)).sum(1)
    return SiteUncertainty(
        tuple(names),
        tuple(labels),
        sites.clamp(min=0).sqrt(),
        levels.clamp(min=0).sqrt(),
        weight_variance.sqrt(),
        noise,
    )
