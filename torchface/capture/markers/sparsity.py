"""Marker solvers with another weight of the L1 penalty."""

from __future__ import annotations

import copy

from torchface.capture.markers.marker_solver import MarkerSolver


def with_sparsity(solver: MarkerSolver, sparsity: float) -> MarkerSolver:
    """The same solver with another sparsity."""
    other = copy.copy(solver)
    # A learned sparsity of the solver is a parameter or a buffer of its own, and stays with it.
    other._parameters = {name: value for name, value in solver._parameters.items() if name != "sparsity"}
    other._buffers = {name: value for name, value in solver._buffers.items() if name != "sparsity"}
    other.sparsity = float(sparsity)
    other.regularization(solver.rest)
    return other
