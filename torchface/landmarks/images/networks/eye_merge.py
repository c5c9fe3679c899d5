"""What two networks say of the lids, one shown the whole face and one each eye, as one."""

from __future__ import annotations

import torch
from torch import Tensor

from torchface.errors import ShapeError
from torchface.landmarks.images.networks.eye_crop import EYE_LANDMARKS

HIDDEN, SEEN = 0.3, 0.8
"""Visibility up to which an eye does not count, and from which it counts fully."""

PLACES = tuple(sum(EYE_LANDMARKS, ()).index(number) for number in range(36, 48))
"""Rows of both eyes' lids, in the order of ``EYE_LANDMARKS``, that landmarks 36 to 47 are."""


def merged_lids(
    landmarks: Tensor, deviation: Tensor, lids: Tensor, lid_deviation: Tensor, visibility: Tensor
) -> tuple[Tensor, Tensor]:
    r"""A face's landmarks with those of its lids moved to where both networks together put them.

    .. math:: x = \frac{x_1 / \sigma_1^2 + v\, x_2 / \sigma_2^2}{1 / \sigma_1^2 + v / \sigma_2^2}, \qquad
        \frac{1}{\sigma^2} = \frac{1}{\sigma_1^2} + \frac{v}{\sigma_2^2}

    with v how far the eye counts: not at all where it is likely hidden, fully where it is likely seen. Sums, products
    and roots alone: it goes into graphs as it is.

    Args:
        landmarks: :math:`x_1`, iBUG's 68, (...,68,2) pixels.
        deviation: :math:`\sigma_1`, (...,68) pixels.
        lids: :math:`x_2` of the right and the left eye, (...,2,6,2) pixels, in the order of ``EYE_LANDMARKS``.
        lid_deviation: :math:`\sigma_2`, (...,2,6) pixels.
        visibility: probability that nothing hides each eye, (...,2).

    Returns:
        Landmarks (...,68,2) and their deviation (...,68).

    Raises:
        ShapeError: shapes that do not belong together.
    """
    if landmarks.shape[-2:] != (68, 2) or lids.shape[-3:] != (2, 6, 2) or visibility.shape[-1:] != (2,):
        raise ShapeError(
            f"merged_lids: found landmarks {tuple(landmarks.shape)}, lids {tuple(lids.shape)} and visibility "
            f"{tuple(visibility.shape)}, expected (...,68,2), (...,2,6,2) and (...,2)"
        )
    share = ((visibility - HIDDEN) / (SEEN - HIDDEN)).clamp(0, 1)[..., None]
    own, theirs = 1 / deviation[..., 36:48].square(), (share / lid_deviation.square()).flatten(-2)[..., list(PLACES)]
    both = own + theirs
    places = (own[..., None] * landmarks[..., 36:48, :] + theirs[..., None] * _ordered(lids)) / both[..., None]
    return (
        torch.cat([landmarks[..., :36, :], places, landmarks[..., 48:, :]], -2),
        torch.cat([deviation[..., :36], 1 / both.sqrt(), deviation[..., 48:]], -1),
    )


def _ordered(lids: Tensor) -> Tensor:
    """Landmarks 36 to 47 (...,12,2) of both eyes' lids (...,2,6,2)."""
    return lids.flatten(-3, -2)[..., list(PLACES), :]
