"""``ExampleSolver`` as a module that an ONNX model is exported of."""

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field

import onnx
import torch
from torch import Tensor, nn

from torchface.capture.anybody import AllAtOnce, ExampleSolver, LandmarkModel, Regional
from torchface.capture.anybody.examples.example_methods import SquaredDistances
from torchface.capture.anybody.examples.example_shapes import EYE_CORNERS
from torchface.capture.anybody.examples.landmark_equations import LandmarkEquations
from torchface.capture.energy import Quadratic
from torchface.onnx.exported_model import exported_model
from torchface.optim.fixed_splitting import FixedSplitting, newton_inverse

STEPS = 168
"""Of splitting; every frame has a matrix of its own, and few landmarks or shapes nearly alike make a bad one."""

_RHO, _DOUBLINGS = 1e-7, 28  # of the inverse for a landmark model's coefficients, of a matrix with a unit diagonal


@dataclass(frozen=True)
class _SplitSquares(SquaredDistances):
    """Squared distances whose least is found by a fixed number of steps."""

    program: FixedSplitting = field(default_factory=FixedSplitting)

    def solved(self, energy: Quadratic, initial: Tensor | None) -> Tensor:
        return self.program(energy.f, energy.H, initial).to(energy.f)


class ExampleGraph(nn.Module):
    """Weights of examples by splitting with fixed steps, all frames together."""

    neutral: Tensor
    basis: Tensor
    method: LandmarkModel | Regional | AllAtOnce

    def __init__(self, solver: ExampleSolver, steps: int | None = None) -> None:
        super().__init__()
        steps = STEPS if steps is None else steps
        self.placement, self.regions, method = solver.placement, solver.regions, solver.method
        self.register_buffer("neutral", solver.neutral.detach().double().cpu())
        self.register_buffer("basis", solver.basis.detach().double().cpu())
        if isinstance(method, LandmarkModel):
            self.method = copy.deepcopy(method).double()
            onto = self._onto(method)
            H = onto.T @ (method.components.flatten(0, 1).T @ self.basis.flatten(0, 1))
            self.program = FixedSplitting(H + 2 * method.ridge * torch.eye(len(H)), steps=steps)
        else:
            objective = getattr(method, "objective")  # noqa: B009
            split = _SplitSquares(objective.sparsity, objective.ridge, FixedSplitting(steps=steps))
            self.method = Regional(split) if isinstance(method, Regional) else AllAtOnce(split)

    def forward(self, landmarks: Tensor, previous: Tensor) -> dict[str, Tensor]:
        """``weights`` and ``carried`` (B,N) of ``landmarks`` (B,68,2), NaN where not seen, from ``previous`` (B,N)."""
        at = self.placement.equations(landmarks.double(), self.neutral, self.basis)
        if isinstance(self.method, LandmarkModel):
            weights = self._of_model(self.method, at, previous.double())
        else:
            weights = self.method.solve(at, self.regions, previous.double()).weights
        return {"weights": weights.float(), "carried": weights.float().clone()}

    def _of_model(self, model: LandmarkModel, at: LandmarkEquations, previous: Tensor) -> Tensor:
        """See :meth:`torchface.capture.anybody.LandmarkModel.solve`; its system is scaled to a unit diagonal."""
        eyes = (self.neutral[EYE_CORNERS[0]] - self.neutral[EYE_CORNERS[1]]).norm()
        squares = at.of_model(model.mean, model.components, eyes)
        energy = squares.least_squares().energy
        count = squares.seen.sum(1).clamp(min=1)[:, None]
        identity = torch.eye(energy.f.shape[-1]).double()
        H = energy.H + identity * (2 * (model.noise**2 / (model.variances + 1e-300)) / count)[..., None]
        scale = (H * identity).sum(1).rsqrt()  # (B,K)
        inverse = newton_inverse(H * scale[:, :, None] * scale[:, None], _RHO, _DOUBLINGS)
        coefficients = -scale * (inverse @ (scale * energy.f)[..., None])[..., 0]
        start = model.components.flatten(0, 1).T @ (self.neutral - model.mean).flatten()
        return self.program((start - coefficients) @ self._onto(model) + model.sparsity, start=previous)

    def _onto(self, model: LandmarkModel) -> Tensor:
        """What turns coefficients into the program's f, (K,N)."""
        eyes = (self.neutral[EYE_CORNERS[0]] - self.neutral[EYE_CORNERS[1]]).norm()
        return (2 / (68 * eyes**2)) * (model.components.flatten(0, 1).T @ self.basis.flatten(0, 1))


def example_model(
    solver: ExampleSolver, steps: int | None = None, facts: Mapping[str, object] | None = None
) -> onnx.ModelProto:
    """The solver as ONNX: ``landmarks`` (B,68,2) and ``previous`` (B,N) to ``weights`` and ``carried`` (B,N)."""
    metadata = {
        "task": "example_solver",
        "shape_names": list(solver.names),
        "units": "pixels",
        "method": type(solver.method).__name__,
        "placement": type(solver.placement).__name__,
        "steps": STEPS if steps is None else steps,
        **(facts or {}),
    }
    inputs = {
        "landmarks": solver.neutral.detach().float().cpu().expand(2, -1, -1).clone(),
        "previous": torch.zeros(2, len(solver.names)),
    }
    sizes = dict.fromkeys(inputs, ("batch",))
    return exported_model(ExampleGraph(solver, steps), inputs, ["weights", "carried"], metadata, sizes)
