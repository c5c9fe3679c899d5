"""Learns a person's landmarks from frames: an information filter beside which expressions are marginalised out."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchface.optim.exported_operators import symmetric_inverse

_POSE_INFORMATION = 1e-6
_SOFTENING = 0.1


def lasting_precision(weights: Tensor, penalty: float, resting: Tensor) -> Tensor:
    """How sure it is that weights (N,) are at rest, one over a variance, (N,).

    The quadratic that an L1 penalty touches: shapes at rest are likely to be, what is active is left open.

    Args:
        weights: solved.
        penalty: for a weight of 1.
        resting: whether the person has been asked to rest, () bool.

    Source: Candès, Wakin and Boyd 2008.
    """
    likely = penalty / (weights + _SOFTENING)
    return torch.where(resting, 100.0 * penalty / _SOFTENING, likely)


def frame_information(
    residual: Tensor, by_head: Tensor, by_person: Tensor, weights: Tensor, precision: Tensor
) -> tuple[Tensor, Tensor]:
    r"""What a frame's residuals tell of the person, expression and pose marginalised out: (D,D) and the gradient (D,).

    .. math:: A = J_z^\top J_z - J_z^\top J_x (J_x^\top J_x + \Lambda)^{-1} J_x^\top J_z, \quad
        g = J_z^\top r - J_z^\top J_x (J_x^\top J_x + \Lambda)^{-1} (J_x^\top r + \Lambda x)

    Args:
        residual: in standard deviations, (R,).
        by_head: its derivatives by weights and motion, (R,N+6).
        by_person: by the person's coefficients, (R,D).
        weights: (N,).
        precision: of their prior, which is at rest, (N,).
    """
    lasting = pad(precision, (0, 6), value=_POSE_INFORMATION)
    coupling = by_head.T @ by_person
    explained = symmetric_inverse(by_head.T @ by_head + torch.diag(lasting)) @ torch.cat(
        [coupling, (residual @ by_head + lasting * pad(weights, (0, 6)))[:, None]], dim=1
    )
    through = coupling.T @ explained
    count = by_person.shape[1]
    information = by_person.T @ by_person - through[:, :count]
    return 0.5 * (information + information.T), residual @ by_person - through[:, count]
