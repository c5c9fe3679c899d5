"""``ExampleSolver`` of squared distances, or of a landmark model, as a module that an ONNX model is exported of."""

import copy
from collections.abc import Mapping
from dataclasses import replace

import onnx
import torch
from torch import Tensor, nn

from torchface.capture.anybody import AllAtOnce, ExampleSolver, LandmarkModel, Regional, SolvedSimilarity
from torchface.capture.anybody.examples.example_methods import head_rows, regional_basis
from torchface.capture.anybody.examples.example_shapes import EYE_CORNERS
from torchface.capture.anybody.examples.expression_regions import HEAD, HEAD_LANDMARKS
from torchface.capture.anybody.examples.landmark_equations import LandmarkEquations
from torchface.errors import ValueRangeError
from torchface.onnx.exported_model import exported_model
from torchface.optim.fixed_splitting import FixedSplitting, newton_inverse

STEPS, REGIONAL_STEPS = 96, 168
"""Of splitting; every frame has a matrix of its own, and a region's few landmarks make a worse one."""

_RHO, _DOUBLINGS = 1e-7, 28  # of the inverse for a landmark model's coefficients, of a matrix with a unit diagonal


class ExampleGraph(nn.Module):
    r"""Weights of examples by splitting with fixed steps, all frames together.

    A similarity that is solved for is eliminated from each frame's least squares: its four columns (size, roll, place)
    are orthogonal over the landmarks that are seen, as these are centred first. So the best similarity of given weights
    is four divisions, and no system has to be solved.

    Args:
        solver: with landmark boxes, of squared distances or of a landmark model; or of squared distances all at once
            with the similarity solved for.
    """

    neutral: Tensor
    basis: Tensor
    head: Tensor
    others: Tensor
    order: Tensor
    rows: Tensor
    own: Tensor

    def __init__(self, solver: ExampleSolver, steps: int | None = None) -> None:
        super().__init__()
        method = solver.method
        _check(solver)
        steps = steps_of(solver) if steps is None else steps
        self.placement, self.program = solver.placement, FixedSplitting(steps=steps)
        self.register_buffer("neutral", solver.neutral.detach().double().cpu())
        self.register_buffer("basis", solver.basis.detach().double().cpu())
        self.regions = solver.regions if isinstance(method, Regional) else ()
        of_head = torch.tensor([region == HEAD for region in self.regions], dtype=torch.bool)
        self.register_buffer("head", of_head.nonzero()[:, 0])
        self.register_buffer("others", (~of_head).nonzero()[:, 0])
        self.register_buffer("rows", head_rows(self.basis))
        self.register_buffer(
            "own", regional_basis(self.basis, self.regions)[..., self.others] if self.regions else None
        )
        self.register_buffer("order", torch.cat([self.head, self.others]).argsort())
        objective = method if isinstance(method, LandmarkModel) else getattr(method, "objective")  # noqa: B009
        self.sparsity, self.ridge = objective.sparsity, objective.ridge
        self.model = None
        if isinstance(method, LandmarkModel):
            self.model = copy.deepcopy(method).double()
            onto = self._onto(method)
            H = onto.T @ (method.components.flatten(0, 1).T @ self.basis.flatten(0, 1))
            self.program = FixedSplitting(H + 2 * self.ridge * torch.eye(len(H)), steps=steps)

    def forward(self, landmarks: Tensor, previous: Tensor) -> dict[str, Tensor]:
        """``weights`` and ``carried`` (B,N) of ``landmarks`` (B,68,2), NaN where not seen, from ``previous`` (B,N)."""
        at = self.placement.equations(landmarks.double(), self.neutral, self.basis)
        previous = previous.double()
        if self.model is not None:
            weights = self._of_model(self.model, at, previous)
        elif self.regions:
            weights = self._of_regions(at, previous)
        else:
            weights = self._of_squares(at, previous)
        return {"weights": weights.float(), "carried": weights.float().clone()}

    def _of_squares(self, at: LandmarkEquations, previous: Tensor) -> Tensor:
        shapes, rows = at.basis.shape[-1], at.basis.flatten(0, 1)
        factor = (at.share[..., None] * at.scale[:, None].square()).flatten(1)  # (B,136)
        offset = at.offset.flatten(1)
        pairs = (rows[:, :, None] * rows[:, None, :]).flatten(1)
        H = 2 * (factor @ pairs).unflatten(1, (shapes, shapes)) + 2 * self.ridge * torch.eye(shapes).double()
        f = 2 * ((factor * offset) @ rows) + self.sparsity
        if isinstance(self.placement, SolvedSimilarity):
            free = at.free.flatten(1, 2)  # (B,136,4)
            counted = 2 * factor[..., None] * free
            size = (counted * free).sum(1).clamp(min=1e-30)
            cross = counted.transpose(1, 2) @ rows  # (B,4,N)
            pull = (counted * offset[..., None]).sum(1) / size
            H = H - cross.transpose(1, 2) @ (cross / size[..., None])
            f = f - (cross * pull[..., None]).sum(1)
        return self.program(f, H, previous)

    def _of_regions(self, at: LandmarkEquations, previous: Tensor) -> Tensor:
        """The head's shapes first; see :class:`torchface.capture.anybody.Regional`."""
        found = []
        if len(self.head):
            shown = (at.seen & self.rows).sum(1, keepdim=True) >= len(HEAD_LANDMARKS) // 2
            basis = self.basis.index_select(2, self.head)
            first = at.with_basis(basis).among(self.rows | ~shown)
            found.append(self._of_squares(first, previous.index_select(1, self.head)).to(self.basis))
            at = replace(at, offset=at.offset + (found[0] @ basis.flatten(0, 1).T).unflatten(1, (68, 2)))
        if len(self.others):
            rest = at.with_basis(self.own)
            found.append(self._of_squares(rest, previous.index_select(1, self.others)).to(self.basis))
        return torch.cat(found, dim=1).index_select(1, self.order)

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
        return self.program((start - coefficients) @ self._onto(model) + self.sparsity, start=previous)

    def _onto(self, model: LandmarkModel) -> Tensor:
        """What turns coefficients into the program's f, (K,N)."""
        eyes = (self.neutral[EYE_CORNERS[0]] - self.neutral[EYE_CORNERS[1]]).norm()
        return (2 / (68 * eyes**2)) * (model.components.flatten(0, 1).T @ self.basis.flatten(0, 1))


def _check(solver: ExampleSolver) -> None:
    if isinstance(solver.placement, SolvedSimilarity) and not isinstance(solver.method, AllAtOnce):
        raise ValueRangeError(
            f"export examples: found {type(solver.method).__name__} with the similarity solved for, expected all "
            "shapes at once; others have landmark boxes"
        )


def steps_of(solver: ExampleSolver) -> int:
    return REGIONAL_STEPS if isinstance(solver.method, Regional) else STEPS


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
        "steps": steps_of(solver) if steps is None else steps,
        **(facts or {}),
    }
    inputs = {
        "landmarks": solver.neutral.detach().float().cpu().expand(2, -1, -1).clone(),
        "previous": torch.zeros(2, len(solver.names)),
    }
    sizes = dict.fromkeys(inputs, ("batch",))
    return exported_model(ExampleGraph(solver, steps), inputs, ["weights", "carried"], metadata, sizes)
