"""A module as an ONNX model, by tracing: for what is too long to be built node by node."""

from __future__ import annotations

import io
import json
import warnings
from collections.abc import Mapping, Sequence

import onnx
import torch
from onnx import helper
from torch import Tensor, nn

from torchface.onnx.graph_builder import IR_VERSION, OPSET


def traced_model(
    module: nn.Module,
    inputs: Mapping[str, Tensor],
    outputs: Sequence[str],
    metadata: Mapping[str, object],
) -> onnx.ModelProto:
    """The checked model of a module whose control flow does not depend on its inputs.

    Args:
        module: of the inputs in their order.
        inputs: examples by name; the model takes tensors of their shapes.
        outputs: names of what the module returns.
        metadata: values that are not text become JSON.
    """
    written = io.BytesIO()
    with warnings.catch_warnings(), torch.no_grad():
        # That shapes become constants is meant, and no other exporter of PyTorch works without further packages.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            module,
            tuple(inputs.values()),
            written,  # type: ignore[arg-type]
            input_names=list(inputs),
            output_names=list(outputs),
            opset_version=OPSET,
            dynamo=False,
        )
    model = onnx.load_model_from_string(written.getvalue())
    _share_constants(model.graph)
    model.producer_name, model.producer_version, model.ir_version = "torchface", "", IR_VERSION
    helper.set_model_props(
        model, {key: value if isinstance(value, str) else json.dumps(value) for key, value in metadata.items()}
    )
    onnx.checker.check_model(model, full_check=True)
    return model


def _share_constants(graph: onnx.GraphProto) -> None:
    """Keeps each constant once, gives values short names, and drops the places where nodes were traced."""
    kept = {value.name: value.name for value in (*graph.input, *graph.output)}
    constants: dict[bytes, onnx.TensorProto] = {}
    nodes = []

    def shared(tensor: onnx.TensorProto) -> str:
        own = onnx.TensorProto()
        own.CopyFrom(tensor)
        own.name = ""
        first = constants.setdefault(own.SerializeToString(), own)
        if not first.name:
            first.name = f"c{len(constants)}"
        return first.name

    for tensor in graph.initializer:
        kept[tensor.name] = shared(tensor)
    for node in graph.node:
        if node.op_type == "Constant" and node.attribute[0].name == "value":
            kept[node.output[0]] = shared(node.attribute[0].t)
            continue
        nodes.append(node)
        for name in node.output:
            if name:
                kept.setdefault(name, f"v{len(kept)}")
    for node in nodes:
        # Optional inputs that are left out have no name.
        node.input[:] = [kept[name] if name else "" for name in node.input]
        node.output[:] = [kept[name] if name else "" for name in node.output]
        node.name = node.doc_string = ""
        del node.metadata_props[:]
    del graph.node[:], graph.initializer[:], graph.value_info[:]
    graph.node.extend(nodes)
    graph.initializer.extend(constants.values())
