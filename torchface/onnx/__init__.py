"""ONNX graphs of what torchface learns and solves."""

from torchface.onnx.solver import SolverGraph
from torchface.onnx.solver_export import SolverReport, export_solver

__all__ = ["SolverGraph", "SolverReport", "export_solver"]
