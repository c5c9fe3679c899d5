"""A dynamics prior as ONNX: the last frames' weights to mean and variance of the next."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import onnx
import torch
from torch import Tensor

from torchface import __version__
from torchface.capture.priors import DynamicsPrior
from torchface.onnx.checked_export import ExportReport, write_checked
from torchface.onnx.graph_builder import GraphBuilder

_PARITY = {"mean": 1e-4, "deviation": 1e-4}
_UNITS = {"mean": "of a weight of 1", "deviation": "of a weight of 1"}


def export_dynamics_prior(
    model: DynamicsPrior, path: str | Path, facts: Mapping[str, object] | None = None
) -> ExportReport:
    """Writes a dynamics prior, and checks it.

    The graph takes ``windows`` (B,J,N), the newest frame last, and gives ``mean`` (B,N) and ``deviation`` (B,N), the
    standard deviation of the next frame. The metadata holds ``shape_names``, ``window``, ``fps`` and ``input_noise``.

    Args:
        model: in float32.
        path: the file to write.
        facts: further metadata, such as licence and data.

    Raises:
        ValueRangeError: ONNX Runtime and PyTorch differ; nothing is written.
    """
    cases = []
    generator = torch.Generator().manual_seed(0)
    for batch in (1, 7):
        start = model.center + 0.2 * torch.randn(batch, 1, len(model.names), generator=generator)
        steps = 0.03 * torch.randn(batch, model.window, len(model.names), generator=generator)
        windows = (start + steps.cumsum(1)).clamp(model.limits[0], model.limits[1])
        mean, variance = model(windows)
        cases.append(({"windows": windows}, {"mean": mean, "deviation": variance.sqrt()}))
    return write_checked(dynamics_model(model, facts), path, cases, _PARITY, _UNITS)


def dynamics_model(model: DynamicsPrior, facts: Mapping[str, object] | None = None) -> onnx.ModelProto:
    """The graph; it computes what ``DynamicsPrior.forward`` does, step by step, all processes at once."""
    build = GraphBuilder()
    op = build.op
    processes, noise = model.processes, model.noise
    count, kinds = len(model.names), len(noise.own_coefficients)
    groups, _, inputs = processes.inducing.shape
    # The newest frame itself is the step's start.
    own = model.coefficients.clone()
    own[-1] += 1.0
    scale = model.target_scale * model.gain[model.group_index]
    members = torch.nn.functional.one_hot(model.group_index, groups).float().T
    constants: dict[str, Tensor | float] = {
        "center": model.center,
        "to_motion": model.basis.T,
        "feature_scale": model.feature_scale,
        "coefficients": own,
        "inverse_lengths": processes.inverse_lengths[:, None],
        "inducing": processes.inducing.transpose(1, 2),
        "inducing_lengths": processes.inducing.square().sum(-1)[:, None],
        "signal": processes.signal[:, None, None],
        "signal_row": processes.signal[:, None],
        "whitening": processes.whitening,
        "spread": processes.covariance_root,
        "weights": processes.weights * scale,
        "to_shapes": members * scale.square(),
        "rest": noise.rest_variance,
        "low": float(model.limits[0]),
        "high": float(model.limits[1]),
        "zero": 0.0,
        "two": 2.0,
        "half": -0.5,
    }
    for name, value in constants.items():
        build.constant(name, value)
    for name, ids in {
        "row": (-1, inputs),
        "frame_axis": (1,),
        "last_axis": (2,),
        "group_axis": (0,),
        "moving_row": (-1, kinds * count),
    }.items():
        build.constant(name, ids)
    motion = op("MatMul", "to_motion", op("Sub", "windows", "center"))
    features = op("Reshape", op("Div", motion, "feature_scale"), "row")
    scaled = op("Mul", features, "inverse_lengths")
    lengths = op("ReduceSum", op("Mul", scaled, scaled), "last_axis", keepdims=1)
    across = op("Mul", op("MatMul", scaled, "inducing"), "two")
    squared = op("Max", op("Sub", op("Add", lengths, "inducing_lengths"), across), "zero")
    near = op("Mul", op("Exp", op("Mul", squared, "half")), "signal")
    told = op("MatMul", near, "spread")
    known = op("MatMul", near, "whitening")
    left = op("Sub", "signal_row", op("ReduceSum", op("Mul", known, known), "last_axis", keepdims=0))
    unsure = op("Add", op("Max", left, "zero"), op("ReduceSum", op("Mul", told, told), "last_axis", keepdims=0))
    variance = op("Add", op("MatMul", op("Transpose", unsure, perm=[1, 0]), "to_shapes"), "rest")
    if kinds:
        # A window of one frame does not move. Slope and curvature of a constant are 0, so the centre may stay in.
        step = torch.zeros(1, model.window)
        step[0, -2:] = torch.tensor([-1.0, 1.0])
        build.constant("to_moving", torch.cat([model.basis.T[1:], step]))
        build.constant("own_share", noise.own_coefficients.flatten())
        build.constant("shared_share", (noise.group_coefficients * noise.scale.square()).flatten())
        build.constant("usual", noise.scale.square().flatten())
        build.constant("around", torch.block_diag(*[noise.group_average.T] * kinds))
        build.constant("to_noise", torch.eye(count).repeat(kinds, 1))
        moving = op("Reshape", op("MatMul", "to_moving", "windows"), "moving_row")
        energy = op("Mul", moving, moving)
        spread = op("MatMul", op("Div", energy, "usual"), "around")
        total = op("Add", op("Mul", energy, "own_share"), op("Mul", spread, "shared_share"))
        variance = op("Add", variance, op("MatMul", total, "to_noise"))
    op("Sqrt", variance, output="deviation")
    steps = op("ReduceSum", op("Mul", "windows", "coefficients"), "frame_axis", keepdims=0)
    added = op("ReduceSum", op("MatMul", told, "weights"), "group_axis", keepdims=0)
    op("Clip", op("Add", steps, added), "low", "high", output="mean")
    return build.model(
        "dynamics_prior",
        {"windows": ("batch", model.window, count)},
        {"mean": ("batch", count), "deviation": ("batch", count)},
        {
            "task": "dynamics_prior",
            "shape_names": list(model.names),
            "window": model.window,
            "fps": model.fps,
            "input_noise": model.input_noise,
            "units": "weights, 1 is the whole shape",
            "version": __version__,
            **(facts or {}),
        },
    )
