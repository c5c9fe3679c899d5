"""Loops of a graph that are written out: the short ones, on which ONNX Runtime would spend more than on their steps."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from onnxscript import ir

_LONGEST = 8  # nodes of a body; a step of splitting has six


def unroll_loops(model: ir.Model) -> None:
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


def _steps(body: ir.Graph) -> int | None:
    """How many steps a loop takes whose condition is that its counter is below a constant; None for another."""
    less = body.outputs[0].producer()
    if less is None or less.op_type != "Less" or less.inputs[0] is not body.outputs[1] or less.inputs[1] is None:
        return None
    limit = less.inputs[1].const_value
    return None if limit is None else int(limit.numpy())


def _unroll(loop: ir.Node, body: ir.Graph, count: int) -> None:
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
