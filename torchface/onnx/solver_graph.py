"""The marker solve with a fixed number of steps, as it goes into an ONNX graph."""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from torch import Tensor, nn

from torchface.capture.markers.marker_solver import MarkerSolver, penalty_value
from torchface.errors import ShapeError, ValueRangeError
from torchface.optim.box_problem import metric
from torchface.optim.operator_splitting import RELAXATION, RHO, prepare_splitting

STEPS = 66
STEPS_WITH_GAPS = 96
# Numbers below this share of the largest on the diagonal of H would overflow its scaling.
_SMALLEST_DIAGONAL = 1e-6
# Newton's iteration starts from this over a norm of A; below 2 it converges.
NEWTON_SCALE = 1.5
# Shares of the steps after which f is formed again from what the markers' distances are by then: early, so that what
# the first, rough f left behind in slow modes is gone at the end.
_FORMED_AGAIN = (0.09, 0.27)


class SolverGraph(nn.Module):
    r"""``MarkerSolver`` as matrix products and clamps alone.

    Frames in which every marker is seen share one H, factored here; a step of splitting is then

    .. math:: v' = c + z\,(2G + (2 - \alpha) I) - v\,G, \qquad z' = \mathrm{clip}(v', 0, 1)

    (see ``torchface.optim.operator_splitting``; with ``t = 2z - v`` written out a step is two products and a clamp).

    Missing markers give a frame an H of its own. Its inverse comes from Newton's iteration
    :math:`X' = X (2I - AX)`, :math:`A = H + \rho D` scaled to a unit diagonal, so that A's condition is at most about
    :math:`N / \rho` and a dozen products suffice. (To fill missing markers with where the current weights put them
    would keep the one H, but over-relaxed it can settle on a wrong point.) A frame without a marker gives ``previous``.

    In float32 a shape that moves the markers by hundredths of a millimetre drowns in the rounding of f when the markers
    are centimetres from rest. So the steps halt twice: from the gradient g at the weights w reached, made of short
    distances, :math:`f = g - Hw` gives :math:`c = -\alpha g (H + \rho D)^{-1} + w ((\alpha - 1) I - G)`, where nothing
    large cancels.

    Args:
        solver: the exact solve; its alignment is folded into the constants.
        steps: for batches in which every marker is seen.
        steps_with_gaps: for batches with missing markers.
        rho: the metric's :math:`\rho`; see ``choose_rho``.

    Source: thesis 4.1.4.

    Example:
        >>> from torchface import zoo
        >>> solver = zoo.get_model("marker_solver")
        >>> graph = SolverGraph(solver)
        >>> weights = torch.zeros(1, len(solver.names))
        >>> weights[0, solver.names.index("jawOpen")] = 0.5
        >>> found = graph(solver.points(weights).float(), torch.zeros_like(weights).float())
        >>> bool((found - weights).abs().max() < 0.01)
        True
    """

    inputs: tuple[str, ...] = ("markers", "previous")

    rest: Tensor
    rows: Tensor
    l1_penalty: Tensor
    step: Tensor
    double_step: Tensor
    offset: Tensor

    def __init__(
        self,
        solver: MarkerSolver,
        steps: int = STEPS,
        steps_with_gaps: int = STEPS_WITH_GAPS,
        rho: float = RHO,
    ) -> None:
        super().__init__()
        if solver.activation is not None:
            raise ValueRangeError(
                "solver graph: found a rig with correctives, expected none; see torchface.onnx.corrective_graph"
            )
        self.names, self.labels = solver.names, solver.labels
        self.steps, self.steps_with_gaps, self.rho = steps, steps_with_gaps, rho
        self.sparsity, self.ridge = penalty_value(solver.sparsity), penalty_value(solver.ridge)
        rest, basis = solver.rest.double(), solver.basis.double()
        scale = 1.0
        if solver.alignment is not None:
            # s R (b' - t) = b - (s R t + shift): the difference is in marker space, its rotation in the rows.
            rest = solver.alignment.inverse().apply(rest[None])[0]
            scale = float(solver.alignment.scale[0])
            basis = scale * (solver.alignment.rotation[0].to(basis).T @ basis)
        markers = len(rest)
        rows = (2.0 / markers) * basis.flatten(0, 1)
        # (2/M) B'B from the rows, whatever the scale between the two spaces.
        self.gram_scale = 0.5 * markers / scale**2
        H = self.gram_scale * (rows.T @ rows)
        H.diagonal().add_(2 * self.ridge)
        self.double_ridge = 2 * self.ridge
        factors = prepare_splitting(H, rho)
        self.smallest_diagonal = _SMALLEST_DIAGONAL * float(H.diagonal().max())
        # Each iteration doubles the digits once the smallest eigenvalue, rho over a norm of at most N, has come to 1.
        self.newton_steps = math.ceil(math.log2(16 * min(_norm(H) * 2, len(H)) / (NEWTON_SCALE * rho)))
        double_step = 2 * factors.step
        double_step.diagonal().add_(2 - RELAXATION)
        for name, value in (
            ("rest", rest),
            ("rows", rows),
            ("l1_penalty", torch.full_like(H[0], self.sparsity)),
            ("step", factors.step),
            ("double_step", double_step),
            ("offset", factors.offset),
        ):
            self.register_buffer(name, value.to(solver.rest.dtype))

    def forward(self, markers: Tensor, previous: Tensor) -> Tensor:
        """Weights for markers.

        Args:
            markers: (B,M,3), millimetres, in the order of ``labels``; NaN for not seen.
            previous: the weights of the frame before, (B,N); zeros where there is none.

        Returns:
            Weights in [0,1], (B,N).

        Raises:
            ShapeError: the shapes do not fit.
        """
        if markers.shape[1:] != self.rest.shape or previous.shape != (len(markers), len(self.names)):
            raise ShapeError(
                f"solver graph: found markers {tuple(markers.shape)} and previous {tuple(previous.shape)}, "
                f"expected (B,{len(self.rest)},3) and (B,{len(self.names)})"
            )
        offset = self.rest - markers
        missing = torch.isnan(offset).any(-1, keepdim=True)
        z = previous.to(offset).clamp(0.0, 1.0)
        if torch.compiler.is_compiling():  # a graph has both ways; here a call takes one
            return torch.cond(missing.any(), self._with_gaps, self._complete, (offset, missing, z))
        return (self._with_gaps if bool(missing.any()) else self._complete)(offset, missing, z)

    def _complete(
        self, offset: Tensor, missing: Tensor, z: Tensor, pull: Tensor | None = None, target: Tensor | None = None
    ) -> Tensor:
        """Frames that share one H: nothing of markers (B,M,3) is missing, nothing pulls."""
        offset = offset.flatten(1)
        v = z
        for steps in stretches(self.steps):
            constant = self._constant(offset, z)
            for _ in range(steps):
                v = torch.addmm(constant, v, -self.step)
                v = torch.addmm(v, z, self.double_step)
                z = v.clamp(0.0, 1.0)
        return z

    def _constant(self, offset: Tensor, w: Tensor) -> Tensor:
        """:math:`c` from the gradient at w."""
        # ``.T`` would be taken out of a compiled branch, which then has one tensor twice.
        distance = torch.addmm(offset, w, self.rows.t(), alpha=self.gram_scale)
        gradient = torch.addmm(self.l1_penalty, distance, self.rows) + self.double_ridge * w
        return torch.addmm(torch.addmm((RELAXATION - 1) * w, w, -self.step), gradient, self.offset)

    def _with_gaps(
        self, offset: Tensor, missing: Tensor, z: Tensor, pull: Tensor | None = None, target: Tensor | None = None
    ) -> Tensor:
        """Frames with an H of their own: markers (B,M,1) are missing, or weights are pulled (B,N) to targets (B,N)."""
        identity = torch.eye(len(self.names), dtype=z.dtype, device=z.device)
        seen = 1 - missing.to(offset)  # (B,M,1)
        visible = seen.mean(1, keepdim=True)  # (B,1,1)
        seen_offset = torch.where(missing, 0.0, offset).flatten(1)[:, None]  # (B,1,3M)
        seen = seen.expand_as(offset).flatten(1)[:, None]
        kept = seen.transpose(1, 2) * self.rows  # (B,3M,N)
        ridge = z.new_full((1, 1, len(self.names)), self.double_ridge)
        penalty = self.l1_penalty
        if pull is not None and target is not None:
            ridge, penalty = ridge + pull[:, None], penalty - (pull * target)[:, None]
        H = self.gram_scale * (kept.transpose(1, 2) @ self.rows) + (ridge * identity) * visible
        diagonal = (H * identity).sum(1, keepdim=True)  # (B,1,N)
        diagonal = diagonal.clamp(min=self.smallest_diagonal)
        scale = diagonal.rsqrt()
        A = H * scale * scale.transpose(1, 2) + self.rho * identity
        X = NEWTON_SCALE * identity / A.square().sum((1, 2), keepdim=True).sqrt()
        for _ in range(self.newton_steps):
            X = X @ (2 * identity - A @ X)
        offset = -RELAXATION * (X * scale * scale.transpose(1, 2))
        minus_step = self.rho * diagonal.transpose(1, 2) * offset + identity
        double_step = (2 - RELAXATION) * identity - 2 * (minus_step)
        z = v = z[:, None]
        for steps in stretches(self.steps_with_gaps):
            w = z
            distance = (seen_offset + self.gram_scale * (w @ self.rows.t())) * seen
            gradient = distance @ self.rows + visible * (penalty + ridge * w)
            constant = gradient @ offset + w @ minus_step + (RELAXATION - 1) * w
            for _ in range(steps):
                v = constant + v @ minus_step + z @ double_step
                z = v.clamp(0.0, 1.0)
        return z[:, 0]


def stretches(steps: int) -> list[int]:
    """The steps between one forming of f and the next."""
    marks = [0, *(round(fraction * steps) for fraction in _FORMED_AGAIN), steps]
    return [after - before for before, after in pairwise(marks)]


def _norm(H: Tensor) -> float:
    """Frobenius norm of H scaled to a unit diagonal."""
    scale = metric(H).rsqrt()
    return float((H * scale[:, None] * scale).norm())
