"""A landmark network as ONNX: crops of faces to landmarks, their deviation, visibility and presence."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import onnx
import torch

from torchface import __version__
from torchface.landmarks.images.networks.heat_maps import cell_places
from torchface.landmarks.images.networks.landmark_network import DEVIATION_RANGE, LandmarkNetwork
from torchface.onnx.checked_export import ExportReport, write_checked
from torchface.onnx.graph_builder import GraphBuilder
from torchface.onnx.network_nodes import convolution, crop_cases, doubled, folded, heat_points, layers, with_context

_PARITY = {"landmarks": 0.1, "deviation": 0.1, "visibility": 0.01, "presence": 0.01}
_UNITS = {"landmarks": "pixels", "deviation": "pixels", "visibility": "of 1", "presence": "of 1"}


def export_landmark_network(
    model: LandmarkNetwork, path: str | Path, facts: Mapping[str, object] | None = None
) -> ExportReport:
    """Writes a landmark network as ONNX, its weights in half precision, and checks it.

    The graph takes ``image`` (B,3,S,S) in [0,1], red first: faces' boxes enlarged by the metadata's ``crop`` and
    turned upright. It gives ``landmarks`` (B,68,2) and ``deviation`` (B,68), pixels of the crop, ``visibility`` (B,68)
    and ``presence`` (B,) in [0,1].

    Args:
        model: what to export.
        path: the file to write.
        facts: further metadata, such as licence and data.

    Raises:
        ValueRangeError: ONNX Runtime and PyTorch differ; nothing is written.
    """
    model = model.eval()
    cases = crop_cases(model, "image", (model.size, model.size), (1, 3))
    return write_checked(landmark_network_model(model, facts), path, cases, _PARITY, _UNITS)


def landmark_network_model(model: LandmarkNetwork, facts: Mapping[str, object] | None = None) -> onnx.ModelProto:
    """The graph.

    Built node by node: it takes milliseconds, where ``torch.export`` takes seconds, so that every start of a tracker
    can afford it.
    """
    build = GraphBuilder()
    landmark_network_nodes(build, model, "image")
    return build.model(
        "landmark_network",
        {"image": ("batch", 3, model.size, model.size)},
        {
            "landmarks": ("batch", 68, 2),
            "deviation": ("batch", 68),
            "visibility": ("batch", 68),
            "presence": ("batch",),
        },
        {
            "task": "landmark_network",
            "landmarks": "iBUG 68",
            "image": "red, green, blue, 0 to 1",
            "crop": str(model.margin),
            "units": "pixels of the crop",
            "version": __version__,
            **(facts or {}),
        },
    )


def landmark_network_nodes(
    build: GraphBuilder, model: LandmarkNetwork, image: str, prefix: str = ""
) -> tuple[str, str, str, str]:
    """The nodes of the network, batch normalisations folded into the convolutions before them.

    Args:
        build: the graph that they become part of.
        model: the network.
        image: crops (B,3,S,S) in [0,1], red first.
        prefix: of the names of what they give.

    Returns:
        Names of landmarks, deviation, visibility and presence.
    """
    net = folded(model, LandmarkNetwork.from_config(model.config))
    op, constant = build.op, build.constant
    centred = op("Sub", op("Mul", image, constant("two", 2.0)), constant("one", 1.0))
    quarter = layers(build, net.quarter, layers(build, net.stem, centred))
    eighth = layers(build, net.eighth, quarter)
    deep = layers(build, net.sixteenth, eighth)
    pooled = op("GlobalAveragePool", deep)
    deep = with_context(build, net.context, pooled, deep)
    eighth = op("Add", doubled(build, convolution(build, net.up_eighth, deep)), eighth)
    eighth = layers(build, net.mix_eighth, eighth)
    below = doubled(build, convolution(build, net.up_quarter, eighth))
    features = layers(build, net.mix_quarter, op("Add", below, convolution(build, net.skip_quarter, quarter)))
    places = cell_places(torch.zeros(1, 1, model.size // 4, model.size // 4), 4)
    _, spread, under = heat_points(build, net.heat, features, places, output=f"{prefix}landmarks")
    spread = op("Add", spread, "one")
    told = [
        op("Add", op("ReduceSum", op("Mul", under, build.weight(net.local[..., i])), "last", keepdims=0),
           constant(f"bias{i}", net.local_bias[:, i]))
        for i in range(2)
    ]  # fmt: skip
    deviation = op("Exp", op("Add", told[0], op("Mul", op("Log", spread), constant("quarter", 0.25))))
    least, most = (constant(f"limit{i}", value) for i, value in enumerate(DEVIATION_RANGE))
    op("Clip", deviation, least, most, output=f"{prefix}deviation")
    op("Sigmoid", told[1], output=f"{prefix}visibility")
    flat = op("Reshape", pooled, constant("flat", (0, -1)))
    logit = op("Add", op("MatMul", flat, build.weight(net.presence.weight.T)), constant("there", net.presence.bias))
    op("Reshape", op("Sigmoid", logit), constant("faces", (-1,)), output=f"{prefix}presence")
    return f"{prefix}landmarks", f"{prefix}deviation", f"{prefix}visibility", f"{prefix}presence"
