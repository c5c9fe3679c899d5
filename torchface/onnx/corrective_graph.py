"""The marker solve of a rig with correctives with a fixed number of steps, as it goes into an ONNX graph."""

from __future__ import annotations

import copy
import math

import torch
from torch import Tensor, nn

from torchface.capture.markers.marker_solver import MarkerSolver, penalty_value
from torchface.correctives.activation import RoundedActivation
from torchface.errors import ShapeError, ValueRangeError
from torchface.onnx.solver_graph import NEWTON_SCALE
from torchface.optim.operator_splitting import RELAXATION, RHO

STEPS = 6
ROUNDED_STEPS, LINEAR_SPLITTING, SPLITTING = 2, 60, 40
LENGTHS = (1.0, 0.5, 0.15)
SMALLEST_DIAGONAL = 1e-6


class CorrectiveGraph(nn.Module):
    r"""``MarkerSolver`` of a rig with correctives as operators that ONNX has, in double precision inside.

    First the solve of the shapes alone, then Gauss-Newton's steps: each a quadratic program in the box by operator
    splitting, taken whole, by half or by less, whichever leaves the least energy. In the first two in-betweens are
    rounded, as in ``torchface.capture.corrective_energy``. A frame without a marker gives ``previous``.

    Args:
        solver: the exact solve, of a rig with correctives.
        steps: of Gauss-Newton.

    Raises:
        ValueRangeError: the rig has no correctives, which ``SolverGraph`` is for.
    """

    inputs: tuple[str, ...] = ("markers", "previous")

    rest: Tensor
    rows: Tensor
    identity: Tensor
    penalty: Tensor
    curvature: Tensor
    scale: Tensor
    rotation: Tensor
    translation: Tensor

    def __init__(self, solver: MarkerSolver, steps: int = STEPS) -> None:
        super().__init__()
        if solver.activation is None:
            raise ValueRangeError("corrective graph: found a rig without correctives, expected some; see SolverGraph")
        self.names, self.labels = solver.names, solver.labels
        self.steps = self.steps_with_gaps = steps
        self.rho = RHO
        self.sparsity, self.ridge = penalty_value(solver.sparsity), penalty_value(solver.ridge)
        self.activation = copy.deepcopy(solver.activation).double()
        self.rounded = RoundedActivation(self.activation) if len(self.activation.in_betweens) else self.activation
        shapes = len(solver.names)
        self.newton_steps = math.ceil(math.log2(16 * shapes / (NEWTON_SCALE * RHO)))
        given = solver.alignment
        for name, value in (
            ("rest", solver.rest.double()),
            ("rows", solver.every_basis.double().flatten(0, 1)),
            ("identity", torch.eye(shapes, dtype=torch.float64)),
            # Of the weights' own terms, the slope at zero and the second derivative.
            ("penalty", torch.full((1, shapes), self.sparsity).double()),
            ("curvature", torch.full((1, shapes), 2 * self.ridge).double()),
            ("scale", torch.ones(1).double() if given is None else given.scale.double()),
            ("rotation", torch.eye(3).double() if given is None else given.rotation[0].double()),
            ("translation", torch.zeros(3).double() if given is None else given.translation[0].double()),
        ):
            self.register_buffer(name, value)

    def forward(self, markers: Tensor, previous: Tensor) -> Tensor:
        """Weights in [0,1], (B,N), for markers (B,M,3), NaN for not seen, and the weights before, (B,N).

        Raises:
            ShapeError: the shapes do not fit.
        """
        self._check(markers, previous)
        return self._solved(markers, previous, self.penalty, self.curvature)

    def _check(self, markers: Tensor, previous: Tensor) -> None:
        if markers.shape[1:] != self.rest.shape or previous.shape[1:] != (len(self.names),):
            raise ShapeError(
                f"corrective graph: found markers {tuple(markers.shape)} and previous {tuple(previous.shape)}, "
                f"expected (B,{len(self.rest)},3) and (B,{len(self.names)})"
            )

    def _solved(self, markers: Tensor, previous: Tensor, penalty: Tensor, curvature: Tensor) -> Tensor:
        """With the weights' own terms as they are in each frame, (B,N) or (1,N)."""
        own = penalty, curvature
        missing = torch.isnan(markers).to(markers).amax(-1, keepdim=True)  # (B,M,1)
        placed = self.scale * (torch.where(missing > 0, 0.0, markers).double() @ self.rotation.T) + self.translation
        seen = 1 - missing.double()
        count = seen.sum((1, 2))[:, None]  # (B,1)
        mask = seen.expand(-1, -1, 3).flatten(1)  # (B,3M)
        offset = (self.rest - placed).flatten(1) * mask
        share = 2 / count.clamp(min=1)
        w = previous.double().clamp(0, 1)
        shapes = len(self.names)
        J = self.rows[:, :shapes].expand(len(w), -1, -1)
        residual = (offset + w @ self.rows[:, :shapes].T) * mask
        w = w + self._step(w, J, residual, mask, share, own, LINEAR_SPLITTING)
        for number in range(self.steps):
            activation = self.rounded if number < ROUNDED_STEPS else self.activation
            residual = (offset + torch.cat([w, activation(w)], 1) @ self.rows.T) * mask
            J = self.rows[:, :shapes] + self.rows[:, shapes:] @ activation.jacobian(w)
            step = self._step(w, J, residual, mask, share, own, SPLITTING)
            # The whole way to the least of the linear model may lead uphill: the best of some lengths.
            best, least = w, self._energy(w, offset, mask, share, own, activation)
            for length in LENGTHS:
                there = w + length * step
                value = self._energy(there, offset, mask, share, own, activation)
                best, least = torch.where(value < least, there, best), torch.minimum(value, least)
            w = best
        return torch.where(count > 0, w, previous.double().clamp(0, 1)).to(markers)

    def _energy(
        self,
        w: Tensor,
        offset: Tensor,
        mask: Tensor,
        share: Tensor,
        own: tuple[Tensor, Tensor],
        activation: nn.Module,
    ) -> Tensor:
        """(B,1)."""
        residual = (offset + torch.cat([w, activation(w)], 1) @ self.rows.T) * mask
        data = 0.5 * share * residual.square().sum(1, keepdim=True)
        return data + (w * (own[0] + 0.5 * own[1] * w)).sum(1, keepdim=True)

    def _step(
        self,
        w: Tensor,
        J: Tensor,
        residual: Tensor,
        mask: Tensor,
        share: Tensor,
        own: tuple[Tensor, Tensor],
        steps: int,
    ) -> Tensor:
        """From w to the least of the linearised energy in the box, (B,N); see ``SolverGraph`` for the splitting."""
        penalty, curvature = own
        H = share[..., None] * ((J * mask[..., None]).transpose(1, 2) @ J) + curvature[:, None] * self.identity
        slope = share * (residual[:, None] @ J)[:, 0] + penalty + curvature * w
        diagonal = (H * self.identity).sum(1, keepdim=True)
        diagonal = torch.maximum(diagonal, SMALLEST_DIAGONAL * diagonal.amax(2, keepdim=True)).clamp(min=1e-12)
        scale = diagonal.rsqrt()
        A = H * scale * scale.transpose(1, 2) + self.rho * self.identity
        X = NEWTON_SCALE * self.identity / A.square().sum((1, 2), keepdim=True).sqrt()
        for _ in range(self.newton_steps):  # each doubles the digits
            X = X @ (2 * self.identity - A @ X)
        inverse = -RELAXATION * (X * scale * scale.transpose(1, 2))
        minus_step = self.rho * diagonal.transpose(1, 2) * inverse + self.identity
        double_step = (2 - RELAXATION) * self.identity - 2 * minus_step
        z = v = here = w[:, None]
        constant = slope[:, None] @ inverse + here @ minus_step + (RELAXATION - 1) * here
        for _ in range(steps):  # each needs the one before
            v = constant + v @ minus_step + z @ double_step
            z = v.clamp(0.0, 1.0)
        return z[:, 0] - w


class HybridCorrectiveGraph(CorrectiveGraph):
    r"""``HybridSolver`` of a rig with correctives as operators that ONNX has.

    What a classifier predicts pulls the weights as a ridge about its predictions does, so the steps are those of
    ``CorrectiveGraph``. A frame without a marker gives ``previous``, whatever is predicted.
    """

    inputs = ("markers", "previous", "predicted", "gamma")

    def forward(  # type: ignore[override]
        self, markers: Tensor, previous: Tensor, predicted: Tensor, gamma: Tensor
    ) -> Tensor:
        r"""Weights in [0,1], (B,N).

        Args:
            markers, previous: as ``CorrectiveGraph`` takes them.
            predicted: :math:`\tilde w`, (B,N); looked at where :math:`\gamma > 0`.
            gamma: :math:`\gamma`, (B,N), mm² over all markers; zero for the markers alone.

        Raises:
            ShapeError: the shapes do not fit.
        """
        if predicted.shape != previous.shape or gamma.shape != previous.shape:
            raise ShapeError(
                f"hybrid graph: found predicted {tuple(predicted.shape)} and gamma {tuple(gamma.shape)}, expected "
                f"{tuple(previous.shape)}"
            )
        self._check(markers, previous)
        pull = (2 / len(self.labels)) * gamma.double()
        target = torch.where(gamma > 0, predicted.clamp(0.0, 1.0), 0.0).double()
        return self._solved(markers, previous, self.penalty - pull * target, self.curvature + pull)
