"""One Gauss-Newton step of the video solve, with a fixed number of splitting's steps, as it goes into a loop."""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn

from torchface.capture.own_rig.frame_states import FrameTerms
from torchface.capture.own_rig.gauss_newton import SLIDING_STEPS, HeadState, split_step
from torchface.capture.own_rig.state_estimate import Expectation
from torchface.capture.own_rig.video_solver import VideoSolver

_SPLITTING_STEPS = 40


class GaussNewtonStep(nn.Module):
    r"""Moves weights and pose toward the least of ``VideoSolver.energy`` linearised where they are, weights in [0,1].

    Args:
        solver: the exact solve.

    Raises:
        ValueRangeError: the solver's prior is none of Student's distributions.
    """

    upper: Tensor

    def __init__(self, solver: VideoSolver) -> None:
        super().__init__()
        groups = None if solver.prior is None else solver.prior.prepared()
        self.solver = copy.deepcopy(solver).double()
        self.solver.prior, self.solver.dynamics = groups, None  # type: ignore[assignment]
        self.register_buffer("upper", self.solver.rest.new_ones(len(solver.names)))

    def forward(
        self,
        iteration: Tensor,
        settled: Tensor,
        weights: Tensor,
        rotation: Tensor,
        translation: Tensor,
        dual: Tensor,
        rows: Tensor,
        *given: Tensor,
    ) -> tuple[Tensor, ...]:
        """The next values of the first seven arguments.

        Args:
            iteration: from 0, ().
            settled: whether the last step moved no weight further than the tolerance, () bool.
            weights, rotation, translation: (1,N), (1,3,3), (1,3).
            dual: of the last program, (N+6,).
            rows: which point each landmark is, (1,68).
            given: tensors of :func:`frame_terms`.
        """
        head = HeadState(weights, rotation, translation)
        rows = torch.where((iteration > 0) & (iteration < SLIDING_STEPS), self.solver.chosen(head), rows)
        energy = self.solver.energy(frame_terms(*given), head, rows)
        after, dual = split_step(energy, head, self.upper, dual, _SPLITTING_STEPS)
        settled = (after.weights - weights).abs().max() < self.solver.settings.tolerance
        return iteration + 1, settled, after.weights, after.rotation, after.translation, dual, rows


def frame_terms(landmarks: Tensor, precision: Tensor, *expected: Tensor) -> FrameTerms:
    """The terms of one frame's energy; poses are not tracked.

    Args:
        landmarks, precision: as of ``FrameTerms``, (1,68,2) and (1,68).
        expected: mean weights, rotation and translation, (1,N), (1,3,3), (1,3), and the information, (1,N+6,N+6).
    """
    mean = HeadState(*expected[:3])
    return FrameTerms(landmarks, precision, mean.rotation, mean.translation, Expectation(mean, expected[3]))
