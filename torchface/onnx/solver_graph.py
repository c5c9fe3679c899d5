"""The marker solve with a fixed number of steps: the module that goes into an ONNX graph."""

import copy

import torch
from torch import Tensor, nn

from torchface.capture import MarkerSolver
from torchface.capture.energy import Quadratic, pull_term
from torchface.errors import ShapeError, ValueRangeError
from torchface.optim import FixedSplitting, ProjectedGradient
from torchface.optim.full_precision import full_precision

Program = FixedSplitting | ProjectedGradient

STEPS_WITH_GAPS = 96


class SolverGraph(nn.Module):
    r"""``MarkerSolver`` and ``HybridSolver`` with a fixed number of steps, for a graph.

    Batches in which every marker is seen share one H, which is factored beforehand. Where a marker is missing, or a
    prediction counts, each frame has an H of its own. A frame without a marker gives ``previous``.

    Args:
        solver: the exact solve, of a rig without correctives; see ``torchface.onnx.corrective_graph`` for others.
        complete: solves box QPs of ``solver.complete_hessian()``; ``FixedSplitting`` if absent.
        with_gaps: solves those that bring their H; ``FixedSplitting`` with 96 steps if absent.

    Raises:
        ValueRangeError: the rig has correctives.

    Source: thesis 4.1.4 and 4.1.8.

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

    def __init__(self, solver: MarkerSolver, complete: Program | None = None, with_gaps: Program | None = None) -> None:
        super().__init__()
        if solver.activation is not None:
            raise ValueRangeError(
                "solver graph: found a rig with correctives, expected none; see torchface.onnx.corrective_graph"
            )
        self.solver = copy.deepcopy(solver)
        self.complete = complete or FixedSplitting(self.solver.complete_hessian().detach())
        self.with_gaps = with_gaps or FixedSplitting(steps=STEPS_WITH_GAPS)

    @property
    def steps(self) -> tuple[int, int]:
        """Of complete batches, and of those with gaps."""
        return self.complete.steps, self.with_gaps.steps

    @property
    def rho(self) -> float | None:
        """Of the splitting's metric."""
        return self.complete.rho if isinstance(self.complete, FixedSplitting) else None

    @full_precision
    def forward(
        self, markers: Tensor, previous: Tensor, predicted: Tensor | None = None, gamma: Tensor | None = None
    ) -> Tensor:
        r"""Weights for markers, and for predictions where there are any.

        Args:
            markers: (B,M,3), millimetres, in the order of the solver's labels; NaN or infinity for not seen.
            previous: the weights of the frame before, (B,N); zeros where there is none.
            predicted: :math:`\tilde w`, (B,N); looked at where :math:`\gamma > 0`.
            gamma: :math:`\gamma`, (B,N), mm² over all markers; zero for the markers alone.

        Returns:
            Weights in [0,1], (B,N).

        Raises:
            ShapeError: the shapes do not fit.
        """
        markers = checked_markers(self.solver, markers, previous, predicted, gamma)
        start = previous.to(torch.promote_types(markers.dtype, self.solver.rest.dtype)).clamp(0.0, 1.0)
        missing = torch.isnan(markers).any(-1)
        own = missing.any()
        given: tuple[Tensor, ...] = (markers, start, missing)
        if predicted is not None and gamma is not None:
            own, given = own | (gamma > 0).any(), (*given, predicted, gamma)
        if torch.compiler.is_compiling():  # a graph has both ways; here a call takes one
            weights: Tensor = torch.cond(own, self._with_gaps, self._complete, given)
            return weights
        return (self._with_gaps if bool(own) else self._complete)(*given)

    def _complete(self, markers: Tensor, start: Tensor, *_: Tensor) -> Tensor:
        return self.complete(self.solver.complete_slope(markers), None, start.double()).to(start)

    def _with_gaps(self, markers: Tensor, start: Tensor, missing: Tensor, *prediction: Tensor) -> Tensor:
        energy = self.solver.energy(markers)
        assert isinstance(energy, Quadratic)
        if prediction:
            predicted, gamma = prediction
            energy = energy + prediction_term(predicted, gamma, len(self.solver.labels))
        H = energy.H.expand(start.shape[0], -1, -1)
        solved = self.with_gaps(energy.f, H, start.double()).to(start)
        return torch.where(missing.all(1, keepdim=True), start, solved)


def prediction_term(predicted: Tensor, gamma: Tensor, markers: int) -> Quadratic:
    r"""The pull of predictions (B,N), looked at where :math:`\gamma > 0`, of a solve with some markers."""
    target = torch.where(gamma > 0, predicted.clamp(0.0, 1.0), 0.0)
    return pull_term(target.double(), gamma.double() / markers)


def checked_markers(
    solver: MarkerSolver, markers: Tensor, previous: Tensor, predicted: Tensor | None, gamma: Tensor | None
) -> Tensor:
    """The markers, NaN where infinite; raises ``ShapeError`` for inputs of a graph that do not fit the solver."""
    for name, value in (("previous", previous), ("predicted", predicted), ("gamma", gamma)):
        if value is None:
            continue
        # Sizes one by one: to compare all at once, or lengths, would fix the size of the batch in a graph.
        fits = markers.shape[1:] == solver.rest.shape and value.shape[1:] == (len(solver.names),)
        if not fits or value.shape[0] != markers.shape[0]:
            raise ShapeError(
                f"solver graph: found markers {tuple(markers.shape)} and {name} {tuple(value.shape)}, "
                f"expected (B,{len(solver.rest)},3) and (B,{len(solver.names)})"
            )
    return torch.where(markers.isinf(), torch.nan, markers)
