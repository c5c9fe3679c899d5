"""Antagonists in solves: of two shapes that are one quantity with a sign, one at most is above 0."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchface.shape_names import antagonists

_NOTHING = 1e-6  # a side that a solve leaves so far up has come to rest


def signed_quantities(names: Sequence[str]) -> Tensor:
    """The matrix (K,N) of +1 and -1 that makes of weights (N,) the K quantities whose sides are two shapes each."""
    pairs = antagonists(names)
    sides = torch.nn.functional.one_hot(pairs, len(names)).double()
    return sides[:, 0] - sides[:, 1]


def weaker_sides(weights: Tensor, signed: Tensor) -> Tensor:
    """Which of weights (B,N) are the smaller of two antagonists, (B,N) bool; of two that are equal, neither.

    A solver holds these at 0 in its next step. Once the larger one has come to 0 both are free, and either may grow: so
    the steps of a solve follow the sign without a choice being made beforehand.
    """
    signed = signed.to(weights)
    difference = weights @ signed.T
    return torch.where(difference.abs() > _NOTHING, difference.sign(), 0.0) @ signed < 0


def one_side(weights: Tensor, signed: Tensor) -> Tensor:
    """Weights (B,N) with the smaller of two antagonists at 0."""
    return torch.where(weaker_sides(weights, signed), torch.zeros_like(weights), weights)


def signed_difference(weights: Tensor, signed: Tensor) -> Tensor:
    """Weights (N,) or (B,N) in which two antagonists are what one of them is above the other, and 0.

    A filter of two curves that are never above 0 together lets both be so where one follows the other; their difference
    is the filtered quantity.
    """
    difference, signed = weights @ signed.T.to(weights), signed.to(weights)
    sides = difference.clamp(min=0) @ signed.clamp(min=0) + difference.clamp(max=0) @ signed.clamp(max=0)
    return torch.where(signed.abs().sum(0) > 0, sides, weights)
