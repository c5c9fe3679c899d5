"""A head model's decoder as ONNX: coefficients to vertices and colours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import onnx
import torch

from torchface import __version__
from torchface.modeling import HeadModel, MorphableModel
from torchface.onnx.checked_export import ExportReport, write_checked
from torchface.onnx.graph_builder import GraphBuilder

_PARITY = {"vertices": 1e-3, "colors": 1e-4}
_UNITS = {"vertices": "millimetres", "colors": "of the range"}


def export_head_decoder(model: HeadModel, path: str | Path, facts: Mapping[str, object] | None = None) -> ExportReport:
    """Writes a head model's decoder, and checks it.

    The graph takes ``shape`` (B,K) and, where the model knows colours, ``color`` (B,L), in standard deviations, and
    gives ``vertices`` (B,V,3), millimetres, and ``colors`` (B,V,3), clipped to [0,1]. The metadata holds ``triangles``
    and, where annotated, ``landmarks``, as JSON.

    Args:
        model: in float32.
        path: the file to write.
        facts: further metadata, such as licence and data.

    Raises:
        ValueRangeError: ONNX Runtime and PyTorch differ; nothing is written.
    """
    graph = head_decoder_model(model, facts)
    cases = []
    generator = torch.Generator().manual_seed(0)
    for batch in (1, 5):
        shape = model.shape.sample(batch, generator)
        color = None if model.color is None else model.color.sample(batch, generator)
        heads = model(shape, color)
        inputs, outputs = {"shape": shape}, {"vertices": heads.vertices}
        if color is not None and heads.colors is not None:
            inputs["color"], outputs["colors"] = color, heads.colors.clamp(0, 1)
        cases.append((inputs, outputs))
    names = list(cases[0][1])
    return write_checked(graph, path, cases, {n: _PARITY[n] for n in names}, {n: _UNITS[n] for n in names})


def head_decoder_model(model: HeadModel, facts: Mapping[str, object] | None = None) -> onnx.ModelProto:
    """The graph: a matrix product for shape, another for colour."""
    build = GraphBuilder()
    vertices = len(model.shape.mean)
    build.constant("table", (-1, vertices, 3))
    _decode(build, model.shape, "shape", "vertices")
    inputs: dict[str, Sequence[int | str]] = {"shape": ("batch", model.shape.count)}
    outputs: dict[str, Sequence[int | str]] = {"vertices": ("batch", vertices, 3)}
    if model.color is not None:
        build.constant("zero", 0.0)
        build.constant("one", 1.0)
        plain = _decode(build, model.color, "color", None)
        build.op("Clip", plain, "zero", "one", output="colors")
        inputs["color"], outputs["colors"] = ("batch", model.color.count), ("batch", vertices, 3)
    metadata = {
        "task": "head_decoder",
        "units": "millimetres",
        "coefficients": "standard deviations",
        "version": __version__,
        "triangles": model.faces.tolist(),
        **(facts or {}),
    }
    if model.landmarks is not None:
        metadata["landmarks"] = model.landmarks.tolist()
    return build.model("head_decoder", inputs, outputs, metadata)


def _decode(build: GraphBuilder, model: MorphableModel, given: str, output: str | None) -> str:
    modes = build.constant(f"{given}_modes", model.modes.flatten(1))
    mean = build.constant(f"{given}_mean", model.mean.flatten())
    return build.op("Reshape", build.op("Gemm", given, modes, mean), "table", output=output)
