"""Learning of a Gaussian process: its kernel by gpytorch, its posterior from parts as they come, cross-validated."""

import math
import warnings

import torch
from torch import Tensor

from torchface.capture.priors.gaussian_process import Kernel, Posterior, Statistics, posterior, whitening_of

_LEARNING_RATE = 0.1
_LEAST_ENERGY = 1e-3  # of a part's targets: one that hardly moves is not to count for more


def fitted_kernel(inputs: Tensor, targets: Tensor, inducing: Tensor, active: Tensor, iterations: int) -> Kernel:
    """Hyperparameters that maximise the bound of the marginal likelihood with inducing points, all targets together.

    One length for places, one for slopes, one for curvatures; by Adam on what gpytorch makes of them so that they stay
    positive.

    Args:
        active: 1 for inputs that the kernel uses, else 0, (O,N).

    Source: Titsias 2009.
    """
    import gpytorch  # takes seconds, and only training needs it
    from linear_operator.utils.warnings import NumericalWarning

    columns = [active[order].nonzero()[:, 0] + order * active.shape[1] for order in range(len(active))]
    used = torch.cat(columns)
    sizes = torch.tensor([len(column) for column in columns]).cumsum(0).tolist()
    product = None
    for stop, column in zip(sizes, columns, strict=True):
        one = gpytorch.kernels.RBFKernel(active_dims=tuple(range(stop - len(column), stop)))
        one.lengthscale = math.sqrt(len(used))
        product = one if product is None else product * one
    scaled = gpytorch.kernels.ScaleKernel(product)
    scaled.outputscale = 0.3
    likelihood = gpytorch.likelihoods.GaussianLikelihood()
    likelihood.noise = 0.7
    points = gpytorch.kernels.InducingPointKernel(scaled, inducing[:, used].clone(), likelihood).double().train()
    points.inducing_points.requires_grad_(False)
    optimizer = torch.optim.Adam(points.parameters(), lr=_LEARNING_RATE)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NumericalWarning)  # of the jitter that inducing points close by need
        for _ in range(iterations):  # each step needs the one before
            optimizer.zero_grad()
            covariance = points(inputs[:, used]).evaluate_kernel().add_diagonal(likelihood.noise.expand(len(inputs)))
            fit, volume = covariance.inv_quad_logdet(targets, logdet=True)
            missed = sum(term.loss() for term in points.added_loss_terms())
            loss = (0.5 * (fit + targets.shape[1] * volume) - targets.shape[1] * missed) / targets.numel()
            loss.backward()
            optimizer.step()
    lengths = [
        module.lengthscale.item() for module in scaled.base_kernel.modules() if hasattr(module, "raw_lengthscale")
    ]
    inverse = active / torch.tensor(lengths, dtype=active.dtype)[:, None]
    return Kernel(scaled.outputscale.item(), inverse.flatten(), likelihood.noise.item())


class LeftOutProcess:
    """Cross-validation of a process in two passes over parts of a few folds; no frame is kept.

    In the first pass ``learn`` takes each part, then ``settle`` solves; in the second ``predict`` gives what the other
    folds make of a part, and ``compare`` how well. Memory is two matrices a fold.

    Args:
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
        """Takes up a part: inputs (B,F), and targets (B,n) under autoregression coefficients of the other folds."""
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
