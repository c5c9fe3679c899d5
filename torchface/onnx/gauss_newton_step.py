"""One Gauss-Newton step of the video solve in operators that ONNX has."""

from __future__ import annotations

import copy
from itertools import accumulate
from operator import mul

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from torchface.capture.own_rig.face_points import FacePoints
from torchface.capture.own_rig.reprojection import HeadState, linearise
from torchface.capture.own_rig.video_solver import VideoSolver
from torchface.capture.priors.student_groups import StudentGroups
from torchface.optim.exported_operators import split_box_program

_SLIDING_STEPS = 3
_SPLITTING_STEPS = 40
_RHO = 0.05
_TERMS = 24  # of a series; exact to 1e-7 for rotations of up to 90 degrees


class GaussNewtonStep(nn.Module):
    r"""Moves weights and pose to the least of the energy linearised where they are, weights in [0,1].

    The quadratic program is solved by a fixed number of steps of operator splitting. Contour landmarks slide, chosen
    anew in the first steps.

    Args:
        solver: the exact solve.

    Raises:
        ValueRangeError: the solver's prior is none of Student's distributions.

    Source: Boyd et al. 2011, 3.4.3 and 5.2, for the splitting.
    """

    rest: Tensor
    basis: Tensor
    rows: Tensor
    valid: Tensor
    side: Tensor
    intrinsics: Tensor
    identity: Tensor
    lower: Tensor
    upper: Tensor
    precisions: Tensor
    freedoms: Tensor
    sizes: Tensor
    series: Tensor
    corrective_basis: Tensor | None

    def __init__(self, solver: VideoSolver) -> None:
        super().__init__()
        self.settings, self.shapes = solver.settings, len(solver.names)
        self.strength = 1.0 if solver.prior is None else solver.prior.strength
        points = solver.points
        groups = StudentGroups.of(solver.prior, self.shapes, points.rest)
        # θ/sin θ in powers of sin²(θ/2): 1, 2/3, 8/15, ...
        series = accumulate((2 * k / (2 * k + 1) for k in range(1, _TERMS)), mul, initial=1.0)
        free = points.rest.new_full((6,), 1e9)
        for name, value in {
            "rest": points.rest,
            "basis": points.basis,
            "rows": points.rows,
            "valid": points.valid,
            "side": points.side,
            "intrinsics": solver.intrinsics.double(),
            "identity": torch.eye(self.shapes + 6).to(points.rest),
            "lower": torch.cat([free.new_zeros(self.shapes), -free]),
            "upper": torch.cat([free.new_ones(self.shapes), free]),
            "precisions": groups.precisions,
            "freedoms": groups.freedoms,
            "sizes": groups.sizes,
            "series": points.rest.new_tensor(list(series)),
        }.items():
            self.register_buffer(name, value)
        self.activation = copy.deepcopy(points.activation)
        self.register_buffer("corrective_basis", points.corrective_basis)

    @property
    def points(self) -> FacePoints:
        """Of the rig."""
        more = self.activation, self.corrective_basis
        return FacePoints(self.rest, self.basis, self.rows, self.valid, self.side, *more)

    def chosen(self, head: HeadState) -> Tensor:
        """Which point each landmark is, (1,68); see ``FacePoints.chosen``."""
        return self.points.chosen(head.weights, head.rotation, head.translation, self.intrinsics)

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
            given: what :meth:`data_terms` takes after the rows.
        """
        head = HeadState(weights, rotation, translation)
        slides = (iteration > 0) & (iteration < _SLIDING_STEPS)
        rows = torch.where(slides, self.chosen(head), rows)
        H, gradient = self.data_terms(head, rows, *given)
        prior_H, prior_gradient = self._prior_terms(weights[0])
        H, gradient = H + pad(prior_H, (0, 6, 0, 6)), gradient + pad(prior_gradient, (0, 6))
        motion, dual = self._box_program(weights[0], H, gradient, dual)
        head = head.moved(weights + motion[:, : self.shapes], motion[:, self.shapes :])
        settled = motion[:, : self.shapes].abs().max() < self.settings.tolerance
        return iteration + 1, settled, head.weights, head.rotation, head.translation, dual, rows

    def data_terms(
        self,
        head: HeadState,
        rows: Tensor,
        landmarks: Tensor,
        precision: Tensor,
        mean_weights: Tensor,
        mean_rotation: Tensor,
        mean_translation: Tensor,
        information: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Of landmarks and of the frames before: H (N+6,N+6), and the gradient (N+6,) at a state.

        Args:
            head: the state.
            rows: (1,68).
            landmarks, precision: as of ``linearise``, (1,68,2) and (1,68).
            mean_weights, mean_rotation, mean_translation: predicted from the frames before, as of the state.
            information: of that, (N+6,N+6).
        """
        at = linearise(self.points, head, rows, self.intrinsics, landmarks, precision, self.settings.contour_slide)
        J, r = at.jacobian[0].flatten(0, 1), at.residual[0].flatten()
        rotation = _rotation_between(mean_rotation[0], head.rotation[0], self.series)
        residual = torch.cat([(head.weights - mean_weights)[0], rotation, (head.translation - mean_translation)[0]])
        return J.T @ J + information, r @ J + information @ residual

    def _prior_terms(self, weights: Tensor) -> tuple[Tensor, Tensor]:
        """Of the shape prior, the L1 penalty and the ridge: H (N,N), and the gradient (N,) at weights (N,)."""
        H = 2 * self.settings.ridge * self.identity[: self.shapes, : self.shapes]
        if len(self.precisions):
            H = H + self.strength * StudentGroups(self.precisions, self.freedoms, self.sizes).bound(weights)
        return H, H @ weights + self.settings.sparsity

    def _box_program(self, weights: Tensor, H: Tensor, gradient: Tensor, dual: Tensor) -> tuple[Tensor, Tensor]:
        """By what weights and pose should move, (1,N+6), and the scaled dual there, (N+6,)."""
        here = pad(weights, (0, 6))
        z, dual = split_box_program(
            H, gradient, self.lower - here, self.upper - here, dual, self.identity, _RHO, _SPLITTING_STEPS
        )
        return z, pad(dual[: self.shapes], (0, 6))


def _rotation_between(start: Tensor, end: Tensor, series: Tensor) -> Tensor:
    """The vector (3,) of the rotation from one pose (3,3) to another; ONNX has no arc sine of float64."""
    turned = end @ start.T
    axis = 0.5 * torch.stack([turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]])
    half = (0.25 * (3 - (turned[0, 0] + turned[1, 1] + turned[2, 2]))).clamp(0, 0.6)
    return (half ** torch.arange(_TERMS, dtype=half.dtype, device=half.device) * series).sum() * axis
