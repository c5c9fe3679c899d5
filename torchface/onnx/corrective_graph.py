"""The marker solve of a rig with correctives with a fixed number of steps: the module that goes into an ONNX graph."""

import copy
from dataclasses import replace

import torch
from torch import Tensor, nn

from torchface.capture.corrective_energy import CorrectiveEnergy
from torchface.capture.markers.marker_solver import MarkerSolver
from torchface.correctives.activation import RoundedActivation
from torchface.errors import ValueRangeError
from torchface.onnx.solver_graph import checked_markers, prediction_term
from torchface.optim.fixed_splitting import FixedSplitting, fixed_loop

STEPS = 6
_ROUNDED_STEPS, _LINEAR_SPLITTING, _SPLITTING = 2, 60, 60
_RHO, _LENGTHS = 0.06, (1.0, 0.5, 0.15)  # shapes that move markers nearly alike need a small rho, others a large one


class CorrectiveGraph(nn.Module):
    r"""``MarkerSolver`` and ``HybridSolver`` of a rig with correctives with a fixed number of steps, for a graph.

    First the solve of the shapes alone, then Gauss-Newton's steps: each a quadratic program in the box by operator
    splitting, taken whole, by half or by less, whichever leaves the least energy. In the first two in-betweens are
    rounded, as in ``torchface.capture.corrective_energy``. A frame without a marker gives ``previous``.
    """

    def __init__(self, solver: MarkerSolver, steps: int = STEPS) -> None:
        super().__init__()
        if solver.activation is None:
            raise ValueRangeError("corrective graph: found a rig without correctives, expected some; see SolverGraph")
        self.solver, self.steps, self.rho = copy.deepcopy(solver), (steps, steps), _RHO
        activation = copy.deepcopy(solver.activation)
        self.rounded = RoundedActivation(activation) if len(activation.in_betweens) else activation
        self.linear = FixedSplitting(steps=_LINEAR_SPLITTING)
        self.splitting = FixedSplitting(steps=_SPLITTING, rho=_RHO)

    def forward(
        self, markers: Tensor, previous: Tensor, predicted: Tensor | None = None, gamma: Tensor | None = None
    ) -> Tensor:
        """Weights in [0,1], (B,N); arguments and errors as of ``SolverGraph.forward``."""
        markers = checked_markers(self.solver, markers, previous, predicted, gamma)
        start, shapes = previous.double().clamp(0.0, 1.0), len(self.solver.names)
        energy = self.solver.energy(markers)
        assert isinstance(energy, CorrectiveEnergy)
        if predicted is not None and gamma is not None:
            energy = energy + prediction_term(predicted, gamma, len(self.solver.labels))
        H = energy.extended.H[..., :shapes, :shapes].expand(start.shape[0], -1, -1)
        w = self.linear(energy.extended.f[:, :shapes], H, start).to(start)
        rounded, first = replace(energy, activation=self.rounded), min(_ROUNDED_STEPS, self.steps[0])
        (w,) = fixed_loop(lambda w: (self._stepped(rounded, w),), first, (w,))
        (w,) = fixed_loop(lambda w: (self._stepped(energy, w),), self.steps[0] - first, (w,))
        missing = torch.isnan(markers).any(-1).all(1, keepdim=True)
        return torch.where(missing, start, w).to(torch.promote_types(markers.dtype, self.solver.rest.dtype))

    def _stepped(self, energy: CorrectiveEnergy, w: Tensor) -> Tensor:
        """The weights (B,N) after one step."""
        problem = energy.linearised(w)
        step = self.splitting(problem.f, problem.H, w).to(w) - w
        # The whole way to the least of the linear model may lead uphill: the best of some lengths.
        best, least = w, energy.value(w)
        for length in _LENGTHS:
            there = w + length * step
            value = energy.value(there)
            best, least = torch.where((value < least)[:, None], there, best), torch.minimum(value, least)
        return best
