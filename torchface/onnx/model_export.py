"""Any learned model that has a graph, written as ONNX."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from torch import nn

from torchface.capture import ExampleSolver, MarkerSolver
from torchface.capture.own_rig import VideoSolver
from torchface.capture.priors import DynamicsPrior
from torchface.errors import ValueRangeError
from torchface.landmarks import BoxNetwork, LandmarkNetwork, LandmarkTrees, UVLandmarkDetector
from torchface.landmarks.images.networks.eye_network import EyeNetwork
from torchface.modeling import ExpressionRegression, HeadModel
from torchface.onnx.checked_export import ExportReport
from torchface.onnx.dynamics_prior_graph import export_dynamics_prior
from torchface.onnx.example_graph_export import ExampleReport, export_example_solver
from torchface.onnx.expression_graph import export_expression_regression
from torchface.onnx.head_decoder_graph import export_head_decoder
from torchface.onnx.landmark_trees_graph import export_landmark_trees
from torchface.onnx.network_graphs import export_network
from torchface.onnx.solver_graph_export import SolverReport, export_marker_solver
from torchface.onnx.uv_landmark_graph import export_landmark_bank
from torchface.onnx.video_graph_export import VideoReport, write_video_solver


def export_model(
    model: nn.Module, path: str | Path, facts: Mapping[str, object] | None = None
) -> ExportReport | SolverReport | VideoReport | ExampleReport:
    """Writes a model as ONNX, and checks it against PyTorch.

    Args:
        model: a ``HeadModel``, ``ExpressionRegression``, ``UVLandmarkDetector``, ``LandmarkNetwork``,
            ``EyeNetwork``, ``BoxNetwork``, ``LandmarkTrees``, ``DynamicsPrior``, ``MarkerSolver``, ``VideoSolver``
            or ``ExampleSolver``.
        path: the file to write; it appears only when it is complete and checked.
        facts: further metadata, such as licence and data.

    Raises:
        ValueRangeError: there is no graph for its class, or ONNX Runtime and PyTorch differ; nothing is written.

    Example:
        >>> from torchface import zoo
        >>> report = export_model(zoo.get_model("face_boxes"), "boxes.onnx", {"licence": "MIT"})
        >>> report.path.name, max(report.parity.values()) < 0.1
        ('boxes.onnx', True)
    """
    if isinstance(model, HeadModel):
        return export_head_decoder(model, path, facts)
    if isinstance(model, ExpressionRegression):
        return export_expression_regression(model, path, facts)
    if isinstance(model, UVLandmarkDetector):
        return export_landmark_bank(model, path, facts)
    if isinstance(model, LandmarkNetwork | EyeNetwork | BoxNetwork):
        return export_network(model, path, facts)
    if isinstance(model, LandmarkTrees):
        return export_landmark_trees(model, path, facts)
    if isinstance(model, DynamicsPrior):
        return export_dynamics_prior(model, path, facts)
    if isinstance(model, MarkerSolver):
        return export_marker_solver(model, path, facts=facts)
    if isinstance(model, VideoSolver):
        return write_video_solver(model, path, facts)
    if isinstance(model, ExampleSolver):
        return export_example_solver(model, path, facts=facts)
    raise ValueRangeError(
        f"{path}: found a {type(model).__name__}, expected a HeadModel, ExpressionRegression, UVLandmarkDetector, "
        "LandmarkNetwork, EyeNetwork, BoxNetwork, LandmarkTrees, DynamicsPrior, MarkerSolver, VideoSolver or "
        "ExampleSolver"
    )
