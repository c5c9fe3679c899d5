"""A Gaussian process learned from parts as they come, and what each fold is predicted to be from the others."""

from __future__ import annotations

import torch
from torch import Tensor

from torchface.capture.priors.gaussian_process import Kernel, Posterior, Statistics, posterior, whitening_of

_LEAST_ENERGY = 1e-3  # of a part's targets: one that hardly moves is not to count for more


class LeftOutProcess:
    """Cross-validation of a process in two passes over parts of a few folds; no frame is kept.

    In the first pass ``learn`` takes each part, then ``settle`` solves; in the second ``predict`` tells what the other
    folds make of a part, and ``compare`` how well. Memory is two matrices a fold.

    Args:
        kernel: of the process.
        inducing: Z, (M,F).
        targets: n.
        folds: K; what is left out together has one number below it.
    """

    posterior: Posterior
    """Of all folds, once settled."""

    def __init__(self, kernel: Kernel, inducing: Tensor, targets: int, folds: int) -> None:
        self.kernel, self._inducing, self._whitening = kernel, inducing, whitening_of(kernel, inducing)
        points = len(inducing)
        self._squares = torch.zeros(folds, points, points, dtype=torch.float64)
        self._products = torch.zeros(folds, points, targets, dtype=torch.float64)
        self._others: list[Posterior] = []
        self._toward = self._length = 0.0

    def learn(self, fold: int, inputs: Tensor, targets: Tensor) -> None:
        """Takes up a part.

        Args:
            fold: its number.
            inputs: (B,F).
            targets: under autoregression coefficients learned from the other folds, (B,n).
        """
        features = self.kernel.between(inputs, self._inducing) @ self._whitening
        self._squares[fold].addmm_(features.T, features)
        self._products[fold].addmm_(features.T, targets)

    def settle(self, redundancy: float) -> None:
        """Solves for all folds, and for all but each; the number of correlated frames that count as one is given."""
        whole = Statistics(self._squares.sum(0), self._products.sum(0))

        def solved(statistics: Statistics) -> Posterior:
            return posterior(self.kernel, self._inducing, self._whitening, statistics, redundancy)

        self.posterior = solved(whole)
        self._others = [
            solved(Statistics(whole.square - square, whole.product - product))
            for square, product in zip(self._squares, self._products, strict=True)
        ]

    def predict(self, fold: int, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Mean (B,n) and variance (B,), without noise, of inputs (B,F) of a fold, learned from the others."""
        near, own = self.kernel.between(inputs, self._inducing), self._others[fold]
        projected = near @ own.covariance_root
        explained = (near @ self._whitening).square().sum(1)
        return projected @ own.weights, (self.kernel.signal - explained).clamp(min=0.0) + projected.square().sum(1)

    def compare(self, mean: Tensor, targets: Tensor) -> None:
        """Counts how far a predicted mean goes toward the targets of a part, (B,n) both.

        Errors count relative to those without the process, so that a take with much motion does not dominate.
        """
        energy = max(float(targets.square().sum()), _LEAST_ENERGY)
        self._toward += float((mean * targets).sum()) / energy
        self._length += float(mean.square().sum()) / energy

    @property
    def gain(self) -> float:
        """By what the mean is best multiplied, in [0,1], of all that was compared."""
        return min(max(self._toward / max(self._length, 1e-12), 0.0), 1.0)
