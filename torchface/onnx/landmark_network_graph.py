"""A landmark network as ONNX: crops of faces to landmarks, their deviation, visibility and presence."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import TensorProto, numpy_helper
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from torchface import __version__
from torchface.landmarks.images.network import DEVIATION_RANGE, LandmarkNetwork, ResidualBlock
from torchface.onnx.checked_export import ExportReport, write_checked
from torchface.onnx.graph_builder import GraphBuilder

_PARITY = {"landmarks": 0.1, "deviation": 0.1, "visibility": 0.01, "presence": 0.01}
_UNITS = {"landmarks": "pixels", "deviation": "pixels", "visibility": "of 1", "presence": "of 1"}


class _HalfBuilder(GraphBuilder):
    """A builder that keeps large constants in half precision; ONNX Runtime widens them when it loads the graph."""

    def weight(self, value: Tensor) -> str:
        """A constant of a network: float16 in the file, float32 in the graph."""
        name = f"w{len(self._root._constants)}"
        half = np.ascontiguousarray(value.detach().cpu().numpy().astype(np.float16))
        self._root._constants[name] = numpy_helper.from_array(half, name)
        return self.op("Cast", name, to=TensorProto.FLOAT)


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
    generator = torch.Generator().manual_seed(0)
    cases = []
    for batch in (1, 3):
        coarse = torch.rand(batch, 3, model.size // 8, model.size // 8, generator=generator)
        crops = torch.nn.functional.interpolate(coarse, (model.size, model.size), mode="bilinear")
        with torch.no_grad():
            cases.append(({"image": crops}, model(crops)._asdict()))
    return write_checked(landmark_network_model(model, facts), path, cases, _PARITY, _UNITS)


def landmark_network_model(model: LandmarkNetwork, facts: Mapping[str, object] | None = None) -> onnx.ModelProto:
    """The graph, its batch normalisations folded into the convolutions before them.

    Built node by node: it takes milliseconds, where ``torch.export`` takes seconds, so that every start of a tracker
    can afford it.
    """
    net, build = folded(model), _HalfBuilder()
    op, constant = build.op, build.constant
    centred = op("Sub", op("Mul", "image", constant("two", 2.0)), constant("one", 1.0))
    quarter = _run(build, net.quarter, _run(build, net.stem, centred))
    eighth = _run(build, net.eighth, quarter)
    deep = _run(build, net.sixteenth, eighth)
    pooled = op("GlobalAveragePool", deep)
    context = nn.Conv2d(net.context.in_features, net.context.out_features, 1)
    context.weight.data, context.bias.data = net.context.weight.data[:, :, None, None], net.context.bias.data  # type: ignore[union-attr]
    deep = op("Add", deep, _convolution(build, context, pooled))
    eighth = op("Add", _doubled(build, _convolution(build, net.up_eighth, deep)), eighth)
    eighth = _run(build, net.mix_eighth, eighth)
    below = _doubled(build, _convolution(build, net.up_quarter, eighth))
    features = _run(build, net.mix_quarter, op("Add", below, _convolution(build, net.skip_quarter, quarter)))
    heat = op("Reshape", _convolution(build, net.heat, features), constant("rows", (0, 68, -1)))
    share = op("Softmax", heat, axis=-1)
    places = net.places(torch.zeros(1, 1, model.size // 4, model.size // 4))
    landmarks = op("MatMul", share, constant("places", places), output="landmarks")
    squared = op("MatMul", share, constant("squares", places.square()))
    spread = op("ReduceSum", op("Sub", squared, op("Mul", landmarks, landmarks)), constant("last", (-1,)), keepdims=0)
    spread = op("Add", op("Max", spread, constant("zero", 0.0)), "one")
    cells = op("Reshape", features, constant("channels", (0, net.decoder, -1)))
    under = op("MatMul", share, op("Transpose", cells, perm=[0, 2, 1]))
    told = [
        op("Add", op("ReduceSum", op("Mul", under, build.weight(net.local[..., i])), "last", keepdims=0),
           constant(f"bias{i}", net.local_bias[:, i]))
        for i in range(2)
    ]  # fmt: skip
    deviation = op("Exp", op("Add", told[0], op("Mul", op("Log", spread), constant("quarter", 0.25))))
    least, most = (constant(f"limit{i}", value) for i, value in enumerate(DEVIATION_RANGE))
    op("Clip", deviation, least, most, output="deviation")
    op("Sigmoid", told[1], output="visibility")
    flat = op("Reshape", pooled, constant("flat", (0, -1)))
    logit = op("Add", op("MatMul", flat, build.weight(net.presence.weight.T)), constant("there", net.presence.bias))
    op("Reshape", op("Sigmoid", logit), constant("faces", (-1,)), output="presence")
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


def folded(model: LandmarkNetwork) -> LandmarkNetwork:
    """The same network with its batch normalisations folded into the convolutions before them."""
    twin = LandmarkNetwork.from_config(model.config)
    twin.load_state_dict(model.state_dict())
    twin.eval()
    for part in twin.modules():
        if isinstance(part, nn.Sequential):
            for at in range(len(part) - 1):
                first, second = part[at], part[at + 1]
                if isinstance(first, nn.Conv2d) and isinstance(second, nn.BatchNorm2d):
                    part[at], part[at + 1] = fuse_conv_bn_eval(first, second), nn.Identity()
    return twin


def _run(build: _HalfBuilder, part: nn.Module, value: str) -> str:
    """The nodes of convolutions, rectifiers and residual blocks, one after the other."""
    if isinstance(part, nn.Conv2d):
        return _convolution(build, part, value)
    if isinstance(part, nn.ReLU):
        return build.op("Relu", value)
    if isinstance(part, ResidualBlock):
        inner = _run(build, part.second, _run(build, part.first, value))
        return build.op("Relu", build.op("Add", value, inner))
    for one in part.children():
        value = _run(build, one, value)
    return value


def _convolution(build: _HalfBuilder, part: nn.Conv2d, value: str) -> str:
    assert part.bias is not None
    pads = [int(part.padding[0]), int(part.padding[1])] * 2
    strides = list(part.stride)
    bias = build.constant(f"b{len(build._constants)}", part.bias)
    return build.op("Conv", value, build.weight(part.weight), bias, pads=pads, strides=strides)


def _doubled(build: _HalfBuilder, value: str) -> str:
    scales = build.constant("scales", torch.tensor([1.0, 1.0, 2.0, 2.0]))
    return build.op(
        "Resize", value, "", scales, mode="nearest", coordinate_transformation_mode="asymmetric", nearest_mode="floor"
    )
