"""Expressions laid onto their neutral by what does not move."""

from __future__ import annotations

from torch import Tensor

from torchface.geometry.similarity import similarity_transform

# Of the robust alignment, millimetres: how far off counts half, round by round, and what is too little to move.
_HALF, _NOTHING = (3.0, 2.0, 1.4, 1.0, 0.7, 0.5, 0.35, 0.25, 0.2, 0.2, 0.2, 0.2, 0.2, 0.2), 0.01


def settle(neutral: Tensor, expression: Tensor) -> Tensor:
    """An expression (V,3) moved onto its neutral by what stays: far-off vertices lose their say, round by round."""
    moved = expression
    for half in _HALF:
        distance = (moved - neutral).norm(dim=-1)
        weights = 1 / (1 + (distance / half) ** 2) ** 2
        pose = similarity_transform(expression[None], neutral[None], weights[None], scale=False)
        moved = pose.apply(expression[None])[0]
    return expression if float((moved - expression).norm(dim=-1).max()) < _NOTHING else moved
