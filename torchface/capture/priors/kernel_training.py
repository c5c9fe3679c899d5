"""Hyperparameters of a kernel, by gpytorch."""

from __future__ import annotations

import math
import warnings

import torch
from torch import Tensor

from torchface.capture.priors.gaussian_process import Kernel

_LEARNING_RATE = 0.1


def fitted_kernel(inputs: Tensor, targets: Tensor, inducing: Tensor, active: Tensor, iterations: int) -> Kernel:
    """Hyperparameters that maximise the bound of the marginal likelihood with inducing points, all targets together.

    One length for places, one for slopes, one for curvatures; by Adam on what gpytorch makes of them so that they stay
    positive.

    Args:
        inputs: (B,O·N), scaled.
        targets: (B,n), scaled.
        inducing: (M,O·N).
        active: 1 for inputs that the kernel uses, else 0, (O,N).
        iterations: of Adam.

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
    lengths = [one.lengthscale.item() for one in scaled.base_kernel.modules() if hasattr(one, "raw_lengthscale")]
    inverse = active / torch.tensor(lengths, dtype=active.dtype)[:, None]
    return Kernel(scaled.outputscale.item(), inverse.flatten(), likelihood.noise.item())
