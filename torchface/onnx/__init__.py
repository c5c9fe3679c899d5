"""ONNX graphs of what torchface learns and solves."""

from torchface.onnx.hybrid import HybridGraph
from torchface.onnx.solver import SolverGraph
from torchface.onnx.solver_export import SolverReport, export_hybrid_solver, export_solver

__all__ = ["HybridGraph", "SolverGraph", "SolverReport", "export_hybrid_solver", "export_solver"]
