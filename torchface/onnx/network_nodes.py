"""The nodes of small convolutional networks in ONNX graphs that are built node by node."""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import torch
from torch import Tensor, nn

from torchface.landmarks.images.networks.heat_maps import ResidualBlock
from torchface.onnx.graph_builder import GraphBuilder

Network = TypeVar("Network", bound=nn.Module)
Inputs = dict[str, Tensor]


class HeatPoints(NamedTuple):
    """Names of what is read off heat maps of P points.

    Args:
        points: (B,P,2), the mean places of the heat.
        squared_spread: (B,P), its variance by both axes together.
        features: (B,P,C), the features under the heat.
    """

    points: str
    squared_spread: str
    features: str


def layers(build: GraphBuilder, part: nn.Module, value: str) -> str:
    """The nodes of convolutions, rectifiers and residual blocks, one after the other."""
    if isinstance(part, nn.Conv2d):
        return convolution(build, part, value)
    if isinstance(part, nn.ReLU):
        return build.op("Relu", value)
    if isinstance(part, ResidualBlock):
        inner = layers(build, part.second, layers(build, part.first, value))
        return build.op("Relu", build.op("Add", value, inner))
    for one in part.children():
        value = layers(build, one, value)
    return value


def convolution(build: GraphBuilder, part: nn.Conv2d, value: str) -> str:
    """The node of a convolution, its weight in half precision."""
    return build.convolution(part, value, build.weight(part.weight))


def doubled(build: GraphBuilder, value: str) -> str:
    """The node that doubles a map's resolution."""
    scales = build.constant("scales", torch.tensor([1.0, 1.0, 2.0, 2.0]))
    return build.op(
        "Resize", value, "", scales, mode="nearest", coordinate_transformation_mode="asymmetric", nearest_mode="floor"
    )


def with_context(build: GraphBuilder, context: nn.Linear, pooled: str, deep: str) -> str:
    """The nodes that add to a map (B,C,h,w) what a linear layer makes of its mean (B,C,1,1)."""
    pointwise = nn.Conv2d(context.in_features, context.out_features, 1)
    pointwise.weight.data, pointwise.bias.data = context.weight.data[:, :, None, None], context.bias.data  # type: ignore[union-attr]
    return build.op("Add", deep, convolution(build, pointwise, pooled))


def heat_points(
    build: GraphBuilder, heat: nn.Conv2d, features: str, places: Tensor, prefix: str = "", output: str | None = None
) -> HeatPoints:
    """The nodes that read points off heat maps.

    Args:
        build: the graph that they become part of.
        heat: makes P maps of features.
        features: (B,C,h,w).
        places: of the maps' cells, (h*w,2).
        prefix: of the constants' names.
        output: what the points shall be called.
    """
    op = build.op
    maps = op(
        "Reshape", convolution(build, heat, features), build.constant(f"{prefix}rows", (0, heat.out_channels, -1))
    )
    share = op("Softmax", maps, axis=-1)
    named = {} if output is None else {"output": output}
    points = op("MatMul", share, build.constant(f"{prefix}places", places), **named)
    squared = op("MatMul", share, build.constant(f"{prefix}squares", places.square()))
    last = build.constant(f"{prefix}last", (-1,))
    spread = op("ReduceSum", op("Sub", squared, op("Mul", points, points)), last, keepdims=0)
    spread = op("Max", spread, build.constant(f"{prefix}zero", 0.0))
    cells = op("Reshape", features, build.constant(f"{prefix}cells", (0, heat.in_channels, -1)))
    return HeatPoints(points, spread, op("MatMul", share, op("Transpose", cells, perm=[0, 2, 1])))
