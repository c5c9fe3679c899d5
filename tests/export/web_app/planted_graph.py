"""A graph with the inputs and outputs of ``torchface export webcam`` that reads planted weights off the picture."""

import json
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper
from onnx.numpy_helper import from_array

from torchface.shape_names import ARKIT

BLOCK, COLUMNS = 16, 8
"""Pixels of a block's side, and how many stand side by side in the picture's upper left corner."""
PRESENCE, YAW = 60, 61
"""The blocks that tell whether there is a face, and how far the head is turned, behind those of the 52 weights."""
BESIDE = (62, 63)
"""The blocks whose brightness, rounded, tells whether somebody stands to the left and to the right."""
STATE = len(ARKIT) + 1


def write_planted_graph(path: Path) -> None:
    """Weights are the brightness of blocks times the gain, smoothed with those before; the state counts frames."""
    nodes: list[onnx.NodeProto] = []
    constants: list[onnx.TensorProto] = []

    def constant(values: object, dtype: type = np.float32) -> str:
        name = f"constant_{len(constants)}"
        constants.append(from_array(np.asarray(values, dtype), name))
        return name

    def node(kind: str, *inputs: str, out: str | None = None, **fields: object) -> str:
        name = out or f"{kind}_{len(nodes)}"
        nodes.append(helper.make_node(kind, inputs, [name], **fields))
        return name

    def part(values: str, first: int, end: int, out: str | None = None) -> str:
        return node("Slice", values, constant([first], np.int64), constant([end], np.int64), out=out)

    side = BLOCK * COLUMNS
    corner = node("Slice", "image", constant([0, 0, 0], np.int64), constant([side, side, 3], np.int64))
    grey = node("ReduceMean", node("Cast", corner, to=TensorProto.FLOAT), axes=[2], keepdims=0)
    blocks = node("Reshape", grey, constant([COLUMNS, BLOCK, COLUMNS, BLOCK], np.int64))
    bright = node("Reshape", node("ReduceMean", blocks, axes=[1, 3], keepdims=0), constant([-1], np.int64))
    values = node("Div", bright, constant(255.0))
    now = node("Mul", part(values, 0, len(ARKIT)), part("controls", 1, 2))
    first = node("Equal", part("state", len(ARKIT), STATE), constant([0.0]))
    kept = node("Exp", node("Mul", node("Neg", "interval"), constant(20.0)))
    share = node("Where", first, constant([0.0]), node("Mul", kept, part("controls", 2, 3)))
    before = part("state", 0, len(ARKIT))
    moved = node("Add", now, node("Mul", share, node("Sub", before, now)))
    node("Clip", moved, constant(0.0), constant(1.0), out="weights")
    count = node("Add", part("state", len(ARKIT), STATE), constant([1.0]))
    node("Concat", "weights", count, out="next_state", axis=0)
    seen = node("Squeeze", part(values, PRESENCE, PRESENCE + 1))
    node("Cast", node("Greater", seen, constant(0.5)), to=TensorProto.FLOAT, out="presence")
    angle = node("Sub", part(values, YAW, YAW + 1), constant([0.5]))
    cosine, sine = node("Cos", angle), node("Sin", angle)
    zero = constant([0.0])
    # Yaw of a head before an OpenCV camera, whose y is down and z away.
    rows = (cosine, zero, sine, zero, constant([-1.0]), zero, sine, zero, node("Neg", cosine))
    flat = node("Concat", *rows, axis=0)
    node("Reshape", flat, constant([3, 3], np.int64), out="rotation")
    node("Identity", constant([0.0, 0.0, 600.0]), out="translation")
    node("Identity", constant([[0.1, 0.05], [0.1, 0.05]]), out="gaze")
    node("Concat", *(part(values, which, which + 1) for which in BESIDE), out="beside", axis=0)
    marks = np.stack([160 + 60 * np.cos(np.arange(68)), 130 + 70 * np.sin(np.arange(68))], axis=1)
    there = node("Cast", "presence", to=TensorProto.BOOL)
    node("Where", there, constant(marks), constant(np.nan), out="landmarks")
    node("Where", there, constant([[140.0, 110.0], [180.0, 110.0]]), constant(np.nan), out="iris")
    node("Squeeze", node("Clip", node("Div", count, constant([100.0])), constant(0.0), constant(1.0)), out="calibrated")
    graph = helper.make_graph(
        nodes,
        "planted",
        [
            helper.make_tensor_value_info("image", TensorProto.UINT8, ["height", "width", "channels"]),
            helper.make_tensor_value_info("interval", TensorProto.FLOAT, []),
            helper.make_tensor_value_info("controls", TensorProto.FLOAT, [5]),
            helper.make_tensor_value_info("state", TensorProto.FLOAT, [STATE]),
        ],
        [
            helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)
            for name, shape in {
                "weights": [len(ARKIT)],
                "rotation": [3, 3],
                "translation": [3],
                "gaze": [2, 2],
                "landmarks": [68, 2],
                "iris": [2, 2],
                "presence": [],
                "calibrated": [],
                "beside": [2],
                "next_state": [STATE],
            }.items()
        ],
        constants,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=9)
    helper.set_model_props(model, {"names": json.dumps(ARKIT), "state": str(STATE)})
    onnx.checker.check_model(model)
    path.write_bytes(model.SerializeToString())
