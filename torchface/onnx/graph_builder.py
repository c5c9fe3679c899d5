"""Builds small ONNX graphs node by node, with short names, shared constants and named metadata."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import onnx
from onnx import helper, numpy_helper
from torch import Tensor

from torchface.onnx.operator_set import IR_VERSION, OPSET


class GraphBuilder:
    """Collects nodes and constants; names are values of the graph.

    Args:
        parent: for the branch of an ``If``: the graph around it, whose values and constants the branch may use.
    """

    def __init__(self, parent: GraphBuilder | None = None) -> None:
        self._root: GraphBuilder = self if parent is None else parent._root
        self._nodes: list[onnx.NodeProto] = []
        if parent is None:
            self._constants: dict[str, onnx.TensorProto] = {}
            self._count = 0

    def constant(self, name: str, value: Tensor | float | Sequence[int]) -> str:
        """A float32 constant; integers, given as a sequence, stay int64."""
        if isinstance(value, Tensor):
            array = value.detach().cpu().numpy().astype(np.float32)
        else:
            array = np.array(value, dtype=np.float32 if isinstance(value, float) else np.int64)
        self._root._constants[name] = numpy_helper.from_array(np.ascontiguousarray(array), name)
        return name

    def double(self, value: Tensor) -> str:
        """A float64 constant under a name of its own; the same numbers are kept once."""
        array = value.detach().cpu().numpy().astype(np.float64, order="C")
        name = f"{'x'.join(map(str, array.shape))} {hashlib.sha256(array.tobytes()).hexdigest()[:16]}"
        self._root._constants[name] = numpy_helper.from_array(array, name)
        return name

    def op(self, kind: str, *inputs: str, output: str | None = None, **attributes: Any) -> str:
        """Adds a node with one output and returns the output's name; axes to reduce may be an attribute."""
        if "axes" in attributes:
            axes = attributes.pop("axes")
            inputs = (*inputs, self.constant(f"axes {axes}", axes))
        if output is None:
            output = f"v{self._root._count}"
            self._root._count += 1
        self._nodes.append(helper.make_node(kind, list(inputs), [output], **attributes))
        return output

    def branch(self, *outputs: str) -> onnx.GraphProto:
        """The nodes as a branch of an ``If`` with float outputs."""
        infos = [helper.make_tensor_value_info(output, onnx.TensorProto.FLOAT, None) for output in outputs]
        return helper.make_graph(self._nodes, "branch", [], infos)

    def model(
        self,
        name: str,
        inputs: Mapping[str, Sequence[int | str]],
        outputs: Mapping[str, Sequence[int | str]],
        metadata: Mapping[str, Any],
        types: Mapping[str, int] | None = None,
    ) -> onnx.ModelProto:
        """The checked model.

        Args:
            name: of the graph.
            inputs, outputs: their shapes.
            metadata: values that are not text become JSON.
            types: of inputs and outputs that are not float32.
        """

        def infos(values: Mapping[str, Sequence[int | str]]) -> list[onnx.ValueInfoProto]:
            kinds = types or {}
            return [
                helper.make_tensor_value_info(key, kinds.get(key, onnx.TensorProto.FLOAT), list(shape))
                for key, shape in values.items()
            ]

        graph = helper.make_graph(self._nodes, name, infos(inputs), infos(outputs), list(self._constants.values()))
        model = helper.make_model(graph, producer_name="torchface", opset_imports=[helper.make_opsetid("", OPSET)])
        model.ir_version = IR_VERSION
        helper.set_model_props(
            model, {key: value if isinstance(value, str) else json.dumps(value) for key, value in metadata.items()}
        )
        onnx.checker.check_model(model, full_check=True)
        return model
