"""The nodes of small convolutional networks in ONNX graphs that are built node by node."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
import torch
from onnx import TensorProto, numpy_helper
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from torchface.landmarks.images.network import ResidualBlock
from torchface.onnx.graph_builder import GraphBuilder

Network = TypeVar("Network", bound=nn.Module)


class HalfBuilder(GraphBuilder):
    """A builder that keeps large constants in half precision; ONNX Runtime widens them when it loads the graph."""

    def weight(self, value: Tensor) -> str:
        """A constant of a network: float16 in the file, float32 in the graph."""
        name = f"w{len(self._root._constants)}"
        half = np.ascontiguousarray(value.detach().cpu().numpy().astype(np.float16))
        self._root._constants[name] = numpy_helper.from_array(half, name)
        return self.op("Cast", name, to=TensorProto.FLOAT)


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


def layers(build: HalfBuilder, part: nn.Module, value: str) -> str:
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


def convolution(build: HalfBuilder, part: nn.Conv2d, value: str) -> str:
    """The node of a convolution."""
    assert part.bias is not None
    pads = [int(part.padding[0]), int(part.padding[1])] * 2
    strides = list(part.stride)
    bias = build.constant(f"b{len(build._constants)}", part.bias)
    return build.op("Conv", value, build.weight(part.weight), bias, pads=pads, strides=strides)


def doubled(build: HalfBuilder, value: str) -> str:
    """The node that doubles a map's resolution."""
    scales = build.constant("scales", torch.tensor([1.0, 1.0, 2.0, 2.0]))
    return build.op(
        "Resize", value, "", scales, mode="nearest", coordinate_transformation_mode="asymmetric", nearest_mode="floor"
    )
