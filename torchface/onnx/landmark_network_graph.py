"""A landmark network as ONNX: crops of faces to landmarks, their deviation, visibility and presence."""

from __future__ import annotations

import torch

from torchface.landmarks.images.folded_normalisation import without_normalisation
from torchface.landmarks.images.networks.heat_maps import cell_places
from torchface.landmarks.images.networks.landmark_network import DEVIATION_RANGE, LandmarkNetwork
from torchface.onnx.graph_builder import GraphBuilder
from torchface.onnx.network_nodes import convolution, doubled, heat_points, layers, with_context


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
    net = without_normalisation(model)
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
