"""The hybrid solve with a fixed number of steps, as it goes into an ONNX graph."""

from __future__ import annotations

import torch
from torch import Tensor

from torchface.errors import ShapeError
from torchface.onnx.solver_graph import SolverGraph


class HybridGraph(SolverGraph):
    r"""``HybridSolver`` as matrix products and clamps alone.

    A frame's :math:`\gamma` changes its H; its inverse is made as for missing markers. (One H with the greatest
    :math:`\gamma` throughout, and targets :math:`(\gamma \tilde w + (\gamma_{max} - \gamma) w) / \gamma_{max}`, has the
    same optimum, but shapes that markers hardly see then take hundreds of steps where :math:`\gamma` is small.)
    Batches with neither gaps nor :math:`\gamma` take the one H of ``SolverGraph``.

    Source: thesis 4.1.8, equation 38.

    Example:
        >>> from torchface import zoo
        >>> solver = zoo.get_model("marker_solver")
        >>> still = solver.points(torch.zeros(1, len(solver.names))).float()
        >>> none = torch.zeros(1, len(solver.names)).float()
        >>> bool(HybridGraph(solver)(still, none, none, none).max() < 0.01)
        True
    """

    inputs = ("markers", "previous", "predicted", "gamma")

    def forward(  # type: ignore[override]
        self, markers: Tensor, previous: Tensor, predicted: Tensor, gamma: Tensor
    ) -> Tensor:
        r"""Weights for markers and predictions.

        Args:
            markers: (B,M,3), millimetres; NaN for not seen.
            previous: the weights of the frame before, (B,N); zeros where there is none.
            predicted: :math:`\tilde w`, (B,N); looked at where :math:`\gamma > 0`.
            gamma: :math:`\gamma`, (B,N), mm² over all markers; zero for the markers alone.

        Returns:
            Weights in [0,1], (B,N).

        Raises:
            ShapeError: the shapes do not fit.
        """
        if predicted.shape != previous.shape or gamma.shape != previous.shape:
            raise ShapeError(
                f"hybrid graph: found predicted {tuple(predicted.shape)} and gamma {tuple(gamma.shape)}, expected "
                f"{tuple(previous.shape)}"
            )
        led = gamma > 0
        compiles = torch.compiler.is_compiling()
        if not compiles and not bool(led.any()):
            alone: Tensor = super().forward(markers, previous)
            return alone
        offset = self.rest - markers
        missing = torch.isnan(offset).any(-1, keepdim=True)
        target = torch.where(led, predicted.to(offset).clamp(0.0, 1.0), 0.0)
        given = offset, missing, previous.to(offset).clamp(0.0, 1.0), gamma * (2 / len(self.labels)), target
        if compiles:  # a graph has both ways; here a call takes one
            return torch.cond(led.any() | missing.any(), self._with_gaps, self._complete, given)
        return self._with_gaps(*given)
