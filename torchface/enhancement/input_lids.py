"""The lids of an input that shows them itself: eyes close where the input closes them, whatever is blended."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.enhancement.detail.low_pass import LowPass
from torchface.enhancement.matching.face_regions import surface_distances

_WAVELENGTH = 8.0  # millimetres: lids are placed by longer waves, shorter ones are their wrinkles
_SOFT = 6.0  # millimetres inside an eye's region in which its lids become those of the input
_ALIKE, _UNLIKE = 0.25, 0.4  # of what the lids move: how far the input's are off those found at which they are, are not


@dataclass(frozen=True, eq=False)
class _Eye:
    """One eye's vertices (E,), how much each is of the lids (E,), and the filter of their surface."""

    ids: Tensor
    weights: Tensor
    low_pass: LowPass


class InputLids:
    r"""Puts an input's own lids into enhanced frames where both are nearly the same.

    Lids move far over little skin, so the smooth part of a blink is half open, and detail has to close it. A blend of
    lids closes them nearly, but seldom wholly. With :math:`x` the enhanced lids, :math:`\ell` their smooth part and
    :math:`a` the input's, the input shows lids of its own where :math:`|a - x|` is small beside :math:`|x - \ell|`;
    there the long waves of :math:`a - x` are added, and wrinkles stay. An input that was smoothed itself is always off
    by a third and more: its lids are those found.

    Args:
        neutral: (V,3), millimetres.
        faces: (F,3) int64.
        eyes: which triangles are each eye's region, (E,F) bool.
    """

    def __init__(self, neutral: Tensor, faces: Tensor, eyes: Tensor) -> None:
        self._eyes = [_eye(neutral, faces, inside) for inside in eyes if bool(inside.any())]

    def __call__(self, enhanced: Tensor, low: Tensor, own: Tensor) -> Tensor:
        """Enhanced frames (T,V,3) with the lids of ``own``; all of one place, ``low`` the smooth part."""
        for eye in self._eyes:
            moved, off = ((one - other)[:, eye.ids] for one, other in ((enhanced, low), (own, enhanced)))
            weights = eye.weights.to(enhanced)[:, None]
            size, error = ((weights * some.square()).sum((1, 2)) for some in (moved, off))
            ratio = (error / size.clamp(min=1e-12)).clamp(min=1e-12).sqrt()
            trusted = ((_UNLIKE - ratio) / (_UNLIKE - _ALIKE)).clamp(0, 1)
            enhanced = enhanced.index_add(1, eye.ids, trusted[:, None, None] * weights * eye.low_pass(off))
        return enhanced


def _eye(neutral: Tensor, faces: Tensor, inside: Tensor) -> _Eye:
    ids, own = faces[inside].unique(return_inverse=True)
    own = own.view(-1, 3)
    points = neutral[ids]
    edge = torch.isin(ids, faces[~inside]).nonzero()[:, 0]
    deep = torch.ones(len(ids))
    if len(edge):
        deep = (surface_distances(points, own, edge, _SOFT).float() / _SOFT).clamp(max=1)
    return _Eye(ids, 0.5 - 0.5 * torch.cos(math.pi * deep), LowPass(points, own, _WAVELENGTH))
