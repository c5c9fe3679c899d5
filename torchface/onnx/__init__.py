"""ONNX graphs of what torchface learns and solves."""

from torchface.onnx.action_unit_graph import ActionUnitReport, export_action_units
from torchface.onnx.checked_export import ExportReport
from torchface.onnx.dynamics_prior_graph import export_dynamics_prior
from torchface.onnx.enhancement_graph import export_wrinkle_weights
from torchface.onnx.example_graph_export import ExampleReport, export_example_solver
from torchface.onnx.model_export import export_model
from torchface.onnx.module_graph import export_module
from torchface.onnx.solver_graph import SolverGraph
from torchface.onnx.solver_graph_export import GraphSteps, SolverReport, export_solver
from torchface.onnx.video_graph import VideoGraph
from torchface.onnx.video_graph_export import VideoReport, export_video_solver

__all__ = [
    "ActionUnitReport",
    "ExampleReport",
    "ExportReport",
    "GraphSteps",
    "SolverGraph",
    "SolverReport",
    "VideoGraph",
    "VideoReport",
    "export_action_units",
    "export_dynamics_prior",
    "export_example_solver",
    "export_model",
    "export_module",
    "export_solver",
    "export_video_solver",
    "export_wrinkle_weights",
]
