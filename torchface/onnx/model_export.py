"""Any learned model that has a graph, written as ONNX."""

from collections.abc import Callable, Mapping
from pathlib import Path

from torch import nn

from torchface.capture import ActionUnitClassifier, DynamicsPrior, ExampleSolver, MarkerSolver, ShapePrior, VideoSolver
from torchface.errors import ValueRangeError
from torchface.landmarks import BoxNetwork, EyeNetwork, LandmarkNetwork, LandmarkTrees, UVLandmarkDetector
from torchface.landmarks.images.networks.part_network import PartNetwork
from torchface.modeling import ExpressionRegression, HeadModel
from torchface.onnx.action_unit_graph import ActionUnitReport, export_action_units
from torchface.onnx.checked_export import ExportReport
from torchface.onnx.dynamics_prior_graph import export_dynamics_prior
from torchface.onnx.example_graph_export import ExampleReport, export_example_solver
from torchface.onnx.expression_graph import export_expression_regression
from torchface.onnx.head_decoder_graph import export_head_decoder
from torchface.onnx.landmark_trees_graph import export_landmark_trees
from torchface.onnx.module_graph import export_module, export_shape_prior
from torchface.onnx.network_graphs import export_network
from torchface.onnx.solver_graph_export import SolverReport, export_marker_solver
from torchface.onnx.uv_landmark_graph import export_landmark_bank
from torchface.onnx.video_graph_export import VideoReport, write_video_solver

_Report = ExportReport | SolverReport | VideoReport | ExampleReport | ActionUnitReport
_EXPORTS: dict[type[nn.Module], Callable[..., _Report]] = {
    HeadModel: export_head_decoder,
    ExpressionRegression: export_expression_regression,
    UVLandmarkDetector: export_landmark_bank,
    LandmarkNetwork: export_network,
    EyeNetwork: export_network,
    PartNetwork: export_network,
    BoxNetwork: export_network,
    LandmarkTrees: export_landmark_trees,
    DynamicsPrior: export_dynamics_prior,
    ShapePrior: export_shape_prior,
    MarkerSolver: export_marker_solver,
    VideoSolver: write_video_solver,
    ExampleSolver: export_example_solver,
    ActionUnitClassifier: export_action_units,
}


def export_model(
    model: nn.Module, path: str | Path, facts: Mapping[str, object] | None = None
) -> ExportReport | SolverReport | VideoReport | ExampleReport | ActionUnitReport:
    """Writes a model as ONNX, and checks it against PyTorch.

    Args:
        model: of a class that ``torchface export`` names, or one with a method ``example_inputs``; see
            ``torchface.zoo.register``.
        path: the file to write; it appears only when it is complete and checked.
        facts: further metadata, such as licence and data.

    Raises:
        ValueRangeError: there is no graph for its class, or ONNX Runtime and PyTorch differ; nothing is written.

    Example:
        >>> from torchface import zoo
        >>> report = export_model(zoo.get_model("expressions"), "expressions.onnx", {"licence": "MIT"})
        >>> report.path.name, max(report.parity.values()) < 0.01
        ('expressions.onnx', True)
    """
    for kind, export in _EXPORTS.items():
        if isinstance(model, kind):
            return export(model, path, facts=facts)
    if example := getattr(model, "example_inputs", None):
        return export_module(model, example(), path, facts)
    elsewhere = "; `torchface export enhancement --model NAME --rig RIG --out DIR` writes graphs of an EnhancementModel"
    raise ValueRangeError(
        f"{path}: found no graph for {type(model).__name__}, expected one of "
        f"{', '.join(kind.__name__ for kind in _EXPORTS)}{elsewhere}"
    )
