"""The nodes of small convolutional networks in ONNX graphs that are built node by node."""

from __future__ import annotations

from typing import TypeVar

import torch
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from torchface.landmarks.images.network import ResidualBlock
from torchface.onnx.graph_builder import GraphBuilder

Network = TypeVar("Network", bound=nn.Module)


def folded(model: Network, twin: Network) -> Network:
    """A network with its batch normalisations folded into the convolutions before them.

    Args:
        model: in evaluation mode.
        twin: another of the same configuration, which takes over its state.
    """
    twin.load_state_dict(model.state_dict())
    twin.eval()
    for part in twin.modules():
        if isinstance(part, nn.Sequential):
            for at in range(len(part) - 1):
                first, second = part[at], part[at + 1]
                if isinstance(first, nn.Conv2d) and isinstance(second, nn.BatchNorm2d):
                    part[at], part[at + 1] = fuse_conv_bn_eval(first, second), nn.Identity()
    return twin


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
