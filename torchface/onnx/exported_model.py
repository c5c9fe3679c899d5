"""A module as an ONNX model, by ``torch.export``."""

import json
import logging
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn

from torchface import __version__

if TYPE_CHECKING:
    from onnxscript import ir

OPSET = 18  # of the operators: the oldest that the exporter of PyTorch writes
IR_VERSION = 8  # of the file's format, the oldest that runtimes of the last years read
_FOLDED = 256  # numbers of a constant that is computed beforehand; ONNX Runtime computes larger ones when it loads
_LONGEST = 8  # nodes of a loop's body that is written out; a step of splitting has six


def exported_model(
    module: nn.Module,
    inputs: Mapping[str, Tensor],
    outputs: Sequence[str],
    metadata: Mapping[str, object],
    sizes: Mapping[str, Sequence[str | None]] | None = None,
    translations: Mapping[Callable[..., object], Callable[..., object]] | None = None,
    optimize: bool = True,
) -> onnx.ModelProto:
    """The checked model of a module.

    Args:
        module: of the inputs in their order.
        outputs: names of what the module returns.
        metadata: beside the version; values that are not text become JSON.
        sizes: names of the first axes of inputs, which may then have any size, None for one that keeps the example's;
            the example's is to be 2 or more.
        translations: of operators that PyTorch does not know from ONNX, functions of the operator's arguments.
        optimize: with the exporter's own search for simpler operators, which takes minutes for thousands of them; ONNX
            Runtime simplifies graphs as it loads them, too.
    """
    held = _held_apart(module.eval())
    # Loaded here: it takes a second, and solvers that run graphs have no need of it.
    from onnxscript import ir, optimizer

    shapes = tuple(
        {axis: size or torch.export.Dim.STATIC for axis, size in enumerate((sizes or {}).get(name, ()))} or None
        for name in inputs
    )
    # It warns of missing torchvision, whose operators no graph here has.
    log = logging.getLogger("torch.onnx._internal.exporter._registration")
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(), torch.no_grad():
            warnings.filterwarnings(
                "ignore", r"`isinstance\(treespec", FutureWarning
            )  # PyTorch's copy of its own trees
            warnings.filterwarnings("ignore", "# The axis name", UserWarning)  # of an axis that several inputs have
            program = torch.onnx.export(
                held,
                tuple(inputs.values()),
                input_names=list(inputs),
                output_names=list(outputs),
                dynamic_shapes=None if not any(shapes) else shapes if held is module else (shapes,),
                opset_version=OPSET,
                custom_translation_table=dict(translations or {}),
                dynamo=True,
                optimize=False,
                verbose=False,
            )
    finally:
        log.setLevel(level)
    if program is None:
        raise AssertionError("torch.onnx.export returned no program")
    if optimize:
        optimizer.optimize_ir(program.model, output_size_limit=_FOLDED)
    unroll_loops(program.model)
    ir.passes.Sequential(
        ir.passes.common.LiftConstantsToInitializersPass(lift_all_constants=True, size_limit=0),
        ir.passes.common.LiftSubgraphInitializersToMainGraphPass(),
        ir.passes.common.DeduplicateInitializersPass(size_limit=2**30),
        ir.passes.common.RemoveUnusedNodesPass(),
        ir.passes.common.ClearMetadataAndDocStringPass(),
    )(program.model)
    _with_known_casts(program.model)
    _shorten_names(program.model)
    for value, name in zip(program.model.graph.outputs, outputs, strict=True):
        value.name = name  # which what a loop gives has lost where the loop is written out
    model = program.model_proto
    del model.graph.value_info[:], model.metadata_props[:]
    for value in (*model.graph.input, *model.graph.output):
        del value.metadata_props[:]
    model.producer_name, model.producer_version, model.ir_version = "torchface", "", IR_VERSION
    _set_metadata(model, metadata)
    check_model(model)
    return model


class _Held(nn.Module):
    def __init__(self, module: nn.Module) -> None:
        super().__init__()
        self.module = module

    def forward(self, *inputs: Tensor) -> object:
        return self.module(*inputs)


def _held_apart(module: nn.Module) -> nn.Module:
    """The module itself; or one around it, where it has attributes, such as ``graph``, that ``torch.export`` needs."""
    own = {name.partition(".")[0] for name in module.state_dict()} | {name for name, _ in module.named_children()}
    return _Held(module).eval() if own & (set(dir(torch.fx.GraphModule)) - set(dir(nn.Module))) else module


def half_stored(model: onnx.ModelProto, names: Collection[str]) -> onnx.ModelProto:
    """A graph whose named constants are halves in the file; ONNX Runtime widens them when it loads."""
    casts = []
    for value in model.graph.initializer:
        if value.name in names:
            name, half = value.name, numpy_helper.to_array(value).astype(np.float16)
            value.CopyFrom(numpy_helper.from_array(half, f"{name} half"))
            casts.append(helper.make_node("Cast", [value.name], [name], to=TensorProto.FLOAT))
    nodes = [*casts, *model.graph.node]
    del model.graph.node[:]
    model.graph.node.extend(nodes)
    check_model(model)
    return model


def chained_models(
    first: onnx.ModelProto, second: onnx.ModelProto, outputs: Sequence[str], metadata: Mapping[str, object]
) -> onnx.ModelProto:
    """One model of two of ``exported_model``, of which the second takes outputs of the first by their names."""
    model, rest = onnx.ModelProto(), onnx.GraphProto()
    model.CopyFrom(first)
    rest.CopyFrom(second.graph)
    kept = {one.name for one in (*rest.input, *rest.output)}
    rename_values(rest, lambda name: name if name in kept else f"second.{name}")
    given = {one.name: one for one in (*first.graph.output, *rest.output)}
    del model.graph.output[:]
    model.graph.output.extend(given[name] for name in outputs)
    model.graph.node.extend(rest.node)
    model.graph.initializer.extend(rest.initializer)
    _set_metadata(model, metadata)
    check_model(model)
    return model


def rename_values(graph: onnx.GraphProto, renamed: Callable[[str], str]) -> None:
    """Gives values of a graph, and of those inside its nodes, other names."""
    for value in (*graph.initializer, *graph.input, *graph.output):
        value.name = renamed(value.name)
    for node in graph.node:
        for names in (node.input, node.output):
            names[:] = [name and renamed(name) for name in names]
        for attribute in node.attribute:
            if attribute.HasField("g"):
                rename_values(attribute.g, renamed)


def _set_metadata(model: onnx.ModelProto, metadata: Mapping[str, object]) -> None:
    """Gives a model its metadata and the version; values that are not text become JSON."""
    facts = {"version": __version__, **metadata}
    helper.set_model_props(
        model, {key: value if isinstance(value, str) else json.dumps(value) for key, value in facts.items()}
    )


def check_model(model: onnx.ModelProto) -> None:
    """Has ONNX check a model, with the types of its values where that can be done."""
    # Inference of shapes does not see the constants around a branch, which sizes in it are made of.
    onnx.checker.check_model(model, full_check=all(node.op_type != "If" for node in model.graph.node))


def _with_known_casts(model: Any) -> None:
    """Casts to the type of another value, of which runtimes warn, as casts to that type."""
    from onnxscript import ir

    for node in list(ir.traversal.RecursiveGraphIterator(model.graph)):
        if node.op_type != "CastLike":
            continue
        like, graph = node.inputs[1], node.graph
        assert like is not None
        assert graph is not None
        dtype = like.dtype if like.const_value is None else like.const_value.dtype
        if dtype is not None:
            cast = ir.node("Cast", [node.inputs[0]], {"to": int(dtype)})
            cast.outputs[0].name, cast.outputs[0].type = node.outputs[0].name, node.outputs[0].type
            cast.outputs[0].shape = node.outputs[0].shape
            ir.convenience.replace_nodes_and_values(graph, node, [node], [cast], node.outputs, cast.outputs)


def _shorten_names(model: Any) -> None:
    """Numbers in place of the names of values inside the graph, of which runtimes find the types by themselves."""
    from onnxscript import ir

    outside = {*model.graph.inputs, *model.graph.outputs}
    for number, node in enumerate(ir.traversal.RecursiveGraphIterator(model.graph)):
        node.name = None
        for value in node.outputs:
            if not value.is_graph_output():
                value.type = value.shape = None
        graphs = (attribute.as_graph() for attribute in node.attributes.values() if attribute.type.name == "GRAPH")
        inside = [*node.outputs, *(value for graph in graphs for value in graph.inputs)]
        for place, value in enumerate(value for value in inside if value not in outside):
            value.name = f"{number}.{place}"


def unroll_loops(model: "ir.Model") -> None:
    """Writes out the short loops of ``torchface.optim.fixed_splitting.fixed_loop``, whose number of steps is fixed.

    ONNX Runtime takes some microseconds for a step of a ``Loop`` beside what its nodes take.
    """
    from onnxscript import ir

    for node in list(ir.traversal.RecursiveGraphIterator(model.graph)):
        if node.op_type != "Loop" or len(body := node.attributes["body"].as_graph()) > _LONGEST:
            continue
        if any(attribute.type == ir.AttributeType.GRAPH for inner in body for attribute in inner.attributes.values()):
            continue
        count = _steps(body)
        if count is not None:
            _unroll(node, body, count)


def _steps(body: "ir.Graph") -> int | None:
    """How many steps a loop takes whose condition is that its counter is below a constant; None for another."""
    less = body.outputs[0].producer()
    if less is None or less.op_type != "Less" or less.inputs[0] is not body.outputs[1] or less.inputs[1] is None:
        return None
    limit = less.inputs[1].const_value
    return None if limit is None else int(limit.numpy())


def _unroll(loop: "ir.Node", body: "ir.Graph", count: int) -> None:
    from onnxscript import ir

    graph = loop.graph
    assert isinstance(graph, ir.Graph)
    skipped = {value.producer() for value in body.outputs[:2]}
    carried = list(loop.inputs[3:])
    for _ in range(count):
        values: dict[ir.Value | None, ir.Value | None] = dict(zip(body.inputs[3:], carried, strict=True))
        for node in body:
            if node in skipped:
                continue
            copy = ir.Node(
                node.domain,
                node.op_type,
                [values.get(value, value) for value in node.inputs],
                node.attributes.values(),
                num_outputs=len(node.outputs),
            )
            for value, copied in zip(node.outputs, copy.outputs, strict=True):
                copied.type, copied.shape, values[value] = value.type, value.shape, copied
            graph.insert_before(loop, copy)
        carried = [values.get(value, value) for value in body.outputs[2:]]
    ir.convenience.replace_all_uses_with(
        loop.outputs[1:], [value for value in carried if value is not None], replace_graph_outputs=True
    )
    graph.remove(loop, safe=True)
    for node in body:  # uses of values outside that are no more
        for place in range(len(node.inputs)):
            node.replace_input_with(place, None)
