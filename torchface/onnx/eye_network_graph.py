"""An eye network as ONNX: crops of eyes to lids, irises, their deviation, and whether eyes are open, shut, hidden."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import nn

from torchface.landmarks.images.folded_normalisation import without_normalisation
from torchface.landmarks.images.networks.eye_network import DEVIATION_RANGE, LEAST_SPREAD, POINTS, STRIDE, EyeNetwork
from torchface.landmarks.images.networks.heat_maps import cell_places
from torchface.onnx.graph_builder import GraphBuilder
from torchface.onnx.network_nodes import convolution, doubled, heat_points, layers, with_context

_OUTPUTS: dict[str, tuple[int, ...]] = {
    "landmarks": (6, 2), "iris": (2,), "deviation": (POINTS,), "openness": (), "closed": (), "visibility": ()
}  # fmt: skip


def eye_nodes(build: GraphBuilder, model: EyeNetwork, eyes: str, outputs: Mapping[str, str]) -> None:
    """The network's nodes in a graph that is being built.

    Args:
        build: collects them.
        model: the network.
        eyes: the value that holds crops, (B,3,h,w) in [0,1].
        outputs: what the values of the network's findings shall be called, by their names in ``EyeFindings``.
    """
    net = without_normalisation(model)
    op = build.op

    def constant(name: str, value: torch.Tensor | float | tuple[int, ...]) -> str:
        return build.constant(f"eye_{name}", value)

    axes, share = constant("axes", (1, 2, 3)), constant("share", 1 / (3 * model.height * model.width))
    # By sums: means have their axes elsewhere in later versions of the operators.
    centred = op("Sub", eyes, op("Mul", op("ReduceSum", eyes, axes), share))
    power = op("Mul", op("ReduceSum", op("Mul", centred, centred), axes), share)
    spread = op("Sqrt", op("Add", power, constant("least", LEAST_SPREAD**2)))
    half = layers(build, net.stem, op("Div", centred, spread))
    quarter = layers(build, net.quarter, half)
    deep = layers(build, net.eighth, quarter)
    pooled = op("GlobalAveragePool", deep)
    deep = with_context(build, net.context, pooled, deep)
    quarter = layers(
        build, net.mix_quarter, op("Add", doubled(build, convolution(build, net.up_quarter, deep)), quarter)
    )
    features = layers(build, net.mix_half, op("Add", doubled(build, convolution(build, net.up_half, quarter)), half))
    places = cell_places(torch.zeros(1, 1, model.height // STRIDE, model.width // STRIDE), STRIDE)
    points, spread, under = heat_points(build, net.heat, features, places, "eye_")
    last = constant("last", (-1,))
    spread = op("Log", op("Add", spread, constant("unit", 1.0)))
    told = op("ReduceSum", op("Mul", under, build.weight(net.local)), last, keepdims=0)
    told = op("Add", told, constant("bias", net.local_bias))
    deviation = op("Exp", op("Add", told, op("Mul", spread, constant("fourth", 0.25))))
    limits = [constant(f"limit{i}", value) for i, value in enumerate(DEVIATION_RANGE)]
    op("Clip", deviation, *limits, output=outputs["deviation"])
    split = [constant(f"row{i}", (i,)) for i in (0, 6, 7)]
    axis = constant("axis", (1,))
    op("Slice", points, split[0], split[1], axis, output=outputs["landmarks"])
    flat = constant("flat", (0, -1))
    op("Reshape", op("Slice", points, split[1], split[2], axis), flat, output=outputs["iris"])
    known = op("Concat", op("Reshape", pooled, flat), op("Reshape", under, flat), axis=1)
    first, second = net.told[0], net.told[2]
    assert isinstance(first, nn.Linear)
    assert isinstance(second, nn.Linear)
    inner = op("Add", op("MatMul", known, build.weight(first.weight.T)), constant("inner", first.bias))
    answers = op("MatMul", op("Relu", inner), build.weight(second.weight.T))
    answers = op("Add", answers, constant("answers", second.bias))
    whole = constant("whole", (-1,))
    for row, name in enumerate(("openness", "closed", "visibility")):
        bounds = [constant(f"answer{end}", (end,)) for end in (row, row + 1)]
        answer = op("Reshape", op("Slice", answers, *bounds, axis), whole)
        op("Identity" if name == "openness" else "Sigmoid", answer, output=outputs[name])
