"""The network of face boxes as ONNX: images of any size to the likeliest faces in them."""

from __future__ import annotations

import onnx
from torch import nn

from torchface.landmarks.images.boxes.box_network import (
    BESIDE_A_PEAK,
    LOG_SIDES,
    STRIDE,
    TYPICAL_SIDE,
    BoxNetwork,
    SeparableConvolution,
)
from torchface.landmarks.images.folded_normalisation import without_normalisation
from torchface.onnx.graph_builder import GraphBuilder

"""What the graph says of a face, in this order."""


def box_network_nodes(build: GraphBuilder, network: BoxNetwork, images: str) -> str:
    """The nodes of the network, batch normalisations folded into the convolutions before them.

    Args:
        build: the graph that they become part of.
        network: with what it has learned.
        images: (B,3,H,W) in [0,1], red first.

    Returns:
        The name of the faces, (B,K,6).
    """
    net, op = without_normalisation(network), build.op
    half, one = build.constant("box_half", 0.5), build.constant("box_one", 1.0)
    fine = _run(build, net.level_8, _run(build, net.level_4, _run(build, net.stem, op("Sub", images, half))))
    middle = _run(build, net.level_16, fine)
    coarse = _run(build, net.from_32, _run(build, net.level_32, middle))
    middle = _run(build, net.mixed_16, op("Relu", op("Add", middle, _as_large(build, coarse, middle))))
    from_16 = _run(build, net.from_16, middle)
    fine = op("Relu", op("Add", fine, _as_large(build, from_16, fine)))
    said = _run(build, net.said, _run(build, net.mixed_8, fine))
    starts = {at: build.constant(f"box_{at}", (at,)) for at in (0, 1, 2, 3, 5, 6)}
    channel = build.constant("box_channel", (1,))

    def channels(first: int, last: int) -> str:
        return op("Slice", said, starts[first], starts[last], channel)

    likely = op("Sigmoid", channels(0, 1))
    highest = op("MaxPool", likely, kernel_shape=[3, 3], pads=[1, 1, 1, 1])
    share = op("Where", op("Equal", highest, likely), one, build.constant("box_beside", BESIDE_A_PEAK))
    peaks = op("Mul", likely, share)
    rows, columns = (_counted(build, op("Shape", said, start=axis, end=axis + 1)) for axis in (2, 3))
    column = op("Add", channels(1, 2), columns)
    row = op("Add", channels(2, 3), op("Unsqueeze", rows, starts[1]))
    cells = op("Concat", column, row, channels(3, 6), axis=1)
    told = op("Transpose", op("Reshape", cells, build.constant("box_told", (0, 5, -1))), perm=[0, 2, 1])
    flat = op("Reshape", peaks, build.constant("box_flat", (0, -1)))
    scores, places = build.two_of("TopK", flat, build.constant("box_faces", (network.faces,)), axis=1)
    wide = op("Expand", op("Unsqueeze", places, starts[2]), build.constant("box_five", (1, 1, 5)))
    own = op("GatherElements", told, wide, axis=1)
    last = build.constant("box_last", (2,))

    def values(first: int, end: int) -> str:
        return op("Slice", own, starts[first], starts[end], last)

    stride = build.constant("box_stride", float(STRIDE))
    place = op("Sub", op("Mul", op("Add", values(0, 2), half), stride), half)
    limits = build.constant("box_least", -LOG_SIDES), build.constant("box_most", LOG_SIDES)
    side = op("Mul", op("Exp", op("Clip", values(2, 3), *limits)), build.constant("box_side", TYPICAL_SIDE))
    square = op("ReduceSum", op("Mul", values(3, 5), values(3, 5)), last, keepdims=1)
    length = op("Sqrt", op("Max", square, build.constant("box_tiny", 1e-12)))
    angle = op("Div", values(3, 5), length)
    return op("Concat", place, side, op("Unsqueeze", scores, starts[2]), angle, axis=-1)


def _run(build: GraphBuilder, part: nn.Module, value: str) -> str:
    """The nodes of convolutions, rectifiers and separable convolutions, one after the other."""
    if isinstance(part, nn.Conv2d):
        return build.convolution(part, value, build.unnamed(part.weight))
    if isinstance(part, nn.ReLU):
        return build.op("Relu", value)
    if isinstance(part, SeparableConvolution):
        changed = _run(build, part.pointwise, _run(build, part.depthwise, value))
        return build.op("Relu", build.op("Add", value, changed) if part.shortcut else changed)
    for one in part.children():
        value = _run(build, one, value)
    return value


def _as_large(build: GraphBuilder, value: str, other: str) -> str:
    """A map as large as another."""
    own, theirs = build.op("Shape", value, start=0, end=2), build.op("Shape", other, start=2, end=4)
    sizes = build.op("Concat", own, theirs, axis=0)
    return build.op(
        "Resize", value, "", "", sizes, mode="nearest", coordinate_transformation_mode="asymmetric",
        nearest_mode="floor",
    )  # fmt: skip


def _counted(build: GraphBuilder, size: str) -> str:
    """0, 1, 2 and so on, as many as a size (1,) says."""
    first, step = (build.scalar(f"box_count_{at}", at) for at in (0, 1))
    counted = build.op("Range", first, build.op("Squeeze", size), step)
    return build.op("Cast", counted, to=onnx.TensorProto.FLOAT)
