"""The step of each shape from its own last frames, by least squares over parts of takes."""

from __future__ import annotations

import torch
from torch import Tensor

from torchface.capture.priors.take_windows import Part

_RIDGE = 1e-6  # of the coefficients, in squared weights
_POOLING = 0.02  # weight of the coefficients that all shapes share against each one's own


class Autoregression:
    """Normal equations of parts as they come, added up for each fold.

    A window at rest must stay at rest whatever the weights there, so the step is a linear function of the steps before:
    a shape that the takes never raised must not be drawn back to 0. The coefficients are pooled: each shape's are drawn
    toward those that fit all shapes.

    Args:
        shapes: N.
        window: J.
        folds: K.
    """

    def __init__(self, shapes: int, window: int, folds: int) -> None:
        self._squares = torch.zeros(folds, shapes, window - 1, window - 1, dtype=torch.float64)
        self._products = torch.zeros(folds, shapes, window - 1, dtype=torch.float64)

    def add(self, part: Part) -> None:
        """Takes up a part."""
        before = part.windows.diff(dim=1)
        self._squares[part.fold] += torch.einsum("bin,bjn->nij", before, before)
        self._products[part.fold] += torch.einsum("bin,bn->ni", before, part.following - part.windows[:, -1])

    def coefficients(self) -> tuple[Tensor, list[Tensor]]:
        """Those of frames, (J,N), from all parts, and from all but each fold."""
        square, product = self._squares.sum(0), self._products.sum(0)
        left_out = [_from_steps(square - a, product - b) for a, b in zip(self._squares, self._products, strict=True)]
        return _from_steps(square, product), left_out


def _from_steps(square: Tensor, product: Tensor) -> Tensor:
    """Coefficients (J,N) of frames, of normal equations (N,J-1,J-1), (N,J-1) of the steps between them."""
    count, steps = product.shape
    ridge = _RIDGE * torch.eye(steps, dtype=torch.float64)
    pooled = square.mean(0) + ridge
    common = torch.linalg.solve(pooled, product.mean(0))
    own = torch.linalg.solve(square + _POOLING * pooled, product + _POOLING * (pooled @ common))
    zero = torch.zeros(count, 1, dtype=torch.float64)
    padded = torch.cat([zero, own, zero], dim=1)
    return (padded[:, :-1] - padded[:, 1:]).T
