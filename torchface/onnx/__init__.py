"""ONNX graphs of what torchface learns and solves."""

from torchface.onnx.action_units import ActionUnitReport, export_action_units
from torchface.onnx.checked import ExportReport
from torchface.onnx.dynamics_prior import export_dynamics_prior
from torchface.onnx.hybrid import HybridGraph
from torchface.onnx.model_export import export_model
from torchface.onnx.solver import SolverGraph
from torchface.onnx.solver_export import SolverReport, export_hybrid_solver, export_solver
from torchface.onnx.video_export import VideoReport, export_video_solver
from torchface.onnx.video_solver import VideoGraph

__all__ = [
    "ActionUnitReport",
    "ExportReport",
    "HybridGraph",
    "SolverGraph",
    "SolverReport",
    "VideoGraph",
    "VideoReport",
    "export_action_units",
    "export_dynamics_prior",
    "export_hybrid_solver",
    "export_model",
    "export_solver",
    "export_video_solver",
]
