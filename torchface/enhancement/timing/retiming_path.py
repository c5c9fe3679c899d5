"""The retiming path: where the frames of one sequence lie on another, in order."""

from dataclasses import dataclass

import torch
from scipy.optimize import isotonic_regression
from torch import Tensor

from torchface.errors import ShapeError


@dataclass(frozen=True, eq=False)
class SequenceProjection:
    """Where the frames of one sequence lie on another."""

    times: Tensor  # on the other's timeline, from 0 to its number of frames minus 1, never falling, (m,)
    distances: Tensor  # from the points at those times, (m,)


def project_sequence(alpha: Tensor, beta: Tensor) -> SequenceProjection:
    r"""Projects a sequence (m,D) onto another (n,D), of two frames at least, in order.

    Each frame is projected onto each segment; the path that never goes back and has the least sum of distances is
    found by dynamic programming. Frames that share a segment are put in order by isotonic regression.

    .. math:: \min_P \sum_i E_{i,P(i)}, \quad P(i) \le P(i+1)

    Source: Facial Performance Enhancement Using Dynamic Shape Space Analysis, section 6.1, equations 5 and 6. Changed:
    order is held inside segments too.
    """
    if alpha.ndim != 2 or beta.ndim != 2 or alpha.shape[1] != beta.shape[1] or len(beta) < 2 or len(alpha) < 1:
        raise ShapeError(
            f"project_sequence: found alpha {tuple(alpha.shape)} and beta {tuple(beta.shape)}, expected (m,D) and "
            "(n,D) with a frame and two frames at least"
        )
    alpha, beta = alpha.double(), beta.double()
    shares, distances = segment_projections(alpha, beta)
    best, came_from = distances[0], []
    # A frame's best cost needs the frame's before: one step a frame.
    for row in distances[1:]:
        least, where = best.cummin(0)
        came_from.append(where)
        best = least + row
    path = [int(best.argmin())]
    for where in reversed(came_from):
        path.append(int(where[path[-1]]))
    segments = torch.tensor(path[::-1])
    frames = torch.arange(len(alpha))
    inside = shares[frames, segments]
    for segment in segments.unique():  # runs differ in length
        run = segments == segment
        inside[run] = torch.from_numpy(isotonic_regression(inside[run].numpy()).x)
    step = beta[segments + 1] - beta[segments]
    nearest = beta[segments] + inside[:, None] * step
    return SequenceProjection(segments + inside, (alpha - nearest).norm(dim=1))


def segment_projections(alpha: Tensor, beta: Tensor) -> tuple[Tensor, Tensor]:
    """Where on each segment of beta (n,D) each frame of alpha (m,D) lies nearest, 0 to 1, and how far, (m,n-1) each."""
    # By products of matrices, which take no memory in m n D; from beta's middle, which keeps their digits.
    middle = beta.mean(0)
    alpha, beta = alpha - middle, beta - middle
    step = beta[1:] - beta[:-1]
    length = step.square().sum(1)
    along = alpha @ step.T - (beta[:-1] * step).sum(1)
    shares = torch.where(length > 0, along / length.clamp(min=1e-300), torch.zeros_like(along)).clamp(0, 1)
    offset = alpha.square().sum(1)[:, None] - 2 * alpha @ beta[:-1].T + beta[:-1].square().sum(1)
    squared = offset - 2 * shares * along + shares.square() * length
    return shares, squared.clamp(min=0).sqrt()
