"""Landmark trees as ONNX: one grey image and boxes of faces in it to landmarks."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor

from torchface import __version__
from torchface.landmarks.images.trees.landmark_trees import FAINTEST, LandmarkTrees
from torchface.onnx.checked_export import ExportReport, write_checked
from torchface.onnx.exported_model import IR_VERSION, OPSET

_PARITY = 0.1  # pixels; a rounding error may read the pixel beside, which moves a face by some hundredths


class _Graph:
    """Nodes and constants of a graph, written node by node.

    The exported module takes 3.5 times as long: its exporter makes of reads in tables what ONNX Runtime is slow at.
    """

    def __init__(self) -> None:
        self._nodes: list[onnx.NodeProto] = []
        self._constants: dict[str, onnx.TensorProto] = {}

    def stored(self, name: str, values: Tensor) -> str:
        """A constant of the tensor's own type."""
        array = np.ascontiguousarray(values.detach().cpu().numpy())
        self._constants[name] = numpy_helper.from_array(array, name)
        return name

    def constant(self, name: str, value: Tensor | float | Sequence[int]) -> str:
        """A float32 constant; integers, given as a sequence, stay int64."""
        if isinstance(value, Tensor):
            return self.stored(name, value.float())
        return self.stored(name, torch.tensor(value, dtype=torch.float32 if isinstance(value, float) else torch.int64))

    def op(self, kind: str, *inputs: str, output: str | None = None, **attributes: Any) -> str:
        """Adds a node with one output and returns the output's name; axes to reduce may be an attribute."""
        if "axes" in attributes:
            axes = attributes.pop("axes")
            inputs = (*inputs, self.constant(f"axes {axes}", axes))
        output = output or f"v{len(self._nodes)}"
        self._nodes.append(helper.make_node(kind, list(inputs), [output], **attributes))
        return output

    def model(
        self, inputs: Mapping[str, tuple[int, Sequence[int | str]]], landmarks: int, facts: Mapping[str, object]
    ) -> onnx.ModelProto:
        """The checked model."""
        given = [helper.make_tensor_value_info(name, kind, list(shape)) for name, (kind, shape) in inputs.items()]
        found = helper.make_tensor_value_info("landmarks", TensorProto.FLOAT, ["faces", landmarks, 2])
        graph = helper.make_graph(self._nodes, "landmark_trees", given, [found], list(self._constants.values()))
        model = helper.make_model(graph, producer_name="torchface", opset_imports=[helper.make_opsetid("", OPSET)])
        model.ir_version = IR_VERSION
        helper.set_model_props(
            model, {key: value if isinstance(value, str) else json.dumps(value) for key, value in facts.items()}
        )
        onnx.checker.check_model(model, full_check=True)
        return model


def export_landmark_trees(
    model: LandmarkTrees, path: str | Path, facts: Mapping[str, object] | None = None
) -> ExportReport:
    """Writes landmark trees as ONNX, and checks them.

    The graph takes ``image`` (height,width), grey, 0 to 255, and ``boxes`` (B,4) of faces in it: x, y, width, height.
    Boxes are in pixels.
    It gives ``landmarks`` (B,L,2), pixels, x right and y down; a box that is not finite gives NaN.
    """
    generator = torch.Generator().manual_seed(0)
    cases = []
    for faces, height, width in ((1, 120, 100), (3, 90, 140)):
        coarse = torch.rand(1, 1, height // 12, width // 12, generator=generator)
        cloudy = torch.nn.functional.interpolate(coarse, size=(height, width), mode="bicubic").clamp(0, 1)
        stored = (255 * cloudy).round()
        boxes = torch.tensor([25.0, 20, 50, 50]) + 10 * torch.rand(faces, 4, generator=generator)
        expected = model((stored / 255).expand(faces, 1, height, width), boxes)
        cases.append(({"image": stored[0, 0].to(torch.uint8), "boxes": boxes}, {"landmarks": expected}))
    return write_checked(
        landmark_trees_model(model, facts), path, cases, {"landmarks": _PARITY}, {"landmarks": "pixels"}
    )


def landmark_trees_model(model: LandmarkTrees, facts: Mapping[str, object] | None = None) -> onnx.ModelProto:
    """The graph."""
    build = _Graph()
    op, constant = build.op, build.constant
    count = len(model.mean)
    mean = model.mean - model.mean.mean(0)
    energy = mean.square().sum()
    # A similarity from the mean shape is linear in the shape: scale times cosine, scale times sine.
    constant("to_similarity", torch.stack([mean, torch.stack([-mean[:, 1], mean[:, 0]], 1)], -1).view(-1, 2) / energy)
    for name, ids in {"flat": (-1,), "wide": (-1, 2 * count), "points": (-1, count, 2), "rows": (-1, 1, 2),
                      "two": (-1, 2, 2 * count), "two_rows": (-1, 2, model.sizes["features"]), "second_axis": (1,),
                      "x_y": (1, 0), "last_column": (1,)}.items():  # fmt: skip
        constant(name, ids)
    constant("zero", 0.0)
    constant("faintest", FAINTEST * 255.0)
    values = op("Reshape", "image", "flat")
    size = op("Reshape", op("Gather", op("Shape", "image"), "x_y"), constant("column", (2, 1)))  # width, height
    limits = op("Cast", op("Sub", size, constant("one", (1,))), to=TensorProto.FLOAT)
    strides = op("Concat", constant("step", (1,)), op("Gather", op("Shape", "image"), "last_column"), axis=0)
    strides = op("Reshape", strides, "column")
    start = _start(build, model)
    usable = op("Less", op("Abs", start), constant("far", 1e9))  # neither NaN nor infinite
    shapes = op("Where", usable, start, "zero")
    build.stored("doubled", 2 * torch.arange(model.sizes["trees"], dtype=torch.int32))
    for cascade in range(model.sizes["cascades"]):
        anchors, offsets = model.anchors[cascade], model.offsets[cascade]
        x, y = offsets.unbind(1)
        rotated = torch.stack([torch.cat([x, y]), torch.cat([-y, x])])
        similarity = op("MatMul", shapes, "to_similarity")
        places = op(
            "Add",
            op("Gather", shapes, build.stored(f"anchors{cascade}", torch.cat([2 * anchors, 2 * anchors + 1])), axis=1),
            op("MatMul", similarity, constant(f"offsets{cascade}", rotated)),
        )
        places = op("Reshape", op("Round", places), "two_rows")
        places = op("Cast", op("Min", op("Max", places, "zero"), limits), to=TensorProto.INT64)
        address = op("ReduceSum", op("Mul", places, strides), "second_axis", keepdims=0)
        grey = op("Gather", values, address)
        grey = op("Cast", grey, to=TensorProto.FLOAT)
        centred = op("Sub", grey, op("ReduceMean", grey, axes=[1], keepdims=1))
        deviation = op("Sqrt", op("ReduceMean", op("Mul", centred, centred), axes=[1], keepdims=1))
        coefficients = _leaves(build, model, cascade, op("Div", grey, op("Max", deviation, "faintest")))
        steps = model.bases[cascade].view(-1, count, 2)
        across = torch.stack([-steps[..., 1], steps[..., 0]], -1)
        both = torch.cat([steps.flatten(1), across.flatten(1)], dim=1)
        step = op("Reshape", op("MatMul", coefficients, constant(f"basis{cascade}", both)), "two")
        moved = op("Reshape", op("MatMul", op("Reshape", similarity, "rows"), step), "wide")
        shapes = op("Add", shapes, moved)
    found = op("Where", usable, shapes, constant("nothing", float("nan")))
    op("Reshape", found, "points", output="landmarks")
    return build.model(
        {"image": (TensorProto.UINT8, ("height", "width")), "boxes": (TensorProto.FLOAT, ("faces", 4))},
        count,
        {
            "task": "face_landmarks",
            "landmarks": "iBUG 68" if count == 68 else str(count),
            "image": "grey, 0 to 255",
            "boxes": "x, y, width, height in pixels, as OpenCV's face detector gives them",
            "units": "pixels",
            "version": __version__,
            **(facts or {}),
        },
    )


def _start(build: _Graph, model: LandmarkTrees) -> str:
    """The mean shape in each box, (B,2L), as one product: box middle and side are linear in what follows."""
    op, constant = build.op, build.constant
    count = len(model.mean)
    half = op("Mul", op("Slice", "boxes", constant("b2", (2,)), constant("b4", (4,)), constant("b1", (1,))),
              constant("half", 0.5))  # fmt: skip
    middle = op("Add", op("Slice", "boxes", constant("b0", (0,)), "b2", "b1"), half)
    quarter = op("Mul", op("Slice", half, "b0", "b1", "b1"), op("Slice", half, "b1", "b2", "b1"))
    side = op("Mul", op("Sqrt", quarter), constant("twice", 2.0))
    repeat = torch.eye(2).repeat(1, count)
    return op(
        "Add",
        op("MatMul", middle, constant("repeat", repeat)),
        op("MatMul", side, constant("mean", (model.mean - 0.5).view(1, -1))),
    )


def _leaves(build: _Graph, model: LandmarkTrees, cascade: int, grey: str) -> str:
    """The sum (B,1,K) of the leaves that grey values (B,P) lead to: all trees go down a level together."""
    op = build.op
    trees, depth = model.sizes["trees"], model.sizes["depth"]
    place = ""
    for level in range(depth):
        nodes = slice(2**level - 1, 2 ** (level + 1) - 1)
        names = []
        for table in ("first", "second"):
            ids = getattr(model, table)[cascade, :, nodes].reshape(-1).to(torch.int32)
            names.append(build.stored(f"{table}{cascade}_{level}", ids))
        limit = build.constant(f"threshold{cascade}_{level}", model.thresholds[cascade, :, nodes].reshape(-1))
        if level == 0:  # every face is at the root of every tree
            values = [op("Gather", grey, name, axis=1) for name in names]
        else:
            values = [op("GatherElements", grey, op("Gather", name, place), axis=1) for name in names]
            limit = op("Gather", limit, place)
        right = op("Cast", op("Greater", op("Sub", *values), limit), to=TensorProto.INT32)
        place = op("Add", op("Add", place, place) if level else "doubled", right)
    leaves = build.stored(f"leaves{cascade}", model.leaves[cascade].reshape(trees * 2**depth, -1))
    held = op("Cast", op("Gather", leaves, place), to=TensorProto.FLOAT)
    return op("MatMul", build.constant(f"scales{cascade}", model.scales[cascade][None]), held)
