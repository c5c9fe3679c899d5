"""``ExampleSolver`` that solves for size, roll and place too, as an ONNX model of the module here."""

from __future__ import annotations

from collections.abc import Mapping

import onnx
import torch
from torch import Tensor, nn

from torchface import __version__
from torchface.capture.anybody import AllAtOnce, ExampleSolver, SolvedSimilarity, SquaredDistances
from torchface.errors import ValueRangeError
from torchface.onnx.exported_model import exported_model
from torchface.optim.fixed_splitting import FixedSplitting

STEPS = 96
"""Of splitting; every frame has a matrix of its own."""


class PlacedExamples(nn.Module):
    r"""Weights of examples, with the similarity eliminated from each frame's least squares.

    Its four columns (size, roll, place) are orthogonal over the landmarks that are seen, as these are centred first: so
    the best similarity of given weights is four divisions, and no system has to be solved.

    Args:
        solver: all shapes at once, squared distances, with the similarity solved for.
        steps: of splitting.

    Raises:
        ValueRangeError: it is another solver.
    """

    neutral: Tensor
    basis: Tensor
    pairs: Tensor
    ridge: Tensor

    def __init__(self, solver: ExampleSolver, steps: int = STEPS) -> None:
        super().__init__()
        method = solver.method
        objective = method.objective if isinstance(method, AllAtOnce) else method
        if not isinstance(objective, SquaredDistances):
            raise ValueRangeError(
                f"export examples: found {type(objective).__name__} with the similarity solved for, expected all "
                "shapes at once and squared distances; others have landmark boxes"
            )
        self.placement, self.program = SolvedSimilarity(), FixedSplitting(steps=steps)
        self.sparsity = objective.sparsity
        rows = solver.basis.detach().double().cpu().flatten(0, 1)
        self.register_buffer("neutral", solver.neutral.detach().double().cpu())
        self.register_buffer("basis", solver.basis.detach().double().cpu())
        self.register_buffer("pairs", (rows[:, :, None] * rows[:, None, :]).flatten(1))
        self.register_buffer("ridge", 2 * objective.ridge * torch.eye(rows.shape[1], dtype=torch.float64))

    def forward(self, landmarks: Tensor, previous: Tensor) -> dict[str, Tensor]:
        """``weights`` and ``carried`` (B,N) of ``landmarks`` (B,68,2), NaN where not seen, from ``previous`` (B,N)."""
        at = self.placement.equations(landmarks.double(), self.neutral, self.basis)
        shapes = self.basis.shape[-1]
        factor = (at.share[..., None] * at.scale[:, None].square()).flatten(1)  # (B,136)
        rows, offset, free = self.basis.flatten(0, 1), at.offset.flatten(1), at.free.flatten(1, 2)
        counted = 2 * factor[..., None] * free  # (B,136,4)
        size = (counted * free).sum(1).clamp(min=1e-30)
        cross = counted.transpose(1, 2) @ rows  # (B,4,N)
        pull = (counted * offset[..., None]).sum(1) / size
        H = 2 * (factor @ self.pairs).unflatten(1, (shapes, shapes))
        H = H - cross.transpose(1, 2) @ (cross / size[..., None]) + self.ridge
        f = 2 * ((factor * offset) @ rows) - (cross * pull[..., None]).sum(1) + self.sparsity
        weights = self.program(f, H, previous.double()).float()
        return {"weights": weights, "carried": weights.clone()}


def placed_example_model(
    solver: ExampleSolver, steps: int = STEPS, facts: Mapping[str, object] | None = None
) -> onnx.ModelProto:
    """The solver as ONNX: ``landmarks`` (B,68,2) and ``previous`` (B,N) to ``weights`` and ``carried`` (B,N)."""
    metadata = {
        "task": "example_solver",
        "shape_names": list(solver.names),
        "units": "pixels",
        "version": __version__,
        "method": type(solver.method).__name__,
        "placement": "solved similarity",
        "steps": [steps, steps],
        **(facts or {}),
    }
    inputs = {
        "landmarks": solver.neutral.detach().float().cpu().expand(2, -1, -1).clone(),
        "previous": torch.zeros(2, len(solver.names)),
    }
    module = PlacedExamples(solver, steps)
    return exported_model(module, inputs, ["weights", "carried"], metadata, dict.fromkeys(inputs, ("batch",)))
