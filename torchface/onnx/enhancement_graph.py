"""Weights of wrinkle maps as ONNX: of a rig's vertices, or of its blendshape weights."""

from __future__ import annotations

from collections.abc import Mapping
from functools import reduce
from operator import mul
from pathlib import Path

import onnx
import torch
from onnx import TensorProto
from torch import Tensor

from torchface import __version__
from torchface.correctives.activation import CorrectiveActivation
from torchface.enhancement.wrinkle_maps.wrinkle_weights import ROTATION_STEPS, RigWrinkles, WrinkleWeights
from torchface.onnx.checked_export import ExportReport, write_checked
from torchface.onnx.graph_values import OPSET, Value, ValueGraph

OUTPUT = "map_weights"
_PARITY = 1e-4


def export_wrinkle_weights(
    wrinkles: WrinkleWeights | RigWrinkles,
    poses: Tensor,
    path: str | Path,
    facts: Mapping[str, object] | None = None,
) -> ExportReport:
    """Writes the graph of a rig's wrinkle weights, and checks it.

    It takes ``vertices`` (B,V,3), millimetres, of the rig in any rigid place, or for ``RigWrinkles`` ``weights``
    (B,N), and gives ``map_weights`` (B,R,M) in [0,1]. The metadata holds ``regions`` and, for the latter, ``shapes``,
    as JSON.

    Args:
        wrinkles: what to write.
        poses: to check it with, vertices (T,V,3) or weights (T,N).
        path: the file to write.
        facts: further metadata, such as names of the maps.

    Raises:
        ValueRangeError: ONNX Runtime and PyTorch differ; nothing is written.
    """
    name = "weights" if isinstance(wrinkles, RigWrinkles) else "vertices"
    graph = wrinkle_weights_model(wrinkles, facts)
    with torch.no_grad():
        cases = [({name: some}, {OUTPUT: wrinkles(some)}) for some in (poses[:1], poses)]
    return write_checked(graph, path, cases, {OUTPUT: _PARITY}, {OUTPUT: "of the range"})


def wrinkle_weights_model(
    wrinkles: WrinkleWeights | RigWrinkles, facts: Mapping[str, object] | None = None
) -> onnx.ModelProto:
    """The graph: products of few small matrices."""
    graph = ValueGraph()
    size: tuple[int | str, ...]
    if isinstance(wrinkles, RigWrinkles):
        learned, name, size = wrinkles.wrinkles, "weights", ("batch", len(wrinkles.names))
        told: dict[str, object] = {"units": "weights in [0,1]", "shapes": list(wrinkles.names)}
        moments = _of_weights(graph, wrinkles)
    else:
        learned, name, size = wrinkles, "vertices", ("batch", wrinkles.vertex_count, 3)
        told = {"units": "millimetres"}
        near = graph.op("Gather", graph.value(name), learned.sites.tolist(), axis=1) - learned.neutral
        moments = graph.op("MatMul", learned.rows, near - near.rows(0, 1, axis=1))
    graph.build.op("Identity", _map_weights(graph, learned, moments).name, output=OUTPUT)
    regions, _, maps = learned.coefficients.shape
    about = {"task": "wrinkle_weights", "version": __version__, "regions": list(learned.region_names)}
    return graph.root.model(
        "wrinkle_weights", {name: size}, {OUTPUT: ("batch", regions, maps)}, {**about, **told, **(facts or {})}, OPSET
    )


def _of_weights(graph: ValueGraph, wrinkles: RigWrinkles) -> Value:
    """The moments (B,3+3Rq,3) of blendshape weights."""
    weights = graph.value("weights")
    change = graph.op("MatMul", weights, wrinkles.moved)
    if wrinkles.activation is not None and wrinkles.corrected is not None:
        activations, order = _activations(graph, weights, wrinkles.activation)
        change = change + graph.op("MatMul", activations, wrinkles.corrected[order])
    return change.shaped(0, -1, 3)


def _activations(graph: ValueGraph, weights: Value, activation: CorrectiveActivation) -> tuple[Value, list[int]]:
    """How far correctives are on, (B,C), and which each column is of: combinations first, then in-betweens."""
    between = activation.in_betweens.tolist()
    products = [row for row in range(len(activation.drivers)) if row not in between]
    found = []
    if products:
        # A driver that a combination lacks is a column of ones after the weights.
        padded = graph.cat(weights, weights.rows(0, 1, axis=1) * 0.0 + 1.0, axis=1)
        columns = activation.drivers[products].unbind(1)
        found.append(reduce(mul, (graph.op("Gather", padded, column.tolist(), axis=1) for column in columns)))
    if between:
        own = graph.op("Gather", weights, activation.drivers[between, 0].tolist(), axis=1)
        low, peak, high = activation.knots.float().unbind(1)
        rising, falling = (own - low) / (peak - low), (own - high) / (peak - high)
        found.append(rising.least(falling).most(0.0))
    return graph.cat(*found, axis=1), [*products, *between]


def _map_weights(graph: ValueGraph, learned: WrinkleWeights, moments: Value) -> Value:
    """The weights (B,R,M) of moments, as ``WrinkleWeights.of_moments``."""
    regions, _, components = learned.centers.shape
    turn = _nearest_rotation(graph, moments.rows(0, 3, axis=1) + learned.resting[:3])
    beyond = (turn - _double(graph, torch.eye(3))).number().shaped(-1, 1, 9)
    moved = moments.rows(3, len(learned.resting), axis=1).shaped(-1, regions * components, 9)
    still = learned.resting[3:].reshape(1, regions * components, 9)
    sums = (moved * torch.eye(3).flatten() + (moved + still) * beyond).reduced("ReduceSum", -1)
    scores = graph.op("Transpose", sums.shaped(-1, regions, components), perm=[1, 0, 2])
    squares = (scores * scores).reduced("ReduceSum", -1, keep=True)
    others = learned.centers.square().sum(-1)[:, None]
    apart = (squares + others - 2.0 * graph.op("MatMul", scores, learned.centers.transpose(1, 2))).most(0.0)
    kernels = graph.op("Exp", apart * -learned.sharpness)
    value = graph.op("MatMul", scores, learned.linear) + graph.op("MatMul", kernels, learned.coefficients)
    bounded = (value + (learned.bias - learned.value_at_rest)).most(0.0).least(1.0)
    return graph.op("Transpose", bounded, perm=[1, 0, 2])


def _nearest_rotation(graph: ValueGraph, matrices: Value) -> Value:
    """In double precision, (B,3,3)."""
    x = graph.op("Cast", matrices, to=TensorProto.DOUBLE)
    size = graph.op("ReduceSum", x * x, [1, 2], keepdims=1)
    x = x / graph.op("Sqrt", size * _double(graph, torch.tensor([1 / 3])))
    half, more = _double(graph, torch.tensor([0.5])), _double(graph, torch.tensor([1.5]))
    for _ in range(ROTATION_STEPS):
        product = graph.op("MatMul", graph.op("MatMul", x, graph.op("Transpose", x, perm=[0, 2, 1])), x)
        x = x * more - product * half
    return x


def _double(graph: ValueGraph, value: Tensor) -> Value:
    return graph.op("Cast", value, to=TensorProto.DOUBLE)
