"""Parts of all trainings of networks with heat maps: batches, losses of places, gaps and maps."""

from typing import Any

import torch
from torch import Tensor
from torch.utils.data import Dataset

from torchface.errors import ShapeError
from torchface.landmarks.images.networks.heat_maps import cell_places
from torchface.optim import DescentSettings


def check_pictures(pictures: Dataset[tuple[Tensor, ...]], expected: str, *shapes: tuple[int, ...]) -> None:
    """Refuses a data set that is empty, or whose first picture (4,H,W) or labels have other shapes than expected."""
    count: int = len(pictures)  # type: ignore[arg-type]  # data sets by number have a length
    rgba, *labels = pictures[torch.arange(min(count, 1))]
    forms = [tuple(one.shape[1:]) for one in labels]
    if not count or rgba.dtype != torch.uint8 or rgba.ndim != 4 or rgba.shape[1] != 4 or forms != list(shapes):
        found = ", ".join(f"{one.dtype} {tuple(one.shape)}" for one in (rgba, *labels)).replace("torch.", "")
        raise ShapeError(f"pictures: found {count}, the first {found}; expected at least one, {expected}")


def draw_numbers(pictures: Dataset[Any], settings: DescentSettings, step: int) -> tuple[Tensor, torch.Generator]:
    """The numbers (B,) of a step's pictures, and the generator that draws the rest of the step."""
    generator = torch.Generator().manual_seed(1_000_003 * settings.seed + step)
    count: int = len(pictures)  # type: ignore[arg-type]
    return torch.randint(count, (settings.batch,), generator=generator), generator


def point_loss(points: Tensor, truth: Tensor, deviation: Tensor | None, weight: Tensor) -> tuple[Tensor, Tensor]:
    r"""The loss of places and of the deviations stated for them, and the distances :math:`r_l` (B,L).

    .. math:: \frac{1}{\sum_l v_l} \sum_l v_l \Bigl( r_l + 3 \ln(1 + r_l / 0.7) + \tfrac12 \tfrac{r_l}{\sigma_l}
        + \ln \sigma_l \Bigr)

    Linear far away, steep near the truth, so that neither what is hidden nor what is already good decides alone;
    :math:`\sigma` learns from the likelihood without pulling on the places.

    Args:
        points, truth: (B,L,2) pixels.
        deviation: :math:`\sigma`, (B,L) pixels; if absent, places alone are learned.
        weight: :math:`v`, (B,L).

    Source: Feng et al. 2018 (a loss that is steep near zero); Kumar et al. 2020 (likelihood with visibility).
    """
    distance = ((points - truth).square().sum(-1) + 1e-6).sqrt()
    near = distance + 3 * torch.log1p(distance / 0.7)
    if deviation is not None:
        near = near + 0.5 * (distance.detach() / deviation + 2 * deviation.log())
    return (near * weight).sum() / weight.sum().clamp(min=1), distance.detach()


def deviation_loss(distance: Tensor, deviation: Tensor, weight: Tensor) -> Tensor:
    r"""The negative log likelihood :math:`\tfrac{r^2}{2 \sigma^2} + 2 \ln \sigma` of stated deviations (B,L), pixels.

    Nothing is learned through the distances r.
    """
    likelihood = 0.5 * (distance.detach() / deviation).square() + 2 * deviation.log()
    return (likelihood * weight).sum() / weight.sum().clamp(min=1)


def gap_loss(points: Tensor, truth: Tensor, weight: Tensor, pairs: Tensor, steepness: float) -> Tensor:
    """The loss of the vectors between pairs (P,2) of points (B,L,2), such as lids, steeper near the truth than far
    away."""
    first, second = pairs.to(points.device).unbind(1)
    apart = (points[:, first] - points[:, second]) - (truth[:, first] - truth[:, second])
    size = (apart.square().sum(-1) + 1e-6).sqrt()
    both = weight[:, first] * weight[:, second]
    return ((size + steepness * torch.log1p(size / 0.5)) * both).sum() / both.sum().clamp(min=1)


def heat_loss(heat: Tensor, truth: Tensor, weight: Tensor, stride: int, spread: float) -> Tensor:
    """The weighted mean cross entropy of heat maps (B,L,h,w) with a Gaussian of ``spread`` cells about the truth
    (B,L,2)."""
    squared = (cell_places(heat, stride) - truth[:, :, None]).square().sum(-1) / stride**2
    wanted = torch.softmax(-squared / (2 * spread**2), dim=-1)
    form = -(wanted * heat.flatten(2).log_softmax(-1)).sum(-1)
    return (form * weight).sum() / weight.sum().clamp(min=1)
