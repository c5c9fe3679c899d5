"""Parts of a graph that are exported each by itself and put into the graph around them afterwards.

``torch.export`` takes long in a graph whose sizes are known when it runs, and for each place where a part is used.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import onnx
import torch
from torch import Tensor

from torchface.errors import TorchfaceError
from torchface.onnx.exported_model import check_model, rename_values

_DOMAIN = "torchface"


@torch.library.custom_op("torchface::graph_part", mutates_args=())
def graph_part(inputs: Sequence[Tensor], name: str, shape: Sequence[int]) -> Tensor:
    """Stands in an exported program for a part of that name that gives a tensor of that shape, float32."""
    raise TorchfaceError(f"{name}: found a part of a graph that is computed, expected one that is exported")


@graph_part.register_fake
def _(inputs: Sequence[Tensor], name: str, shape: Sequence[int]) -> Tensor:
    return torch.empty(tuple(shape))


def _node(inputs: Sequence[Any], name: str, shape: Sequence[int]) -> Any:
    from onnx.defs import OpSchema
    from onnxscript.values import Op, Opset

    kinds = [(f"T{number}", ["tensor(float)", "tensor(uint8)", "tensor(bool)"], "") for number in range(len(inputs))]
    taken = [OpSchema.FormalParameter(f"input{number}", f"T{number}") for number in range(len(inputs))]
    given = [OpSchema.FormalParameter("output", "tensor(float)")]
    schema = OpSchema(name, _DOMAIN, 1, inputs=taken, outputs=given, type_constraints=kinds)
    return Op(Opset(_DOMAIN, 1), name, schema)(*inputs)


PART: Mapping[Callable[..., object], Callable[..., object]] = {graph_part._opoverload: _node}
"""Translation of ``graph_part`` for ``exported_model``."""


def with_parts(model: onnx.ModelProto, parts: Mapping[str, onnx.ModelProto], kept: str) -> onnx.ModelProto:
    """A graph with parts, of one output each, in the place of the nodes of their names; weights whose names begin
    with ``kept`` keep theirs."""
    whole = onnx.ModelProto()
    whole.CopyFrom(model)
    names = dict[str, dict[str, str]]()
    for name, part in parts.items():
        constants = [one.name for one in part.graph.initializer]
        names[name] = {one: one if one.startswith(kept) else f"{name} {one}" for one in constants}
    _insert(whole.graph, parts, names, iter(range(2**30)))
    for name, part in parts.items():
        for value in part.graph.initializer:
            whole.graph.initializer.add().CopyFrom(value)
            whole.graph.initializer[-1].name = names[name][value.name]
    standard = [one for one in whole.opset_import if one.domain != _DOMAIN]
    del whole.opset_import[:]
    whole.opset_import.extend(standard)
    check_model(whole)
    return whole


def _insert(
    graph: onnx.GraphProto,
    parts: Mapping[str, onnx.ModelProto],
    constants: Mapping[str, Mapping[str, str]],
    count: Iterator[int],
) -> None:
    nodes = list[onnx.NodeProto]()
    for one in graph.node:
        for attribute in one.attribute:
            if attribute.HasField("g"):
                _insert(attribute.g, parts, constants, count)
        if one.domain != _DOMAIN:
            nodes.append(one)
            continue
        part, own = onnx.GraphProto(), f"{one.op_type} {next(count)}"
        part.CopyFrom(parts[one.op_type].graph)
        outside = zip((*part.input, *part.output), (*one.input, *one.output), strict=True)
        known = {value.name: name for value, name in outside} | dict(constants[one.op_type])
        rename_values(part, lambda name, known=known, own=own: known.get(name, f"{own} {name}"))  # type: ignore[misc]
        nodes += part.node
    del graph.node[:]
    graph.node.extend(nodes)
